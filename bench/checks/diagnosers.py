"""Conformance checks of diagnosers, independent of their method.

The checks use two small recordings of a slider, one with strong linear drag and one without a
hidden cause. Accuracy is not checked but measured (`simgap compare diagnosis-small`).
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.checks.base import (
    Check,
    CheckError,
    NotApplicable,
    global_random_state_untouched,
    require,
)
from bench.diagnoser import Answer, Case, Diagnoser, Lesson, library_of, names_in
from bench.recordings.simulate import SimulatedRecording, Wish, make
from bench.sealing.wire import packed
from sims import effects
from sims.base import Array, InputError
from sims.recording.recording import Recording, read_recording
from sims.simulated import Simulated
from sims.tally import TALLY, SpentError

SYSTEM = "slider"
BUDGET = 60_000
"""Simulation budget of an answer."""
FEW = 40
"""Simulation budget that is too small for a useful answer."""
LESSON = 12_000
"""Simulation budget of the training; small, so that the suite is fast."""
SECONDS = 60.0
"""Time limit of an answer, seconds."""

LEARNED: dict[type[Diagnoser], dict[str, Array]] = {}
"""Trained state of each diagnoser in this process."""


@cache
def _made(hidden: bool) -> SimulatedRecording:
    """Simulate a recording of the slider, with strong drag or without a hidden cause."""
    return make(
        Wish(
            system=SYSTEM,
            effects={"drag.linear": (0.6,)} if hidden else {},
            noise={"x": 0.002},
            observe=("x",),
            inputs={"u": "sine:2:0.7"},
            runs=3,
            seconds=2.0,
            rate=50.0,
            engine="batch",
            seed=7,
        )
    )


@contextmanager
def _case(
    kind: type[Diagnoser], hidden: bool = True, budget: int = BUDGET, missing: bool = False
) -> Iterator[Case]:
    """Make a case as a diagnoser gets it; its folder is deleted afterwards."""
    made = _made(hidden)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recording.csv"
        made.write(path)
        path.with_suffix(".truth.toml").unlink()
        simulator = type(made.simulator)
        assert issubclass(simulator, Simulated)
        recording = read_recording(path, simulator)
        if missing:
            recording = _with_gaps(recording)
        TALLY.begin(budget)
        try:
            yield Case(
                path,
                recording,
                simulator,
                library_of(simulator, recording),
                np.random.default_rng(3),
                budget,
                SECONDS,
                _learned(kind),
            )
        finally:
            TALLY.begin()


def _with_gaps(recording: Recording) -> Recording:
    """Return the recording with every seventh sample missing."""
    runs = []
    for run in recording.runs:
        channels = {name: values.copy() for name, values in run.channels.items()}
        for values in channels.values():
            values[3::7] = np.nan
        runs.append(replace(run, channels=channels))
    return replace(recording, runs=tuple(runs))


def _learned(kind: type[Diagnoser]) -> dict[str, Array]:
    """Train a diagnoser with a small budget, once per process."""
    if not kind.learned:
        return {}
    if kind not in LEARNED:
        arrays, _ = _taught(kind)
        LEARNED[kind] = arrays
    return LEARNED[kind]


def _taught(kind: type[Diagnoser]) -> tuple[dict[str, Array], int]:
    simulator = type(_made(False).simulator)
    assert issubclass(simulator, Simulated)
    library = effects.library(simulator.system)
    TALLY.begin(LESSON)
    try:
        lesson = Lesson(simulator, library, np.random.default_rng(5), LESSON)
        return {n: np.asarray(a) for n, a in kind().train(lesson).items()}, TALLY.used
    finally:
        TALLY.begin()


class _Run(NamedTuple):
    """Answer of a diagnoser and side effects of the diagnosis.

    Attributes:
        answer: the answer.
        foreign: named effects that the recording could not show.
        changed: whether the recording or its files were changed.
        touched: description of changes of the global random state; empty for none.
    """

    answer: Answer
    foreign: tuple[str, ...]
    changed: bool
    touched: str


@cache
def _asked(kind: type[Diagnoser], hidden: bool = True, turn: int = 0) -> _Run:  # noqa: ARG001
    """Run a diagnoser; the result is cached for several checks, once for each value of `turn`."""
    with _case(kind, hidden) as case:
        before, touched = _bytes(case), ""
        answers: list[Answer] = []
        try:
            with global_random_state_untouched(f"case.rng in {kind.__name__}.diagnose"):
                answers.append(_answer(kind, case))
        except CheckError as error:
            # Without an answer, there is nothing else to check.
            if not answers:
                raise
            touched = str(error)
        (answer,) = answers
        names = {name for group in names_in(answer) for name in group}
        foreign = tuple(sorted(names - set(case.library)))
        return _Run(answer, foreign, _bytes(case) != before, touched)


def _answer(kind: type[Diagnoser], case: Case) -> Answer:
    """Run a diagnoser and validate its answer.

    Raises:
        CheckError: the result is not a valid answer.
    """
    given = kind().diagnose(case)
    try:
        return Answer.of(given)
    except InputError as error:
        look = f"{kind.__name__}.diagnose"
        raise CheckError(f"expected an answer; found {error}; see {look}") from None


def _bytes(case: Case) -> list[bytes]:
    arrays = [
        array.tobytes()
        for run in case.recording.runs
        for array in (run.times, *run.channels.values(), *run.inputs.values())
    ]
    return [*arrays, case.path.read_bytes(), case.path.with_suffix(".toml").read_bytes()]


def check_answers(kind: type[Diagnoser]) -> None:
    """Check that the diagnoser answers about a recording with a cause, and about one without."""
    for hidden in (True, False):
        answer = _asked(kind, hidden).answer
        empty = answer.verdict in ("named", "ambiguous") and not answer.causes
        require(not empty, "causes where something is named", answer.document(), kind.__name__)


def check_names_what_there_is(kind: type[Diagnoser]) -> None:
    """Check that named effects are observable in the recording, and occur once in a set."""
    run, look = _asked(kind), f"{kind.__name__}.diagnose"
    require(not run.foreign, "names of case.library", run.foreign, look)
    double = [names for names in names_in(run.answer) if len(set(names)) < len(names)]
    require(not double, "each effect once in a set", double, look)


def check_same_answer_again(kind: type[Diagnoser]) -> None:
    """Check that the same random seed gives the same answer."""
    first, again = (_asked(kind, turn=turn).answer.document() for turn in (0, 1))
    require(first == again, "the same answer again", again, f"case.rng in {kind.__name__}")


def check_leaves_the_recording_alone(kind: type[Diagnoser]) -> None:
    """Check that neither the arrays nor the files of the recording are changed."""
    require(not _asked(kind).changed, "the recording as it was", "another one", kind.__name__)


def check_leaves_global_chance_alone(kind: type[Diagnoser]) -> None:
    """Check that all random numbers come from case.rng."""
    if said := _asked(kind).touched:
        raise CheckError(said)


def check_keeps_to_its_budget(kind: type[Diagnoser]) -> None:
    """Check that the diagnoser answers with a tiny budget, or stops with the budget error."""
    with _case(kind, budget=FEW) as case:
        try:
            _answer(kind, case)
        except SpentError:
            return
        used = case.used
    require(used <= FEW, f"at most {FEW} simulations", used, f"{kind.__name__}.diagnose")


def check_takes_missing_samples(kind: type[Diagnoser]) -> None:
    """Check that the diagnoser answers about a recording with missing samples."""
    with _case(kind, missing=True) as case:
        _answer(kind, case)


def check_learns_within_its_budget(kind: type[Diagnoser]) -> NotApplicable | None:
    """Check that the training stays within its budget and results in numeric arrays."""
    if not kind.learned:
        return NotApplicable("it does not learn")
    arrays, used = _taught(kind)
    require(used <= LESSON, f"at most {LESSON} simulations", used, f"{kind.__name__}.train")
    try:
        packed(arrays)
    except ValueError as error:
        raise CheckError(
            f"expected arrays of numbers; found {error}; see {kind.__name__}"
        ) from None
    LEARNED.setdefault(kind, arrays)
    return None


DIAGNOSER_CHECKS: tuple[Check, ...] = (
    check_answers,
    check_names_what_there_is,
    check_same_answer_again,
    check_leaves_the_recording_alone,
    check_leaves_global_chance_alone,
    check_keeps_to_its_budget,
    check_takes_missing_samples,
    check_learns_within_its_budget,
)
"""All checks of diagnosers, in the order in which they run."""

DIAGNOSER_NEEDS: Mapping[Check, tuple[Check, ...]] = dict.fromkeys(
    DIAGNOSER_CHECKS[1:], (check_answers,)
)
"""For each check, the checks that must pass for it to be meaningful."""
