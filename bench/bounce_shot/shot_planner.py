"""Plan shots in tuned models: find the drop height that keeps the ball farthest from the rim.

`plan_shot` searches the height in any model. `plan_tuned_shot` makes the model from the result of a
tuner, and stores the plan with it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.bounce_shot.shot_config import ShotConfig
from bench.bounce_shot.shot_geometry import ShotGeometry, compute_hoop_crossings
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

EffectCoefficients = Mapping[str, Sequence[float]]
"""Coefficients of effects, by the name of the effect."""


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
class TunedModel:
    """Tuned simulator and the shot planned in it.

    Attributes:
        method: label of the method.
        restitution: tuned restitution.
        effects: coefficients of the effects that explain added and that act on the shot.
        simulations: number of simulations used on this target.
        seconds: time used.
        status: as in status.csv; ``no plan`` if the model reaches the hoop from no height.
        reason: explanation of the status.
        height: planned drop height, m; NaN if there is none.
        margin: planned distance to the rim, m.
    """

    method: str
    restitution: float
    effects: EffectCoefficients
    simulations: int
    seconds: float
    status: str
    reason: str = ""
    height: float = float("nan")
    margin: float = float("nan")


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
        """Simulate the paths of the ball from several drop heights.

        Args:
            scene: Geometry of incline and hoop.
            heights: (n,) drop heights above contact with the incline, m.
            times: (T,) sample times, s.

        Returns:
            Centres x, y, z of the ball (n, T, 3), m.
        """
        constants = {**self.constants, "incline_angle": scene.angle}
        scenarios = [
            Scenario(times, constants={**constants, "drop_height": float(height)})
            for height in heights
        ]
        return self.simulator.simulate_batch(np.tile(self.theta, (len(heights), 1)), scenarios)


def plan_tuned_shot(
    model: TunedModel, settings: ShotConfig, scene: ShotGeometry, radius: float
) -> TunedModel:
    """Plan a shot in a tuned model, and store the planned drop height and distance to the rim.

    A method that crashed has no model and gets no plan. A finished method whose model reaches the
    hoop from no height gets the status "no plan"; after another end, such as a timeout, the status
    stays and the planned height is NaN.

    Args:
        model: simulator with the parameters that a tuner has found.
        settings: settings of the bounce shot, from the table [shot] of the experiment.
        scene: incline and hoop.
        radius: radius of the ball, m.
    """
    if model.status == "crashed":
        return model
    plan = plan_shot(make_planning_model(model, settings, radius), scene, settings.heights)
    if not plan.is_found and model.status in ("done", "converged"):
        return replace(
            model,
            status="no plan",
            reason="the model does not reach the hoop's plane from any height",
        )
    return replace(model, height=plan.height, margin=plan.rim_margin)


def make_planning_model(model: TunedModel, settings: ShotConfig, radius: float) -> PlanningModel:
    """Make the model in which a shot is planned: a bounce shot with the effects of a tuned model.

    The drop does not show friction and moment of inertia of the ball, so they are assumed.

    Args:
        model: tuned model; its effects act with fixed coefficients.
        settings: settings of the bounce shot, from the table [shot] of the experiment, with the
            assumed friction and moment of inertia.
        radius: radius of the ball, m.
    """
    constants = {
        "radius": radius,
        "friction": settings.planned_friction,
        "inertia_ratio": settings.planned_inertia,
    }
    simulator = BounceShot(fixed={name: list(values) for name, values in model.effects.items()})
    return PlanningModel(simulator, np.array([model.restitution]), constants)


def plan_shot(model: PlanningModel, scene: ShotGeometry, heights: tuple[float, float]) -> ShotPlan:
    """Find the drop height from which the ball passes the hoop farthest from its rim.

    Successively finer grids are simulated, because the distance may have several maxima, and
    heights from which the hoop is not reached give no search direction.

    Args:
        model: Tuned model.
        scene: Geometry of incline and hoop.
        heights: Minimum and maximum height, m.

    Returns:
        The plan; without a height if the hoop's plane is not crossed from any height.

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
        best_index = np.nanargmax(margins)
        best = ShotPlan(float(grid[best_index]), float(margins[best_index]))
        spacing = float(grid[1] - grid[0])
        # Up to the neighbours of the best height: the maximum is between them.
        grid = np.linspace(
            max(low, best.height - spacing), min(high, best.height + spacing), _LATER_GRID_SIZE
        )
    return best
