"""Headline sentences and warnings of the report of a comparison of diagnosers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pandas as pd

from bench.diagnosis_benchmark.diagnoser_figures import TARGET_FALSE_ALARM_RATE
from bench.diagnosis_benchmark.report_page.diagnoser_page_data import DiagnoserReportData
from bench.diagnosis_benchmark.result_tables import (
    PRIMARY_METRIC,
    REFERENCE_DIAGNOSER,
    index_by_diagnoser,
)
from bench.diagnosis_benchmark.wrong_answers import is_correct, select_graded_answers
from bench.figures.style import TRUSTED_TUNERS_NOTE
from bench.pages.html_elements import make_code, make_strong, safe
from bench.pages.text_format import format_p_value, format_percent

_SIGNIFICANCE_LEVEL = 0.05
"""Maximum Holm-corrected p-value for a significant difference between two diagnosers."""
_KINDS = {
    "clean": "false alarms in {of} clean recordings",
    "single": "of {of} single effects of at least one noise",
    "double": "of {of} pairs",
    "foreign": "of {of} foreign causes",
}


def write_conclusion(shown: DiagnoserReportData) -> Iterator[str]:
    """Yield the headline sentences as escaped HTML.

    They state the failures of simgap, the diagnoser that identifies most causes among those with
    few false alarms, and the diagnosers that are significantly better than simgap.
    """
    yield from _own_failures(shown)
    yield from _find_leader(shown)
    yield from _find_better_than_simgap(shown)


def _own_failures(shown: DiagnoserReportData) -> Iterator[str]:
    own = select_graded_answers(shown.rows[shown.rows["diagnoser"] == REFERENCE_DIAGNOSER])
    if own.empty:
        return
    wrong = own[~is_correct(own)]
    parts = []
    for kind, says in _KINDS.items():
        of = int((own["kind"] == kind).sum())
        if of:
            parts.append(f"{int((wrong['kind'] == kind).sum())} {says.format(of=of)}")
    said = (
        f"{make_strong(REFERENCE_DIAGNOSER)} fails on {len(wrong)} of {len(own)} questions: "
        f"{', '.join(parts)}."
    )
    yield f'{said} <a href="#failures">They are listed first</a>.' if len(wrong) else said


def _find_leader(shown: DiagnoserReportData) -> Iterator[str]:
    """Yield the best diagnoser among those with few false alarms, and whether its lead is clear."""
    table = shown.tables["table"]
    alarms, named = (
        index_by_diagnoser(table, "false alarms"),
        index_by_diagnoser(table, PRIMARY_METRIC),
    )
    if not any(line["of"] for line in alarms.values()):
        return
    quiet = [name for name in shown.order if alarms[name]["share"] <= TARGET_FALSE_ALARM_RATE]
    asked = [name for name in quiet if named[name]["of"]]
    limit = f"{100 * TARGET_FALSE_ALARM_RATE:g} %".replace(" %", "\u00a0%")
    if not asked:
        yield f"Nobody stays at {limit} of false alarms or less here."
        return
    best = max(asked, key=lambda name: float(named[name]["share"]))
    said = f"Of those that alarm in {limit} of the clean recordings or less ({_names(asked)}), "
    yield (
        f"{said}{make_strong(safe(best, 60))} names most: {_share(named[best])}. "
        + _is_leader_significant(shown, best, [name for name in asked if name != best])
    )
    line = alarms[best]
    if line["high"] > TARGET_FALSE_ALARM_RATE:
        yield (
            f"That {safe(best, 60)} stays below {limit} these {int(line['of'])} clean recordings "
            f"cannot show: {_alarms(int(line['count']))} up to {format_percent(line['high'])}."
        )


def _is_leader_significant(shown: DiagnoserReportData, best: str, others: list[str]) -> str:
    """Say whether simgap as the best diagnoser differs significantly from the others.

    Returns:
        One sentence, or an empty text if there are no others or if simgap is not the best: only
        pairs with simgap are tested.
    """
    if not others or best != REFERENCE_DIAGNOSER:
        return ""
    lines = index_by_diagnoser(shown.tables["pairs"], "named")
    near = [name for name in others if float(lines[name]["p_holm"]) >= _SIGNIFICANCE_LEVEL]
    if near:
        return f"It is not told apart from {_names(near)} (McNemar, Holm)."
    worst = max(float(lines[name]["p_holm"]) for name in others)
    return f"It is told apart from each of the others ({format_p_value(worst)}; McNemar, Holm)."


def _find_better_than_simgap(shown: DiagnoserReportData) -> Iterator[str]:
    """Yield the metrics at which another diagnoser is significantly better than simgap."""
    pairs = shown.tables["pairs"]
    if pairs.empty:
        return
    sure = pairs[
        (pairs["p_holm"] < _SIGNIFICANCE_LEVEL) & (pairs["only_other"] > pairs["only_simgap"])
    ]
    for line in sure.to_dict("records"):
        yield (
            f"{make_strong(safe(line['diagnoser'], 60))} is better than simgap at "
            f"“{safe(line['metric'])}”: alone right on {int(line['only_other'])} questions, simgap "
            f"on {int(line['only_simgap'])} ({format_p_value(line['p_holm'])})."
        )
    if sure.empty:
        yield "No other is better than simgap at naming or at keeping quiet, with significance."


def write_warnings(shown: DiagnoserReportData) -> Iterator[str]:
    """Yield sentences about limitations of the results, as escaped HTML."""
    if shown.experiment.trusted:
        yield f"{TRUSTED_TUNERS_NOTE.capitalize()}."
    if shown.case_count < shown.planned:
        yield (
            f"{shown.case_count} of {shown.planned} questions: those that everybody has been "
            "asked. Questions are asked in an order of chance, so these are a fair sample."
        )
    failed = shown.rows[shown.rows["status"] != "done"]
    if len(failed):
        by = failed.groupby("diagnoser").size()
        told = ", ".join(f"{safe(name, 60)} {count}" for name, count in by.items())
        yield f"Without an answer (crashed, too late or too costly): {told}."
    for name, reason, count in summarise_unsupported(shown.left_out):
        yield f"{safe(name, 60)} cannot be asked {count} of the questions: {safe(reason)}."
    for name, reason in shown.skipped.items():
        yield f"{make_code(safe(name, 60))} was not asked: {safe(reason)}"


def summarise_unsupported(left_out: pd.DataFrame) -> list[tuple[str, str, int]]:
    """Count the cases that diagnosers do not support, by diagnoser and reason.

    Args:
        left_out: rows of unsupported cases, with columns diagnoser and reason.

    Returns:
        List of (diagnoser, reason, number of cases).
    """
    groups = left_out.groupby(["diagnoser", "reason"], sort=False).size().reset_index(name="of")
    return [(str(n), str(why), int(of)) for n, why, of in groups.itertuples(index=False)]


def _names(names: list[str]) -> str:
    return ", ".join(safe(name, 60) for name in names)


def _share(line: dict[str, Any] | pd.Series[Any]) -> str:
    ends = f"95 % interval {format_percent(line['low'])} to {format_percent(line['high'])}"
    return f"{int(line['count'])} of {int(line['of'])}, {format_percent(line['share'])} ({ends})"


def _alarms(count: int) -> str:
    return "1 alarm leaves" if count == 1 else f"{count} alarms leave"
