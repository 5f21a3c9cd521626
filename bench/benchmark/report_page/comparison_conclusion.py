"""Headline sentences and warnings of a comparison's report."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from bench.benchmark.report_page import headline
from bench.benchmark.report_page.comparison_page_data import ComparisonReportData
from bench.benchmark.statistics.tuner_ranking import BEST, EQUAL, SIGNIFICANCE
from bench.pages import html_elements
from bench.pages.html_elements import make_paragraph, make_strong, safe
from bench.pages.text_format import format_number, format_percent, joined

SIGNIFICANCE_LEVEL = SIGNIFICANCE
"""Corrected p-value below which one tuner is called better than another."""


def best_table(results: ComparisonReportData) -> str:
    """Build a table of the best tuners after 1, 3, 10 and all simulations; safe HTML.

    The table has a column for each range.
    """
    columns = [headline.standings(results.statistics, kind) for kind in results.ranges]
    if not all(columns):
        return ""
    rows = [
        [str(together[0].simulations), *map(_best, together)]
        for together in zip(*columns, strict=True)
    ]
    best = (f"best (median error), {headline.WHERE[kind]}" for kind in results.ranges)
    return html_elements.make_table(["-simulations", *best], rows)


def write_conclusion(results: ComparisonReportData) -> list[str]:
    """List the tuners that are worse than the best after all simulations, by range; safe HTML."""
    return [_of_range(results, kind) for kind in results.ranges]


def standing_tables(results: ComparisonReportData) -> str:
    """Build a table of best, worse and undecided tuners for each range; safe HTML."""
    label = results.format_metric_label(results.shown_metric)
    parts = []
    for kind in results.ranges:
        rows = [
            [
                str(one.simulations),
                _best(one),
                _named(one.worse),
                _named(one.undecided),
                _named(one.failed),
            ]
            for one in headline.standings(results.statistics, kind)
        ]
        heads = ["-simulations", "best (median error)", "worse", "not decided", "all runs failed"]
        # Usually nothing failed, and the column would be empty.
        width = len(heads) if any(row[-1] for row in rows) else len(heads) - 1
        title = f"{_where(results, kind)}: {label}; {headline.floor_text(results.statistics)}"
        how = headline.how_decided(results.statistics, kind)
        parts.append(f"<h3>{safe(title, 400)}</h3>\n")
        parts.append(html_elements.make_table(heads[:width], [row[:width] for row in rows]))
        failed = headline.failed_runs(results.statistics, kind)
        parts += [make_paragraph(safe(text, 1000), "soft") for text in (failed, how) if text]
    return "".join(parts)


def _best(one: headline.Standing) -> str:
    """Format the best tuners with their median error."""
    return (
        f"{_named(one.best, make_strong)} ({safe(one.error)})" if one.best else "every run failed"
    )


def _of_range(results: ComparisonReportData, kind: str) -> str:
    found, where = headline.standings(results.statistics, kind), _where(results, kind)
    if not found:
        return f"{where}: no target has an error that decides."
    last = found[-1]
    # The wording of the first one explains the format of the others.
    first = [
        re.sub(r" (\d\S*x) \((\d+)/(\d+)\)$", r" \1 the error (larger on \2 of \3 targets)", one)
        for one in last.worse[:1]
    ]
    parts = {
        "worse than the best": [*first, *last.worse[1:]],
        "not decided": last.undecided,
        "all runs failed": last.failed,
    }
    said = "; ".join(f"{what}: {_named(names)}" for what, names in parts.items() if names)
    return f"{where}, after {last.simulations} simulations: {said or 'no tuner is worse'}."


def _where(results: ComparisonReportData, kind: str) -> str:
    text = headline.WHERE[kind]
    return f"{text[0].upper()}{text[1:]} ({headline.targets_text(results.statistics, kind)})"


def reaching(results: ComparisonReportData) -> list[str]:
    """Describe how soon the best tuners of each range reach an error permanently; safe HTML."""
    said = ((_where(results, kind), _reaching(results, kind)) for kind in results.ranges)
    return [f"{where}: {text}" for where, text in said if text]


def _reaching(results: ComparisonReportData, kind: str) -> str:
    statistics, table = results.statistics, results.tables["ert"]
    ranking = statistics.ranking[statistics.ranking["range"] == kind]
    last = ranking[ranking["simulations"] == ranking["simulations"].max()]
    best = list(last.loc[last["verdict"].isin((BEST, EQUAL)), "tuner"])
    part = table[
        (table["range"] == kind)
        & (table["threshold"] == statistics.reference_level)
        & (table["successes"] > 0)
        & table["tuner"].isin(best)
    ]
    if part.empty:
        return ""
    lines = sorted(part.to_dict("records"), key=lambda row: statistics.order.index(row["tuner"]))
    each = [
        f"{safe(row['tuner'], 40)} {format_number(row['ert'])} "
        f"({_ends(row)}; {int(row['successes'])} of {int(row['runs'])} runs"
        f"{_training(results, row)})"
        for row in lines
    ]
    return (
        "expected simulations of the best tuners until the error stays at or below "
        f"{format_number(statistics.reference_level)}{_unit(results)}: {', '.join(each)}."
    )


def _unit(results: ComparisonReportData) -> str:
    """Return the unit of the deciding error."""
    metric = results.statistics.metric
    if metric in ("param_error", "stiff_error"):
        return " training widths"
    return f" in {safe(results.format_metric_label(metric))}"


def _ends(line: Mapping[Any, Any]) -> str:
    high = format_number(line["high"]) if np.isfinite(line["high"]) else "∞"
    return f"95 % {format_number(line['low'])} to {high}"


def _training(results: ComparisonReportData, line: Mapping[Any, Any]) -> str:
    simulations, _ = results.stored.costs.get(str(line["tuner"]), (0.0, 0.0))
    return f"; training {format_number(simulations, 6)}" if simulations else ""


def _named(names: Sequence[str], mark: Callable[[str], str] = str) -> str:
    """Format names as safe HTML, with a mark-up function for each."""
    shown = [mark(safe(name, 100)) for name in names]
    return joined(shown)


def write_warnings(results: ComparisonReportData) -> Iterator[str]:
    """Yield warnings about limitations of the results; safe HTML."""
    few = (headline.too_few(results.statistics, kind) for kind in results.ranges)
    yield from dict.fromkeys(safe(text) for text in few if text)
    if results.missing:
        yield f"Not finished: {results.missing} planned runs are not made yet."
    statuses = results.stored.statuses
    skipped = statuses[statuses["status"] == "skipped"]["tuner"].nunique()
    failed = int(statuses["status"].isin(["crashed", "timeout", "diverged"]).sum())
    if failed:
        share = format_percent(failed / len(statuses))
        yield f'{failed} of {len(statuses)} runs failed ({share}): <a href="#failures">why</a>.'
    if skipped:
        tuners = f"{skipped} tuner{'s' * (skipped > 1)}"
        yield f'{tuners} could not be used here: <a href="#failures">why</a>.'


def redraws_text(results: ComparisonReportData) -> str:
    """Describe how many targets were drawn again, as plain text; empty for none."""
    redrawn, draws = (
        results.environment.get(key, 0) for key in ("redrawn_targets", "target_draws")
    )
    targets = sum(results.statistics.target_counts.values())
    if not redrawn:
        return ""
    return (
        f"{redrawn} of {targets} targets were drawn again because their own simulation diverged "
        f"({draws} draws in all)."
    )


def write_provenance_notes(results: ComparisonReportData) -> Iterator[str]:
    """Yield notes on isolation, salt and targets that limit the results."""
    if results.experiment.trusted:
        yield "Trusted: the tuners ran inside the harness, where nothing is out of their reach."
    if not results.experiment.salt_sha256:
        yield "The targets have a public salt: everybody can draw them."
    if redrawn := redraws_text(results):
        yield redrawn
