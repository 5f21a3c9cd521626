"""Alternative causes: refits of competing models, and causes that explain the data as well.

The search tests few candidates about each model, and stops fits that fall behind. A diagnosed cause
must be compared with all competing models, each at its own optimum.

A model is compared with every model of the same size that shares all effects but one. The differing
effect is an alternative if that model is not worse by odds of 33 to 1, on fitted and held-out runs
together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.fitting.fitted_models import FittedModel, select_likeliest
from bench.diagnosis.search.effect_search import (
    FAR_EXCESS,
    MAX_RICHER_LAW_EXCESS_RATIO,
    EffectSearch,
)
from bench.diagnosis.search.fit_starts import generate_shifted_starts, make_swapped_start
from bench.diagnosis.search.held_out_model_choice import HeldOutValidation
from bench.diagnosis.search.lack_of_fit import assess_lack_of_fit
from bench.diagnosis.search.score_test import estimate_tail_p_value
from bench.diagnosis.search.scored_models import list_submodels
from bench.diagnosis.search.verdict_rules import (
    compute_excess_ratio,
    convert_excess_ratio,
    is_indistinguishable,
)

MAX_COMPETITOR_DISTANCE = 30.0
"""Maximum difference in penalised log-likelihood of competing models that are refitted."""
MAX_COMPETITOR_EXCESS_RATIO = 1.5
"""Maximum excess of refitted competing models, as a multiple of the excess of the model."""


def refine_best_model(search: EffectSearch, model: FittedModel) -> FittedModel:
    """Refit a model and its promising competitors of the same size, and return the best.

    The search stops fits early and tests few candidates, so another model may be better at its
    optimum.

    1. Replace single effects of the model by others that fit better.
    2. Fit neighbouring frequencies and event times, which have dozens of local minima.
    3. Select the competing models that are close enough to matter.
    4. Refit all of these to convergence.

    If the residual is noise, generalised least squares is used, weighted by an AR(1) model of this
    noise. If the residual has structure, ordinary least squares is used, because the structure is
    not noise and would distort the fit.

    Args:
        search: search with all models fitted so far; the refits are stored in it.
        model: best model of the search.

    Returns:
        The best of these models; with structure in the residual, the model of step 1, refitted.
    """
    effect_count = len(model.effects)
    # 1. Replaced effects.
    # A search on fewer samples may have compared this model (`settled_effects`) with all
    # replacements already.
    if search.settled_effects != frozenset(model.effects):
        model = _swap_each_effect(search, model)
    # 2. Neighbouring frequencies.
    neighbour_starts = list(generate_shifted_starts(search.evaluator, model.fit))
    # Only effects with many local minima, such as periodic ones, have such starts. Segments of the
    # runs have fewer minima, so that fits to them may find better models.
    if neighbour_starts:
        search.refit_from_segments(effect_count)
    # 3. Competing models.
    # The models without one of the effects are refitted, too: the gain of each effect is measured
    # from them.
    submodels = list_submodels(search, model)
    # None if the residual has structure.
    noise = _estimate_model_noise(search, model)
    competing_models = list_competing_models(search, model)
    if noise is None:
        competing_models = select_decisive(search, model, competing_models)
    # The result is the best of the compared models, each refitted in step 4. With structure in the
    # residual, likelihoods only tell which model mimics it best, so no competing model replaces the
    # model.
    compared_models = [model]
    if noise is not None:
        compared_models = [
            candidate
            for candidate in competing_models
            if abs(model.penalised_log_likelihood - candidate.penalised_log_likelihood)
            < MAX_COMPETITOR_DISTANCE
        ] or [model]
    # 4. Refits, from the own parameters of each model. Models that differ from the best one in one
    # effect are also fitted from the parameters of the best one.
    starts = [candidate.fit.make_start() for candidate in competing_models]
    starts += [candidate.fit.make_start() for candidate in submodels]
    starts += [
        make_swapped_start(search.evaluator, model, candidate)
        for candidate in compared_models
        if len(model.effects) > 1 and differ_in_one_effect(model, candidate)
    ]
    search.refit_models([*starts, *neighbour_starts], noise)
    # A refit that ends worse is not stored, so `models` contains the best fit of each model.
    refitted = [search.models[frozenset(candidate.effects)] for candidate in compared_models]
    return select_likeliest(*refitted)


def _swap_each_effect(search: EffectSearch, model: FittedModel) -> FittedModel:
    """Replace each effect by the other effects of the library, and return the best model.

    The library has all effects that may act on the system. Unlike `swap_effect`, which refits only
    a few candidates, there is no limit on their number: only effects whose score is far below the
    best one are left out. A cause is reported only if no other effect in its place explains the
    data better.

    Args:
        search: the search; the fitted models are added to it.
        model: the model whose effects are replaced.

    Returns:
        The best of the newly fitted models, or the given one if none is better.
    """
    size = len(model.effects)
    known_effect_sets = set(search.models)
    submodels = [search.remove_effect(model, name) for name in model.effects]
    # Each model without one effect is extended by the others; the fits are stored in `models`.
    # The second argument is the maximum number of candidates.
    search.refit_extensions(submodels, len(search.evaluator.library))
    best = model
    for effect_set, other_model in search.models.items():
        # The search has already compared the known models.
        if effect_set in known_effect_sets or len(effect_set) != size:
            continue
        if other_model.penalised_log_likelihood > best.penalised_log_likelihood:
            best = other_model
    return best


def differ_in_one_effect(model: FittedModel, other_model: FittedModel) -> bool:
    """Return whether models have as many effects, and all in common except one of each."""
    has_same_size = len(model.effects) == len(other_model.effects)
    return has_same_size and len(set(model.effects) - set(other_model.effects)) == 1


def list_competing_models(search: EffectSearch, model: FittedModel) -> list[FittedModel]:
    """Return models with as many effects that explain the data nearly as well, including the model.

    Args:
        search: the search, with all fitted models.
        model: the model to compare with.
    """
    size = len(model.effects)
    return [
        other_model
        for other_model in search.models.values()
        if len(other_model.effects) == size and _is_competitive(search, other_model, model)
    ]


def select_decisive(
    search: EffectSearch, model: FittedModel, competing_models: Sequence[FittedModel]
) -> list[FittedModel]:
    """Return the competing models whose comparison with a model can change the diagnosis.

    If the residual of the model is near the noise, these are all of them. Far from the noise, no
    competing model replaces the model; they only show alternatives to one of its effects. So those
    that differ in several effects are left out.

    Args:
        search: the search, with all fitted models.
        model: the model to compare with.
        competing_models: models with as many effects, from `list_competing_models`.
    """
    if search.compute_excess_residual(model) < FAR_EXCESS:
        return list(competing_models)
    names = set(model.effects)
    return [m for m in competing_models if len(names - set(m.effects)) <= 1]


def _is_competitive(search: EffectSearch, other_model: FittedModel, model: FittedModel) -> bool:
    """Return whether two models are close in penalised log-likelihood or in excess residual.

    The excess residual is the RMS residual in units of the noise, minus one; that of the other
    model must be below `MAX_COMPETITOR_EXCESS_RATIO` times that of the model. It is compared, too,
    because likelihoods are misleading if the residual has structure.

    Args:
        search: the search, which computes the residuals.
        other_model: fitted model that may compete.
        model: fitted model with which it is compared.
    """
    if (
        abs(model.penalised_log_likelihood - other_model.penalised_log_likelihood)
        < MAX_COMPETITOR_DISTANCE
    ):
        return True
    return search.compute_excess_residual(
        other_model
    ) < MAX_COMPETITOR_EXCESS_RATIO * search.compute_excess_residual(model)


def _estimate_model_noise(search: EffectSearch, model: FittedModel) -> NoiseModel | None:
    """Estimate the AR(1) noise of each channel from the residual of a model.

    Args:
        search: search for causes, which tests the residual for structure.
        model: fitted model, whose likelihood has sigma and correlation phi of its residual.

    Returns:
        The noise; None if the residual has structure, because it is then not noise.
    """
    if assess_lack_of_fit(search, model).has_structure:
        return None
    # The noise is a divisor, also where a model fits a channel exactly.
    sigma = np.maximum(model.likelihood.sigma, 1e-300)
    # Correlations are never negative, as in the score test.
    return NoiseModel(sigma, np.maximum(model.likelihood.phi, 0.0))


@dataclass(frozen=True)
class CauseEvidence:
    """An effect that was found, with its evidence.

    Attributes:
        effect: its name.
        alternatives: effects that explain the data as well, the most plausible first.
        p_value: p-value of its gain under the hypothesis that it is absent.
        gain: loss of twice the log-likelihood without it.
        preferred: effect to report for the set: the likeliest one, including held-out runs, among
            those with the most plausible coefficients.
    """

    effect: str
    alternatives: tuple[str, ...]
    p_value: float
    gain: float
    preferred: str = ""


class _Competitor(NamedTuple):
    """Effect that explains the data about as well as an effect of the model, in its place.

    Attributes:
        distance: how far its model is behind, in twice the log-likelihood.
        name: name of the effect.
    """

    distance: float
    name: str


@dataclass(frozen=True)
class AlternativeFinder:
    """Collects alternatives for the effects of a model.

    Attributes:
        search: the search, with every fitted model.
        held_out_validation: results on held-out runs; None if there are none.
        structure: whether the residual of the model has structure that no effect explains.
        simulates: False to use only existing fits and scores.
    """

    search: EffectSearch
    held_out_validation: HeldOutValidation | None
    structure: bool
    simulates: bool = True

    def collect_evidence(self, model: FittedModel) -> tuple[CauseEvidence, ...]:
        """Return the evidence for each effect of the model, the largest likelihood gain first."""
        effects = [self._measure_evidence(model, name) for name in model.effects]
        return tuple(sorted(effects, key=lambda evidence: -evidence.gain))

    def _measure_evidence(self, model: FittedModel, effect: str) -> CauseEvidence:
        """Return the p-value, the gain and the equally good alternatives of an effect.

        The gain is the increase of twice the log-likelihood over the model without the effect. An
        alternative is an effect that, in place of this one, explains the data equally well. Of
        these and the effect itself, the one with the most plausible coefficients is preferred,
        unless the residual has structure.

        Args:
            model: fitted model with the effect.
            effect: name of the effect, with its place on a robot: ``drag.linear@elbow``.
        """
        reduced_model = self._get_model_without(model, effect)
        gain = model.likelihood.value - reduced_model.likelihood.value
        p_value = self._compute_p_value(reduced_model, effect, gain)
        # The effect itself is included. Effects with implausible coefficients come last; of the
        # others, the one whose model explains the data best comes first.
        competing_effects = sorted(
            self._list_competing_effects(model, effect),
            key=lambda competitor: (self._compute_range_excess(competitor.name), competitor),
        )
        ordered_effects = [competitor.name for competitor in competing_effects]
        alternatives = tuple(name for name in ordered_effects if name != effect)
        # With structure in the residual, indistinguishable does not mean equally likely, so the
        # effect found is kept, unless a simpler effect that it contains explains as much.
        is_kept = self.structure and effect in ordered_effects
        preferred_effect = effect if is_kept else ordered_effects[0]
        return CauseEvidence(
            effect=effect,
            alternatives=alternatives,
            p_value=float(np.clip(p_value, 0.0, 1.0)),
            gain=float(gain),
            preferred=preferred_effect,
        )

    def _get_model_without(self, model: FittedModel, effect: str) -> FittedModel:
        """Return the model without the effect, against which the gain of the effect is measured.

        If no simulations are allowed and this model was not fitted, return the base model.

        Args:
            model: fitted model with the effect.
            effect: name of the effect that is removed.
        """
        if self.simulates:
            return self.search.remove_effect(model, effect)
        remaining_effects = frozenset(model.effects) - {effect}
        return self.search.models.get(remaining_effects, self.search.base_model)

    def _compute_p_value(self, reduced_model: FittedModel, effect: str, gain: float) -> float:
        """Return the p-value of an effect: how probable its gain is if the effect does not act.

        There are two tests, and the smaller p-value is returned, as either may be more sensitive:

        * the gain of the fit with the effect;
        * the linear score, which predicts gains without a fit.

        Both compare with surrogate residuals: random noise that contains no effect. Without scores
        about the reduced model, those about another model are used (`reference_scores`), or new
        ones. If the finder must not simulate (`simulates` is false) and there are no scores, only a
        stored p-value is used, or 1.

        Args:
            reduced_model: model without the effect.
            effect: name of the effect, with its place on a robot: ``drag.linear@elbow``.
            gain: gain of the model with the effect over the model without it, in twice the
                log-likelihood.
        """
        search = self.search
        # Models and their scores are stored by the set of their effects.
        key = frozenset(reduced_model.effects)
        stored_scores = search.scores_by_effects.get(key)
        if stored_scores is None and not self.simulates:
            return search.best_p_values.get(key, 1.0)
        scores = (
            stored_scores or search.reference_scores or search.score_missing_effects(reduced_model)
        )
        null_quantiles = dict(zip(scores.effects, scores.null_quantiles.tolist(), strict=True))
        # The gain minus what its effect gains from noise alone (90 % quantile) is compared with the
        # scores of the surrogates, from which this level is subtracted as well.
        excess = gain - null_quantiles.get(effect, 0.0)
        by_refit = estimate_tail_p_value(scores.null_scores, np.array([excess]))
        by_score = search.best_p_values.get(key, 1.0)
        return min(by_score, by_refit)

    def _list_competing_effects(self, model: FittedModel, effect: str) -> list[_Competitor]:
        """List the effects that explain the data as well as the given one, with their distance.

        The report names them, because the data do not tell which of them acts. A competing effect
        is tested by the fitted models in which it replaces the effect and everything else is equal.
        The distance is how far such a model is behind, in twice the log-likelihood; the effect
        itself has the distance 0.

        Args:
            model: fitted model with the effect.
            effect: name of the effect that another one may replace.
        """
        shared = set(model.effects) - {effect}
        competing_effects = [_Competitor(0.0, effect)]
        for other_model in list(self.search.models.values()):
            names = set(other_model.effects)
            has_same_size = len(names) == len(model.effects)
            # Only a model that differs in this one effect shows what could replace it.
            if not has_same_size or not shared < names:
                continue
            (added,) = names - shared
            # Skip the model itself, and other fits of the same effects.
            if added == effect:
                continue
            distance = self._compute_distance(
                model, other_model, self._act_in_one_loop(effect, added)
            )
            if is_indistinguishable(distance) and not self._wastes_coefficients(
                effect, added, distance
            ):
                competing_effects.append(_Competitor(distance, added))
        return self._remove_richer(competing_effects)

    def _wastes_coefficients(self, effect: str, other_effect: str, distance: float) -> bool:
        """Return whether another effect needs more coefficients but hardly fits better.

        This matters only if the residual has structure, because likelihoods then do not account for
        the number of coefficients. Each further coefficient must reduce the excess residual (RMS
        residual in units of the noise, minus one) as much as a richer law must, to the share
        `MAX_RICHER_LAW_EXCESS_RATIO`.

        Args:
            effect: effect of the model.
            other_effect: effect that would replace it.
            distance: how far the model with the other effect is behind, on the scale of twice the
                log-likelihood; negative if it fits better.
        """
        if not self.structure:
            return False
        coefficient_count, other_count = (
            len(self.search.evaluator.get_coefficient_indices(name))
            for name in (effect, other_effect)
        )
        further_count = other_count - coefficient_count
        # The logarithm of a ratio below one is negative, as the distance of a better model is.
        return further_count > 0 and distance > further_count * convert_excess_ratio(
            [MAX_RICHER_LAW_EXCESS_RATIO]
        )

    def _remove_richer(self, competing_effects: list[_Competitor]) -> list[_Competitor]:
        """Return the competing effects without those that contain another of them.

        These are families (one effect at several places) of which one member explains as much, and
        richer laws of which the simpler one does.

        Args:
            competing_effects: effects that explain the data about as well.
        """
        effects = self.search.evaluator.available_effects
        names = {competitor.name for competitor in competing_effects}
        # `contains` has the names of the simpler effects, or members, that an effect contains.
        return [
            competitor
            for competitor in competing_effects
            if names.isdisjoint(effects[competitor.name].contains)
        ]

    def _act_in_one_loop(self, effect: str, other_effect: str) -> bool:
        """Return whether two effects act at different joints of one closed kinematic chain (loop).

        Args:
            effect: name of one effect.
            other_effect: name of the other effect.
        """
        evaluator = self.search.evaluator
        # Index of the joint of each effect; a loop is a set of such indices.
        joints = {evaluator.available_effects[name].coordinate for name in (effect, other_effect)}
        return len(joints) == 2 and any(joints <= loop for loop in evaluator.simulator.system.loops)

    def _compute_distance(
        self, model: FittedModel, other_model: FittedModel, is_in_one_loop: bool
    ) -> float:
        """Return how far another model is behind, on the scale of twice the log-likelihood.

        It is negative if the other model is better.

        1. If the residual has structure that neither model explains, likelihoods only compare how
           each model mimics it. Then the distance depends on the excess residuals of the models.
        2. The same holds for effects at joints of one kinematic loop: likelihoods would compare the
           compliance of the loop's constraint, which is a setting of the simulator.
        3. Otherwise the distance is the difference of penalised log-likelihoods. Held-out runs are
           further data, so their log-likelihoods are added.

        Args:
            model: fitted model.
            other_model: fitted model in which another effect replaces one of the model.
            is_in_one_loop: whether the differing effects act in one kinematic loop.
        """
        validation = self.held_out_validation
        # Held-out runs compare the models only if both were evaluated there.
        if (
            validation is not None
            and not {model.effects, other_model.effects} <= validation.held_out_fits.keys()
        ):
            validation = None
        # 1 and 2. Excess residuals.
        if self.structure or is_in_one_loop:
            other_excess = self.search.compute_excess_residual(other_model)
            ratios = [
                compute_excess_ratio(other_excess, self.search.compute_excess_residual(model))
            ]
            if validation is not None:
                other_excess = validation.compute_excess_residual(other_model.effects)
                ratios.append(
                    compute_excess_ratio(
                        other_excess, validation.compute_excess_residual(model.effects)
                    )
                )
            return convert_excess_ratio(ratios)
        # 3. Likelihoods.
        distance = self._compute_comparable_likelihood(model) - self._compute_comparable_likelihood(
            other_model
        )
        # Held-out runs are further data, so their log-likelihoods are added.
        if validation is not None:
            held_out_fit = validation.held_out_fits[model.effects]
            other_held_out_fit = validation.held_out_fits[other_model.effects]
            distance += (
                held_out_fit.penalised_log_likelihood - other_held_out_fit.penalised_log_likelihood
            )
        return distance

    def _compute_comparable_likelihood(self, model: FittedModel) -> float:
        """Return the penalised log-likelihood by which competing models are compared.

        For robots, the penalty for what an effect gains from noise is left out, except for effects
        with many shapes. It may differ for equivalent effects: if all commands have the same sign,
        a dead band is equivalent to a bias, but its coefficient must be positive. The penalty must
        not decide between them.
        """
        evaluator = self.search.evaluator
        if not evaluator.has_linearisation:
            return model.penalised_log_likelihood
        null_penalties = 0.0
        for name in model.effects:
            parameters = evaluator.parameters[evaluator.coefficient_slices[name]]
            # Only a shape parameter, such as a frequency, has a positive lower bound.
            if not any(parameter.bounds[0] > 0 for parameter in parameters):
                null_penalties += self.search.get_effect_penalty(name)
        return model.penalised_log_likelihood + null_penalties

    def _compute_range_excess(self, effect: str) -> float:
        """Return how far the coefficients of an effect are outside their plausible ranges.

        Of indistinguishable effects, those with plausible coefficients are preferred. The
        coefficients are those of the likeliest model with the effect.

        Returns:
            The largest distance of a coefficient from the middle of its range, in half ranges; 1 if
            all are within their ranges, and infinity if no model with the effect was fitted.
        """
        evaluator = self.search.evaluator
        models_with_effect = [m for m in self.search.models.values() if effect in m.effects]
        if not models_with_effect:
            return float("inf")
        best = select_likeliest(*models_with_effect)
        parameters = evaluator.parameters[evaluator.coefficient_slices[effect]]
        values = best.fit.theta[evaluator.coefficient_slices[effect]].tolist()
        distances = [1.0]
        for parameter, value in zip(parameters, values, strict=True):
            low, high = parameter.bounds
            if not low <= value <= high:
                distances.append(2.0 * abs(value - 0.5 * (low + high)) / (high - low))
        return max(distances)


def select_preferred_model(
    finder: AlternativeFinder, model: FittedModel
) -> tuple[FittedModel, tuple[CauseEvidence, ...]]:
    """Replace each effect by the preferred one of its indistinguishable alternatives.

    Args:
        finder: finds the alternatives.
        model: the model found.

    Returns:
        The model with the preferred effects if it was fitted, else the given one, and the evidence
        for its effects.
    """
    causes = finder.collect_evidence(model)
    names = frozenset(cause.preferred for cause in causes)
    preferred_model = finder.search.models.get(names, model)
    if preferred_model is model:
        return model, causes
    return preferred_model, finder.collect_evidence(preferred_model)
