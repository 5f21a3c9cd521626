"""Run a diagnoser on a case, in an isolated process or, if it is trusted, in this one.

`diagnose_isolated` starts the isolated process from the harness, sends it the recording and
validates its answer. `serve_requests` is the other end of the channel, in the isolated process: it
writes the recording, calls the diagnoser and sends the answer.

The harness cannot trust anything from the isolated process once the code of a plugin has run in it.
The simulations are counted in that process, so a malicious plugin could change their number. It
cannot obtain the true causes, because no process of a diagnoser ever contains them.
"""

from __future__ import annotations

import inspect
import json
import tempfile
import time
import traceback
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from bench.benchmark.isolation.isolation_layers import AccessPolicy
from bench.benchmark.isolation.message_channel import (
    MAX_HARNESS_MESSAGE_BYTES,
    MAX_TEXT_BYTES,
    MessageChannel,
    MessageKind,
    PeerClosedError,
    ProtocolError,
    pack_arrays,
    unpack_arrays,
)
from bench.benchmark.isolation.process_errors import RunEndedError
from bench.benchmark.isolation.tuner_processes import (
    START_TIMEOUT_SECONDS,
    IsolatedProcess,
    TunerSpec,
)
from bench.benchmark.isolation.tuner_server import load_class
from bench.benchmark.runner.tuner_process_start import start_part_process
from bench.core.diagnoser import (
    Answer,
    Diagnoser,
    DiagnoserTrainingTask,
    DiagnosisCase,
    list_observable_effects,
)
from bench.core.plugin_registries import simulators
from bench.logs.recording_loading import get_simulator_class
from sims import effects
from sims.core.simulation_counter import SIMULATION_COUNTER
from sims.core.simulator import Array, InputError
from sims.recording.recording import read_recording
from sims.system_simulator import SystemSimulator

PRELOAD_MODULE = "bench.diagnosis_benchmark.preload"
"""Module that is preloaded in the fork server."""

_MAX_DOCUMENT_BYTES = 1 << 30
"""Maximum size of the document of a case, bytes."""

_MAX_ANSWER_BYTES = 1 << 20
"""Maximum size of an answer, bytes."""

_MAX_REASON_LENGTH = 200
"""Maximum length of the reason why a diagnoser does not support a case, characters."""

_USED_SIMULATIONS_KEY = "simulations"
"""Name of the array with the number of simulations that a training used."""


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


def diagnose_isolated(
    code: TunerSpec,
    request: dict[str, Any],
    trained_arrays: Mapping[str, Array],
    limits: AnswerLimits,
    hidden: tuple[str, ...],
) -> dict[str, Any]:
    """Run a diagnoser on a case in an isolated process and validate its answer.

    The process ends after this answer, so that nothing passes from one case to the next. Messages
    have a kind of `MessageKind`: WEIGHTS has the trained arrays, QUESTION the case, and ANSWER the
    answer. The time limit begins with the case; starting the process and loading the arrays do not
    count.

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


def diagnose_in_process(
    request: dict[str, Any], trained_arrays: Mapping[str, Array]
) -> dict[str, Any]:
    """Run a trusted diagnoser on a case in this process.

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
            return diagnose_case(request, Path(folder), trained_arrays)
        except Exception:
            traceback.print_exc()
            raise RunEndedError("crashed", traceback.format_exc()) from None


def serve_requests(
    channel: MessageChannel, policy: AccessPolicy, first_document: list[str]
) -> None:
    """Answer requests of the harness until the channel is closed; runs in the isolated process.

    The requests are WEIGHTS (trained arrays), QUESTION (a case) and FIT (a training) of
    `MessageKind`; the answers are READY, DONE (arrays received), ANSWER, WEIGHTS and FAILURE (with
    the traceback).

    Args:
        channel: message channel to the harness.
        policy: access policy of this process, with its own writable folder.
        first_document: names of the active isolation layers, which the first message reports.
    """
    channel.send_document(MessageKind.READY, first_document)
    trained_arrays: Mapping[str, Array] = {}
    with suppress(PeerClosedError):
        while True:
            message = channel.receive(MAX_HARNESS_MESSAGE_BYTES)
            try:
                match message.kind:
                    case MessageKind.WEIGHTS:
                        trained_arrays = unpack_arrays(message.body)
                        channel.send(MessageKind.DONE)
                    case MessageKind.QUESTION:
                        question = message.to_document(_MAX_DOCUMENT_BYTES)
                        diagnosis = diagnose_case(question, Path(policy.folder), trained_arrays)
                        channel.send_document(MessageKind.ANSWER, diagnosis)
                    case MessageKind.FIT:
                        arrays, used_simulations = train_diagnoser(
                            message.to_document(_MAX_DOCUMENT_BYTES)
                        )
                        channel.send(
                            MessageKind.WEIGHTS,
                            *pack_arrays(
                                {**arrays, _USED_SIMULATIONS_KEY: np.array([used_simulations])}
                            ),
                        )
            except PeerClosedError:
                return
            except BaseException:
                error_text = traceback.format_exc().encode("utf-8", "replace")
                # BaseException includes SystemExit: the diagnoser caused it. Of a long traceback,
                # only the end is sent: half of the limit for a text leaves room for its encoding.
                channel.send(MessageKind.FAILURE, error_text[-MAX_TEXT_BYTES // 2 :])


def diagnose_case(
    question: Mapping[str, Any],
    folder: Path,
    learned: Mapping[str, Array],
    diagnoser: Diagnoser | None = None,
) -> dict[str, Any]:
    """Run a diagnoser on one benchmark case and read its verdict.

    The recording is written to files and read again, as a user would have it, and the diagnoser is
    called with counted simulations.

    Args:
        question: request with ``wanted`` (name, module, file), ``table`` and ``description`` of the
            recording, ``budget``, ``seconds``, ``seed``, and ``beside``, texts of further files in
            the folder of the recording.
        folder: folder to which the recording is written.
        learned: trained arrays of the diagnoser.
        diagnoser: the diagnoser if it already exists.

    Returns:
        JSON document with the answer, the number of simulations and the processor time; with a
        reason in ``skipped`` if the diagnoser does not support the simulator.
    """
    diagnoser = diagnoser or load_diagnoser(question["wanted"])
    path = folder / "recording.csv"
    path.write_text(question["table"], encoding="utf-8")
    path.with_suffix(".toml").write_text(question["description"], encoding="utf-8")
    for name, text in question.get("beside", {}).items():
        (folder / name).write_text(text, encoding="utf-8")
    simulator_class = get_simulator_class(path)
    assert issubclass(simulator_class, SystemSimulator)
    # `cannot` returns why the diagnoser does not support a simulator; empty if it does.
    if reason := diagnoser.cannot(simulator_class):
        return {"answer": None, "simulations": 0, "processor_seconds": 0.0, "skipped": str(reason)}
    recording = read_recording(path, simulator_class)
    case = DiagnosisCase(
        path,
        recording,
        simulator_class,
        library=list_observable_effects(simulator_class, recording),
        rng=np.random.default_rng(question["seed"]),
        budget=int(question["budget"]),
        seconds=float(question["seconds"]),
        learned=learned,
    )
    # Every simulation of this process counts; one more than the budget raises an error.
    SIMULATION_COUNTER.reset(case.budget)
    started_at = time.process_time()
    try:
        answer = Answer.of(diagnoser.diagnose(case))
    finally:
        used_simulations = SIMULATION_COUNTER.used
        processor_seconds = time.process_time() - started_at
        SIMULATION_COUNTER.reset()
    return {
        "answer": answer.document(),
        "simulations": used_simulations,
        "processor_seconds": processor_seconds,
    }


def train_diagnoser(request: Mapping[str, Any]) -> tuple[Mapping[str, Array], int]:
    """Train a diagnoser for a system, with counted and limited simulations.

    Args:
        request: ``wanted`` (name and code of the diagnoser), ``system`` (name of the system),
            ``budget`` (maximum number of simulations) and ``seed``.

    Returns:
        The trained arrays by name, and the number of simulations used.
    """
    simulator_class = get_simulator(request["system"])
    task = DiagnoserTrainingTask(
        simulator_class,
        library=effects.list_effects_for(simulator_class.system),
        rng=np.random.default_rng(request["seed"]),
        budget=int(request["budget"]),
    )
    SIMULATION_COUNTER.reset(task.budget)
    try:
        arrays = load_diagnoser(request["wanted"]).train(task)
        return {name: np.asarray(array) for name, array in arrays.items()}, SIMULATION_COUNTER.used
    finally:
        SIMULATION_COUNTER.reset()


def load_diagnoser(specification: Mapping[str, Any]) -> Diagnoser:
    """Load a diagnoser from its module or file, and create it.

    Args:
        specification: name, module, and file of a plugin (empty for a module).
    """
    kind: type[Diagnoser] = load_class(dict(specification), Diagnoser)
    return kind()


def get_simulator(system: str) -> type[SystemSimulator]:
    """Return the simulator class of a system."""
    kind = simulators.get(system)
    assert inspect.isclass(kind)
    assert issubclass(kind, SystemSimulator)
    return kind
