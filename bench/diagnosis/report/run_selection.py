"""Data of one run of a report, and the choice of the run that its figures show."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bench.diagnosis.report.cause_and_value_text import shorten_label
from bench.diagnosis.report.report_data import DataSplit, DiagnosisReportData
from sims.core.simulator import Array


class RunView(NamedTuple):
    """Run that a figure or chart shows.

    Attributes:
        data_split: Data split of the run.
        row: Index of the run in it.
        held_out: Whether the run is held out.
        sigma: (C,) Standard deviation of the noise of each channel.
        gap: RMS residual of the base model over all channels, in units of the noise.
    """

    data_split: DataSplit
    row: int
    held_out: bool
    sigma: Array
    gap: float

    @property
    def name(self) -> str:
        """Name of the run."""
        return self.data_split.names[self.row]

    @property
    def times(self) -> Array:
        """Sample times (T,) of the run, s."""
        return self.data_split.times[self.row]

    def count_samples(self) -> int:
        """Count the sample times; one counts once, however many channels were recorded."""
        return int(np.isfinite(self.data_split.observed[self.row]).any(axis=1).sum())

    def get_samples(self, signal: str, channel_index: int) -> Array:
        """Return the samples (T,) of a channel.

        Args:
            signal: ``observed``, ``before`` (base model) or ``after`` (extended model).
            channel_index: index of the channel.
        """
        samples: Array = getattr(self.data_split, signal)
        return samples[self.row, : len(self.times), channel_index]

    def compute_residual(self, model: str, channel_index: int) -> Array:
        """Compute the residual (T,) of a channel in units of its noise.

        Args:
            model: ``before`` (base model) or ``after`` (extended model).
            channel_index: index of the channel.
        """
        observed = self.get_samples("observed", channel_index)
        difference = observed - self.get_samples(model, channel_index)
        residual: Array = difference / self.sigma[channel_index]
        return residual


def rank_runs(report: DiagnosisReportData) -> list[RunView]:
    """List all runs by descending gap, but the worst held-out run first, if there is any.

    The gap of a run is the RMS residual of the base model in units of the noise; 0 without samples.

    Args:
        report: content of the report, with the fitted and the held-out runs as data splits.
    """
    sigma = np.array([c.sigma for c in report.channels])
    runs = []
    for split in report.data_splits:
        squares = np.square((split.observed - split.before) / sigma)
        for row, run_squares in enumerate(squares):
            finite = run_squares[np.isfinite(run_squares)]
            gap = float(np.sqrt(finite.mean())) if finite.size else 0.0
            runs.append(RunView(split, row, split is report.held_out, sigma, gap))
    runs.sort(key=lambda run: -run.gap)
    has_held_out = any(run.held_out for run in runs)
    first = next(run for run in runs if run.held_out == has_held_out)
    return [first, *(run for run in runs if run is not first)]


def select_worst_run(report: DiagnosisReportData) -> RunView:
    """Select the run with the largest gap in units of the noise, a held-out one if there is any."""
    return rank_runs(report)[0]


def format_selected_run(report: DiagnosisReportData, view: RunView) -> str:
    """Format the phrase of a caption that names a run and says why it is shown.

    For example "Run swing3, the held-out run with the largest gap".

    Args:
        report: content of the report, whose verdict gives the reason.
        view: the run that `select_worst_run` selected.
    """
    # `validation_run` is an adjective: "held-out" or "left-out".
    kind = f"{report.validation_run} run" if view.held_out else "run"
    reason = "that fits worst" if report.verdict.verdict == "adequate" else "with the largest gap"
    return f"Run {shorten_label(view.name)}, the {kind} {reason}"
