"""Build the verdict from the result of a search: causes, held-out gain, ranked candidates."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from bench.diagnosis.dry_friction_form import add_solver_parameters, get_friction_form
from bench.diagnosis.experiment_design.discriminating_run import (
    DiscriminatingRun,
    propose_discriminating_run,
)
from bench.diagnosis.pipeline.held_out_gap_closed import (
    HeldOutGainCalculator,
    compute_held_out_excess,
)
from bench.diagnosis.pipeline.parameter_estimates import ParameterEstimates
from bench.diagnosis.pipeline.search_result import SearchResult
from bench.diagnosis.search import verdict_rules
from bench.diagnosis.search.alternative_causes import CauseEvidence
from bench.diagnosis.search.diagnose import DiagnosisResult
from bench.diagnosis.search.effect_search import EffectSearch
from bench.diagnosis.search.score_test import estimate_tail_p_value
from bench.diagnosis.verdict import Candidate, Cause, Verdict
from sims.robot.fitted_causes import GRAVITY_COMPENSATED, is_gravity_compensated


def build_verdict(result: SearchResult) -> Verdict:
    """Build the verdict from the result of a search.

    It has the causes with coefficients, the base parameters, the held-out gain, all candidates with
    their scores, and the proposed next experiment.

    Args:
        result: result of the search, with the runs, the fitted models and the finding.
    """
    runs, evaluator, finding = result.runs, result.runs.fitting, result.finding
    numbers = result.estimates.values
    causes = build_causes(result)
    gains = HeldOutGainCalculator(result)
    parameters = {evaluator.parameters[i].name: numbers[i] for i in evaluator.base_indices.tolist()}
    # They are counted here, because the simulations of the proposed experiment below are not part
    # of the answer.
    simulations = evaluator.simulation_count
    if runs.validation is not None:
        simulations += runs.validation.simulations
    heldout = gains.measure()
    candidates = _list_candidates(result.search, gains)
    next_run = _propose_next_run(result)
    return Verdict(
        verdict=finding.verdict,
        system=runs.recording.system,
        engine=runs.engine or "its own",
        causes=causes,
        parameters=parameters,
        heldout=heldout,
        candidates=candidates,
        next_experiment=next_run,
        simulations=int(simulations),
        seconds=time.perf_counter() - runs.context.started,
        cut=finding.early_stop,
        recording_faults=result.errors,
        recording_notes=runs.recording.notes,
    )


def build_causes(result: SearchResult) -> tuple[Cause, ...]:
    """Build the causes of the verdict: those found, with values and intervals of coefficients.

    Returns:
        One `Cause` of the verdict for each cause found, in the same order.
    """
    return tuple(_build_cause(result.estimates, cause) for cause in result.finding.causes)


def _build_cause(estimates: ParameterEstimates, evidence: CauseEvidence) -> Cause:
    """Build a cause of the verdict from an effect found by the search.

    It has the effect's description and fitted coefficients. The description names the soft form
    of dry friction (MuJoCo's `frictionloss`) with the solver parameters if the friction has it.

    Args:
        estimates: estimates of the found model.
        evidence: the effect and its evidence.
    """
    evaluator = estimates.search.evaluator
    effect = evaluator.available_effects[evidence.effect]
    # A coefficient that cannot be observed has the range from zero to zero, and is not a result.
    coefficients = effect.on(evaluator.simulator.system)
    fixed = {c.name for c in coefficients if c.least is not None and c.least == c.most}
    fitted_values = {
        name: number
        for name, number in estimates.select_coefficients(evidence.effect).items()
        if name not in fixed
    }
    friction_form = get_friction_form(evaluator, evidence.effect)
    description = effect.says
    if friction_form is not None:
        description = add_solver_parameters(evaluator, evidence.effect, description)
    if evaluator.kind.has_model and is_gravity_compensated(evidence.effect, fitted_values):
        description = GRAVITY_COMPENSATED
    return Cause(
        effect=evidence.effect,
        alternatives=evidence.alternatives,
        says=description,
        coefficients=fitted_values,
        p_value=evidence.p_value,
        form=friction_form,
    )


def restrict_verdict(result: SearchResult) -> DiagnosisResult:
    """Return the finding with the verdict that its numbers and the fitted models allow.

    1. A missing effect that only linear scores suggest, and that fits refute, does not count: the
       verdict becomes ``adequate``.
    2. The verdict becomes weaker if the data do not determine the coefficients of the causes.

    Args:
        result: result of the search, with the finding and the fitted models.
    """
    finding = result.finding
    if finding.verdict == "unknown" and _is_refuted(result):
        return replace(finding, verdict="adequate")
    unambiguous_causes = [cause.effect for cause in finding.causes if not cause.alternatives]
    are_results = _are_results(result.estimates, unambiguous_causes)
    return replace(finding, verdict=verdict_rules.verdict_of_numbers(finding.verdict, are_results))


def _are_results(estimates: ParameterEstimates, effects: Iterable[str]) -> bool:
    """Return whether the coefficients of effects are results, and no parameter is at a bound.

    A result has a finite interval. A base parameter at a bound of its range makes the answer False,
    because a cause may compensate for a value beyond the bound. The exception is a value at a bound
    that is a result nevertheless, such as zero at a physical limit.

    Args:
        estimates: estimates of the found model.
        effects: names of the effects.
    """
    evaluator = estimates.search.evaluator
    base_values = [estimates.values[i] for i in evaluator.base_indices.tolist()]
    indices = [i for name in effects for i in evaluator.get_coefficient_indices(name)]
    is_base_at_bound = any(v.at_bound is not None and not v.is_result for v in base_values)
    return all(estimates.values[i].is_result for i in indices) and not is_base_at_bound


def _is_refuted(result: SearchResult) -> bool:
    """Return whether fitted models refute a missing effect that only the linear score suggests.

    In closed loops and at rest, derivatives may predict a gain that no fit achieves. A missing
    effect is refuted if no model with effects is better than the base model on the fitted runs (by
    penalised log-likelihood) and also on the held-out runs, as far as it was evaluated there. It is
    not refuted if

    * the diagnosis has causes, or the search ended early;
    * the residual has structure, or held-out runs show a large discrepancy;
    * no model with effects was fitted.

    Args:
        result: result of the search; its models are fits by effects.
    """
    search, finding = result.search, result.finding
    if finding.causes or finding.lack_of_fit.has_structure or finding.early_stop is not None:
        return False
    extended_models = [model for model in search.models.values() if model.effects]
    better_effects = [
        model.effects
        for model in extended_models
        if model.penalised_log_likelihood > search.base_model.penalised_log_likelihood
    ]
    # RMS residual of the base model on the held-out runs, in units of the noise, less 1.
    excess = compute_held_out_excess(result)
    # The base model alone must leave no large gap on held-out runs. Without effects, the excess is
    # the same before and after.
    has_held_out_gap = excess is not None and verdict_rules.misses_held_out_gap(excess, excess)
    if not extended_models or has_held_out_gap:
        return False
    # A model that is better on the fitted runs must be worse on the held-out runs, and must have
    # been evaluated there. The base model has no effects, and the key ().
    held_out = finding.held_out_fits or {}
    return not any(
        names not in held_out
        or held_out[names].penalised_log_likelihood > held_out[()].penalised_log_likelihood
        for names in better_effects
    )


def _list_candidates(search: EffectSearch, gains: HeldOutGainCalculator) -> tuple[Candidate, ...]:
    """List all effects of the library with their scores about the base model, best first.

    The score is twice the gain in log-likelihood, by the linear score test or by a fit if that
    gains more. It is reduced by the price of each coefficient beyond the first, so that an effect
    precedes more general effects that contain it.

    Args:
        search: the search, with the scores about the base model.
        gains: gains of the prediction of held-out runs by single effects.
    """
    scores = search.base_scores
    if scores is None:
        return ()
    base = search.base_model.likelihood.value
    candidates = []
    for i, effect in enumerate(scores.effects):
        score = float(scores.score[i])
        # A fit may gain more than the linear score predicts, in particular far from the data.
        single_effect_model = search.models.get(frozenset({effect}))
        if single_effect_model is not None:
            score = max(score, float(single_effect_model.likelihood.value - base))
        # The p-value compares the score with those that surrogate data without any effect reach. An
        # effect with many shapes reaches higher ones, so the 90 % quantile of the surrogate scores
        # of the same effect is subtracted from each score first.
        score_above_null = np.array([score - scores.null_quantiles[i]])
        p_value = float(
            np.clip(estimate_tail_p_value(scores.null_scores, score_above_null), 0.0, 1.0)
        )
        share = gains.get_closed_share((effect,))
        coefficient_count = len(search.evaluator.get_coefficient_indices(effect))
        # This price only decides the order of the candidates, so the p-value does not have it.
        score -= search.parameter_penalty * (coefficient_count - 1)
        candidates.append(Candidate(effect, max(score, 0.0), p_value, share))
    return tuple(sorted(candidates, key=lambda candidate: -candidate.score))


def _propose_next_run(result: SearchResult) -> DiscriminatingRun | None:
    """Propose a run that distinguishes the strongest cause from its most plausible alternative.

    If the base model is not identifiable, the run should identify its parameters. Return None
    if no cause has alternatives, or if the search was stopped early.

    Args:
        result: result of the search.
    """
    search, finding = result.search, result.finding
    if finding.early_stop is not None:
        return None
    if finding.verdict == "unidentifiable":
        return _propose_identifying_run(finding.unidentified_parameters)
    competing_models = result.list_models_with_alternatives()
    if not competing_models:
        return None
    most_plausible, *_ = competing_models
    return propose_discriminating_run(search, finding.model, most_plausible)


def _propose_identifying_run(unidentified: tuple[str, ...]) -> DiscriminatingRun:
    """Propose how to identify parameters that the data do not identify."""
    has_several = len(unidentified) > 1
    condition_text = "their influences differ" if has_several else "it changes the motion"
    names = " and ".join(unidentified)
    return DiscriminatingRun(
        f"Measure {names} separately, or record runs in which {condition_text}"
    )
