"""Wider ranges for base parameters that a fit leaves at a bound of their range.

A declared range is a guess of usual values. If the best value lies outside it, the base model is
wrong, and an effect of the library would be fitted to the difference. Therefore the range is
widened as far as physics allows, and the base model is fitted again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from bench.diagnosis.evaluation.coefficient_bounds import MAX_RANGE_FACTOR_MODEL_FILE, bound_of
from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.base_fit import FINAL_ITERATIONS, BaseFit
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from sims.core.simulator import Array, Parameter

Bounds = tuple[float, float]

WIDENING_FACTOR = 4.0
"""Factor by which a range is widened in one round."""
MAX_WIDENING_ROUNDS = 5
"""Maximum number of rounds: the range is then a thousand times as wide."""


def list_parameters_at_bounds(evaluator: RunEvaluator, base: BaseFit) -> list[int]:
    """Return the indices in theta of fitted base parameters whose range should be widened.

    They are at a bound of their range, and physics allows values beyond this bound.
    """
    places = []
    for i in evaluator.base_indices.tolist():
        if i in base.fixed_parameters:
            continue
        low, high = evaluator.parameters[i].bounds
        end = bound_of(float(base.fit.theta[i]), low, high)
        lower, upper = widen_range(evaluator.parameters[i], get_physical_limits(evaluator, i))
        if (end == "low" and lower < low) or (end == "high" and upper > high):
            places.append(i)
    return places


def fit_wider(
    evaluator: RunEvaluator, noise: NoiseModel, base: BaseFit
) -> tuple[BaseFit, dict[str, Bounds]]:
    """Widen the ranges of parameters at a bound, and fit the base model again.

    Args:
        evaluator: the runs for fitting; the ranges of its parameters are replaced.
        noise: noise of each channel.
        base: the fitted base model.

    Returns:
        The base model, and the new ranges by name; empty if no parameter is at a bound.
    """
    new_bounds: dict[str, Bounds] = {}
    for _ in range(MAX_WIDENING_ROUNDS):
        places = list_parameters_at_bounds(evaluator, base)
        if not places or evaluator.search_control.is_over():
            break
        for i in places:
            parameter = evaluator.parameters[i]
            new_bounds[parameter.name] = widen_range(parameter, get_physical_limits(evaluator, i))
        use_bounds(evaluator, new_bounds)
        fit = TrajectoryFitter(evaluator, noise, base.fixed_parameters).fit_models(
            [base.fit.make_start()], FINAL_ITERATIONS
        )[0]
        base = replace(base, fit=fit)
    return base, new_bounds


def compute_range_around(evaluator: RunEvaluator, place: int, value: float | None = None) -> Bounds:
    """Return the range of a base parameter, widened until it contains a value.

    It is widened at most `MAX_WIDENING_ROUNDS` times.

    Args:
        evaluator: the runs for fitting.
        place: index of the parameter.
        value: value that the range must contain; None for the widest range.
    """
    parameter = evaluator.parameters[place]
    limits = get_physical_limits(evaluator, place)
    for _ in range(MAX_WIDENING_ROUNDS):
        low, high = parameter.bounds
        if value is not None and low <= value <= high:
            break
        parameter = replace(parameter, bounds=widen_range(parameter, limits), training=None)
    return parameter.bounds


def use_bounds(evaluator: RunEvaluator, new_bounds: Mapping[str, Bounds]) -> None:
    """Replace the ranges of parameters of a run evaluator.

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


def get_physical_limits(evaluator: RunEvaluator, place: int) -> Bounds:
    """Return the physical limits of a base parameter; for a robot, those of its total value.

    Args:
        evaluator: the runs for fitting.
        place: index of the parameter.
    """
    parameter = evaluator.parameters[place]
    if evaluator.kind.has_model:
        coefficient = _get_coefficient(evaluator.kind, parameter.name)
        if coefficient is not None:
            lower_limit, upper_limit = coefficient.least, coefficient.most
            return (
                -np.inf if lower_limit is None else lower_limit,
                MAX_RANGE_FACTOR_MODEL_FILE * coefficient.plausible[0][1]
                if upper_limit is None
                else upper_limit,
            )
    return _get_physical_limits(parameter)


def _get_coefficient(kind: Any, name: str) -> Any:
    """Return the effect coefficient that a freed parameter of a robot's model file is fitted as.

    It is None for a parameter of the simulator itself.
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
    share = parameter.unit == "1" and low >= 0.0 and high <= 1.0
    return 0.0 if low >= 0.0 else -np.inf, 1.0 if share else np.inf


def widen_range(parameter: Parameter, limits: Bounds) -> Bounds:
    """Return the next wider range of a parameter.

    Args:
        parameter: the parameter with its present range.
        limits: its physical limits.
    """
    low, high = parameter.bounds
    width = high - low
    # A positive parameter stays positive, so its range grows by a factor on both sides.
    lower = (
        low / WIDENING_FACTOR if low > 0.0 else low - (WIDENING_FACTOR - 1.0) * width * (low < 0.0)
    )
    upper = high * WIDENING_FACTOR if low >= 0.0 else high + (WIDENING_FACTOR - 1.0) * width
    return max(lower, min(limits[0], low)), min(upper, max(limits[1], high))


def describe_unusual_values(
    evaluator: RunEvaluator, theta: Array, wider: Mapping[str, tuple[Bounds, Bounds]]
) -> list[str]:
    """Return a sentence for each fitted parameter that lies outside its declared range.

    Args:
        evaluator: the runs for fitting.
        theta: (P,) the fitted parameters.
        wider: by parameter name, the declared range and the wider range that was used.
    """
    sentences = []
    for i in evaluator.base_indices.tolist():
        parameter, value = evaluator.parameters[i], float(theta[i])
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
