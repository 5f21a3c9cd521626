"""The ball before a camera: heights, and where a tracker sees the ball in the picture."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sims.core.number_limits import ANGLE_RANGE, IMAGE_SIZE_RANGE, LENGTH_RANGE
from sims.core.simulator import Array, Channel, Constant, InputError, Parameter, Scenario, Simulator
from sims.systems.ball import Ball, BallSystem
from sims.vision import video_files
from sims.vision.pinhole_camera import PinholeCamera

FILM_MODES = ("projected", "tracked")
"""How a film is made: computed through the camera, or rendered and tracked."""


class FilmedBall(Simulator):
    """A ball that falls and bounces on level ground, seen by a fixed camera.

    By default, the camera has a field of view of 40 degrees and looks at (0, 0, 2) m, as the
    published visual tuner's does (Allevato et al., TuneNet, arXiv 1907.11200, released code). `v`
    is the pixel row of the middle of the ball's outline, from the top; it may lie outside the
    picture.

    Args:
        constants: values for `constants` other than their defaults.
        observe: channels to return, in order (default: both).
        film: "projected" computes `v` through the camera. "tracked" renders a film of each run, its
            light, colours and compression drawn from the run's own numbers, and lets the tracker
            find the ball: `v` is missing where it is not seen, and `z`, which no film shows,
            throughout.
        settings: those of simulator ball.

    Raises:
        InputError: an unknown name or setting, or a film to be tracked without the packages for it.
    """

    name = "ball-filmed"
    says = "a bouncing ball before a fixed camera"
    parameters: tuple[Parameter, ...] = BallSystem.parameters
    channels = (
        Channel("z", "m", says="height of the centre above the ground"),
        Channel("v", "px", says="pixel row of the middle of the ball's outline, down from the top"),
    )
    constants = (
        *BallSystem.constants,
        Constant(
            "camera_azimuth",
            "rad",
            0.0,
            "angle of the camera position about the vertical",
            limits=ANGLE_RANGE,
        ),
        Constant(
            "camera_distance", "m", 7.5, "of the camera from the vertical", True, LENGTH_RANGE
        ),
        Constant("camera_height", "m", 6.5, "of the camera above the ground", limits=(-1e6, 1e6)),
        Constant(
            "camera_aim",
            "m",
            2.0,
            "height of the point on the vertical at which the camera looks",
            limits=(-1e6, 1e6),
        ),
        Constant("pixels", "px", 100.0, "width and height of the picture", True, IMAGE_SIZE_RANGE),
    )
    states = BallSystem.states

    def __init__(
        self,
        constants: Mapping[str, float] | None = None,
        observe: Sequence[str] | None = None,
        *,
        film: str = "projected",
        **settings: Any,
    ) -> None:
        """Create the simulator of the ball, and check that its film can be tracked.

        Args:
            constants: Constants of ball and camera that differ from their defaults.
            observe: Names of the observed channels; all if None.
            film: "projected": the ball's centre is projected by the camera model; "tracked": a film
                is rendered and tracked.
            settings: Settings of the simulator of the ball, such as its engine.

        Raises:
            InputError: A name or setting is unknown, or the packages for films are missing.
        """
        super().__init__(constants, observe)
        if film not in FILM_MODES:
            raise InputError(
                f"simulator {self.name}: expected film to be one of {', '.join(FILM_MODES)}, found"
                f" {film!r}"
            )
        if film == "tracked":
            # Fail here with one message, not in the middle of a training.
            video_files.check_installed()
        self._tracked = film == "tracked"
        self._ball = Ball(
            self._select_ball_constants(self.constant_values), ["x", "y", "z"], **settings
        )
        # The parameters include the coefficients of effects that are not fixed.
        self.parameters = self._ball.parameters

    def simulate(self, theta: Array, scenario: Scenario) -> Array:
        """Simulate a film of the ball for each parameter vector; see `Simulator.simulate`.

        Args:
            theta: (n, dim) parameters: the restitution, then coefficients of effects.
            scenario: times, initial state and constants of the run.

        Returns:
            (n, T, C) the C observed channels in T samples: the height z in m, NaN if films are
            tracked, and the pixel row v of the ball, NaN where it is not seen.
        """
        constants = self.run_constants(scenario)
        self.run_inputs(scenario)  # raises an error if the scenario has inputs
        fall = Scenario(
            scenario.times, scenario.initial, {}, self._select_ball_constants(constants)
        )
        centres = self._ball.simulate(theta, fall)  # (n, T, 3), m
        camera = _make_camera(constants)
        radius = constants["radius"]
        if self._tracked:
            tracks = [
                _track_film(camera, radius, positions, scenario.times) for positions in centres
            ]
            rows = np.array(tracks).reshape(centres.shape[:2])  # also for an empty batch
            heights = np.full_like(rows, np.nan)
        else:
            outline_centres, _ = camera.project_sphere(centres, radius)
            heights = centres[..., 2]
            rows = outline_centres[..., 1]
        observations = np.stack([heights, rows], axis=2)
        result: Array = observations[:, :, self.columns]
        return result

    def close(self) -> None:
        """Give back what the engine holds."""
        self._ball.close()

    @staticmethod
    def _select_ball_constants(constants: Mapping[str, float]) -> dict[str, float]:
        return {c.name: constants[c.name] for c in BallSystem.constants}


def _make_camera(constants: Mapping[str, float]) -> PinholeCamera:
    """Make the camera from the simulator's constants, with a square picture."""
    size = round(constants["pixels"])
    place = (constants["camera_azimuth"], constants["camera_distance"], constants["camera_height"])
    return PinholeCamera(*place, target=(0.0, 0.0, constants["camera_aim"]), size=(size, size))


def _track_film(camera: PinholeCamera, radius: float, centres: Array, times: Array) -> Array:
    """Render a film of a ball, and return the pixel rows (T,) that the tracker finds in it.

    Shapes: T frames.

    A row is NaN in frames in which the tracker finds no ball, and all are if the motion is not
    finite.

    Args:
        camera: camera that films the ball.
        radius: radius of the ball, m.
        centres: (T, 3) centre of the ball, m.
        times: (T,) times of the frames, s.
    """
    from sims.vision.ball_renderer import BallScene, SceneAppearance
    from sims.vision.ball_tracker import track_ball
    from sims.vision.video_files import VideoFile, write_video

    pixel_rows: Array = np.full(times.size, np.nan)
    if not np.isfinite(centres).all():
        return pixel_rows
    # Light, colours and compression are drawn from what the film shows: the same parameters and
    # scenario give the same film, whatever was filmed before.
    film_settings = [
        camera.azimuth,
        camera.distance,
        camera.height,
        *camera.size,
        radius,
        *centres.ravel(),
    ]
    digest = hashlib.sha256(np.array(film_settings).tobytes()).digest()
    rng = np.random.default_rng(np.frombuffer(digest, dtype=np.uint32))
    appearance = SceneAppearance.draw(rng)
    scene = BallScene(camera, appearance, radius, rng)
    try:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "film.mp4"
            write_video(path, scene.render_frames(centres), times, appearance.crf)
            track = track_ball(VideoFile(path))
    except InputError:  # no ball is found
        return pixel_rows
    finally:
        scene.close()
    # A track may lack frames, so the number of each frame is found by its time in the film, which
    # begins at 0.
    frames = np.interp(track.times, times - times[0], np.arange(times.size))
    pixel_rows[np.rint(frames).astype(int)] = track.v
    return pixel_rows
