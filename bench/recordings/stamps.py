"""Whether a recording's stamps can be seconds: its motion against what its system could do.

Over how long a coordinate moves is told twice. The recording says: the shortest lag T after which
its values x differ by as much as they spread,

    mean (x(t + T) - x(t))^2 >= var x                                      (1)

and the system says: at rest in the recorded positions, driven by the recorded inputs, its own
forces would move it as far within

    T' = (var x / mean a^2)^(1/4)                                          (2)

with a its acceleration at nominal parameters. An oscillation has T = 1.05/w and T' = 1/w. Dust,
friction and a wrong mass change their ratio a few times, milliseconds called seconds a thousand
times; then the samples lie further apart than (2), too, which nobody would record on purpose.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bench.recordings import poses
from bench.recordings.afloat import unplaced
from bench.recordings.normalised import may_be_normalised
from bench.recordings.oddity import Oddity
from bench.sizes import INSIST
from sims.base import Array, InputError, Simulator
from sims.recording.recording import Recording, Run
from sims.simulated import Simulated
from sims.system import Moment, System

FACTOR = 300.0
"""Ratio of the two times beyond which the unit of one is wrong."""
DRIVEN = 10.0
"""A driven system may be moved as slowly as one likes: its samples must lie so much further apart
than (2) until it is certain.
"""
STILL = 0.01
"""Share of its usual size by which a coordinate moves at least, so that it tells something."""
GAP = 100.0
"""Times all the rest of a run that a gap in it takes, and nothing known before it tells of what is
behind.
"""
_FEW = 10
"""Samples of a run of which nothing is said."""
_UNITS = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}


def refuse_odd(recording: Recording, kind: type[Simulator], force: bool = False) -> list[str]:
    """Refuse stamps that cannot be seconds, and positions that cannot be a robot's; what may be is
    returned to be said.

    Args:
        recording: as it was read.
        kind: a simulator of its system.
        force: whether the user insists.

    Raises:
        InputError: they cannot be, in one line.
    """
    # Positions of a wrong unit make stamps look odd, and not the other way round.
    found = [
        *odd_logs(recording),
        *poses.odd_poses(recording, kind),
        *oddities(recording, kind),
        *unplaced(recording, kind),
    ]
    for oddity in found:
        if oddity.certain and not force:
            raise InputError(f"{recording.path}: {oddity.text}, {INSIST}")
    return [oddity.text for oddity in found]


def odd_logs(recording: Recording) -> Iterator[Oddity]:
    """Yield what was left out of a recording's logs, and units that they do not state."""
    yield from (Oddity(note, False) for note in recording.notes)
    yield from may_be_normalised(recording)


def oddities(recording: Recording, kind: type[Simulator]) -> Iterator[Oddity]:
    """What is odd, at most one a run."""
    for run in recording.runs:
        if run.times.size < _FEW:
            continue
        odd = _gap(run) or _slow(recording, run, kind)
        if odd is not None:
            yield odd


def _gap(run: Run) -> Oddity | None:
    intervals = np.diff(run.times)
    place = int(intervals.argmax())
    gap = float(intervals[place])
    rest = float(intervals.sum()) - gap
    if gap <= GAP * rest:
        return None
    where = f"{gap:.4g} s without a sample from t = {run.times[place]:.6g} s on"
    known = f"in a run that has samples for {rest:.4g} s"
    return Oddity(f"run {run.name}: {where}, {known}; divide it there into two runs", True)


def _slow(recording: Recording, run: Run, kind: type[Simulator]) -> Oddity | None:
    """The oddity of a run in which every coordinate moves far more slowly than its system would, or
    far faster. All coordinates share the stamps, so one that moves as expected clears them; another
    may belong to a link without inertia in the model file.
    """
    # What steps itself tells nobody its forces.
    if not issubclass(kind, Simulated) or (kind.own_engine and not kind.has_model):
        return None
    system = kind.system()
    interval = float(np.median(np.diff(run.times)))
    if kind.has_model:
        accelerations = poses.accelerations(run, kind)
    else:
        accelerations = _accelerations(recording, run, system)
    # A servo stands still by force: what would move it is nothing to wonder about.
    servo = kind.has_model and _driven(run)
    sizes = {channel.name: channel.scale for channel in system.channels}
    first: Oddity | None = None
    for column, name in enumerate(system.coordinates):
        x = run.channels.get(name)
        if x is None:
            continue
        spread = float(np.nanstd(x))
        pull = float(np.sqrt(np.nanmean(accelerations[:, column] ** 2)))
        if not (spread > STILL * sizes.get(name, 1.0) and pull > 0):
            continue
        own = (spread / pull) ** 0.5  # (2)
        recorded = interval * _lag(x)
        ratio = recorded / own
        if 0 < ratio < 1 / FACTOR:
            moves = f"{name} moves in {recorded:.3g} s as {kind.name} would within {own:.2g} s"
            first = first or Oddity(f"run {run.name}: {moves}; are the stamps seconds?", False)
            continue
        if ratio < FACTOR or interval < (DRIVEN * own if servo else own):
            return None
        unit = min(_UNITS, key=lambda factor: abs(np.log(ratio / factor)))
        moves = f"{name} takes {recorded:.3g} s to move as {kind.name} would within {own:.2g} s"
        apart = f"samples lie {interval:.3g} s apart"
        remedy = f"are the stamps {_UNITS[unit]}? then divide t by {unit:g}"
        certain = not _driven(run) or interval >= DRIVEN * own
        first = first or Oddity(f"run {run.name}: {moves}, and {apart}; {remedy}", certain)
    return first


def _driven(run: Run) -> bool:
    return any(np.any(signal) for signal in run.inputs.values())


def _accelerations(recording: Recording, run: Run, system: System) -> Array:
    """(T, D) what the system's own forces do at rest in the recorded positions."""
    count = run.times.size
    given = {**recording.constants, **run.constants}
    constants = {c.name: np.full((count, 1), given.get(c.name, c.value)) for c in system.constants}
    theta = np.tile([p.nominal for p in system.parameters], (count, 1))
    default = [np.full(count, system.states[name]) for name in system.coordinates]
    columns = [
        run.channels.get(name, usual)
        for name, usual in zip(system.coordinates, default, strict=True)
    ]
    x = np.stack(columns, axis=1)
    nothing = np.zeros((count, 1))
    inputs = {c.name: nothing for c in system.inputs}
    inputs |= {name: signal[:, None] for name, signal in run.inputs.items()}
    moment = Moment(system, theta, constants, nothing, x, np.zeros_like(x), inputs)
    with np.errstate(all="ignore"):
        accelerations: Array = system.force(moment) / system.mass(theta, constants)
    return accelerations


def _lag(x: Array) -> float:
    """The lag of (1) in samples; 0 where the first one is beyond it already, and the motion between
    samples is not seen.
    """
    variance = float(np.nanvar(x))
    lag, before = 1, 0
    while lag < x.size:
        differences = x[lag:] - x[:-lag]
        differences = differences[np.isfinite(differences)]
        if differences.size and float(np.mean(differences**2)) >= variance:
            return float(before)
        before, lag = lag, 2 * lag
    return float(before)
