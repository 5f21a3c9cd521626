"""Sortable and filterable tables of the report of a comparison of diagnosers."""

from __future__ import annotations

from bench.diagnosis.failures import failures
from bench.diagnosis.page.shown import Shown
from bench.diagnosis.tables import NAMED, OWN
from bench.pages.grid import Column, Grid
from bench.pages.page import Page

_COUNTED = (
    Column("count", digits=6),
    Column("of", digits=6),
    Column("share", digits=3),
    Column("low", "95 % low", 3),
    Column("high", "95 % high", 3),
)


def failures_grid(shown: Shown, page: Page) -> str:
    """Render the table of incorrect answers, filtered to those of simgap at first."""
    frame = failures(shown.rows, shown.order)
    if frame.empty:
        return ""
    page.table("failures", frame, 6)
    columns = (
        Column("diagnoser"),
        Column("question", says="the last number tells questions of one sort apart"),
        Column("verdict", "says"),
        Column("named", says="alternatives behind a bar"),
        Column("outcome"),
        Column("noise"),
        Column("right_by", "right by"),
    )
    filters = ("diagnoser", "kind", "system", "noise", "outcome")
    first = OWN if (frame["diagnoser"] == OWN).any() else ""
    only = {"diagnoser": first} if first else {}
    title = "Answers that are not right"
    return page.grid(Grid("wrong", title, "failures", columns, filters, only, "", "diagnoser"))


def table_grid(shown: Shown, page: Page) -> str:
    """Render table.csv, filtered at first to the metric that counts as a diagnosed cause."""
    page.table("table", shown.tables["table"], 6)
    columns = (Column("diagnoser"), Column("metric", "what is counted"), *_COUNTED)
    only = {"metric": NAMED}
    title = "Every share: table.csv"
    grid = Grid(
        "numbers",
        title,
        "table",
        columns,
        ("diagnoser", "metric"),
        only,
        "share,down",
        "diagnoser",
    )
    return page.grid(grid)


def groups_grid(shown: Shown, page: Page) -> str:
    """Render groups.csv: false alarms and diagnosed causes by recording condition and effect."""
    frame = shown.tables["groups"]
    if frame.empty:
        return ""
    page.table("groups", frame, 6)
    columns = (
        Column("diagnoser"),
        Column("metric", "what is counted"),
        Column("by"),
        Column("value"),
        *_COUNTED,
    )
    filters = ("diagnoser", "metric", "by", "value")
    metrics = list(dict.fromkeys(frame["metric"]))
    only = {"metric": "named" if "named" in metrics else str(metrics[0]), "by": "noise"}
    title = "By system, noise, rate, runs and effect: groups.csv"
    return page.grid(Grid("by", title, "groups", columns, filters, only, "", "diagnoser"))


def pairs_grid(shown: Shown, page: Page) -> str:
    """Render pairs.csv: each diagnoser compared with simgap."""
    frame = shown.tables["pairs"]
    if frame.empty:
        return ""
    page.table("pairs", frame, 6)
    columns = (
        Column("diagnoser", "against"),
        Column("metric", "what is counted"),
        Column("questions", digits=6),
        Column("only_simgap", "simgap alone right", 6),
        Column("only_other", "the other alone right", 6),
        Column("p_value", "p (McNemar)", 2),
        Column("p_holm", "p, Holm-corrected", 2),
    )
    title = "Question by question against simgap: pairs.csv"
    filters = ("diagnoser", "metric")
    return page.grid(Grid("against", title, "pairs", columns, filters, {}, "p_holm", "diagnoser"))


def confusion_grid(shown: Shown, page: Page) -> str:
    """Render confusion.csv: number of each answer for each hidden effect."""
    frame = shown.tables["confusion"]
    if frame.empty:
        return ""
    page.table("confusion", frame)
    columns = (
        Column("diagnoser"),
        Column("hidden"),
        Column("said", says="the leading name; verdicts in brackets"),
        Column("count", digits=6),
    )
    first = OWN if (frame["diagnoser"] == OWN).any() else str(frame["diagnoser"].iloc[0])
    title = "Effect by effect: confusion.csv"
    filters = ("diagnoser", "hidden", "said")
    only = {"diagnoser": first}
    grid = Grid("taken", title, "confusion", columns, filters, only, "count,down", "diagnoser")
    return page.grid(grid)


def costs_grid(shown: Shown, page: Page) -> str:
    """Render costs.csv: simulations and time per answer."""
    page.table("costs", shown.tables["costs"], 6)
    columns = (
        Column("diagnoser"),
        Column("answers", digits=6),
        Column("simulations_median", "simulations, median", 4),
        Column("simulations_p95", "95 % quantile", 4),
        Column("processor_seconds_median", "processor time [s], median", 3),
        Column("processor_seconds_p95", "95 % quantile", 3),
        Column("seconds_median", "by the clock [s], median", 3),
        Column("training_simulations", "training simulations", 6),
        Column("training_seconds", "training [s]", 3),
    )
    title = "What answers cost: costs.csv"
    return page.grid(Grid("prices", title, "costs", columns, (), {}, "", "diagnoser"))


def items_grid(shown: Shown, page: Page) -> str:
    """Render items.csv: one row per answer."""
    page.table("items", shown.rows, 6)
    columns = (
        Column("question"),
        Column("diagnoser"),
        Column("size", "size [noises]", 3),
        Column("noise"),
        Column("rate", "rate [Hz]", 6),
        Column("runs", digits=6),
        Column("verdict", "says"),
        Column("named"),
        Column("outcome"),
        Column("p_value", "p", 2),
        Column("simulations", digits=6),
        Column("processor_seconds", "processor time [s]", 3),
        Column("reason"),
    )
    filters = ("diagnoser", "kind", "system", "hidden", "noise", "outcome", "status")
    title = "Every answer: items.csv"
    return page.grid(Grid("answers", title, "items", columns, filters, {}, "", "diagnoser"))
