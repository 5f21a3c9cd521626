"""Makes a planned shot in the world, and says how near the plan came."""

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
"""Samples a second at which a shot is followed, Hz."""
SECONDS = 3.0
"""For so long a shot is followed, s."""


@dataclass(frozen=True)
class Throw:
    """One shot.

    Attributes:
        hit: the centre came through the hoop.
        off: where it came through the hoop's plane, m from the centre along x, > 0 beyond it; NaN
            for never.
        prediction_error: mean distance in m between the planned and the flown centre at the same
            instants, from the release until the plan or the ball has come through the hoop's plane,
            whichever is first.
        times: (T,) seconds.
        planned: (T, 3), NaN where there was no plan.
        flown: (T, 3).
    """

    hit: bool
    off: float
    prediction_error: float
    times: Array
    planned: Array
    flown: Array


def throw(dealt: Deal, settings: Settings, model: TunedModel) -> Throw:
    """Make the planned shot, with the shot's release error."""
    times = np.arange(round(SECONDS * RATE) + 1) / RATE
    # No plan, no shot; which is a miss.
    if not math.isfinite(model.height):
        nothing = np.full((times.size, 3), np.nan)
        return Throw(False, float("nan"), float("nan"), times, nothing, nothing)
    heights = np.array([model.height])
    known = constants_of(settings, dealt.ball.radius)
    planned = flights(simulator_of(model), theta_of(model), dealt.scene, known, heights, times)[0]
    # From here on with what the planner did not know: the ball, the friction, the release.
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
    # Behind the hoop's plane nothing was planned.
    last = min(_through(planned, dealt.scene.hoop_z), _through(flown, dealt.scene.hoop_z))
    error = float(np.linalg.norm(planned - flown, axis=1)[: last + 1].mean())
    return Throw(hit, off, error, times, planned, flown)


def _through(path: Array, height: float) -> int:
    """Index of the sample after which a path comes down through a height after its bounce; its end
    if never.
    """
    z = path[:, 2]
    # Before its bounce the ball falls through the same heights.
    risen = np.logical_or.accumulate(z[1:] > z[:-1])
    down = np.flatnonzero(risen & (z[:-1] > height) & (z[1:] <= height))
    return int(down[0]) if down.size else len(z) - 1


def thrown(dealt: Deal, settings: Settings, made: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row a method: what was planned and what became of it."""
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
