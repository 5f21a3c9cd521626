"""Render a recorded ball motion as a video, and write the camera that was used."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.problem.seeds import rng_for
from bench.recordings.size import check_film
from sims.ball.system import BallSystem
from sims.base import InputError, unknown
from sims.camera.camera import Camera
from sims.camera.files import Filmed, beside, described
from sims.camera.look import Look
from sims.camera.render import Stage
from sims.camera.video import write_video
from sims.recording.recording import read_recording, system_of
from sims.recording.write import refuse_existing


def write(
    recording: Path, out: Path, run: str | None, pixels: int, seed: int, force: bool = False
) -> tuple[int, float]:
    """Film one run with a camera drawn from a seed, whose parameters are published with the film.

    Args:
        recording: Path of a recording of system ball.
        out: Path of the video.
        run: Name of the run; None for the first one.
        pixels: Size of the image in pixels, even, at least 16.
        seed: Seed of the camera and of the look of the film.
        force: Whether to render a film that exceeds the size limit.

    Returns:
        Number of frames, and duration in seconds.

    Raises:
        InputError: The recording is not of a ball or has no heights, or the video cannot be
            written.
    """
    # Check this before the work, since rendering takes a while.
    refuse_existing([out, beside(out)])
    if pixels < 16 or pixels % 2:
        raise InputError(f"size {pixels}: expected an even number of at least 16 pixels")
    if (system := system_of(recording)) != BallSystem.name:
        raise InputError(f"{recording}: expected a recording of system ball, found {system}")
    data = read_recording(recording, BallSystem, whole=True)
    runs = {r.name: r for r in data.runs}
    if run is not None and run not in runs:
        raise unknown(f"run in {recording}", run, list(runs))
    chosen = runs[run] if run is not None else data.runs[0]
    if "z" not in chosen.channels:
        raise InputError(f"{recording}: expected the channel z, found {', '.join(chosen.channels)}")
    # A drop recorded by its height alone falls straight down at the origin.
    zero = np.zeros(chosen.times.size)
    positions = np.stack([chosen.channels.get(name, zero) for name in ("x", "y", "z")], axis=1)
    if not np.isfinite(positions).all():
        missing = "has missing samples; a film shows the ball in every frame"
        raise InputError(f"{recording}: run {chosen.name}: {missing}")
    check_film(recording, len(positions), pixels, force)
    radius = {**data.constants, **chosen.constants}.get("radius", _default("radius"))
    rng = rng_for("film", seed)
    camera, look = Camera.published(rng, pixels), Look.drawn(rng)
    stage = Stage(camera, look, radius, rng)
    filmed = Filmed(camera, radius, float(positions[0, 0]), float(positions[0, 1]))
    # The camera is published with the film, so that exact heights follow from the images.
    description = {beside(out): described(filmed)}
    write_video(out, stage.film(positions), chosen.times, look.crf, description)
    return len(positions), float(chosen.times[-1] - chosen.times[0])


def _default(name: str) -> float:
    return next(c.value for c in BallSystem.constants if c.name == name)
