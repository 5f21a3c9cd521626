"""Prediction of held-out runs by fitted models, of which only the initial states are fitted.

For n samples with f effective initial states, the penalised log-likelihood of a model with
log-likelihood L is that of G. Schwarz (Ann. Stat. 6(2), 461, 1978, doi:10.1214/aos/1176344136):

    M = 2 log L - f log n                                                                      (1)
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.diagnosis.evaluation.noise_model import Mask, NoiseModel, maximise_likelihood
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.fitted_models import count_identified_states
from bench.diagnosis.fitting.levenberg_marquardt import FitStart, TrajectoryFit
from bench.diagnosis.fitting.trajectory_derivatives import compute_state_jacobian
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from sims.core.root_mean_square import compute_rms
from sims.core.simulator import Array
from sims.core.user_messages import format_count

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

Better initial states of the fitted runs must gain as much (`search.fit_starts.find_first_states`).
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


class Validation(ABC):
    """Prediction of runs with models that were fitted to other runs.

    The runs are held-out runs (`HeldOutRuns`), or all runs in turn (`CrossValidation`).

    Args:
        evaluator: Run evaluator of the predicted runs.
        noise: Noise that weights the channels.

    Attributes:
        evaluator: Run evaluator of the predicted runs.
        noise: Noise that weights the channels.
        seen: (R, T, C) mask of the available samples.
        is_cross_validation: Whether the reported model is fitted to these runs too.
    """

    is_cross_validation: bool

    def __init__(self, evaluator: RunEvaluator, noise: NoiseModel) -> None:
        self.evaluator = evaluator
        self.noise = noise
        self.seen: Mask = np.isfinite(evaluator.observed)

    @property
    @abstractmethod
    def simulations(self) -> int:
        """Number of simulations made for the validation alone."""

    @abstractmethod
    def validate(self, fits: Sequence[TrajectoryFit]) -> list[HeldOutFit]:
        """Predict the runs with each model, given by its fit to the runs for fitting."""

    @abstractmethod
    def close(self) -> None:
        """Release the resources of the simulators."""


class HeldOutRuns(Validation):
    """Validation on held-out runs, of which only the initial states are fitted.

    Args:
        evaluator: Run evaluator of the runs, with the effects at the same indices as in the fit.
        noise: Noise that weights the channels.
    """

    is_cross_validation = False

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

        The nearest fit is the one with the lowest cost.

        1. Fit the initial states of all models, over ever longer parts of the runs. For filtered
           runs (of a robot, whose initial states a Kalman filter has estimated well), one stage
           with whole runs is tried first.
        2. If even the nearest of these is far from the noise, fit them in another way.
        3. If the motion has left the range of its linearisation, continue with derivatives at the
           nearest fit.
        4. Least squares may converge to a different minimum for similar models, and chance would
           then decide between them. Models far from the nearest one are therefore fitted again from
           its initial states, and the better fit counts.

        Shapes: P parameters.

        Args:
            thetas: parameters of each model.
            is_staged: whether to fit ever longer parts of filtered runs, too, even if a fit to
                whole runs comes near the noise.

        Returns:
            The prediction of the runs by each model.
        """
        # 1. All models.
        guess = self.evaluator.initial_state_guesses
        # No effect is named, because no coefficient is fitted; effects act by those in theta.
        starts = [FitStart((), theta, guess) for theta in thetas]
        is_filtered = self.evaluator.filtered_runs is not None and not is_staged
        fits = self._fit_initial_states(
            starts, FILTERED_HORIZON_STAGES if is_filtered else HORIZON_STAGES
        )
        # 2. Poor fits.
        if is_filtered and self._are_poor(fits):
            fits, is_filtered = self._improve_poor_fits(starts, fits)
        # 3. Derivatives. A fit in stages may end far from the motion about which they were
        # computed.
        if not is_filtered and self._leaves_linear_range(_find_lowest_cost_fit(fits)):
            fits = self._continue_from_nearest(starts, fits)
        # 4. Far models. These initial states are good over the first fraction of the runs already.
        fits = self._refit_far_models(
            fits, FILTERED_HORIZON_STAGES if is_filtered else HORIZON_STAGES[1:]
        )
        return [self._predict_runs(fit) for fit in fits]

    def _are_poor(self, fits: Sequence[TrajectoryFit]) -> bool:
        """Return whether even the nearest fit is far from the noise, or has failed."""
        count = max(int(self.seen.sum()), 1)
        # The comparison is negated because the cost of a failed fit may be NaN.
        return not _find_lowest_cost_fit(fits).cost < MIN_STAGED_FIT_COST * count

    def _improve_poor_fits(
        self, starts: Sequence[FitStart], fits: Sequence[TrajectoryFit]
    ) -> tuple[list[TrajectoryFit], bool]:
        """Fit filtered runs (of a robot) in another way, and keep the better fit of each model.

        - A robot on the ground, whose contacts a fit of states would lift or press in, starts from
          states with settled contacts.
        - Other motions may amplify differences of the initial state, so they are fitted in stages.

        Args:
            starts: model, parameters and first initial states of each fit.
            fits: poor fit of each model.

        Returns:
            The better fits, and whether the next fits may also use the single stage of filtered
            runs.
        """
        filtered_runs = self.evaluator.filtered_runs
        if filtered_runs is not None and filtered_runs.is_on_ground:
            settled_starts = [
                replace(start, initial_states=filtered_runs.estimate_settled_states(start.theta))
                for start in starts
            ]
            other_fits = self._fit_initial_states(settled_starts, FILTERED_HORIZON_STAGES)
            return _select_nearer_fits(fits, other_fits), True
        other_fits = self._fit_initial_states(starts, HORIZON_STAGES)
        return _select_nearer_fits(fits, other_fits), False

    def _refit_far_models(
        self, fits: Sequence[TrajectoryFit], stages: Sequence[tuple[float, int]]
    ) -> list[TrajectoryFit]:
        """Refit models far from the nearest one from its initial states; keep the better fits.

        Args:
            fits: fit of each model.
            stages: share of the runs and maximum number of iterations, one stage after another.
        """
        nearest_fit = _find_lowest_cost_fit(fits)
        limit = REFIT_SQUARES_RATIO * nearest_fit.cost
        # The comparison is negated because the cost of a failed fit may be NaN.
        far_indices = [i for i, fit in enumerate(fits) if not fit.cost < limit]
        starts = [
            replace(fits[i].make_start(), initial_states=nearest_fit.initial_states)
            for i in far_indices
        ]
        better_fits = list(fits)
        for i, fit in zip(far_indices, self._fit_initial_states(starts, stages), strict=True):
            better_fits[i] = _find_lowest_cost_fit([fits[i], fit])
        return better_fits

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
        the guess is off by no more than the noise. The result is False for a system, whose
        derivatives are differences, and for a failed fit.

        Args:
            fit: fit of the initial states, whose Jacobian (R, T, C, s) has the derivatives of R
                runs with T samples of C channels by s initial states.
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
        # Simulated change minus predicted change; a diverging simulation is infinite or NaN.
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

        The nearest fit is the one with the lowest cost (sum of squares). If new derivatives reduce
        this cost enough, those of the first fits were wrong, so the fits are repeated from the
        starts with derivatives that are computed again before each stage. The best fit of each
        model is returned.

        Args:
            starts: model, parameters and first initial states of each fit.
            fits: fit of each model.
        """
        first_stage, *later_stages = HORIZON_STAGES
        # The last stage fits whole runs.
        whole_runs = HORIZON_STAGES[-1]
        continued_fits = _select_nearer_fits(fits, self._continue_about_best(fits, [whole_runs]))
        lowest_cost, continued_cost = (
            _find_lowest_cost_fit(some_fits).cost for some_fits in (fits, continued_fits)
        )
        if lowest_cost - continued_cost < MIN_SQUARES_DECREASE:
            return continued_fits
        staged_fits = self._fit_initial_states(starts, [first_stage])
        # Whole runs are the last of the stages, and are fitted twice: the second fit has
        # derivatives at the result of the first one.
        for stage in (*later_stages, whole_runs):
            staged_fits = self._continue_about_best(staged_fits, [stage])
        return _select_nearer_fits(continued_fits, staged_fits)

    def _continue_about_best(
        self, fits: Sequence[TrajectoryFit], stages: Sequence[tuple[float, int]]
    ) -> list[TrajectoryFit]:
        """Continue the fits with derivatives by initial states about the best of them.

        The derivatives are stored in the run evaluator, from which the fits take them.

        Args:
            fits: fit of each model.
            stages: share of the runs and maximum number of iterations, one after another.
        """
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


def compute_penalised_likelihood(observed: Array, simulated: Array, free: float) -> float:
    """Compute the penalised log-likelihood of predictions (Bayesian information criterion).

    It is M = 2 log L - f log n (1), with the likelihood L of n samples, maximised by the parameters
    of the noise, and f effective initial states.

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
