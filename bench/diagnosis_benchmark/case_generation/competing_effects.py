"""Competing effects: effects of the library refitted to the observations of a case.

Cases that a competing effect explains too well are rejected as ambiguous. Only the most promising
effects are refitted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np

from bench.diagnosis_benchmark.case_generation.effect_sizing import NuisanceFitter, ResidualFit
from bench.diagnosis_benchmark.case_generation.recording_conditions import RecordingConditions
from bench.diagnosis_benchmark.case_generation.reference_simulation import SIMULATORS
from sims import effects as library
from sims.core.simulator import Array

MAX_REFITTED_EFFECTS = 4  # number of effects refitted, those with the smallest first-order residual
STARTS_PER_EFFECT = 3  # number of starting points from which one effect is refitted
SHAPE_GRIDS: dict[
    str, list[tuple[float, ...]]
] = {  # initial guesses of shape parameters, in the units of the library
    "force.periodic": [(f,) for f in (0.2, 0.4, 0.7, 1.2, 2.0, 3.5)],
    "force.ripple": [(p,) for p in (0.1, 0.2, 0.4, 0.8, 1.6, 3.0, 6.0)],
    "friction.position": [(p,) for p in (0.3, 0.6, 1.2, 2.5, 5.0)],
    "friction.warming": [(s,) for s in (0.7, 2.0, 6.0)],
    "friction.stribeck": [(s,) for s in (0.05, 0.2, 1.0)],
    "sensor.slip": [(s,) for s in (0.3, 0.7, 1.2, 2.0, 3.0, 4.0)],
    "wind": [(u, v) for u in (-4.0, 0.0, 4.0) for v in (-4.0, 0.0, 4.0)],
}


def compute_refitted_residual(
    setting: RecordingConditions,
    observed: Array,
    name: str,
    coefficients: Sequence[float] | None = None,
) -> float:
    """Compute the residual after base parameters, initial states and an effect are refitted.

    Args:
        setting: recording conditions with the true parameters, where the fit starts.
        observed: noise-free observations, (R, T, C).
        name: name of the effect.
        coefficients: starting values of its coefficients; None for several guesses.

    Returns:
        RMS residual in units of the noise.
    """
    fit = NuisanceFitter(setting, [name])
    if coefficients is not None:
        return fit(observed, [*setting.parameters.values(), *coefficients]).rms_residual
    guesses = _rank_starts(setting, observed, name, NuisanceFitter(setting)(observed))
    return min(fit(observed, guess).rms_residual for _, guess in guesses[:STARTS_PER_EFFECT])


def find_best_effect(setting: RecordingConditions, observed: Array) -> tuple[str, float]:
    """Find the effect of the library that leaves the smallest residual.

    Args:
        setting: recording conditions.
        observed: noise-free observations, (R, T, C).

    Returns:
        Name of the effect and RMS residual in units of the noise.
    """
    base_fit = NuisanceFitter(setting)(observed)
    usable = library.list_effects_for(SIMULATORS[setting.system].system)
    names = [
        n for n in usable if setting.is_driven or not (n.startswith("input.") or n == "backlash")
    ]
    first = {n: _rank_starts(setting, observed, n, base_fit)[0] for n in names}
    promising_names = sorted(first, key=lambda n: first[n][0])[:MAX_REFITTED_EFFECTS]
    residuals = {
        n: NuisanceFitter(setting, [n])(observed, first[n][1], base_fit.starts).rms_residual
        for n in promising_names
    }
    name = min(residuals, key=lambda n: residuals[n])
    return name, min(residuals[name], base_fit.rms_residual)


def _rank_starts(
    setting: RecordingConditions, observed: Array, name: str, base_fit: ResidualFit
) -> list[tuple[float, Array]]:
    """List starting points for refitting an effect, the best first.

    Args:
        setting: recording conditions.
        observed: noise-free observations, (R, T, C).
        name: name of the effect.
        base_fit: fit without the effect.

    Returns:
        Pairs of RMS residual (to first order where that is possible) and theta.
    """
    fit = NuisanceFitter(setting, [name])
    if name == "input.saturation":  # starts below the peak: at the peak the derivative is zero
        peak = max(np.abs(s.inputs["u"]).max() for s in setting.scenarios)
        guesses = [np.array([*base_fit.theta, share * peak]) for share in (0.9, 0.6)]
        result = [(_compute_residual(fit, observed, guess, base_fit), guess) for guess in guesses]
    elif name == "state.limit":  # an end stop that is not reached has no derivative either
        guesses = [
            np.array([*base_fit.theta, *stop])
            for stop in _iterate_stop_starts(setting, observed[..., 0])
        ]
        result = [(_compute_residual(fit, observed, guess, base_fit), guess) for guess in guesses]
    else:
        result = [
            _estimate_linear_step(fit, observed, shape, base_fit)
            for shape in SHAPE_GRIDS.get(name, [()])
        ]
    return sorted(result, key=lambda pair: pair[0])


def _iterate_stop_starts(
    setting: RecordingConditions, path: Array
) -> Iterator[tuple[float, float, float]]:
    """Yield starting values of an end stop: stiffness, place and loss.

    There are soft and hard stops at either end of the travel, which the motion meets late and
    early. A grid is used because a stop that the motion does not reach has no derivative.

    Args:
        setting: recording conditions.
        path: positions, of any shape; only the smallest and the largest are used.
    """
    low, high = float(path.min()), float(path.max())
    # Scale of the stiffness, N m/rad for a pendulum and N/m for a slider.
    max_stiffness = 20.0 if setting.system == "pendulum" else 5000.0
    for inset_share, stiffness_share in product((0.03, 0.15), (0.001, 0.01, 0.1)):
        inset = inset_share * (high - low)
        yield stiffness_share * max_stiffness, high - inset, 0.05
        yield -stiffness_share * max_stiffness, low + inset, 0.05


def _compute_residual(
    fit: NuisanceFitter, observed: Array, theta: Array, base_fit: ResidualFit
) -> float:
    """Compute the RMS residual at given parameters without refitting, in units of the noise.

    It ranks starting points where the derivative of the effect is zero, so that a linear step is
    impossible.

    Args:
        fit: fitter of the model with the effect.
        observed: noise-free observations, (R, T, C).
        theta: base parameters and coefficients of the effect.
        base_fit: fit without the effect, whose initial states are used.
    """
    residual, _ = fit.linearise(observed, theta, base_fit.starts)
    return float(np.sqrt(np.mean(residual**2)))


def _estimate_linear_step(
    fit: NuisanceFitter, observed: Array, shape: Sequence[float], base_fit: ResidualFit
) -> tuple[float, Array]:
    """Estimate the residual by one least-squares step from a zero effect with a fixed shape.

    Shape parameters that the system does not have are omitted.

    Returns:
        RMS residual of the linear model, and theta after the step.
    """
    base, count = base_fit.theta.size, fit.theta.size
    shape = shape[: count - base - 1]
    scaled = count - len(shape)
    theta = np.array([*base_fit.theta, *[0.0] * (scaled - base), *shape])
    residual, slope = fit.linearise(observed, theta, base_fit.starts)
    slope = np.delete(slope, np.s_[scaled:count], axis=1)
    # Almost no damping, because the model is linear here.
    step = fit.compute_step(residual, slope, 1e-9)
    theta[:scaled] += step[:scaled] * fit.scales[:scaled]
    return float(np.sqrt(np.mean((residual - slope @ step) ** 2))), np.clip(
        theta, fit.low, fit.high
    )
