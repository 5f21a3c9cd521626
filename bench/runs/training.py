"""Trains learned tuners once for each simulator and seed, and keeps what they learned as plain
tensors.

The file's name is a hash of everything that went in: the code that makes runs, the tuner's and
simulator's source and options, the training range and scenarios, budget, seed, the versions of the
packages that compute (`bench.runs.sources`). The file holds the same hash, so that one which was
put in another's place is noticed. Nothing is ever unpickled.
"""

from __future__ import annotations

import os
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from bench.problem.experiment import Entry, Experiment
from bench.problem.nuisance import Nuisance
from bench.problem.practice import Practice
from bench.problem.problem import Problem
from bench.problem.robots import kind_of
from bench.problem.seeds import stream_of
from bench.registry import tuners
from bench.runs.housing import housed, undisturbed
from bench.runs.school import school
from bench.runs.sources import (
    digest,
    effect_sources,
    recording_digest,
    rooms,
    source,
    versions,
    what_matters,
)
from bench.sealing.ended import EndedError
from bench.sealing.outside import Tuned, moved
from methods.base import Tuner, Watch
from sims.base import Array, InputError
from sims.files import replacing

_COUNTS = "__simulations_and_seconds__"
"""Name of the array that says what the training cost."""
_KEY = "__key__"
"""Name of the array that holds the key of what was trained."""
_REMEDY = "delete it to have it trained again"
"""What to do with a file that cannot be used; it is never repaired silently."""


MADE_AGAIN = "it was killed, and asked for other simulations when it was made again"
"""What ends one that is not the same again."""


class WeightsError(InputError):
    """A file of trained weights that cannot be used."""


@dataclass(frozen=True)
class Training:
    """What one training cost when it was done, and where its tensors lie; `found` where that was
    earlier.
    """

    path: Path
    simulations: int
    seconds: float
    found: bool = False


def build(entry: Entry) -> Tuner:
    """The tuner of an entry, with its options.

    Raises:
        InputError: an option that the tuner does not have, or a value that it refuses.
    """
    kind = tuners.get(entry.tuner)
    try:
        return kind(**entry.options)
    # Python says the former of an option that is not there, tuners the latter of a value.
    except (TypeError, ValueError) as error:
        raise InputError(f"tuner {entry.label}: {error}") from None


def folder() -> Path:
    """Where trained weights are kept: $SIMGAP_CACHE, else simgap/ in the user's cache folder."""
    if os.environ.get("SIMGAP_CACHE"):
        return Path(os.environ["SIMGAP_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "simgap"


NOT_OF_A_TRAINING = {
    "title": "words",
    "says": "words",
    "tags": "words",
    "error_channel": "what is reported of runs",
    "ranges": "targets are met after the training",
    "targets": "targets are met after the training",
    "same_targets_as": "targets are met after the training",
    "held_out": "targets are met after the training",
    "world": "makes the targets; tuners train in the simulator that they tune",
    "seeds": "how many trainings there are; each key has its own seed",
    "budget": "of a run",
    "timeout": "of a run",
    "memory": "of a run",
    "negligible_error": "ranks tuners when all runs are made",
    "identifiability": "is found beside the runs",
    "isolation": "of a run; a training has a process of its own",
    "salt": "targets are met after the training",
    "salt_sha256": "targets are met after the training",
    "recording": "where it lies; what it holds is hashed",
    "model": "where it lies; what it holds is hashed",
    "calibration": "what it comes to is in the settings of what is tuned",
    "shot": "what is done with a tuned model afterwards",
    "diagnosis": "who diagnoses what, where nothing is tuned",
    "sweep": "what is run sweeps over nothing; it has values of its own",
    "experiments": "what is run names no others",
    "nuisance": "matters to entries that are randomised alone, and is hashed with them",
    "tuners": "who else trains; the key has its own tuner with its options",
}
"""Keys of an experiment that change no trained weights, each with the reason; all others do."""


def key(experiment: Experiment, entry: Entry, seed: int) -> str:
    """The hash of everything that determines the trained weights.

    Raises:
        InputError: the source of the tuner or the simulator cannot be told.
    """
    simulator = kind_of(experiment)
    hashed = digest(
        what_matters(experiment, NOT_OF_A_TRAINING),
        recording_digest(experiment),
        entry.tuner,
        dict(entry.options),
        seed,
        [source(tuners.get(entry.tuner)), source(simulator)],
        effect_sources(experiment.settings),
        rooms(),
        versions(),
        *([dict(experiment.nuisance)] if entry.randomised else []),
        length=16,
    )
    return f"{entry.tuner}-{experiment.simulator}-{seed}-{hashed}"


@dataclass(frozen=True)
class Lesson:
    """One training to make.

    Attributes:
        entry: the tuner with its options.
        seed: of the training.
        tuned: the tuner, to be built in a process of its own; None where it is trusted.
        hidden: folders that this process must not reach.
    """

    entry: Entry
    seed: int
    tuned: Tuned | None = None
    hidden: tuple[str, ...] = ()

    def files(self) -> tuple[Path, ...]:
        """What must travel with it to another machine."""
        return (Path(self.tuned.file),) if self.tuned and self.tuned.file else ()

    def moved(self, places: Mapping[Path, Path]) -> Lesson:
        """The same where its files have other places."""
        return self if self.tuned is None else replace(self, tuned=moved(self.tuned, places))


def train(
    experiment: Experiment, lesson: Lesson, watch: Watch | None = None, anew: bool = False
) -> Training:
    """Train, or find trained: the tensors' file and what the training cost when it was done.

    Args:
        experiment: the training ground and budget.
        lesson: who is trained, and where.
        watch: looks on, if it comes to training.
        anew: train even where there are weights, and replace them.

    Raises:
        WeightsError: there is a file, and it is damaged or foreign.
        EndedError: the tuner failed in its process.
    """
    before: list[str] = []
    return undisturbed(lambda: _train(experiment, lesson, watch, anew, before))


def _train(
    experiment: Experiment, lesson: Lesson, watch: Watch | None, anew: bool, before: list[str]
) -> Training:
    entry, seed = lesson.entry, lesson.seed
    name = key(experiment, entry, seed)
    path = folder() / f"{name}.npz"
    if path.exists() and not anew:
        simulations, seconds = _checked(path, name)[_COUNTS]
        # Weights that do not fit must show now, and not in every run.
        _fitting(lesson, path)
        return Training(path, int(simulations), float(seconds), found=True)
    problem = Problem(experiment)
    # Tuners that train alike share a stream: a comparison of them has the same network.
    stream = stream_of(
        experiment.name, "fit", tuners.get(entry.tuner).trains_as or entry.tuner, seed
    )
    learn = _learned_here if lesson.tuned is None else _learned_apart
    rough = Nuisance(problem) if entry.randomised else None
    practice = _Repeated(problem, experiment.training_budget, before, rough)
    started = perf_counter()
    state = learn(lesson, practice, stream, watch)
    seconds = perf_counter() - started
    problem.close()
    if rough is not None:
        rough.close()
    # Beside the tensors, so that a file that was renamed or exchanged is noticed.
    about = {
        _COUNTS: np.array([practice.used, seconds]),
        _KEY: np.frombuffer(name.encode(), dtype=np.uint8),
    }
    _write(path, {**state, **about})
    return Training(path, practice.used, seconds)


class _Repeated(Practice):
    """A ground for a training that is made again after a kill and must ask for the same: who could
    have itself killed would else learn from the budget several times.
    """

    def __init__(
        self, problem: Problem, budget: int, before: list[str], nuisance: Nuisance | None = None
    ) -> None:
        super().__init__(problem, budget, nuisance)
        self._before, self._place = before, 0

    def simulate(self, rng: np.random.Generator, points: Array) -> Array:
        """As of any ground.

        Raises:
            EndedError: what is asked for is not what was asked for before the kill.
        """
        asked = digest(repr(rng.bit_generator.state), np.asarray(points).tobytes())
        if self._place == len(self._before):
            self._before.append(asked)
        elif self._before[self._place] != asked:
            raise EndedError("crashed", MADE_AGAIN)
        self._place += 1
        return super().simulate(rng, points)


def _learned_here(
    lesson: Lesson, practice: Practice, stream: NDArray[np.uint32], watch: Watch | None
) -> Mapping[str, Array]:
    """What a trusted tuner learns, in this process."""
    tuner = build(lesson.entry)
    tuner.watch = watch
    tuner.fit(practice, np.random.default_rng(stream), practice.budget)
    return tuner.state()


def _learned_apart(
    lesson: Lesson, practice: Practice, stream: NDArray[np.uint32], watch: Watch | None
) -> Mapping[str, Array]:
    """What a tuner learns in its own process; what it simulates is counted here."""
    assert lesson.tuned is not None
    with housed(lesson.tuned, lesson.seed, "run", lesson.hidden) as tuner:
        state = school(tuner.child, practice, stream, watch)
    # By such names the file is written, or says what it holds.
    taken = {"file", "allow_pickle", _COUNTS, _KEY} & set(state)
    if taken:
        raise EndedError("crashed", f"the tuner learned what cannot be kept by the names {taken}")
    return state


def _fitting(lesson: Lesson, path: Path) -> None:
    """Refuse weights that the tuner cannot take.

    Raises:
        WeightsError: it cannot.
    """
    if lesson.tuned is None:
        trained(lesson.entry, path)
        return
    try:
        with housed(lesson.tuned, lesson.seed, "run", lesson.hidden, state=weights_of(path)):
            return
    except EndedError as ended:
        said = ended.reason.strip().splitlines()[-1:]
        raise _not_of(path, lesson.entry, "".join(said)) from None


def _not_of(path: Path, entry: Entry, why: object) -> WeightsError:
    return WeightsError(f"{path}: not the weights of {entry.label}: {why}; {_REMEDY}")


def _write(path: Path, arrays: Mapping[str, Array | NDArray[np.uint8]]) -> None:
    """Write a whole file or none: several processes may train the same."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def trained(entry: Entry, path: Path) -> Tuner:
    """The tuner with the tensors of `path`.

    Raises:
        WeightsError: the file is missing, damaged, or foreign.
    """
    tuner = build(entry)
    try:
        tuner.restore(weights_of(path))
    except ValueError as error:
        raise _not_of(path, entry, error) from None
    return tuner


def weights_of(path: Path) -> dict[str, Array]:
    """The tensors of a file.

    Raises:
        WeightsError: the file is missing, damaged, or foreign.
    """
    state = _checked(path, path.stem)
    del state[_COUNTS], state[_KEY]
    return state


def _checked(path: Path, name: str) -> dict[str, Array]:
    """The arrays of a file of trained weights.

    Raises:
        WeightsError: it is missing, damaged, or was trained for something else than `name`.
    """
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            arrays = {member: file[member] for member in file.files}
    except (
        OSError,
        ValueError,
        EOFError,
        zipfile.BadZipFile,
        zlib.error,
        KeyError,
        AttributeError,
    ):
        raise WeightsError(
            f"{path}: expected trained weights, found none or a damaged file; {_REMEDY}"
        ) from None
    counts, held = arrays.get(_COUNTS, np.empty(0)), arrays.get(_KEY, np.empty(0))
    if (
        counts.shape != (2,)
        or counts.dtype != np.float64
        or held.dtype != np.uint8
        or held.ndim != 1
    ):
        raise WeightsError(
            f"{path}: expected trained weights, found arrays {sorted(arrays)[:4]}; {_REMEDY}"
        )
    found = held.tobytes().decode("utf-8", "replace")
    if found != name:
        raise WeightsError(
            f"{path}: expected the weights of {name}, found those of {found:.80}; {_REMEDY}"
        )
    return arrays
