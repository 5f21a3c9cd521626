"""Evaluation of one case with several diagnosers, each in its own process; runs in a worker.

The worker draws the case and renders its recording. The process of a diagnoser
(`diagnoser_process`) receives the texts of the recording's files through a pipe, and nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

from bench.benchmark.isolation.process_errors import RunEndedError
from bench.benchmark.isolation.tuner_processes import TunerSpec
from bench.benchmark.runner.retry_after_kill import retry_if_killed
from bench.benchmark.runner.trained_weights import read_weights
from bench.core.random_streams import make_seed_words
from bench.diagnosis_benchmark.case_generation.benchmark_case import BenchmarkCase
from bench.diagnosis_benchmark.case_set import CaseSpec, render_recording
from bench.diagnosis_benchmark.diagnoser_process import (
    AnswerLimits,
    diagnose_in_process,
    diagnose_isolated,
)
from sims.core.simulator import InputError

BUDGET_EXCEEDED_REASON = "it asked for more simulations than are allowed"
"""Reason of a missing answer when the diagnoser exceeded its simulation budget."""


@dataclass(frozen=True)
class EvaluatedDiagnoser:
    """Diagnoser that is evaluated.

    Attributes:
        label: name in tables.
        code: where its code is.
        learned: files with trained arrays, by system.
        trusted: whether it runs in this process.
    """

    label: str
    code: TunerSpec
    learned: Mapping[str, Path]
    trusted: bool = False


def evaluate_case(
    question: dict[str, Any],
    seed: int,
    salt: str,
    known_case: dict[str, Any] | None,
    examined: Sequence[EvaluatedDiagnoser],
    limits: AnswerLimits,
    hidden: tuple[str, ...],
) -> dict[str, Any]:
    """Draw a case and evaluate it with several diagnosers, one after the other.

    The case is drawn anew from its specification (``question``) and the salt unless it is known.
    Each diagnoser receives a request with the recording of the case, but not its true causes.

    Args:
        question: case specification as JSON.
        seed: seed of the public case set.
        salt: salt from which cases are drawn.
        known_case: the case as JSON if it was already drawn, {} if its cause was found to be
            unobservable, None if it was not drawn yet.
        examined: diagnosers to evaluate.
        limits: limits of each answer.
        hidden: folders that no diagnoser may read.

    Returns:
        JSON document with the name of the case (``question``), the case with its true causes
        (``item``, {} if the sensors cannot show the cause), and one row per diagnoser (``rows``).
    """
    case_spec = CaseSpec.from_document(question)
    if known_case is None:
        case = case_spec.draw_case(seed, salt)
    else:
        case = BenchmarkCase.from_document(known_case) if known_case else None
    if case is None:
        return {"question": case_spec.name, "item": {}, "rows": []}
    recording_text = render_recording(case)
    rows = []
    for diagnoser in examined:
        request = {
            "wanted": diagnoser.code.describe(),
            "table": recording_text.table,
            "description": recording_text.description,
            "beside": recording_text.extra_files,  # model file of a robot, in the same folder
            "system": case.system,
            "budget": limits.simulations,
            "seconds": limits.seconds,
            "seed": make_seed_words("diagnosis", diagnoser.label, case_spec.name).tolist(),
        }
        rows.append(_ask_diagnoser(diagnoser, request, case_spec.name, limits, hidden))
    return {"question": case_spec.name, "item": case.to_document(), "rows": rows}


def make_failed_answers(
    question: CaseSpec, labels: Sequence[str], error: BaseException
) -> dict[str, Any]:
    """Make failed answers for a case whose worker died or exceeded its time limit.

    Args:
        question: specification of a case: system, hidden cause, size and seed.
        labels: labels of the diagnosers.
        error: error of the worker.

    Returns:
        Document as `evaluate_case` returns it: name of the case (``question``), the case
        (``item``), of which only the name is known, and one row per diagnoser.

    Raises:
        InputError: `error` is one: a wrong input stops the study.
    """
    if isinstance(error, InputError):
        raise error
    status = "timeout" if isinstance(error, TimeoutError) else "crashed"
    rows = [
        {
            "question": question.name,
            "diagnoser": label,
            "status": status,
            "reason": str(error),
            "answer": None,
            "simulations": 0,
            "processor_seconds": None,
            "seconds": None,
            "trusted": False,
        }
        for label in labels
    ]
    return {"question": question.name, "item": {"name": question.name}, "rows": rows}


def _ask_diagnoser(
    diagnoser: EvaluatedDiagnoser,
    request: dict[str, Any],
    question: str,
    limits: AnswerLimits,
    hidden: tuple[str, ...],
) -> dict[str, Any]:
    """Run one diagnoser on a case and return its row, with the reason if it gave no answer.

    Args:
        diagnoser: the diagnoser.
        request: request of the diagnoser, with the texts of the recording; it does not contain the
            true causes.
        question: name of the case.
        limits: limits of the answer.
        hidden: folders that the diagnoser may not read.

    Returns:
        The row as it is stored: status (done, skipped, or how the process ended), answer and costs.
    """
    row: dict[str, Any] = {
        "question": question,
        "diagnoser": diagnoser.label,
        "trusted": diagnoser.trusted,
    }
    weights = diagnoser.learned.get(request["system"])
    trained_arrays = read_weights(weights) if weights else {}
    started_at = perf_counter()
    try:
        if diagnoser.trusted:
            answer = diagnose_in_process(request, trained_arrays)
        else:
            answer = retry_if_killed(
                lambda: diagnose_isolated(diagnoser.code, request, trained_arrays, limits, hidden)
            )
        skipped = answer.pop("skipped", "")
        outcome = {"status": "skipped" if skipped else "done", "reason": skipped, **answer}
    except RunEndedError as ended:
        outcome = {"status": ended.status, "reason": _format_failure_reason(ended.reason)}
    # An isolated answer has measured its time without the start of the process; it replaces this.
    seconds = perf_counter() - started_at
    empty_answer = {"answer": None, "simulations": 0, "processor_seconds": None, "seconds": seconds}
    return {**row, **empty_answer, **outcome}


def _format_failure_reason(text: str) -> str:
    """Return the reason why a diagnoser failed, marked if it exceeded its simulation budget.

    Args:
        text: reason of the failure, mostly a traceback. If the budget was exceeded, it contains the
            name of that exception, and gets `BUDGET_EXCEEDED_REASON` as its first line.
    """
    if "sims.core.simulation_counter.SimulationBudgetExceededError" in text:
        return f"{BUDGET_EXCEEDED_REASON}\n{text}"
    return text
