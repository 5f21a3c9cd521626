"""Value of candidate runs: expected discrimination of models, or information about parameters.

If two models explain the present data, the value of a run x is the residual of the competing model
on that run after it is refitted to both the data and the run. C is the covariance of its parameters
from the present data, and d is the difference of the two models on the run (T-optimality; A. C.
Atkinson, V. V. Fedorov, Biometrika 62(1), 57, 1975, doi:10.1093/biomet/62.1.57):

    T(x) = min over δ, z of  |d - J δ - B z|^2 + δ' C^-1 δ                                      (1)

All terms are whitened by the noise of the present data. J and B are the derivatives of the
competing model by its parameters and by the free initial state of the run. Either model may be
true, so each is fitted to the prediction of the other, and the smaller value counts. If no models
compete but parameters are uncertain, the value of a run is the decrease of that uncertainty
(D-optimality; V. V. Fedorov, Theory of Optimal Experiments, 1972),

    D(x) = 1/2 log det(I + C J' (I - B B^+) J)                                                  (2)

Because of the noise of the run, twice the difference of the log-likelihoods of the two models has
the mean T and the variance 4 T.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.noise_model import NoiseModel, whiten
from bench.diagnosis.experiment_design.candidate_runs import CandidateRun
from bench.diagnosis.experiment_design.safety_limits import RigLimits
from bench.diagnosis.fitting.fitted_models import FittedModel, ModelSet
from bench.diagnosis.validation.confidence_intervals import (
    compute_covariance,
    compute_fisher_blocks,
)
from sims.core.simulator import Array

DISCRIMINATION_THRESHOLD = 25.0
"""Minimum discrimination (1) for which a run distinguishes two models: despite its noise, odds of
at least 33 to 1 result in 19 of 20 cases.
"""
MAX_USEFUL_DISCRIMINATION = 4.0 * DISCRIMINATION_THRESHOLD
"""Discrimination (1) above which a run gains no further value."""
MAX_EVALUATED_RUNS = 12
"""Maximum number of runs of a robot for which (1) is computed: those with the largest difference of
the models before a refit.
"""
MAX_EXACT_EVALUATIONS, MAX_EXACT_EVALUATIONS_ROBOT = 12, 4
"""Maximum number of exact evaluations of (1) in a row, for a system and for a robot, which is
slower to simulate.
"""
STATE_STEP_SHARE = 1e-3
"""Step of an initial state for a derivative, in units of the state."""
MAX_STATE_STEP_GROWTH = 100.0
"""Maximum growth factor of such a step during a run, relative to the channel scales."""
MAX_FIT_ITERATIONS = 12
"""Maximum number of iterations of a fit of a competing model to a candidate run."""
MAX_DAMPING = 1e8
"""Damping (D. W. Marquardt 1963) above which a fit of a competing model to a candidate run stops.
"""
FIRST_DAMPING = 1e-6
"""Damping of the first step of a fit, relative to the squared sensitivities."""
DAMPING_INCREASE = 100.0
"""Factor of the damping after a step that failed or did not lower the cost."""
DAMPING_DECREASE = 10.0
"""Divisor of the damping after a step that lowered the cost."""
MIN_RELATIVE_DECREASE = 1e-3
"""Relative decrease of the cost below which a fit has converged."""
FIRST_ORDER_DAMPING = 1e-9
"""Damping of a single linear step, which only keeps the normal equations regular."""
RIDGE = 1e-18
"""Ridge of the normal equations, for parameters without any influence."""


class _ParameterInformation(NamedTuple):
    """Information of the present runs on a model's parameters.

    Each parameter is in units of `spread`: its standard error, but at most a tenth of its bounds.

    Attributes:
        model: Fitted model.
        spread: (q,) unit of each fitted parameter.
        inverse: (q, q) inverse of the covariance of the parameters, in these units.
    """

    model: FittedModel
    spread: Array
    inverse: Array


class _LinearisedRun(NamedTuple):
    """Linearisation of a run with a model, whitened.

    Attributes:
        prediction: (n,) prediction.
        parameter_jacobian: (n, q) derivatives by the parameters, each in units of its spread.
        state_jacobian: (n, s) derivatives by the initial state.
    """

    prediction: Array
    parameter_jacobian: Array
    state_jacobian: Array


class RunValue(NamedTuple):
    """Value of a candidate run.

    Attributes:
        run: Candidate run.
        values: Discrimination T of each ordered pair of models, eq. (1) of the module docstring;
            with one model the information gain D, eq. (2).
        value: Value of the run over all pairs.
        is_exact: Whether T is computed exactly, not only to first order.
    """

    run: CandidateRun
    values: Array
    value: float
    is_exact: bool = False


def get_sort_key(entry: RunValue) -> tuple[float, str]:
    """Return a sort key that puts the best run first."""
    return -entry.value, entry.run.says


class RunRanker:
    """Ranker of candidate runs for some models, the first of which is the present diagnosis."""

    def __init__(self, models: ModelSet, competing_models: Sequence[FittedModel]) -> None:
        """Prepare the noise, the limits of the setup, and the covariances of the parameters.

        The attributes are:

        - `information`: inverse covariance C^-1 of the parameters of each model by the present
          data, eq. (1) of the module docstring.
        - `pairs`: all ordered pairs of indices (true model, competing model).
        - `max_total_value`: value of a run (its summed discrimination) at which all models are
          distinguished, so that a larger one is not better; infinite with a single model.
        - `max_exact_evaluations`: maximum number of exact evaluations (by fits) in a row.
        - `is_free_state`: (s,) mask of the initial states that have to be estimated.

        Shapes: s states of a run.

        Args:
            models: Fitted models with noise and run evaluator.
            competing_models: Models that explain the present data about equally well; a single one
                if only its parameters are uncertain.
        """
        self.models, self.evaluator = models, models.evaluator
        self.information = [
            _compute_parameter_information(models, model) for model in competing_models
        ]
        # Noise and limits are those of the model of the present diagnosis, which comes first.
        self.noise: NoiseModel = compute_fisher_blocks(models, competing_models[0]).noise
        self.limits = RigLimits(self.evaluator, competing_models[0])
        self.pairs = list(permutations(range(len(competing_models)), 2))
        # Both orders of a pair count once. An information gain has no limit.
        self.max_total_value = (
            MAX_USEFUL_DISCRIMINATION * len(self.pairs) / 2 if self.pairs else np.inf
        )
        self.max_exact_evaluations = (
            MAX_EXACT_EVALUATIONS_ROBOT if self.evaluator.kind.has_model else MAX_EXACT_EVALUATIONS
        )
        self.is_free_state = ~self.evaluator.known_state_mask.all(axis=0)

    # -- runs

    def rank_runs(self, runs: Sequence[CandidateRun]) -> list[RunValue]:
        """Return the runs within the limits, the most valuable first.

        If models compete, the value of a run is their discrimination T to first order: by how much
        the models still differ on the run after the competing one has adapted to it. Otherwise it
        is the information gain D: by how much the run narrows the uncertain parameters. Runs that
        cannot be simulated, or are too sensitive to the initial state, are left out.

        Args:
            runs: candidate runs, with their scenario and initial state.
        """
        diagnosed_model = self.information[0].model
        allowed_runs = [
            run
            for run, is_allowed in zip(runs, self.limits(diagnosed_model, runs), strict=True)
            if is_allowed
        ]
        if self.evaluator.kind.has_model:
            allowed_runs = self._select_distinct_runs(allowed_runs)
        run_values = []
        for run in allowed_runs:
            linearisations = [
                self._linearise_run(run, information, information.model.fit.theta)
                for information in self.information
            ]
            successful = [entry for entry in linearisations if entry is not None]
            # The run is left out if it cannot be linearised with one of the models.
            if len(successful) == len(linearisations):
                run_values.append(self._evaluate_linearised(run, successful))
        return sorted(run_values, key=get_sort_key)

    def _evaluate_linearised(
        self, run: CandidateRun, linearisations: Sequence[_LinearisedRun]
    ) -> RunValue:
        """Compute the value of a run to first order, from its linearisation with each model.

        With several models the value is the discrimination T, eq. (1) of the module docstring, for
        each pair of a true and a competing model; with one model it is the information gain D of
        its parameters, eq. (2).

        Args:
            run: run that could be recorded: its plan, scenario and initial state.
            linearisations: its linearisation with each model of the ranker.
        """
        if not self.pairs:
            value = _compute_information_gain(linearisations[0], self.information[0])
            return RunValue(run, np.array([value]), value)
        discrimination = np.zeros((len(linearisations), len(linearisations)))
        for true_index, competing_index in self.pairs:
            competing = linearisations[competing_index]
            difference = linearisations[true_index].prediction - competing.prediction
            discrimination[true_index, competing_index], _, _ = _compute_remaining_difference(
                difference, competing, self.information[competing_index]
            )
        return RunValue(run, discrimination, _sum_discrimination(discrimination))

    def evaluate_exactly(self, entry: RunValue) -> RunValue:
        """Compute the discrimination T of each pair of models exactly, by fits.

        A linearised value may be wrong, as the competing model may be far from linear. Each model
        of a pair is taken as true in turn. A run that violates a limit under any model has the
        value zero.

        Args:
            entry: Candidate run with its linearised value.
        """
        # The information gain of a single model needs no fit, so it is exact already.
        if not self.pairs:
            return entry._replace(is_exact=True)
        values = entry.values.copy()
        for true_index, competing_index in self.pairs:
            values[true_index, competing_index] = self._compute_discrimination(
                entry.run, self.information[true_index], self.information[competing_index]
            )
        # The run must be within the limits, whichever model is true. For the first model,
        # `rank_runs` has tested this already.
        for information in self.information[1:]:
            if not all(self.limits(information.model, [entry.run])):
                values[:] = 0.0
        return RunValue(entry.run, values, _sum_discrimination(values), is_exact=True)

    def _select_distinct_runs(self, runs: Sequence[CandidateRun]) -> list[CandidateRun]:
        """Select the runs of a robot with the largest difference of the models before any refit.

        At most `MAX_EVALUATED_RUNS` are selected, because the exact evaluation of a robot's run is
        slow. The size of a run is the sum over the pairs of models of log(1 + |d|^2), with the
        whitened difference d of their predictions; the logarithm prevents that one pair dominates.
        With a single model, d is its motion about the mean.

        Args:
            runs: candidate runs within the limits of the robot.
        """
        thetas = [information.model.fit.theta for information in self.information]
        sizes = []
        for run in runs:
            whitened = self._whiten(self._simulate_run(run, thetas, [run.states] * len(thetas)))
            differences = [second - first for first, second in combinations(whitened, 2)]
            if not differences:
                differences = [whitened[0] - whitened[0].mean()]
            size = float(sum(np.log1p(np.square(d).sum()) for d in differences))
            # A run that cannot be simulated is the last one.
            sizes.append(size if np.isfinite(size) else -np.inf)
        order = np.argsort(-np.array(sizes), kind="stable")
        return [runs[index] for index in order[:MAX_EVALUATED_RUNS].tolist()]

    # -- one run

    def _simulate_run(
        self, run: CandidateRun, thetas: Sequence[Array], states: Sequence[Array]
    ) -> Array:
        """Simulate the run (L, T, C) with each parameter vector and initial state.

        Shapes: T samples, C channels, P parameters, s states of a run.

        Args:
            run: the run.
            thetas: L parameter vectors (P,).
            states: L initial states (s,).
        """
        scenarios = [run.scenario] * len(thetas)
        return self.evaluator.simulate_scenarios(np.array(thetas), scenarios, np.array(states))

    def _whiten(self, values: Array) -> Array:
        """Whiten L predictions of a run (L, T, C), or differences of them, to vectors (L, T C).

        Whitening gives independent noise of variance one. `whiten` expects one run with L columns,
        (1, T, C, L), and the mask (1, T, C) of observed samples; all samples of a run that is only
        planned count as observed.

        Shapes: T samples, C channels.

        Args:
            values: (L, T, C) predictions or differences, in the units of the channels.
        """
        is_observed = np.ones((1, *values.shape[1:]), dtype=np.bool_)
        columns = np.moveaxis(values, 0, -1)[None]
        result: Array = np.moveaxis(whiten(columns, is_observed, self.noise)[0], -1, 0)
        return result.reshape(len(values), -1)

    def _linearise_run(
        self,
        run: CandidateRun,
        information: _ParameterInformation,
        theta: Array,
        states: Array | None = None,
    ) -> _LinearisedRun | None:
        """Linearise a run about parameters and an initial state, by finite differences.

        The value of a run follows from the linearisation, without fits.

        1. Simulate the run with each parameter and each free initial state displaced.
        2. Reject the run if it amplifies differences of the initial state so much that its result
           could not be interpreted.
        3. Whiten the differences by the noise.

        Shapes: P parameters, s states of a run.

        Args:
            run: run that could be recorded: its plan, scenario and initial state.
            information: model with its free parameters and the steps of their differences.
            theta: (P,) parameters.
            states: (s,) initial state; None for that of the run.

        Returns:
            The linearisation; None if the simulation fails, or if the run amplifies differences of
            the initial state so much that its result could not be interpreted.
        """
        # 1. Simulations: the point itself, displaced parameters, then displaced initial states. A
        # parameter is displaced by its unit `spread`, about its standard error.
        initial_state = run.states if states is None else states
        free_indices = information.model.fit.free_indices.tolist()
        thetas, initial_states = [theta], [initial_state]
        for index, step in zip(free_indices, information.spread, strict=True):
            displaced_theta = theta.copy()
            displaced_theta[index] += step
            thetas.append(displaced_theta)
            initial_states.append(initial_state)
        for shift in STATE_STEP_SHARE * np.eye(initial_state.size)[self.is_free_state]:
            thetas.append(theta)
            initial_states.append(initial_state + shift)
        simulated = self._simulate_run(run, thetas, initial_states)
        if not np.isfinite(simulated).all():
            return None
        prediction, differences = simulated[:1], simulated[1:] - simulated[0]
        # 2. Amplification: change of a channel by a displaced initial state, in units of its scale.
        parameter_count = len(free_indices)
        channel_scales = np.array([channel.scale for channel in self.evaluator.simulator.channels])
        amplification = np.abs(differences[parameter_count:]) / channel_scales
        if amplification.max(initial=0.0) > MAX_STATE_STEP_GROWTH * STATE_STEP_SHARE:
            return None
        # 3. Whitening. A parameter is displaced by its unit, so its difference is the derivative.
        whitened = self._whiten(np.concatenate([prediction, differences]))
        parameter_responses = whitened[1 : 1 + parameter_count]
        state_responses = whitened[1 + parameter_count :]
        return _LinearisedRun(
            whitened[0], parameter_responses.T, state_responses.T / STATE_STEP_SHARE
        )

    def _compute_discrimination(
        self,
        run: CandidateRun,
        true_model: _ParameterInformation,
        competing_model: _ParameterInformation,
    ) -> float:
        """Compute the discrimination T of a run by a fit of the competing model.

        It is T = min over delta, z of |d - J delta - B z|^2 + delta' C^-1 delta, eq. (1), with the
        difference d of two models, the derivatives J by parameters and B by the initial state, and
        the covariance C of the parameters. The prediction of `true_model` takes the place of the
        recording. The fit of `competing_model` by Levenberg-Marquardt may move its parameters as
        far as the present data allow. T is 0 if a model cannot be simulated on the run, so that
        such a run is not proposed.

        1. Simulate the prediction of the true model.
        2. Propose a step from the linearisation.
        3. Accept it if the cost decreases, otherwise increase the damping.

        Args:
            run: run that could be recorded.
            true_model: model that is taken as true, with its information from the present runs.
            competing_model: model that is fitted to its prediction.

        Returns:
            The discrimination in units of the noise variance: the lowest cost of the fit.
        """
        # 1. Prediction.
        fit = competing_model.model.fit
        simulated = self._simulate_run(run, [true_model.model.fit.theta], [run.states])
        target = self._whiten(simulated)[0]
        theta = fit.theta.copy()
        initial_state = run.states.copy()
        # Parameters minus their estimates from the present data, in units of `spread`.
        deviation = np.zeros(fit.free_indices.size)
        linearisation, damping = self._linearise_run(run, competing_model, theta), FIRST_DAMPING
        if linearisation is None or not np.isfinite(target).all():
            return 0.0
        lowest_cost = float(np.square(target - linearisation.prediction).sum())
        for _ in range(MAX_FIT_ITERATIONS):
            if damping > MAX_DAMPING:
                break
            # 2. Step.
            _, step, state_step = _compute_remaining_difference(
                target - linearisation.prediction,
                linearisation,
                competing_model,
                deviation,
                damping,
            )
            trial_theta, trial_states = theta.copy(), initial_state.copy()
            trial_theta[fit.free_indices] += step * competing_model.spread
            trial_states[self.is_free_state] += state_step
            trial_deviation = deviation + step
            trial_linearisation = self._linearise_run(
                run, competing_model, trial_theta, trial_states
            )
            cost = np.inf
            if trial_linearisation is not None:
                cost = float(np.square(target - trial_linearisation.prediction).sum())
                cost += float(trial_deviation @ competing_model.inverse @ trial_deviation)
            # 3. Acceptance.
            if trial_linearisation is None or not cost < lowest_cost:
                # The step was too long or failed, so the next one is much shorter (Marquardt).
                damping *= DAMPING_INCREASE
                continue
            is_converged = lowest_cost - cost < MIN_RELATIVE_DECREASE * lowest_cost
            theta, initial_state, deviation = trial_theta, trial_states, trial_deviation
            linearisation, lowest_cost = trial_linearisation, cost
            damping /= DAMPING_DECREASE
            if is_converged:
                break
        return lowest_cost


def _compute_parameter_information(models: ModelSet, model: FittedModel) -> _ParameterInformation:
    """Compute the information of the present runs on a model's parameters: C^-1, and their units.

    The unit of each parameter, `spread`, is its standard error, but at most a tenth of the width of
    its bounds: the unit is also the step of finite differences, which would be too large for a
    parameter that the data hardly determine.

    Args:
        models: Fitted models with noise and run evaluator.
        model: Model whose covariance is computed.
    """
    covariance = compute_covariance(models, model)
    bounds = [models.evaluator.parameters[index].bounds for index in model.fit.free_indices]
    max_spread = 0.1 * np.array([high - low for low, high in bounds])
    spread = np.minimum(np.sqrt(np.maximum(np.diagonal(covariance), 1e-300)), max_spread)
    inverse = np.asarray(np.linalg.pinv(covariance / np.outer(spread, spread), hermitian=True))
    return _ParameterInformation(model, np.asarray(spread), inverse)


def symmetrise_discrimination(values: Array) -> Array:
    """Return the smaller discrimination of each pair, as either model of it may be true."""
    return np.minimum(values, values.T)


def _sum_discrimination(values: Array) -> float:
    """Sum the discrimination over all pairs; each pair counts up to `MAX_USEFUL_DISCRIMINATION`."""
    discrimination = symmetrise_discrimination(values)
    pairs = discrimination[np.triu_indices(len(discrimination), 1)]
    return float(np.minimum(pairs, MAX_USEFUL_DISCRIMINATION).sum())


def _compute_remaining_difference(
    difference: Array,
    linearisation: _LinearisedRun,
    information: _ParameterInformation,
    deviation: Array | None = None,
    damping: float = FIRST_ORDER_DAMPING,
) -> tuple[float, Array, Array]:
    """Compute the discrimination T to first order, and the steps to the minimum of eq. (1).

    T is min over delta, z of |d - J delta - B z|^2 + delta' C^-1 delta, in units of the noise: the
    difference of the models that remains after the competing model has adapted to the run. It is a
    linear least-squares problem, solved by its normal equations.

    Shapes: q fitted parameters.

    Args:
        difference: (n,) difference d: prediction of the true model minus that of the other one.
        linearisation: Linearisation of the competing model.
        information: Information of the present runs on the competing model.
        deviation: (q,) difference of the parameters from their present estimates, in units of
            `spread`.
        damping: Levenberg-Marquardt damping of the step.

    Returns:
        T, the step delta (q,) of the parameters and the step z of the initial state.
    """
    parameter_count = len(information.spread)
    deviation = np.zeros(parameter_count) if deviation is None else deviation
    columns = np.concatenate(
        [linearisation.parameter_jacobian, linearisation.state_jacobian], axis=1
    )
    normal, right_hand_side = columns.T @ columns, columns.T @ difference
    # The present data hold the parameters near their estimates: C^-1 in eq. (1).
    # A fit that is already away from them (`deviation`) is drawn back.
    normal[:parameter_count, :parameter_count] += information.inverse
    right_hand_side[:parameter_count] -= information.inverse @ deviation
    damped = normal + damping * np.diag(np.diagonal(normal)) + RIDGE * np.eye(len(normal))
    step = np.linalg.solve(damped, right_hand_side)
    # The cost is a quadratic function of the step, so its value after the step is known exactly.
    initial_cost = float(difference @ difference + deviation @ information.inverse @ deviation)
    minimum_cost = initial_cost - 2.0 * float(right_hand_side @ step) + float(step @ normal @ step)
    return max(minimum_cost, 0.0), step[:parameter_count], step[parameter_count:]


def _compute_information_gain(
    linearisation: _LinearisedRun, information: _ParameterInformation
) -> float:
    """Compute the information gain D, eq. (2): the logarithm of the decrease of uncertainty.

    It is D = 1/2 log det(I + C J' (I - B B^+) J) (2), with the derivatives J by parameters and B by
    the initial state, and the covariance C of the parameters.

    Args:
        linearisation: the run, linearised by parameters and initial states.
        information: information of the present runs on the parameters.
    """
    basis, _ = np.linalg.qr(linearisation.state_jacobian)
    # (I - B B^+) J: the initial state of the run, which is unknown, could explain the other part.
    projected_jacobian = linearisation.parameter_jacobian - basis @ (
        basis.T @ linearisation.parameter_jacobian
    )
    covariance = np.linalg.pinv(information.inverse, hermitian=True)
    _, value = np.linalg.slogdet(
        np.eye(len(covariance)) + covariance @ (projected_jacobian.T @ projected_jacobian)
    )
    return float(0.5 * value)
