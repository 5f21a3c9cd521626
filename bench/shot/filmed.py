"""Film a drop with a camera about three metres away, and track the ball in the film."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from bench.figures.track import drawn
from bench.recordings import tracking
from sims.base import Array
from sims.camera.camera import Camera
from sims.camera.files import Filmed, beside, described
from sims.camera.look import Look
from sims.camera.render import Stage
from sims.camera.video import write_video

DISTANCE = (2.8, 3.4)
"""Range of the camera's distance, m; the whole drop is in the picture."""
HEIGHT = (0.8, 1.4)
"""Range of the camera's height, m."""
AIM = 0.9
"""Height of the point at which the camera looks, m."""
NARROW = 0.4
"""Aspect ratio of the picture, width over height; a falling ball needs no wide picture."""


def filmed(
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
        float(rng.uniform(*pair)) for pair in ((0.0, 2.0 * math.pi), DISTANCE, HEIGHT)
    )
    # The codec halves the resolution of colour, so both dimensions must be even.
    size = (2 * round(NARROW * pixels / 2), pixels)
    camera, look = Camera(azimuth, distance, height, (0.0, 0.0, AIM), size=size), Look.drawn(rng)
    film = path.with_suffix(".mp4")
    # Recordings and films are never overwritten, and a killed process may have left some of them.
    for left in (
        film,
        beside(film),
        *(path.with_suffix(end) for end in (".csv", ".toml", ".png", ".pdf")),
    ):
        left.unlink(missing_ok=True)
    stage = Stage(camera, look, radius, rng)
    places = np.stack([np.zeros_like(heights), np.zeros_like(heights), heights], axis=1)
    write_video(
        film, stage.film(places), times, look.crf, {beside(film): described(Filmed(camera, radius))}
    )
    stage.close()
    tracking.write(film, path, drawn, scale="camera")
