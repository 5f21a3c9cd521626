"""Choice of MuJoCo's solver options for a robot with contacts: those of the file or others."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from bench.diagnosis.numerics_cause import OptionFinding
from bench.diagnosis.pipeline.base_model import BaseModel
from bench.diagnosis.pipeline.cause_search import CauseSearch
from bench.diagnosis.pipeline.run_filtering import filter_simulated_runs
from bench.diagnosis.pipeline.search_result import SearchResult
from bench.diagnosis.pipeline.time_step_choice import closes_gap_alone, is_clearly_better
from bench.diagnosis.search.verdict_rules import is_indistinguishable

MAX_LINEAR_RESIDUAL = 3.0
"""Maximum residual of the base model, in units of the noise, at which effects act linearly."""
MAX_COMPETING_SQUARES_RATIO = 2.0
"""Maximum sum of squares of an effect that competes with other options, relative to theirs."""
MIN_COMPETING_GAIN_SHARE = 0.7
"""Minimum gain of an effect that competes with other options, relative to theirs, near the noise.

Gains are in twice the log-likelihood, and those of effects to first order.
"""
MAX_OPTION_ROUNDS = 3
"""Maximum number of options of the solver that are changed."""
MAX_FITTED_OPTIONS = 3
"""Maximum number of alternative options that are fitted in a round."""


class RatedOptions(NamedTuple):
    """Base model with some options of the solver, and how well it explains the recording.

    Attributes:
        model: The base model.
        log_likelihood: Twice the log-likelihood.
        penalised_log_likelihood: Penalised log-likelihood.
        residual: RMS residual in units of the noise.
        held_out: Penalised log-likelihood of the held-out runs; 0 without validation.
        is_noise_like: Whether the residual may be noise.
    """

    model: BaseModel
    log_likelihood: float
    penalised_log_likelihood: float
    residual: float
    held_out: float
    is_noise_like: bool

    @classmethod
    def rate(cls, model: BaseModel) -> RatedOptions:
        """Rate how well a base model explains the fitted runs and predicts the held-out ones.

        Args:
            model: fitted base model, whose runs have the options to rate.
        """
        search = model.runs.create_search(model.fit)
        rated = search.base_model
        # Without validation, held-out runs count as equally likely.
        held_out = 0.0
        if model.runs.validation is not None:
            (prediction,) = model.runs.validation.validate([model.fit.fit])
            held_out = prediction.penalised_log_likelihood
        return cls(
            model=model,
            log_likelihood=float(rated.likelihood.value),
            penalised_log_likelihood=rated.penalised_log_likelihood,
            residual=1.0 + search.compute_excess_residual(rated),
            held_out=held_out,
            is_noise_like=search.is_noise_like(rated),
        )

    def is_better_than(self, other: RatedOptions) -> bool:
        """Return whether these options explain the recording better than others, on their own.

        They must close half of the gap, and predict the held-out runs better. If the same options
        are changed, only to other values, a clearly higher likelihood is enough.

        Args:
            other: base model with other options, to compare with.
        """
        # This import is needed for robots only.
        from sims.robot.integrator_settings import list_changed_options

        # Names of the options that differ from the model file.
        kinds: list[Any] = [rated.model.runs.kind for rated in (self, other)]
        options, other_options = (
            list_changed_options(kind.robot, kind.numerics).keys() for kind in kinds
        )
        gain = self.log_likelihood - other.log_likelihood
        if options == other_options:
            return not is_indistinguishable(gain)
        # A residual of 1 is only noise, and the rest is the gap.
        gap, remaining_gap = other.residual - 1.0, self.residual - 1.0
        return self.held_out >= other.held_out and closes_gap_alone(gain, gap, remaining_gap)


class SolverOptionChoice:
    """Choice of the options of MuJoCo's solver, before and after the search for causes.

    Attributes:
        finding: finding that other options than the file's are used; None while the file's are.
    """

    def __init__(self) -> None:
        """Begin with the options of the model file."""
        self.finding: OptionFinding | None = None
        self._possible_options: RatedOptions | None = None

    def choose(self, model: BaseModel) -> BaseModel:
        """Choose the options of the base model: those of the file, or others.

        Other options are used before the search if they alone close the gap down to the noise, and
        if no effect comes near with the file's options. Otherwise, options that are better than the
        file's are kept for `reconsider`, which compares them with the result of the search.

        Args:
            model: base model with the options of the file.
        """
        runs = model.runs
        if (
            not runs.contacts.has_contacts_off_ground
            or runs.context.options.tuner is not None
            or not model.is_usable
        ):
            return model
        file_options = RatedOptions.rate(model)
        if file_options.is_noise_like:
            return model
        options = _improve_options(file_options)
        if options is file_options:
            return model
        if options.is_noise_like and not _has_competing_effect(options, file_options):
            return self._use(options, file_options)
        self._possible_options = options
        return model

    def reconsider(self, result: SearchResult, cause_search: CauseSearch) -> SearchResult:
        """Return the result with other options, if they explain the data better, or this result.

        The other options are those that `choose` kept. They are searched for causes only if they
        alone are better than the present result, or if that result does not explain the data.

        Args:
            result: result with the options and the time step of the model file.
            cause_search: search for causes from another base model.
        """
        options = self._possible_options
        if options is None or result.has_ended:
            return result
        # Ratings are the penalised log-likelihood and the excess residual.
        rating = result.rate()
        option_rating = options.penalised_log_likelihood, options.residual - 1.0
        if not is_clearly_better(rating, option_rating) and result.is_explained:
            return result
        model = self._use(options, RatedOptions.rate(result.base))
        other = cause_search.search(model.finish())
        if is_clearly_better(rating, other.rate()):
            return other
        self.finding = None
        return result

    def _use(self, options: RatedOptions, file_options: RatedOptions) -> BaseModel:
        """Use other options of the solver than the model file's, and return their base model.

        Args:
            options: The other options.
            file_options: The options of the model file, with the base model fitted with them.
        """
        model = options.model
        robot_kind: Any = model.runs.kind
        gain = options.log_likelihood - file_options.log_likelihood
        self.finding, self._possible_options = OptionFinding(robot_kind, gain), None
        model.runs.context.say("simulated with other options of the solver than the model file's")
        # The gain on held-out runs is measured against the options of the model file.
        return replace(
            model, runs=replace(model.runs, before=file_options.model.predict_held_out())
        )


def _improve_options(rated: RatedOptions) -> RatedOptions:
    """Return the best options, changed one after the other while the base model improves.

    In each round, a fast estimate ranks the alternatives (settings with one option changed), and
    the base model is fitted with the best few.

    Args:
        rated: base model with the options of the model file, and its rating.
    """
    # This import is needed for robots only.
    from bench.diagnosis.evaluation.solver_option_ranking import rank_option_alternatives

    runs = rated.model.runs
    for _ in range(MAX_OPTION_ROUNDS):
        evaluator = rated.model.runs.fitting
        tried = []
        alternatives = rank_option_alternatives(
            evaluator, runs.noise, rated.model.fit.fit.theta, evaluator.initial_state_guesses
        )
        for alternative in alternatives[:MAX_FITTED_OPTIONS]:
            if runs.context.search_control.is_over():
                break
            robot_kind: Any = runs.kind
            # The runs take over the filter of the alternative before, if it has one.
            runs = runs.with_kind(robot_kind.with_integrator_settings(alternative.numerics))
            if runs.fitting.filtered_runs is None:
                filter_simulated_runs(runs)
            tried.append(RatedOptions.rate(rated.model.refit(runs)))
        best = max(tried, key=lambda one: one.log_likelihood, default=rated)
        # Nothing was tried, or nothing is better.
        if best is rated or not best.is_better_than(rated):
            break
        rated = best
    return rated


def _has_competing_effect(options: RatedOptions, file_options: RatedOptions) -> bool:
    """Return whether an effect may explain the recording as other options of the solver do.

    1. Scan the coefficients of effects at contacts by simulation. Far from the noise, linear scores
       are not valid, so that these effects alone decide, by the sum of squares.
    2. Score all other effects to first order, except laws with many shapes: an option is the
       simpler explanation.
    3. Compare the gain in twice the log-likelihood of the best effect with that of the options.

    Args:
        options: the other solver options, with the base model fitted to them.
        file_options: options of the model file, with the base model fitted to them.
    """
    # This import is needed for robots only.
    from bench.diagnosis.search.contact_search import (
        exclude_laws_with_many_shapes,
        find_lowest_scan,
    )

    runs = file_options.model.runs
    search = runs.create_search(file_options.model.fit)
    # 1. Effects at contacts. A scan simulates an effect with several coefficients.
    lowest_squares = find_lowest_scan(search)
    if file_options.residual > MAX_LINEAR_RESIDUAL:
        return lowest_squares < MAX_COMPETING_SQUARES_RATIO * options.model.fit.fit.cost
    # 2. Other effects.
    exclude_laws_with_many_shapes(search)
    model = search.base_model
    # Scores are gains in twice the log-likelihood.
    score = float(search.score_missing_effects(model).score.max(initial=0.0))
    # 3. Gains.
    squares = np.square(search.compute_residual(model.fit) / runs.noise.sigma).sum()
    sample_count = float(search.observed_mask.sum())
    # Twice the log-likelihood of white noise is -n log(sum of squares), up to a constant.
    scan_gain = sample_count * float(np.log(squares / lowest_squares))
    option_gain = options.log_likelihood - file_options.log_likelihood
    return max(scan_gain, score) > MIN_COMPETING_GAIN_SHARE * option_gain
