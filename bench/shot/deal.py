"""Draws what each shot is made with, the same for every method, and records the ball's drop.

The recorded drop is filmed and tracked, or heights of the centre at the sampling rate with noise.
Either is a recording like any other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.problem.experiment import Experiment
from bench.problem.salt import PUBLIC
from bench.problem.seeds import rng_for
from bench.shot.filmed import filmed
from bench.shot.settings import Settings
from sims.ball.simulator import Ball as BallSimulator
from sims.recording.recording import Recording, Run, read_recording
from sims.recording.write import write_recording
from sims.shot.balls import BallKind, ball_named
from sims.shot.scene import ShotScene
from sims.shot.world import GRAVITY, Ground, fly

RECORDINGS = "recordings"
"""The folder of recorded drops, in a study's."""


@dataclass(frozen=True)
class Deal:
    """One ball and one shot.

    Attributes:
        name: e.g. ``tennis-007``.
        ball: the truth, which only the world knows.
        scene: incline and hoop, which everybody knows.
        release: error of the place of release, m: along x, and in height.
        salt: what it was drawn from.
    """

    name: str
    ball: BallKind
    scene: ShotScene
    release: tuple[float, float]
    salt: str = ""


def deal(experiment: Experiment, settings: Settings, kind: str, index: int, salt: str = "") -> Deal:
    """Shot `index` of a kind of ball; it depends on the experiment's name, not on methods or
    numbers of shots.
    """
    rng = rng_for(*_of(salt), experiment.name, "shot", kind, index)
    # The order of the draws is part of the experiment: another order gives other shots.
    ball = ball_named(kind).one(rng)
    angle, x, drop = (
        float(rng.uniform(*pair)) for pair in (settings.angle, settings.hoop_x, settings.hoop_drop)
    )
    dx, dz = (settings.release * rng.standard_normal(2)).tolist()
    # A ball that touches the incline at x = 0 has its centre radius / cos(angle) above it.
    touching = ball.radius / math.cos(angle)
    scene = ShotScene(angle, x, touching - drop, settings.hoop_radius)
    return Deal(f"{kind}-{index:03d}", ball, scene, (dx, dz), salt)


def _of(salt: str) -> tuple[str, ...]:
    """What the names of streams begin with; public ones with nothing."""
    return () if salt in ("", PUBLIC) else ("salt", salt)


def deals(experiment: Experiment, settings: Settings, salt: str = "") -> list[Deal]:
    """All shots of an experiment; the balls take turns, so that a part of the work is a part of
    each.
    """
    return [
        deal(experiment, settings, kind, i, salt)
        for i in range(experiment.targets)
        for kind in settings.balls
    ]


def in_view(path: Path, experiment: Experiment) -> float:
    """The share of a drop's sample times at which its recording has a height."""
    z = read_recording(path, BallSimulator, whole=True).runs[0].channels["z"]
    return float(np.isfinite(z).sum() / experiment.sampling.samples)


def record(experiment: Experiment, dealt: Deal, settings: Settings, path: Path) -> None:
    """Record a drop of the ball on level ground; nothing is done where there is a recording
    already.
    """
    if path.exists() and path.with_suffix(".toml").exists():
        return
    # One of the two without the other is what a kill left.
    for left in (path, path.with_suffix(".toml")):
        left.unlink(missing_ok=True)
    rng = rng_for(*_of(dealt.salt), experiment.name, "drop", dealt.name)
    height = experiment.initial.get("z", 1.5)
    clear = float(rng.uniform(*height)) if isinstance(height, tuple) else height
    radius, sampling = dealt.ball.radius, experiment.sampling
    times = np.arange(sampling.samples) / sampling.rate
    z = fly(dealt.ball, Ground(0.0, settings.friction), (0.0, 0.0, radius + clear), times)[:, 2]
    if settings.filmed:
        filmed(path, z, times, radius, round(settings.filmed), rng)
        return
    noise = experiment.noise.get("z", 0.0)
    seen = z + noise * rng.standard_normal(z.shape)
    # To a hundredth of a millimetre, far below any noise: the file stays short.
    run = Run("1", times, {"z": np.round(seen, 5)}, {}, {}, {}, False)
    known = {"radius": radius, "mass": dealt.ball.mass, "gravity": GRAVITY}
    recording = Recording(path, "ball", f"a drop of {dealt.name}", known, {"z": noise}, (run,))
    write_recording(path, recording, BallSimulator)
