"""Film a drop with a camera about three metres away, and track the ball in the film."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from bench.figures.recording_figure import render_track_figure
from bench.logs import film_tracking
from sims.core.simulator import Array
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
