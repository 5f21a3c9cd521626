"""Finds the drop height for which a simulator scores, with as much room to the rim as there is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sims.base import Array, InputError, Scenario
from sims.shot.scene import ShotScene, margins
from sims.shot.simulator import BounceShot

_GRID = 48
"""Heights of the first grid, over the whole range."""
_ROUNDS = 4
"""Grids, each around the best height of the one before."""
_ZOOM = 9
"""Heights of each later grid, over two spaces of the one before."""


@dataclass(frozen=True)
class Plan:
    """A shot.

    Attributes:
        height: drop height, m; NaN where the simulator reaches the hoop's plane from none.
        margin: the simulator's distance to the rim, m; negative where it expects to miss.
        times: (T,) seconds.
        path: (T, 3) x, y, z of the centre as simulated.
    """

    height: float
    margin: float
    times: Array
    path: Array

    @property
    def found(self) -> bool:
        """Whether there is a height at all."""
        return bool(np.isfinite(self.height))


def plan(
    simulator: BounceShot,
    theta: Array,
    scene: ShotScene,
    constants: Mapping[str, float],
    heights: tuple[float, float],
    seconds: float = 3.0,
    rate: float = 240.0,
) -> Plan:
    """The drop height of the largest margin.

    A grid over all heights, then finer ones around its best: there is one maximum as a rule, but
    need not be, and a height from which the hoop is not reached gives no direction.

    Args:
        simulator: tuned, with channels x, y, z.
        theta: (dim,) its parameters.
        scene: incline and hoop.
        constants: what is known of the ball: radius, friction ...
        heights: lowest and highest, m.
        seconds: length of the simulated flight.
        rate: samples a second; the hoop's plane is met on the chord between two.

    Raises:
        InputError: impossible heights.
    """
    low, high = heights
    if not 0 < low < high:
        raise InputError(f"expected drop heights above 0, the first the lower, found {heights}")
    times = np.arange(round(seconds * rate) + 1) / rate
    grid = np.linspace(low, high, _GRID)
    best = float("nan")
    for _ in range(_ROUNDS):
        room = margins(flights(simulator, theta, scene, constants, grid, times), scene)
        if not np.isfinite(room).any():
            break
        best = float(grid[np.nanargmax(room)])
        reach = float(grid[1] - grid[0])
        # As far as the neighbours of the best: the maximum lies between them.
        grid = np.linspace(max(low, best - reach), min(high, best + reach), _ZOOM)
    if not np.isfinite(best):
        return Plan(best, float("nan"), times, np.full((times.size, 3), np.nan))
    path = flights(simulator, theta, scene, constants, np.array([best]), times)
    return Plan(best, float(margins(path, scene)[0]), times, path[0])


def flights(
    simulator: BounceShot,
    theta: Array,
    scene: ShotScene,
    constants: Mapping[str, float],
    heights: Array,
    times: Array,
) -> Array:
    """Simulated paths (n, T, 3) from drop heights (n,)."""
    known = {**constants, "incline_angle": scene.angle}
    scenarios = []
    for height in heights:
        scenarios.append(Scenario(times, constants={**known, "drop_height": float(height)}))
    rows = np.repeat(np.atleast_2d(theta), len(heights), axis=0)
    return simulator.simulate_lanes(rows, scenarios)
