"""What the engines share that step one body at a time: lane after lane, forces put in through the
engine's interface.

Bullet and MuJoCo (with its Euler integrator) step alike, by semi-implicit Euler: with step h,

    w' = w + h (G(x) + F) / M                                              (1)
    x' = x + h w'                                                          (2)

where G is the gravity that the engine itself applies and F is what is put in from outside. That is
of first order if w is read as the velocity at the time of x, and of second if it is read as the one
half a step before (leapfrog; Hairer, Lubich, Wanner, Acta Numerica 12, 2003,
doi:10.1017/S0962492902000144), with a(x) the acceleration there:

    w = v - h/2 a(x)                                                       (3)

`sims.engines.joint` and `sims.engines.flight` read it so: they choose F such that the engine's
velocity ends where half a step's force takes the velocity at x.

What acts beside the engine is asked for by `sims.engines.forces`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sims.base import Array, InputError
from sims.limits import cut, is_number
from sims.system import Acting, Contact, Effect, Lanes, Moment, Motion, System

TIME_TOLERANCE = 1e-6
"""Share of an interval by which sample times may miss the engine's steps: recordings round their
time stamps."""

DEFAULT_STEPS = {"point": 1 / 120, "linear": 2.5e-3, "rotary": 2.5e-3}
"""Longest step in seconds where the user sets none, by the system's kind."""

Places = NDArray[np.intp]
Mask = NDArray[np.bool_]
Path = tuple[Array, Array, Array]
"""Positions, velocities, accelerations of one lane, (N, D)."""


@dataclass(frozen=True)
class Lane:
    """One lane's work. Effects whose coefficients are all zero are left out: off is off.

    Attributes:
        system: what to integrate.
        theta: (1, p) the system's parameters.
        constants: (1, 1) by name; `numbers` has them as numbers.
        x: (D,) initial position.
        v: (D,) initial velocity.
        steps: (S,) seconds, all > 0: where a lane waits is left out.
        inputs: (S,) by name, at least one value.
        effects: those that act, with coefficients (K, 1, 1).
        declared: all effects of the call in their order, also those that act on other lanes alone.
        kept: (N,) increasing numbers of steps, from 0, after which the state is kept.
    """

    system: System
    theta: Array
    constants: Mapping[str, Array]
    x: Array
    v: Array
    steps: Array
    inputs: Mapping[str, Array]
    effects: Acting
    declared: tuple[Effect, ...]
    kept: Places

    @property
    def numbers(self) -> dict[str, float]:
        """The constants as plain numbers."""
        return {name: float(value[0, 0]) for name, value in self.constants.items()}

    @property
    def contacts(self) -> list[tuple[Contact, Array]]:
        """Effects on impacts."""
        return [(effect, c) for effect, c in self.effects if isinstance(effect, Contact)]

    def moment(self, t: Array, x: Array, v: Array, inputs: Mapping[str, Array]) -> Moment:
        """Instants of this lane: t (n, 1), x and v (n, D), inputs (n, 1)."""
        n = len(x)
        known = {name: np.repeat(value, n, axis=0) for name, value in self.constants.items()}
        theta = np.repeat(self.theta, n, axis=0)
        return Moment(self.system, theta, known, t, x, v, inputs)


class ApartError(Exception):
    """Lanes cannot be integrated together."""


Rollouts = Callable[[Sequence[Lane]], Iterable[Path]]
"""Integrates lanes; the rows of each path are those of `Lane.kept`, NaN where it failed."""


def integrate(lanes: Lanes, rollouts: Rollouts, discard: Callable[[], None]) -> Motion:
    """All lanes through `rollouts`.

    Args:
        lanes: the work.
        rollouts: integrates those that can be.
        discard: called where it is interrupted; it may have left the engine's world in any state.

    Returns:
        The motion. A lane with a non-finite number or result is all NaN.
    """
    count = lanes.steps.shape[1] // lanes.every + 1
    shape = (len(lanes.theta), count, lanes.x.shape[1])
    x = np.full(shape, np.nan)
    motion = Motion(x, x.copy(), x.copy())
    work: list[Lane] = []
    places: list[tuple[int, Places]] = []
    for i in range(len(lanes.theta)):
        # Lanes of one run follow each other and make the same steps.
        if i == 0 or not np.array_equal(lanes.steps[i], lanes.steps[i - 1]):
            timing = _timing(lanes.steps[i], lanes.every)
        lane = _lane(lanes, i, *timing[:3])
        # A rollout that must fail would cost the engine its world.
        if all(np.isfinite(values).all() for values in _given(lane)):
            work.append(lane)
            places.append((i, timing[3]))
    try:
        for (i, rows), path in zip(places, rollouts(work), strict=True):
            if finite(path):
                for result, values in zip((motion.x, motion.v, motion.a), path, strict=True):
                    result[i] = values[rows]
    except BaseException:  # an interrupted rollout leaves forces behind
        discard()
        raise
    return motion


def in_turn(
    rollout: Callable[[Lane], Path], discard: Callable[[], None], lanes: Sequence[Lane]
) -> Iterator[Path]:
    """One lane after the other; `discard` is called behind one that failed."""
    for lane in lanes:
        path = rollout(lane)
        if not finite(path):
            discard()
        yield path


def finite(path: Path) -> bool:
    """Whether all numbers of a path are."""
    return all(bool(np.isfinite(values).all()) for values in path)


def _timing(steps: Array, every: int) -> tuple[Places, Array, Places, Places]:
    """Which steps are taken, their lengths, how many precede the states to keep, and which of these
    each record is.
    """
    # A state behind a step of no length is the one before it: records share their rows.
    moves = steps > 0
    moving = np.flatnonzero(moves)
    taken = np.concatenate([[0], np.cumsum(moves)])[::every]
    kept, rows = np.unique(taken, return_inverse=True)
    return moving, evened(steps[moving], every), kept, rows


def _lane(lanes: Lanes, i: int, moving: Places, steps: Array, kept: Places) -> Lane:
    acting = [(effect, c[:, i : i + 1]) for effect, c in lanes.effects]
    effects = tuple((effect, c) for effect, c in acting if c.any())
    constants = {name: value[i : i + 1] for name, value in lanes.constants.items()}
    # A lane that never moves has an input still, at its one instant.
    felt = moving if moving.size else slice(1)
    inputs = {name: value[i, felt] for name, value in lanes.inputs.items()}
    return Lane(
        lanes.system,
        lanes.theta[i : i + 1],
        constants,
        lanes.x[i],
        lanes.v[i],
        steps,
        inputs,
        effects,
        tuple(effect for effect, _ in lanes.effects),
        kept,
    )


def _given(lane: Lane) -> list[Array]:
    return [
        lane.theta,
        lane.x,
        lane.v,
        *lane.constants.values(),
        *lane.inputs.values(),
        *(c for _, c in lane.effects),
    ]


def evened(steps: Array, every: int) -> Array:
    """`steps` (S,), made equal if they are but for rounding: each change of step costs an engine
    more than a step.

    Args:
        steps: seconds, > 0.
        every: steps from one sample to the next.
    """
    if not steps.size:
        return steps
    # By how much the sample times are missed counts, and not by how much each step differs: errors
    # of rounded time stamps do not add up.
    even = math.fsum(steps) / steps.size
    ends = even * np.arange(1, steps.size + 1)
    missed = np.abs(np.cumsum(steps) - ends).max()
    alike = missed <= TIME_TOLERANCE * even * every
    return np.full(steps.size, even) if alike else steps


def legs(lane: Lane, *signals: Array) -> list[tuple[int, list[int]]]:
    """The steps as legs in which neither the step nor any of `signals` (S,) changes.

    Returns:
        The number of the first step of each leg, and how many steps it takes from one state to keep
        to the next, and at last to its end.
    """
    size = lane.steps.size
    new = np.zeros(size, dtype=bool)
    new[:1] = True
    for values in (lane.steps, *signals):
        new[1:] |= values[1:size] != values[: size - 1]
    # The engine is stopped where a leg begins and where a state is to be kept.
    stops = new.copy()
    stops[lane.kept[lane.kept < size]] = True
    begins = np.flatnonzero(stops)
    counts = np.diff(begins, append=size).tolist()
    firsts = new[begins].tolist()
    result: list[tuple[int, list[int]]] = []
    for begin, count, first in zip(begins.tolist(), counts, firsts, strict=True):
        if first:
            result.append((begin, []))
        result[-1][1].append(count)
    return result


def checked_time_step(time_step: float | None, system: type[System]) -> float:
    """Longest step in seconds: as given, or the default for systems of this kind.

    Raises:
        InputError: not finite or not positive.
    """
    if time_step is None:
        return DEFAULT_STEPS[system.kind]
    if not (is_number(time_step) and time_step > 0):
        found = cut(str(time_step))
        raise InputError(f"time_step must be a positive number of seconds, found {found}")
    return float(time_step)
