"""Cross-validation over runs: refit each model without one run, and predict that run.

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

from bench.diagnosis.evaluation.noise_model import Mask, NoiseModel
from bench.diagnosis.evaluation.run_evaluator import Indices, RunEvaluator
from bench.diagnosis.fitting.fit_state import FitStart, KnownJacobian, TrajectoryFit
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from bench.diagnosis.validation.held_out_runs import (
    HeldOutFit,
    HeldOutRuns,
    compute_penalised_likelihood,
)
from sims.core.simulator import Array

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
            fits: Models as fitted to all runs.

        Returns:
            Predictions of all runs by each model.
        """
        shape = self.evaluator.observed.shape
        simulated = np.full((len(fits), *shape), np.nan)
        states = np.stack([fit.initial_states for fit in fits])
        free_state_counts = np.zeros(len(fits))
        for number, fold in enumerate(self._run_folds):
            self.evaluator.search_control.begin_stage(
                f"cross-validation, fold {number + 1} of {len(self._run_folds)}"
            )
            thetas = self._refit_fold(fold, fits)
            predicted = HeldOutRuns(fold.left_out, self.noise).fit_initial_states(thetas)
            for i, prediction in enumerate(predicted):
                simulated[i, fold.rows, : prediction.simulated.shape[1]] = prediction.simulated
                states[i, fold.rows] = prediction.states
                free_state_counts[i] += prediction.freedom
        return [
            self._predict_all_runs(*result)
            for result in zip(simulated, states, free_state_counts.tolist(), strict=True)
        ]

    def _predict_all_runs(
        self, simulated: Array, states: Array, free_state_count: float
    ) -> HeldOutFit:
        """Return a model's prediction of all runs with its merit, the penalised log-likelihood.

        A failed simulation has the merit -infinity, so that any other model is preferred.

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
        """The folds; each has run evaluators for its own runs, with the parameters of the whole."""
        numbers = np.array([run.fold for run in self.evaluator.runs])
        folds = []
        for number in sorted(set(numbers.tolist())):
            rows = np.flatnonzero(numbers == number)
            fitted_rows = np.flatnonzero(numbers != number)
            folds.append(
                _Fold(
                    rows, fitted_rows, self._make_evaluator(fitted_rows), self._make_evaluator(rows)
                )
            )
        return folds

    def _make_evaluator(self, rows: Indices) -> RunEvaluator:
        """Make a run evaluator of the runs `rows`, which are the fitted or the left-out ones."""
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
        """
        thetas = [fit.theta.copy() for fit in fits]
        removals = [(i, name) for i, fit in enumerate(fits) for name in fit.effects]
        if not removals:
            return thetas
        runs = len(evaluator.prepared_runs)
        thetas_without = np.stack([fits[i].theta for i, _ in removals])
        for theta_without, (_, name) in zip(thetas_without, removals, strict=True):
            theta_without[evaluator.get_coefficient_indices(name)] = 0.0
        simulated_without = evaluator.simulate(
            np.repeat(thetas_without, runs, axis=0),
            np.tile(np.arange(runs), len(removals)),
            np.concatenate([fits[i].initial_states for i, _ in removals]),
        ).reshape(len(removals), *evaluator.observed.shape)
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
