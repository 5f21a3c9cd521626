"""Server side of an isolated diagnoser: write the recording, call the diagnoser, send its answer.

The harness cannot trust anything from this process once the code of a plugin has run in it. The
simulations are counted in this process, so a malicious plugin could change their number. It cannot
obtain the true causes, because no process of a diagnoser ever contains them.
"""

from __future__ import annotations

import inspect
import time
import traceback
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from bench.benchmark.isolation.isolation_layers import AccessPolicy
from bench.benchmark.isolation.message_channel import (
    MAX_HARNESS_MESSAGE_BYTES,
    MAX_TEXT_BYTES,
    MessageChannel,
    MessageKind,
    PeerClosedError,
    pack_arrays,
    unpack_arrays,
)
from bench.benchmark.isolation.tuner_server import load_class
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
from sims.core.simulator import Array
from sims.recording.recording import read_recording
from sims.system_simulator import SystemSimulator

_MAX_DOCUMENT_BYTES = 1 << 30
"""Maximum size in bytes of a case document."""


def serve_requests(
    channel: MessageChannel, policy: AccessPolicy, first_document: list[str]
) -> None:
    """Answer requests of the harness until the channel is closed.

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


_USED_SIMULATIONS_KEY = "simulations"
"""Name of the array with the number of simulations that a training used."""


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
