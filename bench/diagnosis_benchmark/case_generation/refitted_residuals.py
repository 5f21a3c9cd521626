"""Residual sizes of hidden effects, and of competing effects, after parameters are refitted.

The size is the RMS residual after base parameters and initial states are refitted. The batch engine
is used here to choose sizes. Recordings of the benchmark come from other integrators, except for
hidden-state effects (`reference_simulation.simulate_with_mujoco`).

Cases that a competing effect explains too well are rejected as ambiguous. Only the most promising
effects are refitted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from bench.diagnosis_benchmark.case_generation.input_and_sensor_effects import EffectCoefficients
from bench.diagnosis_benchmark.case_generation.recording_conditions import (
    SIMULATORS,
    RecordingConditions,
)
from bench.diagnosis_benchmark.case_generation.reference_simulation import simulate_causes
from bench.diagnosis_benchmark.case_generation.strength_search import arrange_slopes
from sims import effects as library
from sims.core.root_mean_square import compute_rms
from sims.core.simulator import Array

FINITE_DIFFERENCE_STEP = 1e-5
"""Finite-difference step, as a fraction of a parameter's scale."""

DIVERGED_VALUE = 1e30
"""Value in units of the noise beyond which a simulation counts as diverged."""

FIRST_DAMPING = 1e-6
"""Damping of the first step, relative to the squared sensitivities."""

DAMPING_INCREASE = 30.0
"""Factor of the damping after a step that does not decrease the sum of squares."""

DAMPING_DECREASE = 10.0
"""Divisor of the damping after any other step."""

MAX_DAMPING = 1e3
"""Damping at which a fit ends."""

MIN_RELATIVE_GAIN = 1e-3
"""Relative decrease of the RMS residual below which a fit has converged."""

RIDGE = 1e-9
"""Constant part of the damping, relative to the largest squared sensitivity."""

SATURATION_SHARES = (0.9, 0.6)
"""Limits of an input from which its fit starts, as shares of the input's peak."""

STOP_INSET_SHARES = (0.03, 0.15)
"""Distances of an end stop from the end of the travel, as shares of the travel."""

STOP_STIFFNESS_SHARES = (0.001, 0.01, 0.1)
"""Stiffnesses of an end stop from which its fit starts, as shares of the largest one."""

STOP_LOSS = 0.05
"""Damping of an end stop from which its fit starts, as a factor of the approach velocity, s/m."""

MAX_REFITTED_EFFECTS = 4
"""Number of effects that are refitted, those with the smallest first-order residual."""

STARTS_PER_EFFECT = 3
"""Number of starting points from which one effect is refitted."""

SHAPE_GRIDS: dict[str, list[tuple[float, ...]]] = {
    "force.periodic": [(f,) for f in (0.2, 0.4, 0.7, 1.2, 2.0, 3.5)],
    "force.ripple": [(p,) for p in (0.1, 0.2, 0.4, 0.8, 1.6, 3.0, 6.0)],
    "friction.position": [(p,) for p in (0.3, 0.6, 1.2, 2.5, 5.0)],
    "friction.warming": [(s,) for s in (0.7, 2.0, 6.0)],
    "friction.stribeck": [(s,) for s in (0.05, 0.2, 1.0)],
    "sensor.slip": [(s,) for s in (0.3, 0.7, 1.2, 2.0, 3.0, 4.0)],
    "wind": [(u, v) for u in (-4.0, 0.0, 4.0) for v in (-4.0, 0.0, 4.0)],
}
"""Shape parameters from which the fit of an effect starts, in the units of the library."""

SIMPLER_EFFECTS = {
    "friction.direction": ("drag.linear",),
    "friction.load_direction": ("friction.load",),
    "friction.load_quadratic": ("friction.load",),
    "friction.position": ("friction.coulomb",),
    "friction.stribeck": ("friction.coulomb",),
    "input.power": ("input.gain",),
    "friction.warming": ("friction.coulomb", "drag.linear"),
    # Wind that is fast compared with the motion is a constant force.
    "wind": ("drag.linear", "drag.quadratic", "force.bias", "gravity.tilt"),
}
"""Simpler effects that an effect can resemble, by its name."""


@dataclass(frozen=True)
class ResidualFit:
    """Result of a fit.

    Attributes:
        rms_residual: RMS residual over all samples and channels, in units of the noise.
        theta: base parameters, then coefficients of effects.
        starts: initial states, (R, S).
    """

    rms_residual: float
    theta: Array
    starts: Array


class NuisanceFitter:
    """Damped least-squares fit of base parameters, effect coefficients and initial states."""

    def __init__(self, setting: RecordingConditions, effects: Sequence[str] = ()) -> None:
        """Make the simulator with the fitted effects; collect starting values, bounds and scales.

        The fit starts at the true base parameters and initial states and at the nominal
        coefficients. A coefficient may reach twice its plausible range, as far as a hidden effect
        can be. The scale of a base parameter is its value, that of a coefficient a tenth of its
        range; steps of the fit are in units of these scales.

        Args:
            setting: recording conditions with the true parameters and initial states.
            effects: names of the effects whose coefficients are fitted.
        """
        kind = SIMULATORS[setting.system]
        self.simulator = kind(setting.constants, setting.channels, engine="batch", effects=effects)
        self.scenarios = list(setting.scenarios)
        self.sigma = setting.noise_sigmas
        self.states = list(kind.states)
        true_values = [setting.parameters[p.name] for p in kind.system.parameters]
        # The simulator's parameters are the base parameters, then the coefficients of the effects.
        self.theta = np.array(
            [*true_values, *(p.nominal for p in self.simulator.parameters[len(true_values) :])]
        )
        self.starts = np.array(
            [[s.initial[name] for name in self.states] for s in setting.scenarios]
        )
        low, high = np.array([p.bounds for p in self.simulator.parameters]).T
        is_base_parameter = np.arange(low.size) < len(true_values)
        self.low = low
        self.high = np.where(is_base_parameter, high, low + 2 * (high - low))
        self.scales = np.where(is_base_parameter, self.theta, 0.1 * (high - low))

    def __call__(
        self,
        observed: Array,
        theta: Array | Sequence[float] | None = None,
        starts: Array | None = None,
        rounds: int = 12,
    ) -> ResidualFit:
        """Fit observations by the Levenberg-Marquardt method.

        The unknowns are base parameters, coefficients and the initial states of each run. A step
        that does not decrease the sum of squares increases the damping, another one decreases it.
        The fit stops when the RMS residual hardly decreases.

        Shapes: R runs, T samples, C channels, S states.

        Args:
            observed: observations, (R, T, C).
            theta: starting values of parameters and coefficients; None for the true parameters and
                the nominal coefficients.
            starts: starting values of the initial states, (R, S); None for the true ones.
            rounds: maximum number of iterations.

        Returns:
            The fit; its RMS residual is infinite if the simulation diverges at the start.
        """
        theta = self.theta if theta is None else np.asarray(theta, dtype=float)
        starts, damping = self.starts if starts is None else starts, FIRST_DAMPING
        residual, slope = self.linearise(observed, theta, starts)
        if not np.isfinite(residual).all():  # the simulation diverges at the start
            return ResidualFit(np.inf, theta, starts)
        for _ in range(rounds):
            step = self.compute_step(residual, slope, damping)
            theta_step, starts_step = step[: theta.size], step[theta.size :]
            new_theta = np.clip(theta + theta_step * self.scales, self.low, self.high)
            new_starts = starts + starts_step.reshape(starts.shape)
            new_residual, new_slope = self.linearise(observed, new_theta, new_starts)
            if not new_residual @ new_residual < residual @ residual:  # a NaN is no improvement
                damping *= DAMPING_INCREASE
                if damping > MAX_DAMPING:
                    break
                continue
            relative_gain = 1.0 - np.sqrt((new_residual @ new_residual) / (residual @ residual))
            theta, starts = new_theta, new_starts
            residual, slope = new_residual, new_slope
            damping /= DAMPING_DECREASE
            if relative_gain < MIN_RELATIVE_GAIN:
                break
        return ResidualFit(compute_rms(residual), theta, starts)

    @staticmethod
    def compute_step(residual: Array, slope: Array, damping: float) -> Array:
        """Solve the damped normal equations of Levenberg and Marquardt.

        The damping is relative to the diagonal. The small constant part (`RIDGE`)
        keeps the matrix regular if an unknown has no influence.

        Args:
            residual: N residuals, observed minus simulated, (N,).
            slope: Jacobian of the simulation for P unknowns, in units of their scales, (N, P).
            damping: damping factor of the diagonal.

        Returns:
            Step to be added to the unknowns, in units of the scales, (P,); not finite if the
            residual is not.
        """
        normal_matrix = slope.T @ slope
        diagonal = np.diag(normal_matrix)
        normal_matrix = normal_matrix + np.diag(damping * diagonal + RIDGE * diagonal.max())
        # The residual is infinite if the simulation diverges.
        with np.errstate(invalid="ignore"):
            gradient = slope.T @ residual
        return np.asarray(np.linalg.solve(normal_matrix, gradient), dtype=np.float64)

    def linearise(self, observed: Array, theta: Array, starts: Array) -> tuple[Array, Array]:
        """Compute the residual and its Jacobian by finite differences.

        All variants are simulated in one batch: for each run, the given values, each parameter
        changed, and each initial state changed. The initial states of a run influence only its own
        rows of the Jacobian.

        Shapes: R runs, T samples, C channels, S states, N = R T C residuals, P = parameters,
        coefficients and R S initial states.

        Args:
            observed: observations, (R, T, C).
            theta: parameters and coefficients.
            starts: initial states, (R, S).

        Returns:
            The residual (N,) in units of the noise, infinite if the simulation diverges, and the
            Jacobian (N, P) of the simulation in units of the scales.
        """
        runs, state_count, count = len(starts), len(self.states), theta.size
        variant_count = 1 + count + state_count
        thetas = np.tile(theta, (runs, variant_count, 1))
        initial_states = np.tile(starts[:, None], (1, variant_count, 1))
        # Variant 0 is unchanged; variants of theta follow, then those of the initial states.
        for i in range(count):
            thetas[:, 1 + i, i] += FINITE_DIFFERENCE_STEP * self.scales[i]
        for i in range(state_count):
            initial_states[:, 1 + count + i, i] += FINITE_DIFFERENCE_STEP
        initial = {name: initial_states[:, :, i].ravel() for i, name in enumerate(self.states)}
        scenarios = [s for s in self.scenarios for _ in range(variant_count)]
        observations = (
            self.simulator.simulate_batch(
                thetas.reshape(runs * variant_count, count), scenarios, initial
            )
            / self.sigma
        )
        observations = observations.reshape(runs, variant_count, -1)
        residual = (observed / self.sigma).reshape(runs, -1) - observations[:, 0]
        slopes = (observations[:, 1:] - observations[:, :1]) / FINITE_DIFFERENCE_STEP
        is_finite = (np.abs(observations) < DIVERGED_VALUE).all()
        return (
            residual.ravel() if is_finite else np.full(residual.size, np.inf),
            arrange_slopes(slopes, count),
        )


def make_gap_function(
    setting: RecordingConditions, observed: Callable[[float], Array]
) -> Callable[[float], float]:
    """Make the function that computes the size of a cause from its strength.

    The size is the RMS residual that is left when the model without the cause is refitted to the
    recording with the cause. Each call starts its fit at the result of the last one.

    Shapes: R runs, T samples, C channels.

    Args:
        setting: recording conditions.
        observed: noise-free observations (R, T, C) as a function of the strength.

    Returns:
        RMS residual after refitting, in units of the noise, as a function of the strength.
    """
    fit = NuisanceFitter(setting)
    last_evaluation: list[tuple[float, ResidualFit]] = []

    def compute_size(strength: float) -> float:
        """Return the RMS residual, in units of the noise, that a cause of a strength leaves.

        `observed` gives the recording with the cause at a strength, and `fit` refits the model
        without it, from the true parameters and initial states or, if there was a call before, from
        values extrapolated from its fit, which saves iterations.

        Args:
            strength: factor of the coefficients of the cause.
        """
        theta, starts = fit.theta, fit.starts
        # The fitted values differ from the true ones about in proportion to the strength.
        if last_evaluation:
            last_strength, fitted = last_evaluation[-1]
            share = strength / last_strength
            theta = np.clip(theta + share * (fitted.theta - theta), fit.low, fit.high)
            starts = starts + share * (fitted.starts - starts)
        fitted = fit(observed(strength), theta, starts)
        if np.isfinite(fitted.rms_residual):
            last_evaluation.append((strength, fitted))
        return fitted.rms_residual

    return compute_size


def compute_wrong_answer_residual(
    kind: str, setting: RecordingConditions, effects: EffectCoefficients, size: float
) -> float | None:
    """Compute the RMS residual that the best wrong answer leaves, in units of the noise.

    It would be a correct answer if it left little. Wrong answers by kind of case:

    * single: simpler forms of the effect, such as Coulomb friction for Stribeck friction,
    * double: each of the two effects alone,
    * foreign: the best effect of the library.

    Args:
        kind: single, double or foreign.
        setting: recording conditions with the runs for fitting only.
        effects: coefficients of the hidden causes by name.
        size: size of each in units of the noise.

    Returns:
        The residual; 0 if the simulation with the causes diverges, so that the case is rejected;
        None for a single effect that has no simpler form or is smaller than the noise.
    """
    # Effects with the coefficients from which their fit starts; None for several guesses.
    wrong_answers = (
        [(simpler, None) for name in effects for simpler in SIMPLER_EFFECTS.get(name, ())]
        if kind == "single"
        else list(effects.items())
    )
    if kind == "single" and (not wrong_answers or size < 1.0):
        return None
    observed = simulate_causes(setting, effects)
    if not np.isfinite(observed).all():
        return 0.0
    if kind == "foreign":
        return compute_smallest_residual(setting, observed)
    return min(
        compute_refitted_residual(setting, observed, name, coefficients)
        for name, coefficients in wrong_answers
    )


def compute_refitted_residual(
    setting: RecordingConditions,
    observed: Array,
    name: str,
    coefficients: Sequence[float] | None = None,
) -> float:
    """Compute the residual after base parameters, initial states and an effect are refitted.

    It tells whether this effect can explain a recording with another hidden cause.

    Shapes: R runs, T samples, C channels.

    Args:
        setting: recording conditions with the true parameters, where the fit starts.
        observed: noise-free observations, (R, T, C).
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
        coefficients: starting values of its coefficients; None for several guesses.

    Returns:
        RMS residual in units of the noise.
    """
    fit = NuisanceFitter(setting, [name])
    if coefficients is not None:
        return fit(observed, [*setting.parameters.values(), *coefficients]).rms_residual
    base_fit = NuisanceFitter(setting)(observed)  # without the effect
    # Pairs of first-order residual and starting values, the best first.
    guesses = _rank_starts(setting, observed, name, base_fit)
    return min(fit(observed, guess).rms_residual for _, guess in guesses[:STARTS_PER_EFFECT])


def compute_smallest_residual(setting: RecordingConditions, observed: Array) -> float:
    """Compute the RMS residual that the best effect of the library leaves, in units of the noise.

    All effects are ranked by their residual to first order; only the most promising ones are
    refitted. Effects of the input are left out if nothing drives the system.

    Shapes: R runs, T samples, C channels.

    Args:
        setting: recording conditions.
        observed: noise-free observations, (R, T, C).
    """
    base_fit = NuisanceFitter(setting)(observed)
    usable = library.list_effects_for(SIMULATORS[setting.system].system)
    names = [
        name
        for name in usable
        if setting.is_driven or not (name.startswith("input.") or name == "backlash")
    ]
    # By effect, the first-order residual of its best start, and that start (theta).
    best_starts = {name: _rank_starts(setting, observed, name, base_fit)[0] for name in names}
    promising_names = sorted(names, key=lambda name: best_starts[name][0])[:MAX_REFITTED_EFFECTS]
    # An effect can be zero, so it never leaves more than the model without it.
    residuals = [base_fit.rms_residual]
    for name in promising_names:
        _, theta = best_starts[name]
        refit = NuisanceFitter(setting, [name])(observed, theta, base_fit.starts)
        residuals.append(refit.rms_residual)
    return min(residuals)


def _rank_starts(
    setting: RecordingConditions, observed: Array, name: str, base_fit: ResidualFit
) -> list[tuple[float, Array]]:
    """List starting points for refitting an effect, the best first.

    A least-squares fit finds only the minimum near its start. Effects with a shape (a period, a
    time, a position) therefore start from several shapes, each after one linear step from an effect
    of size zero. A saturation or an end stop has no derivative while it is not reached; such
    effects start from a grid of values at which they act.

    Shapes: R runs, T samples, C channels.

    Args:
        setting: recording conditions.
        observed: noise-free observations, (R, T, C).
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
        base_fit: fit without the effect.

    Returns:
        Pairs of RMS residual (to first order where that is possible) and theta.
    """
    fit = NuisanceFitter(setting, [name])
    guesses: list[tuple[float, ...]]
    if name == "input.saturation":
        peak = max(np.abs(s.inputs["u"]).max() for s in setting.scenarios)
        guesses = [(share * peak,) for share in SATURATION_SHARES]
    elif name == "state.limit":
        guesses = list(_iterate_stop_starts(setting, observed[..., 0]))  # channel 0: position
    else:
        guesses = []
    if guesses:
        thetas = [np.array([*base_fit.theta, *coefficients]) for coefficients in guesses]
        starts = [(_compute_residual(fit, observed, theta, base_fit), theta) for theta in thetas]
    else:
        # An effect without a shape has one start.
        starts = [
            _estimate_linear_step(fit, observed, shape, base_fit)
            for shape in SHAPE_GRIDS.get(name, [()])
        ]
    return sorted(starts, key=lambda residual_and_theta: residual_and_theta[0])


def _iterate_stop_starts(
    setting: RecordingConditions, path: Array
) -> Iterator[tuple[float, float, float]]:
    """Yield starting values from which an end stop is fitted.

    There are soft and hard stops at either end of the travel, which the motion meets late and
    early. A grid is used because a stop that the motion does not reach has no derivative.

    Args:
        setting: recording conditions.
        path: positions, of any shape; only the smallest and the largest are used.

    Yields:
        Stiffness, whose sign is the side of the stop, position, and loss: the damping as a factor
        of the approach velocity, s/m or s/rad.
    """
    low, high = float(path.min()), float(path.max())
    # Scale of the stiffness, N m/rad for a pendulum and N/m for a slider.
    max_stiffness = 20.0 if setting.system == "pendulum" else 5000.0
    for inset_share, stiffness_share in product(STOP_INSET_SHARES, STOP_STIFFNESS_SHARES):
        inset = inset_share * (high - low)
        yield stiffness_share * max_stiffness, high - inset, STOP_LOSS
        yield -stiffness_share * max_stiffness, low + inset, STOP_LOSS


def _compute_residual(
    fit: NuisanceFitter, observed: Array, theta: Array, base_fit: ResidualFit
) -> float:
    """Compute the RMS residual at given parameters without refitting, in units of the noise.

    It ranks starting points where the derivative of the effect is zero, so that a linear step is
    impossible.

    Shapes: R runs, T samples, C channels.

    Args:
        fit: fitter of the model with the effect.
        observed: noise-free observations, (R, T, C).
        theta: base parameters and coefficients of the effect.
        base_fit: fit without the effect, whose initial states are used.
    """
    residual, _ = fit.linearise(observed, theta, base_fit.starts)
    return compute_rms(residual)


def _estimate_linear_step(
    fit: NuisanceFitter, observed: Array, shape: Sequence[float], base_fit: ResidualFit
) -> tuple[float, Array]:
    """Estimate the residual by one least-squares step from a zero effect with a fixed shape.

    theta consists of the base parameters, the linear coefficients of the effect (zero at first) and
    its shape parameters (such as a period), which the step does not change. Shape parameters that
    the system does not have are omitted, as the second component of the wind for a slider.

    Shapes: R runs, T samples, C channels.

    Args:
        fit: fits parameters, coefficients and initial states.
        observed: noise-free observations, (R, T, C).
        shape: shape parameters of the effect.
        base_fit: fit without the effect.

    Returns:
        RMS residual of the linear model, and theta after the step.
    """
    base_count, count = base_fit.theta.size, fit.theta.size
    # The effect has count - base_count coefficients, of which at least one is linear.
    shape = shape[: count - base_count - 1]
    fitted_count = count - len(shape)
    theta = np.array([*base_fit.theta, *[0.0] * (fitted_count - base_count), *shape])
    residual, slope = fit.linearise(observed, theta, base_fit.starts)
    # The columns of the initial states follow those of theta and stay.
    slope = np.delete(slope, np.s_[fitted_count:count], axis=1)
    # Almost no damping, because the model is linear here.
    step = fit.compute_step(residual, slope, damping=1e-9)
    theta[:fitted_count] += step[:fitted_count] * fit.scales[:fitted_count]
    return compute_rms(residual - slope @ step), np.clip(theta, fit.low, fit.high)
