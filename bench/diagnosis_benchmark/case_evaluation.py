"""Evaluation of one case with several diagnosers, each in its own process; runs in a worker.

The worker draws the case and writes its recording. The process of a diagnoser receives the texts of
the recording's files through a pipe, and nothing else.
"""

from __future__ import annotations

import json
import tempfile
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

from bench.benchmark.isolation.message_channel import (
    MessageKind,
    ProtocolError,
    pack_arrays,
)
from bench.benchmark.isolation.process_errors import RunEndedError
from bench.benchmark.isolation.tuner_processes import (
    START_TIMEOUT_SECONDS,
    IsolatedProcess,
    TunerSpec,
)
from bench.benchmark.runner.retry_after_kill import retry_if_killed
from bench.benchmark.runner.trained_weights import read_weights
from bench.benchmark.runner.tuner_process_reuse import start_part_process
from bench.core.diagnoser import Answer
from bench.core.random_streams import make_seed_words
from bench.diagnosis_benchmark import diagnoser_process
from bench.diagnosis_benchmark.case_generation.recording_conditions import BenchmarkCase
from bench.diagnosis_benchmark.case_set import CaseSpec, render_recording
from sims.core.simulator import Array, InputError

PRELOAD_MODULE = "bench.diagnosis_benchmark.preload"
"""Module that is preloaded in the fork server."""
_MAX_ANSWER_BYTES = 1 << 20
"""Maximum size of an answer, bytes."""
_MAX_REASON_LENGTH = 200
"""Maximum length of the reason why a diagnoser does not support a case, characters."""
BUDGET_EXCEEDED_REASON = "it asked for more simulations than are allowed"
"""Reason of a missing answer when the diagnoser exceeded its simulation budget."""


@dataclass(frozen=True)
class AnswerLimits:
    """Limits of one answer.

    Attributes:
        simulations: maximum number of simulations with simgap's simulators.
        seconds: maximum elapsed time.
        memory: maximum memory, MiB; 0 for no limit.
    """

    simulations: int
    seconds: float
    memory: int = 0


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
            answer = _diagnose_in_process(request, trained_arrays)
        else:
            answer = retry_if_killed(
                lambda: _diagnose_isolated(diagnoser.code, request, trained_arrays, limits, hidden)
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


def _diagnose_in_process(
    request: dict[str, Any], trained_arrays: Mapping[str, Array]
) -> dict[str, Any]:
    """Run a trusted diagnoser in this process.

    Args:
        request: the case and its files, as the process of a diagnoser receives them.
        trained_arrays: arrays of a learned diagnoser, by name.

    Returns:
        Answer, number of simulations and processor time; or the reason in ``skipped`` if the
        diagnoser does not support the simulator.

    Raises:
        RunEndedError: the diagnoser failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        try:
            return diagnoser_process.diagnose_case(request, Path(folder), trained_arrays)
        except Exception:
            traceback.print_exc()
            raise RunEndedError("crashed", traceback.format_exc()) from None


def _diagnose_isolated(
    code: TunerSpec,
    request: dict[str, Any],
    trained_arrays: Mapping[str, Array],
    limits: AnswerLimits,
    hidden: tuple[str, ...],
) -> dict[str, Any]:
    """Run a diagnoser in an isolated process and validate its answer.

    The process ends after this answer, so that nothing passes from one case to the next. Its
    messages have a kind of one letter: L sends the trained arrays, Q the case, and A is the answer.
    The time limit begins with the case; starting the process and loading the arrays do not count.

    Args:
        code: where the code of the diagnoser is.
        request: request with the texts of the recording.
        trained_arrays: trained arrays; empty if the diagnoser needs no training.
        limits: limits of the answer.
        hidden: folders that the diagnoser may not read.

    Returns:
        Answer, number of simulations, processor time and elapsed seconds; or the reason in
        ``skipped`` if the diagnoser does not support the simulator.

    Raises:
        RunEndedError: the diagnoser failed.
    """
    # Only the recording of a robot has further files: its model file.
    extra_modules = ("mujoco",) if request["beside"] else ()
    child = start_diagnoser_process(code, limits.memory, hidden, extra_modules)
    try:
        if trained_arrays:
            deadline = perf_counter() + START_TIMEOUT_SECONDS
            child.send(MessageKind.WEIGHTS, *pack_arrays(trained_arrays), deadline=deadline)
            child.receive(deadline=deadline)  # the process confirms that it has the arrays
        started_at = perf_counter()
        deadline = started_at + limits.seconds
        child.send(MessageKind.QUESTION, json.dumps(request).encode(), deadline=deadline)
        message = child.receive(_MAX_ANSWER_BYTES, deadline)
        seconds = perf_counter() - started_at
        try:
            if message.kind != MessageKind.ANSWER:
                raise ProtocolError("it gave no answer")
            answer = _validate_answer(message.to_document(_MAX_ANSWER_BYTES), limits)
        except (ProtocolError, InputError, KeyError, TypeError, ValueError) as error:
            raise child.fail_with_protocol_error(f"{error}"[:500]) from None
        return {**answer, "seconds": seconds}
    finally:
        child.end()


def _validate_answer(message: Any, limits: AnswerLimits) -> dict[str, Any]:
    """Validate the message of an isolated diagnoser, which may be malicious.

    Args:
        message: document that the process of the diagnoser sent.
        limits: limits of the answer, which the reported costs cannot exceed.

    Returns:
        Answer, number of simulations and processor time; or the reason in ``skipped`` if the
        diagnoser does not support the simulator.

    Raises:
        ProtocolError: the reported costs are impossible.
    """
    simulations, seconds = int(message["simulations"]), float(message["processor_seconds"])
    # A billion seconds are 32 years; NaN is refused, too.
    if not 0 <= simulations <= limits.simulations or not 0 <= seconds < 1e9:
        raise ProtocolError("it reported an impossible number of simulations")
    if skipped := str(message.get("skipped", ""))[:_MAX_REASON_LENGTH]:
        empty_answer = {"answer": None, "simulations": 0, "processor_seconds": 0.0}
        return {**empty_answer, "skipped": skipped}
    answer = Answer.of(message["answer"]).document()
    return {"answer": answer, "simulations": simulations, "processor_seconds": seconds}


def start_diagnoser_process(
    code: TunerSpec, memory: int, hidden: tuple[str, ...], extra_modules: tuple[str, ...] = ()
) -> IsolatedProcess:
    """Start the isolated process of a diagnoser from the fork server, and wait until it is ready.

    Args:
        code: where the code of the diagnoser is.
        memory: maximum memory, MiB; 0 for no limit.
        hidden: folders that the process must not read.
        extra_modules: further modules that the fork server loads first, such as MuJoCo for robots.

    Returns:
        The process; the caller ends it.
    """
    child = start_part_process(
        code,
        "bench.diagnosis_benchmark.diagnoser_process:serve_requests",
        memory,
        hidden,
        # MuJoCo starts a process while it is imported, which an isolated diagnoser must not do.
        [PRELOAD_MODULE, *extra_modules],
    )
    try:
        child.wait_until_ready()
    except BaseException:
        child.end()
        raise
    return child
