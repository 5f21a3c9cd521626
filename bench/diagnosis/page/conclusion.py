"""Headline sentences and warnings of the report of a comparison of diagnosers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pandas as pd

from bench.diagnosis.failures import counted, right
from bench.diagnosis.figures import WANTED_ALARMS
from bench.diagnosis.page.shown import Shown
from bench.diagnosis.tables import NAMED, OWN, by_diagnoser
from bench.figures.style import TRUSTED
from bench.pages.elements import code, safe, strong
from bench.pages.text import percent, probability

_SURE = 0.05
"""Maximum Holm-corrected p-value for a significant difference between two diagnosers."""
_KINDS = {
    "clean": "false alarms in {of} clean recordings",
    "single": "of {of} single effects of at least one noise",
    "double": "of {of} pairs",
    "foreign": "of {of} foreign causes",
}


def conclusion(shown: Shown) -> Iterator[str]:
    """Yield the headline sentences as escaped HTML.

    They state the failures of simgap, the diagnoser that identifies most causes among those with
    few false alarms, and the diagnosers that are significantly better than simgap.
    """
    yield from _own_failures(shown)
    yield from _leading(shown)
    yield from _better(shown)


def _own_failures(shown: Shown) -> Iterator[str]:
    own = counted(shown.rows[shown.rows["diagnoser"] == OWN])
    if own.empty:
        return
    wrong = own[~right(own)]
    parts = []
    for kind, says in _KINDS.items():
        of = int((own["kind"] == kind).sum())
        if of:
            parts.append(f"{int((wrong['kind'] == kind).sum())} {says.format(of=of)}")
    said = f"{strong(OWN)} fails on {len(wrong)} of {len(own)} questions: {', '.join(parts)}."
    yield f'{said} <a href="#failures">They are listed first</a>.' if len(wrong) else said


def _leading(shown: Shown) -> Iterator[str]:
    """Yield the best diagnoser among those with few false alarms, and whether its lead is clear."""
    table = shown.tables["table"]
    alarms, named = by_diagnoser(table, "false alarms"), by_diagnoser(table, NAMED)
    if not any(line["of"] for line in alarms.values()):
        return
    quiet = [name for name in shown.order if alarms[name]["share"] <= WANTED_ALARMS]
    asked = [name for name in quiet if named[name]["of"]]
    limit = f"{100 * WANTED_ALARMS:g} %".replace(" %", "\u00a0%")
    if not asked:
        yield f"Nobody stays at {limit} of false alarms or less here."
        return
    best = max(asked, key=lambda name: float(named[name]["share"]))
    said = f"Of those that alarm in {limit} of the clean recordings or less ({_names(asked)}), "
    yield f"{said}{strong(safe(best, 60))} names most: {_share(named[best])}. " + _apart(
        shown, best, [name for name in asked if name != best]
    )
    line = alarms[best]
    if line["high"] > WANTED_ALARMS:
        yield (
            f"That {safe(best, 60)} stays below {limit} these {int(line['of'])} clean recordings "
            f"cannot show: {_alarms(int(line['count']))} up to {percent(line['high'])}."
        )


def _apart(shown: Shown, best: str, others: list[str]) -> str:
    """Say whether simgap as the best diagnoser differs significantly from the others.

    Returns:
        One sentence, or an empty text if there are no others or if simgap is not the best: only
        pairs with simgap are tested.
    """
    if not others or best != OWN:
        return ""
    lines = by_diagnoser(shown.tables["pairs"], "named")
    near = [name for name in others if float(lines[name]["p_holm"]) >= _SURE]
    if near:
        return f"It is not told apart from {_names(near)} (McNemar, Holm)."
    worst = max(float(lines[name]["p_holm"]) for name in others)
    return f"It is told apart from each of the others ({probability(worst)}; McNemar, Holm)."


def _better(shown: Shown) -> Iterator[str]:
    """Yield the metrics at which another diagnoser is significantly better than simgap."""
    pairs = shown.tables["pairs"]
    if pairs.empty:
        return
    sure = pairs[(pairs["p_holm"] < _SURE) & (pairs["only_other"] > pairs["only_simgap"])]
    for line in sure.to_dict("records"):
        yield (
            f"{strong(safe(line['diagnoser'], 60))} is better than simgap at "
            f"“{safe(line['metric'])}”: alone right on {int(line['only_other'])} questions, simgap "
            f"on {int(line['only_simgap'])} ({probability(line['p_holm'])})."
        )
    if sure.empty:
        yield "No other is better than simgap at naming or at keeping quiet, with significance."


def warnings(shown: Shown) -> Iterator[str]:
    """Yield sentences about limitations of the results, as escaped HTML."""
    if shown.experiment.trusted:
        yield f"{TRUSTED.capitalize()}."
    if shown.asked < shown.planned:
        yield (
            f"{shown.asked} of {shown.planned} questions: those that everybody has been asked. "
            "Questions are asked in an order of chance, so these are a fair sample."
        )
    failed = shown.rows[shown.rows["status"] != "done"]
    if len(failed):
        by = failed.groupby("diagnoser").size()
        told = ", ".join(f"{safe(name, 60)} {count}" for name, count in by.items())
        yield f"Without an answer (crashed, too late or too costly): {told}."
    for name, reason, count in cannot(shown.left_out):
        yield f"{safe(name, 60)} cannot be asked {count} of the questions: {safe(reason)}."
    for name, reason in shown.skipped.items():
        yield f"{code(safe(name, 60))} was not asked: {safe(reason)}"


def cannot(left_out: pd.DataFrame) -> list[tuple[str, str, int]]:
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
    ends = f"95 % interval {percent(line['low'])} to {percent(line['high'])}"
    return f"{int(line['count'])} of {int(line['of'])}, {percent(line['share'])} ({ends})"


def _alarms(count: int) -> str:
    return "1 alarm leaves" if count == 1 else f"{count} alarms leave"
