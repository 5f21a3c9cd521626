"""Who wins where, in a sentence or two that the statistics support."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd

from bench.analysis.paired import log_errors
from bench.analysis.rounding import FLOOR
from bench.pages.comparison.results import RANGES, Results
from bench.pages.elements import safe, strong
from bench.pages.text import number, percent

SURE = 0.05
"""Holm-corrected p-value below which one tuner is called better than another."""
_FEW = 4
"""Names that a sentence holds."""


def conclusion(results: Results) -> list[str]:
    """Who ends best in each range; safe HTML."""
    return [_of_range(results, kind) for kind in results.ranges]


def soonest(results: Results) -> list[str]:
    """Who reaches an error soonest in each range; safe HTML."""
    said = ((_where(results, kind), _soonest(results, kind)) for kind in results.ranges)
    return [f"{where}: {text}" for where, text in said if text]


def _of_range(results: Results, kind: str) -> str:
    medians = log_errors(results.statistics.curves.of(range=kind)).median().sort_values()
    if medians.empty:
        return f"{_where(results, kind)}: no target has an error that decides."
    winner = str(medians.index[0])
    failed = results.statistics.curves.of(range=kind, tuner=winner).failed
    if failed.all():
        return f"{_where(results, kind)}: every run of every tuner failed."
    said = f"{_where(results, kind)}: {_least(results, kind, winner)}"
    return f"{said} {_against(results, kind, winner)}".strip()


def _where(results: Results, kind: str) -> str:
    count = results.count(kind)
    things = "starting point" if kind == "real" else "target"
    text = f"Targets {RANGES[kind]}" if kind != "real" else "The recording"
    return f"{text} ({count} {things}{'s' * (count != 1)})"


def _least(results: Results, kind: str, winner: str) -> str:
    """Who ends with the smallest error, and what that is."""
    metric = results.statistics.metric
    if metric == "param_error":
        metric = results.statistics.parameter_metric
    line = results.statistics.medians(metric, kind)
    line = line[line["tuner"] == winner]
    if line.empty:
        return f"{strong(safe(winner))} ends with the smallest median error."
    last = line.iloc[-1]
    interval = ""
    if np.isfinite(last["low"]) and last["high"] > FLOOR:
        interval = f" (95 % {_at(last['low'])} to {_at(last['high'])})"
    after = int(last["simulations"])
    return (
        f"{strong(safe(winner))} ends with the smallest error after {after} simulations: "
        f"{safe(results.label(metric))}, median {_at(last['median'])}{interval}."
    )


def _at(error: float) -> str:
    """An error of a curve, which ends where rounding in the observation begins."""
    return number(error) if error > FLOOR else f"at most {number(FLOOR)}"


def _against(results: Results, kind: str, winner: str) -> str:
    """Against how many of the others the paired test holds."""
    pairs = results.tables["pairs"]
    mine = pairs[(pairs["range"] == kind) & ((pairs["a"] == winner) | (pairs["b"] == winner))]
    if mine.empty:
        return ""
    favour = np.where(mine["a"] == winner, mine["effect"], -mine["effect"])
    others = np.where(mine["a"] == winner, mine["b"], mine["a"])
    sure = (mine["p_holm"] < SURE).to_numpy() & (favour > 0)
    test = "(paired test, p &lt; 0.05)"
    if not sure.any():
        return f"No other can be told apart from it {test}{_too_few(results, kind)}."
    text = f"It is better than {sure.sum()} of {len(mine)} others {test}"
    left = [str(name) for name in others[~sure]]
    return f"{text}; not told apart: {_named(left)}." if left else f"{text}."


def _too_few(results: Results, kind: str) -> str:
    """Why a test of few targets cannot find anything."""
    # The smallest p of Wilcoxon's signed-rank test on n pairs, before any correction.
    least = 2.0 ** (1 - results.count(kind))
    pairs = results.tables["pairs"]
    tests = int((pairs["range"] == kind).sum())
    if least * tests < SURE:
        return ""
    return f": {results.count(kind)} targets are too few for {tests} pairs"


def _soonest(results: Results, kind: str) -> str:
    """Who needs the fewest simulations to a level that half of the tuners reach."""
    level = results.statistics.level
    table = results.tables["ert"]
    part = table[
        (table["range"] == kind) & (table["threshold"] == level) & (table["successes"] > 0)
    ]
    if part.empty:
        return ""
    part = part.sort_values("ert", kind="stable")
    first = part.iloc[0]
    rivals = part.iloc[1:][part.iloc[1:]["low"] <= first["high"]]
    names = [str(first["tuner"]), *map(str, rivals["tuner"])]
    reached = f"{int(first['successes'])} of {int(first['runs'])} runs"
    text = (
        f"an error of {number(level)}{_unit(results)} is reached for good soonest by "
        f"{_named(names[:1], strong)}: {number(first['ert'])} simulations expected "
        f"({_ends(first)}; {reached}){_training(results, first)}"
    )
    if len(names) > 1:
        text += f"; the intervals of {_named(names[1:])} overlap with its own"
    return f"{text}."


def _unit(results: Results) -> str:
    """What the error that decides is measured in."""
    metric = results.statistics.metric
    if metric in ("param_error", "stiff_error"):
        return " training widths"
    return f" in {safe(results.label(metric))}"


def _ends(line: pd.Series[Any]) -> str:
    high = number(line["high"]) if np.isfinite(line["high"]) else "∞"
    return f"95 % {number(line['low'])} to {high}"


def _training(results: Results, line: pd.Series[Any]) -> str:
    simulations, _ = results.stored.costs.get(str(line["tuner"]), (0.0, 0.0))
    return f", after a training of {number(simulations, 6)}" if simulations else ""


def _named(names: Sequence[str], how: object = None) -> str:
    """A few names, and how many more there are."""
    shown = [strong(safe(n, 40)) if how is strong else safe(n, 40) for n in names[:_FEW]]
    more = len(names) - len(shown)
    if more:
        return f"{', '.join(shown)} and {more} more"
    return " and ".join([", ".join(shown[:-1]), shown[-1]] if len(shown) > 1 else shown)


def warnings(results: Results) -> Iterator[str]:
    """What takes something away from the results; safe HTML."""
    if results.missing:
        yield f"Not finished: {results.missing} planned runs are not made yet."
    statuses = results.stored.statuses
    skipped = statuses[statuses["status"] == "skipped"]["tuner"].nunique()
    failed = int(statuses["status"].isin(["crashed", "timeout", "diverged"]).sum())
    if failed:
        share = percent(failed / len(statuses))
        yield f'{failed} of {len(statuses)} runs failed ({share}): <a href="#failures">why</a>.'
    if skipped:
        tuners = f"{skipped} tuner{'s' * (skipped > 1)}"
        yield f'{tuners} could not be used here: <a href="#failures">why</a>.'


def marks(results: Results) -> Iterator[str]:
    """How the runs were made, where that takes something away from them."""
    if results.experiment.trusted:
        yield "Trusted: the tuners ran inside the harness, where nothing is out of their reach."
    if not results.experiment.salt_sha256:
        yield "The targets have a public salt: everybody can draw them."
