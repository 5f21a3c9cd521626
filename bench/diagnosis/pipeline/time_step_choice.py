"""Choice of the integrator step of a robot: that of the model file or a finer one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import replace
from itertools import combinations, tee
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.diagnosis.fitting.fitted_models import MAX_ITERATIONS, select_likeliest
from bench.diagnosis.fitting.levenberg_marquardt import FitStart
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from bench.diagnosis.numerics_cause import CoarseStepFinding
from bench.diagnosis.pipeline.base_model import BaseModel
from bench.diagnosis.pipeline.cause_search import CauseSearch
from bench.diagnosis.pipeline.run_filtering import filter_simulated_runs
from bench.diagnosis.pipeline.search_result import SearchResult, rate_model
from bench.diagnosis.pipeline.simulated_runs import SimulatedRuns
from bench.diagnosis.search.verdict_rules import improves_held_out, is_indistinguishable

if TYPE_CHECKING:
    from bench.diagnosis.evaluation.discretisation_error import StepRefinement

MIN_FINER_STEP_GAIN = 20.0
"""Minimum gain in twice the log-likelihood of a finer step over the file's own step; it means odds
of 22,000 to 1.
"""
MIN_CLOSED_SHARE = 0.5
"""Minimum share of the base model's gap that a finer step must close alone to be used in the
search. With a smaller share, another missing effect decides which step looks better.
"""
MIN_TESTED_EXCESS = 0.5
"""Minimum excess RMS residual, in units of the noise, for which errors of the step are simulated
although the innovations do not show them.
"""
MIN_ERROR_SHARE = 0.3
"""Minimum simulated error of the step for which finer steps are tried although the innovations do
not show it, as a share of the residual.
"""
MAX_SUBSET_EFFECTS = 3
"""Maximum number of effects of which all subsets are fitted with another time step."""
MAX_PREDICTED_COST_RATIO = 3.0
"""Maximum ratio of the cost that a linear model predicts with another step to the cost that has to
be reached; above it no fit is made.
"""
REFIT_ITERATIONS = 8
"""Maximum number of steps of the fit of more effects with another time step."""


class TimeStepChoice:
    """Choice of the time step and integrator, before and after the search for causes.

    A missing effect can make either step look better, and effects can imitate a step, so the first
    choice is preliminary.

    Attributes:
        finding: finding that the file's own step is too coarse; None while the file's is used.
    """

    def __init__(self) -> None:
        """Begin with the step of the model file."""
        self.finding: CoarseStepFinding | None = None
        # Each refinement is simulated when it is first needed; iterations need a copy.
        self._refinements: Iterator[StepRefinement] | None = None
        self._file_runs: SimulatedRuns | None = None

    def choose(self, model: BaseModel) -> BaseModel:
        """Choose the step of the base model: the file's own, or a finer one.

        Finer steps are tried if the innovations show errors of the step, or if simulated errors are
        a large part of the residual: the linear response to the errors of a stiff servo may be
        wrong. A finer step is used if it alone closes a large part of the gap. Steps are tried from
        coarse to fine; a step must be so accurate that its error is far below the residual that
        remains with it.

        Args:
            model: base model with the file's own step.
        """
        # This import is needed for robots only.
        from bench.diagnosis.evaluation.discretisation_error import find_step_refinements

        runs = model.runs
        file_log_likelihood, residual_rms = model.rate()
        file_excess = residual_rms - 1.0
        shows_errors = _shows_step_errors(model)
        if not shows_errors and not file_excess > MIN_TESTED_EXCESS:
            return model
        # A refinement is a finer step with its simulated error. The generator simulates each when
        # it is needed; copies of a tee share those that were simulated, also with `reconsider`.
        (refinements,) = tee(find_step_refinements(runs.fitting, runs.noise), 1)
        first = next(copy(refinements), None)
        # Innovations that show the error prove that it matters, however small it is.
        min_error = 0.0 if shows_errors else MIN_ERROR_SHARE * residual_rms
        if first is None or not first.error > min_error:
            return model
        self._refinements = refinements
        # The error of a step must be far below `residual_rms`, the residual that remains with the
        # last step tried. Finer steps leave a smaller one.
        # The cost of a residual that closes the required share of the gap.
        max_rms = 1.0 + (1.0 - MIN_CLOSED_SHARE) * file_excess
        max_cost = model.fit.fit.cost * (max_rms / residual_rms) ** 2
        for refinement in copy(self._refinements):
            if not refinement.is_accurate_enough(residual_rms):
                continue
            runs = runs.with_kind(refinement.kind)
            if runs.fitting.filtered_runs is None:
                # A model that diverges with the file's step may be filtered with a finer one.
                filter_simulated_runs(runs)
            fitter = TrajectoryFitter(runs.fitting, runs.noise, model.fit.fixed_parameters)
            # If this step cannot reach the cost, an exact one cannot either, as their motions are
            # nearly the same.
            if not _select_starts(fitter, [model.fit.fit.make_start()], max_cost):
                break
            finer = model.refit(runs)
            log_likelihood, residual_rms = finer.rate()
            gain = log_likelihood - file_log_likelihood
            if not closes_gap_alone(gain, file_excess, residual_rms - 1.0):
                # A step that is accurate enough for a residual of zero is exact. If even an exact
                # step does not close the gap, an effect may be missing in both models: the file's
                # step is kept, and `reconsider` compares the steps with this effect. After any
                # other step, the residual 0 makes the loop skip all steps that are not exact.
                if refinement.is_accurate_enough(0.0):
                    break
                residual_rms = 0.0
            elif refinement.is_accurate_enough(residual_rms):
                return self._use(refinement, gain, model, finer)
        return model

    def reconsider(self, result: SearchResult, cause_search: CauseSearch) -> SearchResult:
        """Return the result with another step, if that explains the data better, or this result.

        1. If `choose` took a finer step, the file's own step is tested.
        2. If not, a step is tested that is accurate enough for any residual.

        The other step is compared with the effects of this result or some of them. Models are
        compared by penalised log-likelihood and residual, and a finer step must be clearly better:
        data that MuJoCo made with the file's own step must not be explained by another. If the
        other step wins, causes are searched again.

        Args:
            result: result with the present step.
            cause_search: search for causes from another base model.
        """
        finding, model = result.finding, result.searched_base
        if self._refinements is None or result.has_ended:
            return result
        # Without causes, the models are those that `choose` compared, so that its choice stands.
        # But with the file's step and an unexplained residual, a finer step is tested, too.
        if not finding.causes and (self.finding is not None or finding.verdict == "adequate"):
            return result
        # 1. Step of the file. Its runs are stored only if `choose` took a finer step.
        if self._file_runs is not None:
            file_rating = _rate_best_subset(self._file_runs, result)
            if is_clearly_better(file_rating, result.rate()):
                return result
            model.runs.context.say(
                "the time step of the model file explains the data equally well: it is used"
            )
            self.finding = None
            return cause_search.search(model.refit(self._file_runs).finish())
        # 2. Finer step.
        refinements = copy(self._refinements)
        refinement = next((one for one in refinements if one.is_accurate_enough(0.0)), None)
        # The residual of a model that stays incomplete is far larger than an error of the step.
        if refinement is None or finding.is_incomplete:
            return result
        runs = model.runs.with_kind(refinement.kind)
        rating, finer_rating = result.rate(), _rate_best_subset(runs, result)
        if not is_clearly_better(rating, finer_rating):
            return result
        (log_likelihood, _), (finer_log_likelihood, _) = rating, finer_rating
        gain = finer_log_likelihood - log_likelihood
        finer = self._use(refinement, gain, model, model.refit(runs))
        return cause_search.search(finer.finish())

    def _use(
        self, refinement: StepRefinement, gain: float, file: BaseModel, finer: BaseModel
    ) -> BaseModel:
        """Use a finer step, and record that the file's own step is too coarse.

        A URDF specifies no step, so that a finer one corrects nothing in it: nothing is recorded
        then, and the step is not reconsidered.

        Args:
            refinement: the finer step and integrator.
            gain: gain in penalised log-likelihood over the file's own step.
            file: base model with the file's own step.
            finer: base model with the finer step, which is returned.
        """
        # This import is needed for robots only.
        from sims.robot.integrator_settings import specifies_integrator

        numerics = refinement.numerics
        file.runs.context.say(
            f"simulated with a smaller time step: {numerics.integrator}, {numerics.timestep:g} s"
        )
        robot: Any = finer.runs.kind
        if not specifies_integrator(robot.robot):
            self._refinements = None
            return finer
        self.finding, self._file_runs = CoarseStepFinding(refinement, gain), file.runs
        return replace(finer, runs=replace(finer.runs, before=file.predict_held_out()))


def _shows_step_errors(model: BaseModel) -> bool:
    """Return whether the recording shows the discretisation error of the engine's steps.

    The innovations of a Kalman filter show it. Without a filter of the runs this is not known,
    and true is returned.

    Args:
        model: base model, fitted with the file's own step.
    """
    runs = model.runs
    if runs.fitting.filtered_runs is None or not model.is_usable:
        return True
    # These imports are needed for robots only.
    from bench.diagnosis.kalman.linearised_filter import FollowedRuns
    from bench.diagnosis.prediction_error.regression_selection import shows_step_errors

    # The filter with the fitted parameters, which may be the stored one.
    theta = model.fit.fit.theta
    return shows_step_errors(FollowedRuns.get_or_follow(runs.fitting, theta, runs.noise))


def _rate_best_subset(runs: SimulatedRuns, result: SearchResult) -> tuple[float, float]:
    """Fit subsets of the effects of a result to runs with another step, and rate the best model.

    With another step, some effects may be needless, because they imitated the error of the step.
    All subsets are fitted if there are only few effects; otherwise only all together. Fits that
    stay far behind the result are stopped early.

    Args:
        runs: the runs with the other step.
        result: result of a search, whose fixed parameters stay fixed.

    Returns:
        Penalised log-likelihood and excess RMS residual of the best model; minus infinity and
        infinity if no model can come near the result.
    """
    names, fit = result.finding.model.effects, result.finding.model.fit
    evaluator, base = runs.fitting, result.searched_base.fit
    starts, has_few_effects = [], len(names) <= MAX_SUBSET_EFFECTS
    # Smallest number of effects in a subset.
    min_count = 0 if has_few_effects else len(names)
    for count in range(min_count, len(names) + 1):
        for subset in combinations(names, count):
            # Coefficients of omitted effects are zero, as in the nominal parameters.
            theta = fit.theta.copy()
            for omitted in set(names) - set(subset):
                indices = evaluator.coefficient_slices[omitted]
                theta[indices] = evaluator.get_nominal_theta()[indices]
            starts.append(FitStart(subset, theta, fit.initial_states))
    fitter = TrajectoryFitter(evaluator, runs.noise, base.fixed_parameters)
    # The readings are the same with both steps, so that the costs can be compared.
    result_cost = fitter.compute_cost(fit)
    starts = _select_starts(fitter, starts, result_cost)
    if not starts:
        return -np.inf, np.inf
    fits = fitter.fit_models(
        starts,
        MAX_ITERATIONS if has_few_effects else REFIT_ITERATIONS,
        is_racing=True,
        lowest_cost=result_cost,
    )
    search = runs.create_search(base)
    best = select_likeliest(*(search.add_fit(subset_fit) for subset_fit in fits))
    return rate_model(search, best)


def _select_starts(
    fitter: TrajectoryFitter, starts: Sequence[FitStart], max_cost: float
) -> list[FitStart]:
    """Return the starts from which fits with another step may reach a cost, by linear models.

    One simulation shows the error of the step, and its derivatives how much of this error other
    parameters and first states can compensate.

    Args:
        fitter: fitter of the runs with the other step.
        starts: fitted models with the present step.
        max_cost: cost that a model has to reach.
    """
    return [
        start
        for start, cost in zip(starts, fitter.predict_costs(starts), strict=True)
        if not cost > MAX_PREDICTED_COST_RATIO * max_cost
    ]


def closes_gap_alone(gain: float, gap: float, remaining_gap: float) -> bool:
    """Return whether other settings are significantly better, and close much of the gap alone.

    Args:
        gain: Gain of the base model in twice the log-likelihood by a finer step or other options.
        gap: Excess RMS residual of the base model without them, in units of the noise.
        remaining_gap: Excess RMS residual of the base model with them, in units of the noise.
    """
    return gain >= MIN_FINER_STEP_GAIN and gap - max(remaining_gap, 0.0) >= MIN_CLOSED_SHARE * gap


def is_clearly_better(file: tuple[float, float], other: tuple[float, float]) -> bool:
    """Return whether a model with other settings is significantly better than with the file's.

    Args:
        file: Penalised log-likelihood (twice the log-likelihood less log n for each parameter;
            Schwarz's criterion) and excess RMS residual in units of the noise, with the time step
            and the options of the model file.
        other: The two values with a finer step or other options. Far from the noise floor,
            autocorrelated residuals bias the likelihood, so the residual must be smaller too.
    """
    (file_likelihood, file_excess), (other_likelihood, other_excess) = file, other
    # `improves_held_out` is the rule for held-out runs; it is applied to the fitted runs here.
    return not is_indistinguishable(other_likelihood - file_likelihood) and improves_held_out(
        (file_likelihood, other_likelihood), (file_excess, other_excess)
    )
