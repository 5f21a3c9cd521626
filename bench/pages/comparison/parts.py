"""Sections below the charts: tables, failures, and how the results were made."""

from __future__ import annotations

import shlex
from collections.abc import Iterator

import pandas as pd

from bench.pages import elements
from bench.pages.comparison.results import Results
from bench.pages.elements import code, folded, paragraph, safe
from bench.pages.grid import Column, Grid
from bench.pages.page import Page
from bench.pages.text import number
from bench.problem.identifiability import STIFF
from bench.store.status import FAILURES

_MOST = 20
"""Maximum number of failure reasons that are shown completely."""
_LONG = 6000
"""Maximum length of a reason in characters."""


def table_grid(results: Results, page: Page) -> str:
    """Build the grid of table.csv.

    It initially shows the deciding error at the end of the budget, the best tuner first.

    Args:
        results: Results of the comparison.
        page: Page, to which the table is added.
    """
    table = results.tables["table"]
    page.table("table", table)
    metric = results.statistics.metric
    if metric == "param_error":
        metric = results.statistics.parameter_metric
    only = {"metric": metric, "simulations": str(int(table["simulations"].max()))}
    if len(results.ranges) > 1:
        only["range"] = results.ranges[0]
    columns = (
        Column("tuner"),
        Column("range"),
        Column("metric"),
        Column("simulations", digits=6),
        Column("median", digits=3),
        Column("mean", digits=3),
        Column("low", "mean, 95 % low", 3),
        Column("high", "mean, 95 % high", 3),
        Column("runs", digits=6),
        Column("failures", digits=6),
        Column("fit_simulations", "training simulations", 6),
        Column("tuner_seconds", "seconds in the tuner", 3),
        Column("simulator_seconds", "seconds in the simulator", 3),
    )
    filters = ("range", "metric", "simulations")
    title = "Every number: table.csv"
    return page.grid(Grid("numbers", title, "table", columns, filters, only, switch="tuner"))


def ert_grid(results: Results, page: Page) -> str:
    """Build the grid of ert.csv.

    Args:
        results: Results of the comparison.
        page: Page, to which the table is added.
    """
    page.table("ert", results.tables["ert"])
    columns = (
        Column("tuner"),
        Column("range"),
        Column("threshold", "error to be reached", 3),
        Column("ert", "expected simulations", 3),
        Column("low", "95 % low", 3),
        Column("high", "95 % high", 3),
        Column("successes", digits=6),
        Column("runs", digits=6),
        Column("failures", digits=6),
    )
    filters, only = ("range", "threshold"), {"threshold": str(results.statistics.level)}
    if len(results.ranges) > 1:
        only["range"] = results.ranges[0]
    title = "Expected running times: ert.csv"
    return page.grid(Grid("times", title, "ert", columns, filters, only, switch="tuner"))


def pairs_grid(results: Results, page: Page) -> str:
    """Build the grid of pairs.csv; empty without pairs.

    Args:
        results: Results of the comparison.
        page: Page, to which the table is added.
    """
    table = results.tables["pairs"]
    if table.empty:
        return ""
    page.table("pairs", table)
    columns = (
        Column("range"),
        Column("a"),
        Column("b"),
        Column("targets", digits=6),
        Column("a_better", "share where a is better", 3),
        Column("effect", "effect (1: a on all targets)", 3),
        Column("error_ratio", "error of a over b, median", 3),
        Column("p_value", "p", 2),
        Column("p_holm", "p, Holm-corrected", 2),
    )
    title = "Tuner against tuner: pairs.csv"
    return page.grid(Grid("against", title, "pairs", columns, ("range", "a", "b"), {}, "p_holm"))


def wins_grid(results: Results, page: Page) -> str:
    """Build the grid of who_wins.csv.

    Args:
        results: Results of the comparison.
        page: Page, to which the table is added.
    """
    page.table("who_wins", results.tables["who_wins"])
    columns = (
        Column("range"),
        Column("threshold", "error reached", 3),
        Column("from_seconds", "from [s a simulation]", 3),
        Column("to_seconds", "to [s a simulation]", 3),
        Column("tuner", "needs the least time"),
    )
    title = "Who wins: who_wins.csv"
    return page.grid(Grid("winners", title, "who_wins", columns, ("range", "threshold")))


def even_grid(results: Results, page: Page) -> str:
    """Build the grid of break_even.csv; empty without rows.

    Args:
        results: Results of the comparison.
        page: Page, to which the table is added.
    """
    table = results.tables["break_even"]
    if table.empty:
        return ""
    page.table("break_even", table)
    columns = (
        Column("range"),
        Column("threshold", "error reached", 3),
        Column("learned", "trained"),
        Column("search", "search"),
        Column("fit_simulations", "training simulations", 6),
        Column("targets", "pays from so many targets", 3),
        Column("low", "95 % low", 3),
        Column("high", "95 % high", 3),
    )
    filters, only = ("range", "threshold"), {"threshold": str(results.statistics.level)}
    title = "Break-even: break_even.csv"
    return page.grid(Grid("even", title, "break_even", columns, filters, only, "targets"))


def spectra(results: Results, page: Page) -> str:
    """Build the section on what the data of each target identify; empty without the figure.

    Args:
        results: Results of the comparison.
        page: Page, to which the figure is added.
    """
    still = results.still("spectra", "1 sigma of each direction, and the parameters in it.")
    if still is None:
        return ""
    caption = (
        f"Marks above the dashed line ({STIFF:g} training widths) are sloppy: no tuner can know "
        "them from these data. Right: which parameters make up a direction."
    )
    return "<h3>What the data can know</h3>\n" + page.picture("spectra", still, caption)


def failures(results: Results) -> Iterator[str]:
    """Yield every kind of failure with its first reason in full."""
    statuses = results.stored.statuses
    failed = statuses[statuses["status"].isin(FAILURES)]
    if failed.empty:
        yield paragraph(f"None: {len(statuses)} runs ended as they should.")
        return
    groups = list(failed.groupby(["tuner", "status", "reason"], sort=False))
    groups.sort(key=lambda group: -len(group[1]))
    for (tuner, status, reason), group in groups[:_MOST]:
        runs = f"{len(group)} run{'s' * (len(group) > 1)}"
        last = (str(reason).strip().splitlines() or ["no reason was given"])[-1]
        head = f"{safe(tuner, 60)}: {safe(status)} in {runs} — {safe(last, 160)}"
        example = str(group["run"].iloc[0])
        named = paragraph(f"First in run {code(safe(example))}.") if example else ""
        yield folded(head, named + _whole(str(reason)))
    if len(groups) > _MOST:
        yield paragraph(f"{len(groups) - _MOST} more reasons are in status.csv.")


def _whole(text: str) -> str:
    """Format a text of several lines with its indentation."""
    cut = text if len(text) <= _LONG else f"{text[:_LONG]} …"
    lines = [safe(line, 1000) for line in cut.strip("\n").replace("\t", "    ").split("\n")]
    # `safe` strips leading spaces, so they are added again.
    indents = [len(line) - len(line.lstrip()) for line in cut.strip("\n").split("\n")]
    body = "\n".join(" " * indent + line for indent, line in zip(indents, lines, strict=True))
    return f"<pre>{body}</pre>"


def seconds(results: Results) -> str:
    """Build a table of mean seconds by tuner."""
    table = results.tables["table"]
    last = table[table["runs"] > 0].sort_values("simulations").groupby("tuner", sort=False).last()
    last = last.reindex([t for t in results.statistics.order if t in last.index])
    rows = [
        [
            safe(name, 60),
            number(row["tuner_seconds"]),
            number(row["simulator_seconds"]),
            number(row["fit_seconds"]) if row["fit_simulations"] else "–",
        ]
        for name, row in last.iterrows()
    ]
    heads = ["tuner", "-in the tuner [s]", "-in the simulator [s]", "-one training [s]"]
    return "<h3>Mean seconds of a run</h3>\n" + elements.table(heads, rows)


def making(results: Results) -> Iterator[str]:
    """Yield the command that repeats the comparison, the configuration, and the machine."""
    yield paragraph("The same runs again, with the targets that were met here:")
    yield f"<pre>{safe(again(results), 1000)}</pre>"
    yield paragraph(
        "The page, tables and figures alone: "
        + code(safe(f"simgap plot {shlex.quote(results.folder)}", 500))
        + ". Whether the runs are what they say: "
        + code(safe(f"simgap verify {shlex.quote(results.folder)}", 500))
        + "."
    )
    yield folded("experiment.toml: the exact configuration", _whole(results.configuration))
    yield folded("Versions and machine", _environment(results))


def again(results: Results) -> str:
    """Return the command that repeats the comparison."""
    source = shlex.quote(f"{results.folder}/experiment.toml")
    plugins = [f" --plugin {shlex.quote(p)}" for p in results.environment.get("plugins", ())]
    return f"simgap compare {source}{''.join(plugins)}"


def _environment(results: Results) -> str:
    held = results.environment
    facts = {
        "simgap": held.get("simgap"),
        "started": held.get("started"),
        "Python": held.get("python"),
        "platform": held.get("platform"),
        "processors": held.get("processors"),
        "stepping": held.get("stepping"),
        "seals that held": ", ".join(held.get("seals", ())) or "none noted",
    }
    lines = [
        f"<dt>{safe(name)}</dt><dd>{safe(value)}</dd>"
        for name, value in facts.items()
        if value is not None
    ]
    packages = pd.Series(held.get("packages", {}), dtype=str)
    listed = ", ".join(f"{safe(name, 60)} {safe(value, 40)}" for name, value in packages.items())
    return f"<dl>{''.join(lines)}</dl>" + paragraph(listed, "soft")
