"""Diagnose a recording: search for causes, validate them on held-out runs, and select a verdict.

The questions are asked in order. Does anything move? Do the data determine the base parameters?
Which effects does the search find, and are they better than their competing models? Do held-out
runs confirm them? Which alternatives explain the data as well? Does the residual have structure?
The thresholds are in `bench.diagnosis.search.verdict_rules`.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from bench.diagnosis.evaluation.search_control import EarlyStop, SearchStoppedError
from bench.diagnosis.fitting.fitted_models import EffectNames, FittedModel
from bench.diagnosis.search import verdict_rules
from bench.diagnosis.search.alternative_causes import (
    AlternativeFinder,
    CauseEvidence,
    list_competing_models,
    refine_best_model,
    select_decisive,
    select_preferred_model,
)
from bench.diagnosis.search.effect_search import EffectSearch
from bench.diagnosis.search.held_out_model_choice import HeldOutValidation
from bench.diagnosis.search.lack_of_fit import (
    LackOfFitResult,
    assess_lack_of_fit,
    assess_residual_size,
)
from bench.diagnosis.search.subsampled_search import search_with_subsampling
from bench.diagnosis.search.verdict_rules import (
    DiagnosisState,
    VerdictName,
    decide_early_stop_verdict,
    decide_verdict,
)
from bench.diagnosis.validation.confidence_intervals import compute_covariance
from bench.diagnosis.validation.held_out_runs import HeldOutFit, Validation
from sims.core.simulator import Array

MAX_VALIDATED_SINGLES = 6
"""Number of best single-effect models that are evaluated on held-out runs, for display."""


@dataclass(frozen=True)
class DiagnosisResult:
    """Result of a diagnosis.

    Attributes:
        verdict: one of six verdicts.
        model: the extended model; the base model if no cause was found.
        base: the base model.
        causes: the causes, strongest first.
        lack_of_fit: lack-of-fit result of the extended model.
        unidentified_parameters: names of base parameters that the data do not determine.
        held_out_fits: models on held-out runs, by their effects; None if there are none.
        early_stop: early end of the search with its open questions; None if it was completed.
        is_incomplete: whether the model stays incomplete, so that its effects were identified
            without a search for the set that explains the recording.
    """

    verdict: VerdictName
    model: FittedModel
    base: FittedModel
    causes: tuple[CauseEvidence, ...]
    lack_of_fit: LackOfFitResult
    unidentified_parameters: tuple[str, ...] = ()
    held_out_fits: Mapping[EffectNames, HeldOutFit] | None = None
    early_stop: EarlyStop | None = None
    is_incomplete: bool = False


def diagnose(search: EffectSearch, held_out: Validation | None) -> DiagnosisResult:
    """Search, validate on held-out runs, collect alternatives, and select a verdict.

    Args:
        search: the search, which contains the fitted base model.
        held_out: held-out runs for validation; None if there are none.
    """
    return run_diagnosis(Diagnosis(search, held_out))


def run_diagnosis(diagnosis: Diagnosis) -> DiagnosisResult:
    """Run the complete diagnosis, or as many of its steps as the time limit allows."""
    try:
        return diagnosis.run()
    except SearchStoppedError:
        return diagnosis.build_early_result()


class Diagnosis:
    """The steps of a diagnosis, and their results so far.

    Attributes:
        alternative_finder: collects the evidence for each cause.
    """

    alternative_finder: type[AlternativeFinder] = AlternativeFinder

    def __init__(self, search: EffectSearch, held_out: Validation | None) -> None:
        """Start a diagnosis without results.

        `_held_out_validation` is the validation of the models on held-out runs, and `_model` the
        best model so far; both are None until their step is reached. They are kept so that a search
        that is stopped early can report what it found.

        Args:
            search: the search, which contains the fitted base model.
            held_out: predicts held-out runs, or each run by cross-validation; None if neither is
                possible.
        """
        self._search = search
        self._held_out = held_out
        self._search_control = search.evaluator.search_control
        self._held_out_validation: HeldOutValidation | None = None
        self._model: FittedModel | None = None

    def run(self) -> DiagnosisResult:
        """Return the result of the complete diagnosis.

        1. Stop if nothing moves, or the data do not determine the base model.
        2. Add effects to the base model while they explain more of the recording.
        3. Compare the best model with competing models of the same size.
        4. Drop effects that held-out runs do not confirm.
        5. Test the residual for structure. A thorough search may then accept a larger model.
        6. Find, for each cause, the alternatives that explain the data equally well.
        7. Select the verdict from these answers.

        Raises:
            SearchStoppedError: the search had to end early.
        """
        # Before each step, `begin_question` tells the search control which question is open. It
        # needs this for the progress display and after an early end.
        # 1. Base model.
        early_result = self.classify_unfit_base()
        if early_result is not None:
            return early_result
        search, base = self._search, self._search.base_model
        # 2. Search.
        self._search_control.begin_question("search")
        self._model = search_with_subsampling(search)
        # 3. Competing models.
        self._search_control.begin_question("rivals")
        self._model = search.simplify_laws(refine_best_model(search, self._model))
        self._model = search.fit_to_convergence(self._model)
        # Effects of the model that was fitted to convergence.
        converged_effects = self._model.effects
        # 4. Held-out runs.
        self._evaluate_on_held_out_runs()
        # 5. Structure.
        self._search_control.begin_question("structure")
        lack_of_fit = assess_lack_of_fit(search, self._model)
        if search.thorough and self._accept_larger_model(lack_of_fit):
            lack_of_fit = assess_lack_of_fit(search, self._model)
        # 6. Alternatives.
        self._search_control.begin_question("alternatives")
        model, causes = select_preferred_model(
            AlternativeFinder(search, self._held_out_validation, lack_of_fit.has_structure),
            self._model,
        )
        validation = self._held_out_validation
        # Steps 4 to 6 may have changed the effects since the fit to convergence.
        if model.effects != converged_effects:
            model = search.fit_to_convergence(model)
            if validation is not None:
                validation.evaluate_models([model])
        # 7. Verdict.
        self._search_control.check_not_stopped()
        state = DiagnosisState(
            cause_count=len(causes),
            has_alternatives=any(cause.alternatives for cause in causes),
            gap_closed=compute_gap_closed(search, model, lack_of_fit),
            is_unexplained=_is_unexplained(search, model, lack_of_fit),
            misses_held_out_gap=validation is not None
            and validation.has_unexplained_gap(model, lack_of_fit),
        )
        # Report the base model that was fitted first, even if the search found a better fit of it.
        return self._make_result(decide_verdict(state), base, model, causes, lack_of_fit)

    def classify_unfit_base(self) -> DiagnosisResult | None:
        """Return the result of the diagnosis if causes cannot be searched; None if they can.

        They cannot be searched if nothing moves, or if the data do not determine the base model:
        effects would then only compensate for parameters with arbitrary values.

        Raises:
            SearchStoppedError: the search had to end before the base model was fitted.
        """
        search = self._search
        # An unfinished base fit gives no information, not even about motion.
        if self._search_control.has_abandoned_fits():
            raise SearchStoppedError
        # Without motion, residual tests would only test rounding.
        if _shows_no_motion(search):
            return _build_motionless_result(search)
        base = search.base_model
        unidentified = find_unidentified_parameters(search, base)
        # Causes would represent values of parameters that the data do not determine.
        if unidentified:
            lack_of_fit = assess_lack_of_fit(search, base)
            return DiagnosisResult(
                verdict=decide_verdict(DiagnosisState(is_base_determined=False)),
                model=base,
                base=base,
                causes=(),
                lack_of_fit=lack_of_fit,
                unidentified_parameters=unidentified,
            )
        return None

    def _evaluate_on_held_out_runs(self) -> None:
        """Compare the model with competitors on held-out runs, and drop effects that do not help.

        The results are kept for the choice of alternatives and for the verdict. It does nothing if
        there are no held-out runs and too few runs for cross-validation.
        """
        if self._held_out is None or self._model is None:
            return
        self._search_control.begin_question("held_out")
        validation = _validate_on_held_out(self._search, self._model, self._held_out)
        # After an early stop, some fits of initial states are unfinished, so that their models
        # would seem to predict badly.
        self._search_control.check_not_stopped()
        self._held_out_validation = validation
        # The effects that remain after dropping an unhelpful one may have simpler forms.
        self._model = self._search.simplify_laws(
            validation.drop_unhelpful_effects(self._search, self._model)
        )

    def _accept_larger_model(self, lack_of_fit: LackOfFitResult) -> bool:
        """Replace the model by one with more effects if held-out runs confirm it.

        This is tried only if the residual has structure, that is, if the model lacks something.

        Returns:
            Whether the model was replaced.
        """
        model, validation, search = self._model, self._held_out_validation, self._search
        if (
            model is None
            or validation is None
            or not model.effects
            or not lack_of_fit.has_structure
        ):
            return False
        extension = validation.find_better_extension(search, model)
        if extension is model:
            return False
        self._model = search.simplify_laws(search.fit_to_convergence(extension))
        validation.evaluate_models([self._model])
        return True

    def build_early_result(self) -> DiagnosisResult:
        """Return the result of a search that had to end early, which claims only what was tested.

        Only existing fits and scores are used. Nothing is simulated except held-out runs, for which
        a part of the time limit was reserved.
        """
        search = self._search
        # It lists the questions of the diagnosis that stay open; one of them is validation, if
        # there are held-out runs.
        early_stop = self._search_control.make_early_stop(self._held_out is not None)
        model = self._model or search.get_best_so_far()
        # If the validation is stopped, too, the verdict does without it.
        if self._held_out_validation is None and self._held_out is not None and model.effects:
            validation = HeldOutValidation(self._held_out)
            with suppress(SearchStoppedError), self._search_control.use_reserve():
                validation.evaluate_models([search.base_model, model])
                self._search_control.check_not_stopped()
                self._held_out_validation = validation
        # The residual was not tested, so the verdict counts it as structure and not as noise
        # (p-value 0). The report shows only its size (p-value 1).
        lack_of_fit = replace(assess_residual_size(search, model), p_value=0.0)
        finder = self.alternative_finder(
            search, self._held_out_validation, structure=False, simulates=False
        )
        causes = finder.collect_evidence(model)
        gap_closed = compute_gap_closed(search, model, lack_of_fit)
        verdict = decide_early_stop_verdict(len(causes), gap_closed, early_stop.skipped_questions)
        result = self._make_result(
            verdict, search.base_model, model, causes, assess_residual_size(search, model)
        )
        return replace(result, early_stop=early_stop)

    def _make_result(
        self,
        verdict: VerdictName,
        base: FittedModel,
        model: FittedModel,
        causes: tuple[CauseEvidence, ...],
        lack_of_fit: LackOfFitResult,
    ) -> DiagnosisResult:
        """Bundle a verdict with its models, and with the held-out predictions if there are any.

        Args:
            verdict: name of the verdict.
            base: base model: the simulator without additional effects, fitted to the runs.
            model: the extended model; the base model if no cause was found.
            causes: evidence for the causes, strongest first.
            lack_of_fit: lack-of-fit result of the extended model.
        """
        held_out_fits = (
            self._held_out_validation.held_out_fits
            if self._held_out_validation is not None
            else None
        )
        return DiagnosisResult(
            verdict, model, base, causes, lack_of_fit, held_out_fits=held_out_fits
        )


def _shows_no_motion(search: EffectSearch) -> bool:
    """Return whether the recording shows no motion, and the base model expects none.

    Without motion the residual is only rounding, so the diagnosis ends before the search. The
    thresholds are in `verdict_rules.is_motionless`.
    """
    # Range of each channel (C,) over all runs and samples (R, T, C).
    observed = search.evaluator.observed
    ranges = np.nanmax(observed, axis=(0, 1)) - np.nanmin(observed, axis=(0, 1))
    # The base fit has fixed the parameters that do not influence the simulated runs. If these are
    # all base parameters, the model expects no motion either.
    is_model_sensitive = len(search.fixed_parameters) != search.evaluator.base_indices.size
    residual_sigma = search.base_model.likelihood.sigma
    return verdict_rules.is_motionless(
        ranges, residual_sigma, search.noise.sigma, is_model_sensitive
    )


def _build_motionless_result(search: EffectSearch) -> DiagnosisResult:
    """Return the verdict "unidentifiable" for a recording without motion.

    No base parameter can be determined, and no test of the residual is meaningful.
    """
    base, evaluator = search.base_model, search.evaluator
    return DiagnosisResult(
        verdict=decide_verdict(DiagnosisState(is_base_determined=False)),
        model=base,
        base=base,
        causes=(),
        # No force was tested, and nothing counts as structure.
        lack_of_fit=LackOfFitResult(
            p_value=1.0,
            where="",
            excess=base.likelihood.sigma / search.noise.sigma,
            channels_above_noise=(),
        ),
        unidentified_parameters=tuple(evaluator.parameters[i].name for i in evaluator.base_indices),
    )


def find_unidentified_parameters(search: EffectSearch, base: FittedModel) -> tuple[str, ...]:
    """Return the sensitive base parameters that the data do not determine, the worst first.

    A parameter is not determined if its standard deviation is too large a share of its plausible
    range. Parameters that do not influence the runs were fixed in the base fit, and are not tested.

    Args:
        search: search for causes, with its run evaluator, noise and fitted models.
        base: base model: the simulator without additional effects, fitted to the runs.

    Returns:
        Names of the parameters, in descending order of the ratio of standard deviation to range.
    """
    variances = np.diagonal(compute_covariance(search, base))
    # Rounding may make a variance slightly negative.
    deviations = np.sqrt(np.maximum(variances, 0.0))
    relative_deviations = {}
    for index, deviation in zip(base.fit.free_indices, deviations.tolist(), strict=True):
        parameter = search.evaluator.parameters[index]
        low, high = parameter.bounds
        if not verdict_rules.is_identified(deviation, low, high):
            relative_deviations[parameter.name] = deviation / (high - low)
    return tuple(sorted(relative_deviations, key=lambda name: -relative_deviations[name]))


def _validate_on_held_out(
    search: EffectSearch, model: FittedModel, held_out: Validation
) -> HeldOutValidation:
    """Predict held-out runs with all models that matter for the verdict.

    These are the base model, the result, models with a subset of its effects, models that explain
    the data nearly as well, and the best models with a single effect.

    Args:
        search: search with all fitted models.
        model: best model of the search.
        held_out: predicts held-out runs.
    """
    models = search.models.values()
    # Models with a subset of the effects are included, because effects that do not help on held-out
    # runs are dropped.
    names = set(model.effects)
    submodels = [m for m in models if set(m.effects) < names]
    singles = [m for m in models if len(m.effects) == 1]
    singles.sort(key=lambda m: -m.penalised_log_likelihood)
    competing_models = select_decisive(search, model, list_competing_models(search, model))
    validation = HeldOutValidation(held_out)
    # All models are evaluated together, so that initial states start from those of the nearest
    # model.
    validation.evaluate_models(
        [search.base_model, model, *competing_models, *submodels, *singles[:MAX_VALIDATED_SINGLES]]
    )
    return validation


def _is_unexplained(search: EffectSearch, model: FittedModel, lack_of_fit: LackOfFitResult) -> bool:
    """Return whether the model lacks something: structure in the residual, or a significant effect.

    A score test predicts the gain of each missing effect, to first order and without a fit. The
    p-value of the best one comes from an earlier test, or from one that is made here if the
    residual is above the noise and has no structure. Otherwise it counts as 1.

    Args:
        search: the search, with all fitted models.
        model: fitted model: its effects, parameters, initial states and likelihood.
        lack_of_fit: result of the lack-of-fit test.
    """
    p_value = search.best_p_values.get(frozenset(model.effects))
    # A model with a residual above the noise was not scored, because the search did not need it.
    if p_value is None:
        is_above_noise = not lack_of_fit.has_structure and not search.is_noise_like(model)
        p_value = search.score_missing_effects(model).p_value if is_above_noise else 1.0
    return verdict_rules.is_unexplained(lack_of_fit.has_structure, p_value)


def compute_gap_closed(
    search: EffectSearch, model: FittedModel, lack_of_fit: LackOfFitResult
) -> float:
    """Return the share of the discrepancy on the fitted runs that a model removes.

    With the RMS residuals b of the base model and a of this model, in units of the noise, it is (b
    - max(a, 1)) / (b - 1), or 0 if the base model leaves no discrepancy. If the residual of the
    model has no structure, it is noise, and replaces the noise floor where it is larger.

    Args:
        search: search for causes, with its run evaluator, noise and fitted models.
        model: the extended model.
        lack_of_fit: lack-of-fit test of the model, which tells whether its residual has structure.

    Returns:
        The share: 1 if the model leaves only noise, negative if it is worse than the base model.
    """
    noise = search.noise.sigma
    residual_sigma = model.likelihood.sigma
    # A residual without structure is noise, even if it exceeds an estimated noise floor. A channel
    # without samples has no residual.
    if not lack_of_fit.has_structure:
        noise = np.where(np.isfinite(residual_sigma), np.maximum(residual_sigma, noise), noise)
    before = _compute_normalised_rms(search, search.base_model, noise)
    after = _compute_normalised_rms(search, model, noise)
    # At the noise floor there is no discrepancy, and the quotient would be rounding error.
    if not before > 1.0 + 1e-9:
        return 0.0
    return (before - max(after, 1.0)) / (before - 1.0)


def _compute_normalised_rms(search: EffectSearch, model: FittedModel, noise: Array) -> float:
    """Return the RMS over all samples of a model's residual divided by the noise.

    Args:
        search: the search with the recorded runs.
        model: fitted model: its effects, parameters, initial states and likelihood.
        noise: (C,) standard deviation of each channel.
    """
    normalised_residual = search.compute_residual(model.fit) / noise
    squares = np.square(normalised_residual[search.observed_mask])
    return float(np.sqrt(squares.mean()))
