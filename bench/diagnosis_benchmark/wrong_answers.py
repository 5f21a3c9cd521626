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
    is_right = rows["found_class"].astype(bool)
    for kind, is_right_for_kind in by_kind.items():
        is_right = is_right.where(rows["kind"] != kind, is_right_for_kind)
    return is_right & (rows["status"] == "done")


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
    graded_rows = select_graded_answers(rows)
    graded_rows = graded_rows.assign(right=is_correct(graded_rows))
    correct_names = (
        graded_rows[graded_rows["right"]].groupby("question")["diagnoser"].agg(list).to_dict()
    )
    wrong_rows = graded_rows[~graded_rows["right"]].copy()
    correct_by_case = [
        [name for name in order if name in correct_names.get(q, ())] for q in wrong_rows["question"]
    ]
    wrong_rows["right_by"] = [" ".join(names) or "nobody" for names in correct_by_case]
    wrong_rows["place"] = wrong_rows["diagnoser"].map({name: i for i, name in enumerate(order)})
    failure_table: pd.DataFrame = wrong_rows.sort_values(["place", "kind", "question"])[
        list(FAILURE_COLUMNS)
    ]
    return failure_table.reset_index(drop=True)
