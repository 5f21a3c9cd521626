"""Render a run of a recording as a film."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.core.random_streams import make_rng
from bench.core.resource_estimates import check_film_size
from sims.core.files import check_absent
from sims.core.simulator import InputError, make_unknown_name_error
from sims.recording.recording import read_recording, read_system_name
from sims.systems.ball import BallSystem
from sims.vision.ball_renderer import BallScene, SceneAppearance
from sims.vision.pinhole_camera import (
    FilmDescription,
    PinholeCamera,
    format_camera_file,
    get_camera_file_path,
)
from sims.vision.video_files import write_video


def write_film(
    recording: Path, out: Path, run: str | None, pixels: int, seed: int, force: bool = False
) -> tuple[int, float]:
    """Render a run of a recorded ball as a film, and write the film with a file of its camera.

    The positions of the ball must be complete. The camera and the look of the scene (colours,
    light) are drawn from the seed.

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
    check_absent([out, get_camera_file_path(out)])
    if pixels < 16 or pixels % 2:
        raise InputError(f"size {pixels}: expected an even number of at least 16 pixels")
    if (system := read_system_name(recording)) != BallSystem.name:
        raise InputError(f"{recording}: expected a recording of system ball, found {system}")
    # Without `whole`, a single run would be split into two with the same name.
    loaded_recording = read_recording(recording, BallSystem, whole=True)
    runs = {r.name: r for r in loaded_recording.runs}
    if run is None:
        chosen_run = loaded_recording.runs[0]
    elif run in runs:
        chosen_run = runs[run]
    else:
        raise make_unknown_name_error(f"run in {recording}", run, list(runs))
    if "z" not in chosen_run.channels:
        raise InputError(
            f"{recording}: expected the channel z, found {', '.join(chosen_run.channels)}"
        )
    # A drop recorded by its height alone falls straight down at the origin.
    zero = np.zeros(chosen_run.times.size)
    positions = np.stack([chosen_run.channels.get(name, zero) for name in ("x", "y", "z")], axis=1)
    if not np.isfinite(positions).all():
        missing = "has missing samples; a film shows the ball in every frame"
        raise InputError(f"{recording}: run {chosen_run.name}: {missing}")
    check_film_size(recording, len(positions), pixels, force)
    defaults = {constant.name: constant.value for constant in BallSystem.constants}
    radius = {**defaults, **loaded_recording.constants, **chosen_run.constants}["radius"]
    rng = make_rng("film", seed)
    camera, appearance = PinholeCamera.draw_published(rng, pixels), SceneAppearance.draw(rng)
    scene = BallScene(camera, appearance, radius, rng)
    filmed = FilmDescription(camera, radius, float(positions[0, 0]), float(positions[0, 1]))
    # The camera is published with the film, so that exact heights follow from the images. `crf` is
    # the constant rate factor of the video encoder, which determines the quality of the images.
    description = {get_camera_file_path(out): format_camera_file(filmed)}
    write_video(out, scene.render_frames(positions), chosen_run.times, appearance.crf, description)
    return len(positions), float(chosen_run.times[-1] - chosen_run.times[0])
