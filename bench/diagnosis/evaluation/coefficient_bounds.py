"""Ranges of effect coefficients: where they are plausible, and where a fit may move them.

Times and frequencies follow the time scale of the recording (`evaluation.run_data`).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import numpy as np

from bench.diagnosis.evaluation.run_data import is_instant
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from sims.core.effect import Coefficient, Effect, Friction
from sims.core.simulator import Array, Parameter

MAX_RANGE_FACTOR = 20.0
"""Ratio of the fit bounds to the plausible range, for coefficients of equation-based systems."""
MAX_RANGE_FACTOR_MODEL_FILE = 1000.0
"""Ratio of the fit bounds to the plausible range, for quantities that a robot model file specifies.

The total of such a quantity has physical limits (`least` and `most` of the coefficient), and its
plausible range is a guess from the weight of the robot: damping of 60 N m s on a link of 1 N m is
unusual, but possible.
"""
MAX_RANGE_FACTOR_DRY_FRICTION = 4.0
"""Ratio of the fit bounds to the plausible range, for dry friction.

Stronger friction only sticks, and sticking divides the steps of the engine.
"""
INVERSE_FORCE_UNITS = ("1/N", "1/(N")
"""Units of coefficients of terms that grow faster than linearly with a force."""
MIN_CYCLES_PER_RUN = 1.0
"""Minimum number of cycles of a periodic effect within the longest run.

With fewer cycles, any slow change would be called periodic.
"""
BOUND_TOLERANCE = 1e-6
"""Maximum distance of a value at a bound from this bound, as a share of the range.

A bound of zero is reached exactly or not at all, because ranges are wide compared with small
coefficients.
"""
RELATIVE_BOUND_TOLERANCE = 1e-3
"""Maximum distance of a value at a bound from this bound, as a share of the bound itself.

It applies in addition to `BOUND_TOLERANCE`.
"""

Bound = Literal["low", "high"]
"""End of a range that a value lies at."""


def compute_coefficient_bounds(evaluator: RunEvaluator, name: str) -> list[tuple[float, float]]:
    """Return the range in which a fit may move each coefficient of an effect.

    The plausible range of a coefficient ranks causes, and values outside it are reported, but it
    does not override the data. So a fit has wider limits:

    * limits of physics (`Coefficient.least` and `most`): totals of friction, damping, inertia and
      mass are not negative;
    * otherwise, a multiple of the plausible range;
    * zero for a coefficient that is nonnegative by definition, and the range of a shape parameter.

    Args:
        evaluator: evaluator, which has the coefficients of all effects.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
    """
    effect = evaluator.available_effects[name]
    pairs = zip(
        evaluator.parameters[evaluator.coefficient_slices[name]], effect.coefficients, strict=False
    )
    return [
        _restrict_to_physical(
            _compute_fit_bounds(parameter, coefficient, effect, evaluator), coefficient
        )
        for parameter, coefficient in pairs
    ]


def get_bounds_by_index(
    evaluator: RunEvaluator, names: Iterable[str]
) -> dict[int, tuple[float, float]]:
    """Return the ranges of `compute_coefficient_bounds` for some effects, by index in theta.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        names: names of the effects.
    """
    bounds: dict[int, tuple[float, float]] = {}
    for name in names:
        indices = evaluator.get_coefficient_indices(name)
        bounds |= zip(indices, compute_coefficient_bounds(evaluator, name), strict=True)
    return bounds


def clip_coefficients(evaluator: RunEvaluator, name: str, c: Array) -> Array:
    """Clip the coefficients (k,) of an effect to the range in which a fit may move them.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
        c: (k,) its coefficients.
    """
    clipped: Array = np.clip(c, *np.array(compute_coefficient_bounds(evaluator, name)).T)
    return clipped


def is_unusual(value: float, low: float, high: float) -> bool:
    """Return whether a value lies outside its plausible range by more than rounding.

    Args:
        value: the value.
        low: lower end of the range.
        high: upper end of the range.
    """
    tolerance = BOUND_TOLERANCE * (high - low)
    return not low - tolerance <= value <= high + tolerance


def bound_of(value: float, low: float, high: float) -> Bound | None:
    """Return the end of its range that a value lies at; None if it lies inside.

    Args:
        value: the value.
        low: lower end of the range.
        high: upper end of the range.
    """
    tolerance = BOUND_TOLERANCE * (high - low)
    # A range may be a thousand times as wide as the distance of its bound from zero.
    if value <= low + min(tolerance, RELATIVE_BOUND_TOLERANCE * abs(low)):
        return "low"
    return "high" if value >= high - min(tolerance, RELATIVE_BOUND_TOLERANCE * abs(high)) else None


def _restrict_to_physical(
    bounds: tuple[float, float], coefficient: Coefficient
) -> tuple[float, float]:
    """Return a range restricted to the physical limits of a coefficient.

    Args:
        bounds: lower and upper end of the range.
        coefficient: coefficient of an effect, with its smallest and largest physical value.
    """
    low, high = bounds
    if coefficient.least is not None:
        low = max(low, coefficient.least)
    if coefficient.most is not None:
        high = min(high, coefficient.most)
    return low, high


def _compute_fit_bounds(
    parameter: Parameter, coefficient: Coefficient, effect: Effect, evaluator: RunEvaluator
) -> tuple[float, float]:
    """Return the range in which a fit may move a coefficient, without its physical limits.

    It is the plausible range, widened by a factor, since data count more than plausibility. Times
    and frequencies are adapted to the length of the runs, because the data cannot show slower
    changes. A shape parameter, such as a frequency, keeps its plausible range.

    Args:
        parameter: the coefficient as a parameter, with its unit and plausible range.
        coefficient: declaration of the coefficient by its effect.
        effect: effect of the coefficient: a force, friction, input, sensor or contact law.
        evaluator: evaluator, whose longest run limits times and frequencies.
    """
    low, high = parameter.bounds
    longest_run = evaluator.longest_duration
    if is_instant(parameter):
        return evaluator.time_span
    if parameter.unit == "Hz":
        # The lower bound is at most half of the upper bound, so that the range is not empty.
        low = min(max(low, MIN_CYCLES_PER_RUN / longest_run), high / 2.0)
    # A positive lower bound marks a shape parameter, such as a frequency, a rate or a sharpness.
    if low > 0:
        return low, high
    if parameter.unit == "s":
        # Delays longer than a run look constant within it.
        return max(MAX_RANGE_FACTOR * low, -longest_run), min(MAX_RANGE_FACTOR * high, longest_run)
    # A term that grows with the square of a force does not cause sticking by itself.
    is_dry_friction = isinstance(effect, Friction) and not parameter.unit.startswith(
        INVERSE_FORCE_UNITS
    )
    range_factor = MAX_RANGE_FACTOR_DRY_FRICTION if is_dry_friction else MAX_RANGE_FACTOR
    # The limits of a robot coefficient refer to the total with the value of the model file.
    if evaluator.kind.has_model and coefficient.least is not None:
        range_factor = MAX_RANGE_FACTOR_MODEL_FILE
    # A coefficient whose sign is part of the definition of its effect has a lower bound of zero.
    return range_factor * low, range_factor * high
