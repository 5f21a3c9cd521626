"""Multi-start fit of the base model, initial values from a tuner, and wider ranges at bounds.

A declared range is a guess of usual values. If the best value lies outside it, the base model is
wrong, and an effect of the library would be fitted to the difference. Therefore the range is
widened as far as physics allows, and the base model is fitted again.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from bench.benchmark.runner.standalone_tuning import (
    StandaloneProblem,
    run_tuner,
    spread_start_points,
)
from bench.core.random_streams import make_rng
from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.parameter_bounds import (
    MAX_WIDENING_ROUNDS,
    list_wider_bounds,
    use_bounds,
)
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.levenberg_marquardt import FitStart, TrajectoryFit
from bench.diagnosis.fitting.trajectory_derivatives import compute_state_jacobian
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from sims.core.simulator import Array, Parameter

GRID_STARTS = 15
"""Number of starts over the bounds, in addition to the nominal start."""
FITTED_STARTS = 3
"""Number of starts that are fitted: those with the lowest cost."""
FINAL_ITERATIONS = 10
"""Maximum number of steps of a final fit, after parameters or settings have changed."""
MIN_SENSITIVITY_SIGMAS = 1.0
"""Minimum change of the observations, in sigmas, of a parameter that influences the data.

The change is that of all samples together (root of the sum of squares) when the parameter moves
across its bounds.
"""
LOG_SCALE_RATIO = 5.0
"""Minimum ratio of the bounds of a parameter for which starts are spaced logarithmically."""
FAILED_SAMPLE_RESIDUAL = 1e3
"""Residual of a sample that a start could not simulate, in the unit of the channel."""
TUNER_SIMULATION_BUDGET = 60
"""Maximum number of simulations of all runs by the tuner."""
TUNER_TIME_LIMIT_SECONDS = 300.0
"""Time limit of the tuner, in seconds."""


class Horizon(NamedTuple):
    """A fit horizon.

    Attributes:
        share: initial share of each run that is fitted.
        iterations: number of steps of the fit.
    """

    share: float
    iterations: int


FILTERED_FIT_HORIZONS = (Horizon(1.0, 6),)
"""Fit horizons of a robot whose runs start near their best states, due to a state filter."""
FIT_HORIZONS = (Horizon(0.2, 6), Horizon(0.45, 6), Horizon(1.0, 20))
"""Fit horizons, used one after another.

The end of a run depends on its beginning so strongly that only a nearly fitted model can follow it.
"""


@dataclass(frozen=True)
class BaseFit:
    """The fitted base model.

    Attributes:
        fit: the fit.
        insensitive_parameters: indices of parameters that stay nominal because they do not
            influence the data.
        unidentified_parameters: indices of parameters that stay nominal because the data do not
            determine them together with the others.
    """

    fit: TrajectoryFit
    insensitive_parameters: frozenset[int]
    unidentified_parameters: frozenset[int] = frozenset()

    @property
    def fixed_parameters(self) -> frozenset[int]:
        """Indices in theta of all base parameters that stay at their nominal values."""
        return self.insensitive_parameters | self.unidentified_parameters

    def refit(
        self, evaluator: RunEvaluator, noise: NoiseModel, start: FitStart | None = None
    ) -> BaseFit:
        """Return the model with its free parameters fitted again.

        Args:
            evaluator: evaluator that simulates the recorded runs.
            noise: noise that weights the channels.
            start: start of the fit; None for the present fit.
        """
        fitter = TrajectoryFitter(evaluator, noise, self.fixed_parameters)
        (fit,) = fitter.fit_models([start or self.fit.make_start()], FINAL_ITERATIONS)
        return replace(self, fit=fit)

    def refit_at_nominal(
        self, evaluator: RunEvaluator, noise: NoiseModel, fixed_indices: Collection[int]
    ) -> BaseFit:
        """Return the model fitted again with some fixed parameters at their nominal values.

        Args:
            evaluator: evaluator that simulates the recorded runs.
            noise: noise that weights the channels.
            fixed_indices: indices of fixed parameters that are set.
        """
        indices = list(fixed_indices)
        theta = self.fit.theta.copy()
        theta[indices] = evaluator.get_nominal_theta()[indices]
        return self.refit(evaluator, noise, replace(self.fit.make_start(), theta=theta))


def fit_base_model(
    evaluator: RunEvaluator,
    noise: NoiseModel,
    initial_base: Array | None = None,
    max_cost: float = np.inf,
) -> BaseFit:
    """Fit the parameters and initial states of the model without effects.

    1. List starts, and select those with the lowest costs by simulation.
    2. Fit the beginnings of the runs, then longer parts of them, with the best starts.
    3. For a linearised robot, fit again with derivatives at the fitted model.
    4. Set parameters to which the runs are insensitive to their nominal values, and fit the others.

    Args:
        evaluator: evaluator that simulates the recorded runs.
        noise: noise that weights the channels.
        initial_base: (b,) base parameters to start from, for example from a tuner; None for a
            multi-start over the bounds.
        max_cost: cost above which the base model is of no interest. The cost of whole runs is at
            least that of their beginnings, so a fit that exceeds it there is not continued.

    Returns:
        The best fit, with insensitive parameters at their nominal values. If it exceeds `max_cost`
        at the beginning of the runs, it is simulated only there.
    """
    # 1. Starts. The base model has no effects, hence the empty tuple.
    thetas = _list_starts(evaluator, initial_base)
    starts = [FitStart((), theta, evaluator.initial_state_guesses) for theta in thetas]
    # Simulating a start costs far less than fitting it, so the starts are reduced first.
    evaluator.search_control.report(f"base fit from {len(starts)} starts")
    if len(starts) > FITTED_STARTS:
        order = np.argsort(compute_start_costs(evaluator, noise, starts), kind="stable")
        starts = [starts[i] for i in order[:FITTED_STARTS]]

    # 2. Longer and longer parts of the runs. A state filter has already found initial states near
    # the best ones, so that whole runs can be fitted at once.
    horizons = FIT_HORIZONS if evaluator.filtered_runs is None else FILTERED_FIT_HORIZONS
    for horizon in horizons:
        evaluator.search_control.report(f"base fit, first {horizon.share:.0%} of the runs")
        fits = TrajectoryFitter(evaluator, noise, share=horizon.share).fit_models(
            starts, horizon.iterations
        )
        starts = [fit.make_start() for fit in fits]
        best = min(fits, key=lambda fit: fit.cost)
        # Whole runs would cost at least as much.
        if best.cost > max_cost and horizon.share < 1.0:
            return BaseFit(best, frozenset())
    # 3. Derivatives at the fitted model, by initial states. All later fits share them. Without a
    # filter, they were computed about the first start, far from the fitted model.
    if evaluator.has_linearisation and evaluator.filtered_runs is None:
        compute_state_jacobian(evaluator, best.theta, best.initial_states, is_recomputed=True)
        best = BaseFit(best, frozenset()).refit(evaluator, noise).fit

    # 4. Insensitive parameters.
    # Their fitted values mean nothing, because the data do not depend on them.
    base_indices = evaluator.base_indices.tolist()
    insensitive = frozenset(i for i in base_indices if not _is_sensitive(evaluator, best, i, noise))
    base = BaseFit(best, insensitive)
    return base.refit_at_nominal(evaluator, noise, insensitive) if insensitive else base


def _list_starts(evaluator: RunEvaluator, initial_base: Array | None) -> list[Array]:
    """Return parameter vectors (P,) from which the base model is fitted.

    They are spread over the bounds, because a fit finds the nearest local minimum only.

    Shapes: P parameters.

    Args:
        evaluator: evaluator, which has the nominal parameters and their bounds.
        initial_base: (b,) base parameters to start from; None for the nominal ones and a regular
            grid over the bounds.
    """
    nominal = evaluator.get_nominal_theta()
    if initial_base is not None:
        nominal[evaluator.base_indices] = initial_base
        return [nominal]
    parameters = [evaluator.parameters[i] for i in evaluator.base_indices]
    starts = [nominal]
    # A simulator may have no parameters; its base fit only fits initial states.
    if not parameters:
        return starts
    for position_shares in spread_start_points(GRID_STARTS, len(parameters)):
        theta = nominal.copy()
        for index, parameter, share in zip(
            evaluator.base_indices, parameters, position_shares, strict=True
        ):
            theta[index] = _interpolate_bounds(parameter, share)
        starts.append(theta)
    return starts


def _interpolate_bounds(parameter: Parameter, share: float) -> float:
    """Return the value at a share (0 to 1) of the way from the lower to the upper bound.

    Over a wide positive range, equal steps of the share multiply the value by equal factors.

    Args:
        parameter: parameter with lower and upper bound.
        share: position between the bounds, from 0 to 1.
    """
    low, high = parameter.bounds
    if low > 0 and high / low > LOG_SCALE_RATIO:
        return float(low * (high / low) ** share)
    return float(low + (high - low) * share)


def compute_lowest_start_cost(evaluator: RunEvaluator, noise: NoiseModel, share: float) -> float:
    """Return the lowest cost of the starts of a base fit, before any fit.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        noise: noise that weights the channels.
        share: initial share of each run that counts.

    Returns:
        The sum of squares; infinite if no start can be simulated.
    """
    starts = [
        FitStart((), theta, evaluator.initial_state_guesses)
        for theta in _list_starts(evaluator, None)
    ]
    # With an infinite residual of failed samples, a start that fails anywhere has an infinite cost.
    costs = compute_start_costs(evaluator, noise, starts, share, failed_residual=np.inf)
    return float(costs.min())


def compute_start_costs(
    evaluator: RunEvaluator,
    noise: NoiseModel,
    starts: Sequence[FitStart],
    share: float = FIT_HORIZONS[0].share,
    failed_residual: float = FAILED_SAMPLE_RESIDUAL,
) -> Array:
    """Return the sum of squares of each start over the first samples of the runs, without a fit.

    It selects the starts that are worth a fit. Residuals are in units of the noise. By default a
    sample that cannot be simulated has a large finite residual, so that starts that fail late are
    better than those that fail early.

    Args:
        evaluator: evaluator that simulates the recorded runs.
        noise: noise that weights the channels.
        starts: parameters and initial states.
        share: fraction of each run, from its beginning, that counts.
        failed_residual: residual of a sample that could not be simulated, in the unit of the
            channel.

    Returns:
        Sums of squares (n,) of the n starts.
    """
    thetas = np.array([s.theta for s in starts])
    states = np.array([s.initial_states for s in starts])
    simulated = evaluator.simulate_all_runs(thetas, states, share)
    # An abandoned start has no samples, and must not seem to fit them.
    unmasked_residuals = np.nan_to_num(evaluator.observed - simulated, nan=failed_residual)
    residuals = np.where(evaluator.get_sample_mask(share), unmasked_residuals, 0.0) / noise.sigma
    costs: Array = np.square(residuals).sum(axis=(1, 2, 3))
    return costs


def _is_sensitive(
    evaluator: RunEvaluator, fit: TrajectoryFit, index: int, noise: NoiseModel
) -> bool:
    """Return whether the simulated runs depend on a parameter enough to estimate it.

    The norm of the change of all samples, in units of the noise, must exceed
    `MIN_SENSITIVITY_SIGMAS` if the parameter moves over its whole range. It is computed from the
    derivatives at the fit.

    Args:
        evaluator: evaluator with the recorded runs.
        fit: fit of the base model, whose Jacobian is used.
        index: index of the parameter in theta.
        noise: noise of each channel.
    """
    # A fixed parameter has no column in the Jacobian (R, T, C, q + s).
    columns = np.flatnonzero(fit.free_indices == index)
    if not columns.size:
        return False
    low, high = evaluator.parameters[index].bounds
    change = fit.jacobian[..., columns[0]] * (high - low) / noise.sigma
    recorded_change = change[np.isfinite(evaluator.observed)]
    change_norm = np.sqrt(np.square(recorded_change).sum())
    return float(change_norm) > MIN_SENSITIVITY_SIGMAS


def fit_wider(evaluator: RunEvaluator, noise: NoiseModel, base: BaseFit) -> BaseFit:
    """Widen the ranges of parameters that are at a bound, and fit the base model again.

    A declared range is a guess. If the best value lies outside it, an effect would be fitted to the
    difference later, and reported as a cause. This is repeated until no parameter is at a bound
    that physics allows to exceed.

    Args:
        evaluator: the runs for fitting; the ranges of its parameters are replaced.
        noise: noise of each channel.
        base: fit of the base model, with the parameters that were fixed or freed.

    Returns:
        The base model; the same if no range was widened.
    """
    for _ in range(MAX_WIDENING_ROUNDS):
        wider_bounds = list_wider_bounds(evaluator, base.fit.theta, base.fixed_parameters)
        if not wider_bounds or evaluator.search_control.is_over():
            break
        use_bounds(evaluator, wider_bounds)
        base = base.refit(evaluator, noise)
    return base


def find_start_with_tuner(
    name: str, evaluator: RunEvaluator, noise: NoiseModel, seed: int
) -> Array:
    """Let a tuner search base parameters (b,) from which the base model is fitted.

    Initial states are fixed at their guesses from the first samples.

    Args:
        name: name of the tuner.
        evaluator: evaluator that simulates the recorded runs.
        noise: noise of each channel.
        seed: seed of the tuner's random numbers.

    Returns:
        The best base parameters that the tuner finds within its simulation budget and time limit.

    Raises:
        InputError: the tuner does not exist, or must be trained first.
    """
    channels = evaluator.observed.shape[2]
    # A tuner accepts one table (R T, C), so the R runs, padded to T samples, are concatenated.
    observed = evaluator.observed.reshape(-1, channels)
    parameters = [evaluator.parameters[i] for i in evaluator.base_indices]
    problem = StandaloneProblem(
        parameters=parameters,
        start=evaluator.get_nominal_theta()[evaluator.base_indices],
        observed=observed,
        scale=noise.sigma,
        lengths=(evaluator.observed.shape[1],) * len(evaluator.prepared_runs),
        evaluate=lambda base: _evaluate_base(evaluator, noise, observed, base),
    )
    return run_tuner(
        name,
        problem,
        TUNER_SIMULATION_BUDGET,
        TUNER_TIME_LIMIT_SECONDS,
        make_rng("explain", name, seed),
    )


def _evaluate_base(
    evaluator: RunEvaluator,
    noise: NoiseModel,
    observed: Array,
    base: Array,
) -> tuple[Array, Array]:
    """Simulate all runs with n sets of base parameters, and return their losses for a tuner.

    The loss is the root mean square of the residuals in units of the noise, as in a comparison of
    tuners, with zeros for missing samples; it is infinite if the simulation fails.

    Shapes: R runs, padded to T samples, C channels.

    Args:
        evaluator: evaluator that simulates the recorded runs.
        noise: noise of each channel.
        observed: (R T, C) observations of all runs, concatenated.
        base: (n, b) sets of base parameters.

    Returns:
        Simulated observations (n, R T, C) and losses (n,).
    """
    # No effect is active, because the coefficients after the base parameters are zero.
    theta = np.tile(evaluator.get_nominal_theta(), (len(base), 1))
    theta[:, evaluator.base_indices] = base
    simulated = evaluator.simulate_all_runs(theta, evaluator.initial_state_guesses)
    simulated = simulated.reshape(len(base), *observed.shape)
    residuals = np.where(np.isfinite(observed), simulated - observed, 0.0)
    # An abandoned simulation is NaN, which is expected here.
    with np.errstate(invalid="ignore"):
        squares = np.square(residuals / noise.sigma)
        losses = np.sqrt(squares.mean(axis=(1, 2)))
    return simulated, np.where(np.isfinite(losses), losses, np.inf)
