"""Ranges of parameters and effect coefficients: plausible values, and the bounds of a fit.

Times and frequencies follow the time scale of the recording (`evaluation.time_scaled_ranges`).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.evaluation.time_scaled_ranges import is_instant
from sims.core.effect import Coefficient, Effect, Friction
from sims.core.simulator import Array, Parameter
from sims.effects.friction import VISCOUS_UNITS

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

WIDENING_FACTOR = 4.0
"""Factor by which a range is widened in one round."""
MAX_WIDENING_ROUNDS = 5
"""Maximum number of rounds: the range is then a thousand times as wide."""

Bounds = tuple[float, float]
"""Lower and upper end of a range."""
Bound = Literal["low", "high"]
"""End of a range that a value lies at."""


def compute_coefficient_bounds(evaluator: RunEvaluator, name: str) -> list[Bounds]:
    """Return the range in which a fit may move each coefficient of an effect.

    The plausible range of a coefficient ranks causes, and values outside it are reported, but it
    does not override the data. So a fit has wider limits:

    * the plausible range itself for a shape parameter, such as a frequency;
    * otherwise, a multiple of the plausible range, which keeps a lower bound of zero;
    * in any case within the limits of physics (`Coefficient.least` and `most`): totals of friction,
      damping, inertia and mass are not negative.

    Args:
        evaluator: evaluator, which has the coefficients of all effects.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.

    Returns:
        Lower and upper end of the range of each coefficient, in the order of the effect.
    """
    effect = evaluator.available_effects[name]
    # Each coefficient as a parameter of the evaluator, and as the effect declares it. The last
    # declared coefficients may not exist on this system, so the lengths may differ.
    pairs = zip(list_coefficients(evaluator, name), effect.coefficients, strict=False)
    return [
        _restrict_to_physical(
            _compute_fit_bounds(parameter, coefficient, effect, evaluator), coefficient
        )
        for parameter, coefficient in pairs
    ]


def get_bounds_by_index(evaluator: RunEvaluator, names: Iterable[str]) -> dict[int, Bounds]:
    """Return the range in which a fit may move each coefficient of some effects.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        names: names of the effects.

    Returns:
        Lower and upper end of the range, by index of the coefficient in theta.
    """
    bounds: dict[int, Bounds] = {}
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
    low, high = np.array(compute_coefficient_bounds(evaluator, name)).T
    clipped: Array = np.clip(c, low, high)
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
    # A range may be a thousand times as wide as the distance of its bound from zero, so the
    # tolerance is also limited by this distance. A bound of zero must be reached exactly.
    if value <= low + min(tolerance, RELATIVE_BOUND_TOLERANCE * abs(low)):
        return "low"
    if value >= high - min(tolerance, RELATIVE_BOUND_TOLERANCE * abs(high)):
        return "high"
    return None


def _restrict_to_physical(bounds: Bounds, coefficient: Coefficient) -> Bounds:
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
) -> Bounds:
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
    # An event may happen at any time of the recording.
    if is_instant(parameter):
        return evaluator.time_span
    if parameter.unit == "Hz":
        # The lower bound is at most half of the upper bound, so that the range is not empty.
        low = min(max(low, MIN_CYCLES_PER_RUN / longest_run), high / 2.0)
    # A positive lower bound marks a shape parameter, such as a frequency, a rate or a sharpness. It
    # is not widened.
    if low > 0:
        return low, high
    if parameter.unit == "s":
        # Delays longer than a run look constant within it.
        return max(MAX_RANGE_FACTOR * low, -longest_run), min(MAX_RANGE_FACTOR * high, longest_run)
    # A term that grows with the square of a force does not cause sticking by itself, nor does one
    # that grows with the speed.
    is_dry_friction = (
        isinstance(effect, Friction)
        and not parameter.unit.startswith(INVERSE_FORCE_UNITS)
        and parameter.unit not in VISCOUS_UNITS
    )
    range_factor = MAX_RANGE_FACTOR_DRY_FRICTION if is_dry_friction else MAX_RANGE_FACTOR
    # The limits of a robot coefficient refer to the total with the value of the model file.
    if evaluator.kind.has_model and coefficient.least is not None:
        range_factor = MAX_RANGE_FACTOR_MODEL_FILE
    # A coefficient whose sign is part of the definition of its effect has a lower bound of zero.
    return range_factor * low, range_factor * high


def list_coefficients(evaluator: RunEvaluator, name: str) -> Sequence[Parameter]:
    """Return the coefficients of an effect as parameters, with units and plausible ranges.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
    """
    return evaluator.parameters[evaluator.coefficient_slices[name]]


def compute_range_around(evaluator: RunEvaluator, index: int, value: float | None = None) -> Bounds:
    """Return the range of a base parameter, widened until it contains a value.

    It is widened at most `MAX_WIDENING_ROUNDS` times, and not beyond physical limits, so that it
    need not contain the value.

    Args:
        evaluator: run evaluator of the runs to which models are fitted.
        index: index of the parameter.
        value: value that the range should contain; None for the widest range.
    """
    parameter = evaluator.parameters[index]
    limits = get_physical_limits(evaluator, index)
    for _ in range(MAX_WIDENING_ROUNDS):
        low, high = parameter.bounds
        if value is not None and low <= value <= high:
            break
        # The narrower range for training would not be consistent with the new bounds.
        parameter = replace(parameter, bounds=widen_range(parameter, limits), training=None)
    return parameter.bounds


def use_bounds(evaluator: RunEvaluator, new_bounds: Mapping[str, Bounds]) -> None:
    """Replace the ranges of parameters of a run evaluator.

    The narrower ranges that some parameters have for training (`training`) are dropped.

    Args:
        evaluator: the runs for fitting; its parameters are replaced.
        new_bounds: new range of each parameter, by name.
    """
    if not new_bounds:
        return
    evaluator.parameters = tuple(
        replace(p, bounds=new_bounds[p.name], training=None) if p.name in new_bounds else p
        for p in evaluator.parameters
    )
    # Workers that were forked before still have the narrow ranges.
    evaluator.worker_pool.forget(evaluator)


def get_physical_limits(evaluator: RunEvaluator, index: int) -> Bounds:
    """Return the physical limits of a base parameter; for a robot, those of its total value.

    For example, a mass cannot be negative. A number of a robot's model file that is fitted (a
    freed parameter) is corrected by an effect; the limits are those of the effect's coefficient.
    Without an upper limit of the total, it is limited to a multiple of its plausible range.

    Args:
        evaluator: run evaluator of the runs to which models are fitted.
        index: index of the parameter.
    """
    parameter = evaluator.parameters[index]
    coefficient = None
    if evaluator.kind.has_model:
        coefficient = _get_coefficient(evaluator.kind, parameter.name)
    if coefficient is None:
        return _get_physical_limits(parameter)
    lower_limit, upper_limit = coefficient.least, coefficient.most
    if lower_limit is None:
        lower_limit = -np.inf
    if upper_limit is None:
        # `plausible` has a range for each kind of system (point, linear, rotary); those of an
        # effect at a place of a robot are equal.
        _, plausible_maximum = coefficient.plausible[0]
        upper_limit = MAX_RANGE_FACTOR_MODEL_FILE * plausible_maximum
    return lower_limit, upper_limit


def _get_coefficient(kind: Any, name: str) -> Any:
    """Return the effect coefficient that a freed parameter of a robot's model file is fitted as.

    A freed parameter is a number of the model file that the user lets the fit change. For a
    parameter of the simulator itself, None is returned.

    Args:
        kind: class of the simulator.
        name: name of the freed parameter, such as ``EFFECT`` or ``EFFECT.COEFFICIENT``.
    """
    for effect in kind.system.freed_effects:
        for c in effect.coefficients:
            if name in (effect.name, f"{effect.name}.{c.name}"):
                return c
    return None


def _get_physical_limits(parameter: Parameter) -> Bounds:
    """Return the limits of a declared parameter from its unit and its range.

    A parameter with a nonnegative range stays nonnegative, and a share is at most 1.
    """
    low, high = parameter.bounds
    is_share = parameter.unit == "1" and low >= 0.0 and high <= 1.0
    return 0.0 if low >= 0.0 else -np.inf, 1.0 if is_share else np.inf


def widen_range(parameter: Parameter, limits: Bounds) -> Bounds:
    """Return the next wider range of a parameter, within its physical limits.

    A nonnegative range stays nonnegative: its positive ends are multiplied and divided by a factor,
    and a lower end of zero stays. A range with negative values grows on both sides by a multiple of
    its width. A range that exceeds the limits already does not become narrower.

    Args:
        parameter: the parameter with its present range.
        limits: its physical limits.
    """
    low, high = parameter.bounds
    if low >= 0.0:
        lower, upper = low / WIDENING_FACTOR, high * WIDENING_FACTOR
    else:
        growth = (WIDENING_FACTOR - 1.0) * (high - low)
        lower, upper = low - growth, high + growth
    lower_limit, upper_limit = limits
    # A present end that is already beyond its limit stays where it is.
    return max(lower, min(lower_limit, low)), min(upper, max(upper_limit, high))


def list_wider_bounds(
    evaluator: RunEvaluator, theta: Array, fixed_parameters: Collection[int]
) -> dict[str, Bounds]:
    """Return wider ranges of fitted base parameters that are at a bound of their range, by name.

    Parameters for which physics does not allow values beyond this bound are not included.

    Shapes: P parameters.

    Args:
        evaluator: the runs, with the present range of each parameter.
        theta: (P,) parameters of a fit of the base model within these ranges.
        fixed_parameters: indices of parameters that were not fitted.
    """
    wider_bounds = {}
    for index in evaluator.base_indices.tolist():
        parameter = evaluator.parameters[index]
        low, high = parameter.bounds
        # The end of the range at which the fitted value lies, "low" or "high"; None inside.
        bound = bound_of(float(theta[index]), low, high)
        lower, upper = widen_range(parameter, get_physical_limits(evaluator, index))
        is_widened = (bound == "low" and lower < low) or (bound == "high" and upper > high)
        if is_widened and index not in fixed_parameters:
            wider_bounds[parameter.name] = lower, upper
    return wider_bounds


def describe_unusual_values(
    evaluator: RunEvaluator, theta: Array, wider: Mapping[str, tuple[Bounds, Bounds]]
) -> list[str]:
    """Return a sentence for each fitted parameter that lies outside its declared range.

    The report shows them, because such a value often means a wrong unit or constant.

    Shapes: P parameters.

    Args:
        evaluator: run evaluator of the runs to which models are fitted.
        theta: (P,) fitted parameters.
        wider: by parameter name, the declared range and the wider range that was used.
    """
    sentences = []
    for parameter_index in evaluator.base_indices.tolist():
        parameter, value = evaluator.parameters[parameter_index], float(theta[parameter_index])
        if parameter.name not in wider:
            continue
        (low, high), (wide_low, wide_high) = wider[parameter.name]
        if low <= value <= high:
            continue
        unit = "" if parameter.unit == "1" else f" {parameter.unit}"
        sentences.append(
            f"{parameter.name} = {value:.4g}{unit} lies outside its usual range, {low:g} to "
            f"{high:g}{unit}; the range was widened to {wide_low:g} to {wide_high:g}{unit}. "
            "Check the units and constants of the recording"
        )
    return sentences
