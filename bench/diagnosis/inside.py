"""Server side of an isolated diagnoser: write the recording, call the diagnoser, send its answer.

The harness cannot trust anything from this process once the code of a plugin has run in it. The
simulations are counted in this process, so a malicious plugin could change their number. It cannot
obtain the truth, because no process of a diagnoser ever contains it.
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

from bench.diagnoser import Answer, Case, Diagnoser, Lesson, library_of
from bench.recordings.inspection import kind_of
from bench.registry import simulators
from bench.sealing.inside import found
from bench.sealing.seals import Reach
from bench.sealing.wire import TEXT_LIMIT, Channel, GoneError, packed, unpacked
from sims import effects
from sims.base import Array
from sims.recording.recording import read_recording
from sims.simulated import Simulated
from sims.tally import TALLY

_LIMIT = 1 << 40
"""Maximum size in bytes of a message from the harness; large, because the harness is trusted."""
_DOCUMENT = 1 << 30
"""Maximum size in bytes of a case document."""


def serve(channel: Channel, reach: Reach, held: list[str]) -> None:
    """Answer requests of the harness until the channel is closed.

    Args:
        channel: message channel to the harness.
        reach: access policy of this process, with its own writable folder.
        held: sent in the first message of this process.
    """
    channel.send_document(b"R", held)
    learned: Mapping[str, Array] = {}
    with suppress(GoneError):
        while True:
            message = channel.receive(_LIMIT)
            try:
                match message.kind:
                    case b"L":
                        learned = unpacked(message.body)
                        channel.send(b"K")
                    case b"Q":
                        question = message.document(_DOCUMENT)
                        channel.send_document(b"A", asked(question, Path(reach.folder), learned))
                    case b"F":
                        arrays, used = taught(message.document(_DOCUMENT))
                        channel.send(b"L", *packed({**arrays, _USED: np.array([used])}))
            except GoneError:
                return
            except BaseException:
                said = traceback.format_exc().encode("utf-8", "replace")
                # BaseException includes SystemExit: the diagnoser caused it. Of a long text, only
                # the end is sent.
                channel.send(b"D", said[-TEXT_LIMIT // 2 :])


_USED = "simulations"
"""Name of the array with the number of simulations that a training used."""


def built(wanted: Mapping[str, Any]) -> Diagnoser:
    """Load a diagnoser from its module or file, and create it."""
    kind: type[Diagnoser] = found(dict(wanted), Diagnoser)
    return kind()


def simulator_of(system: str) -> type[Simulated]:
    """Return the simulator class of a system."""
    kind = simulators.get(system)
    assert inspect.isclass(kind)
    assert issubclass(kind, Simulated)
    return kind


def asked(
    question: Mapping[str, Any],
    folder: Path,
    learned: Mapping[str, Array],
    diagnoser: Diagnoser | None = None,
) -> dict[str, Any]:
    """Diagnose one case.

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
    diagnoser = diagnoser or built(question["wanted"])
    path = folder / "recording.csv"
    path.write_text(question["table"], encoding="utf-8")
    path.with_suffix(".toml").write_text(question["description"], encoding="utf-8")
    for name, text in question.get("beside", {}).items():
        (folder / name).write_text(text, encoding="utf-8")
    kind = kind_of(path, path)
    assert issubclass(kind, Simulated)
    if reason := diagnoser.cannot(kind):
        return {"answer": None, "simulations": 0, "processor_seconds": 0.0, "skipped": str(reason)}
    recording = read_recording(path, kind)
    case = Case(
        path,
        recording,
        kind,
        library_of(kind, recording),
        np.random.default_rng(question["seed"]),
        int(question["budget"]),
        float(question["seconds"]),
        learned,
    )
    TALLY.begin(case.budget)
    begun = time.process_time()
    try:
        answer = Answer.of(diagnoser.diagnose(case))
    finally:
        used, spent = TALLY.used, time.process_time() - begun
        TALLY.begin()
    return {"answer": answer.document(), "simulations": used, "processor_seconds": spent}


def taught(lesson: Mapping[str, Any]) -> tuple[Mapping[str, Array], int]:
    """Train a diagnoser for a system.

    Args:
        lesson: request with ``wanted``, ``system``, ``budget`` and ``seed``.

    Returns:
        The trained arrays by name, and the number of simulations used.
    """
    kind = simulator_of(lesson["system"])
    TALLY.begin(int(lesson["budget"]))
    try:
        arrays = built(lesson["wanted"]).train(
            Lesson(
                kind,
                effects.library(kind.system),
                np.random.default_rng(lesson["seed"]),
                int(lesson["budget"]),
            )
        )
        return {name: np.asarray(array) for name, array in arrays.items()}, TALLY.used
    finally:
        TALLY.begin()
