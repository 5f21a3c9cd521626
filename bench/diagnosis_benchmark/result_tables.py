"""Tables of a comparison of diagnosers, computed from one row per answer.

Fractions of false alarms and of missing answers have 95 % intervals of Clopper and Pearson
(Biometrika 26, 404, 1934), which keep their level for rare events too; other fractions have 95 %
intervals of Wilson (J. Am. Stat. Assoc. 22, 209, 1927). Two diagnosers are compared on the same
cases by McNemar's exact test (Psychometrika 12, 153, 1947); all pairs with simgap are corrected
together by Holm's method (Scand. J. Stat. 6, 65, 1979).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd

MIN_GRADED_SIZE = 1.0
"""Minimum size of an effect that must be diagnosed, in units of the noise."""
P_VALUE_LEVELS = (0.01, 0.05, 0.1, 0.2, 0.5)
"""Significance levels at which p-values of clean recordings are counted."""
REFERENCE_DIAGNOSER = "simgap"
"""Diagnoser with which all others are compared."""
SET_SIZE_BINS = ((1, 1), (2, 2), (3, 4), (5, 10**6))
"""Bins of set sizes, as inclusive (low, high)."""
SET_SIZE_LABELS = ("1", "2", "3 to 4", "5 or more")
"""Labels of the bins of set sizes."""

PRIMARY_METRIC = "the same, up to equivalence"
"""Primary metric: cause named alone or in a set of at most two, equivalent effects counted once."""

RowFilter = Callable[[pd.DataFrame], pd.DataFrame]
RowPredicate = Callable[[pd.DataFrame], "pd.Series[bool]"]


def compute_share(hits: int, of: int, exact: bool = False) -> dict[str, Any]:
    """Compute a fraction with its 95 % interval.

    Args:
        hits: number of successes.
        of: number of trials.
        exact: whether to use the Clopper-Pearson interval instead of Wilson's.

    Returns:
        The keys count, of, share, low and high; the last three are NaN without trials.
    """
    from scipy.stats import binomtest

    if not of:
        return {"count": 0, "of": 0, "share": np.nan, "low": np.nan, "high": np.nan}
    interval = binomtest(hits, of).proportion_ci(0.95, method="exact" if exact else "wilson")
    ends = {"low": float(interval.low), "high": float(interval.high)}
    return {"count": hits, "of": of, "share": hits / of, **ends}


def select_single_effects(rows: pd.DataFrame) -> pd.DataFrame:
    """Select cases with one hidden effect that is large enough to be diagnosed."""
    return rows[(rows["kind"] == "single") & (rows["size"] >= MIN_GRADED_SIZE)]


def select_clean(rows: pd.DataFrame) -> pd.DataFrame:
    """Select cases without a hidden cause."""
    return rows[rows["kind"] == "clean"]


def _within(rows: pd.DataFrame) -> pd.Series[bool]:
    """Return whether the cause is in a named set of any size and no other cause is named."""
    return rows["outcome"].isin(("right", "set"))


METRICS: tuple[tuple[str, Callable[[pd.DataFrame], pd.DataFrame], RowPredicate, bool], ...] = (
    ("false alarms", select_clean, lambda rows: rows["alarm"], True),
    ("named, alone", select_single_effects, lambda rows: rows["outcome"] == "right", False),
    ("named, in a set of at most two", select_single_effects, lambda rows: rows["found"], False),
    (PRIMARY_METRIC, select_single_effects, lambda rows: rows["found_class"], False),
    ("named, in a set of any size", select_single_effects, _within, False),
    ("something seen", select_single_effects, lambda rows: rows["alarm"], False),
    ("pairs: both named", lambda r: r[r["kind"] == "double"], lambda r: r["found_class"], False),
    (
        "foreign causes: unknown or partial",
        lambda rows: rows[rows["kind"] == "foreign"],
        lambda rows: rows["outcome"] == "right",
        False,
    ),
    ("without an answer", lambda rows: rows, lambda rows: rows["status"] != "done", True),
)
"""Metrics: name, row filter, success predicate, and whether to use the Clopper-Pearson interval."""


def build_metric_table(rows: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """Build the table of all metrics, one row per diagnoser and metric.

    Args:
        rows: one row per answer.
        order: names of the diagnosers.
    """
    lines = []
    for name in order:
        own = rows[rows["diagnoser"] == name]
        for metric, of, right, exact in METRICS:
            part = of(own)
            counted = compute_share(int(right(part).sum()), len(part), exact)
            lines.append({"diagnoser": name, "metric": metric, **counted})
        intervals = compute_share(int(own["holding"].sum()), int(own["intervals"].sum()))
        lines.append({"diagnoser": name, "metric": "95 % intervals that hold", **intervals})
    return pd.DataFrame(lines)


def build_group_table(rows: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """Build the table of false alarms and diagnosed causes by recording condition and effect.

    Args:
        rows: one row per answer.
        order: names of the diagnosers.
    """
    lines = []
    keys = ("system", "noise", "stated", "rate", "runs", "source", "driven")
    asked: tuple[tuple[str, RowFilter, RowPredicate, tuple[str, ...], bool], ...] = (
        ("false alarms", select_clean, lambda part: part["alarm"], keys, True),
        (
            "named",
            select_single_effects,
            lambda part: part["found_class"],
            (*keys, "hidden"),
            False,
        ),
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
                    counted = compute_share(int(right(part).sum()), len(part), exact)
                    place = {"diagnoser": name, "metric": metric, "by": key, "value": str(value)}
                    lines.append({**place, **counted})
    return pd.DataFrame(lines)


def build_power_table(rows: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """Build the table of diagnosed and detected single effects by size.

    Args:
        rows: one row per answer.
        order: names of the diagnosers.
    """
    lines = []
    for name in order:
        own = rows[(rows["diagnoser"] == name) & (rows["kind"] == "single")]
        for size, part in own.groupby("size"):
            for metric, right in (("named", part["found_class"]), ("seen", part["alarm"])):
                counted = compute_share(int(right.sum()), len(part))
                lines.append({"diagnoser": name, "size": size, "metric": metric, **counted})
    return pd.DataFrame(lines)


def build_confusion_table(rows: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """Count the leading name of the first diagnosed cause for each hidden cause.

    Args:
        rows: one row per answer.
        order: names of the diagnosers.
    """
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


def build_calibration_table(rows: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """Build the calibration table of p-values on clean recordings.

    It gives the fraction of clean recordings whose p-value is at most a level; for a calibrated
    p-value this fraction equals the level. Diagnosers without p-values are omitted.

    Args:
        rows: one row per answer.
        order: names of the diagnosers.
    """
    lines = []
    for name in order:
        own = select_clean(rows[rows["diagnoser"] == name])
        given = pd.to_numeric(own["p_value"]).dropna()
        if given.empty:
            continue
        for level in P_VALUE_LEVELS:
            counted = compute_share(int((given <= level).sum()), len(given), exact=True)
            lines.append({"diagnoser": name, "level": level, **counted})
    columns = ["diagnoser", "level", "count", "of", "share", "low", "high"]
    return pd.DataFrame(lines, columns=columns)


def build_set_size_table(rows: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """Count answers about single effects, and those that contain the truth, by largest set size.

    Args:
        rows: one row per answer.
        order: names of the diagnosers.
    """
    lines = []
    for name in order:
        own = select_single_effects(rows[rows["diagnoser"] == name])
        own = own[own["largest_set"] > 0]
        for (low, high), said in zip(SET_SIZE_BINS, SET_SIZE_LABELS, strict=True):
            part = own[own["largest_set"].between(low, high)]
            counted = compute_share(int(_within(part).sum()), len(part))
            lines.append({"diagnoser": name, "largest_set": said, **counted})
    return pd.DataFrame(lines)


def build_cost_table(
    rows: pd.DataFrame, order: Sequence[str], training: Sequence[dict[str, str]]
) -> pd.DataFrame:
    """Build the table of costs per answer and of training costs.

    Args:
        rows: one row per answer.
        order: names of the diagnosers.
        training: rows of training.csv.
    """
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


def build_pair_table(rows: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """Compare each diagnoser with simgap on the same cases, Holm-corrected within each metric.

    Args:
        rows: one row per answer.
        order: names of the diagnosers.
    """
    asked: tuple[tuple[str, Callable[[pd.DataFrame], pd.DataFrame], RowPredicate], ...] = (
        ("named", select_single_effects, lambda part: part["found_class"]),
        ("named, alone", select_single_effects, lambda part: part["outcome"] == "right"),
        ("no false alarm", select_clean, lambda part: ~part["alarm"]),
    )
    lines = []
    for metric, of, right in asked:
        part = of(rows)
        wide = part.assign(right=right(part)).pivot(
            index="question", columns="diagnoser", values="right"
        )
        for name in order:
            if name == REFERENCE_DIAGNOSER or REFERENCE_DIAGNOSER not in wide or name not in wide:
                continue
            both = wide[[REFERENCE_DIAGNOSER, name]].dropna()
            ours = int((both[REFERENCE_DIAGNOSER].astype(bool) & ~both[name].astype(bool)).sum())
            theirs = int((~both[REFERENCE_DIAGNOSER].astype(bool) & both[name].astype(bool)).sum())
            lines.append(
                {
                    "metric": metric,
                    "diagnoser": name,
                    "questions": len(both),
                    "only_simgap": ours,
                    "only_other": theirs,
                    "p_value": compute_mcnemar_p_value(ours, theirs),
                }
            )
    columns = ["metric", "diagnoser", "questions", "only_simgap", "only_other", "p_value"]
    frame = pd.DataFrame(lines, columns=columns)
    held = [
        correct_holm(part["p_value"].tolist()) for _, part in frame.groupby("metric", sort=False)
    ]
    frame["p_holm"] = [value for part in held for value in part]
    return frame


def compute_mcnemar_p_value(ours: int, theirs: int) -> float:
    """Compute the p-value of McNemar's exact test, two-sided.

    Args:
        ours: number of cases that only the first diagnoser answered correctly.
        theirs: number of cases that only the second diagnoser answered correctly.
    """
    from scipy.stats import binomtest

    if not ours + theirs:
        return 1.0
    return float(binomtest(ours, ours + theirs).pvalue)


def correct_holm(chances: Sequence[float]) -> list[float]:
    """Correct p-values for multiple tests by Holm's method; the order is kept."""
    order = np.argsort(chances, kind="stable")
    corrected = np.ones(len(chances))
    highest = 0.0
    for rank, place in enumerate(order.tolist()):
        highest = max(highest, min(1.0, (len(chances) - rank) * chances[place]))
        corrected[place] = highest
    return [float(value) for value in corrected]


TableRow = dict[str, Any]


def index_by_diagnoser(frame: pd.DataFrame, metric: str = "") -> dict[str, TableRow]:
    """Index the rows of a table by diagnoser.

    Args:
        frame: table with a column diagnoser.
        metric: metric whose rows are used; empty for a table without a column metric.
    """
    if metric:
        frame = frame[frame["metric"] == metric]
    lines = [{str(key): value for key, value in line.items()} for line in frame.to_dict("records")]
    return {str(line["diagnoser"]): line for line in lines}


def select_fully_answered_cases(rows: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """Select the cases that every diagnoser has answered, so that comparisons are fair.

    Args:
        rows: one row per answer.
        order: names of the diagnosers.
    """
    counts = rows.groupby("question")["diagnoser"].nunique()
    whole = counts.index[counts == len(order)]
    chosen: pd.DataFrame = rows[rows["question"].isin(whole)]
    return chosen


def build_all_tables(
    rows: pd.DataFrame, order: Sequence[str], training: Sequence[dict[str, str]]
) -> dict[str, pd.DataFrame]:
    """Build every table, by the name of its file.

    Args:
        rows: one row per answer.
        order: names of the diagnosers.
        training: rows of training.csv.
    """
    return {
        "table": build_metric_table(rows, order),
        "groups": build_group_table(rows, order),
        "power": build_power_table(rows, order),
        "confusion": build_confusion_table(rows, order),
        "calibration": build_calibration_table(rows, order),
        "sets": build_set_size_table(rows, order),
        "costs": build_cost_table(rows, order, training),
        "pairs": build_pair_table(rows, order),
    }
