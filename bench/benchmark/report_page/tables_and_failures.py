"""Sections below the charts: tables, failures, and how the results were made."""

from __future__ import annotations

import shlex
from collections.abc import Iterator

import pandas as pd

from bench.benchmark.problem.fisher_information import STIFF_SIGMA_THRESHOLD
from bench.benchmark.report_page.comparison_page_data import ComparisonReportData
from bench.benchmark.storage.run_status import FAILED_OR_SKIPPED_STATUSES
from bench.pages import html_elements
from bench.pages.data_grid import DataGrid, GridColumn
from bench.pages.html_elements import make_code, make_collapsible, make_paragraph, safe
from bench.pages.html_page import HtmlPage
from bench.pages.text_format import format_number

_MOST = 20
"""Maximum number of failure reasons that are shown completely."""
_LONG = 6000
"""Maximum length of a reason in characters."""


def render_error_table(results: ComparisonReportData, page: HtmlPage) -> str:
    """Build the grid of table.csv.

    It initially shows the deciding error at the end of the budget, the best tuner first.

    Args:
        results: Results of the comparison.
        page: Page, to which the table is added.
    """
    table = results.tables["table"]
    page.add_table("table", table)
    metric = results.statistics.metric
    if metric == "param_error":
        metric = results.statistics.parameter_error_metric
    only = {"metric": metric, "simulations": str(int(table["simulations"].max()))}
    if len(results.ranges) > 1:
        only["range"] = results.ranges[0]
    columns = (
        GridColumn("tuner"),
        GridColumn("range"),
        GridColumn("metric"),
        GridColumn("simulations", digits=6),
        GridColumn("median", digits=3),
        GridColumn("mean", digits=3),
        GridColumn("low", "mean, 95 % low", 3),
        GridColumn("high", "mean, 95 % high", 3),
        GridColumn("runs", digits=6),
        GridColumn("failures", digits=6),
        GridColumn("fit_simulations", "training simulations", 6),
        GridColumn("tuner_seconds", "seconds in the tuner", 3),
        GridColumn("simulator_seconds", "seconds in the simulator", 3),
    )
    filters = ("range", "metric", "simulations")
    title = "Every number: table.csv"
    return page.render_grid(
        DataGrid("numbers", title, "table", columns, filters, only, switch="tuner")
    )


def render_ert_table(results: ComparisonReportData, page: HtmlPage) -> str:
    """Build the grid of ert.csv.

    Args:
        results: Results of the comparison.
        page: Page, to which the table is added.
    """
    page.add_table("ert", results.tables["ert"])
    columns = (
        GridColumn("tuner"),
        GridColumn("range"),
        GridColumn("threshold", "error to be reached", 3),
        GridColumn("ert", "expected simulations", 3),
        GridColumn("low", "95 % low", 3),
        GridColumn("high", "95 % high", 3),
        GridColumn("successes", digits=6),
        GridColumn("runs", digits=6),
        GridColumn("failures", digits=6),
    )
    filters, only = ("range", "threshold"), {"threshold": str(results.statistics.reference_level)}
    if len(results.ranges) > 1:
        only["range"] = results.ranges[0]
    title = "Expected running times: ert.csv"
    return page.render_grid(DataGrid("times", title, "ert", columns, filters, only, switch="tuner"))


def render_pairs_table(results: ComparisonReportData, page: HtmlPage) -> str:
    """Build the grid of pairs.csv; empty without pairs.

    Args:
        results: Results of the comparison.
        page: Page, to which the table is added.
    """
    table = results.tables["pairs"]
    if table.empty:
        return ""
    page.add_table("pairs", table)
    columns = (
        GridColumn("range"),
        GridColumn("a"),
        GridColumn("b"),
        GridColumn("targets", digits=6),
        GridColumn("a_better", "share where a is better", 3),
        GridColumn("effect", "effect (1: a on all targets)", 3),
        GridColumn("error_ratio", "error of a over b, median", 3),
        GridColumn("p_value", "p", 2),
        GridColumn("p_holm", "p, Holm-corrected", 2),
    )
    title = "Tuner against tuner: pairs.csv"
    return page.render_grid(
        DataGrid("against", title, "pairs", columns, ("range", "a", "b"), {}, "p_holm")
    )


def render_winners_table(results: ComparisonReportData, page: HtmlPage) -> str:
    """Build the grid of who_wins.csv.

    Args:
        results: Results of the comparison.
        page: Page, to which the table is added.
    """
    page.add_table("who_wins", results.tables["who_wins"])
    columns = (
        GridColumn("range"),
        GridColumn("threshold", "error reached", 3),
        GridColumn("from_seconds", "from [s a simulation]", 3),
        GridColumn("to_seconds", "to [s a simulation]", 3),
        GridColumn("tuner", "needs the least time"),
    )
    title = "Who wins: who_wins.csv"
    return page.render_grid(DataGrid("winners", title, "who_wins", columns, ("range", "threshold")))


def render_break_even_table(results: ComparisonReportData, page: HtmlPage) -> str:
    """Build the grid of break_even.csv; empty without rows.

    Args:
        results: Results of the comparison.
        page: Page, to which the table is added.
    """
    table = results.tables["break_even"]
    if table.empty:
        return ""
    page.add_table("break_even", table)
    columns = (
        GridColumn("range"),
        GridColumn("threshold", "error reached", 3),
        GridColumn("learned", "trained"),
        GridColumn("search", "search"),
        GridColumn("fit_simulations", "training simulations", 6),
        GridColumn("targets", "pays from so many targets", 3),
        GridColumn("low", "95 % low", 3),
        GridColumn("high", "95 % high", 3),
    )
    filters, only = ("range", "threshold"), {"threshold": str(results.statistics.reference_level)}
    title = "Break-even: break_even.csv"
    return page.render_grid(
        DataGrid("even", title, "break_even", columns, filters, only, "targets")
    )


def render_identifiability_table(results: ComparisonReportData, page: HtmlPage) -> str:
    """Build the section on what the data of each target identify; empty without the figure.

    Args:
        results: Results of the comparison.
        page: Page, to which the figure is added.
    """
    still = results.make_static_figure(
        "spectra", "1 sigma of each direction, and the parameters in it."
    )
    if still is None:
        return ""
    caption = (
        f"Marks above the dashed line ({STIFF_SIGMA_THRESHOLD:g} training widths) are sloppy: "
        "no tuner can know them from these data. Right: which parameters make up a direction."
    )
    return "<h3>What the data can know</h3>\n" + page.render_figure("spectra", still, caption)


def render_failures(results: ComparisonReportData) -> Iterator[str]:
    """Yield every kind of failure with its first reason in full."""
    statuses = results.stored.statuses
    failed = statuses[statuses["status"].isin(FAILED_OR_SKIPPED_STATUSES)]
    if failed.empty:
        yield make_paragraph(f"None: {len(statuses)} runs ended as they should.")
        return
    groups = list(failed.groupby(["tuner", "status", "reason"], sort=False))
    groups.sort(key=lambda group: -len(group[1]))
    for (tuner, status, reason), group in groups[:_MOST]:
        runs = f"{len(group)} run{'s' * (len(group) > 1)}"
        last = (str(reason).strip().splitlines() or ["no reason was given"])[-1]
        head = f"{safe(tuner, 60)}: {safe(status)} in {runs} — {safe(last, 160)}"
        example = str(group["run"].iloc[0])
        named = make_paragraph(f"First in run {make_code(safe(example))}.") if example else ""
        yield make_collapsible(head, named + _whole(str(reason)))
    if len(groups) > _MOST:
        yield make_paragraph(f"{len(groups) - _MOST} more reasons are in status.csv.")


def _whole(text: str) -> str:
    """Format a text of several lines with its indentation."""
    cut = text if len(text) <= _LONG else f"{text[:_LONG]} …"
    lines = [safe(line, 1000) for line in cut.strip("\n").replace("\t", "    ").split("\n")]
    # `safe` strips leading spaces, so they are added again.
    indents = [len(line) - len(line.lstrip()) for line in cut.strip("\n").split("\n")]
    body = "\n".join(" " * indent + line for indent, line in zip(indents, lines, strict=True))
    return f"<pre>{body}</pre>"


def render_time_table(results: ComparisonReportData) -> str:
    """Build a table of mean seconds by tuner."""
    table = results.tables["table"]
    last = table[table["runs"] > 0].sort_values("simulations").groupby("tuner", sort=False).last()
    last = last.reindex([t for t in results.statistics.order if t in last.index])
    rows = [
        [
            safe(name, 60),
            format_number(row["tuner_seconds"]),
            format_number(row["simulator_seconds"]),
            format_number(row["fit_seconds"]) if row["fit_simulations"] else "–",
        ]
        for name, row in last.iterrows()
    ]
    heads = ["tuner", "-in the tuner [s]", "-in the simulator [s]", "-one training [s]"]
    return "<h3>Mean seconds of a run</h3>\n" + html_elements.make_table(heads, rows)


def render_reproduction(results: ComparisonReportData) -> Iterator[str]:
    """Yield the command that repeats the comparison, the configuration, and the machine."""
    yield make_paragraph("The same runs again, with the targets that were met here:")
    yield f"<pre>{safe(format_rerun_command(results), 1000)}</pre>"
    yield make_paragraph(
        "The page, tables and figures alone: "
        + make_code(safe(f"simgap plot {shlex.quote(results.folder)}", 500))
        + ". Whether the runs are what they say: "
        + make_code(safe(f"simgap verify {shlex.quote(results.folder)}", 500))
        + "."
    )
    yield make_collapsible(
        "experiment.toml: the exact configuration", _whole(results.configuration)
    )
    yield make_collapsible("Versions and machine", _environment(results))


def format_rerun_command(results: ComparisonReportData) -> str:
    """Return the command that repeats the comparison."""
    source = shlex.quote(f"{results.folder}/experiment.toml")
    plugins = [f" --plugin {shlex.quote(p)}" for p in results.environment.get("plugins", ())]
    return f"simgap compare {source}{''.join(plugins)}"


def _environment(results: ComparisonReportData) -> str:
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
    return f"<dl>{''.join(lines)}</dl>" + make_paragraph(listed, "soft")
