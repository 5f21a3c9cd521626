"""Plain-text summary of an explanation, for the terminal, the page and the figures."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from functools import cache
from math import isclose, isfinite
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from bench.diagnosis.evaluation.search_control import QUESTION_TEXTS, EarlyStop
from bench.diagnosis.report import (
    candidate_ranking,
    cause_and_value_text,
    detectable_gap,
    residual_analysis,
)
from bench.diagnosis.report.cause_and_value_text import (
    END_WORDS,
    append_unit,
    format_effect_set,
    format_estimate,
    format_number,
    format_percent,
    format_sentence,
    format_value_at_bound,
    sanitise,
)
from bench.diagnosis.report.consistency_section import format_consistency as format_consistency
from bench.diagnosis.report.report_data import (
    DiagnosisReportData,
    GapLocation,
    ParameterChange,
)
from bench.diagnosis.search.diagnose import DiagnosisResult
from bench.diagnosis.search.lack_of_fit import LackOfFitResult
from bench.diagnosis.search.verdict_rules import (
    EFFECT_P_VALUE_THRESHOLD,
    STRUCTURE_P_VALUE_THRESHOLD,
)
from bench.diagnosis.verdict import Cause, HeldOutResult
from bench.pages.template import load_template
from sims.core.root_mean_square import compute_rms
from sims.extended_simulator import FittedValue

_TEMPLATE = Path(__file__).with_name("summary.txt")
TERMINAL_WIDTH = 100
"""Maximum number of characters of a line on the terminal."""
MAX_PERCENT_SHIFT = 10.0
"""Relative change of a parameter above which it is not reported in percent."""
MIN_REPORTED_SHIFT = 0.05
"""Minimum relative change of a parameter that is reported as absorption if its interval is unknown.
"""
MIN_REPORTED_CHANGE = 1e-3
"""Minimum relative change of a parameter that can be reported as absorption, however narrow its
interval.
"""
MAX_SENTENCES_ON_PARAMETERS = 3
"""Maximum number of parameters that get a sentence each."""
NOISE_TOLERANCE = 0.02
"""Relative difference up to which two noise levels are printed as one."""


@cache
def _load_sentences() -> Any:
    """Load the macros of the template of sentences."""
    return load_template(_TEMPLATE).make_module(
        {
            "summary": sys.modules[__name__],
            "ranking": candidate_ranking,
            "residuals": residual_analysis,
            "gaps": detectable_gap,
            "wording": cause_and_value_text,
            "MAX_SENTENCES_ON_PARAMETERS": MAX_SENTENCES_ON_PARAMETERS,
            "significance_level": EFFECT_P_VALUE_THRESHOLD,
        }
    )


def _write(macro: str, *values: Any) -> list[str]:
    """Write the sentences of a macro, one per line of its text."""
    lines = getattr(_load_sentences(), macro)(*values).split("\n")
    return [" ".join(line.split()) for line in lines if line.strip()]


def _write_one(macro: str, *values: Any) -> str:
    """Write the text of a macro as one sentence or clause."""
    return " ".join(_write(macro, *values))


def format_summary(report: DiagnosisReportData) -> list[str]:
    """Format the summary of a report as lines for the terminal.

    They contain the verdict in a sentence, the gain, the location of the gap, changed parameters,
    and what remains unexplained.

    Args:
        report: content of the report.
    """
    # The title comes from a file: it must not contain line breaks or terminal control sequences.
    lines = [sanitise(report.title, TERMINAL_WIDTH), ""]
    for text in (format_headline(report), *format_gain_and_caveats(report)):
        lines += wrap(text, TERMINAL_WIDTH)
    for text in _write("details", report):
        lines += ["", *wrap(text, TERMINAL_WIDTH, subsequent_indent="  ")]
    return lines


def format_headline(report: DiagnosisReportData) -> str:
    """Format in one sentence what is wrong with the simulator."""
    return _write_one("headline", report)


def format_gain_and_caveats(report: DiagnosisReportData) -> list[str]:
    """List the sentences directly after the headline: gain, caveats and required details."""
    return _write("caveats", report)


def format_early_stop(report: DiagnosisReportData) -> str:
    """Format why the search stopped early and which questions it skipped; empty if complete."""
    return _write_one("early_stop", report)


def format_coefficients(cause: Cause) -> str:
    """Format a cause's coefficients with intervals, its p-value, and its alternatives."""
    return _write_one("coefficients", cause)


def format_interval(held_out: HeldOutResult) -> str:
    """Format the 95 % interval of the share closed: `` (85 to 94 %)``; empty without one."""
    text = _write_one("interval", held_out)
    return f" {text}" if text else ""


def list_open_numbers(report: DiagnosisReportData) -> list[tuple[str, FittedValue]]:
    """List the coefficients that are not results, each with its cause and name."""
    return [
        (f"{sanitise(cause.effect, 60)}, {sanitise(key, 60)}", fitted)
        for cause in report.verdict.causes
        for key, fitted in cause.open_numbers.items()
    ]


def list_skipped_questions(early_stop: EarlyStop) -> list[str]:
    """List the questions that a search did not answer before it was stopped."""
    names = early_stop.skipped_questions
    return [QUESTION_TEXTS[name] for name in names if name in QUESTION_TEXTS]


def list_largest_gaps(report: DiagnosisReportData) -> list[GapLocation]:
    """List the run, the channel and the phase with the largest gap, if there are several of each.

    The gap is the RMS residual in units of the noise.

    Args:
        report: content of the report, with the gap of each run, channel and phase of the motion.
    """
    largest = []
    for kind in ("run", "channel", "phase"):
        places = [p for p in report.gap_locations if p.kind == kind and isfinite(p.before)]
        # With a single one, its gap is the largest anyway.
        if len(places) > 1:
            largest.append(max(places, key=lambda place: place.before))
    return largest


def list_unidentified_parameters(report: DiagnosisReportData) -> list[str]:
    """List the parameters that the recording cannot identify; at least one is named.

    The first of these lists that is not empty is returned:

    1. those that the search reported,
    2. those without an interval, although the data are sensitive to them,
    3. those to which the data are not sensitive,
    4. all parameters,
    5. a phrase for all of them.

    Args:
        report: content of the report; its parameters have a value and an interval each.
    """
    without_interval = [
        p.name for p in report.parameters if p.is_sensitive and not np.isfinite(p.before).all()
    ]
    insensitive = [p.name for p in report.parameters if not p.is_sensitive]
    names = (
        list(report.unidentified_parameters)
        or without_interval
        or insensitive
        or [p.name for p in report.parameters]
    )
    return [sanitise(name, 60) for name in names] or ["the simulation's parameters"]


def has_gap_closed(held_out: HeldOutResult) -> bool:
    """Return whether the share of the gap closed is known."""
    return held_out.gap_closed is not None and isfinite(held_out.gap_closed)


def get_held_out_unit(report: DiagnosisReportData) -> str:
    """Return the unit of the held-out errors.

    It is the stored unit. For a result without one, it is found by comparison: the noise floor is
    the RMS noise of all channels with one unit. If this fits no unit, the result is the only unit
    of the channels, or ``1``.

    Args:
        report: content of the report, with the channels and their noise.
    """
    held_out = report.verdict.heldout
    if held_out is not None and held_out.unit:
        return held_out.unit
    floor = held_out.noise_floor if held_out is not None else None
    units = list(dict.fromkeys(c.unit for c in report.channels))
    for unit in units:
        combined_noise = compute_rms([c.sigma for c in report.channels if c.unit == unit])
        if isclose(combined_noise, floor or 0.0, rel_tol=NOISE_TOLERANCE):
            return unit
    return units[0] if len(units) == 1 else "1"


def format_tuned_value(p: ParameterChange, model_index: int) -> str:
    """Format a parameter's estimate with its interval, or the bound that it is at.

    The estimate after is followed by the change of the number in the model file, if there is one.

    Args:
        p: Parameter before and after the causes are added.
        model_index: 0 for the estimate before, 1 for the one after.
    """
    value, low, high = (p.before, p.after)[model_index]
    bound = p.bounds[model_index]
    file_change = p.in_file if model_index == 1 else ""
    if bound is not None:
        return format_value_at_bound(value, p.unit, bound) + file_change
    return append_unit(format_estimate(value, low, high), p.unit) + file_change


def format_shift(p: ParameterChange) -> str:
    """Format the change of a parameter in percent, or as a number if it was zero before.

    A very large change is a number too, as it is clearer than a percentage.

    Args:
        p: Parameter with its estimates before and after the causes are added.
    """
    (before, _, _), (after, _, _) = p.before, p.after
    change = after - before
    if not change:
        return "unchanged"
    if abs(change) < MIN_REPORTED_CHANGE * abs(before):
        return f"changes by less than {format_percent(MIN_REPORTED_CHANGE)}"
    sign = "+" if change > 0 else ""
    if not before or abs(change / before) > MAX_PERCENT_SHIFT:
        return sign + append_unit(format_number(change, 2), p.unit)
    return sign + format_percent(change / abs(before))


def has_absorbed_gap(p: ParameterChange) -> bool:
    """Return whether a parameter had absorbed a part of the gap: whether it changes significantly.

    The change must exceed the root sum square of the half-widths of both 95 % intervals, and be at
    least `MIN_REPORTED_CHANGE` of the value. Without intervals, a minimum relative change is
    required instead.

    Args:
        p: Parameter with value and interval before and after the causes are added.
    """
    (before, low_before, high_before), (after, low_after, high_after) = p.before, p.after
    change = abs(after - before)
    if not np.isfinite([*p.before, *p.after]).all():
        return change > MIN_REPORTED_SHIFT * abs(before)
    min_significant_change = np.hypot(
        (high_before - low_before) / 2.0, (high_after - low_after) / 2.0
    )
    return bool(change > min_significant_change and change >= MIN_REPORTED_CHANGE * abs(before))


def format_next_run(report: DiagnosisReportData) -> str:
    """Format the proposed next experiment; empty if there is none."""
    next_run = report.verdict.next_experiment
    return format_sentence(next_run.says) if next_run is not None else ""


def format_simulation_count(report: DiagnosisReportData) -> str:
    """Format the number of simulations, system, engine and duration."""
    verdict = report.verdict
    system = sanitise(verdict.system, 60)
    engine = sanitise(verdict.engine, 60)
    simulations = f"{verdict.simulations:,} simulations of system {system} on engine {engine}"
    return f"{simulations}, {format_number(verdict.seconds, 2)} s."


def list_verdict_reasons(finding: DiagnosisResult) -> Iterator[str]:
    """Yield the reasons for the verdict as sentences, the most important first.

    A search that was stopped early has no such reasons.

    Args:
        finding: Outcome of the search: verdict, causes and lack of fit.
    """
    if finding.early_stop is not None:
        return
    if finding.verdict == "unknown" and finding.causes:
        yield "the best effects do not close enough of the gap to explain it"
    if finding.verdict in ("partial", "unknown") and finding.lack_of_fit.has_structure:
        yield _describe_residual_structure(finding.lack_of_fit)
    for cause in finding.causes:
        if cause.alternatives:
            names = [cause.effect, *cause.alternatives]
            # Effects of a robot have a place, such as `friction.coulomb@elbow`.
            have_places = any("@" in name for name in names)
            effects_text = (
                format_effect_set(names, "and") if have_places else _join_effect_names(names)
            )
            yield (
                f"{effects_text} have the same influence on these runs, "
                "once parameters and initial states are fitted with each: "
                "their likelihoods differ by odds of less than 33 to 1"
            )


def _describe_residual_structure(lack_of_fit: LackOfFitResult) -> str:
    """Say how the residual of the final model still differs from the noise of the sensors.

    Args:
        lack_of_fit: Result of the lack-of-fit test, with a p-value for a pattern in the residual.
    """
    p_value = lack_of_fit.p_value
    # Lack of fit is either a residual with a pattern, or one that is only too large.
    if p_value < STRUCTURE_P_VALUE_THRESHOLD:
        return (
            f"the residual has structure that sensor noise does not explain (p-value {p_value:.2g})"
        )
    return "the residual exceeds the stated noise of the sensors"


def _join_effect_names(effects: list[str]) -> str:
    """Join registered names of effects."""
    return f"{effects[0]} and {', '.join(effects[1:])}"


def list_bound_warnings(changes: Sequence[ParameterChange]) -> Iterator[str]:
    """Yield a warning for each base parameter whose fitted value is at a bound of its range.

    The value may then be wrong, and a cause may compensate for it. There are two fits, that of the
    base model and that of the model with the causes. Of a parameter that is at a bound in both,
    only the base fit is reported.

    Args:
        changes: Value, interval and bound of each parameter in both fits.
    """
    for parameter in changes:
        (value_before, *_), (value_after, *_) = parameter.before, parameter.after
        values = value_before, value_after
        for fit_text, value, bound in zip(
            ("in the base fit ", ""), values, parameter.bounds, strict=True
        ):
            if bound is None:
                continue
            yield (
                f"{fit_text}{parameter.name} lies at the {END_WORDS[bound]} bound of its range, "
                f"{value:g} {parameter.unit}: larger ranges were not searched, and a "
                "cause may compensate for a value beyond the bound. Check the "
                "units and constants of the recording"
            )
            # A parameter that is at a bound in the base fit is not reported for the second fit.
            break


def list_unexplained_residuals(
    lack_of_fit: LackOfFitResult, channels: Sequence[str], insensitive: str, unidentified: str
) -> Iterator[str]:
    """Yield sentences on the residual of the extended model, and on parameters kept nominal.

    These are channels above the noise, the dependence of an unmodelled force, and parameters that
    the data do not identify.

    Args:
        lack_of_fit: Result of the lack-of-fit test of the extended model.
        channels: Names of all channels.
        insensitive: Joined names of the parameters to which the data are insensitive.
        unidentified: Joined names of those that are not identified together with the others.
    """
    for channel in lack_of_fit.channels_above_noise:
        noise_multiple = lack_of_fit.excess[channels.index(channel)]
        yield f"the residual of channel {channel} is {noise_multiple:.3g} times its noise"
    # `where` names the variable; it is empty if no test for unmodelled forces was made.
    if lack_of_fit.has_structure and lack_of_fit.where:
        yield f"the residual behaves like a force that depends on {lack_of_fit.where}"
    if insensitive:
        yield f"the data do not depend on {insensitive}: kept at the nominal value"
    if unidentified:
        yield (
            f"the data do not identify {unidentified} together with the other parameters: kept at "
            "the nominal value"
        )
