"""The [shot] table of an experiment: what is shot, at what, and what the planner takes for known."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from bench.problem.experiment import Experiment
from bench.registry import tuners
from sims.base import InputError, unknown
from sims.shot.balls import BALLS, ball_named

Range = tuple[float, float]


@dataclass(frozen=True)
class Settings:
    """Pairs are ranges from which each shot draws.

    Attributes:
        balls: kinds.
        angle: of the incline, radians.
        hoop_x: distance of the hoop's centre from the release, m.
        hoop_drop: how far the hoop's plane lies below the height at which a ball's centre touches
            the incline, m.
        hoop_radius: m.
        heights: drop heights that the planner may choose, m.
        release: 1 sigma of the height and of the horizontal place of release, m.
        planned_friction: what the planner takes for the friction of ball and incline, all balls
            alike.
        planned_inertia: what it takes for their moment of inertia over mass x radius^2.
        friction: the world's.
        filmed: height in pixels of the film from which the recorded drop is tracked
            (`bench.shot.filmed`); 0 for heights with the experiment's noise instead of a film.
        rows: tuners that get the pixel rows of the film instead of heights in metres, and not the
            camera: those that compare simulated heights with rows, such as tunenet-vision.
    """

    balls: tuple[str, ...] = tuple(BALLS)
    angle: Range = (0.30, 0.40)
    hoop_x: Range = (0.7, 1.1)
    hoop_drop: Range = (0.0, 0.2)
    hoop_radius: float = 0.15
    heights: Range = (0.3, 2.5)
    release: float = 0.01
    planned_friction: float = 0.2
    planned_inertia: float = 0.4
    friction: float = 0.4
    filmed: float = 0.0
    rows: tuple[str, ...] = ()


def settings_of(experiment: Experiment) -> Settings:
    """The settings of an experiment, its defaults filled in.

    Raises:
        InputError: an unknown entry, or a value of another kind.
    """
    names = [f.name for f in fields(Settings)]
    values: dict[str, Any] = {}
    for key, value in experiment.shot.items():
        if key not in names:
            raise unknown(f"entry of [shot] in experiment {experiment.name}", key, names)
        values[key] = _value(f"experiment {experiment.name}: shot.{key}", key, value)
    made = Settings(**values)
    if made.rows and not made.filmed:
        raise InputError(
            f"experiment {experiment.name}: shot.rows: only a film has pixel rows; set shot.filmed too"
        )
    known = sorted({*(e.label for e in experiment.tuners), *tuners.names()})
    for name in made.rows:
        if name not in known:
            raise unknown(f"tuner in shot.rows of experiment {experiment.name}", name, known)
    return made


def _value(where: str, key: str, value: Any) -> Any:
    if key == "rows":
        return _names(where, value)
    if key == "balls":
        balls = tuple(ball_named(name).name for name in _names(where, value))
        if not balls:
            raise InputError(f"{where}: expected at least one ball")
        return balls
    if isinstance(getattr(Settings, key), tuple):
        if (
            not isinstance(value, list | tuple)
            or len(value) != 2
            or not all(_number(v) for v in value)
        ):
            raise InputError(f"{where}: expected [low, high], found {value!r}")
        low, high = (float(v) for v in value)
        if not 0 <= low <= high:
            raise InputError(f"{where}: expected 0 <= low <= high, found {value!r}")
        return low, high
    if not _number(value) or value < 0:
        raise InputError(f"{where}: expected a number of at least 0, found {value!r}")
    return float(value)


def _names(where: str, value: Any) -> tuple[str, ...]:
    if not isinstance(value, list | tuple) or not all(isinstance(v, str) for v in value):
        raise InputError(f"{where}: expected a list of names, found {value!r}")
    return tuple(value)


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
