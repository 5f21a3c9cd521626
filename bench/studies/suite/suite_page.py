"""Page of a benchmark suite: headline, guide, methods x problems, statistics and curves."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pandas.api.types import is_numeric_dtype

from bench.figures.style import MarkStyle, get_mark_style
from bench.pages.chart import Axis, Panel, Series
from bench.pages.html_page import HtmlPage
from bench.studies.suite.suite_guide import (
    LOSS_FACTOR,
    build_guide,
    build_headline,
    describe_losses,
    describe_tests,
)
from bench.studies.suite.suite_tables import FREE, SuiteTables

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
    """Render the page as HTML.

    Args:
        tables: tables of the suite.
    """
    suite = tables.suite
    page = HtmlPage(_STYLESHEET)
    frames = {
        "ranks": tables.ranks,
        "pairs": tables.pairs,
        "ert": tables.running_times,
        "profile": tables.profile,
    }
    shown_frames = {name: frame for name, frame in frames.items() if len(frame)}
    for name, frame in shown_frames.items():
        page.add_table(name, frame)
    order = _order_tuners(tables)
    styles = {name: get_mark_style(place) for place, name in enumerate(order)}
    targets = suite.runs.groupby("cell")["target"].nunique()
    seeds = int(suite.runs.groupby(["cell", "tuner", "target"])["seed"].nunique().max())
    trained = suite.training[suite.training["fit_simulations"] > 0]
    ranked = bool(tables.complete_tuners)
    return page.render(
        _TEMPLATE,
        version=suite.version,
        tuners=suite.tuners,
        problem_count=suite.cells["problem"].nunique(),
        targets=_join_range(targets),
        seeds=f"{seeds} seed{'' if seeds == 1 else 's'}",
        headline=build_headline(tables) if ranked else "No method has results in all cells.",
        tests=list(describe_tests(tables)),
        guide_checkpoints=[k for k in _GUIDE_CHECKPOINTS if k in tables.checkpoints],
        guide=_build_guide_rows(tables) if ranked else [],
        losses=list(describe_losses(tables)),
        loss_factor=f"{LOSS_FACTOR:g}",
        cells=_build_cells(tables, page, styles),
        rank_blocks=[
            {"k": k, "rows": _build_rank_rows(tables, k, order)}
            for k in _RANK_BLOCKS
            if k in tables.checkpoints
        ],
        skipped=[f"{row.tuner}: {row.reason}" for row in suite.skipped.itertuples()],
        rank_panel=_make_rank_panel(tables, page, styles) if ranked else None,
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
    """Arrange the guide with one row per property and one entry per number of simulations."""
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
    mean. `order` are the methods.
    """
    ranks = tables.get_ranks(k)
    errors = tables.errors[tables.errors["simulations"] == k].set_index(["cell", "tuner"])
    mean_ranks, counts = ranks.mean(), ranks.notna().sum(axis=1)
    rows = []
    for tuner in sorted(
        order, key=lambda t: (t not in tables.complete_tuners, mean_ranks.get(t, 1e9))
    ):
        entries = []
        for cell in map(str, ranks.index):
            rank = float(ranks[tuner][cell]) if tuner in ranks else np.nan
            anchor = _make_anchor(cell)
            if not np.isfinite(rank):
                entries.append({"text": "", "kind": "", "anchor": anchor, "title": ""})
                continue
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
    """Build name, description and error curves of each cell, a problem with one target range."""
    points = [k for k in _CURVE_POINTS if k <= tables.suite.budget]
    parts = []
    for cell, curves in tables.curves.items():
        for tuner in curves.list_tuners():
            values = curves.select(tuner=tuner).values[:, points]
            with np.errstate(invalid="ignore"):
                low, median, high = np.percentile(values, [25, 50, 75], axis=0)
            frame = pd.DataFrame(
                {"cell": cell, "tuner": tuner, "simulations": points, "median": median,
                 "low": low, "high": high}
            )  # fmt: skip
            parts.append(frame[np.isfinite(frame["median"])])
    page.add_table("curves", pd.concat(parts, ignore_index=True), _DIGITS)
    ticks = tuple(float(k) for k in (0, *tables.checkpoints))
    x_axis = Axis("simulations used on the target", "symlog", ("symlog", "linear"), ticks)
    cells = []
    for row in tables.suite.cells.itertuples():
        cell = str(row.cell)
        present_tuners = set(tables.curves[cell].list_tuners())
        series = tuple(
            Series(name, "median", style, {"tuner": name, "cell": cell})
            for name, style in styles.items()
            if name in present_tuners
        )
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
    """Make the panel of mean ranks against the number of simulations."""
    page.add_table("mean-ranks", tables.ranks[tables.ranks["training"] == FREE], _DIGITS)
    series = tuple(
        Series(name, "mean_rank", style, {"tuner": name})
        for name, style in styles.items()
        if name in tables.complete_tuners
    )
    ticks = tuple(float(k) for k in tables.checkpoints)
    x_axis = Axis("simulations used on the target", "log", ("log", "linear"), ticks)
    y_axis = Axis("mean rank, 1 is best", scales=("linear",))
    return Panel("Mean rank over all cells", "mean-ranks", "simulations", series, x_axis, y_axis)


def _list_columns(frame: pd.DataFrame) -> list[tuple[str, str, int]]:
    """Return name, heading and significant digits of each column; 0 digits for text."""
    return [
        (str(column), "", _DIGITS if is_numeric_dtype(frame[column]) else 0) for column in frame
    ]
