"""Draw the setup of each shot: its ball, incline, hoop and release error.

They are the same for every method.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from bench.benchmark.problem.experiment_config import Experiment
from bench.bounce_shot.shot_config import BallKind, ShotConfig, get_ball_kind
from bench.bounce_shot.shot_geometry import ShotGeometry
from bench.core.random_streams import PUBLIC_SALT, make_rng


@dataclass(frozen=True)
class ShotSetup:
    """Ball, scene and release error of one shot.

    Attributes:
        name: for example ``tennis-007``.
        ball: true ball, which only the true world uses.
        scene: incline and hoop, which all methods know.
        release: error of the release position, m: along x, and in height.
        salt: salt from which the shot was drawn.
    """

    name: str
    ball: BallKind
    scene: ShotGeometry
    release: tuple[float, float]
    salt: str = ""


def draw_shot(
    experiment: Experiment, settings: ShotConfig, kind: str, index: int, salt: str = ""
) -> ShotSetup:
    """Draw the ball, the scene and the release error of a shot.

    The result does not depend on the methods or the number of shots.

    Args:
        experiment: the experiment; its name is part of the seed.
        settings: settings of the bounce shot, from the table [shot] of the experiment.
        kind: kind of ball.
        index: index of the shot with this kind of ball.
        salt: text that is part of the seed, so that the shot cannot be predicted without it; a
            public or empty one is left out.
    """
    rng = make_rng(*get_stream_prefix(salt), experiment.name, "shot", kind, index)
    # The order of the draws is part of the experiment: another order gives other shots.
    ball = get_ball_kind(kind).draw_ball(rng)
    angle = float(rng.uniform(*settings.angle))
    hoop_x = float(rng.uniform(*settings.hoop_x))
    hoop_drop = float(rng.uniform(*settings.hoop_drop))
    x_error, height_error = (settings.release * rng.standard_normal(2)).tolist()
    # Height of the centre of a ball that touches the incline at x = 0.
    contact_height = ball.radius / math.cos(angle)
    scene = ShotGeometry(angle, hoop_x, contact_height - hoop_drop, settings.hoop_radius)
    return ShotSetup(f"{kind}-{index:03d}", ball, scene, (x_error, height_error), salt)


def get_stream_prefix(salt: str) -> tuple[str, ...]:
    """Return the first words of the names of random streams: the salt, unless it is public."""
    return () if salt in ("", PUBLIC_SALT) else ("salt", salt)


def draw_shots(experiment: Experiment, settings: ShotConfig, salt: str = "") -> list[ShotSetup]:
    """Draw all shots of an experiment.

    The kinds of balls alternate, so that an interrupted study has shots of each.

    Args:
        experiment: content of the experiment's TOML file: simulator, tuners, targets and budget.
        settings: settings of the bounce shot, from the table [shot] of the experiment.
        salt: text that is part of the seeds, so that shots cannot be predicted without it.
    """
    return [
        draw_shot(experiment, settings, kind, i, salt)
        for i in range(experiment.targets)
        for kind in settings.balls
    ]
