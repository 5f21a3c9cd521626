"""HTML report of a bounce-shot study, report.html."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from typing import Any

import pandas as pd

from bench.benchmark.problem.experiment import Experiment
from bench.bounce_shot.hit_rate_table import ALL_BALLS
from bench.figures.style import FigureFiles, get_mark_style
from bench.pages.chart import Axis, Chart, Panel, PrintedFigure, Series
from bench.pages.data_grid import DataGrid, GridColumn
from bench.pages.html_elements import make_code, make_list, make_paragraph, make_strong, safe
from bench.pages.html_page import HtmlPage
from bench.pages.text_format import format_percent

_NAMED = 4
"""Maximum number of methods that a sentence names."""


def render_page(
    experiment: Experiment,
    folder: str,
    lines: pd.DataFrame,
    rows: pd.DataFrame,
    pictures: Mapping[str, FigureFiles],
) -> str:
    """Render the HTML report; the hit rates come first.

    Args:
        experiment: the experiment.
        folder: result folder.
        lines: table of `bench.bounce_shot.hit_rate_table.build_result_table`.
        rows: one row per method and shot.
        pictures: printed figures by name.
    """
    name = experiment.title or experiment.name
    made = f"Made by {make_code('simgap')} from the shots in {make_code(safe(folder, 300))}."
    page = HtmlPage(f"{name}: bounce shot", made)
    page.add_table("table", lines)
    page.add_table("shots", rows, 6)
    page.append(f"<header>\n<h1>{safe(name, 200)}</h1>")
    page.append(make_paragraph(safe(experiment.says), "soft") + "\n</header>")
    page.append(f'<div class="conclusion">{make_list(_conclusion(lines))}</div>')
    page.append(_success(page, lines, pictures))
    page.add_section("numbers", "Numbers", page.render_grid(_lines_grid()))
    page.add_section(
        "off", "How far off", _picture(page, pictures, "off", "How far shots were off.")
    )
    page.add_section(
        "shots",
        "Shots",
        _picture(page, pictures, "shots", "Planned and flown paths of some shots."),
        page.render_grid(_shots_grid()),
    )
    again = f"simgap compare {shlex.quote(f'{folder}/experiment.toml')}"
    page.add_section("making", "How it was made", f"<pre>{safe(again, 1000)}</pre>")
    return page.to_html()


def _conclusion(lines: pd.DataFrame) -> Iterator[str]:
    """Yield sentences on the method with the most hits, and on those with overlapping intervals."""
    over = lines[lines["ball"] == ALL_BALLS].sort_values("rate", ascending=False, kind="stable")
    best = over.iloc[0]
    yield (
        f"{make_strong(safe(best['method'], 60))} hits most: {int(best['hits'])} of "
        f"{int(best['shots'])} shots, {_rate(best)}."
    )
    rest = over.iloc[1:]
    near = [safe(name, 60) for name in rest["method"][rest["high"] >= best["low"]]]
    if near:
        more = f" and {len(near) - _NAMED} more" if len(near) > _NAMED else ""
        yield f"The intervals of {', '.join(near[:_NAMED])}{more} overlap with its own."
    elif len(rest):
        yield "No other method's interval overlaps with its own."


def _rate(line: pd.Series[Any]) -> str:
    ends = f"95 % interval {format_percent(line['low'])} to {format_percent(line['high'])}"
    return f"{format_percent(line['rate'])} ({ends}, Wilson)"


def _success(page: HtmlPage, lines: pd.DataFrame, pictures: Mapping[str, FigureFiles]) -> str:
    """Render the chart of the hit rate of each method by ball."""
    balls = [ALL_BALLS, *(ball for ball in dict.fromkeys(lines["ball"]) if ball != ALL_BALLS)]
    place = {ball: i for i, ball in enumerate(balls)}
    page.add_table("success", lines.assign(place=lines["ball"].map(place)))
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
    names = tuple(f"{ball}\nn={_shots(lines, ball)}" for ball in balls)
    across = Axis("ball; n shots of each method", names=names)
    up = Axis("share of shots through the hoop", scales=("linear",), ends=(-0.03, 1.03))
    panel = Panel("Hits by ball", "success", "place", series, across, up)
    caption = (
        "Marks are shares of hits, bars their 95 % intervals (Wilson). Intervals that overlap "
        "widely say little about who is better."
    )
    still = _static(pictures, "success", "The share of hits of each method, over all and by ball.")
    return page.render_chart(Chart("success", "Shots through the hoop", caption, (panel,), still))


def _shots(lines: pd.DataFrame, ball: str) -> str:
    counts = sorted(set(lines.loc[lines["ball"] == ball, "shots"].astype(int)))
    return "–".join(str(n) for n in (counts if len(counts) == 1 else (counts[0], counts[-1])))


def _lines_grid() -> DataGrid:
    columns = (
        GridColumn("method"),
        GridColumn("ball"),
        GridColumn("shots", digits=6),
        GridColumn("hits", digits=6),
        GridColumn("rate", digits=3),
        GridColumn("low", "95 % low", 3),
        GridColumn("high", "95 % high", 3),
        GridColumn("off_median", "off, median [m]", 3),
        GridColumn("prediction_error_median", "prediction error, median [m]", 3),
        GridColumn("simulations", digits=4),
        GridColumn("seconds", digits=3),
        GridColumn("failures", digits=6),
    )
    filters = ("method", "ball")
    title = "Every method and ball: table.csv"
    return DataGrid(
        "lines", title, "table", columns, filters, {"ball": ALL_BALLS}, "rate,down", "method"
    )


def _shots_grid() -> DataGrid:
    columns = (
        GridColumn("shot"),
        GridColumn("ball"),
        GridColumn("method"),
        GridColumn("hit"),
        GridColumn("off", "off [m]", 3),
        GridColumn("prediction_error", "prediction error [m]", 3),
        GridColumn("drop_height", "drop height [m]", 3),
        GridColumn("restitution", digits=3),
        GridColumn("status"),
        GridColumn("reason"),
    )
    title = "Every shot: shots.csv"
    filters = ("ball", "method", "hit", "status")
    return DataGrid("every-shot", title, "shots", columns, filters, {}, "", "method")


def _picture(page: HtmlPage, pictures: Mapping[str, FigureFiles], name: str, shows: str) -> str:
    still = _static(pictures, name, shows)
    return page.render_figure(f"{name}-figure", still, safe(shows)) if still else ""


def _static(pictures: Mapping[str, FigureFiles], name: str, shows: str) -> PrintedFigure | None:
    if name not in pictures:
        return None
    return PrintedFigure(pictures[name].svg, pictures[name].pdf, shows, name)
