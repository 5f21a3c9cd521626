"""Plan the drop height for which a simulator scores with the largest distance to the rim."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bench.bounce_shot.shot_geometry import ShotGeometry, compute_rim_margins
from sims.core.simulator import Array, InputError, Scenario
from sims.systems.bounce_shot import BounceShot

_FIRST_GRID_SIZE = 48
"""Number of heights of the first grid, over the whole range."""
_GRID_COUNT = 4
"""Number of successive grids, each around the best height of the previous one."""
_LATER_GRID_SIZE = 9
"""Number of heights of each later grid, which covers two intervals of the previous one."""
_FLIGHT_SECONDS = 3.0
"""Length of a simulated flight in seconds."""
_SAMPLING_RATE = 240.0
"""Sampling rate in Hz; the crossing of the hoop's plane is interpolated linearly."""


@dataclass(frozen=True)
class ShotPlan:
    """Planned shot.

    Attributes:
        height: Drop height, m; NaN if the simulator crosses the hoop's plane from no height.
        rim_margin: Simulated distance to the rim, m; negative if a miss is expected.
        times: (T,) times of the path, s.
        path: (T, 3) simulated x, y, z of the centre, m.
    """

    height: float
    rim_margin: float
    times: Array
    path: Array

    @property
    def is_found(self) -> bool:
        """True if a drop height was found."""
        return bool(np.isfinite(self.height))


def plan_shot(
    simulator: BounceShot,
    theta: Array,
    scene: ShotGeometry,
    constants: Mapping[str, float],
    heights: tuple[float, float],
) -> ShotPlan:
    """Find the drop height with the largest distance to the rim, by successively finer grids.

    Grids are used because the distance may have several maxima, and because heights from which the
    hoop is not reached give no search direction.

    Args:
        simulator: Tuned simulator with channels x, y, z.
        theta: (dim,) parameters of the simulator.
        scene: Geometry of incline and hoop.
        constants: Known constants of the ball, such as radius and friction.
        heights: Minimum and maximum height, m.

    Raises:
        InputError: The heights are not positive and increasing.
    """
    low, high = heights
    if not 0 < low < high:
        raise InputError(f"expected drop heights above 0, the first the lower, found {heights}")
    times = np.arange(round(_FLIGHT_SECONDS * _SAMPLING_RATE) + 1) / _SAMPLING_RATE
    grid = np.linspace(low, high, _FIRST_GRID_SIZE)
    best = float("nan")
    for _ in range(_GRID_COUNT):
        margins = compute_rim_margins(
            simulate_flights(simulator, theta, scene, constants, grid, times), scene
        )
        if not np.isfinite(margins).any():
            break
        best = float(grid[np.nanargmax(margins)])
        reach = float(grid[1] - grid[0])
        # Up to the neighbours of the best height: the maximum is between them.
        grid = np.linspace(max(low, best - reach), min(high, best + reach), _LATER_GRID_SIZE)
    if not np.isfinite(best):
        return ShotPlan(best, float("nan"), times, np.full((times.size, 3), np.nan))
    path = simulate_flights(simulator, theta, scene, constants, np.array([best]), times)
    return ShotPlan(best, float(compute_rim_margins(path, scene)[0]), times, path[0])


def simulate_flights(
    simulator: BounceShot,
    theta: Array,
    scene: ShotGeometry,
    constants: Mapping[str, float],
    heights: Array,
    times: Array,
) -> Array:
    """Simulate the paths from several drop heights.

    Args:
        simulator: Simulator with channels x, y, z.
        theta: (dim,) parameters of the simulator.
        scene: Geometry of incline and hoop.
        constants: Known constants of the ball.
        heights: (n,) drop heights, m.
        times: (T,) sample times, s.

    Returns:
        Centres (n, T, 3), m.
    """
    scenario_constants = {**constants, "incline_angle": scene.angle}
    scenarios = []
    for height in heights:
        scenarios.append(
            Scenario(times, constants={**scenario_constants, "drop_height": float(height)})
        )
    rows = np.repeat(np.atleast_2d(theta), len(heights), axis=0)
    return simulator.simulate_batch(rows, scenarios)
