"""Tests of the figures of a comparison, by name, and of the tables next to them."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from bench.benchmark import comparison_printed_figures
from bench.benchmark.comparison_printed_figures import (
    FIGURE_FILES,
    draw_figure,
    list_figure_names,
)
from bench.benchmark.statistics.comparison_statistics import ComparisonStatistics, build_tables
from bench.benchmark.statistics.error_curves import build_error_table
from sims.core.simulator import InputError
from tests.bench.figures.sample_comparisons import LABELS, stored

ALL = list(FIGURE_FILES)


def words(drawn):
    texts = [axis.get_title() for axis in drawn.axes]
    texts += [axis.get_ylabel() for axis in drawn.axes]
    return " | ".join([*texts, drawn.get_suptitle()])


def test_a_comparison_that_has_everything_allows_every_figure():
    assert list_figure_names(stored()) == ALL
    assert len(set(FIGURE_FILES.values())) == len(FIGURE_FILES)


@pytest.mark.parametrize(
    ("missing", "changes"),
    [
        ({"misfit"}, {"experiment": replace(stored().experiment, world={})}),
        ({"distance"}, {"runs": stored().runs.assign(outside=0.0)}),
        ({"amortisation"}, {"costs": {"tunenet": (0.0, 0.0)}}),
        ({"spectra"}, {"spectra": None}),
        (
            {"directions"},
            {"runs": stored().runs.drop(columns=["stiff_error", "sloppy_error", "heldout_error"])},
        ),
        (set(ALL), {"runs": pd.DataFrame()}),
    ],
)
def test_what_a_comparison_lacks_is_not_drawn(missing, changes):
    lacking = stored(**changes)
    assert list_figure_names(lacking) == [name for name in ALL if name not in missing]
    with pytest.raises(InputError, match=f"unknown figure '{next(iter(missing))}'; there are: "):
        draw_figure(lacking, LABELS, next(iter(missing)))


@pytest.mark.parametrize(
    ("name", "axes", "text"),
    [
        ("error", 2, "absolute error of restitution, median"),
        ("misfit", 2, "RMSE of z [m], median"),
        ("distance", 3, "After 12 simulations"),
        ("runtime", 2, "share of (run, threshold) pairs reached"),
        ("cost", 2, "seconds per target"),
        ("amortisation", 2, "tuner that searches"),
        ("spectra", 2, "what the data identify"),
        ("directions", 6, "RMSE of z [m], unseen scenarios, median"),
    ],
)
def test_each_figure_can_be_had_without_a_file(name, axes, text):
    drawn = draw_figure(stored(), LABELS, name)
    assert isinstance(drawn, Figure)
    assert len(drawn.axes) == axes
    assert text in words(drawn)


def test_a_figure_draws_the_numbers_of_the_runs():
    whole = stored()
    axis = draw_figure(whole, LABELS, "error").axes[0]
    lines = {line.get_label(): line for line in axis.lines}
    part = whole.runs[(whole.runs["range"] == "in") & (whole.runs["k"] == 12)]
    for tuner, values in part.groupby("tuner")["param_abs_error"]:
        assert lines[tuner].get_ydata()[-1] == pytest.approx(np.median(values), rel=1e-12)


def test_errors_that_count_as_equal_are_shaded_and_cut_no_curve():
    whole = stored(experiment=replace(stored().experiment, negligible_error=0.05))
    whole = whole._replace(runs=whole.runs.drop(columns=["stiff_error", "sloppy_error"]))
    drawn = draw_figure(whole, LABELS, "error")
    for axis in drawn.axes:
        (said,) = (text.get_text() for text in axis.texts)
        assert said == "below 0.02: count as equal"  # 0.4 of restitution is one training width
        low, high = axis.get_ylim()
        values = np.concatenate([line.get_ydata() for line in axis.lines])
        assert low <= values.min()
        assert values.max() <= high


def test_statistics_are_computed_once_for_several_figures(monkeypatch):
    whole = stored()
    statistics = ComparisonStatistics(whole)

    def again(_):
        raise AssertionError("computed again")

    monkeypatch.setattr(comparison_printed_figures, "ComparisonStatistics", again)
    for name in ("runtime", "cost", "amortisation"):
        draw_figure(whole, LABELS, name, statistics)


def test_tables_can_be_had_without_a_file():
    whole = stored()
    made = build_tables(whole)
    assert list(made) == ["table", "ert", "ranking", "pairs", "break_even", "who_wins"]
    expected = ComparisonStatistics(whole).sort_rows(
        build_error_table(whole.runs, whole.statuses, 12, whole.costs)
    )
    assert list(dict.fromkeys(expected["tuner"])) == ["tunenet", "random"]
    pd.testing.assert_frame_equal(made["table"].drop(columns=["salt", "trusted"]), expected)
    assert set(made["ert"]["tuner"]) == {"random", "tunenet"}
    assert set(made["pairs"]["range"]) == {"in", "wide"}
    assert set(made["break_even"]["learned"]) == {"tunenet"}
    assert len(made["who_wins"]) > 0
    assert build_tables(stored(runs=pd.DataFrame())) == {}


def test_who_begins_at_the_target_needs_nothing_and_has_no_place_on_a_logarithmic_axis():
    whole = stored()
    first = whole.runs.assign(tuner_seconds=whole.runs["tuner_seconds"] * (whole.runs["k"] > 0))
    errors = ["param_error", "param_abs_error", "stiff_error", "sloppy_error"]
    first.loc[first["tuner"] == "random", errors] = 0.01
    there = stored(runs=first)
    drawn = draw_figure(there, LABELS, "cost")
    lines = {line.get_label() for axis in drawn.axes for line in axis.get_lines()}
    assert "random" not in lines
    assert "tunenet" in lines


def test_break_even_is_drawn_at_the_numbers_of_its_table():
    whole = stored()
    drawn = draw_figure(whole, LABELS, "amortisation")
    evens = build_tables(whole)["break_even"]
    level = ComparisonStatistics(whole).reference_level
    for axis, kind in zip(drawn.axes, ("in", "wide"), strict=True):
        part = evens[(evens["range"] == kind) & (evens["threshold"] == level)]
        (line,) = (one for one in axis.containers if one.get_label() == "tunenet")
        expected = np.where(part["targets"] == 0, 10**-0.5, part["targets"])
        assert line.lines[0].get_xdata().tolist() == pytest.approx(expected.tolist())
    assert [tick.get_text() for tick in drawn.axes[0].get_yticklabels()] == ["random"]
