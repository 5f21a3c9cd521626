"""HTML report of a bounce-shot study, report.html."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from typing import Any

import pandas as pd

from bench.figures.style import Pictures, look
from bench.pages.chart import Axis, Chart, Panel, Series, Static
from bench.pages.elements import code, listed, paragraph, safe, strong
from bench.pages.grid import Column, Grid
from bench.pages.page import Page
from bench.pages.text import percent
from bench.problem.experiment import Experiment
from bench.shot.table import ALL

_NAMED = 4
"""Maximum number of methods that a sentence names."""


def shot_page(
    experiment: Experiment,
    folder: str,
    lines: pd.DataFrame,
    rows: pd.DataFrame,
    pictures: Mapping[str, Pictures],
) -> str:
    """Render the HTML report; the hit rates come first.

    Args:
        experiment: the experiment.
        folder: result folder.
        lines: table of `bench.shot.table.table`.
        rows: one row per method and shot.
        pictures: printed figures by name.
    """
    name = experiment.title or experiment.name
    made = f"Made by {code('simgap')} from the shots in {code(safe(folder, 300))}."
    page = Page(f"{name}: bounce shot", made)
    page.table("table", lines)
    page.table("shots", rows, 6)
    page.add(f"<header>\n<h1>{safe(name, 200)}</h1>")
    page.add(paragraph(safe(experiment.says), "soft") + "\n</header>")
    page.add(f'<div class="conclusion">{listed(_conclusion(lines))}</div>')
    page.add(_success(page, lines, pictures))
    page.section("numbers", "Numbers", page.grid(_lines_grid()))
    page.section("off", "How far off", _picture(page, pictures, "off", "How far shots were off."))
    page.section(
        "shots",
        "Shots",
        _picture(page, pictures, "shots", "Planned and flown paths of some shots."),
        page.grid(_shots_grid()),
    )
    again = f"simgap compare {shlex.quote(f'{folder}/experiment.toml')}"
    page.section("making", "How it was made", f"<pre>{safe(again, 1000)}</pre>")
    return page.html()


def _conclusion(lines: pd.DataFrame) -> Iterator[str]:
    """Yield sentences on the method with the most hits, and on those with overlapping intervals."""
    over = lines[lines["ball"] == ALL].sort_values("rate", ascending=False, kind="stable")
    best = over.iloc[0]
    yield (
        f"{strong(safe(best['method'], 60))} hits most: {int(best['hits'])} of "
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
    ends = f"95 % interval {percent(line['low'])} to {percent(line['high'])}"
    return f"{percent(line['rate'])} ({ends}, Wilson)"


def _success(page: Page, lines: pd.DataFrame, pictures: Mapping[str, Pictures]) -> str:
    """Render the chart of the hit rate of each method by ball."""
    balls = [ALL, *(ball for ball in dict.fromkeys(lines["ball"]) if ball != ALL)]
    place = {ball: i for i, ball in enumerate(balls)}
    page.table("success", lines.assign(place=lines["ball"].map(place)))
    methods = list(dict.fromkeys(lines["method"]))
    series = tuple(
        Series(
            method,
            "rate",
            look(i),
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
    return page.chart(Chart("success", "Shots through the hoop", caption, (panel,), still))


def _shots(lines: pd.DataFrame, ball: str) -> str:
    counts = sorted(set(lines.loc[lines["ball"] == ball, "shots"].astype(int)))
    return "–".join(str(n) for n in (counts if len(counts) == 1 else (counts[0], counts[-1])))


def _lines_grid() -> Grid:
    columns = (
        Column("method"),
        Column("ball"),
        Column("shots", digits=6),
        Column("hits", digits=6),
        Column("rate", digits=3),
        Column("low", "95 % low", 3),
        Column("high", "95 % high", 3),
        Column("off_median", "off, median [m]", 3),
        Column("prediction_error_median", "prediction error, median [m]", 3),
        Column("simulations", digits=4),
        Column("seconds", digits=3),
        Column("failures", digits=6),
    )
    filters = ("method", "ball")
    title = "Every method and ball: table.csv"
    return Grid("lines", title, "table", columns, filters, {"ball": ALL}, "rate,down", "method")


def _shots_grid() -> Grid:
    columns = (
        Column("shot"),
        Column("ball"),
        Column("method"),
        Column("hit"),
        Column("off", "off [m]", 3),
        Column("prediction_error", "prediction error [m]", 3),
        Column("drop_height", "drop height [m]", 3),
        Column("restitution", digits=3),
        Column("status"),
        Column("reason"),
    )
    title = "Every shot: shots.csv"
    filters = ("ball", "method", "hit", "status")
    return Grid("every-shot", title, "shots", columns, filters, {}, "", "method")


def _picture(page: Page, pictures: Mapping[str, Pictures], name: str, shows: str) -> str:
    still = _static(pictures, name, shows)
    return page.picture(f"{name}-figure", still, safe(shows)) if still else ""


def _static(pictures: Mapping[str, Pictures], name: str, shows: str) -> Static | None:
    if name not in pictures:
        return None
    return Static(pictures[name].svg, pictures[name].pdf, shows, name)
