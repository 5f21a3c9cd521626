"""Search for the causes of a gap, with the form of dry friction that the recording supports."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from bench.diagnosis.dry_friction_form import has_dry_friction, make_soft_kind
from bench.diagnosis.evaluation.search_control import SearchStoppedError
from bench.diagnosis.fitting.levenberg_marquardt import FitStart
from bench.diagnosis.pipeline.base_model import BaseModel
from bench.diagnosis.pipeline.convention_and_unit_checks import RecordingErrorCheck
from bench.diagnosis.pipeline.search_result import SearchResult
from bench.diagnosis.pipeline.simulated_runs import SimulatedRuns
from bench.diagnosis.pipeline.verdict_builder import restrict_verdict
from bench.diagnosis.search.diagnose import DiagnosisResult, diagnose, run_diagnosis
from bench.diagnosis.search.effect_search import EffectSearch
from bench.diagnosis.search.lack_of_fit import assess_lack_of_fit
from bench.diagnosis.search.verdict_rules import INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO

SOFT_FRICTION = (
    "dry friction has MuJoCo's soft form (solreffriction and solimpfriction of the model file): "
    "it fits better than stiff friction"
)
"""Message to the user when dry friction changes to the soft form."""
STIFF_FRICTION = "soft dry friction does not close the gap either: stiff friction is used"
"""Message to the user when dry friction changes back to the stiff form."""


class CauseSearch:
    """Search for causes, in the form of dry friction that the recording supports.

    Dry friction of a robot is either a stiff limit (the search's own effects) or MuJoCo's soft
    constraint.

    Args:
        error_check: check for wrong units and signs, which causes would imitate.
    """

    def __init__(self, error_check: RecordingErrorCheck) -> None:
        self._error_check = error_check

    def search(self, base: BaseModel) -> SearchResult:
        """Search for causes; repeat with MuJoCo's soft dry friction if the data support that form.

        The first search uses stiff friction, and ends with `SoftFrictionError` if it finds the soft
        form likelier. There are three outcomes:

        * the search ends with stiff friction;
        * it is repeated with soft friction, whose result counts;
        * the soft form was chosen before other effects were fitted (`is_preliminary`), and does not
          explain the data: the search is repeated with stiff friction, and tests the form only
          after effects have been fitted.

        Args:
            base: the fitted base model.

        Returns:
            The result of the last search. Its runs have the form of friction that was used.
        """
        runs = base.runs
        # Surrogates and bootstrap share one random stream, so that a seed gives the same result.
        rng = runs.make_rng()
        search = runs.create_search(base.fit, rng)
        if not runs.kind.has_model:
            return self._find_causes(base, search, rng)
        # This import is needed for robots only.
        from bench.diagnosis.prediction_error.dry_friction_fits import SoftFrictionError

        # 1. Stiff friction.
        try:
            return self._search_with_stiff_friction(base, search, rng)
        # 2. Soft friction.
        except SoftFrictionError as error:
            soft_result = self._search_with_soft_friction(base, search, error.start)
            # Its result counts, except one of a preliminary choice that explains nothing: then
            # stiff friction is tried again, if there is time left.
            if (
                not error.is_preliminary
                or soft_result.is_explained
                or runs.context.search_control.is_over()
            ):
                return soft_result
        # 3. Stiff friction again.
        return self._repeat_with_stiff_friction(base, search, soft_result, rng)

    def _search_with_stiff_friction(
        self, base: BaseModel, search: EffectSearch, rng: np.random.Generator
    ) -> SearchResult:
        """Search for causes, and compare the forms of dry friction that the search did not compare.

        Args:
            base: base model, fitted with stiff friction.
            search: search from this model.
            rng: random generator of the search.

        Returns:
            The result, or that of a search with soft friction if that form is likelier.

        Raises:
            SoftFrictionError: the search itself has found the soft form likelier.
        """
        runs = base.runs
        result = self._find_causes(base, search, rng)
        # The two forms still have to be compared for
        # 1. dry friction that is a free number of the model file: it is part of the base model, and
        #    the search compares the forms of friction effects only;
        has_free_friction = has_dry_friction(runs.fitting, ())
        # 2. effects with dry friction, if stiff friction nearly explains the runs: the search then
        #    compares nothing. This is needless if they are fully explained, or if the model stays
        #    incomplete, as its residual is far larger than the difference of the two forms.
        is_settled = result.is_explained or result.finding.is_incomplete
        compared_effects = () if is_settled else result.finding.model.effects
        is_comparison_needed = (
            has_dry_friction(runs.fitting, compared_effects)
            and not result.errors
            and not runs.context.search_control.is_over()
        )
        if not is_comparison_needed:
            return result
        # This import is needed for robots only.
        from bench.diagnosis.prediction_error.dry_friction_fits import refit_if_likelier_soft

        soft_model = refit_if_likelier_soft(
            search, result.finding.model, INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO
        )
        if soft_model is None:
            return result
        soft_result = self._search_with_soft_friction(base, search, soft_model.fit.make_start())
        # Friction of the model file is in every model, so that its likelier form is accepted. Soft
        # friction of an effect may only imitate what the model lacks, unless it explains the runs.
        if has_free_friction or soft_result.is_explained:
            return soft_result
        runs.context.say(STIFF_FRICTION)
        return result

    def _repeat_with_stiff_friction(
        self,
        base: BaseModel,
        first_search: EffectSearch,
        soft_result: SearchResult,
        rng: np.random.Generator,
    ) -> SearchResult:
        """Search again with stiff friction, after soft friction did not explain the data.

        The form of friction is tested only after effects have been fitted (`is_form_given`).

        Args:
            base: base model, fitted with stiff friction.
            first_search: first search with stiff friction, whose filters are reused.
            soft_result: result of the search with soft friction.
            rng: random generator of the search.

        Returns:
            The result of this search. If it finds the soft form likelier again, that of a further
            search with soft friction, or `soft_result` if that would begin with a model that was
            fitted already.
        """
        # This import is needed for robots only.
        from bench.diagnosis.prediction_error.dry_friction_fits import SoftFrictionError

        runs = base.runs
        runs.context.say(STIFF_FRICTION)
        stiff_search = runs.create_search(base.fit, rng, is_form_given=True)
        _take_over(stiff_search, first_search)
        try:
            return self._find_causes(base, stiff_search, rng)
        except SoftFrictionError as error:
            start = error.start
            # A further search would only repeat the one with soft friction if that has fitted its
            # first model already: the base model (no start), or the model of the start.
            if start is None or frozenset(start.effects) in soft_result.search.models:
                runs.context.say(SOFT_FRICTION)
                return soft_result
            return self._search_with_soft_friction(base, first_search, start)

    def _search_with_soft_friction(
        self, base: BaseModel, stiff_search: EffectSearch, likely: FitStart | None = None
    ) -> SearchResult:
        """Refit the base model with MuJoCo's soft dry friction, and search for causes again.

        Args:
            base: base model, fitted with stiff friction.
            stiff_search: search with stiff friction; its filters are reused where they are valid.
            likely: model that may explain the runs, which is fitted first; None without one.

        Returns:
            The result of the new search, whose runs have soft friction.
        """
        stiff_runs, context = base.runs, base.runs.context
        context.say(SOFT_FRICTION)
        soft_runs = stiff_runs.with_kind(make_soft_kind(stiff_runs.kind))
        # The gain on held-out runs refers to the prediction with the settings of the model file.
        runs = replace(soft_runs, before=stiff_runs.before)
        evaluator, fit = runs.fitting, base.fit
        # The fit continues with the fitted parameters, but from the initial states of the filter.
        start = replace(fit.fit.make_start(), initial_states=evaluator.initial_state_guesses)
        soft_base = BaseModel(runs, fit.refit(evaluator, runs.noise, start)).correct_step_errors()
        rng = runs.make_rng()
        search = runs.create_search(soft_base.fit, rng)
        # Filters are valid if the base model has no dry friction that changes its form. Friction of
        # the model file changes it only if it is a free number.
        has_same_base = not has_dry_friction(evaluator, ())
        _take_over(search, stiff_search, likely, has_same_base)
        return self._find_causes(soft_base, search, rng)

    def _find_causes(
        self, base: BaseModel, search: EffectSearch, rng: np.random.Generator
    ) -> SearchResult:
        """Search for causes; return a result without causes if a unit or sign is wrong.

        Every cause would only imitate the wrong unit or sign of the recording. Some of these errors
        are known before the search, others show in its result.

        Args:
            base: the fitted base model.
            search: search from this model.
            rng: random generator of the search.
        """
        check = self._error_check
        # 1. Search, unless an error is known already.
        if not check.errors:
            result = SearchResult(base, search, _search_and_decide(search, base.runs), rng)
            result = replace(result, finding=restrict_verdict(result))
            # This stores the errors that the result shows in `check.errors`.
            check.check_result(result)
            if not check.errors:
                return result
        # 2. A result without causes, with the errors. The base model takes the place of the found
        # one.
        model = search.base_model
        finding = DiagnosisResult("unknown", model, model, (), assess_lack_of_fit(search, model))
        return SearchResult(base, search, finding, rng, check.errors)


def _search_and_decide(search: EffectSearch, runs: SimulatedRuns) -> DiagnosisResult:
    """Run a search and select a verdict.

    For a robot whose runs could be filtered, the search uses prediction errors. Otherwise it is a
    search by simulation; for a robot in contact, effects at the contacts are tried first.

    Args:
        search: search that has not begun, with the fitted base model.
        runs: the runs, with their filters and their validation.
    """
    if runs.fitting.filtered_runs is None:
        if runs.fitting.is_in_contact:
            # This import is needed for robots only.
            from bench.diagnosis.search.contact_search import propose_contact_effects

            # A search that has to end early still gives its best model.
            with suppress(SearchStoppedError):
                propose_contact_effects(search, runs.evaluators)
        return diagnose(search, runs.validation)
    # This import is needed for robots only.
    from bench.diagnosis.prediction_error.robot_diagnosis import RobotDiagnosis

    with runs.record_widened_ranges():
        return run_diagnosis(RobotDiagnosis(search, runs.validation))


def _take_over(
    search: EffectSearch,
    other: EffectSearch,
    likely: FitStart | None = None,
    is_reusable: bool = True,
) -> None:
    """Reuse the filters of another search of the same base model, if both have any.

    Args:
        search: search that has not begun.
        other: search with another form of dry friction.
        likely: model that may explain the runs, which the search fits first; None without one.
        is_reusable: whether the base model has no dry friction, so that the filters are valid.
    """
    # This import is needed for robots only.
    from bench.diagnosis.prediction_error.prediction_error_search import PredictionErrorSearch

    # Only searches by prediction errors have filters.
    if isinstance(search, PredictionErrorSearch) and isinstance(other, PredictionErrorSearch):
        search.likely = likely
        if is_reusable:
            search.take_over(other)
