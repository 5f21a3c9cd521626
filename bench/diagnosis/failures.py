"""What a diagnoser got wrong, answer by answer, and who got it right."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from bench.diagnosis.tables import AT_LEAST

COLUMNS = (
    "diagnoser",
    "question",
    "kind",
    "system",
    "hidden",
    "size",
    "noise",
    "rate",
    "runs",
    "status",
    "verdict",
    "named",
    "outcome",
    "largest_set",
    "right_by",
)
"""Of the table: those of items.csv, and who answered rightly."""


def right(rows: pd.DataFrame) -> pd.Series[bool]:
    """Whether each answer is what it should be: of a clean recording no alarm, of causes all named
    alone or in sets of at most two, of a foreign cause that none of the library's explains it.
    """
    by_kind = {
        "clean": ~rows["alarm"].astype(bool),
        "foreign": rows["outcome"] == "right",
    }
    good = rows["found_class"].astype(bool)
    for kind, judged in by_kind.items():
        good = good.where(rows["kind"] != kind, judged)
    return good & (rows["status"] == "done")


def counted(rows: pd.DataFrame) -> pd.DataFrame:
    """The answers that a board counts: all but those about effects smaller than one noise."""
    return rows[(rows["kind"] != "single") | (rows["size"] >= AT_LEAST)]


def failures(rows: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """A row for each answer that is counted and not right, by diagnoser and question."""
    asked = counted(rows)
    asked = asked.assign(right=right(asked))
    good = asked[asked["right"]].groupby("question")["diagnoser"].agg(list).to_dict()
    wrong = asked[~asked["right"]].copy()
    by = [[name for name in order if name in good.get(q, ())] for q in wrong["question"]]
    wrong["right_by"] = [" ".join(names) or "nobody" for names in by]
    wrong["place"] = wrong["diagnoser"].map({name: i for i, name in enumerate(order)})
    chosen: pd.DataFrame = wrong.sort_values(["place", "kind", "question"])[list(COLUMNS)]
    return chosen.reset_index(drop=True)
