"""Drop the ball of a shot on level ground, and record or film the drop.

The drop is filmed and tracked, or recorded as heights of the centre with noise. Both are recordings
in the common format.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from bench.benchmark.problem.experiment_config import Experiment
from bench.bounce_shot.shot_config import ShotConfig
from bench.bounce_shot.shot_sampling import ShotSetup, get_stream_prefix
from bench.bounce_shot.true_world import GRAVITY, InclinedGround, simulate_shot
from bench.core.random_streams import make_rng
from bench.figures.ball_track_figure import render_track_figure
from bench.logs import ball_heights_from_film
from sims.core.simulator import Array
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
    """Film a drop with a random camera, track the film, and write the tracked recording.

    The film, its camera and a figure of the track are written next to the recording. Files of an
    interrupted call are replaced.

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
    azimuth = float(rng.uniform(0.0, 2.0 * math.pi))
    distance = float(rng.uniform(*CAMERA_DISTANCE_RANGE))
    height = float(rng.uniform(*CAMERA_HEIGHT_RANGE))
    # The codec halves the resolution of colour, so both dimensions must be even.
    size = (2 * round(ASPECT_RATIO * pixels / 2), pixels)
    target = (0.0, 0.0, CAMERA_TARGET_HEIGHT)
    camera = PinholeCamera(azimuth, distance, height, target, size=size)
    appearance = SceneAppearance.draw(rng)
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
    ball_heights_from_film.track_film(film, path, render_track_figure, scale="camera")


RECORDINGS_FOLDER = "recordings"
"""Name of the folder of recorded drops, in the folder of a study."""


def record_drop(experiment: Experiment, setup: ShotSetup, settings: ShotConfig, path: Path) -> None:
    """Record a drop of the ball on level ground, unless the recording exists already.

    The true world is simulated. The drop is filmed and tracked if the experiment has a film;
    otherwise heights with noise are recorded.

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
    rng = make_rng(*get_stream_prefix(setup.salt), experiment.name, "drop", setup.name)
    # Height of the ball's lowest point above the ground, m: a number, or a range to draw from.
    height = experiment.initial.get("z", DEFAULT_HEIGHT)
    drop_height = float(rng.uniform(*height)) if isinstance(height, tuple) else height
    radius, sampling = setup.ball.radius, experiment.sampling
    times = np.arange(sampling.samples) / sampling.rate
    ground = InclinedGround(0.0, settings.friction)
    centres = simulate_shot(setup.ball, ground, (0.0, 0.0, radius + drop_height), times)
    heights = centres[:, 2]
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
