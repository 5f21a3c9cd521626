"""Long recordings of robots, cut: what is searched costs steps of the simulator, and pieces from
all over a recording tell nearly as much as the whole of it.

A search costs about

    steps x joints^2                                                                             (1)

since candidates grow with the joints, and a step with their number. Pieces lie evenly over each run
and begin where its commands have been quiet, so that what was commanded before is over.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from sims.base import Array, Simulator
from sims.recording.recording import Recording, Run

MOST = 5e5
"""(1) from which on a recording is cut: half a minute of six joints at a step of 2 ms."""
PIECE = 2.0
"""Seconds of a piece, if runs are no shorter."""
QUIET = 0.2
"""Seconds before a piece in which its commands change little."""


class Cut(NamedTuple):
    """A recording in pieces, and what is to be said of it; nothing where it is whole."""

    recording: Recording
    note: str


def cut(recording: Recording, kind: type[Simulator]) -> Cut:
    """The recording with its runs in pieces where it is too long to be searched whole.

    Runs for fitting are left in pieces that cost `MOST` together, held-out ones likewise; each is
    there in one piece at least.

    Args:
        recording: as it was read.
        kind: a simulator of its system; one without a model file is never cut.
    """
    if not kind.has_model:
        return Cut(recording, "")
    robot: Any = kind
    step, _ = robot.numerics
    joints = sum(joint.single for joint in robot.robot.joints)
    budget = MOST * step / joints**2
    kept: list[Run] = []
    notes = []
    for word, runs in (("fitting", recording.training()), ("measuring", recording.held_out())):
        whole = sum(map(_seconds, runs))
        if whole <= budget:
            kept += runs
            continue
        pieces = [piece for run in runs for piece in _pieces(run, budget * _seconds(run) / whole)]
        kept += pieces
        left = sum(map(_seconds, pieces))
        notes.append(f"{left:.3g} s of {whole:.4g} s for {word}, in {len(pieces)} pieces")
    if not notes:
        return Cut(recording, "")
    said = " and ".join(notes)
    note = f"of the long recording {said} from all over it were looked at (--whole takes all)"
    return Cut(replace(recording, runs=tuple(kept)), note)


def _seconds(run: Run) -> float:
    return float(run.times[-1] - run.times[0])


def _pieces(run: Run, seconds: float) -> list[Run]:
    """Pieces of a run that last so long together."""
    length = min(PIECE, seconds)
    count = max(int(seconds / length + 0.5), 1)
    span = _seconds(run) / count
    change = _changes(run)
    pieces = []
    for number in range(count):
        # A piece may begin anywhere in its part of the run, where that leaves room for it.
        first = run.times[0] + number * span
        low, high = np.searchsorted(run.times, (first, first + max(span - length, 0.0)))
        high = max(high, low + 1)
        begin = int(low + np.argmin(change[low:high]))
        end = int(np.searchsorted(run.times, run.times[begin] + length, side="right"))
        name = f"{run.name} from {run.times[begin]:.4g} s"
        pieces.append(run.part(slice(begin, end), name))
    return pieces


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
