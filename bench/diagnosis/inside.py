"""The diagnoser's side of the pipe: writes the recording into its own folder, asks the diagnoser,
and sends back what it says.

Nothing here can be trusted by the harness once a plugin's code has run beside it. The number of
simulations is counted in this process, where a plugin that wanted to could change it; what it could
not come by is the truth, which no process of a diagnoser ever holds.
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
"""What the harness sends is not bounded: it is trusted."""
_DOCUMENT = 1 << 30
"""Bytes of a question."""


def serve(channel: Channel, reach: Reach, held: list[str]) -> None:
    """Do what is asked until nobody asks any more."""
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
                # Also what asks to exit: it is the diagnoser's doing. A long text by its end.
                channel.send(b"D", said[-TEXT_LIMIT // 2 :])


_USED = "simulations"
"""The array that says how many simulations a training took."""


def built(wanted: Mapping[str, Any]) -> Diagnoser:
    """The diagnoser of this name, from its module or file."""
    kind: type[Diagnoser] = found(dict(wanted), Diagnoser)
    return kind()


def simulator_of(system: str) -> type[Simulated]:
    """The simulator of a system by its name."""
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
    """One answer, as JSON, or why there is to be none (``skipped``).

    Args:
        question: ``wanted`` (name, module, file), ``table`` and ``description`` of the recording,
            ``budget``, ``seconds``, ``seed``, and ``beside``, texts of files that lie beside it.
        folder: to write the recording to.
        learned: what the diagnoser has learned.
        diagnoser: built already.
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
    """What a diagnoser learns for a system, as arrays by name, and the simulations that it took.

    Args:
        lesson: ``wanted``, ``system``, ``budget``, ``seed``.
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
