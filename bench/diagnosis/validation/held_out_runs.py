"""Prediction of held-out runs by fitted models, and cross-validation over few runs.

For n samples with f effective initial states, the penalised log-likelihood of a model with
log-likelihood L is that of G. Schwarz (Ann. Stat. 6(2), 461, 1978, doi:10.1214/aos/1176344136):

    M = 2 log L - f log n                                                                      (1)

Leave-one-out cross-validation with a run as the unit (M. Stone, J. R. Stat. Soc. B 36(2), 111,
1974, doi:10.1111/j.2517-6161.1974.tb00994.x), because samples of one run depend on each other. It
replaces held-out runs where a recording has too few runs to spare one: the reported model is fitted
to all runs, and its error is measured on predictions of runs that were not used in the fit.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from bench.diagnosis.evaluation.noise_model import Mask, NoiseModel, maximise_likelihood
from bench.diagnosis.evaluation.run_evaluator import Indices, RunEvaluator
from bench.diagnosis.fitting.fitted_models import count_identified_states
from bench.diagnosis.fitting.levenberg_marquardt_state import FitStart, KnownJacobian, TrajectoryFit
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from sims.core.plain_values import format_count
from sims.core.root_mean_square import compute_rms
from sims.core.simulator import Array

HORIZON_STAGES = ((0.2, 6), (0.45, 6), (0.7, 6), (1.0, 10))
"""Stages of the fit of initial states: fraction of each run, and maximum number of steps."""
FILTERED_HORIZON_STAGES = ((1.0, 6),)
"""Stages of the fit of initial states, as in `HORIZON_STAGES`, for a robot with filtered runs.

These runs begin near their best states.
"""
MIN_STAGED_FIT_COST = 1.5
"""Minimum mean square residual of the nearest model, in noise variances, for which models that
start from filtered states are also fitted in stages.
"""
LINEARISATION_ERROR_TOLERANCE = 0.3
"""Maximum RMS linearisation error of a motion in units of the noise. Above it, the derivatives by
the initial states are computed again.
"""
MIN_SQUARES_DECREASE = 3.0
"""Minimum decrease of the sum of squares, in noise variances, by fresh derivatives, for which the
fits are repeated with derivatives that are computed again before each stage.
"""
REFIT_SQUARES_RATIO = 2.0
"""Ratio of a model's sum of squares to that of the nearest model from which it is refitted on the
held-out runs.
"""


@dataclass(frozen=True)
class HeldOutFit:
    """Prediction of runs with parameters that were fitted to other runs.

    Attributes:
        simulated: (R, T, C) prediction; NaN if the simulation failed.
        penalised_log_likelihood: Penalised log-likelihood, eq. (1) of the module docstring; minus
            infinity if the simulation failed.
        states: (R, s) initial states, fitted to these runs.
        freedom: Effective number of initial states, f in eq. (1).
    """

    simulated: Array
    penalised_log_likelihood: float
    states: Array
    freedom: float = 0.0


class Validation(Protocol):
    """Protocol for the prediction of runs with models that were fitted to other runs.

    The runs are held-out runs, or all runs in turn (`bench.diagnosis.validation.held_out_runs`).

    Attributes:
        evaluator: Run evaluator of the predicted runs.
        noise: Noise that weights the channels.
        seen: (R, T, C) mask of the available samples.
        is_cross_validation: Whether the reported model is fitted to these runs too.
    """

    evaluator: RunEvaluator
    noise: NoiseModel
    seen: Mask
    is_cross_validation: bool

    @property
    def simulations(self) -> int:
        """Number of simulations made for the validation alone."""
        ...

    def validate(self, fits: Sequence[TrajectoryFit]) -> list[HeldOutFit]:
        """Predict the runs with each model, given by its fit to the runs for fitting."""
        ...

    def close(self) -> None:
        """Release the resources of the simulators."""
        ...


class HeldOutRuns:
    """Validation on held-out runs, of which only the initial states are fitted.

    Args:
        evaluator: Run evaluator of the runs, with the effects at the same indices as in the fit.
        noise: Noise that weights the channels.
    """

    is_cross_validation = False

    def __init__(self, evaluator: RunEvaluator, noise: NoiseModel) -> None:
        self.evaluator = evaluator
        self.noise = noise
        self.seen: Mask = np.isfinite(evaluator.observed)

    @property
    def simulations(self) -> int:
        """Number of simulations of the held-out runs."""
        return self.evaluator.simulation_count

    def close(self) -> None:
        """Release the resources of the simulator."""
        self.evaluator.close()

    def validate(self, fits: Sequence[TrajectoryFit]) -> list[HeldOutFit]:
        """Predict the held-out runs with each model; see `fit_initial_states`."""
        return self.fit_initial_states([fit.theta for fit in fits])

    def fit_initial_states(
        self, thetas: Sequence[Array], is_staged: bool = False
    ) -> list[HeldOutFit]:
        """Simulate the runs with each parameter vector (P,) and fit their initial states.

        1. Fit the initial states of all models, over ever longer parts of the runs. For filtered
           runs, whose initial states are known well, one stage is tried first. A robot on the
           ground, whose contacts a fit of states would lift or press in, starts from settled ones.
        2. If the motion has left the range of its linearisation, continue with derivatives at the
           best fit.
        3. Least squares may converge to a different minimum for similar models, and chance would
           then decide between them. Models far from the nearest one (the one with the lowest cost)
           are therefore fitted again from its initial states, and the better fit counts.

        Shapes: P parameters.

        Args:
            thetas: parameters of each model.
            is_staged: whether to fit ever longer parts of the runs even if a fit to whole runs
                comes near the noise.

        Returns:
            The prediction of the runs by each model.
        """
        guess = self.evaluator.initial_state_guesses
        initial_starts = [FitStart((), theta, guess) for theta in thetas]
        is_filtered = self.evaluator.filtered_runs is not None and not is_staged
        fits = self._fit_initial_states(
            initial_starts, FILTERED_HORIZON_STAGES if is_filtered else HORIZON_STAGES
        )
        count = max(int(self.seen.sum()), 1)
        has_poor_fit = (
            is_filtered and not _find_lowest_cost_fit(fits).cost < MIN_STAGED_FIT_COST * count
        )
        followed = self.evaluator.filtered_runs
        if has_poor_fit and followed is not None and followed.is_on_ground:
            settled_states = [followed.estimate_settled_states(theta) for theta in thetas]
            starts = [FitStart((), *pair) for pair in zip(thetas, settled_states, strict=True)]
            fits = _select_nearer_fits(
                fits, self._fit_initial_states(starts, FILTERED_HORIZON_STAGES)
            )
        elif has_poor_fit:
            # Runs that amplify differences of the initial state need a fit in stages.
            fits = _select_nearer_fits(
                fits, self._fit_initial_states(initial_starts, HORIZON_STAGES)
            )
            is_filtered = False
        if not is_filtered and self._leaves_linear_range(_find_lowest_cost_fit(fits)):
            fits = self._continue_from_nearest(initial_starts, fits)
        nearest_fit = _find_lowest_cost_fit(fits)
        # The comparison is negated because the cost of a failed fit may be NaN.
        limit = REFIT_SQUARES_RATIO * nearest_fit.cost
        far_indices = [i for i, fit in enumerate(fits) if not fit.cost < limit]
        starts = [
            replace(fits[i].make_start(), initial_states=nearest_fit.initial_states)
            for i in far_indices
        ]
        # These initial states are good over the first fraction of the runs already.
        refits = self._fit_initial_states(
            starts, FILTERED_HORIZON_STAGES if is_filtered else HORIZON_STAGES[1:]
        )
        for i, fit in zip(far_indices, refits, strict=True):
            fits[i] = _find_lowest_cost_fit([fits[i], fit])
        return [self._predict_runs(fit) for fit in fits]

    def _fit_initial_states(
        self, starts: Sequence[FitStart], stages: Sequence[tuple[float, int]]
    ) -> list[TrajectoryFit]:
        """Fit only the initial states of the runs, first to their beginning, then to longer parts.

        A whole run has many local minima if its motion amplifies errors of the initial state; its
        beginning has not.

        Args:
            starts: model, parameters and first initial states of each fit.
            stages: share of the runs and maximum number of iterations, one stage after another.
        """
        fits: list[TrajectoryFit] = []
        if not starts:
            return fits
        control = self.evaluator.search_control
        models = format_count(len(starts), "model")
        control.begin_stage(f"simulating held-out runs with {models}", len(stages))
        for share, iterations in stages:
            fitter = TrajectoryFitter(
                self.evaluator, self.noise, share=share, fits_parameters=False
            )
            fits = fitter.fit_models(starts, iterations)
            starts = [fit.make_start() for fit in fits]
            control.advance()
        return fits

    def _leaves_linear_range(self, fit: TrajectoryFit) -> bool:
        """Return whether the motion has left the range of its linearisation by the initial states.

        For a robot this linearisation is computed once for all models, which is faster than
        differences. It is tested by a prediction: a simulation from the first guess should differ
        from that of the fit as the linearisation says. A chaotic motion leaves its range even if
        the guess is off by no more than the noise.
        """
        evaluator = self.evaluator
        if not evaluator.has_linearisation or not np.isfinite(fit.cost):
            return False
        runs = len(evaluator.initial_state_guesses)
        repeated_theta = np.tile(fit.theta, (runs, 1))
        simulated_from_guess = evaluator.simulate(
            repeated_theta, np.arange(runs), evaluator.initial_state_guesses
        )
        state_changes = fit.initial_states - evaluator.initial_state_guesses
        # A diverging simulation from the guess is infinite or NaN.
        with np.errstate(over="ignore", invalid="ignore"):
            linearisation_error = (
                fit.simulated
                - simulated_from_guess
                - np.einsum("rtcs,rs->rtc", fit.jacobian, state_changes)
            )
            sizes = (linearisation_error / self.noise.sigma)[self.seen]
            rms = compute_rms(sizes)
        # The comparison is negated because NaN compares as false.
        return not rms < LINEARISATION_ERROR_TOLERANCE

    def _continue_from_nearest(
        self, starts: Sequence[FitStart], fits: Sequence[TrajectoryFit]
    ) -> list[TrajectoryFit]:
        """Continue the fits with derivatives at the nearest of them.

        If that reduces the nearest sum of squares enough, the fits are repeated from the starts
        with derivatives that are computed again before each stage.
        """
        continued_fits = _select_nearer_fits(
            fits, self._continue_about_best(fits, HORIZON_STAGES[-1:])
        )
        if (
            _find_lowest_cost_fit(fits).cost - _find_lowest_cost_fit(continued_fits).cost
            < MIN_SQUARES_DECREASE
        ):
            return continued_fits
        staged_fits = self._fit_initial_states(starts, HORIZON_STAGES[:1])
        for stage in (*HORIZON_STAGES[1:], HORIZON_STAGES[-1]):
            staged_fits = self._continue_about_best(staged_fits, [stage])
        return _select_nearer_fits(continued_fits, staged_fits)

    def _continue_about_best(
        self, fits: Sequence[TrajectoryFit], stages: Sequence[tuple[float, int]]
    ) -> list[TrajectoryFit]:
        """Continue the fits with derivatives by initial states about the best of them.

        Args:
            fits: fit of each model.
            stages: share of the runs and maximum number of iterations, one after another.
        """
        # This import is needed for robots only.
        from bench.diagnosis.fitting.linearised_runs import compute_state_jacobian

        nearest_fit = _find_lowest_cost_fit(fits)
        compute_state_jacobian(
            self.evaluator, nearest_fit.theta, nearest_fit.initial_states, is_recomputed=True
        )
        return self._fit_initial_states([fit.make_start() for fit in fits], stages)

    def _predict_runs(self, fit: TrajectoryFit) -> HeldOutFit:
        """Return the prediction of a fit with its merit, the penalised log-likelihood.

        A failed fit has NaN as prediction and the merit -infinity, so that any other model is
        preferred.
        """
        if not np.isfinite(fit.cost):
            no_prediction = np.full_like(self.evaluator.observed, np.nan)
            return HeldOutFit(no_prediction, -np.inf, fit.initial_states)
        # Only initial states were fitted here, so only they count as free.
        free_state_count = count_identified_states(self.evaluator, fit, self.noise)
        penalised_likelihood = compute_penalised_likelihood(
            self.evaluator.observed, fit.simulated, free_state_count
        )
        return HeldOutFit(fit.simulated, penalised_likelihood, fit.initial_states, free_state_count)


def find_first_states(
    evaluator: RunEvaluator, noise: NoiseModel, fit: TrajectoryFit
) -> FitStart | None:
    """Return a start with better first states of fitted runs; None without better ones.

    They are fitted to ever longer parts of the runs, as those of held-out runs, with the parameters
    of the fit, and must reduce the sum of squares. A robot on the ground keeps its first states,
    those with settled contacts.

    Args:
        evaluator: the fitted runs.
        noise: noise that weights the channels.
        fit: fit of these runs.
    """
    followed = evaluator.filtered_runs
    if followed is not None and followed.is_on_ground:
        return None
    derivatives_before = evaluator.state_derivatives
    runs = HeldOutRuns(evaluator, noise)
    (prediction,) = runs.fit_initial_states([fit.theta], is_staged=True)
    squares = np.square((evaluator.observed - prediction.simulated) / noise.sigma)
    evaluator.state_derivatives = derivatives_before
    if not squares[runs.seen].sum() < fit.cost - MIN_SQUARES_DECREASE:
        return None
    return replace(fit.make_start(), initial_states=prediction.states)


def compute_penalised_likelihood(observed: Array, simulated: Array, free: float) -> float:
    """Compute the penalised log-likelihood of predictions, eq. (1) of the module docstring.

    It is M = 2 log L - f log n (1), with the likelihood L of n samples and f effective initial
    states.

    Shapes: R runs, T samples, C channels.

    Args:
        observed: (R, T, C) observations; NaN where missing.
        simulated: (R, T, C) predictions.
        free: Effective number of free initial states.
    """
    observed_mask = np.isfinite(observed)
    residual = np.where(observed_mask, observed - simulated, 0.0)
    state_penalty = float(np.log(max(int(observed_mask.sum()), 2)))
    return maximise_likelihood(residual, observed_mask, free).value - free * state_penalty  # (1)


def _find_lowest_cost_fit(fits: Iterable[TrajectoryFit]) -> TrajectoryFit:
    """Return the fit with the smallest cost."""
    return min(fits, key=lambda fit: fit.cost)


def _select_nearer_fits(
    fits: Sequence[TrajectoryFit], other_fits: Sequence[TrajectoryFit]
) -> list[TrajectoryFit]:
    """Return the better of two fits of each model.

    Args:
        fits: fit of each model.
        other_fits: another fit of each model, in the same order.
    """
    return [_find_lowest_cost_fit(pair) for pair in zip(fits, other_fits, strict=True)]


MAX_STEPS = 8
"""Maximum number of Levenberg-Marquardt steps of a refit, which starts from the fit to all runs."""
MIN_SUPPORTED_CHANGE = 1.0
"""Minimum change of a fold's runs, as the norm over all samples in noise standard deviations, for
an effect to be supported by these runs.
"""


class CrossValidation:
    """Validation that predicts each run with models that are refitted to the other runs.

    Args:
        evaluator: Run evaluator of all runs; each run has the number of its fold.
        noise: Noise that weights the channels.

    Attributes:
        evaluator: Run evaluator of all runs.
        noise: Noise that weights the channels.
        seen: (R, T, C) mask of the available samples.
    """

    is_cross_validation = True

    def __init__(self, evaluator: RunEvaluator, noise: NoiseModel) -> None:
        self.evaluator = evaluator
        self.noise = noise
        self.seen: Mask = np.isfinite(evaluator.observed)

    @property
    def simulations(self) -> int:
        """Number of simulations made for the folds alone."""
        if "_run_folds" not in self.__dict__:
            return 0
        return sum(
            fold.fitting.simulation_count + fold.left_out.simulation_count
            for fold in self._run_folds
        )

    def close(self) -> None:
        """Close the simulators of the folds; the run evaluator of all runs stays open."""
        if "_run_folds" in self.__dict__:
            for fold in self._run_folds:
                fold.fitting.close()
                fold.left_out.close()

    def validate(self, fits: Sequence[TrajectoryFit]) -> list[HeldOutFit]:
        """Predict each run with every model, refitted to the other runs.

        Only the initial states of the predicted run are estimated from it. An effect that the other
        runs do not support is switched off for the prediction.

        Args:
            fits: models as fitted to all runs, from which the refits start.

        Returns:
            Predictions of all runs by each model.
        """
        shape = self.evaluator.observed.shape
        simulated = np.full((len(fits), *shape), np.nan)
        initial_states = np.stack([fit.initial_states for fit in fits])
        free_state_counts = np.zeros(len(fits))
        for number, fold in enumerate(self._run_folds):
            self.evaluator.search_control.begin_stage(
                f"cross-validation, fold {number + 1} of {len(self._run_folds)}"
            )
            thetas = self._refit_fold(fold, fits)
            predictions = HeldOutRuns(fold.left_out, self.noise).fit_initial_states(thetas)
            for model_index, prediction in enumerate(predictions):
                simulated[model_index, fold.rows, : prediction.simulated.shape[1]] = (
                    prediction.simulated
                )
                initial_states[model_index, fold.rows] = prediction.states
                free_state_counts[model_index] += prediction.freedom
        return [
            self._predict_all_runs(*result)
            for result in zip(simulated, initial_states, free_state_counts.tolist(), strict=True)
        ]

    def _predict_all_runs(
        self, simulated: Array, states: Array, free_state_count: float
    ) -> HeldOutFit:
        """Return a model's prediction of all runs with its merit, the penalised log-likelihood.

        A failed simulation has the merit -infinity, so that any other model is preferred.

        Shapes: R runs, T samples, C channels.

        Args:
            simulated: (R, T, C) prediction of each run by the model refitted without it.
            states: (R, s) initial states.
            free_state_count: Effective number of fitted initial states, for the penalty.
        """
        if not np.isfinite(simulated[self.seen]).all():
            return HeldOutFit(np.full_like(simulated, np.nan), -np.inf, states)
        penalised_likelihood = compute_penalised_likelihood(
            self.evaluator.observed, simulated, free_state_count
        )
        return HeldOutFit(simulated, penalised_likelihood, states, free_state_count)

    @cached_property
    def _run_folds(self) -> list[_Fold]:
        """The folds; each has run evaluators for its own runs, with the parameters of the whole.

        Runs of one fold are left out together and predicted by a fit to all other runs.
        """
        fold_numbers = np.array([run.fold for run in self.evaluator.runs])
        folds = []
        for fold_number in sorted(set(fold_numbers.tolist())):
            run_indices = np.flatnonzero(fold_numbers == fold_number)
            fitted_run_indices = np.flatnonzero(fold_numbers != fold_number)
            folds.append(
                _Fold(
                    run_indices,
                    fitted_run_indices,
                    self._make_evaluator(fitted_run_indices),
                    self._make_evaluator(run_indices),
                )
            )
        return folds

    def _make_evaluator(self, rows: Indices) -> RunEvaluator:
        """Make a run evaluator of some runs, which are the fitted or the left-out ones of a fold.

        It takes over what was computed for all runs: the correction of the discretisation error,
        and the derivatives by initial states.

        Args:
            rows: Indices of the runs.
        """
        evaluator = self.evaluator.with_runs([self.evaluator.runs[row] for row in rows])
        length = evaluator.observed.shape[1]
        if self.evaluator.discretisation_correction is not None:
            evaluator.discretisation_correction = self.evaluator.discretisation_correction[
                rows, :length
            ]
        if self.evaluator.state_derivatives is not None:
            evaluator.state_derivatives = self.evaluator.state_derivatives[rows, :length]
        # Workers that are started for one fold also know the other folds.
        evaluator.worker_pool.register(evaluator)
        return evaluator

    def _refit_fold(self, fold: _Fold, fits: Sequence[TrajectoryFit]) -> list[Array]:
        """Refit each model to the runs of a fold that are not left out.

        The refit starts from the fit to all runs, with its derivatives, so it needs few steps.

        Shapes: P parameters.

        Args:
            fold: Fold whose left-out runs will be predicted.
            fits: Models fitted to all runs, from which the refits start.

        Returns:
            Parameters (P,) of each model; an effect that these runs do not show is switched off.
        """
        base = set(self.evaluator.base_indices.tolist())
        # All models of a search keep the same parameters fixed at their nominal values.
        fixed_parameters = frozenset(base - set(fits[0].free_indices.tolist()))
        length = fold.fitting.observed.shape[1]
        starts = []
        for fit in fits:
            jacobian = fit.parameter_jacobian[fold.fitted_rows, :length]
            known_jacobian = KnownJacobian(fit.free_indices, jacobian)
            starts.append(
                FitStart(
                    fit.effects, fit.theta, fit.initial_states[fold.fitted_rows], known_jacobian
                )
            )
        refits = TrajectoryFitter(fold.fitting, self.noise, fixed_parameters).fit_models(
            starts, MAX_STEPS
        )
        return self._remove_unsupported(fold.fitting, refits)

    def _remove_unsupported(
        self, evaluator: RunEvaluator, fits: Sequence[TrajectoryFit]
    ) -> list[Array]:
        """Return parameters (P,) of each model; effects that the runs do not show are off.

        An effect is not shown if switching it off changes the simulated samples by less than
        `MIN_SUPPORTED_CHANGE`, in units of the noise. Its coefficients are then arbitrary and would
        spoil the prediction.

        Shapes: P parameters.

        Args:
            evaluator: run evaluator of the runs to which models are fitted.
            fits: fits of all models to these runs.
        """
        thetas = [fit.theta.copy() for fit in fits]
        removals = [(i, name) for i, fit in enumerate(fits) for name in fit.effects]
        if not removals:
            return thetas
        thetas_without = np.stack([fits[i].theta for i, _ in removals])
        for theta_without, (_, name) in zip(thetas_without, removals, strict=True):
            theta_without[evaluator.get_coefficient_indices(name)] = 0.0
        simulated_without = evaluator.simulate_all_runs(
            thetas_without, np.stack([fits[i].initial_states for i, _ in removals])
        )
        observed_mask = np.isfinite(evaluator.observed)
        for (i, name), simulated in zip(removals, simulated_without, strict=True):
            change = ((fits[i].simulated - simulated) / self.noise.sigma)[observed_mask]
            # If the simulation fails without the effect, the change is NaN and the effect is kept.
            if np.linalg.norm(change) < MIN_SUPPORTED_CHANGE:
                thetas[i][evaluator.get_coefficient_indices(name)] = 0.0
        return thetas


@dataclass(frozen=True)
class _Fold:
    """Fold: the runs that are left out of the fits and predicted, and the runs that are fitted.

    Attributes:
        rows: Indices of the runs that are left out.
        fitted_rows: Indices of the runs that are fitted.
        fitting: Run evaluator of the fitted runs.
        left_out: Run evaluator of the runs that are left out.
    """

    rows: Indices
    fitted_rows: Indices
    fitting: RunEvaluator
    left_out: RunEvaluator
