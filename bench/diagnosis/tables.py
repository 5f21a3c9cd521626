"""Tables of a comparison of diagnosers: rows of answers in, frames out.

Shares of alarms have Clopper and Pearson's 95 % intervals (Biometrika 26, 404, 1934), which hold
their level however rare an alarm is; other shares have Wilson's (J. Am. Stat. Assoc. 22, 209,
1927). Two diagnosers are compared question by question, by McNemar's exact test (Psychometrika 12,
153, 1947), all pairs with simgap's own together by Holm's rule (Scand. J. Stat. 6, 65, 1979).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd

AT_LEAST = 1.0
"""Size in units of the noise from which an effect has to be named."""
LEVELS = (0.01, 0.05, 0.1, 0.2, 0.5)
"""At which p values of recordings without anything hidden are counted."""
OWN = "simgap"
"""With which the others are compared."""
SETS = ((1, 1), (2, 2), (3, 4), (5, 10**6))
"""Sizes of sets that are counted together."""
SETS_SAID = ("1", "2", "3 to 4", "5 or more")
"""The same in words."""

NAMED = "the same, up to equivalence"
"""The metric that counts as named: alone or in a set of at most two, equivalent effects as one."""

Of = Callable[[pd.DataFrame], pd.DataFrame]
Right = Callable[[pd.DataFrame], "pd.Series[bool]"]


def share(hits: int, of: int, exact: bool = False) -> dict[str, Any]:
    """A share with its 95 % interval."""
    from scipy.stats import binomtest

    if not of:
        return {"count": 0, "of": 0, "share": np.nan, "low": np.nan, "high": np.nan}
    interval = binomtest(hits, of).proportion_ci(0.95, method="exact" if exact else "wilson")
    ends = {"low": float(interval.low), "high": float(interval.high)}
    return {"count": hits, "of": of, "share": hits / of, **ends}


def singles(rows: pd.DataFrame) -> pd.DataFrame:
    """One hidden effect that has to be named."""
    return rows[(rows["kind"] == "single") & (rows["size"] >= AT_LEAST)]


def clean(rows: pd.DataFrame) -> pd.DataFrame:
    """Nothing hidden."""
    return rows[rows["kind"] == "clean"]


def _within(rows: pd.DataFrame) -> pd.Series[bool]:
    """The cause stands in a set of any size, or alone; nothing besides is named."""
    return rows["outcome"].isin(("right", "set"))


METRICS: tuple[tuple[str, Callable[[pd.DataFrame], pd.DataFrame], Right, bool], ...] = (
    ("false alarms", clean, lambda rows: rows["alarm"], True),
    ("named, alone", singles, lambda rows: rows["outcome"] == "right", False),
    ("named, in a set of at most two", singles, lambda rows: rows["found"], False),
    (NAMED, singles, lambda rows: rows["found_class"], False),
    ("named, in a set of any size", singles, _within, False),
    ("something seen", singles, lambda rows: rows["alarm"], False),
    ("pairs: both named", lambda r: r[r["kind"] == "double"], lambda r: r["found_class"], False),
    (
        "foreign causes: unknown or partial",
        lambda rows: rows[rows["kind"] == "foreign"],
        lambda rows: rows["outcome"] == "right",
        False,
    ),
    ("without an answer", lambda rows: rows, lambda rows: rows["status"] != "done", True),
)
"""What is counted: name, of which rows, what counts, whether its interval is exact."""


def table(rows: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """Every metric of every diagnoser, long."""
    lines = []
    for name in order:
        own = rows[rows["diagnoser"] == name]
        for metric, of, right, exact in METRICS:
            part = of(own)
            counted = share(int(right(part).sum()), len(part), exact)
            lines.append({"diagnoser": name, "metric": metric, **counted})
        intervals = share(int(own["holding"].sum()), int(own["intervals"].sum()))
        lines.append({"diagnoser": name, "metric": "95 % intervals that hold", **intervals})
    return pd.DataFrame(lines)


def groups(rows: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """Naming and alarms by system, noise, whether it is stated, rate, runs, source and effect."""
    lines = []
    keys = ("system", "noise", "stated", "rate", "runs", "source", "driven")
    asked: tuple[tuple[str, Of, Right, tuple[str, ...], bool], ...] = (
        ("false alarms", clean, lambda part: part["alarm"], keys, True),
        ("named", singles, lambda part: part["found_class"], (*keys, "hidden"), False),
        (
            "foreign",
            lambda part: part[part["kind"] == "foreign"],
            lambda part: part["outcome"] == "right",
            ("hidden", "system"),
            False,
        ),
    )
    for name in order:
        own = rows[rows["diagnoser"] == name]
        for metric, of, right, by, exact in asked:
            for key in by:
                for value, part in of(own).groupby(key):
                    counted = share(int(right(part).sum()), len(part), exact)
                    place = {"diagnoser": name, "metric": metric, "by": key, "value": str(value)}
                    lines.append({**place, **counted})
    return pd.DataFrame(lines)


def power(rows: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """What is named and what is seen of single effects, by their size."""
    lines = []
    for name in order:
        own = rows[(rows["diagnoser"] == name) & (rows["kind"] == "single")]
        for size, part in own.groupby("size"):
            for metric, right in (("named", part["found_class"]), ("seen", part["alarm"])):
                counted = share(int(right.sum()), len(part))
                lines.append({"diagnoser": name, "size": size, "metric": metric, **counted})
    return pd.DataFrame(lines)


def confusion(rows: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """How often what was hidden was taken for what: the leading name of the first cause."""
    asked = rows[(rows["kind"] != "double") & rows["diagnoser"].isin(order)].copy()
    hidden = asked["hidden"].where(asked["kind"] == "single", "(" + asked["kind"] + ")")
    asked["hidden"] = hidden
    pairs_of = zip(asked["verdict"].astype(str), asked["named"].astype(str), strict=True)
    asked["said"] = [_said(verdict, named) for verdict, named in pairs_of]
    counted = asked.groupby(["diagnoser", "hidden", "said"]).size()
    counts: pd.DataFrame = counted.rename("count").reset_index()
    return counts


def _said(verdict: str, named: str) -> str:
    if verdict in ("", "adequate", "unknown", "unidentifiable") or not named:
        return f"({verdict or 'nothing'})"
    return "(several)" if " + " in named else named.partition("|")[0]


def calibration(rows: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """Of diagnosers that give p values: how often these are at most a level where nothing is
    hidden, which should be the level itself.
    """
    lines = []
    for name in order:
        own = clean(rows[rows["diagnoser"] == name])
        given = pd.to_numeric(own["p_value"]).dropna()
        if given.empty:
            continue
        for level in LEVELS:
            counted = share(int((given <= level).sum()), len(given), exact=True)
            lines.append({"diagnoser": name, "level": level, **counted})
    columns = ["diagnoser", "level", "count", "of", "share", "low", "high"]
    return pd.DataFrame(lines, columns=columns)


def sets(rows: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """Answers about single effects by the size of their largest set; how many hold the truth."""
    lines = []
    for name in order:
        own = singles(rows[rows["diagnoser"] == name])
        own = own[own["largest_set"] > 0]
        for (low, high), said in zip(SETS, SETS_SAID, strict=True):
            part = own[own["largest_set"].between(low, high)]
            counted = share(int(_within(part).sum()), len(part))
            lines.append({"diagnoser": name, "largest_set": said, **counted})
    return pd.DataFrame(lines)


def costs(
    rows: pd.DataFrame, order: Sequence[str], training: Sequence[dict[str, str]]
) -> pd.DataFrame:
    """What answers cost, and beside them what was learned from before."""
    lines = []
    for name in order:
        own = rows[(rows["diagnoser"] == name) & (rows["status"] == "done")]
        lessons = [lesson for lesson in training if lesson["diagnoser"] == name]
        line: dict[str, Any] = {"diagnoser": name, "answers": len(own)}
        for column in ("simulations", "processor_seconds", "seconds"):
            values = pd.to_numeric(own[column]).dropna().to_numpy(dtype=float)
            for what, quantile in (("median", 0.5), ("p95", 0.95)):
                value = float(np.quantile(values, quantile)) if values.size else np.nan
                line[f"{column}_{what}"] = value
        line["training_simulations"] = sum(int(one["simulations"]) for one in lessons)
        line["training_seconds"] = sum(float(one["seconds"]) for one in lessons)
        lines.append(line)
    return pd.DataFrame(lines)


def pairs(rows: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """Everybody against simgap's own, question by question."""
    asked: tuple[tuple[str, Callable[[pd.DataFrame], pd.DataFrame], Right], ...] = (
        ("named", singles, lambda part: part["found_class"]),
        ("named, alone", singles, lambda part: part["outcome"] == "right"),
        ("no false alarm", clean, lambda part: ~part["alarm"]),
    )
    lines = []
    for metric, of, right in asked:
        part = of(rows)
        wide = part.assign(right=right(part)).pivot(
            index="question", columns="diagnoser", values="right"
        )
        for name in order:
            if name == OWN or OWN not in wide or name not in wide:
                continue
            both = wide[[OWN, name]].dropna()
            ours = int((both[OWN].astype(bool) & ~both[name].astype(bool)).sum())
            theirs = int((~both[OWN].astype(bool) & both[name].astype(bool)).sum())
            lines.append(
                {
                    "metric": metric,
                    "diagnoser": name,
                    "questions": len(both),
                    "only_simgap": ours,
                    "only_other": theirs,
                    "p_value": mcnemar(ours, theirs),
                }
            )
    columns = ["metric", "diagnoser", "questions", "only_simgap", "only_other", "p_value"]
    frame = pd.DataFrame(lines, columns=columns)
    held = [holm(part["p_value"].tolist()) for _, part in frame.groupby("metric", sort=False)]
    frame["p_holm"] = [value for part in held for value in part]
    return frame


def mcnemar(ours: int, theirs: int) -> float:
    """Exact two-sided probability of so unequal a split of the questions that one alone got
    right.
    """
    from scipy.stats import binomtest

    if not ours + theirs:
        return 1.0
    return float(binomtest(ours, ours + theirs).pvalue)


def holm(chances: Sequence[float]) -> list[float]:
    """Probabilities corrected for their number."""
    order = np.argsort(chances, kind="stable")
    corrected = np.ones(len(chances))
    highest = 0.0
    for rank, place in enumerate(order.tolist()):
        highest = max(highest, min(1.0, (len(chances) - rank) * chances[place]))
        corrected[place] = highest
    return [float(value) for value in corrected]


Line = dict[str, Any]


def by_diagnoser(frame: pd.DataFrame, metric: str = "") -> dict[str, Line]:
    """The lines of a table by diagnoser, those of one metric where it is named."""
    if metric:
        frame = frame[frame["metric"] == metric]
    lines = [{str(key): value for key, value in line.items()} for line in frame.to_dict("records")]
    return {str(line["diagnoser"]): line for line in lines}


def complete(rows: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """The questions that every diagnoser was asked: what is not finished compares like with
    like.
    """
    counts = rows.groupby("question")["diagnoser"].nunique()
    whole = counts.index[counts == len(order)]
    chosen: pd.DataFrame = rows[rows["question"].isin(whole)]
    return chosen


def all_tables(
    rows: pd.DataFrame, order: Sequence[str], training: Sequence[dict[str, str]]
) -> dict[str, pd.DataFrame]:
    """Every table by the name of its file."""
    return {
        "table": table(rows, order),
        "groups": groups(rows, order),
        "power": power(rows, order),
        "confusion": confusion(rows, order),
        "calibration": calibration(rows, order),
        "sets": sets(rows, order),
        "costs": costs(rows, order, training),
        "pairs": pairs(rows, order),
    }
