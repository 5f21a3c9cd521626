"""HTML report of a bounce-shot study: the values of the template `shots.html`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import pandas as pd

from bench.benchmark.problem.experiment import Experiment
from bench.bounce_shot.hit_rate_table import ALL_BALLS, make_success_panel
from bench.figures.style import FigureFiles
from bench.pages.chart import PrintedFigure
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
    success_panel, success = make_success_panel(lines)
    page = HtmlPage()
    page.add_table("table", lines)
    page.add_table("shots", rows, 6)
    page.add_table(success_panel.table, success)
    over = lines[lines["ball"] == ALL_BALLS].sort_values("rate", ascending=False, kind="stable")
    best, *other_rows = over.to_dict("records")
    return page.render(
        _TEMPLATE,
        experiment=experiment,
        folder=folder,
        ALL_BALLS=ALL_BALLS,
        best=best,
        has_others=bool(other_rows),
        similar=[row["method"] for row in other_rows if row["high"] >= best["low"]],
        success_panel=success_panel,
        figure=partial(PrintedFigure.from_files, pictures),
    )
