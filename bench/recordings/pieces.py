"""Recordings of robots in pieces: long ones, since what is searched costs steps of the simulator,
and pieces from all over a recording tell nearly as much as the whole of it; and those of motion
that drifts or is unstable, which no simulation follows for long, if the user asks for it.

A search costs about

    steps x evaluations of a step x (joints + 3)                                                (1)

by what was measured with one joint and with six. Pieces lie evenly over each run and begin where
its commands have been quiet, so that hardly anything of what was commanded before is left in the
motion; what drives may still feel of it goes with them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from sims.base import Array, InputError, Simulator
from sims.recording.recording import Recording, Run

MOST = 1.6e5
"""(1) from which on a recording is cut: 35 s of six joints at a step of 2 ms."""
PIECE = 2.0
"""Seconds of a piece, if runs are no shorter."""
FEWEST = 20
"""Intervals of a piece, at least."""
EVEN = 1e-9
"""Seconds by which rounding may move an end."""
QUIET = 0.2
"""Seconds before a piece in which its commands change little."""


EVALUATIONS = {"RK4": 2.0}
"""What a step costs by integrator, one otherwise: of four evaluations half is saved elsewhere."""


class Cut(NamedTuple):
    """A recording in pieces, and what is to be said of it; nothing where it is whole."""

    recording: Recording
    note: str


def cut(
    recording: Recording,
    kind: type[Simulator],
    seconds: float | None = None,
    whole: bool = False,
) -> Cut:
    """The recording with its runs in pieces where it is too long to be searched whole, or where
    pieces are asked for.

    Runs for fitting are left in pieces that cost `MOST` together, held-out ones likewise; each is
    there in one piece at least.

    Args:
        recording: as it was read.
        kind: a simulator of its system; one without a model file is cut only if it is asked for.
        seconds: of a piece, if every run is to be cut into such; `PIECE` where it is too long.
        whole: keep all pieces, and a recording whole that none are asked for of.
    """
    if seconds is None and (whole or not kind.has_model):
        return Cut(recording, "")
    robot: Any = kind
    floats = kind.has_model and bool(robot.system.afloat)
    if floats and seconds is not None:
        raise InputError(
            f"{recording.path}: expected no --pieces: bodies of {recording.system} float, and "
            "nothing says where they are when a piece begins; leave it out"
        )
    budget = np.inf if whole or not kind.has_model else _budget(kind)
    kept: list[Run] = []
    notes = []
    for word, runs in (("fitting", recording.training()), ("measuring", recording.held_out())):
        all_of_it = sum(map(_seconds, runs))
        if all_of_it <= budget and seconds is None:
            kept += runs
            continue
        share = min(budget / all_of_it, 1.0) if all_of_it > 0 else 1.0
        take = _first if floats else _pieces
        pieces = [p for run in runs for p in take(run, share * _seconds(run), seconds or PIECE)]
        kept += pieces
        left = sum(map(_seconds, pieces))
        notes.append(f"{left:.3g} s of {all_of_it:.4g} s for {word}, in {len(pieces)} pieces")
    if not notes:
        return Cut(recording, "")
    said = " and ".join(notes)
    left_out = budget < max(sum(map(_seconds, recording.training())), 0.0)
    more = " from all over it (--whole takes all)" if left_out and not whole else ""
    note = f"of the recording {said} were looked at{more}"
    return Cut(replace(recording, runs=tuple(kept)), note)


def _budget(kind: type[Simulator]) -> float:
    """Seconds of a robot's motion that cost `MOST`."""
    robot: Any = kind
    step, integrator = robot.numerics
    joints = sum(joint.single for joint in robot.robot.joints)
    return float(MOST * step / (joints + 3) / EVALUATIONS.get(integrator, 1.0))


def _seconds(run: Run) -> float:
    return float(run.times[-1] - run.times[0])


def _pieces(run: Run, seconds: float, longest: float) -> list[Run]:
    """Pieces of a run that last so long together, none longer than that."""
    length = min(longest, seconds)
    # A piece must hold a few samples, however little may be kept of a run.
    length = max(length, FEWEST * float(np.median(np.diff(run.times))))
    count = max(int(seconds / length + 0.5), 1)
    span = _seconds(run) / count
    length = min(length, span)
    change = _changes(run)
    pieces = []
    for number in range(count):
        # A piece may begin anywhere in its part of the run, where that leaves room for it.
        first = run.times[0] + number * span
        low, high = np.searchsorted(run.times, (first, first + max(span - length, 0.0)))
        high = max(high, low + 1)
        begin = int(low + np.argmin(change[low:high]))
        # The sample at its very end is the next one's first.
        end = int(np.searchsorted(run.times, run.times[begin] + length - EVEN))
        name = f"{run.name} from {run.times[begin]:.4g} s"
        pieces.append(run.part(slice(begin, end), name))
    return pieces


def _first(run: Run, seconds: float, _: float) -> list[Run]:
    """The beginning of a run, which is known where bodies float."""
    end = int(np.searchsorted(run.times, run.times[0] + seconds - EVEN))
    return [run.part(slice(0, max(end, FEWEST)), f"{run.name}, its first {seconds:.4g} s")]


def _changes(run: Run) -> Array:
    """(T,) how much the commands changed just before each sample, each in shares of its spread."""
    back = np.searchsorted(run.times, run.times - QUIET)
    total = np.zeros(run.times.size)
    for values in run.inputs.values():
        spread = float(np.ptp(values))
        if spread > 0:
            added = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(values)))]) / spread
            total += added - added[back]
    return total
