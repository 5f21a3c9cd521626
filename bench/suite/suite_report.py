"""Report of a benchmark suite: headline, guide, statistics, curves and tables.

No method has a sentence of its own: every name comes from a rank, so that the guide changes with
the results.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pandas.api.types import is_numeric_dtype

from bench.benchmark.comparison_report import REPORT_FILE
from bench.figures.style import MarkStyle, get_mark_style
from bench.pages.chart import Axis, Panel, make_method_series
from bench.pages.html_page import HtmlPage
from bench.pages.template import render_text
from bench.suite.suite_runs import (
    SuiteRuns,
    collect_suite_runs,
    find_stored_runs,
    list_comparison_folders,
    merge_runs,
    read_suite_runs,
    write_suite_runs,
)
from bench.suite.suite_statistics import FREE, SuiteTables, build_guide, choose_segments
from sims.core.files import write_atomically

LOSS_CHECKPOINTS = (10, 100)
"""Numbers of simulations at which losses of the reference methods are listed."""
LOSS_FACTOR = 3.0
"""Ratio to the smallest error above which a method counts as losing."""
REFERENCE_TUNERS = ("hybrid", "tunenet")
"""Methods of this project, whose losses the page lists."""
_SIGNIFICANCE = 0.05
"""Significance level of the tests against the best method."""
MAX_PRINTED_RATIO = 1e4
"""Largest ratio that is printed as a number."""


def build_headline(tables: SuiteTables) -> str:
    """Build one or two sentences that say which method to use up to which number of simulations.

    Ranks do not count the cost of training (`FREE`); so methods without training are named too.

    Args:
        tables: Statistics of the suite, with the mean ranks of its methods.
    """
    ranks = tables.ranks[tables.ranks["training"] == FREE]
    mean_ranks = ranks.pivot(index="tuner", columns="simulations", values="mean_rank")
    untrained = mean_ranks[~mean_ranks.index.isin(tables.get_trained_tuners())]
    best = join_segments(choose_segments(mean_ranks))
    best_untrained = join_segments(choose_segments(untrained))
    if best == best_untrained or untrained.empty:
        return f"Use {best}."
    return (
        f"If you can train on your simulator beforehand, use {best}. "
        f"Without training, use {best_untrained}."
    )


def join_segments(segments: Sequence[tuple[str, int]]) -> str:
    """Describe which method is best up to which number of simulations.

    Args:
        segments: methods, each with its last number of simulations.

    Returns:
        For example ``hybrid up to 30 simulations, then least_squares``.
    """
    *first, (last, _) = segments
    words = [f"{name} up to {k} simulation{'' if k == 1 else 's'}" for name, k in first]
    return ", ".join([*words, f"then {last}" if words else last])


def describe_tests(tables: SuiteTables) -> list[str]:
    """Describe from which methods the best one differs significantly.

    Args:
        tables: Statistics of the suite.

    Returns:
        One sentence per number of simulations (checkpoint).
    """
    tests = []
    rows = tables.pairs[tables.pairs["training"] == FREE]
    for simulations, part in rows.groupby("simulations"):
        # The test is two-sided, so the best tuner must also win on more than half of the problems.
        is_significant = (part["p_holm"] < _SIGNIFICANCE) & (part["best_better"] > 0.5)
        undecided = list(part["tuner"][~is_significant])
        best = part["best"].iloc[0]
        tests.append((simulations, best, len(part), int(is_significant.sum()), undecided))
    return _render_lines("tests.txt", tests=tests)


def describe_losses(tables: SuiteTables) -> list[str]:
    """Describe where the methods of this project lose, and to which method.

    A loss is a cell (problem and range) in which another method has a median error that is smaller
    by `LOSS_FACTOR`.

    Args:
        tables: Statistics of the suite.

    Returns:
        Lines of text.
    """
    cases = [
        (tuner, k, tables.find_losses(tuner, k, LOSS_FACTOR).to_dict("records"))
        for tuner in REFERENCE_TUNERS
        if tuner in tables.suite.tuners
        for k in LOSS_CHECKPOINTS
        if k <= tables.suite.budget
    ]
    values = {"factor": LOSS_FACTOR, "max_ratio": MAX_PRINTED_RATIO, "count": len(tables.curves)}
    return _render_lines("losses.txt", cases=cases, **values)


def _render_lines(name: str, **values: Any) -> list[str]:
    """Render a text template of this folder as lines, without empty ones."""
    return [line for line in render_text(Path(__file__).with_name(name), **values) if line]


_TEMPLATE = Path(__file__).with_name("suite_page.html")
_CURVE_POINTS = (0, 1, 2, 3, 4, 5, 6, 8, 10, 13, 16, 20, 25, 30, 40, 50, 65, 80, 100)
"""Numbers of simulations at which curves are drawn."""
_GUIDE_CHECKPOINTS = (3, 10, 30, 100)
"""Numbers of simulations of the guide."""
_RANK_BLOCKS = (100, 10, 3)
"""Numbers of simulations for which methods x problems are shown."""
_RANK_CLASSES = 5
"""Number of colours of ranks."""
_AIM_TARGETS, _AIM_SEEDS = 30, 3
"""Numbers of targets and seeds that the suite aims at."""
_DIGITS = 4
"""Significant digits of values in the page's tables."""
_FILTERED_COLUMNS = ("training", "property", "value", "cell", "tuner", "simulations", "level")
"""Columns by which the page's tables are filtered."""
_STYLESHEET = """
table.suite-ranks { font-size: 0.8rem; }
table.suite-ranks thead th { writing-mode: vertical-rl; transform: rotate(180deg); }
table.suite-ranks td a { color: inherit; text-decoration: none; display: block; }
table.suite-ranks td { text-align: center; padding: 0.15rem 0.35rem; }
.rank-0 { background: #08519c; color: #fff; }
.rank-1 { background: #3182bd; color: #fff; }
.rank-2 { background: #9ecae1; color: #111; }
.rank-3 { background: #deebf7; color: #111; }
.rank-4 { background: #f7fbff; color: #111; }
td.failed { outline: 2px solid #c00000; outline-offset: -2px; }
"""


def render_suite_page(tables: SuiteTables) -> str:
    """Render the HTML page of a suite, which compares tuners on many problems.

    The page has the ranking of the tuners, significance tests, the guide by property of the
    problem, losses of this project's tuners, and all tables.
    """
    suite = tables.suite
    page = HtmlPage(style=_STYLESHEET)
    frames = {
        "ranks": tables.ranks,
        "pairs": tables.pairs,
        "ert": tables.running_times,
        "profile": tables.profile,
        "ranks_common_targets": tables.ranks_over_common_targets,
        "coverage": tables.coverage,
    }
    shown_frames = {name: frame for name, frame in frames.items() if len(frame)}
    page.add_tables(shown_frames)
    order = _order_tuners(tables)
    styles = {name: get_mark_style(index) for index, name in enumerate(order)}
    targets = suite.runs.groupby("cell")["target"].nunique()
    seed_counts = suite.runs.groupby(["cell", "tuner", "target"])["seed"].nunique()
    seeds = int(seed_counts.max())
    trained = suite.training[suite.training["fit_simulations"] > 0]
    # Only methods with results in every cell (problem with one range of targets) are ranked.
    has_ranking = bool(tables.complete_tuners)
    partial_tuners = [t for t in suite.tuners if t not in tables.complete_tuners]
    return page.render(
        _TEMPLATE,
        version=suite.version,
        tuners=suite.tuners,
        problem_count=suite.cells["problem"].nunique(),
        targets=_join_range(targets),
        seeds=f"{_join_range(seed_counts)} seed{'' if seeds == 1 else 's'}",
        headline=build_headline(tables) if has_ranking else "No method has results in all cells.",
        tests=describe_tests(tables),
        guide_checkpoints=[k for k in _GUIDE_CHECKPOINTS if k in tables.checkpoints],
        guide=_build_guide_rows(tables) if has_ranking else [],
        losses=describe_losses(tables),
        loss_factor=f"{LOSS_FACTOR:g}",
        cells=_build_cells(tables, page, styles),
        rank_blocks=[
            {"k": k, "rows": _build_rank_rows(tables, k, order)}
            for k in _RANK_BLOCKS
            if k in tables.checkpoints
        ],
        partial_tuners=partial_tuners,
        skipped=[f"{row.tuner}: {row.reason}" for row in suite.skipped.itertuples()],
        rank_panel=_make_rank_panel(tables, page, styles) if has_ranking else None,
        columns={name: _list_columns(frame) for name, frame in shown_frames.items()},
        filters={
            name: tuple(column for column in _FILTERED_COLUMNS if column in frame)
            for name, frame in shown_frames.items()
        },
        budget=suite.budget,
        fit_simulations=_join_range(trained["fit_simulations"].astype(int)),
        is_small=targets.min() < _AIM_TARGETS or seeds < _AIM_SEEDS,
    )


def _join_range(values: pd.Series[Any]) -> str:
    """Return the range of values as text."""
    if values.empty:
        return "no"
    low, high = values.min(), values.max()
    return f"{low}" if low == high else f"{low} to {high}"


def _order_tuners(tables: SuiteTables) -> list[str]:
    """Return the tuners, best mean rank after the whole budget first, incomplete ones last."""
    k = tables.checkpoints[-1]
    mean_ranks = tables.get_ranks(k).mean().sort_values(kind="stable")
    complete = [str(t) for t in mean_ranks.index if t in tables.complete_tuners]
    return complete + [t for t in tables.suite.tuners if t not in complete]


def _make_anchor(cell: str) -> str:
    return "cell-" + re.sub(r"[^a-z0-9]+", "-", cell.lower())


def _build_guide_rows(tables: SuiteTables) -> list[dict[str, Any]]:
    """Arrange the guide with one row per property and one entry per number of simulations.

    The guide names, for each property of a problem such as its dimension, the best tuner and the
    best tuner without training.

    Args:
        tables: Statistics of the suite.
    """
    rows = []
    for (name, value), group in build_guide(tables).groupby(["property", "value"], sort=False):
        by_k = group.set_index("simulations")
        entries = [
            {"best": by_k.at[k, "best"], "untrained": by_k.at[k, "best_untrained"]}
            for k in _GUIDE_CHECKPOINTS
            if k in by_k.index
        ]
        label = f"{name}: {value}" if value else name
        rows.append({"label": label, "cells": int(group["cells"].iloc[0]), "entries": entries})
    return rows


def _build_rank_rows(tables: SuiteTables, k: int, order: Sequence[str]) -> list[dict[str, Any]]:
    """Build the rows of methods x cells after k simulations, best mean rank first.

    A cell is a problem with one range of targets. Each entry has the rank of the method in the cell
    and a colour class from it. Methods that do not have results in every cell come last, without a
    mean.

    Args:
        tables: Statistics of the suite.
        k: Number of simulations.
        order: All methods; their order decides between equal mean ranks.
    """
    ranks = tables.get_ranks(k)
    errors = tables.errors[tables.errors["simulations"] == k].set_index(["cell", "tuner"])
    mean_ranks, counts = ranks.mean(), ranks.notna().sum(axis=1)
    rows = []
    for tuner in sorted(
        order, key=lambda t: (t not in tables.complete_tuners, mean_ranks.get(t, math.inf))
    ):
        entries = []
        for cell in map(str, ranks.index):
            rank = float(ranks[tuner][cell]) if tuner in ranks else np.nan
            anchor = _make_anchor(cell)
            if not np.isfinite(rank):
                entries.append({"text": "", "kind": "", "anchor": anchor, "title": ""})
                continue
            # 0 for the best method of the cell, 1 for the worst.
            share = (rank - 1.0) / max(int(counts[cell]) - 1, 1)
            colour = min(int(share * _RANK_CLASSES), _RANK_CLASSES - 1)
            failures = int(errors["failures"][cell, tuner])
            title = f"{tuner} on {cell}: median error {errors['median_error'][cell, tuner]:.2g}"
            title += f", {failures} failed runs" if failures else ""
            kind = f"rank-{colour}" + (" failed" if failures else "")
            entries.append({"text": f"{rank:g}", "kind": kind, "anchor": anchor, "title": title})
        mean = f"{mean_ranks[tuner]:.1f}" if tuner in tables.complete_tuners else ""
        rows.append({"tuner": tuner, "mean": mean, "entries": entries})
    return rows


def _build_cells(
    tables: SuiteTables, page: HtmlPage, styles: dict[str, MarkStyle]
) -> list[dict[str, Any]]:
    """Build name, description and error curves of each cell, a problem with one target range.

    The curve of a tuner is the median over targets with its quartiles.

    Args:
        tables: tables of the suite.
        page: page to which tables and charts are added.
        styles: styles of marks by name of the tuner.
    """
    points = [k for k in _CURVE_POINTS if k <= tables.suite.budget]
    curve_tables = []
    for cell, by_tuner in tables.curves.items():
        for tuner, curves in by_tuner.items():
            values = curves.values[:, points]
            with np.errstate(invalid="ignore"):
                low, median, high = np.percentile(values, [25, 50, 75], axis=0)
            columns = {"simulations": points, "median": median, "low": low, "high": high}
            frame = pd.DataFrame({"cell": cell, "tuner": tuner, **columns})
            curve_tables.append(frame[np.isfinite(frame["median"])])
    page.add_table("curves", pd.concat(curve_tables, ignore_index=True), _DIGITS)
    ticks = tuple(float(k) for k in (0, *tables.checkpoints))
    x_axis = Axis("simulations used on the target", "symlog", ("symlog", "linear"), ticks)
    cells = []
    for row in tables.suite.cells.itertuples():
        cell = str(row.cell)
        cell_styles = {name: look for name, look in styles.items() if name in tables.curves[cell]}
        series = make_method_series(cell_styles, "tuner", "median", where={"cell": cell})
        unit = "held-out RMSE" if row.range == "real" else "error [training widths]"
        panel = Panel(cell, "curves", "simulations", series, x_axis, Axis(f"{unit}, median", "log"))
        anchor = _make_anchor(cell)
        cells.append(
            {
                "name": cell,
                "anchor": anchor,
                "title": row.title,
                "tests": row.tests,
                "identifiable": row.identifiable,
                "panel": panel,
            }
        )
    return cells


def _make_rank_panel(tables: SuiteTables, page: HtmlPage, styles: dict[str, MarkStyle]) -> Panel:
    """Make the panel of mean ranks against the number of simulations.

    Args:
        tables: tables of the suite.
        page: page to which tables and charts are added.
        styles: styles of marks by name of the tuner.
    """
    page.add_table("mean-ranks", tables.ranks[tables.ranks["training"] == FREE], _DIGITS)
    ranked_styles = {name: look for name, look in styles.items() if name in tables.complete_tuners}
    series = make_method_series(ranked_styles, "tuner", "mean_rank")
    ticks = tuple(float(k) for k in tables.checkpoints)
    x_axis = Axis("simulations used on the target", "log", ("log", "linear"), ticks)
    y_axis = Axis("mean rank, 1 is best", scales=("linear",))
    return Panel("Mean rank over all cells", "mean-ranks", "simulations", series, x_axis, y_axis)


def _list_columns(frame: pd.DataFrame) -> list[tuple[str, str, int]]:
    """Return name, heading and significant digits of each column; 0 digits for text."""
    return [
        (str(column), "", _DIGITS if is_numeric_dtype(frame[column]) else 0) for column in frame
    ]


PrintLine = Callable[[str], None]
_MAX_PRINTED_TUNERS = 30
"""Maximum number of tuners in the printed table."""


def report_suite(folder: Path, print_line: PrintLine) -> SuiteTables:
    """Write and print the results of a suite, together with the stored runs of other methods.

    If `folder` has comparisons, their runs are stored in it, too.

    Args:
        folder: folder of the suite, with one subfolder per problem or with stored runs.
        print_line: callback that prints one line.

    Returns:
        The statistics, also those of the other methods.

    Raises:
        InputError: there are no results.
    """
    has_comparisons = any(list_comparison_folders(folder))
    new_runs = collect_suite_runs(folder) if has_comparisons else read_suite_runs(folder)
    suite = new_runs
    # A folder without comparisons has stored runs already, which are reported alone.
    if has_comparisons:
        stored = find_stored_runs(new_runs.version)
        if stored is not None:
            suite = merge_runs(new_runs, stored)
        write_suite_runs(new_runs, folder)
    tables = SuiteTables(suite)
    for name, frame in {**tables.build_tables(), "guide": build_guide(tables)}.items():
        write_atomically(folder / f"{name}.csv", frame.to_csv(index=False))
    write_atomically(folder / REPORT_FILE, render_suite_page(tables))
    _print_results(tables, new_runs, print_line)
    print_line(f"report  {folder / REPORT_FILE}")
    return tables


def _print_results(tables: SuiteTables, new_runs: SuiteRuns, print_line: PrintLine) -> None:
    """Print the headline, the mean ranks and the losses of the reference methods.

    Args:
        tables: tables of the suite.
        new_runs: errors of the runs that were added to the suite.
        print_line: prints one line of text.
    """
    ranks = tables.ranks[tables.ranks["training"] == FREE]
    table = ranks.pivot(index="tuner", columns="simulations", values="mean_rank")
    if len(table):
        table = table.sort_values(by=table.columns[-1]).head(_MAX_PRINTED_TUNERS).round(1)
    lines = render_text(
        _TEMPLATE.with_name("suite.txt"),
        version=new_runs.version,
        tables=tables,
        targets=_join_range(new_runs.runs.groupby("cell")["target"].nunique()),
        stored_tuners=[name for name in tables.suite.tuners if name not in new_runs.tuners],
        skipped=tables.suite.skipped.to_dict("records"),
        missing=[name for name in tables.suite.tuners if name not in tables.complete_tuners],
        headline=build_headline,
        ranks=table,
        losses=describe_losses(tables),
    )
    for line in lines:
        print_line(line)
