"""Choice of the run that a figure shows, and of the samples that are drawn."""

from __future__ import annotations

import warnings
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.diagnosis.report.figure_panels import shorten_label
from bench.diagnosis.report.report_data import DataSplit, DiagnosisReportData
from bench.diagnosis.report.summary_text import list_data_splits
from sims.core.simulator import Array

MAX_SAMPLES = 3000
"""Maximum number of samples drawn of a run; of a longer run the extremes of each part are drawn."""
MAX_OUTLINED_DOTS = 1000
"""Maximum number of dots drawn as vector outlines; more dots are rasterised in vector files too."""
MAX_CHANNELS = 3
"""Maximum number of channels shown: those with the largest residuals."""


class RunView(NamedTuple):
    """Run that a figure shows.

    Attributes:
        data_split: Data split of the run.
        row: Index of the run in it.
        held_out: Whether the run is held out.
        channels: Indices of the channels to show.
    """

    data_split: DataSplit
    row: int
    held_out: bool
    channels: list[int]

    def count_samples(self) -> int:
        """Count the sample times; one counts once, however many channels were recorded."""
        return int(np.isfinite(self.data_split.observed[self.row]).any(axis=1).sum())


def select_worst_run(report: DiagnosisReportData) -> RunView:
    """Select the run with the largest gap in units of the noise, a held-out one if there is any."""
    split = list_data_splits(report)[-1]
    sigma = np.array([c.sigma for c in report.channels])
    squares = ((split.observed - split.before) / sigma) ** 2
    with warnings.catch_warnings():
        # The mean of a run or channel without samples is NaN, which counts as zero.
        warnings.simplefilter("ignore", RuntimeWarning)
        row = int(np.argmax(np.nan_to_num(np.nanmean(squares, axis=(1, 2)))))
        by_channel = np.nan_to_num(np.nanmean(squares[row], axis=0))
    channels = np.argsort(-by_channel, kind="stable")[:MAX_CHANNELS]
    return RunView(split, row, split is report.held_out, sorted(int(c) for c in channels))


def format_selected_run(report: DiagnosisReportData, view: RunView) -> str:
    """Format the name of the run, and why `select_worst_run` has selected it."""
    kind = f"{report.validation_run} run" if view.held_out else "run"
    reason = "that fits worst" if report.verdict.verdict == "adequate" else "with the largest gap"
    return f"Run {shorten_label(view.data_split.names[view.row])}, the {kind} {reason}"


def decimate(values: Array) -> NDArray[np.intp]:
    """Select about `MAX_SAMPLES` samples at most: minimum and maximum of each part of the run."""
    if values.size <= MAX_SAMPLES:
        return np.arange(values.size)
    edges = np.linspace(0, values.size, MAX_SAMPLES // 2 + 1).astype(int)
    # A missing sample is neither minimum nor maximum.
    low, high = np.nan_to_num(values, nan=np.inf), np.nan_to_num(values, nan=-np.inf)
    chosen = []
    for begin, end in pairwise(edges):
        chosen += [begin + np.argmin(low[begin:end]), begin + np.argmax(high[begin:end])]
    return np.unique(chosen)
