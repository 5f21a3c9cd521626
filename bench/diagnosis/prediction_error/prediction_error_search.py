"""Search for the effects that a robot's model lacks, by prediction errors.

`regression_selection` selects effects by the innovations of a filter. Here, selected sets are
fitted to whole simulated runs (output errors), which decide. The search ends as soon as the
residual of a set is only noise. The order is:

    0. For a robot on the ground, fit the single effects that explain most of the residual of its
       simulated pieces (`effect_scores_on_ground`).
    1. Select effects with few shapes by regression. If the selection leaves a large residual of a
       robot with servos, identify the servos (`servo_identification`), and do nothing of the
       following. Otherwise fit the dry friction among them first, because it is not linear where a
       joint sticks (`dry_friction_fits`), and then the set (`simulated_fits`), also with a lag in
       place of a delay or the reverse (`competing_models`). If this fails, and friction acts at all
       joints, select the other effects with it in the filter's model
       (`stepwise_selection_by_filters`). If this fails too, or before it if servos reach their
       limits, simulate single effects at several coefficients, and fit the best of them
       (`single_effect_fits`).
    2. If a force is still missing, select again, with effects of many shapes at the joints where it
       is missing (`regression_columns`), and replace laws that do not explain the runs by richer
       ones (`competing_models`).
    3. Fit each of the effects with the largest gains alone, and those of the standard joint model
       (`single_effect_fits`, `effect_proposals`).
    4. Add effects one by one, to dry friction in either of its forms or to nothing, each chosen by
       filters with the effect in the model (`stepwise_selection_by_filters`).
    5. Try one effect in place of several (`competing_models`).
    6. Simulate elasticity and backlash between a drive and its links
       (`elasticity_and_backlash_fits`). Those that remove most of the residual without being fitted
       come before 3.

If a long recording shows that the model stays incomplete, filters alone identify its effects
(`stepwise_selection_by_filters`), and nothing of the above is done.

`PredictionErrorSearch.fit_competing_models` then fits the sets that are nearly as good, because
they may be equivalent. All steps share filters with effects in the model (`filters_with_effects`),
columns of regressions (`regression_columns`) and fits (`simulated_fits`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from bench.diagnosis.dry_friction_form import has_dry_friction
from bench.diagnosis.evaluation.parameter_bounds import get_bounds_by_index
from bench.diagnosis.fitting.fitted_models import (
    MAX_ITERATIONS,
    FittedModel,
    select_likeliest,
)
from bench.diagnosis.fitting.levenberg_marquardt import FitStart, TrajectoryFit
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from bench.diagnosis.kalman.candidate_responses import compute_sensitivities
from bench.diagnosis.prediction_error.competing_models import (
    fit_competing_models,
    fit_single_in_place,
    replace_by_richer_laws,
    replace_time_shifts,
)
from bench.diagnosis.prediction_error.dry_friction_fits import (
    check_fit,
    check_simple_friction,
    check_simulated_soft_friction,
    compare_friction_forms,
    fit_dry_friction,
)
from bench.diagnosis.prediction_error.effect_proposals import SearchContext
from bench.diagnosis.prediction_error.effect_scores_on_ground import (
    OutputErrorScores,
    fit_best_scored,
)
from bench.diagnosis.prediction_error.effects_at_joints import acts_at_joint, has_series
from bench.diagnosis.prediction_error.elasticity_and_backlash_fits import (
    add_series_effect,
    fit_series_effects,
    simulate_series_effects,
)
from bench.diagnosis.prediction_error.filters_with_effects import FilteredSet
from bench.diagnosis.prediction_error.regression_columns import build_regression_about
from bench.diagnosis.prediction_error.regression_selection import (
    Selected,
    compute_p_value_of_gain,
    score_by_regression,
    shows_step_errors,
)
from bench.diagnosis.prediction_error.servo_identification import (
    MIN_EXCESS,
    has_unknown_servos,
    identify_servos,
)
from bench.diagnosis.prediction_error.settled_simulations import refine_with_wide_differences
from bench.diagnosis.prediction_error.simulated_fits import (
    RatedStart,
    compute_likely_cost,
    fit_by_simulation,
    fit_nearby,
    fit_quick_selection,
    fit_selection,
    fit_states_alone,
    is_at_noise,
    is_explained,
    is_nearly_explained,
    is_slow_to_simulate,
    remove_idle_effects,
    simulate_identified,
)
from bench.diagnosis.prediction_error.single_effect_fits import (
    fit_likely_effects,
    fit_single_effects,
    list_likely_starts,
)
from bench.diagnosis.prediction_error.stepwise_selection_by_filters import (
    IdentifiedSet,
    add_to_dry_friction,
    add_to_model,
    identify_incomplete,
    select_in_model,
    select_with_friction,
)
from bench.diagnosis.search.candidate_directions import DirectionSet
from bench.diagnosis.search.effect_search import EffectSearch
from bench.diagnosis.search.fit_starts import add_effect_to_start, find_first_states
from bench.diagnosis.search.score_test import CandidateScores
from bench.diagnosis.search.verdict_rules import EFFECT_P_VALUE_THRESHOLD
from sims.core.simulator import Array

MIN_INCOMPLETE_SHARE = 0.6
"""Minimum share of the joints of a real arm whose servo or friction the model lacks."""
MIN_STATE_GAIN = 3.0
"""Minimum decrease of the cost, in units of the noise, by a fit of first states alone."""
FIRST_TEST_STEPS = 4
"""Maximum number of steps of the first fit that tests an effect."""
TRIED_SHARES = (1.0, 0.5)
"""Shares of the regression coefficients with which a filter must follow the runs better."""


@dataclass
class PredictionErrorSearch(EffectSearch):
    """A search with candidates from prediction errors.

    Attributes:
        is_form_given: whether the form of dry friction is not tested before effects are fitted.
        likely: a model that is fitted before any selection, if there is one.
        identified: the set that filters identified in a long recording whose model stays
            incomplete; None otherwise.
    """

    is_form_given: bool = False
    likely: FitStart | None = None
    identified: IdentifiedSet | None = None

    @cached_property
    def _search_context(self) -> SearchContext:
        return SearchContext.of(self)

    @cached_property
    def _output_error_scores(self) -> OutputErrorScores:
        """Scores of effects of a robot on the ground."""
        return OutputErrorScores(self._search_context)

    def run(self) -> FittedModel:
        """Return the model of all effects that the data show.

        - If a likely model is known from before, it is fitted by simulation, and returned if it
          explains the runs, which means that it leaves little more than noise.
        - Otherwise, a long recording whose model stays incomplete is identified by filters without
          simulation.
        - If neither gives a result, effects are searched.

        A likely model is that of an earlier search (`self.likely`), or has the effects that were
        identified together with the base parameters. The result is also stored in
        `best_supported_model`, for a search that is stopped later.

        Raises:
            SoftFrictionError: dry friction of the data has MuJoCo's soft form.
        """
        context, self.best_supported_model, best = self._search_context, self.base_model, None
        # A model of an earlier search, or the effects identified together with base parameters.
        likely = self.likely or self._make_identified_start()
        if likely is not None:
            best = remove_idle_effects(context, fit_by_simulation(context, likely))
        else:
            self.identified = identify_incomplete(context)
        if self.identified is not None:
            self.best_supported_model = self.identified.model
            return self.identified.model
        if best is None or not is_explained(context, best):
            best = self._search_effects()
        best = self._correct_shown_step_errors(best)
        self.best_supported_model = best
        return best

    def _correct_shown_step_errors(self, model: FittedModel) -> FittedModel:
        """Correct the errors of the integrator's steps if the filter with a model shows them.

        Without the effects of the model, the missing force could imitate these errors. Nothing is
        done if they are already corrected, for a model without effects or without a successful fit,
        and for joints in series, which the filter does not follow.

        Args:
            model: the fitted model.
        """
        if (
            self.evaluator.discretisation_correction is not None
            or not model.effects
            or not np.isfinite(model.fit.cost)
            or has_series(self.evaluator, model.effects)
            or not shows_step_errors(self._search_context.filters.get_filter(model))
        ):
            return model
        return self.correct_step_errors(model)

    def _make_identified_start(self) -> FitStart | None:
        """Return a start with the effects that were identified with the base parameters.

        The parameters of the start are those without effects (`filters.reference`, with the
        identified base parameters), and the coefficients of the identified effects. Its first
        states are estimated by the filter of the model without effects (`filters.base`). The result
        is None if base parameters were not identified, or without effects.
        """
        identified, filters = self.evaluator.identified, self._search_context.filters
        if identified is None or not identified.effects:
            return None
        theta = filters.reference.copy()
        for name, coefficients in identified.effects.items():
            theta[self.evaluator.coefficient_slices[name]] = coefficients
        return FitStart(
            tuple(identified.effects), theta, filters.estimate_first_states(filters.base)
        )

    def _search_effects(self) -> FittedModel:
        """Select effects by regression and fit them by simulation, until only noise remains.

        Each further method is slower, so it is tried only if the best model so far does not explain
        the runs:

        1. single effects of a robot on the ground, by the residual of simulations;
        2. likely effects alone, if servos reach their limits (otherwise after 4);
        3. identification servo by servo, after which nothing else is done if it succeeds;
        4. dry friction alone, then the set that regression selects, with a lag in place of a delay
           or the reverse, then the set that regressions with dry friction of all joints in the
           model select, then soft dry friction of one joint;
        5. effects with many shapes, such as forces of any period, then richer laws at the same
           places;
        6. series effects (elastic or slack transmissions) that remove most of the residual;
        7. effects that regression missed: singly, then one by one in addition to others;
        8. one effect in place of several;
        9. all other series effects.

        If no effect was accepted, the selected set is fitted whole. The functions named ``check_``,
        and `compare_friction_forms`, end the search by raising `SoftFrictionError` if dry friction
        is likelier in MuJoCo's soft form.

        Raises:
            SoftFrictionError: dry friction has MuJoCo's soft form; the caller searches again in
                that form.
        """
        context = self._search_context
        best_single = self.base_model
        if context.filters.base.is_on_ground:
            best_single = fit_best_scored(self._output_error_scores)
            if is_explained(context, best_single):
                return best_single
        selected = context.columns.select()
        stiff_friction = None if self.is_form_given else compare_friction_forms(context, selected)
        # The linear model jumps where servos reach their limits, so the selection is not reliable.
        has_jumps = bool(context.filters.base.runs.jumps.any())
        if has_jumps and not best_single.effects:
            best_single = fit_likely_effects(context, self._likely_starts)
            if is_explained(context, best_single):
                return best_single
        self.identified = self._identify_servos(selected)
        if self.identified is not None:
            return self.identified.model
        friction = stiff_friction or fit_dry_friction(context, selected)
        best = friction
        if not is_explained(context, best):
            # Friction of the wrong form leaves a small residual, which many effects would imitate.
            if friction.effects and is_nearly_explained(context, friction):
                check_fit(context, friction)
            best = select_likeliest(best, fit_quick_selection(context, selected))
        if self._should_continue(best):
            best = replace_time_shifts(context, best)
        if self._should_continue(best):
            best = select_likeliest(best, select_with_friction(context, selected))
        if self._should_continue(best) and not has_jumps:
            best = select_likeliest(best, fit_likely_effects(context, self._likely_starts))
        selected_with_shapes = selected
        if self._should_continue(best) and not self.is_form_given:
            check_simulated_soft_friction(context)
        if self._should_continue(best):
            selected_with_shapes = context.columns.select_with_shapes(selected)
            best = select_likeliest(best, fit_quick_selection(context, selected_with_shapes))
            check_simple_friction(context, best)
        if self._should_continue(best):
            best = replace_by_richer_laws(context, best)
        series: list[RatedStart] | None = None
        if self._should_continue(best):
            series = simulate_series_effects(context, selected_with_shapes)
            likely_series = fit_series_effects(context, series, compute_likely_cost(context))
            best = select_likeliest(best, likely_series)
        if self._should_continue(best):
            best = self._add_missing_effects(best, selected, friction)
        best = fit_single_in_place(context, best)
        if not is_explained(context, best) and not self.evaluator.search_control.is_over():
            # These effects are fitted from other first states, which must not be their only gain.
            best = select_likeliest(best, self.refit_first_states(self.base_model))
        if not is_explained(context, best) and not self.evaluator.search_control.is_over():
            if series is None:
                series = simulate_series_effects(context, selected_with_shapes)
            best = select_likeliest(best, fit_series_effects(context, series))
        if self._should_continue(best):
            best = add_series_effect(context, best)
        # The quick fits may have skipped the selection because it is slow to simulate.
        if not best.effects:
            best = fit_selection(context, selected_with_shapes)
        return select_likeliest(best, best_single)

    def _identify_servos(self, selected: Selected) -> IdentifiedSet | None:
        """Identify the servos of a real arm, whose model is incomplete at most joints.

        This takes many simulations, so it is done only if neither the base model, one effect alone,
        nor the selected effects come near the data. The distance is the excess residual: the RMS
        residual in units of the noise, minus one. The result is used only if it adds effects at
        most joints and leaves a smaller residual than the selection.

        Args:
            selected: the selection by regression.

        Returns:
            The identified set; None if one of these conditions does not hold, or if the servos'
            gains are known.
        """
        context = self._search_context
        if not self.compute_excess_residual(self.base_model) > MIN_EXCESS:
            return None
        if not has_unknown_servos(context) or self._likely_starts:
            return None
        best = fit_quick_selection(context, selected)
        excess = self.compute_excess_residual(best)
        if is_nearly_explained(context, best) or not excess > MIN_EXCESS:
            return None
        start, gains = identify_servos(context)
        joints = range(len(self.evaluator.channels))
        incomplete_joints = [
            joint
            for joint in joints
            if any(acts_at_joint(self.evaluator, name, {joint}) for name in start.effects)
        ]
        model = simulate_identified(context, start)
        if (
            len(incomplete_joints) < MIN_INCOMPLETE_SHARE * len(joints)
            or not self.compute_excess_residual(model) < excess
        ):
            return None
        return IdentifiedSet(model, gains, is_residual_tested=False)

    @cached_property
    def _likely_starts(self) -> list[RatedStart]:
        """Effects that alone remove most of the residual without being fitted."""
        return list_likely_starts(self._search_context)

    def _should_continue(self, best: FittedModel) -> bool:
        """Return whether to search effects that regression missed.

        This is the case if the base model lacks a force (its filter needs process noise), the best
        model does not explain the runs, and there is time left.

        Args:
            best: the best model so far.
        """
        is_force_missing = self._search_context.filters.base.has_missing_force
        return (
            is_force_missing
            and not is_explained(self._search_context, best)
            and not self.evaluator.search_control.is_over()
        )

    def _add_missing_effects(
        self, best: FittedModel, selected: Selected, friction: FittedModel
    ) -> FittedModel:
        """Fit effects alone, and add effects one by one, until a set explains the runs.

        If several effects already remove most of the discrepancy, further ones are added to them,
        and nothing else is tried. Otherwise single effects are fitted; then effects are added to
        the dry friction of the selection; then effects are added to the base model.

        Args:
            best: the best model so far; effects are added to it if it removes most of the
                discrepancy.
            selected: the selection by regression.
            friction: dry friction of the selection, fitted alone.
        """
        context = self._search_context
        if is_nearly_explained(context, best):
            check_fit(context, best)
            if len(best.effects) > 1:
                return select_likeliest(best, add_to_model(context, best))
        best = select_likeliest(best, fit_single_effects(context))
        if self._should_continue(best):
            best = select_likeliest(best, add_to_dry_friction(context, selected, friction))
        if self._should_continue(best):
            best = select_likeliest(best, select_in_model(context))
        return best

    @property
    def has_contact_jumps(self) -> bool:
        """True for a robot on the ground."""
        return self._search_context.filters.base.is_on_ground

    def fit_to_convergence(self, model: FittedModel) -> FittedModel:
        """Return the model fitted to final convergence.

        It is first fitted again from first states that are better for its parameters, if there are
        any. For a robot on the ground, derivatives by differences over wide changes of the
        coefficients then replace those by small changes, since these show the jumps of contacts and
        would make the intervals of the coefficients too narrow.

        Args:
            model: model whose coefficients are reported.
        """
        model = super().fit_to_convergence(self._refit_from_better_states(model))
        filters = self._search_context.filters
        is_fitted = bool(model.effects) and np.isfinite(model.fit.cost)
        if not is_fitted or not self.has_contact_jumps:
            return model
        fit = refine_with_wide_differences(
            filters.get_similar_filter(model).first_state_fitter,
            model.fit,
            get_bounds_by_index(self.evaluator, model.effects),
        )
        cost = TrajectoryFitter(self.evaluator, self.noise).compute_cost(fit)
        refined = self._rate_fit(replace(fit, cost=cost))
        # Store the fit as its own refinement, since a refinement by small central differences would
        # undo this.
        self.refined_jacobians[id(refined.fit)] = refined.fit, refined.fit
        self.models[frozenset(model.effects)] = refined
        return refined

    def _refit_from_better_states(self, model: FittedModel) -> FittedModel:
        """Fit a model again if a fit of its first states alone improves it.

        Args:
            model: the fitted model; it is returned without effects or if its simulation fails.
        """
        if not model.effects or not np.isfinite(model.fit.cost):
            return model
        fit = fit_states_alone(self._search_context, model)
        if fit.cost > model.fit.cost - MIN_STATE_GAIN:
            return model
        return select_likeliest(model, self.fit_one(fit.make_start()))

    def refit_first_states(self, model: FittedModel) -> FittedModel:
        """Fit a model that leaves more than noise again from better first states, if there are any.

        A joint that sticks, or a motion that amplifies errors, may leave the first states of a run
        in a local minimum, which looks like a missing effect. A model whose simulation fails is
        returned as it is.

        Args:
            model: the fitted model.

        Returns:
            The refitted model, or `model` if it is as good.
        """
        if not np.isfinite(model.fit.cost) or is_at_noise(self._search_context, model):
            return model
        start = find_first_states(self.evaluator, self.noise, model.fit)
        return model if start is None else select_likeliest(model, self.fit_one(start))

    def refit_dry_friction(self, model: FittedModel) -> FittedModel:
        """Fit a model again from nearby dry friction, if that is better.

        The cost jumps where a joint begins to stick for a moment, so that the best friction
        may lie beyond a jump that is too small to count as an unexplained residual.

        Args:
            model: the fitted model; it is returned if its simulation fails.
        """
        if not np.isfinite(model.fit.cost):
            return model
        for name in model.effects:
            if has_dry_friction(self.evaluator, [name]):
                model = select_likeliest(model, fit_nearby(self._search_context, model, name))
        return model

    def fit_competing_models(self, best: FittedModel) -> FittedModel:
        """Fit the sets that are nearly as good, and return the best of all."""
        return fit_competing_models(self._search_context, best)

    def get_best_so_far(self) -> FittedModel:
        """Return the likeliest model if its gain is significant, without any simulation.

        It is the answer of a search that must end early. The base model is returned if the p-value
        of the gain, corrected for the number of effects in the library, exceeds the threshold.
        """
        # Likelihoods have values in twice the log-likelihood.
        base, library_size = self.base_model, len(self.evaluator.library)
        best = select_likeliest(*self.models.values())
        indices = [i for name in best.effects for i in self.evaluator.get_coefficient_indices(name)]
        gain = best.likelihood.value - base.likelihood.value
        is_significant = (
            bool(indices)
            and compute_p_value_of_gain(gain, len(indices), library_size)
            <= EFFECT_P_VALUE_THRESHOLD
        )
        return best if is_significant else base

    def take_over(self, other: PredictionErrorSearch) -> None:
        """Reuse the filter and the responses of another search of the same base model.

        Both searches have the same runs. The form of the dry friction that effects add (stiff, or
        MuJoCo's soft form) may differ, since the base model has no effect, and so none of this
        friction. Likelihoods of models with effects are reused only if both searches have the same
        evaluator, and so the same form.

        Args:
            other: the other search.
        """
        self.evaluator.filtered_runs = replace(
            other._search_context.filters.base, evaluator=self.evaluator
        )
        self._search_context.columns.take_over(other._search_context.columns)
        if self.evaluator is other.evaluator:
            self._search_context.filters.take_over(other._search_context.filters)

    def leaves_only_creep_of_contacts(self, model: FittedModel) -> bool:
        """Return whether a model with effects, of a robot on the ground, explains the runs.

        Simulated wheels and feet creep from first states that are not exactly settled. In long runs
        this is significant but no further cause, so the size of the residual decides, not its
        p-value.
        """
        context = self._search_context
        is_on_ground = context.filters.base.is_on_ground
        return is_on_ground and bool(model.effects) and is_explained(context, model)

    def compute_p_value_of_missing_effect(self, model: FittedModel) -> float:
        """Return the p-value of the most significant effect that a fitted model lacks.

        Four tests are made, each slower and more accurate:

        1. linear regression of the innovations, which also chooses the effect;
        2. a few steps of a fit by simulation, unless the effect is slow to simulate;
        3. a filter with the effect in its model, at a few shares of the coefficient;
        4. a fit by simulation, of few steps if the effect is slow to simulate.

        The p-value of the first test that is not significant is returned, or that of the last one.
        In the tests 2 to 4, the gain of the effect in twice the log-likelihood has a chi-squared
        law, and the p-value is multiplied by the number of effects in the library (Bonferroni
        correction).

        Args:
            model: the fitted model; only the first test is made if its simulation fails.
        """
        # 1. Regression.
        scores = self.score_missing_effects(model)
        if scores.p_value > EFFECT_P_VALUE_THRESHOLD or not np.isfinite(model.fit.cost):
            return scores.p_value
        name = scores.effects[0]
        # The best shape of the best effect.
        (group, solution), *_ = scores.peaks[0]
        coefficients = self._search_context.columns.coefficients(group, solution)
        start = add_effect_to_start(self.evaluator, model.fit.make_start(), name, coefficients)
        count = len(self.evaluator.get_coefficient_indices(name))
        library_size = len(self.evaluator.library)
        is_slow = is_slow_to_simulate(self._search_context, [name])

        def compute_p_value_of_fit(iterations: int) -> float:
            """Return the p-value of the gain by a fit with a maximum number of steps."""
            gain = self.fit_one(start, iterations).likelihood.value - model.likelihood.value
            return compute_p_value_of_gain(gain, count, library_size)

        # 2. First steps of a fit.
        if not is_slow:
            p_value = compute_p_value_of_fit(FIRST_TEST_STEPS)
            if p_value > EFFECT_P_VALUE_THRESHOLD:
                return p_value
        # 3. Filters.
        p_value = compute_p_value_of_gain(
            self._compute_filter_gain(model, start, name), count, library_size
        )
        if p_value > EFFECT_P_VALUE_THRESHOLD:
            return p_value
        # 4. Fit.
        return compute_p_value_of_fit(FIRST_TEST_STEPS if is_slow else MAX_ITERATIONS)

    def _compute_filter_gain(self, model: FittedModel, start: FitStart, name: str) -> float:
        """Return the largest gain of a filter by an effect, at a few shares of its coefficients.

        Args:
            model: the model without the effect.
            start: the model with the effect.
            name: name of the effect.

        Returns:
            The gain in twice the log-likelihood of the innovations.
        """
        filters = self._search_context.filters
        indices = self.evaluator.get_coefficient_indices(name)
        log_likelihood = filters.get_filter(model).log_likelihood
        gains = []
        for share in TRIED_SHARES:
            theta = start.theta.copy()
            theta[indices] *= share
            gains.append(2.0 * (filters.log_likelihood(theta) - log_likelihood))
        return max(gains)

    def score_missing_effects(
        self,
        model: FittedModel,
        noise_residual: Array | None = None,  # noqa: ARG002
    ) -> CandidateScores:
        """Score every effect that the model lacks by the innovations; the scores are cached.

        Args:
            model: the model; models with the same effects have the same scores.
            noise_residual: not used; the base class estimates the noise from it.
        """
        key = frozenset(model.effects)
        if key not in self.scores_by_effects:
            self.enter_scores(key, self._score_missing_effects(model))
        return self.scores_by_effects[key]

    def _score_missing_effects(self, model: FittedModel) -> CandidateScores:
        """Score the effects that a model lacks by regression of the innovations of its filter.

        A model with joints in series, which the filter does not follow, gets the scores of the base
        model with the p-value 1, so that no effect counts as missing.

        Args:
            model: the fitted model.
        """
        if has_series(self.evaluator, model.effects):
            return replace(self.score_missing_effects(self.base_model), p_value=1.0)
        self._report_scoring(model)
        regression, _ = self._search_context.columns.regression(model)
        rng = self.make_rng("library", model.effects)
        return score_by_regression(regression, set(self._list_addable_effects(model)), rng)

    @property
    def base_scores(self) -> CandidateScores | None:
        """Scores of all effects about the base model; None if no regression was made.

        Scores that the search computed are returned. Otherwise they are computed from the
        regression that selected effects: that of simulation residuals for a robot on the ground,
        or that of innovations.
        """
        regression = (
            self._output_error_scores.known_regression
            or self._search_context.columns.known_base_regression
        )
        scores = super().base_scores
        if regression and not scores:
            rng = self.make_rng("library", ())
            scores = score_by_regression(regression, set(self.evaluator.library), rng)
        return scores

    def score_unmodelled_force(self, model: FittedModel) -> tuple[float, str] | None:
        """Return the p-value of the best additional force, and the signal it depends on.

        The candidates are forces that are any piecewise linear function of one signal, such as a
        position or the time: sums of triangular functions ("hats"). A significant one shows a force
        that no effect of the library describes. The signal is empty without candidates. The result
        is None for a model with joints in series, which the filter does not follow.

        Candidates of the regression are the library and the hats, or the hats alone for a model
        that was identified by filters or servo by servo (`self.identified`). Only hats are scored.

        Args:
            model: the fitted model.
        """
        if has_series(self.evaluator, model.effects):
            return None
        columns, filters = self._search_context.columns, self._search_context.filters
        if self.identified is None:
            regression, _ = columns.regression(model)
        else:
            current = FilteredSet(filters.get_filter(model), model.effects)
            regression, _ = build_regression_about(current, [columns.hats], filters.base)
        # Hats are named by the signal they depend on; effects of the library are left out.
        labels = {probe.effect for probe in columns.hats.probes}
        scores = score_by_regression(regression, labels, self.make_rng("structure", model.effects))
        return scores.p_value, scores.effects[0] if scores.effects else ""

    def make_final_start(self, model: FittedModel) -> FitStart:
        """Return the start of a final fit, with derivatives about the model.

        A fit with known derivatives needs fewer simulations. The fit of the model has those by
        parameters. Its filter has those by initial states, unless the model has no effects or has
        joints in series, or the filter does not follow the runs.

        Args:
            model: the fitted model.
        """
        start = model.fit.make_start_with_derivatives()
        if not model.effects or has_series(self.evaluator, model.effects):
            return start
        followed = self._search_context.filters.get_similar_filter(model)
        if not followed.has_expected_innovations:
            return start
        return replace(start, state_jacobian=followed.compute_state_sensitivities())

    def with_sensitivities(self, start: FitStart) -> FitStart:
        """Return a start with derivatives by its coefficients about the measured motion.

        The start is returned as it is if it has derivatives or no effects. So it is if base
        parameters are fitted too, since only derivatives by coefficients are known, and with joints
        in series, which the filter does not follow.

        Args:
            start: start of a fit.
        """
        free_base_parameters = set(self.evaluator.base_indices.tolist()) - self.fixed_parameters
        needs_jacobian = start.known_jacobian is None and start.effects
        if not needs_jacobian or free_base_parameters or has_series(self.evaluator, start.effects):
            return start
        return replace(start, known_jacobian=self._search_context.columns.sensitivities(start))

    def release_memory(self) -> None:
        """Release the regressions, which only the search needs; they may take most of the memory.

        Scores about the base model that were not computed before are None afterwards.
        """
        self._search_context.columns.release_regressions()

    def get_known_directions(self) -> tuple[TrajectoryFit, DirectionSet] | None:
        """Return the fit of the base model, and first-order changes of its runs by every candidate.

        The changes (R, T, C, K) of R runs, T samples and C channels are those by a unit of the
        coefficient of each of K candidates, linearised about the measured motion.
        """
        library = self._search_context.columns.library
        base = self._search_context.filters.base
        values = compute_sensitivities(base, library, np.float32)
        return self.base_model.fit, DirectionSet(library.probes, values)
