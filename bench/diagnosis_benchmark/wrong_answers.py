"""Incorrect answers of each diagnoser, and the diagnosers that answered the same case correctly."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from bench.diagnosis_benchmark.result_tables import MIN_GRADED_SIZE

FAILURE_COLUMNS = (
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
"""Columns of the table of failures: a selection of items.csv, and who answered correctly."""


def is_correct(rows: pd.DataFrame) -> pd.Series[bool]:
    """Return whether each answer is correct.

    Correct is: no alarm for a clean recording; for hidden effects, all named alone or in sets of at
    most two, equivalent effects counted once; for an unmodelled cause, the statement that no effect
    of the library explains it.
    """
    by_kind = {
        "clean": ~rows["alarm"].astype(bool),
        "foreign": rows["outcome"] == "right",
    }
    good = rows["found_class"].astype(bool)
    for kind, judged in by_kind.items():
        good = good.where(rows["kind"] != kind, judged)
    return good & (rows["status"] == "done")


def select_graded_answers(rows: pd.DataFrame) -> pd.DataFrame:
    """Select the graded answers: all except those on single effects smaller than one noise."""
    return rows[(rows["kind"] != "single") | (rows["size"] >= MIN_GRADED_SIZE)]


def build_failure_table(rows: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """Build the table of incorrect graded answers, ordered by diagnoser, kind and case.

    The column ``right_by`` names the diagnosers that answered the same case correctly, or "nobody".

    Args:
        rows: one row per answer.
        order: names of the diagnosers.
    """
    asked = select_graded_answers(rows)
    asked = asked.assign(right=is_correct(asked))
    good = asked[asked["right"]].groupby("question")["diagnoser"].agg(list).to_dict()
    wrong = asked[~asked["right"]].copy()
    by = [[name for name in order if name in good.get(q, ())] for q in wrong["question"]]
    wrong["right_by"] = [" ".join(names) or "nobody" for names in by]
    wrong["place"] = wrong["diagnoser"].map({name: i for i, name in enumerate(order)})
    chosen: pd.DataFrame = wrong.sort_values(["place", "kind", "question"])[list(FAILURE_COLUMNS)]
    return chosen.reset_index(drop=True)
