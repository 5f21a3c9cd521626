"""Draw ball, scene and release error of each shot, and record the ball's drop.

They are the same for every method. The drop is filmed and tracked, or recorded as heights of the
centre with noise. Both are recordings in the common format.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.benchmark.problem.experiment import Experiment
from bench.bounce_shot.ball_kinds import BallKind, get_ball_kind
from bench.bounce_shot.filmed_drop import film_and_track_drop
from bench.bounce_shot.shot_config import ShotConfig
from bench.bounce_shot.shot_geometry import ShotGeometry
from bench.bounce_shot.true_world import GRAVITY, InclinedGround, simulate_shot
from bench.core.random_streams import PUBLIC_SALT, make_rng
from sims.recording.recording import Recording, Run, read_recording
from sims.recording.recording_writer import write_recording
from sims.systems.ball import Ball as BallSimulator

RECORDINGS_FOLDER = "recordings"
"""Name of the folder of recorded drops, in the folder of a study."""


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
    """Draw a shot; the result does not depend on the methods or the number of shots.

    Args:
        experiment: the experiment; its name is part of the seed.
        settings: the [shot] table.
        kind: kind of ball.
        index: index of the shot with this kind of ball.
        salt: salt from which the shot is drawn.
    """
    rng = make_rng(*_get_stream_prefix(salt), experiment.name, "shot", kind, index)
    # The order of the draws is part of the experiment: another order gives other shots.
    ball = get_ball_kind(kind).draw_ball(rng)
    angle, x, drop = (
        float(rng.uniform(*pair)) for pair in (settings.angle, settings.hoop_x, settings.hoop_drop)
    )
    dx, dz = (settings.release * rng.standard_normal(2)).tolist()
    # The centre of a ball that touches the incline at x = 0 is radius / cos(angle) above it.
    touching = ball.radius / math.cos(angle)
    scene = ShotGeometry(angle, x, touching - drop, settings.hoop_radius)
    return ShotSetup(f"{kind}-{index:03d}", ball, scene, (dx, dz), salt)


def _get_stream_prefix(salt: str) -> tuple[str, ...]:
    """Return the first words of the names of random streams; none for a public salt."""
    return () if salt in ("", PUBLIC_SALT) else ("salt", salt)


def draw_shots(experiment: Experiment, settings: ShotConfig, salt: str = "") -> list[ShotSetup]:
    """Draw all shots of an experiment.

    The kinds of balls alternate, so that an interrupted study has shots of each.

    Args:
        experiment: the experiment.
        settings: the [shot] table.
        salt: salt from which the shots are drawn.
    """
    return [
        draw_shot(experiment, settings, kind, i, salt)
        for i in range(experiment.targets)
        for kind in settings.balls
    ]


def compute_visible_share(path: Path, experiment: Experiment) -> float:
    """Compute the fraction of a drop's sample times at which its recording has a height.

    Args:
        path: the recording.
        experiment: the experiment, for the number of samples.
    """
    z = read_recording(path, BallSimulator, whole=True).runs[0].channels["z"]
    return float(np.isfinite(z).sum() / experiment.sampling.samples)


def record_drop(experiment: Experiment, setup: ShotSetup, settings: ShotConfig, path: Path) -> None:
    """Record a drop of the ball on level ground, unless the recording exists already.

    Args:
        experiment: the experiment.
        setup: the shot.
        settings: the [shot] table.
        path: CSV file of the recording.
    """
    if path.exists() and path.with_suffix(".toml").exists():
        return
    # If only one of the two files exists, the process was killed while writing.
    for leftover in (path, path.with_suffix(".toml")):
        leftover.unlink(missing_ok=True)
    rng = make_rng(*_get_stream_prefix(setup.salt), experiment.name, "drop", setup.name)
    height = experiment.initial.get("z", 1.5)
    drop_height = float(rng.uniform(*height)) if isinstance(height, tuple) else height
    radius, sampling = setup.ball.radius, experiment.sampling
    times = np.arange(sampling.samples) / sampling.rate
    z = simulate_shot(
        setup.ball, InclinedGround(0.0, settings.friction), (0.0, 0.0, radius + drop_height), times
    )[:, 2]
    if settings.filmed:
        film_and_track_drop(path, z, times, radius, round(settings.filmed), rng)
        return
    noise = experiment.noise.get("z", 0.0)
    noisy_heights = z + noise * rng.standard_normal(z.shape)
    # Rounded to 0.01 mm, far below any noise, to keep the file short.
    run = Run("1", times, {"z": np.round(noisy_heights, 5)}, {}, {}, {}, False)
    constants = {"radius": radius, "mass": setup.ball.mass, "gravity": GRAVITY}
    recording = Recording(path, "ball", f"a drop of {setup.name}", constants, {"z": noise}, (run,))
    write_recording(path, recording, BallSimulator)
