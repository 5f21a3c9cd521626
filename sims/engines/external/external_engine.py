"""Shared integration of batch elements by an external engine, one body at a time, with its forces.

Forces are applied through the engine's interface.

Bullet and MuJoCo (with its Euler integrator) both step with semi-implicit Euler: with step h,

    w' = w + h (G(x) + F) / M                                              (1)
    x' = x + h w'                                                          (2)

where G is the gravity that the engine itself applies and F is the force applied from outside. This
is of first order if w is read as the velocity at the time of x, and of second order if it is read
as the velocity half a step earlier (leapfrog; Hairer, Lubich, Wanner, Acta Numerica 12, 2003,
doi:10.1017/S0962492902000144), with a(x) the acceleration at x:

    w = v - h/2 a(x)                                                       (3)

`external.joint_integration` and `external.ball_integration` read it in this way: they choose F such
that the engine's velocity becomes the velocity at x plus half a step of acceleration. Forces are
those of a force program (`external.element_forces`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from sims.core.argument_checks import check_positive
from sims.core.effect import Contact, Force, Friction
from sims.core.engine import IntegrationBatch, Trajectories
from sims.core.simulator import Array, Indices
from sims.core.system import System
from sims.engines.compiled.force_program import ForceProgram, get_force_program
from sims.engines.time_grid import equalise_steps

DEFAULT_MAX_STEPS = {"point": 1 / 120, "linear": 2.5e-3, "rotary": 2.5e-3}
"""Default longest step in seconds, by the system's kind."""

Trajectory = tuple[Array, Array, Array]
"""Trajectory of one batch element: positions, velocities and accelerations, each (N, D)."""


@dataclass(frozen=True, kw_only=True)
class ElementWork(IntegrationBatch):
    """Batch of a single element, without effects whose coefficients are all zero.

    Its steps are all > 0; steps of zero length are left out. Inputs have at least one value.

    Attributes:
        program: force program of the system and the effects.
        parameters: (P,) parameters of the program.
        recorded_steps: (N,) increasing step counts, beginning with 0, after which the state is
            recorded.
    """

    program: ForceProgram
    parameters: Array
    recorded_steps: Indices

    @property
    def plain_constants(self) -> dict[str, float]:
        """Constants as floats, by name."""
        return {name: float(value[0, 0]) for name, value in self.constants.items()}


RolloutFunction = Callable[[ElementWork], Trajectory]
"""Function that integrates one batch element.

The rows of the trajectory are those of `ElementWork.recorded_steps`; they are NaN where the
integration failed.
"""


def integrate_batch(
    batch: IntegrationBatch, rollouts: Sequence[RolloutFunction], discard: Callable[[], None]
) -> Trajectories:
    """Integrate the batch elements one after the other.

    Elements whose numbers are not finite are not integrated. With several rollouts, the elements
    are divided among threads.

    Args:
        batch: batch to integrate.
        rollouts: functions that integrate one element, each with its own world; with several of
            them, each runs in its own thread.
        discard: called after a failure or interruption, which may leave the engine's world in any
            state.

    Returns:
        The trajectories. An element with a number or result that is not finite is all NaN.
    """
    count = batch.steps.shape[1] // batch.steps_per_sample + 1
    trajectories = Trajectories(
        *(np.full((len(batch.theta), count, batch.x.shape[1]), np.nan) for _ in range(3))
    )
    # Index of each element, what its rollout needs, and the recorded state that each of the `count`
    # rows of its result repeats.
    work: list[tuple[int, ElementWork, Indices]] = []
    for element_index in range(len(batch.theta)):
        # Elements of one run are adjacent and have the same steps.
        if element_index == 0 or not np.array_equal(
            batch.steps[element_index], batch.steps[element_index - 1]
        ):
            moving, steps, recorded_steps, output_rows = _compute_timing(
                batch.steps[element_index], batch.steps_per_sample
            )
        element = _make_element(batch, element_index, moving, steps, recorded_steps)
        # A rollout that is certain to fail would cost the engine its world.
        if all(np.isfinite(values).all() for values in _list_numbers(element)):
            work.append((element_index, element, output_rows))

    def integrate_share(k: int) -> None:
        """Integrate every n-th element from the k-th on with rollout k of n, in its own thread.

        A failed element stays NaN, and the world is discarded, because it may be in any
        state.
        """
        for element_index, element, rows in work[k :: len(rollouts)]:
            trajectory = rollouts[k](element)
            if not is_finite(trajectory):
                discard()
                continue
            for result, values in zip(
                (trajectories.x, trajectories.v, trajectories.a), trajectory, strict=True
            ):
                result[element_index] = values[rows]

    try:
        if len(rollouts) == 1:
            integrate_share(0)
        else:
            with ThreadPoolExecutor(len(rollouts)) as pool:
                list(pool.map(integrate_share, range(len(rollouts))))
    except BaseException:  # an interrupted rollout leaves applied forces in the world
        discard()
        raise
    return trajectories


def is_finite(path: Trajectory) -> bool:
    """Return whether all numbers of a trajectory are finite."""
    return all(bool(np.isfinite(values).all()) for values in path)


def _compute_timing(steps: Array, steps_per_sample: int) -> tuple[Indices, Array, Indices, Indices]:
    """Return which steps of one element have a length, and when its state is recorded.

    Shapes: S steps.

    Args:
        steps: (S,) step sizes in seconds; zero where the element waits.
        steps_per_sample: number of steps from one recorded state to the next.

    Returns:
        Indices of the steps with length > 0, their lengths, the step counts at which a state is
        recorded, and for each record the index of its state.
    """
    moves = steps > 0
    moving = np.flatnonzero(moves)
    # Steps with length before each record. Records between which the element only waited have the
    # same number, and use the same state.
    step_counts = np.concatenate([[0], np.cumsum(moves)])[::steps_per_sample]
    recorded, rows = np.unique(step_counts, return_inverse=True)
    return moving, equalise_steps(steps[moving], steps_per_sample), recorded, rows


def _make_element(
    batch: IntegrationBatch, i: int, moving: Indices, steps: Array, recorded_steps: Indices
) -> ElementWork:
    """Collect everything that a rollout needs of batch element i, with the program of its forces.

    Args:
        batch: the whole batch.
        i: number of the element.
        moving: indices of the steps that are not zero.
        steps: lengths of these steps in seconds.
        recorded_steps: numbers of the steps after which the state is recorded.
    """
    element = batch.select(np.array([i]))
    # Effects whose coefficients are all zero do nothing.
    effects = tuple((effect, c) for effect, c in element.effects if c.any())
    # The force program computes these; the other effects are applied elsewhere.
    forces = [(e, c) for e, c in effects if isinstance(e, Force | Friction | Contact)]
    # The parameters of the program: those of the system, its constants, then coefficients.
    numbers = [element.theta[0], *(value[0] for value in element.constants.values())]
    # Steps whose inputs are kept: those with a length.
    # An element without any step of positive length still has an input at its single time.
    input_steps = moving if moving.size else slice(1)
    changes = {
        "steps": steps[None],
        "inputs": {name: values[:, input_steps] for name, values in element.inputs.items()},
        "effects": effects,
    }
    return ElementWork(
        **(vars(element) | changes),
        program=get_force_program(element, np.array([0]), [effect for effect, _ in forces]),
        parameters=np.concatenate([*numbers, *(c[:, 0, 0] for _, c in forces)]),
        recorded_steps=recorded_steps,
    )


def _list_numbers(element: ElementWork) -> list[Array]:
    """Return all numbers of an element, to check that they are finite before a rollout."""
    return [
        element.theta,
        element.x,
        element.v,
        *element.constants.values(),
        *element.inputs.values(),
        *(c for _, c in element.effects),
    ]


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
    return check_positive("time_step", time_step)
