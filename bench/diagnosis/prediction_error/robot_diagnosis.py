"""Confirm by simulation what prediction errors select, and determine the verdict.

1. Fit the selected set and its competing models to whole simulated runs.
2. Remove effects that make predictions of held-out runs worse.
3. Test whether an unmodelled force is missing (`bench.diagnosis.search.lack_of_fit`).
4. Collect other effects that explain the data as well.
5. Determine the verdict by the rules of `bench.diagnosis.search.verdict_rules`.

A set that filters identified in a long recording, or that was identified servo by servo, is
simulated as it is, without step 1, 2 and 4.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.fitted_models import FittedModel
from bench.diagnosis.prediction_error.prediction_error_search import PredictionErrorSearch
from bench.diagnosis.prediction_error.regression_selection import compute_p_value_of_gain
from bench.diagnosis.prediction_error.stepwise_selection_by_filters import IdentifiedSet
from bench.diagnosis.search.alternative_causes import (
    AlternativeFinder,
    CauseEvidence,
    differ_in_one_effect,
    select_preferred_model,
)
from bench.diagnosis.search.diagnose import Diagnosis, DiagnosisResult, compute_gap_closed
from bench.diagnosis.search.effect_search import EffectSearch
from bench.diagnosis.search.held_out_model_choice import HeldOutValidation
from bench.diagnosis.search.lack_of_fit import assess_lack_of_fit, assess_residual_size
from bench.diagnosis.search.verdict_rules import (
    INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO,
    DiagnosisState,
    decide_verdict,
    is_unexplained,
)
from bench.diagnosis.validation.held_out_runs import Validation

MIN_REMOVED_SHARE = 0.5
"""Minimum share of the discrepancy that reported effects remove if the cause is unknown."""
COMPARED_MODEL_MARGIN = 15.0
"""Maximum distance in twice the log-likelihood of models that are evaluated on held-out runs."""
MAX_REFIT_GAIN_RATIO = 2.0
"""Maximum gain of a competitor by its final fit, as a multiple of the gain of the selected model.

Competitors that this gain would not bring within the distance of indistinguishable models are not
refitted.
"""
MAX_REFITTED_COMPETITORS = 4
"""Maximum number of competing models that are fitted to final convergence."""


def _compute_p_value(evaluator: RunEvaluator, name: str, gain: float) -> float:
    """Return the p-value of the gain of an effect in twice the log-likelihood, chi-squared law."""
    count = len(evaluator.get_coefficient_indices(name))
    return compute_p_value_of_gain(gain, count, len(evaluator.library))


@dataclass(frozen=True)
class _RobotAlternatives(AlternativeFinder):
    """Collects alternatives of a robot's effects; p-values are those of the chi-squared law."""

    def _compute_p_value(self, rest: FittedModel, effect: str, gain: float) -> float:  # noqa: ARG002
        """Return the p-value of a gain by its chi-squared law; no surrogates are simulated.

        Args:
            rest: not used; the model without the effect, to which the base class fits surrogates.
            effect: name of the effect.
            gain: its gain in twice the log-likelihood.
        """
        return _compute_p_value(self.search.evaluator, effect, gain)


class RobotDiagnosis(Diagnosis):
    """The steps of the diagnosis of a robot's recording.

    Args:
        search: search by prediction errors, which contains the fitted base model.
        held_out: held-out runs for validation; None if there are none.
    """

    alternative_finder = _RobotAlternatives

    def __init__(self, search: EffectSearch, held_out: Validation | None) -> None:
        super().__init__(search, held_out)
        assert isinstance(search, PredictionErrorSearch)
        self._robot_search = search

    def run(self) -> DiagnosisResult:
        """Return the result of the complete diagnosis.

        - If the base model does not fit at all, the search stops at once.
        - If filters identified effects in a model that stays incomplete, these are the result.
        - Otherwise the effects of the search are compared with competing models, validated on
          held-out runs, tested for an unmodelled force, and compared with alternative causes.

        If the cause is unknown and the effects leave most of the discrepancy, the result has none.

        Raises:
            SearchStoppedError: the search had to end early.
        """
        search, search_control = self._robot_search, self._search_control
        unfit = self.classify_unfit_base()
        if unfit is not None:
            return unfit
        base = search.base_model
        search_control.begin_question("search")
        self._model = search.run()
        if search.identified is not None:
            return self._build_filter_result(search.identified)
        search_control.begin_question("rivals")
        self._model = search.fit_competing_models(self._model)
        size = len(self._model.effects)
        # This may remove effects.
        self._evaluate_on_held_out_runs()
        if 0 < len(self._model.effects) < size:
            # The competing models of the remaining effects were fitted together with the removed
            # ones, so fit them again.
            self._model = search.fit_competing_models(self._model)
            self._evaluate_on_held_out_runs()
        search_control.begin_question("structure")
        fitted = search.refit_first_states(search.refit_dry_friction(self._model))
        self._model = search.fit_to_convergence(fitted)
        lack_of_fit = assess_lack_of_fit(search, self._model)
        # With structure in the residual, likelihoods do not decide between models.
        if not lack_of_fit.has_structure:
            self._refit_near_competitors(
                self._model.penalised_log_likelihood - fitted.penalised_log_likelihood
            )
        search_control.begin_question("alternatives")
        validation = self._held_out_validation
        model, causes = select_preferred_model(
            self.alternative_finder(search, validation, lack_of_fit.has_structure), self._model
        )
        if model is not self._model:
            model = search.fit_to_convergence(model)
            if validation is not None:
                validation.evaluate_models([model])
        search_control.check_not_stopped()
        state = DiagnosisState(
            cause_count=len(causes),
            has_alternatives=any(cause.alternatives for cause in causes),
            gap_closed=compute_gap_closed(search, model, lack_of_fit),
            # The test of missing effects takes seconds, and does not matter if there is structure.
            is_unexplained=not search.leaves_only_creep_of_contacts(model)
            and (
                lack_of_fit.has_structure
                or is_unexplained(False, search.compute_p_value_of_missing_effect(model))
            ),
            misses_held_out_gap=validation is not None
            and validation.has_unexplained_gap(model, lack_of_fit),
        )
        verdict = decide_verdict(state)
        if verdict == "unknown" and state.gap_closed < MIN_REMOVED_SHARE:
            # Effects that leave most of the discrepancy only mimic what is missing.
            model, causes = base, ()
        return self._make_result(verdict, base, model, causes, lack_of_fit)

    def _refit_near_competitors(self, gain: float) -> None:
        """Fit the nearest competing models to final convergence, as the model was.

        The final fit weights a residual by its own autocorrelation, which increases the likelihood
        of every model. Without it, an effect with the same influence on the runs would be behind by
        this increase, and count as excluded. Competitors differ from the model in one effect.

        Args:
            gain: what the final fit of the model gained, in twice the log-likelihood.
        """
        search, model = self._robot_search, self._model
        if model is None or gain <= 0.0:
            return
        # Maximum distance of a competitor whose final fit may bring it close to the model.
        reach = INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO + MAX_REFIT_GAIN_RATIO * gain
        # Where servos are at their force limits, the number of first states that the data determine
        # may differ by one between fits that are not final.
        reach += search.parameter_penalty
        competitors = [
            other
            for other in search.models.values()
            if differ_in_one_effect(model, other)
            and other.penalised_log_likelihood > model.penalised_log_likelihood - reach
        ]
        competitors.sort(key=lambda other: -other.penalised_log_likelihood)
        for competitor in competitors[:MAX_REFITTED_COMPETITORS]:
            search.fit_to_convergence(competitor)

    def _build_filter_result(self, identified: IdentifiedSet) -> DiagnosisResult:
        """Return the result for a set that filters identified in a model that stays incomplete.

        The causes are the identified effects, in descending order of their gain. The verdict always
        counts an unexplained residual, since the model is known to be incomplete.

        Args:
            identified: the set, with the simulated model and the gain of each effect.
        """
        search = self._robot_search
        search_control = self._search_control
        model = identified.model
        validation = None
        if self._held_out is not None:
            search_control.begin_question("held_out")
            validation = self._held_out_validation = HeldOutValidation(self._held_out)
            validation.evaluate_models([search.base_model, model])
        search_control.begin_question("structure")
        if identified.is_residual_tested:
            lack_of_fit = assess_lack_of_fit(search, model)
        else:
            # The residual is far above the noise, so it counts as structure without a test.
            lack_of_fit = replace(assess_residual_size(search, model), p_value=0.0)
        search_control.check_not_stopped()
        state = DiagnosisState(
            cause_count=len(model.effects),
            gap_closed=compute_gap_closed(search, model, lack_of_fit),
            is_unexplained=True,
            misses_held_out_gap=validation is not None
            and validation.has_unexplained_gap(model, lack_of_fit),
        )
        causes = sorted(
            (self._cause(name, gain) for name, gain in identified.gains.items()),
            key=lambda cause: -cause.gain,
        )
        verdict = decide_verdict(state)
        result = self._make_result(verdict, search.base_model, model, tuple(causes), lack_of_fit)
        return replace(result, is_incomplete=True)

    def _cause(self, name: str, gain: float) -> CauseEvidence:
        """Return the evidence for an effect whose gain is that of filters, without alternatives.

        Args:
            name: name of the effect.
            gain: its gain in twice the log-likelihood of the innovations.
        """
        p_value = _compute_p_value(self._robot_search.evaluator, name, gain)
        return CauseEvidence(
            effect=name, alternatives=(), p_value=p_value, gain=gain, preferred=name
        )

    def _evaluate_on_held_out_runs(self) -> None:
        """Predict held-out runs with the model and its competitors, and drop unhelpful effects.

        Competitors are the fitted models with the same number of effects and about the same
        penalised likelihood. Models without one of the effects are fitted too, so that an effect
        that does not improve the prediction can be left out. The model and the validation of this
        diagnosis are replaced. Nothing is done without held-out runs or without a model.
        """
        if self._held_out is None or self._model is None:
            return
        search, model = self._robot_search, self._model
        self._search_control.begin_question("held_out")
        names = set(model.effects)
        if len(names) > 1:
            # The fitted smaller models are stored in `search.models`.
            for name in model.effects:
                search.remove_effect(model, name)
        smaller_models = [m for m in search.models.values() if set(m.effects) < names and m.effects]
        limit = model.penalised_log_likelihood - COMPARED_MODEL_MARGIN
        competing_models = [
            m
            for m in search.models.values()
            if len(m.effects) == len(names)
            and m is not model
            and m.penalised_log_likelihood > limit
        ]
        validation = HeldOutValidation(self._held_out)
        validation.evaluate_models([search.base_model, model, *smaller_models, *competing_models])
        self._search_control.check_not_stopped()
        self._held_out_validation = validation
        self._model = validation.drop_unhelpful_effects(search, model)
