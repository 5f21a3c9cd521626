"""Small page with each kind of content, and texts that look like markup."""

from pathlib import Path

import numpy as np
import pandas as pd

from bench.figures import figure_layout, figure_output, style
from bench.pages.chart import (
    Axis,
    AxisSpan,
    Chart,
    Panel,
    PrintedFigure,
    ReferenceLine,
    Series,
    TooltipLine,
)
from bench.pages.html_page import HtmlPage

NAMES = ("least squares", "<b>cma</b> & co", "random", "</script><script>alert(1)</script>")
STEPS = (0, 1, 2, 3, 5, 10, 20, 50)
RANGES = {"in": "inside", "wide": "anywhere"}
ODD = 'a, b\nline two, "quoted" <i>x</i>'
JOINTS = ("elbow", "wrist, <i>left</i>", "hip")
COMMAND = "simgap score 'a <b>' && more"
TITLE = "Title </title><h1 id=broken>& more"


def errors():
    rows = [
        (name, kind, k, middle, 0.7 * middle, 1.6 * middle)
        for kind in RANGES
        for i, name in enumerate(NAMES)
        for k in STEPS
        for middle in [10 ** (-0.4 * i - 0.05 * k)]
    ]
    return pd.DataFrame(rows, columns=["tuner", "range", "simulations", "median", "low", "high"])


def bins():
    rows = [(n, b, 1.0 + i + b) for i, n in enumerate(NAMES) for b in range(3)]
    return pd.DataFrame(rows, columns=["tuner", "bin", "count"])


def notes():
    values = [0.0, 1.0, -2.5, 1e-3, 9.996e-4, 0.99951, 123456.0, 99951.0, 3.14159e-12, 1e300]
    values += [float("nan"), float("inf"), -7.0e-5, 1000.0, 12.5]
    says = [ODD, *(f"note {i}" for i in range(1, len(values)))]
    return pd.DataFrame({"says": says, "value": values})


def make_printed_figure():
    figure, axes = figure_layout.make_panel_grid(1, 1, (5.5, 4.6))
    axes[0, 0].plot(STEPS, np.sqrt(STEPS), color=style.BLUE)
    return PrintedFigure(
        figure_output.render_svg(figure),
        figure_output.render_pdf(figure),
        'curves with "quotes" & <b>',
        "error",
    )


def error_chart():
    def panel(kind, title):
        series = tuple(
            Series(n, "median", style.get_mark_style(i), {"tuner": n, "range": kind}, "low", "high")
            for i, n in enumerate(NAMES)
        )
        across = Axis("simulations", "symlog", ("symlog", "linear"), tuple(float(k) for k in STEPS))
        return Panel(
            title,
            "error",
            "simulations",
            series,
            across,
            Axis("error [rad]", "log"),
            {"targets": title},
            (ReferenceLine(0.01, "floor"),),
            (AxisSpan(5.0, 20.0, "later", style.get_mark_style(2), foot=True),),
        )

    panels = tuple(panel(kind, title) for kind, title in RANGES.items())
    return Chart("error", "Error <i>now</i>", panels, make_printed_figure(), "targets")


def bins_chart():
    across = Axis("distance", names=("inside", "0–1", "1–2"))
    series = tuple(
        Series(n, "count", style.get_mark_style(i), {"tuner": n}, draw=("bars", "points")[i % 2])
        for i, n in enumerate(NAMES)
    )
    panel = Panel("Counts", "bins", "bin", series, across, Axis("targets"))
    return Chart("bins", "Bins", (panel,))


def motion():
    times = np.arange(0, 10, 0.1)
    rows = [
        (joint, round(t, 3), 3 * i + t, 10 * np.sin(t) + i)
        for i, joint in enumerate(JOINTS)
        for t in times
    ]
    return pd.DataFrame(rows, columns=["joint", "t", "q", "left"])


def motion_chart():
    panels = []
    for joint in JOINTS:
        where = {"joint": joint}
        tells = (
            TooltipLine("position", "q", "rad", style.get_mark_style(1)),
            TooltipLine("residual", "left", "noises", None, 0.5, "rad"),
        )
        for y, span in (("q", ()), ("left", (AxisSpan(-2.0, 2.0, "", along="y"),))):
            series = (
                Series("seen", y, style.get_mark_style(0), where, draw="points", under=True),
                Series("simulated", y, style.get_mark_style(1), where),
            )
            up = Axis(f"{y} [rad]", scales=("linear",), holds=(-20.0, 20.0))
            across = Axis("time [s]", scales=("linear",))
            about = {"facets": where, "spans": span, "tells": tells, "height": 160}
            panels.append(Panel(f"{joint}: {y}", "motion", "t", series, across, up, **about))
    options = {"columns": 2, "along": True, "toggles": ("joint",), "off": {"joint": ("hip",)}}
    return Chart("motion", "Motion", tuple(panels), lights="joint", **options)


def page():
    made = HtmlPage()
    tables = {"error": errors(), "bins": bins(), "notes": notes(), "motion": motion()}
    for name, frame in tables.items():
        made.add_table(name, frame)
    return made.render(
        Path(__file__).with_name("sample_page.html"),
        TITLE=TITLE,
        COMMAND=COMMAND,
        error_chart=error_chart(),
        bins_chart=bins_chart(),
        motion_chart=motion_chart(),
        still=make_printed_figure(),
    )
