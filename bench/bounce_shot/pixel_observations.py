"""Recorded drop as pixel rows, for tuners that use the film without the camera's position.

They tune the simulator `ball-filmed`. It knows the radius of the ball and its drop height. For
training, cameras and balls of all kinds are drawn at random.
"""

from __future__ import annotations

import math

import numpy as np

from bench.benchmark.problem.experiment import Experiment
from bench.benchmark.problem.recorded_runs import ObservedRuns
from bench.bounce_shot.ball_kinds import get_ball_kind
from bench.bounce_shot.filmed_drop import (
    CAMERA_DISTANCE_RANGE,
    CAMERA_HEIGHT_RANGE,
    CAMERA_TARGET_HEIGHT,
)
from bench.bounce_shot.shot_config import ShotConfig
from sims.core.simulator import Array, Scenario
from sims.recording.recording import Recording

ROW_CHANNEL = "v"
"""Channel of the ball's row in the picture, pixels from above."""


def make_pixel_experiment(experiment: Experiment, settings: ShotConfig) -> Experiment:
    """Make the experiment for a ball in front of an unknown camera.

    Args:
        experiment: the experiment.
        settings: its [shot] table.
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
    z = run.channels["z"]
    first = int(np.flatnonzero(np.isfinite(z))[0])
    gravity = recording.constants["gravity"]
    # Released at rest at t = 0, and possibly first seen later: z(t) = z(0) - g t^2 / 2.
    height = float(z[first] + 0.5 * gravity * run.times[first] ** 2)
    return ObservedRuns((Scenario(times, {"z": height}, {}, {"radius": radius}),), observed)
