"""Execute a planned shot in the true world, and compute the prediction error."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.shot.deal import Deal
from bench.shot.settings import Settings
from bench.shot.tune import TunedModel, constants_of, simulator_of, theta_of
from sims.base import Array
from sims.shot.planner import flights
from sims.shot.scene import crossings
from sims.shot.world import Ground, fly

RATE = 240.0
"""Sampling rate of a shot, Hz."""
SECONDS = 3.0
"""Maximum duration of a shot, seconds."""


@dataclass(frozen=True)
class Throw:
    """Result of one shot.

    Attributes:
        hit: whether the centre passed through the hoop.
        off: where the centre passed the hoop's plane, m from the hoop's centre along x, > 0 beyond
            it; NaN if it did not.
        prediction_error: mean distance in m between the planned and the flown centre at equal
            times, from the release until one of them has passed the hoop's plane.
        times: times, seconds, (T,).
        planned: planned path, (T, 3); NaN if there was no plan.
        flown: flown path, (T, 3).
    """

    hit: bool
    off: float
    prediction_error: float
    times: Array
    planned: Array
    flown: Array


def throw(dealt: Deal, settings: Settings, model: TunedModel) -> Throw:
    """Execute a planned shot, with the shot's release error.

    Args:
        dealt: the shot.
        settings: the [shot] table.
        model: tuned model with the plan.
    """
    times = np.arange(round(SECONDS * RATE) + 1) / RATE
    # Without a plan, the shot is a miss.
    if not math.isfinite(model.height):
        nothing = np.full((times.size, 3), np.nan)
        return Throw(False, float("nan"), float("nan"), times, nothing, nothing)
    heights = np.array([model.height])
    known = constants_of(settings, dealt.ball.radius)
    planned = flights(simulator_of(model), theta_of(model), dealt.scene, known, heights, times)[0]
    # The true ball, friction and release, which the planner does not know.
    ground = Ground(dealt.scene.angle, settings.friction)
    start = (
        dealt.release[0],
        0.0,
        dealt.scene.touching(dealt.ball.radius) + model.height + dealt.release[1],
    )
    flown = fly(dealt.ball, ground, start, times)
    x, y = crossings(flown[None], dealt.scene)[0].tolist()
    off = x - dealt.scene.hoop_x
    hit = math.hypot(off, y) < dealt.scene.hoop_radius
    # Beyond the hoop's plane, nothing was planned.
    last = min(_through(planned, dealt.scene.hoop_z), _through(flown, dealt.scene.hoop_z))
    error = float(np.linalg.norm(planned - flown, axis=1)[: last + 1].mean())
    return Throw(hit, off, error, times, planned, flown)


def _through(path: Array, height: float) -> int:
    """Return the index of the sample after which a path descends through a height after its bounce.

    If it does not, return the last index.
    """
    z = path[:, 2]
    # Before its bounce, the ball falls through the same heights.
    risen = np.logical_or.accumulate(z[1:] > z[:-1])
    down = np.flatnonzero(risen & (z[:-1] > height) & (z[1:] <= height))
    return int(down[0]) if down.size else len(z) - 1


def thrown(dealt: Deal, settings: Settings, made: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Execute the shot of each method, and build the result rows.

    Args:
        dealt: the shot.
        settings: the [shot] table.
        made: fields of the tuned model of each method.
    """
    return [
        _row(dealt, model, throw(dealt, settings, model))
        for model in (TunedModel(**row) for row in made)
    ]


def _row(dealt: Deal, model: TunedModel, made: Throw) -> dict[str, Any]:
    effects: Mapping[str, Any] = model.effects
    return {
        "shot": dealt.name,
        "ball": dealt.name.rpartition("-")[0],
        "method": model.method,
        "hit": made.hit,
        "off": made.off,
        "margin": dealt.scene.hoop_radius - abs(made.off),
        "planned_margin": model.margin,
        "prediction_error": made.prediction_error,
        "drop_height": model.height,
        "restitution": model.restitution,
        "true_restitution": dealt.ball.restitution,
        "effects": "; ".join(
            f"{name} {', '.join(f'{v:.4g}' for v in values)}" for name, values in effects.items()
        ),
        "simulations": model.simulations,
        "seconds": model.seconds,
        "status": model.status,
        "reason": model.reason.strip().splitlines()[-1] if model.reason.strip() else "",
    }
