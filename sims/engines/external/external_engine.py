"""Shared integration of batch elements by an external engine, one body at a time.

Forces are applied through the engine's interface.

Bullet and MuJoCo (with its Euler integrator) both step with semi-implicit Euler: with step h,

    w' = w + h (G(x) + F) / M                                              (1)
    x' = x + h w'                                                          (2)

where G is the gravity that the engine itself applies and F is the force applied from outside. This
is of first order if w is read as the velocity at the time of x, and of second order if it is read
as the velocity half a step earlier (leapfrog; Hairer, Lubich, Wanner, Acta Numerica 12, 2003,
doi:10.1017/S0962492902000144), with a(x) the acceleration at x:

    w = v - h/2 a(x)                                                       (3)

`external.joint_rollout` and `external.ball_rollout` read it in this way: they choose F such that
the engine's velocity becomes the velocity at x plus half a step of acceleration.

`sims.engines.external.external_forces` evaluates the forces that the engine does not apply itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sims.core.simulator import Array, InputError
from sims.core.system import (
    ActiveEffects,
    Contact,
    Effect,
    IntegrationBatch,
    StateSnapshot,
    System,
    Trajectories,
)
from sims.core.value_limits import is_plausible_number, truncate_text

TIME_TOLERANCE = 1e-6
"""Largest deviation of sample times from the engine's steps, as a fraction of an interval.

Recordings round their time stamps.
"""

DEFAULT_MAX_STEPS = {"point": 1 / 120, "linear": 2.5e-3, "rotary": 2.5e-3}
"""Default longest step in seconds, by the system's kind."""

Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]
Trajectory = tuple[Array, Array, Array]
"""Trajectory of one batch element: positions, velocities and accelerations, each (N, D)."""


@dataclass(frozen=True)
class ElementWork:
    """Work for one batch element; effects whose coefficients are all zero are left out.

    Attributes:
        system: system to integrate.
        theta: (1, p) parameters of the system.
        constants: (1, 1) constants by name; `plain_constants` returns them as floats.
        x: (D,) initial position.
        v: (D,) initial velocity.
        steps: (S,) step sizes in seconds, all > 0; steps of zero length are left out.
        inputs: (S,) inputs by name, at least one value.
        effects: active effects with coefficients (K, 1, 1).
        declared: all effects of the call in their order, including those active only on other
            elements.
        recorded_steps: (N,) increasing step counts, beginning with 0, after which the state is
            recorded.
    """

    system: System
    theta: Array
    constants: Mapping[str, Array]
    x: Array
    v: Array
    steps: Array
    inputs: Mapping[str, Array]
    effects: ActiveEffects
    declared: tuple[Effect, ...]
    recorded_steps: Indices

    @property
    def plain_constants(self) -> dict[str, float]:
        """Constants as floats, by name."""
        return {name: float(value[0, 0]) for name, value in self.constants.items()}

    @property
    def contact_effects(self) -> list[tuple[Contact, Array]]:
        """Contact effects of the element with their coefficients."""
        return [(effect, c) for effect, c in self.effects if isinstance(effect, Contact)]

    def make_snapshot(
        self, t: Array, x: Array, v: Array, inputs: Mapping[str, Array]
    ) -> StateSnapshot:
        """Make a snapshot of n states of this element.

        Args:
            t: (n, 1) times in seconds.
            x: (n, D) positions.
            v: (n, D) velocities.
            inputs: (n, 1) inputs by name.

        Returns:
            The snapshot.
        """
        n = len(x)
        known = {name: np.repeat(value, n, axis=0) for name, value in self.constants.items()}
        theta = np.repeat(self.theta, n, axis=0)
        return StateSnapshot(self.system, theta, known, t, x, v, inputs)


class NotBatchableError(Exception):
    """The batch elements cannot be integrated together."""


RolloutFunction = Callable[[Sequence[ElementWork]], Iterable[Trajectory]]
"""Function that integrates batch elements and yields their trajectories.

The rows of each trajectory are those of `ElementWork.recorded_steps`; they are NaN where the
integration failed.
"""


def integrate_batch(
    lanes: IntegrationBatch, rollouts: RolloutFunction, discard: Callable[[], None]
) -> Trajectories:
    """Integrate all batch elements with `rollouts`.

    Args:
        lanes: batch to integrate.
        rollouts: integrates the elements whose numbers are all finite.
        discard: called after an interruption, which may leave the engine's world in any state.

    Returns:
        The trajectories. An element with a number or result that is not finite is all NaN.
    """
    count = lanes.steps.shape[1] // lanes.steps_per_sample + 1
    shape = (len(lanes.theta), count, lanes.x.shape[1])
    x = np.full(shape, np.nan)
    motion = Trajectories(x, x.copy(), x.copy())
    work: list[ElementWork] = []
    places: list[tuple[int, Indices]] = []
    for i in range(len(lanes.theta)):
        # Elements of one run are adjacent and have the same steps.
        if i == 0 or not np.array_equal(lanes.steps[i], lanes.steps[i - 1]):
            timing = _timing(lanes.steps[i], lanes.steps_per_sample)
        lane = _lane(lanes, i, *timing[:3])
        # A rollout that is certain to fail would cost the engine its world.
        if all(np.isfinite(values).all() for values in _given(lane)):
            work.append(lane)
            places.append((i, timing[3]))
    try:
        for (i, rows), path in zip(places, rollouts(work), strict=True):
            if is_finite(path):
                for result, values in zip((motion.x, motion.v, motion.a), path, strict=True):
                    result[i] = values[rows]
    except BaseException:  # an interrupted rollout leaves applied forces in the world
        discard()
        raise
    return motion


def integrate_one_by_one(
    rollout: Callable[[ElementWork], Trajectory],
    discard: Callable[[], None],
    lanes: Sequence[ElementWork],
) -> Iterator[Trajectory]:
    """Integrate one element after the other and yield their trajectories.

    Args:
        rollout: integrates one element.
        discard: called after an element that failed.
        lanes: batch elements to integrate.
    """
    for lane in lanes:
        path = rollout(lane)
        if not is_finite(path):
            discard()
        yield path


def is_finite(path: Trajectory) -> bool:
    """Return whether all numbers of a trajectory are finite."""
    return all(bool(np.isfinite(values).all()) for values in path)


def _timing(steps: Array, every: int) -> tuple[Indices, Array, Indices, Indices]:
    """Return the timing of one element.

    Args:
        steps: (S,) step sizes in seconds; zero where the element waits.
        every: number of steps from one recorded state to the next.

    Returns:
        Indices of the steps with length > 0, their lengths, the step counts at which a state is
        recorded, and for each record the index of its state.
    """
    # A step of zero length does not change the state: its record uses the same row as the previous
    # one.
    moves = steps > 0
    moving = np.flatnonzero(moves)
    taken = np.concatenate([[0], np.cumsum(moves)])[::every]
    kept, rows = np.unique(taken, return_inverse=True)
    return moving, equalise_steps(steps[moving], every), kept, rows


def _lane(
    lanes: IntegrationBatch, i: int, moving: Indices, steps: Array, kept: Indices
) -> ElementWork:
    acting = [(effect, c[:, i : i + 1]) for effect, c in lanes.effects]
    effects = tuple((effect, c) for effect, c in acting if c.any())
    constants = {name: value[i : i + 1] for name, value in lanes.constants.items()}
    # An element without any step of positive length still has an input at its single time.
    felt = moving if moving.size else slice(1)
    inputs = {name: value[i, felt] for name, value in lanes.inputs.items()}
    return ElementWork(
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


def _given(lane: ElementWork) -> list[Array]:
    return [
        lane.theta,
        lane.x,
        lane.v,
        *lane.constants.values(),
        *lane.inputs.values(),
        *(c for _, c in lane.effects),
    ]


def equalise_steps(steps: Array, every: int) -> Array:
    """Return equal steps if the given ones differ only by rounding.

    A change of the step size costs an engine more than a step.

    Args:
        steps: (S,) step sizes in seconds, > 0.
        every: number of steps from one sample to the next.

    Returns:
        The steps (S,), equal or unchanged.
    """
    if not steps.size:
        return steps
    # The error of the sample times is compared, not that of each step, because errors of rounded
    # time stamps do not add up.
    even = math.fsum(steps) / steps.size
    ends = even * np.arange(1, steps.size + 1)
    missed = np.abs(np.cumsum(steps) - ends).max()
    alike = missed <= TIME_TOLERANCE * even * every
    return np.full(steps.size, even) if alike else steps


def split_into_legs(lane: ElementWork, *signals: Array) -> list[tuple[int, list[int]]]:
    """Split the steps into legs in which neither the step size nor any signal changes.

    Args:
        lane: batch element.
        *signals: (S,) signals.

    Returns:
        For each leg, the index of its first step, and the numbers of steps from one recorded state
        to the next, with the remainder to the end of the leg as the last number.
    """
    size = lane.steps.size
    new = np.zeros(size, dtype=bool)
    new[:1] = True
    for values in (lane.steps, *signals):
        new[1:] |= values[1:size] != values[: size - 1]
    # The engine is stopped at the beginning of each leg and where a state is recorded.
    stops = new.copy()
    stops[lane.recorded_steps[lane.recorded_steps < size]] = True
    begins = np.flatnonzero(stops)
    counts = np.diff(begins, append=size).tolist()
    firsts = new[begins].tolist()
    result: list[tuple[int, list[int]]] = []
    for begin, count, first in zip(begins.tolist(), counts, firsts, strict=True):
        if first:
            result.append((begin, []))
        result[-1][1].append(count)
    return result


def resolve_time_step(time_step: float | None, system: type[System]) -> float:
    """Return the longest step in seconds: the given one, or the default of the system's kind.

    Args:
        time_step: longest step in seconds; None for the default.
        system: system that the engine will integrate.

    Raises:
        InputError: the step is not finite or not positive.
    """
    if time_step is None:
        return DEFAULT_MAX_STEPS[system.kind]
    if not (is_plausible_number(time_step) and time_step > 0):
        found = truncate_text(str(time_step))
        raise InputError(f"time_step must be a positive number of seconds, found {found}")
    return float(time_step)
