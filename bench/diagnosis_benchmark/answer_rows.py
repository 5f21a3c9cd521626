"""Result rows: one row per answer with its case, true causes, answer and grade."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import pandas as pd

from bench.diagnosis_benchmark.answer_store import AnswersByCase
from bench.diagnosis_benchmark.case_generation.benchmark_case import BenchmarkCase
from bench.diagnosis_benchmark.grading import grade_answer

CASE_COLUMNS = ("noise", "stated", "rate", "seconds", "runs", "source", "driven", "size", "beyond")
"""Attributes of a case that are columns of a result row."""
SKIPPED_STATUS = "skipped"
"""Status and outcome of a case that the diagnoser does not support."""
RUN_SECONDS_COLUMN = "run_seconds"
"""Column of the length of a run; the column `seconds` is the time of an answer."""


def build_answer_rows(answered: AnswersByCase, diagnosers: Sequence[str]) -> pd.DataFrame:
    """Build the result rows, ordered by diagnoser and then by case.

    Args:
        answered: stored answers.
        diagnosers: names of the diagnosers.
    """
    rows = [row for name in diagnosers for row in _iterate_rows(name, answered)]
    return pd.DataFrame(rows)


def _iterate_rows(diagnoser: str, answers: AnswersByCase) -> Iterator[dict[str, Any]]:
    """Yield the result rows of one diagnoser, ordered by the name of the case.

    A case is left out if it was not drawn (its stored document has no hidden effects) or if this
    diagnoser has not answered it.

    Args:
        diagnoser: name of the diagnoser.
        answers: stored answers by name of the case.
    """
    for question, answer in sorted(answers.items()):
        # The case could not be drawn, or its worker was lost before it was drawn.
        if "effects" not in answer["item"] or diagnoser not in answer["rows"]:
            continue
        yield build_answer_row(
            question, BenchmarkCase.from_json(answer["item"]), answer["rows"][diagnoser]
        )


def build_answer_row(
    question: str, case: BenchmarkCase, stored_answer: Mapping[str, Any]
) -> dict[str, Any]:
    """Build the result row of one answer: its case, true causes, answer, grade and cost.

    The rows of all answers are the file items.csv, from which all tables and figures are computed.

    Args:
        question: name of the case.
        case: the case with its true causes.
        stored_answer: stored answer of one diagnoser, with its status, reason and cost.

    Returns:
        Values by column. ``found`` and ``found_class`` tell whether the cause was identified
        without and with equivalent effects counted as one. ``alarm`` tells whether the diagnoser
        says that something is missing; a missing answer counts as an alarm. ``intervals`` is the
        number of closed 95 % intervals, ``holding`` how many of them contain the true value.
    """
    answer = stored_answer["answer"]
    grade = grade_answer(case, answer)
    known_coverage = [covered for covered in grade.covered.values() if covered is not None]
    causes = answer["causes"] if answer else []
    case_columns = {name: getattr(case, name) for name in CASE_COLUMNS}
    case_columns[RUN_SECONDS_COLUMN] = case_columns.pop("seconds")
    return {
        "question": question,
        "diagnoser": stored_answer["diagnoser"],
        "kind": case.kind,
        "system": case.system,
        "hidden": " + ".join(case.effects),
        **case_columns,
        "channels": " ".join(case.channels),
        "status": stored_answer["status"],
        "reason": (stored_answer["reason"].strip().splitlines() or [""])[-1][:200],
        "verdict": answer["verdict"] if answer else "",
        "named": grade.named,
        "outcome": SKIPPED_STATUS if stored_answer["status"] == SKIPPED_STATUS else grade.outcome,
        "set_size": grade.set_size,
        "class_size": grade.class_size,
        "largest_set": max((1 + len(c["alternatives"]) for c in causes), default=0),
        "found": grade.is_correct,
        "found_class": grade.is_correct_up_to_equivalence,
        "alarm": answer is None or answer["verdict"] != "adequate",
        "p_value": answer["p_value"] if answer else None,
        "intervals": len(known_coverage),
        "holding": sum(known_coverage),
        "simulations": stored_answer["simulations"],
        "seconds": stored_answer["seconds"],
        "processor_seconds": stored_answer["processor_seconds"],
        "trusted": stored_answer["trusted"],
    }
