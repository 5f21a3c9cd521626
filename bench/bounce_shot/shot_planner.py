"""Geometry of incline and hoop, and the drop height that scores with the largest clearance."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sims.core.simulator import Array, InputError, Scenario
from sims.systems.bounce_shot import BounceShot


@dataclass(frozen=True)
class ShotGeometry:
    """Geometry of a shot.

    Heights count from the point of the incline below the release, where x = 0.

    Attributes:
        angle: Angle of the incline, which descends towards x, rad.
        hoop_x: Centre of the hoop, a horizontal ring, m.
        hoop_z: Height of the hoop, m.
        hoop_radius: Radius of the hoop, m.
    """

    angle: float
    hoop_x: float
    hoop_z: float
    hoop_radius: float

    def __post_init__(self) -> None:
        """Check that the incline descends, and that the hoop is in front of it and above it.

        Raises:
            InputError: the scene is impossible.
        """
        if not (0 < self.angle < math.pi / 2 and self.hoop_x > 0 and self.hoop_radius > 0):
            raise InputError(
                "expected an incline between 0 and a right angle and a hoop in front of it,"
                f" found {self}"
            )
        if self.hoop_z <= -self.hoop_x * math.tan(self.angle):
            raise InputError(f"expected a hoop above the incline, found {self}")

    def compute_contact_height(self, radius: float) -> float:
        """Return the height of the centre of a ball that touches the incline at x = 0, m."""
        return radius / math.cos(self.angle)


def compute_hoop_crossings(path: Array, scene: ShotGeometry) -> Array:
    """Return the points where paths cross the hoop's plane downwards.

    Only the flight after the first bounce counts: from where z first rises to where it rises again.
    With the sample before the plane at height z1 and the one after it at z2, the hoop's plane at
    height h is crossed on the chord between them, at the share

        (z1 - h) / (z1 - z2)                                               (1)

    Args:
        path: Centres x, y, z of the ball (n, T, 3), m.
        scene: Geometry of the shot.

    Returns:
        Points x, y (n, 2), m; NaN for paths that do not cross.
    """
    path = np.asarray(path, dtype=np.float64)
    x, y, z = np.moveaxis(path, -1, 0)
    with np.errstate(invalid="ignore"):
        rises = z[:, 1:] > z[:, :-1]
        falls = z[:, 1:] < z[:, :-1]
        has_risen = np.logical_or.accumulate(rises, axis=1)
        fallen = np.logical_or.accumulate(has_risen & falls, axis=1)
        rises_again = np.logical_or.accumulate(fallen & rises, axis=1)
        # Downward only: a ball that crosses upwards has not scored.
        is_above = z[:, :-1] > scene.hoop_z
        is_below = z[:, 1:] <= scene.hoop_z
        down = has_risen & ~rises_again & is_above & is_below
    first = np.argmax(down, axis=1)
    rows = np.arange(len(z))
    high = z[rows, first]
    low = z[rows, first + 1]
    is_crossed = down.any(axis=1)  # for paths without a crossing, `first` is 0 and unused
    share = (high - scene.hoop_z) / np.where(is_crossed, high - low, 1.0)  # (1)
    at_x = x[rows, first] + share * (x[rows, first + 1] - x[rows, first])
    at_y = y[rows, first] + share * (y[rows, first + 1] - y[rows, first])
    crossing_points = np.stack([at_x, at_y], axis=1)
    result: Array = np.where(is_crossed[:, None], crossing_points, np.nan)
    return result


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
    """

    height: float = math.nan
    rim_margin: float = math.nan

    @property
    def is_found(self) -> bool:
        """True if a drop height was found."""
        return math.isfinite(self.height)


@dataclass(frozen=True)
class PlanningModel:
    """Model in which shots are planned.

    Attributes:
        simulator: Simulator with channels x, y, z.
        theta: (dim,) parameters of the simulator.
        constants: Known constants of the ball, such as radius and friction.
    """

    simulator: BounceShot
    theta: Array
    constants: Mapping[str, float]

    def simulate_flights(self, scene: ShotGeometry, heights: Array, times: Array) -> Array:
        """Simulate the paths from several drop heights.

        Args:
            scene: Geometry of incline and hoop.
            heights: (n,) drop heights, m.
            times: (T,) sample times, s.

        Returns:
            Centres (n, T, 3), m.
        """
        constants = {**self.constants, "incline_angle": scene.angle}
        scenarios = [
            Scenario(times, constants={**constants, "drop_height": float(height)})
            for height in heights
        ]
        return self.simulator.simulate_batch(np.tile(self.theta, (len(heights), 1)), scenarios)


def plan_shot(model: PlanningModel, scene: ShotGeometry, heights: tuple[float, float]) -> ShotPlan:
    """Find the drop height with the largest distance to the rim, by successively finer grids.

    Grids are used because the distance may have several maxima, and because heights from which the
    hoop is not reached give no search direction.

    Args:
        model: Tuned model.
        scene: Geometry of incline and hoop.
        heights: Minimum and maximum height, m.

    Raises:
        InputError: The heights are not positive and increasing.
    """
    low, high = heights
    if not 0 < low < high:
        raise InputError(f"expected drop heights above 0, the first the lower, found {heights}")
    times = np.arange(round(_FLIGHT_SECONDS * _SAMPLING_RATE) + 1) / _SAMPLING_RATE
    grid = np.linspace(low, high, _FIRST_GRID_SIZE)
    best = ShotPlan()
    for _ in range(_GRID_COUNT):
        crossings = compute_hoop_crossings(model.simulate_flights(scene, grid, times), scene)
        # Distances from the crossing points to the rim, positive inside the hoop.
        margins = scene.hoop_radius - np.hypot(crossings[:, 0] - scene.hoop_x, crossings[:, 1])
        if not np.isfinite(margins).any():
            break
        place = np.nanargmax(margins)
        best = ShotPlan(float(grid[place]), float(margins[place]))
        reach = float(grid[1] - grid[0])
        # Up to the neighbours of the best height: the maximum is between them.
        grid = np.linspace(
            max(low, best.height - reach), min(high, best.height + reach), _LATER_GRID_SIZE
        )
    return best
