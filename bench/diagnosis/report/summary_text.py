"""Plain-text summary of an explanation, for the terminal, the page and the figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from math import isclose, isfinite
from textwrap import wrap

import numpy as np

from bench.diagnosis.evaluation.search_control import QUESTION_TEXTS
from bench.diagnosis.report.cause_text import (
    format_causes,
    format_effect_set,
    format_missing_causes,
    format_number_error,
    format_values,
    has_placed_causes,
    is_overstated,
    rank_candidates,
    strip_place,
)
from bench.diagnosis.report.consistency_section import format_consistency
from bench.diagnosis.report.effect_and_unit_text import (
    END,
    append_unit,
    at_bound,
    format_effect,
    format_estimate,
    format_number,
    format_p_value,
    format_percent,
    format_sentence,
    format_unit,
    is_parameter_error,
    joined,
    sanitise,
)
from bench.diagnosis.report.report_data import (
    ChannelInfo,
    DataSplit,
    DiagnosisReportData,
    GapLocation,
    ParameterChange,
)
from bench.diagnosis.verdict import Cause, HeldOutResult, RecordingFault, Verdict
from sims.core.root_mean_square import compute_rms
from sims.core.simulator import Array

TERMINAL_WIDTH = 100
"""Maximum number of characters of a line on the terminal."""
NOISE_ESTIMATE_ERROR_FACTOR = 1.2
"""Relative standard error of an estimated noise, times the square root of the number of samples
(see `bench.diagnosis.evaluation.noise_floor`).
"""
Z95_ONE_SIDED = 1.645
"""One-sided 95 % quantile of the normal distribution, in standard deviations."""
MAX_PHI = 0.98
"""Maximum correlation of neighbouring samples that is used; with 1 no sample would count."""
MAX_PERCENT_SHIFT = 10.0
"""Relative change of a parameter above which it is not reported in percent."""
MAX_NAMED_CHANNELS = 6
"""Maximum number of channels that a sentence names."""
PERFECT_MODEL_NOTE = "the sensor noise alone would give"
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


def format_summary(report: DiagnosisReportData) -> list[str]:
    """Format the summary as terminal lines.

    They contain the verdict in a sentence, the gain, the location of the gap, changed parameters,
    and what remains unexplained.
    """
    # The title comes from a file: it must not contain line breaks or terminal control sequences.
    lines = [sanitise(report.title, TERMINAL_WIDTH), ""]
    for text in (format_headline(report), *format_gain_and_caveats(report)):
        lines += wrap(text, TERMINAL_WIDTH)
    for text in format_details(report):
        lines += ["", *wrap(text, TERMINAL_WIDTH, subsequent_indent="  ")]
    return lines


def format_details(report: DiagnosisReportData) -> Iterator[str]:
    """Yield the paragraphs below the headline of the summary.

    Args:
        report: Data of the report.

    Returns:
        Paragraphs on causes, reasons, largest gaps, parameters, consistency, residual and next
        experiment. For a recording with a wrong unit or sign, only the number of simulations.
    """
    verdict = report.verdict.verdict
    if report.verdict.recording_faults:
        yield format_simulation_count(report)
        return
    # For these verdicts, the description of an effect is part of the text above the details.
    has_description_above = verdict in ("named", "partial")
    for cause in report.verdict.causes:
        name = f"{format_sentence(format_effect(cause.effect))[:-1]} ({sanitise(cause.effect, 60)})"
        description = "" if has_description_above else f"{_describe_within_sentence(cause)}; "
        yield f"{name}: {description}{format_coefficients(cause)}"
    # The most important reasons come first; the page contains all of them.
    if report.why:
        yield "Why: " + " ".join(format_sentence(text) for text in report.why[:2])
    largest_gaps = [format_largest_gap(report, kind) for kind in ("run", "channel", "phase")]
    gap_texts = [text for text in largest_gaps if text]
    # Without a gap, the largest residual of a part is random.
    if gap_texts and verdict != "adequate":
        unit = "RMS in units of the noise (1 is the noise floor)"
        yield f"Where the gap is largest, {unit}: {'; '.join(gap_texts)}."
    if report.parameters:
        yield "Parameters: " + format_parameter_shifts(report)
    # For a single log with consistent runs there is nothing to report.
    if any(
        not spread.is_consistent or spread.by == "log"
        for spread in (*report.consistency.after, *report.consistency.before)
    ):
        yield "Agreement between runs: " + " ".join(format_consistency(report))
    if report.lack_of_fit:
        yield "Residual: " + " ".join(format_sentence(text) for text in report.lack_of_fit)
    # For an ambiguous verdict, the experiment directly follows the headline.
    if verdict != "ambiguous" and (next_run := format_next_run(report)):
        yield f"Next experiment: {next_run}"
    yield format_simulation_count(report)


def _describe_within_sentence(cause: Cause) -> str:
    """Return the description of an effect, to be used within a sentence."""
    return strip_place(sanitise(cause.says).rstrip("."))


def format_headline(report: DiagnosisReportData) -> str:
    """Format in one sentence what is wrong with the simulator.

    The first rule that applies decides: a fault of the recording, an early stop, then the verdict.

    Args:
        report: Data of the report.
    """
    verdict, causes = report.verdict.verdict, report.verdict.causes
    if report.verdict.recording_faults:
        return format_sentence(report.verdict.recording_faults[0].says)
    if report.verdict.cut is not None:
        return _format_early_stop_headline(report.verdict)
    # A cause is reported as lacking only if the verdict supports it.
    if verdict == "adequate":
        return "These data show no effect that the simulation lacks."
    if verdict == "unidentifiable":
        parameters = joined(list_unidentified_parameters(report))
        return (
            f"These data do not identify {parameters}: it is not known what the simulation lacks."
        )
    if verdict == "unknown" or not causes:
        count = len(rank_candidates(report))
        known = f"none of the {count} known causes" if count else "no set of known causes"
        conclusion = f"{known} explains it"
        conclusion += " at any place" if has_placed_causes(report) else ""
        return f"Something is missing from the simulation, and {conclusion}."
    if verdict == "ambiguous":
        return f"The simulation {format_missing_causes(causes)}: these data do not show which."
    if verdict == "partial" and (open_causes := [c for c in causes if c.open_numbers]):
        reason = _format_unconfirmed_reason(open_causes)
        return f"The simulation {format_missing_causes(causes)}, but {reason}."
    if parameters_at_bounds := report.verdict.bordering:
        (name, first), *_ = parameters_at_bounds.items()
        end = f"the {END[first.at_bound or 'high']} bound of its range"
        value = append_unit(format_number(first.value), first.unit)
        bound_text = f"parameter {sanitise(name, 60)} ends at {end}, {value}"
        return (
            f"The simulation {format_missing_causes(causes)}, but {bound_text}: "
            "the cause may compensate for a value beyond it."
        )
    if verdict == "partial":
        remainder = "something else that no known cause explains"
        if len(causes) == 1 and (number_error := format_number_error(causes[0])):
            return format_sentence(f"{number_error}, and the simulation lacks {remainder}")
        verb = _get_linking_verb(causes)
        return f"The simulation {format_missing_causes(causes)}, and {verb}{remainder}."
    if len(causes) > 1:
        # With several causes the sentence would be too long; their descriptions follow it.
        causes = tuple(replace(cause, alternatives=()) for cause in causes)
        return f"The simulation {format_missing_causes(causes)}."
    (cause,) = causes
    if number_error := format_number_error(cause):
        return format_sentence(number_error)
    if is_overstated(cause):
        return f"The simulation has too much {format_effect(cause.effect)}."
    lacking_text = format_missing_causes([replace(cause, alternatives=())])
    return f"The simulation {lacking_text}: {_describe_within_sentence(cause)}."


def _format_unconfirmed_reason(causes: Sequence[Cause]) -> str:
    """Say why causes are not confirmed: their coefficient is at a bound or has no interval.

    Args:
        causes: Causes with a coefficient at a bound or without an interval.
    """
    numbers = [n for cause in causes for n in cause.open_numbers.values()]
    at_bounds = [n for n in numbers if n.at_bound is not None]
    if not at_bounds:
        subject = "its number" if len(numbers) == 1 else "all of its numbers"
        return f"these data do not determine {subject if len(causes) == 1 else 'all numbers'}"
    first = at_bounds[0]
    value = append_unit(format_number(first.value), first.unit)
    return f"the fit ends at the {END[first.at_bound or 'high']} bound of its range, {value}"


def iterate_undetermined_numbers(report: DiagnosisReportData) -> Iterator[str]:
    """Yield which coefficients are not results, what that means, and what to do.

    Args:
        report: Data of the report.
    """
    open_numbers = [
        (f"{sanitise(cause.effect, 60)}, {sanitise(key, 60)}", fitted)
        for cause in report.verdict.causes
        for key, fitted in cause.open_numbers.items()
    ]
    at_bounds = [(name, fitted) for name, fitted in open_numbers if fitted.at_bound is not None]
    without_interval = [name for name, fitted in open_numbers if fitted.at_bound is None]
    if at_bounds:
        phrases = [
            f"{name}: {append_unit(format_number(fitted.value), fitted.unit)} is the "
            f"{END[fitted.at_bound or 'high']} bound of its range"
            for name, fitted in at_bounds
        ]
        has_time_at_bound = any(fitted.unit == "s" for _, fitted in at_bounds)
        remedy = "; for a time, record longer runs" if has_time_at_bound else ""
        yield (
            f"{'; '.join(phrases)}. A value at a bound is not a result and has no interval: the "
            "data suggest a value beyond it, or another cause acts in a similar way. Check units "
            f"and constants of the recording{remedy}."
        )
    if without_interval:
        yield (
            f"{'; '.join(without_interval)}: the data give no finite interval, so the value is not "
            "a result. Record a motion in which the effect is larger."
        )


def _get_linking_verb(causes: Sequence[Cause]) -> str:
    """Return the verb before a missing effect that follows wrong values."""
    names = [name for cause in causes for name in (cause.effect, *cause.alternatives)]
    return "lacks " if any(is_parameter_error(name) for name in names) else ""


def _format_early_stop_headline(verdict: Verdict) -> str:
    """Format the headline of a search that was stopped early, with its preliminary result."""
    if verdict.verdict == "partial":
        lacking_text = format_missing_causes(verdict.causes)
        return (
            f"The simulation {lacking_text}; the search stopped before testing for further causes."
        )
    no_result = "The search stopped before it identified what the simulation lacks"
    if not verdict.causes:
        return f"{no_result}."
    return f"{no_result}; best candidate so far: {format_causes(verdict.causes)}."


def format_early_stop(report: DiagnosisReportData) -> str:
    """Format why the search stopped early and which questions it skipped; empty if complete."""
    early_stop = report.verdict.cut
    if early_stop is None:
        return ""
    reason = {"budget": "its time budget", "interrupt": "an interrupt"}[early_stop.reason]
    skipped_questions = joined(
        [QUESTION_TEXTS[name] for name in early_stop.skipped_questions if name in QUESTION_TEXTS]
    )
    last_step = (
        f"; last step: {sanitise(early_stop.during_question, 80)}"
        if early_stop.during_question
        else ""
    )
    return f"The search was stopped by {reason}{last_step}. Not completed: {skipped_questions}."


def list_unidentified_parameters(report: DiagnosisReportData) -> list[str]:
    """List the parameters that the recording cannot identify.

    They are those reported by the search, else those without interval, else insensitive ones, else
    all.
    """
    # Each list is the fallback of the previous one, because at least one parameter must be named.
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


def format_gain_and_caveats(report: DiagnosisReportData) -> Iterator[str]:
    """Yield the sentences directly after the headline: gain, caveats and required details.

    Args:
        report: Data of the report.
    """
    verdict = report.verdict.verdict
    yield from (format_sentence(note) for note in report.verdict.recording_notes)
    if report.verdict.recording_faults:
        yield from _format_unit_errors(report.verdict.recording_faults)
        return
    if report.verdict.cut is not None:
        yield format_early_stop(report)
    # A result without a cause needs the tested causes and the detectable gap as context.
    if verdict == "adequate":
        yield format_search_summary(report)
        yield format_detectable_gap(report)
    yield format_gain(report)
    yield from iterate_undetermined_numbers(report)
    if verdict == "partial" or (verdict == "named" and len(report.verdict.causes) > 1):
        # The headline describes a single diagnosed cause; several causes are described here.
        cause_texts = [
            format_number_error(cause)
            or f"{format_effect(cause.effect)}: {_describe_within_sentence(cause)}"
            for cause in report.verdict.causes
        ]
        yield format_sentence("; ".join(cause_texts))
    if verdict == "ambiguous":
        yield "To distinguish them: " + (format_next_run(report) or "no experiment is proposed.")


def _format_unit_errors(errors: Sequence[RecordingFault]) -> Iterator[str]:
    """Yield sentences on a wrong unit or sign: evidence, alternatives, and what to do.

    Args:
        errors: Wrong units or signs that explain the misfit, the likeliest first.
    """
    likeliest_fault, *further_faults = errors
    if likeliest_fault.error_after is not None:
        before = (
            f"from {format_number(likeliest_fault.error_before)} "
            if likeliest_fault.error_before is not None
            else ""
        )
        yield (
            "With this correction the error of the tuned simulation on the fitted runs falls "
            f"{before}to {format_number(likeliest_fault.error_after)} times the noise."
        )
    for text in likeliest_fault.alternatives:
        yield format_sentence(f"or: {text}")
    for fault in further_faults:
        yield format_sentence(f"also: {fault.says}")
    yield "No causes were searched, since each would only imitate this. Correct it and run again."


def format_gain(report: DiagnosisReportData) -> str:
    """Format the held-out error before and after, and the noise floor.

    The noise floor is the error of a perfect model. Without held-out runs, the text says that the
    gain was not measured.
    """
    held_out = report.verdict.heldout
    if held_out is None:
        return _format_fitted_gain(report)
    base = _format_error(report, held_out.rmse_base)
    extended = _format_error(report, held_out.rmse_extended)
    perfect = f"{PERFECT_MODEL_NOTE} {_format_error(report, held_out.noise_floor)}"
    runs = report.validation_runs
    # Without a cause the extended model is the base model, so there is no error after.
    if not report.verdict.causes:
        return f"On {runs} the error of the tuned simulation is {base} (RMSE); {perfect}."
    errors = f"the error on {runs} (RMSE) is {base} before and {extended} after; {perfect}."
    if not has_gap_closed(held_out):
        return errors[0].upper() + errors[1:]
    share = f"{format_percent(held_out.gap_closed)} of the gap{format_interval(held_out)}"
    return f"{_format_closed_gap_subject(report)} {share}: {errors}"


def has_gap_closed(held_out: HeldOutResult) -> bool:
    """Return whether the share of the gap closed is known."""
    return held_out.gap_closed is not None and isfinite(held_out.gap_closed)


def format_interval(held_out: HeldOutResult) -> str:
    """Format the 95 % interval of the share closed: `` (85 to 94 %)``; empty without one."""
    low, high = held_out.low, held_out.high
    if low is None or high is None:
        return ""
    return f" ({format_percent(low).removesuffix(' %')} to {format_percent(high)})"


def _format_closed_gap_subject(report: DiagnosisReportData) -> str:
    """Return the subject and verb of the sentence on how much of the gap is closed.

    Args:
        report: Data of the report, with at least one cause.

    Returns:
        Beginning of the sentence, such as "Together they close".
    """
    causes = report.verdict.causes
    if report.verdict.verdict == "unknown" and report.verdict.cut is None:
        names = joined([format_effect(cause.effect) for cause in causes])
        return f"The best of them, {names}, {'closes' if len(causes) == 1 else 'close'} only"
    if len(causes) > 1:
        return "Together they close"
    if is_parameter_error(causes[0].effect) and not causes[0].alternatives:
        return "Correcting it closes"
    if report.verdict.verdict == "partial":
        return format_sentence(f"{format_effect(causes[0].effect)} closes").rstrip(".")
    if report.verdict.verdict != "ambiguous":
        return "It closes"
    has_several = len(causes[0].alternatives) > 1 and has_placed_causes(report)
    return "Each closes" if has_several else "Either closes"


def _format_fitted_gain(report: DiagnosisReportData) -> str:
    """State the residual of the fitted runs with the tuned model and with the causes added.

    It replaces the gain on held-out runs if that gain was not measured.
    """
    before, after = (
        compute_normalised_rms(report, report.fitting, model_stage)
        for model_stage in ("before", "after")
    )
    error = f"the tuned simulation's error is {format_number(before)} times the noise"
    if report.verdict.causes:
        error += f" before and {format_number(after)} times after"
    caution = "No run is held out, so the gain is not measured independently"
    early_stop = report.verdict.cut
    if early_stop is not None and "held_out" in early_stop.skipped_questions:
        caution = f"The gain was not measured on {report.validation_runs}"
    return f"{caution}; on the fitted runs {error}."


def get_held_out_unit(report: DiagnosisReportData) -> str:
    """Return the unit of the held-out errors.

    It is the stored unit. For a result without one, it is found by comparison: the noise floor is
    the RMS noise of all channels with one unit.
    """
    held_out = report.verdict.heldout
    if held_out is not None and held_out.unit:
        return held_out.unit
    # If the unit is not specified: the noise floor is the RMS noise of the channels of one unit.
    floor = held_out.noise_floor if held_out is not None else None
    units = list(dict.fromkeys(c.unit for c in report.channels))
    for unit in units:
        combined_noise = compute_rms([c.sigma for c in report.channels if c.unit == unit])
        if isclose(combined_noise, floor or 0.0, rel_tol=NOISE_TOLERANCE):
            return unit
    return units[0] if len(units) == 1 else "1"


def _format_error(report: DiagnosisReportData, value: float | None) -> str:
    """Format an error of the held-out prediction with its unit.

    Args:
        report: content of the report, which determines the unit.
        value: the error; None if it was not computed.
    """
    return append_unit(format_number(value), get_held_out_unit(report))


def format_search_summary(report: DiagnosisReportData) -> str:
    """Say how many causes were tested, and which is the best if none is significant.

    Args:
        report: Data of the report with its candidates, the best first.
    """
    candidates = report.verdict.candidates
    if not candidates:
        return "There were no candidate causes."
    best = candidates[0]
    place_text = " at every place" if has_placed_causes(report) else ""
    count = f"{len(rank_candidates(report))} possible causes were tested{place_text}"
    no_significant_cause = f"{count} and none is significant"
    best_candidate = f"{format_effect(best.effect)} ({format_p_value(best.p_value)})"
    return f"{no_significant_cause}; the most promising is {best_candidate}."


def format_detectable_gap(report: DiagnosisReportData) -> str:
    """Format how large a gap the noise could hide in each channel.

    With many channels, only the worst one of each kind is reported.
    """
    sizes = zip(report.channels, compute_detectable_gap(report).tolist(), strict=True)
    # The detectable gap of a channel with too few samples is unknown.
    finite_sizes = [(channel, size) for channel, size in sizes if isfinite(size)]
    parts = []
    for channel, size in _select_worst_of_each_kind(finite_sizes):
        amount = append_unit(format_number(size, 2), channel.unit)
        share = f"{format_number(size / channel.sigma, 2)} of its noise"
        parts.append(f"{amount} in {sanitise(channel.name, 30)} ({share})")
    return f"Noise could conceal a gap of up to {joined(parts)} RMS." if parts else ""


def _select_worst_of_each_kind(
    sizes: Sequence[tuple[ChannelInfo, float]],
) -> list[tuple[ChannelInfo, float]]:
    """Select, from many channels, the one of each kind that hides most, in units of its noise.

    The kind of a channel is the part of its name before the point, such as ``q`` for positions.

    Args:
        sizes: Channels with the smallest gap that would be detected in them, in their units.
    """
    if len(sizes) <= MAX_NAMED_CHANNELS:
        return list(sizes)
    worst_by_kind: dict[str, tuple[ChannelInfo, float]] = {}
    for channel, size in sizes:
        kind = channel.name.partition(".")[0]
        worst_channel, worst_size = worst_by_kind.setdefault(kind, (channel, size))
        if size / channel.sigma > worst_size / worst_channel.sigma:
            worst_by_kind[kind] = channel, size
    return list(worst_by_kind.values())


def compute_detectable_gap(report: DiagnosisReportData) -> Array:
    """Compute the largest gap (C,) that the noise of a channel could hide at 95 %.

    The gap is an RMS in the unit of the channel. r are the n residuals in units of the noise, and s
    = mean(r^2), which is 1 without a gap:

            phi = mean(r_t r_t+1) / s                                   (1)
            n'  = n (1 - phi^2) / (1 + phi^2)                           (2)
            gap^2 = max(0, s - 1) + 1.645 hypot(s sqrt(2 / n'), d)      (3)

    Autocorrelated noise reduces the effective number of samples: (2) is the number of independent
    samples whose mean square has the same variance as that of noise with the correlation phi^k over
    k samples. An estimated noise has itself a relative error of 1.2 / sqrt(n); d is the error of
    its square, twice as much.

    Args:
        report: Data of the report.
    """
    sizes = []
    for c, channel in enumerate(report.channels):
        residual_rows = []
        for split in list_data_splits(report):
            residual_rows += [*((split.observed - split.before)[:, :, c] / channel.sigma)]
        residuals = np.concatenate([row[np.isfinite(row)] for row in residual_rows])
        # A single sample has no neighbour, and its square is not a variance.
        if residuals.size < 2:
            sizes.append(np.nan)
            continue
        square = float(np.mean(residuals**2))
        # Products use neighbours within a run; a product with a missing sample is NaN.
        products = np.concatenate([row[1:] * row[:-1] for row in residual_rows])
        phi = 0.0
        if np.isfinite(products).any() and square:
            phi = float(np.clip(np.nanmean(products) / square, 0.0, MAX_PHI))  # (1)
        effective_samples = residuals.size * (1.0 - phi**2) / (1.0 + phi**2)  # (2)
        noise_error = (
            0.0 if channel.stated else 2.0 * NOISE_ESTIMATE_ERROR_FACTOR / residuals.size**0.5
        )
        standard_error = float(np.hypot(square * (2.0 / effective_samples) ** 0.5, noise_error))
        excess = max(0.0, square - 1.0) + Z95_ONE_SIDED * standard_error  # (3)
        sizes.append(channel.sigma * excess**0.5)
    return np.array(sizes)


def list_data_splits(report: DiagnosisReportData) -> list[DataSplit]:
    """List the fitted runs and the held-out runs, as far as they exist."""
    splits = (report.fitting, report.held_out)
    return [split for split in splits if split is not None and len(split.names)]


def compute_normalised_rms(report: DiagnosisReportData, split: DataSplit, model: str) -> float:
    """Compute the RMS residual of a data split over all channels, in units of the noise.

    Args:
        report: Report data.
        split: Data split.
        model: ``before`` or ``after``.
    """
    sigma = np.array([c.sigma for c in report.channels])
    residual = (split.observed - getattr(split, model)) / sigma
    # The mean of an empty set would cause a warning.
    return float(np.sqrt(np.nanmean(residual**2))) if np.isfinite(residual).any() else float("nan")


def format_coefficients(cause: Cause) -> str:
    """Format a cause's coefficients with intervals, its p-value, and its alternatives."""
    alternatives_text = ""
    if cause.alternatives:
        names = format_effect_set(cause.alternatives)
        alternatives_text = f"; {names} would explain the data equally well"
    parts = [text for text in (format_values(cause), format_p_value(cause.p_value)) if text]
    return f"{'; '.join(parts)}{alternatives_text}."


def format_largest_gap(report: DiagnosisReportData, kind: str) -> str:
    """Format the run, channel or phase with the largest gap; empty if there are not several.

    For example ``channel q (3.2 before, 1.1 after)``: RMS residuals in units of the noise, without
    and with the causes.

    Args:
        report: Report data.
        kind: ``run``, ``channel`` or ``phase``.
    """
    locations = [
        location
        for location in report.gap_locations
        if location.kind == kind and isfinite(location.before)
    ]
    # With a single one, its gap is the largest anyway.
    if len(locations) < 2:
        return ""
    worst: GapLocation = max(locations, key=lambda location: location.before)
    after = f" before, {format_number(worst.after, 2)} after" if report.verdict.causes else ""
    return f"{kind} {sanitise(worst.label, 60)} ({format_number(worst.before, 2)}{after})"


def format_parameter_shifts(report: DiagnosisReportData) -> str:
    """Format how far the parameters move once the causes are in the model.

    A missing effect biases the base parameters, which absorb part of the gap. A few parameters get
    a sentence each; more are listed without intervals, which the page contains.

    Args:
        report: Report data.
    """
    shifts = [p for p in report.parameters if p.is_sensitive]
    if not report.verdict.causes or len(shifts) <= MAX_SENTENCES_ON_PARAMETERS:
        return " ".join(format_parameter_shift(report, p) for p in report.parameters)
    count = sum(has_absorbed_gap(p) for p in shifts)
    absorbed = f"{count} of {len(shifts)} had absorbed part of the gap" if count else "as before"
    values = [
        f"{sanitise(p.name, 60)} {format_number(p.before[0], 2)} → "
        + (format_tuned_value(p, 1) if p.bounds[1] else format_number(p.after[0], 2) + p.in_file)
        for p in shifts
    ]
    fixed = [format_parameter_shift(report, p) for p in report.parameters if not p.is_sensitive]
    return " ".join([f"{absorbed} (before → after): {'; '.join(values)}.", *fixed])


def format_parameter_shift(report: DiagnosisReportData, p: ParameterChange) -> str:
    """Format how far a parameter moves once the cause is in the model.

    The base model had changed it to absorb part of the gap.

    Args:
        report: Report data.
        p: Parameter before and after.
    """
    name = sanitise(p.name, 60)
    unit = f" {format_unit(p.unit)}" if format_unit(p.unit) else ""
    if not p.is_sensitive:
        nominal = f"its nominal {format_number(p.before[0])}{unit}"
        return f"{name} does not influence these data and stays at {nominal}."
    if not report.verdict.causes:
        # Without a cause, the last fit is also of the base model, and is the best one.
        return f"{name} = {format_tuned_value(p, 1)}."
    before, after = format_tuned_value(p, 0), format_tuned_value(p, 1)
    end = ": it had absorbed part of the gap." if has_absorbed_gap(p) else "."
    # A change from the model file is small if the file is right, and its percentage then is not.
    shift = "" if p.in_file else f" ({format_shift(p)})"
    return f"{name} {before} before, {after} after{shift}{end}"


def format_tuned_value(p: ParameterChange, model_index: int) -> str:
    """Format a parameter's estimate with its interval, or the bound that it is at.

    Args:
        p: Parameter before and after.
        model_index: 0 for the estimate before, 1 for the one after.
    """
    value, bound = (p.before, p.after)[model_index], p.bounds[model_index]
    total = p.in_file if model_index else ""
    if bound is not None:
        return at_bound(value[0], p.unit, bound) + total
    return append_unit(format_estimate(*value), p.unit) + total


def format_shift(p: ParameterChange) -> str:
    """Format the change of a parameter in percent, or as a number if it was zero before.

    Args:
        p: Parameter with its estimates before and after the causes are added.
    """
    change = p.after[0] - p.before[0]
    if not change:
        return "unchanged"
    if abs(change) < MIN_REPORTED_CHANGE * abs(p.before[0]):
        return f"changes by less than {format_percent(MIN_REPORTED_CHANGE)}"
    sign = "+" if change > 0 else ""
    # For zero a percentage is undefined, and a very large one is less clear than the number.
    if not p.before[0] or abs(change / p.before[0]) > MAX_PERCENT_SHIFT:
        return sign + append_unit(format_number(change, 2), p.unit)
    return sign + format_percent(change / abs(p.before[0]))


def has_absorbed_gap(p: ParameterChange) -> bool:
    """Return whether a parameter changes significantly.

    The change must exceed the combined 95 % intervals, and be at least `MIN_REPORTED_CHANGE` of the
    value.

    Args:
        p: Parameter with value and interval before and after the causes are added.
    """
    change = abs(p.after[0] - p.before[0])
    # Without intervals, a minimum relative change is required instead.
    if not np.isfinite([*p.before, *p.after]).all():
        return change > MIN_REPORTED_SHIFT * abs(p.before[0])
    before, after = ((high - low) / 2.0 for _, low, high in (p.before, p.after))
    return bool(
        change > np.hypot(before, after) and change >= MIN_REPORTED_CHANGE * abs(p.before[0])
    )


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
