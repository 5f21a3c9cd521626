"""Recorded drop as pixel rows, for tuners that use the film without the camera's position.

They tune the simulator `ball-filmed`. It knows the radius of the ball and its drop height. For
training, cameras and balls of all kinds are drawn at random.
"""

from __future__ import annotations

import math

import numpy as np

from bench.problem.experiment import Experiment
from bench.problem.recorded import Side
from bench.shot.filmed import AIM, DISTANCE, HEIGHT
from bench.shot.settings import Settings
from sims.base import Array, Scenario
from sims.recording.recording import Recording
from sims.shot.balls import ball_named

ROW = "v"
"""Channel of the ball's row in the picture, pixels from above."""


def before_a_camera(experiment: Experiment, settings: Settings) -> Experiment:
    """Make the experiment for a ball in front of an unknown camera.

    Args:
        experiment: the experiment.
        settings: its [shot] table.
    """
    radii = [ball_named(name).radius for name in settings.balls]
    return experiment.chosen(
        simulator="ball-filmed",
        observe=("z", ROW),
        error_channel=ROW,
        noise={},
        constants={
            **experiment.constants,
            "radius": (min(radii), max(radii)),
            "camera_azimuth": (0.0, 2.0 * math.pi),
            "camera_distance": DISTANCE,
            "camera_height": HEIGHT,
            "camera_aim": AIM,
            "pixels": settings.filmed,
        },
    )


def rows_of(recording: Recording, experiment: Experiment, radius: float) -> Side:
    """Convert tracked rows to observations at the experiment's sample times.

    Samples in which the tracker saw nothing are NaN.

    Args:
        recording: a tracked drop, with the rows as extra column `v`.
        experiment: the experiment as returned by `before_a_camera`.
        radius: radius of the ball, m.
    """
    (run,) = recording.runs
    times: Array = np.arange(experiment.sampling.samples) / experiment.sampling.rate
    # The recording may begin later or skip samples; each row is assigned by its time.
    at = np.rint(run.times * experiment.sampling.rate).astype(np.intp)
    kept = at < times.size
    observed: Array = np.full((times.size, 2), np.nan)
    observed[at[kept], 1] = run.extra[ROW][kept]
    z = run.channels["z"]
    first = int(np.flatnonzero(np.isfinite(z))[0])
    gravity = recording.constants["gravity"]
    # Released at rest at t = 0, and possibly first seen later: z(t) = z(0) - g t^2 / 2.
    height = float(z[first] + 0.5 * gravity * run.times[first] ** 2)
    return Side((Scenario(times, {"z": height}, {}, {"radius": radius}),), observed)
