"""Execute a planned shot in the true world."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bench.bounce_shot.shot_config import ShotConfig
from bench.bounce_shot.shot_geometry import compute_hoop_crossings, find_descent_index
from bench.bounce_shot.shot_planner import TunedModel, make_planning_model
from bench.bounce_shot.shot_sampling import ShotSetup
from bench.bounce_shot.true_world import InclinedGround, simulate_shot
from sims.core.simulator import Array

SAMPLING_RATE_HZ = 240.0
"""Sampling rate of a shot, Hz."""
MAX_SHOT_SECONDS = 3.0
"""Maximum duration of a shot, seconds."""


@dataclass(frozen=True)
class ShotResult:
    """Result of one shot.

    Attributes:
        is_hit: whether the centre passed through the hoop.
        miss_distance: where the centre passed the hoop's plane, m from the hoop's centre along x, >
            0 beyond it; NaN if it did not.
        prediction_error: mean distance in m between the planned and the flown centre at equal
            times, from the release until one of them has passed the hoop's plane.
        times: times, seconds, (T,).
        planned: planned path, (T, 3); NaN if there was no plan.
        flown: flown path, (T, 3).
    """

    is_hit: bool
    miss_distance: float
    prediction_error: float
    times: Array
    planned: Array
    flown: Array


def execute_shot(setup: ShotSetup, settings: ShotConfig, model: TunedModel) -> ShotResult:
    """Simulate the flight of a planned shot in the true world, with the shot's release error.

    The ball is dropped on the incline from the planned height, bounces once, and should pass
    through the hoop. The same drop is simulated in the tuned model, without a release error, for
    comparison.

    Args:
        setup: setup of the shot: its ball, drop, incline and hoop.
        settings: settings of the bounce shot, from the table [shot] of the experiment.
        model: tuned model with the plan.
    """
    times = np.arange(round(MAX_SHOT_SECONDS * SAMPLING_RATE_HZ) + 1) / SAMPLING_RATE_HZ
    # Without a plan (NaN), the shot is a miss.
    if not math.isfinite(model.height):
        no_path = np.full((times.size, 3), np.nan)
        return ShotResult(False, float("nan"), float("nan"), times, no_path, no_path)
    planning_model = make_planning_model(model, settings, setup.ball.radius)
    planned_path = planning_model.simulate_flights(setup.scene, np.array([model.height]), times)[0]
    # The true ball, friction and release, which the planner does not know.
    ground = InclinedGround(setup.scene.angle, settings.friction)
    x_error, height_error = setup.release
    contact_height = setup.scene.compute_contact_height(setup.ball.radius)
    start = (x_error, 0.0, contact_height + model.height + height_error)
    flown_path = simulate_shot(setup.ball, ground, start, times)
    ((x, y),) = compute_hoop_crossings(flown_path[None], setup.scene).tolist()
    miss_distance = x - setup.scene.hoop_x
    is_hit = math.hypot(miss_distance, y) < setup.scene.hoop_radius
    # Compare the paths until one of them has passed the hoop's plane: nothing was planned beyond.
    last = min(
        find_descent_index(planned_path, setup.scene.hoop_z),
        find_descent_index(flown_path, setup.scene.hoop_z),
    )
    error = float(np.linalg.norm(planned_path - flown_path, axis=1)[: last + 1].mean())
    return ShotResult(is_hit, miss_distance, error, times, planned_path, flown_path)


class ExampleShot(NamedTuple):
    """Example shot.

    Attributes:
        models: tuned models by method.
        results: executed shots by method.
        top: upper limit of the height axis, m.
    """

    models: dict[str, TunedModel]
    results: dict[str, ShotResult]
    top: float


def execute_example(
    settings: ShotConfig, setup: ShotSetup, methods: Sequence[str], stored: Mapping[str, Any]
) -> ExampleShot:
    """Execute a stored shot again with some methods, because stored results contain no paths.

    Args:
        settings: settings of the bounce shot, from the table [shot] of the experiment.
        setup: setup of the shot: its ball, drop, incline and hoop.
        methods: names of the methods.
        stored: stored results by name of the shot.
    """
    models = {model["method"]: TunedModel(**model) for model in stored[setup.name]["models"]}
    results = {method: execute_shot(setup, settings, models[method]) for method in methods}
    # 0.1 m above the highest flight.
    top = max(float(np.nanmax(result.flown[:, 2])) for result in results.values()) + 0.1
    return ExampleShot(models, results, top)
