"""HTML report of a bounce-shot study: the values of the template `shots.html`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import pandas as pd

from bench.benchmark.problem.experiment import Experiment
from bench.bounce_shot.hit_rate_table import ALL_BALLS
from bench.figures.style import FigureFiles, get_mark_style
from bench.pages.chart import Axis, Panel, PrintedFigure, Series
from bench.pages.html_page import HtmlPage

_TEMPLATE = Path(__file__).with_name("shots.html")


def render_page(
    experiment: Experiment,
    folder: str,
    lines: pd.DataFrame,
    rows: pd.DataFrame,
    pictures: Mapping[str, FigureFiles],
) -> str:
    """Render the HTML report.

    Args:
        experiment: the experiment.
        folder: result folder.
        lines: table of `bench.bounce_shot.hit_rate_table.build_result_table`.
        rows: one row per method and shot.
        pictures: printed figures by name.
    """
    balls = [ALL_BALLS, *(ball for ball in dict.fromkeys(lines["ball"]) if ball != ALL_BALLS)]
    places = {ball: place for place, ball in enumerate(balls)}
    page = HtmlPage()
    page.add_table("table", lines)
    page.add_table("shots", rows, 6)
    page.add_table("success", lines.assign(place=lines["ball"].map(places)))
    over = lines[lines["ball"] == ALL_BALLS].sort_values("rate", ascending=False, kind="stable")
    best, *others = over.to_dict("records")
    return page.render(
        _TEMPLATE,
        experiment=experiment,
        folder=folder,
        ALL_BALLS=ALL_BALLS,
        best=best,
        has_others=bool(others),
        similar=[row["method"] for row in others if row["high"] >= best["low"]],
        success_panel=_make_success_panel(lines, balls),
        figure=partial(PrintedFigure.from_files, pictures),
    )


def _make_success_panel(lines: pd.DataFrame, balls: list[str]) -> Panel:
    """Make the panel of the hit rate of each method by ball."""
    methods = list(dict.fromkeys(lines["method"]))
    series = tuple(
        Series(
            method,
            "rate",
            get_mark_style(i),
            {"method": method},
            "low",
            "high",
            "points",
            (i - (len(methods) - 1) / 2) * 0.6 / len(methods),
        )
        for i, method in enumerate(methods)
    )
    names = tuple(f"{ball}\nn={format_shot_count(lines, ball)}" for ball in balls)
    across = Axis("ball; n shots of each method", names=names)
    up = Axis("share of shots through the hoop", scales=("linear",), ends=(-0.03, 1.03))
    return Panel("Hits by ball", "success", "place", series, across, up)


def format_shot_count(lines: pd.DataFrame, ball: str) -> str:
    """Format the number of shots with a ball, or its range if methods differ.

    Args:
        lines: table of `bench.bounce_shot.hit_rate_table.build_result_table`.
        ball: name of the ball.
    """
    counts = sorted(set(lines.loc[lines["ball"] == ball, "shots"].astype(int)))
    return "–".join(str(count) for count in dict.fromkeys((counts[0], counts[-1])))
