"""Collect the data that text, figures and page of a report need."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.fitted_models import select_likeliest
from bench.diagnosis.identifiability import assess_identifiability_after_search
from bench.diagnosis.pipeline.held_out_gap_closed import HeldOutGainCalculator
from bench.diagnosis.pipeline.search_result import SearchResult
from bench.diagnosis.pipeline.simulated_runs import SimulatedRuns
from bench.diagnosis.report import residual_analysis
from bench.diagnosis.report.cause_and_value_text import format_file_change
from bench.diagnosis.report.report_data import (
    ChannelInfo,
    DataSplit,
    DiagnosisReportData,
    GapLocation,
    ParameterChange,
)
from bench.diagnosis.report.summary_text import (
    list_bound_warnings,
    list_unexplained_residuals,
    list_verdict_reasons,
)
from bench.diagnosis.search.diagnose import DiagnosisResult
from bench.diagnosis.search.effect_search import EffectSearch
from bench.diagnosis.validation.run_consistency import (
    ConsistencySummary,
    ParameterConsistency,
    assess_consistency,
)
from bench.diagnosis.verdict import Verdict
from sims.core.simulator import Array
from sims.extended_simulator import FittedValue as Estimate
from sims.recording.recording import Recording

TRACK_COLUMNS = {"u", "v", "radius_px"}
"""Columns by which the recording of a tracked film is recognised."""
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
"""First bytes of every PNG file."""
MAX_TRACK_FIGURE_BYTES = 1_000_000
"""Maximum size in bytes of the track figure that a page includes."""


def build_report_data(
    result: SearchResult, verdict: Verdict, notes: Sequence[str] = ()
) -> DiagnosisReportData:
    """Collect everything that text, figures and page of a report need, for a verdict.

    Args:
        result: Result of the search.
        verdict: Verdict that the report explains.
        notes: Further notes, one sentence each.
    """
    evaluator, recording, finding = result.runs.fitting, result.runs.recording, result.finding
    # Simulated runs (R, T, C) before and after: of the fitted base model, and of the model with the
    # causes.
    before, after = finding.base.fit.simulated, finding.model.fit.simulated
    # The noise is that of the finding, because a good model estimates it better.
    gains = HeldOutGainCalculator(result)
    sigma = gains.noise_sigma
    held_out, held_out_locations = _summarise_held_out(result, sigma)
    changes = tuple(_list_parameter_changes(result))
    # With a wrong unit or sign, no cause was searched, and there is nothing to explain.
    unexplained, reasons, consistency = tuple[str, ...](), tuple[str, ...](), ConsistencySummary()
    if not verdict.recording_faults:
        base = result.base
        unexplained = (
            *list_unexplained_residuals(
                finding.lack_of_fit,
                evaluator.channels,
                base.join_names(base.fit.insensitive_parameters),
                base.join_names(base.fit.unidentified_parameters),
            ),
            *list_bound_warnings(changes),
            *notes,
        )
        reasons = tuple(list_verdict_reasons(finding))
        consistency = _assess_consistency(result)
    return DiagnosisReportData(
        # A recording without a title gets the name of its file.
        title=recording.title or recording.path.stem,
        path=recording.path,
        verdict=verdict,
        channels=_list_channels(result.runs, sigma),
        fitting=build_data_split(evaluator, before, after),
        held_out=held_out,
        gap_locations=(
            *residual_analysis.compute_gap_locations(evaluator, before, after, sigma),
            *held_out_locations,
        ),
        profiles=tuple(
            residual_analysis.compute_residual_profiles(evaluator, before, after, sigma)
        ),
        parameters=changes,
        lack_of_fit=unexplained,
        why=reasons,
        unidentified_parameters=finding.unidentified_parameters,
        robot=residual_analysis.get_robot(evaluator),
        identifiability=assess_identifiability_after_search(result.search),
        consistency=consistency,
        track=_read_track_figure(recording),
        logs=max(1, len({run.log for run in recording.runs})),
        thorough=result.search.thorough,
        cross_validated=result.runs.is_cross_validated,
        share_intervals=gains.compute_share_intervals(),
    )


def build_data_split(evaluator: RunEvaluator, before: Array, after: Array) -> DataSplit:
    """Return the runs of a run evaluator with two simulations of them.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: Run evaluator of the runs.
        before: (R, T, C) simulated by the base model.
        after: (R, T, C) simulated by the extended model.
    """
    names = tuple(run_data.name for run_data in evaluator.prepared_runs)
    times = tuple(run_data.scenario.times for run_data in evaluator.prepared_runs)
    return DataSplit(names, times, evaluator.observed, before, after)


def _summarise_held_out(
    result: SearchResult, sigma: Array
) -> tuple[DataSplit | None, list[GapLocation]]:
    """Return the held-out runs and their gap locations; None and empty if not measured.

    A gap location is a run with its RMS residual before and after the causes are added.

    Args:
        result: result of the search.
        sigma: (C,) standard deviation of the noise of each of C channels.
    """
    evaluator, held_out_fits = result.runs.predicted, result.finding.held_out_fits
    names = result.finding.model.effects
    # If the data do not identify the base model, it is not validated on held-out runs.
    if evaluator is None or held_out_fits is None or names not in held_out_fits:
        return None, []
    # The base model has no effects, and the key ().
    before = held_out_fits[()].simulated
    after = held_out_fits[names].simulated
    how_validated = "left out" if result.runs.is_cross_validated else "held out"
    locations = residual_analysis.compute_gap_locations(
        evaluator, before, after, sigma, f" ({how_validated})"
    )
    # Channels and phases are reported for the fitted runs only; held-out gaps by run.
    runs = [location for location in locations if location.kind == "run"]
    return build_data_split(evaluator, before, after), runs


def _list_channels(runs: SimulatedRuns, sigma: Array) -> tuple[ChannelInfo, ...]:
    """Return name, unit and noise of each channel.

    Args:
        runs: the runs, with their channels and their noise floor.
        sigma: (C,) standard deviation of the noise of each of C channels, in its unit.
    """
    noise_floor = runs.floor
    rows = zip(
        runs.fitting.simulator.channels,
        sigma.tolist(),
        noise_floor.is_stated.tolist(),
        noise_floor.quantisation_step.tolist(),
        strict=True,
    )
    return tuple(
        ChannelInfo(c.name, c.unit, sigma=noise_sigma, stated=is_stated, step=step)
        for c, noise_sigma, is_stated, step in rows
    )


def _list_parameter_changes(result: SearchResult) -> Iterator[ParameterChange]:
    """Yield each base parameter with its value before and after the causes were added.

    A parameter is marked if the data do not determine it, so that it was kept at its nominal
    value.

    Args:
        result: result of the search, with the fits of the base model and of the found model.
    """
    evaluator = result.runs.fitting
    before = result.estimate(result.finding.base).values
    after = result.estimates.values
    for i in evaluator.base_indices.tolist():
        parameter = evaluator.parameters[i]
        # Fixed parameters stay at their nominal values, as the data do not determine them.
        is_sensitive = i not in result.base.fit.fixed_parameters
        yield ParameterChange(
            name=parameter.name,
            unit=parameter.unit,
            before=_get_value_and_interval(before[i]),
            after=_get_value_and_interval(after[i]),
            is_sensitive=is_sensitive,
            bounds=(before[i].at_bound, after[i].at_bound),
            in_file=format_file_change(after[i]),
        )


def _get_value_and_interval(number: Estimate) -> tuple[float, float, float]:
    """Return value and interval as used by figures: NaN where the data give no bound."""
    low = np.nan if number.low is None else number.low
    high = np.nan if number.high is None else number.high
    return number.value, low, high


def _assess_consistency(result: SearchResult) -> ConsistencySummary:
    """Assess the consistency of runs, logs and loads for the base and the extended model.

    Consistency means that groups of runs give the same parameters as all runs together.

    Args:
        result: result of the search.

    Returns:
        Consistency of each parameter before and after the causes are added, and that of the best
        competing effect; empty if the search ended early or the base model is not identified.
    """
    search, finding = result.search, result.finding
    # Without a complete search or an identified base model, there is nothing to compare.
    if finding.early_stop is not None or finding.unidentified_parameters:
        return ConsistencySummary()
    before = assess_consistency(search, finding.base)
    after = assess_consistency(search, finding.model) if finding.model.effects else before
    return ConsistencySummary(before, after, _estimate_parameters_by_group(search, finding))


def _estimate_parameters_by_group(
    search: EffectSearch, finding: DiagnosisResult
) -> tuple[ParameterConsistency, ...]:
    """Return the estimates by run, log or load of the best effect other than a single cause.

    They let the report compare how consistent the cause and its best competitor are: a wrong effect
    needs another coefficient in each group. The competitor is the likeliest single effect with one
    coefficient that is not part of the diagnosis. The result is empty without a competitor, or if
    there is not exactly one cause.

    Args:
        search: the search, with its fitted models by their effects.
        finding: its outcome, with the causes.
    """
    if len(finding.causes) != 1:
        return ()
    (cause,) = finding.causes
    related_effects = {cause.effect, *cause.alternatives, *finding.model.effects}
    singles = [m for m in search.models.values() if len(m.effects) == 1]
    other_models = [
        model
        for model in singles
        if not related_effects & set(model.effects)
        and np.isfinite(model.penalised_log_likelihood)
        # A trend of a coefficient is only visible in effects with a single coefficient.
        and len(search.evaluator.get_coefficient_indices(model.effects[0])) == 1
    ]
    if not other_models:
        return ()
    best = select_likeliest(*other_models)
    (name,) = best.effects
    return tuple(
        consistency
        for consistency in assess_consistency(search, best)
        # Only the coefficient of the effect, and not the base parameters.
        if consistency.number == name
    )


def _read_track_figure(recording: Recording) -> bytes:
    """Return the PNG figure that film tracking saved next to the recording; empty if none.

    A recording is from a film if it has the columns of the tracked ball. A file that is too large
    or not a PNG is left out, because any file may have that name.

    Args:
        recording: the recording, with its path and its extra columns.
    """
    path = recording.path.with_suffix(".png")
    if not recording.extra.keys() >= TRACK_COLUMNS:
        return b""
    try:
        with path.open("rb") as file:
            picture = file.read(MAX_TRACK_FIGURE_BYTES + 1)
    except OSError:
        return b""
    is_usable = picture.startswith(PNG_SIGNATURE) and len(picture) <= MAX_TRACK_FIGURE_BYTES
    return picture if is_usable else b""
