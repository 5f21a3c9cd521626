"""Base parameters of a robot by prediction errors: Gauss-Newton on the innovations of a filter.

A simulation that begins far from the right parameters leaves the data within a second, and a fit to
it has many local minima. A filter stays near the data whatever the parameters are, so that its
innovations are nearly linear in them (L. Ljung, System Identification, 2nd ed., 1999, chapter 10).
What is found is where the fit by simulation begins.
"""

from __future__ import annotations

import numpy as np

from bench.gap.model.noise import Noise
from bench.gap.model.widen import range_around, use_bounds
from bench.gap.model.world import World
from bench.gap.prediction_error.candidate_responses import FollowedRuns
from sims.base import Array

ITERATIONS = 8
"""Maximum number of Gauss-Newton steps."""
DIFFERENCE = 1e-3
"""Share of a parameter's range by which it is moved for its derivative."""
LEAST_GAIN = 1.0
"""Log likelihood that a step must gain for another one to follow."""
HALVINGS = 4
"""Number of times a step that gains nothing is halved."""
RIDGE = 1e-9
"""Ridge of the normal equations, as a share of each parameter's sum of squares."""
CLEAR = 2.0
"""Log likelihood that the result must gain over the nominal parameters."""


def identify_base(world: World, noise: Noise, followed: FollowedRuns) -> FollowedRuns:
    """Identify the base parameters of a robot from the innovations of a filter.

    The range of a parameter whose estimate lies outside is widened to contain it.

    Args:
        world: the runs for fitting.
        noise: of the sensors.
        followed: the runs, filtered with the nominal parameters.

    Returns:
        The runs, filtered with the parameters that were found; those of before where nothing gains.
    """
    places = world.base.tolist()
    limits = np.array([range_around(world, i) for i in places]).reshape(-1, 2)
    best = followed
    for _ in range(ITERATIONS):
        if world.watch.left():
            break
        world.watch.stage("identifying the base parameters")
        step = _gauss_newton_step(best, places)
        tried, gained = best, 0.0
        for _ in range(HALVINGS):
            theta = best.theta.copy()
            theta[places] = np.clip(theta[places] + step, limits[:, 0], limits[:, 1])
            tried = FollowedRuns.follow(world, theta, noise, None, force=best.force)
            gained = tried.log_likelihood - best.log_likelihood
            if gained > 0:
                break
            step = step / 2.0
        if gained > 0:
            best = tried
        if gained < LEAST_GAIN:
            break
    if best.log_likelihood - followed.log_likelihood < CLEAR or not best.is_sound:
        return followed
    use_bounds(
        world,
        {
            world.parameters[i].name: range_around(world, i, float(best.theta[i]))
            for i in places
            if not _is_within(world.parameters[i].bounds, float(best.theta[i]))
        },
    )
    return best


def _is_within(bounds: tuple[float, float], value: float) -> bool:
    low, high = bounds
    return low <= value <= high


def _gauss_newton_step(followed: FollowedRuns, places: list[int]) -> Array:
    """The change of the parameters that the innovations ask for (b,)."""
    world = followed.world
    target = followed.whitened_innovations(followed.theta)
    columns = []
    for i in places:
        low, high = world.parameters[i].bounds
        step = DIFFERENCE * (high - low)
        theta = followed.theta.copy()
        theta[i] += step if theta[i] + step <= high or theta[i] < low else -step
        moved = followed.whitened_innovations(theta)
        columns.append((target - moved) / (theta[i] - followed.theta[i]))
    rows = np.nan_to_num(np.stack(columns, axis=-1).reshape(-1, len(places)))
    scale = np.maximum(np.sqrt(np.square(rows).sum(axis=0)), 1e-300)
    rows = rows / scale
    normal = rows.T @ rows + RIDGE * np.eye(len(places))
    found: Array = np.linalg.solve(normal, rows.T @ target.reshape(-1)) / scale
    return found
