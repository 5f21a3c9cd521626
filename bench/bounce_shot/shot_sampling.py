"""Draw the setup of each shot, drop the ball, and record or film the drop.

They are the same for every method. The drop is filmed and tracked, or recorded as heights of the
centre with noise. Both are recordings in the common format.

They tune the simulator `ball-filmed`. It knows the radius of the ball and its drop height. For
training, cameras and balls of all kinds are drawn at random.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.benchmark.problem.experiment import Experiment
from bench.benchmark.problem.recording_observations import ObservedRuns
from bench.bounce_shot.shot_config import BallKind, ShotConfig, get_ball_kind
from bench.bounce_shot.shot_planner import ShotGeometry
from bench.bounce_shot.true_world import GRAVITY, InclinedGround, simulate_shot
from bench.core.random_streams import PUBLIC_SALT, make_rng
from bench.figures.recording_figure import render_track_figure
from bench.logs import film_tracking
from sims.core.simulator import Array, Scenario
from sims.recording.recording import Recording, Run
from sims.recording.recording_writer import write_recording
from sims.systems.ball import Ball as BallSimulator
from sims.vision.ball_renderer import BallScene, SceneAppearance
from sims.vision.pinhole_camera import (
    FilmDescription,
    PinholeCamera,
    format_camera_file,
    get_camera_file_path,
)
from sims.vision.video_files import write_video

CAMERA_DISTANCE_RANGE = (2.8, 3.4)
"""Range of the camera's distance, m; the whole drop is in the picture."""
CAMERA_HEIGHT_RANGE = (0.8, 1.4)
"""Range of the camera's height, m."""
CAMERA_TARGET_HEIGHT = 0.9
"""Height of the point at which the camera looks, m."""
ASPECT_RATIO = 0.4
"""Aspect ratio of the picture, width over height; a falling ball needs no wide picture."""
DEFAULT_HEIGHT = 1.5
"""Height from which the ball falls if the experiment states none, m."""


def film_and_track_drop(
    path: Path, heights: Array, times: Array, radius: float, pixels: int, rng: np.random.Generator
) -> None:
    """Film a drop, and write the tracked recording with description, film and camera.

    Args:
        path: CSV file of the recording.
        heights: heights of the ball's centre, m, (T,).
        times: times, seconds, (T,).
        radius: radius of the ball, m.
        pixels: height of the picture, even.
        rng: random generator for camera position, light, colours, noise and compression.

    Raises:
        InputError: the packages for films are missing, or the ball cannot be found in the film.
    """
    azimuth, distance, height = (
        float(rng.uniform(*pair))
        for pair in ((0.0, 2.0 * math.pi), CAMERA_DISTANCE_RANGE, CAMERA_HEIGHT_RANGE)
    )
    # The codec halves the resolution of colour, so both dimensions must be even.
    size = (2 * round(ASPECT_RATIO * pixels / 2), pixels)
    camera, appearance = (
        PinholeCamera(azimuth, distance, height, (0.0, 0.0, CAMERA_TARGET_HEIGHT), size=size),
        SceneAppearance.draw(rng),
    )
    film = path.with_suffix(".mp4")
    # Recordings and films are never overwritten, and a killed process may have left some of them.
    for leftover in (
        film,
        get_camera_file_path(film),
        *(path.with_suffix(end) for end in (".csv", ".toml", ".png", ".pdf")),
    ):
        leftover.unlink(missing_ok=True)
    scene = BallScene(camera, appearance, radius, rng)
    positions = np.stack([np.zeros_like(heights), np.zeros_like(heights), heights], axis=1)
    write_video(
        film,
        scene.render_frames(positions),
        times,
        appearance.crf,
        {get_camera_file_path(film): format_camera_file(FilmDescription(camera, radius))},
    )
    scene.close()
    film_tracking.track_film(film, path, render_track_figure, scale="camera")


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
        settings: settings of the bounce shot, from the table [shot] of the experiment.
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
        experiment: content of the experiment's TOML file: simulator, tuners, targets and budget.
        settings: settings of the bounce shot, from the table [shot] of the experiment.
        salt: salt from which the shots are drawn.
    """
    return [
        draw_shot(experiment, settings, kind, i, salt)
        for i in range(experiment.targets)
        for kind in settings.balls
    ]


def record_drop(experiment: Experiment, setup: ShotSetup, settings: ShotConfig, path: Path) -> None:
    """Record a drop of the ball on level ground, unless the recording exists already.

    Args:
        experiment: content of the experiment's TOML file: simulator, tuners, targets and budget.
        setup: setup of the shot: its ball, drop, incline and hoop.
        settings: settings of the bounce shot, from the table [shot] of the experiment.
        path: CSV file of the recording.
    """
    if path.exists() and path.with_suffix(".toml").exists():
        return
    # If only one of the two files exists, the process was killed while writing.
    for leftover in (path, path.with_suffix(".toml")):
        leftover.unlink(missing_ok=True)
    rng = make_rng(*_get_stream_prefix(setup.salt), experiment.name, "drop", setup.name)
    height = experiment.initial.get("z", DEFAULT_HEIGHT)
    drop_height = float(rng.uniform(*height)) if isinstance(height, tuple) else height
    radius, sampling = setup.ball.radius, experiment.sampling
    times = np.arange(sampling.samples) / sampling.rate
    heights = simulate_shot(
        setup.ball, InclinedGround(0.0, settings.friction), (0.0, 0.0, radius + drop_height), times
    )[:, 2]
    if settings.filmed:
        film_and_track_drop(path, heights, times, radius, round(settings.filmed), rng)
        return
    noise = experiment.noise.get("z", 0.0)
    noisy_heights = heights + noise * rng.standard_normal(heights.shape)
    # Rounded to 0.01 mm, far below any noise, to keep the file short.
    run = Run("1", times, {"z": np.round(noisy_heights, 5)}, {}, {}, {}, False)
    constants = {"radius": radius, "mass": setup.ball.mass, "gravity": GRAVITY}
    recording = Recording(path, "ball", f"a drop of {setup.name}", constants, {"z": noise}, (run,))
    write_recording(path, recording, BallSimulator)


ROW_CHANNEL = "v"
"""Channel of the ball's row in the picture, pixels from above."""


def make_pixel_experiment(experiment: Experiment, settings: ShotConfig) -> Experiment:
    """Make the experiment for a ball in front of an unknown camera.

    Args:
        experiment: content of the experiment's TOML file: simulator, tuners, targets and budget.
        settings: settings of the bounce shot, from the table [shot] of the experiment.
    """
    radii = [get_ball_kind(name).radius for name in settings.balls]
    return experiment.chosen(
        simulator="ball-filmed",
        observe=("z", ROW_CHANNEL),
        error_channel=ROW_CHANNEL,
        noise={},
        constants={
            **experiment.constants,
            "radius": (min(radii), max(radii)),
            "camera_azimuth": (0.0, 2.0 * math.pi),
            "camera_distance": CAMERA_DISTANCE_RANGE,
            "camera_height": CAMERA_HEIGHT_RANGE,
            "camera_aim": CAMERA_TARGET_HEIGHT,
            "pixels": settings.filmed,
        },
    )


def build_pixel_runs(recording: Recording, experiment: Experiment, radius: float) -> ObservedRuns:
    """Convert tracked rows to observations at the experiment's sample times.

    Samples in which the tracker saw nothing are NaN.

    Args:
        recording: a tracked drop, with the rows as extra column `v`.
        experiment: the experiment as returned by `make_pixel_experiment`.
        radius: radius of the ball, m.
    """
    (run,) = recording.runs
    times: Array = np.arange(experiment.sampling.samples) / experiment.sampling.rate
    # The recording may begin later or skip samples; each row is assigned by its time.
    indices = np.rint(run.times * experiment.sampling.rate).astype(np.intp)
    is_inside = indices < times.size
    observed: Array = np.full((times.size, 2), np.nan)
    observed[indices[is_inside], 1] = run.extra[ROW_CHANNEL][is_inside]
    heights = run.channels["z"]
    first = int(np.flatnonzero(np.isfinite(heights))[0])
    gravity = recording.constants["gravity"]
    # Released at rest at t = 0, and possibly first seen later: z(t) = z(0) - g t^2 / 2.
    height = float(heights[first] + 0.5 * gravity * run.times[first] ** 2)
    return ObservedRuns((Scenario(times, {"z": height}, {}, {"radius": radius}),), observed)
