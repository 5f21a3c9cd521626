"""The conformance suite of diagnosers: what every one of them must do, whatever its method.

They are checked on two small recordings of a slider, one with strong linear drag and one without
anything hidden. Nothing is asked about who is right: that is measured (`simgap compare
diagnosis-small`).
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
"""Simulations for an answer."""
FEW = 40
"""Simulations with which hardly anything can be done."""
LESSON = 12_000
"""Simulations to learn from: few, so that the suite stays quick."""
SECONDS = 60.0
"""For an answer."""

LEARNED: dict[type[Diagnoser], dict[str, Array]] = {}
"""What each diagnoser learned in this process."""


@cache
def _made(hidden: bool) -> SimulatedRecording:
    """A recording of the slider, with strong drag or with nothing hidden."""
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
    """A case as a diagnoser gets it, its folder gone afterwards."""
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
    """The recording with every seventh sample missing."""
    runs = []
    for run in recording.runs:
        channels = {name: values.copy() for name, values in run.channels.items()}
        for values in channels.values():
            values[3::7] = np.nan
        runs.append(replace(run, channels=channels))
    return replace(recording, runs=tuple(runs))


def _learned(kind: type[Diagnoser]) -> dict[str, Array]:
    """What a diagnoser learns from a small budget, once a process."""
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
    """One answer, and what was left behind.

    Attributes:
        answer: what was said.
        foreign: names that the recording could not show.
        changed: whether the recording or its files were.
        touched: what of the global random state was; empty for nothing.
    """

    answer: Answer
    foreign: tuple[str, ...]
    changed: bool
    touched: str


@cache
def _asked(kind: type[Diagnoser], hidden: bool = True, turn: int = 0) -> _Run:  # noqa: ARG001
    """A run that several checks look at; another turn is another run of the same."""
    with _case(kind, hidden) as case:
        before, touched = _bytes(case), ""
        answers: list[Answer] = []
        try:
            with global_random_state_untouched(f"case.rng in {kind.__name__}.diagnose"):
                answers.append(_answer(kind, case))
        except CheckError as error:
            # One that gave no answer has nothing else to be looked at.
            if not answers:
                raise
            touched = str(error)
        (answer,) = answers
        names = {name for group in names_in(answer) for name in group}
        foreign = tuple(sorted(names - set(case.library)))
        return _Run(answer, foreign, _bytes(case) != before, touched)


def _answer(kind: type[Diagnoser], case: Case) -> Answer:
    """What it says, checked.

    Raises:
        CheckError: it is no answer.
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
    """It answers about a recording with a cause in it, and about one without."""
    for hidden in (True, False):
        answer = _asked(kind, hidden).answer
        empty = answer.verdict in ("named", "ambiguous") and not answer.causes
        require(not empty, "causes where something is named", answer.document(), kind.__name__)


def check_names_what_there_is(kind: type[Diagnoser]) -> None:
    """What it names are effects that this recording could show, each once in a set."""
    run, look = _asked(kind), f"{kind.__name__}.diagnose"
    require(not run.foreign, "names of case.library", run.foreign, look)
    double = [names for names in names_in(run.answer) if len(set(names)) < len(names)]
    require(not double, "each effect once in a set", double, look)


def check_same_answer_again(kind: type[Diagnoser]) -> None:
    """Asked again with the same chance it says the same."""
    first, again = (_asked(kind, turn=turn).answer.document() for turn in (0, 1))
    require(first == again, "the same answer again", again, f"case.rng in {kind.__name__}")


def check_leaves_the_recording_alone(kind: type[Diagnoser]) -> None:
    """It changes neither the arrays that it is given nor the files."""
    require(not _asked(kind).changed, "the recording as it was", "another one", kind.__name__)


def check_leaves_global_chance_alone(kind: type[Diagnoser]) -> None:
    """All of its chance comes from case.rng."""
    if said := _asked(kind).touched:
        raise CheckError(said)


def check_keeps_to_its_budget(kind: type[Diagnoser]) -> None:
    """With hardly any simulations it answers, or stops in the error that says so."""
    with _case(kind, budget=FEW) as case:
        try:
            _answer(kind, case)
        except SpentError:
            return
        used = case.used
    require(used <= FEW, f"at most {FEW} simulations", used, f"{kind.__name__}.diagnose")


def check_takes_missing_samples(kind: type[Diagnoser]) -> None:
    """It answers about a recording with gaps."""
    with _case(kind, missing=True) as case:
        _answer(kind, case)


def check_learns_within_its_budget(kind: type[Diagnoser]) -> NotApplicable | None:
    """What it learns are arrays of numbers, from no more simulations than it was given."""
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
"""Every check, in the order in which they are made."""

DIAGNOSER_NEEDS: Mapping[Check, tuple[Check, ...]] = dict.fromkeys(
    DIAGNOSER_CHECKS[1:], (check_answers,)
)
"""Checks that mean nothing where another one fails."""
