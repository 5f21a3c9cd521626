"""Options of `simgap explain`, of its Python function and of everything that runs it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from bench.diagnosis.evaluation.search_control import ProgressListener, SearchControl
from sims.core.argument_checks import Count, Name, Names, Seconds
from sims.recording.recording_frame import FrameDescription


def _discard_note(_line: str) -> None:
    """Discard a note."""


def _never_stop() -> bool:
    """Let the search come to its end."""
    return False


@dataclass(frozen=True, kw_only=True)
class ExplainOptions(FrameDescription):
    """Options of an explanation.

    Attributes:
        engine: Engine of the simulation, pybullet, mujoco or batch; a simulator that steps itself
            ignores it.
        seed: Seed of all random numbers: surrogate data and bootstrap.
        free: Constants to estimate together with the parameters; for a robot, numbers of its model
            file, as damping@* or mass@forearm.
        fix_base: For a robot with a floating base: fix the base in the pose of the model file;
            keyframes are left out.
        tuner: Name of a tuner that finds the starting point of the base fit (default: a grid).
        budget: Time limit of the search in seconds; at the limit it ends with the results so far,
            as after Ctrl-C (default: no limit).
        jobs: Number of worker processes; the answer does not depend on it (default: one for each
            core).
        whole: Use all samples of a long recording of a robot (default: segments
            distributed over it).
        pieces: Cut runs into segments of this many seconds, each with its own initial state, for
            motion that drifts or is unstable.
        thorough: If causes are found and a residual remains, search for further causes that
            held-out runs confirm; this takes about twice as long.
        force: Explain a recording that needs more than this machine has, or whose time stamps
            cannot be seconds.
        say: Function that is called with notes on the recording and the base model.
        stop: Function that is called between two steps; if it returns True, the search ends as at
            its time limit.
        progress: Function that is called with the estimated share that is done and the present
            step.
        listener: Object that receives the stages of the search with their steps, and the best model
            so far.
    """

    engine: Name = "batch"
    seed: int = 0
    free: Names = ()
    fix_base: bool = False
    tuner: Name | None = None
    budget: Seconds | None = None
    jobs: Count | None = None
    whole: bool = False
    pieces: Seconds | None = None
    thorough: bool = False
    force: bool = False
    say: Callable[[str], None] = _discard_note
    stop: Callable[[], bool] = _never_stop
    progress: Callable[[float, str], None] | None = None
    listener: ProgressListener | None = None

    def make_search_control(self) -> SearchControl:
        """Start the clock of the time limit."""
        return SearchControl(self.budget, self.stop, self.progress, self.listener)
