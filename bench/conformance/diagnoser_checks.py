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

from bench.benchmark.isolation.message_channel import pack_arrays
from bench.conformance.check_base import (
    Check,
    CheckError,
    NotApplicable,
    check,
    check_global_random_state,
)
from bench.core.diagnoser import (
    Answer,
    Diagnoser,
    DiagnoserTrainingTask,
    DiagnosisCase,
    list_named_sets,
    list_observable_effects,
)
from bench.logs.synthetic_recording import SimulatedRecording, SimulationSpec, simulate_recording
from sims import effects
from sims.core.simulation_counter import SIMULATION_COUNTER, SimulationBudgetExceededError
from sims.core.simulator import Array, InputError
from sims.recording.recording import Recording, read_recording
from sims.system_simulator import SystemSimulator

TEST_SYSTEM = "slider"
SIMULATION_BUDGET = 60_000
"""Simulation budget of an answer."""
TINY_SIMULATION_BUDGET = 40
"""Simulation budget that is too small for a useful answer."""
TRAINING_BUDGET = 12_000
"""Simulation budget of the training; small, so that the suite is fast."""
TIME_LIMIT_SECONDS = 60.0
"""Time limit of an answer, seconds."""

TRAINED_DIAGNOSERS: dict[type[Diagnoser], dict[str, Array]] = {}
"""Trained state of each diagnoser in this process."""
_DRAG = 0.6
"""Hidden linear drag of the slider, N s/m."""
_POSITION_NOISE = 0.002
"""Standard deviation of the position noise, m."""
_SAMPLING_RATE = 50.0
"""Sampling rate of the recordings, Hz."""


@cache
def _get_recording(hidden: bool) -> SimulatedRecording:
    """Simulate a recording of the slider, with strong drag or without a hidden cause.

    Args:
        hidden: Whether the true system has a linear drag that the diagnoser's simulator lacks.

    Returns:
        Three runs of two seconds, with the noisy position as the only channel.
    """
    return simulate_recording(
        SimulationSpec(
            system=TEST_SYSTEM,
            effects={"drag.linear": (_DRAG,)} if hidden else {},
            noise={"x": _POSITION_NOISE},
            observe=("x",),
            # Force amplitude 2 N, frequency 0.7 Hz.
            inputs={"u": "sine:2:0.7"},
            runs=3,
            seconds=2.0,
            rate=_SAMPLING_RATE,
            engine="batch",
            seed=7,
        )
    )


@contextmanager
def _open_case(
    kind: type[Diagnoser],
    hidden: bool = True,
    budget: int = SIMULATION_BUDGET,
    missing: bool = False,
) -> Iterator[DiagnosisCase]:
    """Make a case as a diagnoser gets it; its folder is deleted afterwards.

    Args:
        kind: class of the diagnoser, which is trained first if it learns.
        hidden: whether the recording has a hidden cause (strong linear drag).
        budget: maximum number of simulations.
        missing: whether the recording has gaps.

    Yields:
        The case; within the block, the simulations of this process are counted and limited.
    """
    simulated = _get_recording(hidden)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recording.csv"
        simulated.write(path)
        path.with_suffix(".truth.toml").unlink()  # it states the hidden cause
        simulator = type(simulated.simulator)
        assert issubclass(simulator, SystemSimulator)
        recording = read_recording(path, simulator)
        if missing:
            recording = _add_gaps(recording)
        SIMULATION_COUNTER.reset(budget)
        try:
            yield DiagnosisCase(
                path,
                recording,
                simulator,
                library=list_observable_effects(simulator, recording),
                rng=np.random.default_rng(3),
                budget=budget,
                seconds=TIME_LIMIT_SECONDS,
                learned=_get_trained_state(kind),
            )
        finally:
            SIMULATION_COUNTER.reset()


def _add_gaps(recording: Recording) -> Recording:
    """Return the recording with every seventh sample missing.

    Diagnosers must accept missing samples (NaN), because recordings have them.
    """
    runs = []
    for run in recording.runs:
        channels = {name: values.copy() for name, values in run.channels.items()}
        for values in channels.values():
            values[3::7] = np.nan
        runs.append(replace(run, channels=channels))
    return replace(recording, runs=tuple(runs))


def _get_trained_state(kind: type[Diagnoser]) -> dict[str, Array]:
    """Train a diagnoser with a small budget, once per process.

    Returns:
        Learned arrays by name; empty for a diagnoser that does not learn.
    """
    if not kind.learned:
        return {}
    if kind not in TRAINED_DIAGNOSERS:
        arrays, _ = _train_diagnoser(kind)
        TRAINED_DIAGNOSERS[kind] = arrays
    return TRAINED_DIAGNOSERS[kind]


def _train_diagnoser(kind: type[Diagnoser]) -> tuple[dict[str, Array], int]:
    """Train a diagnoser with a small budget on the slider, the system of the checks.

    Returns:
        Learned arrays by name, and the number of simulations used.
    """
    simulator = type(_get_recording(False).simulator)
    assert issubclass(simulator, SystemSimulator)
    library = effects.list_effects_for(simulator.system)
    SIMULATION_COUNTER.reset(TRAINING_BUDGET)
    try:
        training_task = DiagnoserTrainingTask(
            simulator, library, np.random.default_rng(5), TRAINING_BUDGET
        )
        arrays = kind().train(training_task)
        return {name: np.asarray(array) for name, array in arrays.items()}, SIMULATION_COUNTER.used
    finally:
        SIMULATION_COUNTER.reset()


class _Run(NamedTuple):
    """Answer of a diagnoser and side effects of the diagnosis.

    Attributes:
        answer: the answer.
        unobservable: named effects that the recording cannot show.
        changed: whether the recording or its files were changed.
        random_state_error: description of changes of the global random state; empty for none.
    """

    answer: Answer
    unobservable: tuple[str, ...]
    changed: bool
    random_state_error: str


@cache
def _diagnose_cached(kind: type[Diagnoser], hidden: bool = True, turn: int = 0) -> _Run:  # noqa: ARG001
    """Run a diagnoser, and record its answer and what it changed; several checks use the result.

    Args:
        kind: class of the diagnoser.
        hidden: whether the recording has a hidden cause.
        turn: number of the run, not used: another number is not in the cache and repeats the run.

    Raises:
        CheckError: the diagnoser gave no valid answer.
    """
    with _open_case(kind, hidden) as case:
        files_before, random_state_error = _copy_case_bytes(case), ""
        answer: Answer | None = None
        try:
            with check_global_random_state(f"case.rng in {kind.__name__}.diagnose"):
                answer = _run_diagnoser(kind, case)
        except CheckError as error:
            # Without an answer, there is nothing else to check.
            if answer is None:
                raise
            # With an answer, the error is that of the random state, which one check reports.
            random_state_error = str(error)
        assert answer is not None
        named_effects = {name for group in list_named_sets(answer) for name in group}
        # The library of the case has the effects that the recording can show.
        unobservable = tuple(sorted(named_effects - set(case.library)))
        has_changed = _copy_case_bytes(case) != files_before
        return _Run(answer, unobservable, has_changed, random_state_error)


def _run_diagnoser(kind: type[Diagnoser], case: DiagnosisCase) -> Answer:
    """Run a diagnoser and validate its answer.

    Args:
        kind: class of the diagnoser.
        case: the recording to diagnose, and the effects of the library.

    Raises:
        CheckError: the result is not a valid answer.
    """
    answer = kind().diagnose(case)
    try:
        return Answer.of(answer)
    except InputError as error:
        location = f"{kind.__name__}.diagnose"
        raise CheckError(f"expected an answer; found {error}; see {location}") from None


def _copy_case_bytes(case: DiagnosisCase) -> list[bytes]:
    """Copy the data and files of a case as bytes, to detect later whether they were changed."""
    arrays = [
        array.tobytes()
        for run in case.recording.runs
        for array in (run.times, *run.channels.values(), *run.inputs.values())
    ]
    return [*arrays, case.path.read_bytes(), case.path.with_suffix(".toml").read_bytes()]


def check_answers(kind: type[Diagnoser]) -> None:
    """Check that the diagnoser answers about a recording with a cause, and about one without."""
    for hidden in (True, False):
        answer = _diagnose_cached(kind, hidden).answer
        # These two verdicts say that there is a cause, and must name it.
        empty = answer.verdict in ("named", "ambiguous") and not answer.causes
        check(not empty, "causes where something is named", answer.document(), kind.__name__)


def check_names_what_there_is(kind: type[Diagnoser]) -> None:
    """Check that named effects are observable in the recording, and occur once in a set."""
    run, location = _diagnose_cached(kind), f"{kind.__name__}.diagnose"
    check(not run.unobservable, "names of case.library", run.unobservable, location)
    sets_with_repeats = [
        names for names in list_named_sets(run.answer) if len(set(names)) < len(names)
    ]
    check(not sets_with_repeats, "each effect once in a set", sets_with_repeats, location)


def check_same_answer_again(kind: type[Diagnoser]) -> None:
    """Check that the same random seed gives the same answer."""
    first, second = (_diagnose_cached(kind, turn=turn).answer.document() for turn in (0, 1))
    check(first == second, "the same answer again", second, f"case.rng in {kind.__name__}")


def check_leaves_the_recording_alone(kind: type[Diagnoser]) -> None:
    """Check that neither the arrays nor the files of the recording are changed."""
    check(
        not _diagnose_cached(kind).changed,
        "the recording unchanged",
        "a different one",
        kind.__name__,
    )


def check_leaves_global_chance_alone(kind: type[Diagnoser]) -> None:
    """Check that all random numbers come from case.rng."""
    if message := _diagnose_cached(kind).random_state_error:
        raise CheckError(message)


def check_keeps_to_its_budget(kind: type[Diagnoser]) -> None:
    """Check that the diagnoser answers within a tiny budget, or stops with the budget error.

    Args:
        kind: Diagnoser class under test.
    """
    with _open_case(kind, budget=TINY_SIMULATION_BUDGET) as case:
        try:
            _run_diagnoser(kind, case)
        except SimulationBudgetExceededError:
            return
        used_simulations = case.used
    check(
        used_simulations <= TINY_SIMULATION_BUDGET,
        f"at most {TINY_SIMULATION_BUDGET} simulations",
        used_simulations,
        f"{kind.__name__}.diagnose",
    )


def check_takes_missing_samples(kind: type[Diagnoser]) -> None:
    """Check that the diagnoser answers about a recording with missing samples."""
    with _open_case(kind, missing=True) as case:
        _run_diagnoser(kind, case)


def check_learns_within_its_budget(kind: type[Diagnoser]) -> NotApplicable | None:
    """Check that the training stays within its budget and results in numeric arrays.

    The trained state must consist of numeric arrays, because it is sent to isolated processes as
    plain arrays, not as pickled objects. It is stored for the checks that follow.

    Args:
        kind: Diagnoser class under test.

    Returns:
        A reason why the check is not applicable; None if it passed.
    """
    if not kind.learned:
        return NotApplicable("it does not learn")
    arrays, used_simulations = _train_diagnoser(kind)
    check(
        used_simulations <= TRAINING_BUDGET,
        f"at most {TRAINING_BUDGET} simulations",
        used_simulations,
        f"{kind.__name__}.train",
    )
    try:
        pack_arrays(arrays)
    except ValueError as error:
        raise CheckError(
            f"expected arrays of numbers; found {error}; see {kind.__name__}"
        ) from None
    TRAINED_DIAGNOSERS.setdefault(kind, arrays)
    return None


DIAGNOSER_CHECKS: Mapping[Check, tuple[Check, ...]] = {
    check_answers: (),
    check_names_what_there_is: (check_answers,),
    check_same_answer_again: (check_answers,),
    check_leaves_the_recording_alone: (check_answers,),
    check_leaves_global_chance_alone: (check_answers,),
    check_keeps_to_its_budget: (check_answers,),
    check_takes_missing_samples: (check_answers,),
    check_learns_within_its_budget: (check_answers,),
}
"""Checks in the order in which they run, each with those that must pass for it to be meaningful."""
