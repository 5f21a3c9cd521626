"""`simgap.explain` and `simgap.score`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from bench.gap import explain as explaining
from bench.gap.explanation import Explanation
from bench.gap.model.crew import cores
from bench.gap.model.progress import ProgressListener
from bench.gap.model.watch import Watch
from bench.gap.score_model import scored
from bench.recordings.simulate import SimulatedRecording
from sims.base import InputError
from sims.recording.recording import Recording

Source: TypeAlias = str | Path | Recording | SimulatedRecording
"""What holds a recording."""


def explain(
    recording: Source | Sequence[Source],
    *,
    system: str | None = None,
    model: str | Path | None = None,
    engine: str = "batch",
    free: Sequence[str] = (),
    tuner: str | None = None,
    seed: int = 0,
    force: bool = False,
    budget: float | None = None,
    jobs: int | None = None,
    whole: bool = False,
    pieces: float | None = None,
    thorough: bool = False,
    say: Callable[[str], None] = lambda _: None,
    stop: Callable[[], bool] = lambda: False,
    progress: Callable[[float, str], None] | None = None,
    listener: ProgressListener | None = None,
) -> Explanation:
    """Show what the simulation of a recording gets wrong, name the cause, extend the simulator.

    Args:
        recording: the path of ``NAME.csv``, or a recording that was read or simulated; several of
            one system are explained together, and each beside that by itself.
        system: take it for this system, whatever the description says.
        model: take it for this robot, whatever the description says: an MJCF or URDF.
        engine: pybullet, mujoco or batch; a simulator that steps itself has its own.
        free: constants to estimate with the parameters; of a robot numbers of its file, as
            ``damping@*`` or ``mass@forearm``.
        tuner: a registered tuner that finds where the fit of the base parameters begins.
        seed: of the surrogates and the bootstrap.
        force: explain what needs more than this machine has, or has stamps that cannot be seconds.
        budget: seconds of the clock after which the search ends with what it has then; the
            answer's ``cut`` says what was not asked any more. None: it comes to its end.
        jobs: processes that work at once, where that pays; None: one for each core. The answer does
            not depend on it.
        whole: look at all of a long recording of a robot; else at pieces from all over it.
        pieces: seconds of the pieces that every run is cut into, each with an initial state of its
            own: for motion that drifts or is unstable.
        thorough: search on where causes are found and something is left over: further causes are
            taken that held-out runs bear out. Takes about twice as long there.
        say: told what the user should know of the recording and of the base model.
        stop: asked between two steps of the search; True ends it as a budget does.
        progress: told the share that is done, as far as can be known, and what is looked at.
        listener: receives the events of the search: its stages with their steps, and the best
            model so far.

    Raises:
        InputError: the recording cannot be read, is too short, or is of nothing that takes effects;
            or the budget is no number above 0, or ended before anything could be simulated.
    """
    sources = sources_of(recording)
    if budget is not None and not budget > 0:
        raise InputError(f"budget: expected a number of seconds above 0, found {budget!r}")
    if jobs is not None and jobs < 1:
        raise InputError(f"jobs: expected a whole number of at least 1, found {jobs!r}")
    if pieces is not None and not pieces > 0:
        raise InputError(f"pieces: expected a number of seconds above 0, found {pieces!r}")
    watch = Watch(budget, stop, progress, listener)
    given = system, engine, seed, free, tuner, say, force
    more = jobs or cores(), model, whole, pieces, thorough
    return explaining.explain(sources, *given, watch, *more)


def sources_of(recording: Source | Sequence[Source]) -> list[str | Path | Recording]:
    """One or several, each as a path or as what was read.

    Raises:
        InputError: there is none.
    """
    each = [recording] if isinstance(recording, Source) else list(recording)
    if not each:
        raise InputError("expected a recording, found none")
    return [one.recording if isinstance(one, SimulatedRecording) else one for one in each]


def score(
    model: str | Path, recording: str | Path, *, held_out: bool = False, force: bool = False
) -> dict[str, Any]:
    """The error of an extended simulator on another recording; initial states are estimated there,
    nothing else.

    Args:
        model: extended.toml, or a robot's model file, as extended.xml.
        recording: the path of ``NAME.csv``.
        held_out: count only runs that are marked so.
        force: as in `explain`.

    Returns:
        rmse by channel in its unit, normalised_rmse in units of the noise, runs, samples, units.

    Raises:
        InputError: a file cannot be read, or the recording is of another system.
    """
    return scored(Path(model), Path(recording), held_out, force)
