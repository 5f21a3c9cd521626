"""Cross-validation: prediction of each run by models that are fitted to the other runs.

Leave-one-out cross-validation with a run as the unit (M. Stone, J. R. Stat. Soc. B 36(2), 111,
1974, doi:10.1111/j.2517-6161.1974.tb00994.x), because samples of one run depend on each other. It
replaces held-out runs where a recording has too few runs to spare one: the reported model is fitted
to all runs, and its error is measured on predictions of runs that were not used in the fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bench.diagnosis.evaluation.run_evaluator import Indices, RunEvaluator
from bench.diagnosis.fitting.levenberg_marquardt import FitStart, KnownJacobian, TrajectoryFit
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from bench.diagnosis.validation.held_out_runs import (
    HeldOutFit,
    HeldOutRuns,
    Validation,
    compute_penalised_likelihood,
)
from sims.core.simulator import Array

MAX_STEPS = 8
"""Maximum number of Levenberg-Marquardt steps of a refit, which starts from the fit to all runs."""
MIN_SUPPORTED_CHANGE = 1.0
"""Minimum change of a fold's runs, as the norm over all samples in noise standard deviations, for
an effect to be supported by these runs.
"""


class CrossValidation(Validation):
    """Validation that predicts each run with models that are refitted to the other runs.

    Args:
        evaluator: Run evaluator of all runs; each run has the number of its fold.
        noise: Noise that weights the channels.
    """

    is_cross_validation = True

    @property
    def simulations(self) -> int:
        """Number of simulations made for the folds alone."""
        # The folds are a cached property, which may not be computed yet.
        if "_run_folds" not in self.__dict__:
            return 0
        return sum(
            fold.fitted_runs.simulation_count + fold.left_out_runs.simulation_count
            for fold in self._run_folds
        )

    def close(self) -> None:
        """Close the simulators of the folds; the run evaluator of all runs stays open."""
        # The folds are a cached property, which may not be computed yet.
        if "_run_folds" in self.__dict__:
            for fold in self._run_folds:
                fold.fitted_runs.close()
                fold.left_out_runs.close()

    def validate(self, fits: Sequence[TrajectoryFit]) -> list[HeldOutFit]:
        """Predict each run with every model, refitted to the other runs.

        The runs of one fold are left out together. Only the initial states of a predicted run are
        estimated from it. An effect that the other runs do not support is switched off for the
        prediction.

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
            predictions = HeldOutRuns(fold.left_out_runs, self.noise).fit_initial_states(thetas)
            for model_index, prediction in enumerate(predictions):
                # The runs of a fold may be shorter than the longest of all runs.
                length = prediction.simulated.shape[1]
                simulated[model_index, fold.left_out_indices, :length] = prediction.simulated
                initial_states[model_index, fold.left_out_indices] = prediction.states
                free_state_counts[model_index] += prediction.freedom
        results = zip(simulated, initial_states, free_state_counts.tolist(), strict=True)
        return [
            self._predict_all_runs(model_simulated, model_states, free_state_count)
            for model_simulated, model_states, free_state_count in results
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
            left_out_indices = np.flatnonzero(fold_numbers == fold_number)
            fitted_indices = np.flatnonzero(fold_numbers != fold_number)
            fitted_runs = self._make_evaluator(fitted_indices)
            left_out_runs = self._make_evaluator(left_out_indices)
            folds.append(_Fold(left_out_indices, fitted_indices, left_out_runs, fitted_runs))
        return folds

    def _make_evaluator(self, run_indices: Indices) -> RunEvaluator:
        """Make a run evaluator of some runs, which are the fitted or the left-out ones of a fold.

        It takes over what was computed for all runs: the correction of the discretisation error,
        and the derivatives by initial states.

        Args:
            run_indices: Indices of the runs.
        """
        evaluator = self.evaluator.with_runs([self.evaluator.runs[index] for index in run_indices])
        # Arrays are only as long as the longest of these runs.
        length = evaluator.observed.shape[1]
        correction = self.evaluator.discretisation_correction
        if correction is not None:
            evaluator.discretisation_correction = correction[run_indices, :length]
        derivatives = self.evaluator.state_derivatives
        if derivatives is not None:
            evaluator.state_derivatives = derivatives[run_indices, :length]
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
        # All models of a search keep the same base parameters fixed at their nominal values, so the
        # first fit shows which ones are fixed.
        base_parameters = set(self.evaluator.base_indices.tolist())
        fixed_parameters = frozenset(base_parameters - set(fits[0].free_indices.tolist()))
        length = fold.fitted_runs.observed.shape[1]
        starts = []
        for fit in fits:
            jacobian = fit.parameter_jacobian[fold.fitted_indices, :length]
            known_jacobian = KnownJacobian(fit.free_indices, jacobian)
            initial_states = fit.initial_states[fold.fitted_indices]
            starts.append(FitStart(fit.effects, fit.theta, initial_states, known_jacobian))
        refits = TrajectoryFitter(fold.fitted_runs, self.noise, fixed_parameters).fit_models(
            starts, MAX_STEPS
        )
        return self._remove_unsupported(fold.fitted_runs, refits)

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
        # Every effect of every model is switched off once: index of the model, and indices of the
        # effect's coefficients in theta.
        removals = [
            (model_index, evaluator.get_coefficient_indices(name))
            for model_index, fit in enumerate(fits)
            for name in fit.effects
        ]
        if not removals:
            return thetas
        thetas_without = []
        for model_index, coefficient_indices in removals:
            theta_without = fits[model_index].theta.copy()
            theta_without[coefficient_indices] = 0.0
            thetas_without.append(theta_without)
        initial_states = [fits[model_index].initial_states for model_index, _ in removals]
        simulated_without = evaluator.simulate_all_runs(
            np.stack(thetas_without), np.stack(initial_states)
        )
        observed_mask = np.isfinite(evaluator.observed)
        for (model_index, coefficient_indices), simulated in zip(
            removals, simulated_without, strict=True
        ):
            change = ((fits[model_index].simulated - simulated) / self.noise.sigma)[observed_mask]
            # If the simulation fails without the effect, the change is NaN and the effect is kept.
            if np.linalg.norm(change) < MIN_SUPPORTED_CHANGE:
                thetas[model_index][coefficient_indices] = 0.0
        return thetas


@dataclass(frozen=True)
class _Fold:
    """Fold: the runs that are left out of the fits and predicted, and the runs that are fitted.

    Attributes:
        left_out_indices: Indices of the runs that are left out.
        fitted_indices: Indices of the runs that are fitted.
        left_out_runs: Run evaluator of the runs that are left out.
        fitted_runs: Run evaluator of the fitted runs.
    """

    left_out_indices: Indices
    fitted_indices: Indices
    left_out_runs: RunEvaluator
    fitted_runs: RunEvaluator
