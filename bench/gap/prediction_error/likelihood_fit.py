"""Parameters of a robot by maximum likelihood of the innovations: Gauss-Newton with step halving.

A simulation that begins far from the right parameters leaves the data within a second, and a fit to
it has many local minima. A filter stays near the data whatever the parameters are, so that its
innovations are nearly linear in them (L. Ljung, System Identification, 2nd ed., 1999, chapter 10).
What is found is where a fit by simulation begins.

Derivatives are differences of the innovations of whole filters. Responses about the measured
accelerations contain the noise of the innovations that they are to explain, which biases a step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from bench.gap.model.bounds import bound_of, coefficient_bounds
from bench.gap.model.noise import Noise
from bench.gap.model.widen import range_around, use_bounds
from bench.gap.model.world import World
from bench.gap.prediction_error.candidate_responses import FollowedRuns
from sims.base import Array

Bounds = tuple[float, float]
Follow: TypeAlias = Callable[[Array, FollowedRuns], FollowedRuns]

ITERATIONS = 8
"""Maximum number of Gauss-Newton steps for base parameters."""
DIFFERENCE = 1e-3
"""Share of a parameter's plausible range by which it is moved for its derivative."""
LEAST_GAIN = 1.0
"""Log likelihood that a step must gain for another one to follow."""
HALVINGS = 3
"""Number of times a step that gains nothing is halved."""
RESISTANCE = ("friction.coulomb", "drag.linear", "force.bias")
"""Effects at a joint that are fitted beside base parameters."""
MAX_JOINTS = 3
"""Maximum number of joints at which they are."""
RIDGE = 1e-9
"""Ridge of the normal equations, as a share of each parameter's sum of squares."""
MISSING = 20.0
"""Twice the log likelihood that must be lost without process noise for a force to be missing."""
CLEAR = 2.0
"""Log likelihood that base parameters must gain over the nominal ones."""


def identify_base(world: World, noise: Noise, followed: FollowedRuns) -> FollowedRuns:
    """Identify the base parameters of a robot from the innovations of a filter.

    Friction and constant forces of the joints where a force is missing are fitted beside them, and
    left out again: a mass without them would stand for them. The range of a parameter whose
    estimate lies outside is widened to contain it.

    Args:
        world: the runs for fitting.
        noise: of the sensors.
        followed: the runs, filtered with the nominal parameters.

    Returns:
        The runs, filtered with the parameters that were found; those of before where nothing gains
        or a parameter ends at the widest bound.
    """

    def follow(theta: Array, best: FollowedRuns) -> FollowedRuns:
        world.watch.stage("identifying the base parameters")
        return FollowedRuns.follow(world, theta, noise, None, force=best.force)

    places = world.base.tolist()
    limits = [range_around(world, i) for i in places]
    resisting = [(i, b) for name in _resistance(followed) for i, b in _coefficients(world, name)]
    found = []
    for beside in ([], resisting):
        own = [*places, *(i for i, _ in beside)]
        bounds = [*limits, *(one for _, one in beside)]
        tried = maximise_likelihood(followed, own, bounds, ITERATIONS, follow)
        ends = [bound_of(float(tried.theta[i]), *b) for i, b in zip(places, limits, strict=True)]
        if tried.is_sound and not any(ends):
            found.append(tried)
        # What friction could stand for is explained by the base parameters alone.
        if found and (tried.losses_without_force < MISSING).all():
            break
    best = max(found, key=lambda one: one.log_likelihood, default=followed)
    if best.log_likelihood - followed.log_likelihood < CLEAR:
        return followed
    values = {i: float(best.theta[i]) for i in places}
    outside = {i: v for i, v in values.items() if not _is_within(world.parameters[i].bounds, v)}
    wider = {world.parameters[i].name: range_around(world, i, v) for i, v in outside.items()}
    use_bounds(world, wider)
    theta = followed.theta.copy()
    theta[places] = best.theta[places]
    return follow(theta, best)


def _resistance(followed: FollowedRuns) -> list[str]:
    """Effects that resist the motion of the joints where most is missing."""
    world = followed.world
    coordinates = world.simulator.system.coordinates
    losses = followed.losses_without_force[: len(coordinates)]
    joints = [coordinates[j].removeprefix("q.") for j in np.argsort(-losses)[:MAX_JOINTS].tolist()]
    names = [f"{effect}@{joint}" for joint in joints for effect in RESISTANCE]
    return [name for name in names if name in world.slots]


def _coefficients(world: World, name: str) -> list[tuple[int, Bounds]]:
    """Places and bounds of an effect's coefficients."""
    return list(zip(world.places(name), coefficient_bounds(world, name), strict=True))


def maximise_likelihood(
    followed: FollowedRuns,
    places: Sequence[int],
    bounds: Sequence[Bounds],
    iterations: int,
    follow: Follow,
) -> FollowedRuns:
    """Return the runs, filtered with the likeliest parameters.

    Args:
        followed: the runs, filtered with the parameters with which to begin.
        places: of the parameters that are fitted.
        bounds: of these.
        iterations: maximum number of steps.
        follow: filters the runs with other parameters; told the best filter so far.
    """
    best = followed
    for _ in range(iterations):
        if best.world.watch.left():
            break
        step = _gauss_newton_step(best, places, bounds)
        gained = 0.0
        for _ in range(1 + HALVINGS):
            tried = follow(best.theta + step, best)
            gained = tried.log_likelihood - best.log_likelihood
            if gained > 0:
                best = tried
                break
            step = step / 2.0
        if gained < LEAST_GAIN:
            break
    return best


def _is_within(bounds: Bounds, value: float) -> bool:
    low, high = bounds
    return low <= value <= high


def single_step(followed: FollowedRuns, place: int, bounds: Bounds) -> tuple[float, float]:
    """Return the Gauss-Newton step of one parameter, and the log likelihood that it would gain if
    the innovations were linear.
    """
    target = followed.filtered.whitened
    column = _derivative(followed, target, place, bounds)
    squares = float(np.square(column).sum())
    if not squares > 0:
        return 0.0, 0.0
    low, high = bounds
    value = float(followed.theta[place])
    step = float(np.clip(value + (column * target).sum() / squares, low, high)) - value
    gain = step * float((column * target).sum()) - 0.5 * step**2 * squares
    return step, gain


def _derivative(followed: FollowedRuns, target: Array, place: int, bounds: Bounds) -> Array:
    """By how much the whitened innovations fall (R, T, C) for each unit of a parameter."""
    low, high = bounds
    first, last = followed.world.parameters[place].bounds
    step = DIFFERENCE * min(last - first, high - low)
    # A parameter without a range has no derivative.
    if not step > 0:
        return np.zeros_like(target)
    moved = followed.theta.copy()
    moved[place] += step if moved[place] + step <= high else -step
    change = target - followed.whitened_innovations(moved)
    derivative: Array = np.nan_to_num(change / (moved[place] - followed.theta[place]))
    return derivative


def _gauss_newton_step(
    followed: FollowedRuns, places: Sequence[int], bounds: Sequence[Bounds]
) -> Array:
    """The change of all parameters (P,) in a step of those at some places, within their bounds."""
    theta = followed.theta
    target = followed.filtered.whitened
    columns = [
        _derivative(followed, target, place, one) for place, one in zip(places, bounds, strict=True)
    ]
    rows = np.stack(columns, axis=-1).reshape(-1, len(places))
    scale = np.maximum(np.sqrt(np.square(rows).sum(axis=0)), 1e-300)
    rows = rows / scale
    normal = rows.T @ rows + RIDGE * np.eye(len(places))
    values = theta[list(places)]
    wanted = values + np.linalg.solve(normal, rows.T @ target.reshape(-1)) / scale
    low, high = np.array(bounds).T
    result: Array = np.zeros_like(theta)
    result[list(places)] = np.clip(wanted, low, high) - values
    return result
