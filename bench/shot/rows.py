"""A recorded drop for tuners that get the film's pixel rows and not metres: they never learn where
the camera stood.

They tune simulator `ball-filmed`. It is given what the scene of a drop tells: how large the ball is
and how high it was let go; cameras and balls of all the kinds that are shot are drawn for training.
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
"""The channel of the ball's row in the picture, pixels from above."""


def before_a_camera(experiment: Experiment, settings: Settings) -> Experiment:
    """The experiment with the ball before a camera, neither of which is known."""
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
    """The tracker's rows on the experiment's sample times, empty where it saw nothing, and the drop
    they show.

    Args:
        recording: a tracked drop, with the rows as extra column `v`.
        experiment: as `before_a_camera` gives it.
        radius: of the ball, m.
    """
    (run,) = recording.runs
    times: Array = np.arange(experiment.sampling.samples) / experiment.sampling.rate
    # The recording may begin later or skip some; each row goes to the sample whose time it has.
    at = np.rint(run.times * experiment.sampling.rate).astype(np.intp)
    kept = at < times.size
    observed: Array = np.full((times.size, 2), np.nan)
    observed[at[kept], 1] = run.extra[ROW][kept]
    z = run.channels["z"]
    first = int(np.flatnonzero(np.isfinite(z))[0])
    gravity = recording.constants["gravity"]
    # It was let go at rest at t = 0 and may have been seen later: z(t) = z(0) - g t^2 / 2.
    height = float(z[first] + 0.5 * gravity * run.times[first] ** 2)
    return Side((Scenario(times, {"z": height}, {}, {"radius": radius}),), observed)
