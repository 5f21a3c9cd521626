"""The [shot] table of an experiment: balls, scene, and assumptions of the planner."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from bench.benchmark.problem.experiment import Experiment
from bench.bounce_shot.ball_kinds import BALL_KINDS, get_ball_kind
from bench.core.plugin_registries import tuners
from sims.core.simulator import InputError
from sims.core.toml_validation import (
    Range,
    check_known_names,
    check_name_list,
    check_number,
    check_number_pair,
    get_type_hints_of,
    make_error,
)


@dataclass(frozen=True)
class ShotConfig:
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
            (`bounce_shot.shot_sampling`); 0 for heights with the experiment's noise instead of a
            film.
        rows: tuners that get the pixel rows of the film instead of heights in metres, and not the
            camera: those that compare simulated heights with rows, such as tunenet-vision.
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

    Raises:
        InputError: an unknown entry, or a value of a wrong type.
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
    """Convert a value to the type of its field; numbers must not be negative.

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
