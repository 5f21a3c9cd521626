"""The [shot] table of an experiment: six kinds of balls, scene, assumptions of the planner.

The rules give a height H from which the ball is dropped on a hard floor and the range of heights h
to which it must return; the restitution is that of the impact speed of that drop,

    e = sqrt(h / H)    at    v = sqrt(2 g H)                               (1)

and at another speed u

    e(u) = e (u / v)^p                                                     (2)

Balls of a kind vary within those limits. Chosen here, not taken from tables: the power p of the
impact speed with which restitution falls (a yielding ball's is -1/4, a viscoelastic one's weaker:
K. L. Johnson, Contact Mechanics, 1985, chapter 11), the moments of inertia (a solid sphere's, a
thin shell's, or between for a thick one) and the drag coefficients (0.5 for a sphere below the drag
crisis: G. K. Batchelor, An Introduction to Fluid Dynamics, 1967; 0.6 for a fuzzy one).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from bench.benchmark.problem.experiment_config import Experiment
from bench.core.plugin_registries import tuners
from sims.core.simulator import InputError, make_unknown_name_error
from sims.core.toml_validation import (
    Range,
    check_known_names,
    check_name_list,
    check_number,
    check_number_pair,
    get_type_hints_of,
    make_error,
)

_MIN_IMPACT_SPEED = 1e-3
"""Impact speed in m/s below which the restitution is constant, because (2) is unbounded."""


@dataclass(frozen=True)
class BallKind:
    """Properties of one ball.

    Attributes:
        name: Name of its kind.
        mass: Mass, kg.
        radius: Radius, m.
        restitution: Coefficient of restitution on a hard surface at the impact speed `speed`.
        spread: Maximum deviation of the restitution of balls of this kind.
        speed: Impact speed at which `restitution` applies, m/s.
        exponent: Exponent of the impact speed in the restitution, p of equation (2).
        inertia_ratio: Moment of inertia over mass x radius^2.
        drag: Drag coefficient with respect to the cross-section.
        source: Source of mass, radius and restitution.
    """

    name: str
    mass: float
    radius: float
    restitution: float
    spread: float
    speed: float
    exponent: float
    inertia_ratio: float
    drag: float
    source: str

    def compute_restitution(self, speed: float) -> float:
        """Return the coefficient of restitution at an impact speed in m/s; at most 1.

        With the restitution e at the impact speed v for which it is known, and the exponent p, it
        is e(u) = e (u / v)^p (2) at the speed u. Speeds below `_MIN_IMPACT_SPEED` count as that.
        """
        ratio = max(speed, _MIN_IMPACT_SPEED) / self.speed
        return min(1.0, self.restitution * float(ratio**self.exponent))  # (2)

    def draw_ball(self, rng: np.random.Generator) -> BallKind:
        """Draw a ball of this kind with random restitution."""
        restitution = self.restitution + self.spread * float(rng.uniform(-1.0, 1.0))
        return replace(self, restitution=restitution)


_BALLS = (
    BallKind(
        name="table-tennis",
        mass=0.0027,
        radius=0.0200,
        restitution=0.905,
        spread=0.018,
        speed=2.44,
        exponent=-0.06,
        inertia_ratio=0.66,
        drag=0.50,
        source=(
            "ITTF Laws 2.3 (2.7 g, 40 mm) and Technical Leaflet T3"
            " (dropped 305 mm, back to 240-260 mm)"
        ),
    ),
    BallKind(
        name="tennis",
        mass=0.0577,
        radius=0.0335,
        restitution=0.745,
        spread=0.016,
        speed=7.06,
        exponent=-0.10,
        inertia_ratio=0.55,
        drag=0.60,
        source=(
            "ITF Rules of Tennis, appendix I"
            " (56.0-59.4 g, 65.4-68.6 mm, dropped 254 cm, back to 135-147 cm)"
        ),
    ),
    BallKind(
        name="golf",
        mass=0.0459,
        radius=0.02135,
        restitution=0.858,
        spread=0.015,
        speed=4.25,
        exponent=-0.05,
        inertia_ratio=0.40,
        drag=0.50,
        source=(
            "R&A and USGA, Equipment Rules (at most 45.93 g, at least 42.67 mm);"
            " restitution of a range ball dropped 92 cm:"
            " The Physics Factbook, Coefficients of Restitution"
        ),
    ),
    BallKind(
        name="basketball",
        mass=0.610,
        radius=0.1210,
        restitution=0.767,
        spread=0.018,
        speed=5.94,
        exponent=-0.05,
        inertia_ratio=0.62,
        drag=0.50,
        source=(
            "FIBA Basketball Equipment, size 7"
            " (750-770 mm round, 567-650 g, dropped 1800 mm, back to 960-1160 mm)"
        ),
    ),
    BallKind(
        name="rubber",
        mass=0.0460,
        radius=0.0225,
        restitution=0.890,
        spread=0.015,
        speed=4.50,
        exponent=-0.04,
        inertia_ratio=0.40,
        drag=0.50,
        source=(
            "a ball of 45 mm that loses a fifth of its energy, as superballs in"
            " R. Cross, Am. J. Phys. 67, 222 (1999), "
            "doi:10.1119/1.19229; mass of a solid sphere of polybutadiene, 0.96 g/cm^3"
        ),
    ),
    BallKind(
        name="squash",
        mass=0.0240,
        radius=0.0200,
        restitution=0.543,
        spread=0.031,
        speed=7.06,
        exponent=-0.12,
        inertia_ratio=0.60,
        drag=0.50,
        source=(
            "World Squash, Rules, appendix 7: yellow dot"
            " (24 g, 40 mm, dropped 254 cm at 45 C, back to 26-33 % of it)"
        ),
    ),
)
BALL_KINDS = MappingProxyType({ball.name: ball for ball in _BALLS})


def get_ball_kind(name: str) -> BallKind:
    """Return the kind of ball with this name.

    Raises:
        InputError: There is no such kind.
    """
    if name not in BALL_KINDS:
        raise make_unknown_name_error("ball", name, list(BALL_KINDS))
    return BALL_KINDS[name]


@dataclass(frozen=True)
class ShotConfig:
    """Pairs are ranges from which each shot draws.

    Attributes:
        balls: kinds of balls.
        angle: angle of the incline, rad.
        hoop_x: distance of the hoop's centre from the release, m.
        hoop_drop: distance of the hoop's plane below a ball's centre when it touches the incline,
            m.
        hoop_radius: m.
        heights: drop heights that the planner may choose, m.
        release: standard deviation of height and horizontal position of the release, m.
        planned_friction: friction of ball and incline that the planner assumes for all balls.
        planned_inertia: moment of inertia over mass x radius^2 that the planner assumes.
        friction: true friction of ball and incline.
        filmed: height in pixels of the film from which the recorded drop is tracked; 0 for heights
            with the experiment's noise instead of a film.
        rows: tuners that get the pixel rows of the film instead of heights in metres, and not the
            camera, such as tunenet-vision.
    """

    balls: tuple[str, ...] = tuple(BALL_KINDS)
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


def read_shot_config(experiment: Experiment) -> ShotConfig:
    """Read and validate the [shot] table of an experiment, with defaults.

    The entry ``rows`` names tuners that see the ball's pixel rows in the film, not its heights.

    Raises:
        InputError: an unknown entry, ball or tuner, a value of a wrong type or range, or pixel rows
            without a film.
    """
    source, hints = f"experiment {experiment.name}", get_type_hints_of(ShotConfig)
    check_known_names(f"entry of [shot] in {source}", experiment.shot, hints)
    values = {
        key: _convert_value(source, f"shot.{key}", value, hints[key])
        for key, value in experiment.shot.items()
    }
    settings = ShotConfig(**values)
    if not settings.balls:
        raise InputError(f"{source}: shot.balls: expected at least one ball")
    for ball in settings.balls:
        get_ball_kind(ball)  # raises an error if the ball is unknown
    if settings.rows and not settings.filmed:
        raise InputError(f"{source}: shot.rows: only a film has pixel rows; set shot.filmed too")
    # Tuners in shot.rows need not be in the experiment: the command line may add them.
    known_tuners = {*(entry.label for entry in experiment.tuners), *tuners.names()}
    check_known_names(f"tuner in shot.rows of {source}", settings.rows, known_tuners)
    return settings


def _convert_value(source: str, key: str, value: Any, declared: Any) -> Any:
    """Convert a value to the type of its field: names, a range, or a number.

    Numbers must not be negative.

    Args:
        source: beginning of error messages.
        key: key of the entry.
        value: its value.
        declared: type of the field.

    Returns:
        Tuple of names, tuple (low, high), or a number, as declared.

    Raises:
        InputError: the value has a wrong type or range.
    """
    if declared == tuple[str, ...]:
        return check_name_list(source, key, value)
    if declared == Range:
        low, high = check_number_pair(source, key, value)
        if not 0 <= low <= high:  # equal ends define a constant
            raise make_error(source, key, "0 <= low <= high", value)
        return low, high
    expected = "a number of at least 0"
    size = check_number(source, key, value, expected)
    if size < 0:
        raise make_error(source, key, expected, value)
    return size
