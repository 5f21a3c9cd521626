"""Tests of the sample selection of a page: few real samples, and no lost extreme."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from bench.diagnosis.report.explanation_figures import draw_figure
from bench.diagnosis.report.explanation_page import render_report
from bench.diagnosis.report.motion_chart import (
    MAX_ROWS,
    MIN_ROWS_PER_CHANNEL,
    build_motion_table,
)
from bench.diagnosis.report.report_data import ChannelInfo, DataSplit
from bench.figures.signal_thinning import select_extreme_samples
from tests.bench.diagnosis.sample_report_data import make_report


def lost(kept, signals, peaks):
    """Return the peaks that are not among the kept samples."""
    return [at for at in peaks if at not in set(np.asarray(kept).tolist())]


def test_the_extremes_of_every_stretch_are_kept_and_every_tenth_sample_would_lose_them():
    signal = np.sin(np.arange(25_003) / 500.0)
    peaks = [12_345, 23_456, 777]
    signal[peaks] = 9.0, -7.0, 5.0
    signal[15_000:16_000] = np.nan
    other = np.zeros(signal.size)
    other[[18_181, 3]] = 1.0, -1.0
    kept = select_extreme_samples([signal, other], 100)
    assert lost(kept, signal, [*peaks, 18_181, 3, 0, 25_002]) == []
    assert lost(np.arange(0, signal.size, 10), signal, peaks) != []
    assert len(kept) <= 2 + 4 * 100
    assert np.array_equal(kept, np.unique(kept))
    assert list(select_extreme_samples([np.full(5, np.nan)], 2)) == [0, 2, 4]


def make_long_report(channels=6, runs=4, size=25_000):
    """Return report data with runs of 25 s at 1 kHz."""
    rng = np.random.default_rng(4)
    t = np.arange(size) / 1000.0
    after = np.sin(np.arange(1, channels + 1) * t[:, None])[None].repeat(runs, axis=0)
    observed = after + 0.01 * rng.standard_normal(after.shape)
    before = after + 0.05 * np.cos(3 * t)[None, :, None]
    names = tuple(f"{i + 1}" for i in range(runs))
    held = DataSplit(("late",), (t,), observed[:1], before[:1], after[:1])
    shown = tuple(ChannelInfo(f"channel_{i}", "rad", 0.01, True, 0.0) for i in range(channels))
    side = DataSplit(names, (t,) * runs, observed, before, after)
    return replace(make_report(), fitting=side, held_out=held, channels=shown)


def test_long_recordings_are_thinned_said_so_and_stay_below_3_mb():
    channels, runs = 6, 4
    told = make_long_report(channels, runs)
    found = build_motion_table(told)
    assert len(found.frame) <= 1.1 * max(MAX_ROWS, MIN_ROWS_PER_CHANNEL * channels * (runs + 1))
    page = render_report(told, {})
    assert "Runs of up to 25000 samples are not drawn in full" in page
    assert f"each of {found.part_count} parts of a run" in page
    # Every row is an original sample, not an average.
    frame = pd.DataFrame(found.frame.rows())
    rows = frame[(frame["run"] == "2") & (frame["channel"] == "channel_3")]
    places = np.round(rows["t"].astype(float) * 1000).astype(int)
    measured = told.fitting.observed[1, places, 3]
    assert np.allclose(rows["measured"].astype(float), measured, atol=1e-4)
    assert float(rows["measured"].astype(float).max()) == pytest.approx(
        told.fitting.observed[1, :, 3].max(), abs=1e-4
    )
    assert len(page.encode()) < 2_300_000


def test_of_very_many_runs_the_worst_are_shown_and_the_rest_is_counted():
    told = make_report()
    many = replace(
        told.fitting,
        names=tuple(f"r{i}" for i in range(80)),
        times=told.fitting.times * 20,
        observed=np.tile(told.fitting.observed, (20, 1, 1)),
        before=np.tile(told.fitting.before, (20, 1, 1)) + np.arange(80)[:, None, None],
        after=np.tile(told.fitting.after, (20, 1, 1)),
    )
    found = build_motion_table(replace(told, fitting=many))
    names = [run.name for run in found.runs]
    assert names[:3] == ["held 2", "r79", "r78"]
    assert found.absent == 82 - len(names) > 0
    page = render_report(replace(told, fitting=many), {})
    assert f"{found.absent} more runs, which fit better, are not drawn." in page
    assert "not drawn in full" not in page


def test_runs_of_one_sample_and_runs_without_any_are_no_trouble():
    told = make_report()
    side = told.held_out
    observed = side.observed.copy()
    observed[0] = np.nan
    short = replace(side, observed=observed, times=(side.times[0], side.times[1][:1]))
    found = build_motion_table(replace(told, held_out=short))
    frame = pd.DataFrame(found.frame.rows())
    rows = frame[frame["run"] == side.names[1]]
    assert list(rows["t"]) == ["0", "0"]
    assert set(frame[frame["run"] == side.names[0]]["measured"]) == {""}


def test_dots_of_a_long_run_are_pixels_in_vector_files_too():
    dots, outlines = (
        next(
            line for line in draw_figure(told, "overview").axes[0].lines if line.get_marker() == "o"
        )
        for told in (make_long_report(1, 1), make_report())
    )
    assert dots.get_rasterized()
    assert not outlines.get_rasterized()
