"""Alternative causes that explain the data as well as the effects found.

A model is compared with every model of the same size that shares all effects but one. The differing
effect is an alternative if that model is not worse by odds of 33 to 1, on fitted and held-out runs
together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.diagnosis.fitting.fitted_models import FittedModel
from bench.diagnosis.search.effect_search import EffectSearch
from bench.diagnosis.search.held_out_model_choice import HeldOutValidation
from bench.diagnosis.search.model_moves import MAX_RICHER_LAW_EXCESS_RATIO
from bench.diagnosis.search.score_test import estimate_tail_p_value
from bench.diagnosis.search.verdict_rules import (
    compute_excess_ratio,
    convert_excess_ratio,
    is_indistinguishable,
)


@dataclass(frozen=True)
class CauseEvidence:
    """An effect that was found, with its evidence.

    Attributes:
        effect: its name.
        alternatives: effects that explain the data as well, the most plausible first.
        p_value: p-value of its gain under the hypothesis that it is absent.
        gain: loss of twice the log-likelihood without it.
        preferred: effect to report for the set: the likeliest one, including held-out runs, among
            those with plausible coefficients.
    """

    effect: str
    alternatives: tuple[str, ...]
    p_value: float
    gain: float
    preferred: str = ""


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
        """Return p-value, gain and indistinguishable alternatives of one effect of the model.

        The gain is the increase of twice the log-likelihood over the model without the effect
        (`reduced_model`). `competing_effects` has pairs of distance and name, the effect itself
        included.
        """
        reduced_model = self._get_model_without(model, effect)
        gain = model.likelihood.value - reduced_model.likelihood.value
        p_value = self._compute_p_value(reduced_model, effect, gain)
        competing_effects = self._list_competing_effects(model, effect)
        # Effects with implausible coefficients come last in their set.
        competing_effects.sort(key=lambda pair: (not self._is_plausible(pair[1]), pair))
        ordered_effects = [name for _, name in competing_effects]
        alternatives = tuple(name for name in ordered_effects if name != effect)
        # With structure in the residual, indistinguishable does not mean equally likely, so the
        # effect found is kept.
        preferred_effect = (
            effect if self.structure and effect in ordered_effects else ordered_effects[0]
        )
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
        """
        if self.simulates:
            return self.search.remove_effect(model, effect)
        remaining_effects = frozenset(model.effects) - {effect}
        return self.search.models.get(remaining_effects, self.search.base_model)

    def _compute_p_value(self, reduced_model: FittedModel, effect: str, gain: float) -> float:
        """Return the p-value of a gain about the model without the effect.

        It is the smaller one of the p-values of the gain and of the best score.

        Args:
            reduced_model: the model without the effect.
            effect: name of the effect.
            gain: gain of the model with the effect over the model without it, in twice the
                log-likelihood.
        """
        search = self.search
        key = frozenset(reduced_model.effects)
        stored_scores = search.scores_by_effects.get(key)
        if stored_scores is None and not self.simulates:
            return search.best_p_values.get(key, 1.0)
        scores = (
            stored_scores or search.reference_scores or search.score_missing_effects(reduced_model)
        )
        null_quantiles = dict(zip(scores.effects, scores.null_quantiles.tolist(), strict=True))
        # A score is linear and the gain of a fit is not; either may be more sensitive.
        excess = gain - null_quantiles.get(effect, 0.0)
        by_refit = estimate_tail_p_value(scores.null_scores, np.array([excess]))
        by_score = search.best_p_values.get(key, 1.0)
        return min(by_score, by_refit)

    def _list_competing_effects(self, model: FittedModel, effect: str) -> list[tuple[float, str]]:
        """List the effects that explain the data as well as the given one, with their distance.

        A competing effect is tested by the fitted models in which it replaces the effect and
        everything else is equal. The distance is how far such a model is behind, in twice the
        log-likelihood; the effect itself has the distance 0.
        """
        shared = set(model.effects) - {effect}
        competing_effects = [(0.0, effect)]
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
                competing_effects.append((distance, added))
        return self._remove_richer(competing_effects)

    def _wastes_coefficients(self, effect: str, other_effect: str, distance: float) -> bool:
        """Return whether another effect needs more coefficients but hardly fits better.

        If the residual has structure, likelihoods do not account for the number of coefficients.
        Each further coefficient must then reduce the excess residual (RMS residual in units of the
        noise, minus one) as much as a richer law must. `distance` is how far the other model is
        behind, in twice the log-likelihood.
        """
        if not self.structure:
            return False
        slots = self.search.evaluator.coefficient_slices
        coefficient_count, other_count = (
            int(slots[name].stop - slots[name].start) for name in (effect, other_effect)
        )
        further_count = other_count - coefficient_count
        return further_count > 0 and distance > further_count * convert_excess_ratio(
            [MAX_RICHER_LAW_EXCESS_RATIO]
        )

    def _remove_richer(self, competing_effects: list[tuple[float, str]]) -> list[tuple[float, str]]:
        """Return the competing effects without those that contain another of them.

        These are families of which one member explains as much, and richer laws of which the
        simpler one does.
        """
        effects = self.search.evaluator.available_effects
        names = {name for _, name in competing_effects}
        return [
            (distance, name)
            for distance, name in competing_effects
            if not names & set(effects[name].contains)
        ]

    def _act_in_one_loop(self, effect: str, other_effect: str) -> bool:
        """Return whether two effects act at different joints of one kinematic loop.

        Args:
            effect: name of one effect.
            other_effect: name of the other effect.
        """
        evaluator = self.search.evaluator
        joints = {evaluator.available_effects[name].coordinate for name in (effect, other_effect)}
        return len(joints) == 2 and any(joints <= loop for loop in evaluator.simulator.system.loops)

    def _compute_distance(
        self, model: FittedModel, other_model: FittedModel, is_in_one_loop: bool
    ) -> float:
        """Return the distance of another model in twice the log-likelihood.

        It is negative if the other model is better. If the residual has structure that neither
        model explains, likelihoods only compare how each model mimics it. The distance then depends
        on the excesses. So it does for models that differ in the joint of a loop at which an effect
        acts: likelihoods would compare how the constraint that closes the loop gives way, which is
        a number of the simulation.

        Args:
            model: the model.
            other_model: the model that it is compared with.
            is_in_one_loop: whether the differing effects act in one kinematic loop.
        """
        validation = self.held_out_validation
        # Held-out runs compare the models only if both were evaluated there.
        if (
            validation is not None
            and not {model.effects, other_model.effects} <= validation.held_out_fits.keys()
        ):
            validation = None
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
        """Return the merit; for robots without the null-hypothesis penalty of single-shape effects.

        Two such effects differ, for example, only in a sign constraint: if all commands have the
        same sign, a dead band is equivalent to a bias.
        """
        evaluator = self.search.evaluator
        if not evaluator.has_linearisation:
            return model.penalised_log_likelihood
        null_penalties = 0.0
        for name in model.effects:
            parameters = evaluator.parameters[evaluator.coefficient_slices[name]]
            if not any(parameter.bounds[0] > 0 for parameter in parameters):
                null_penalties += self.search.get_effect_penalty(name)
        return model.penalised_log_likelihood + null_penalties

    def _is_plausible(self, effect: str) -> bool:
        """Return whether the best fit of an effect has coefficients in their plausible ranges.

        The best fit is the model with the effect that has the highest penalised log-likelihood.
        """
        evaluator = self.search.evaluator
        models_with_effect = [m for m in self.search.models.values() if effect in m.effects]
        if not models_with_effect:
            return False
        best = max(models_with_effect, key=lambda m: m.penalised_log_likelihood)
        parameters = evaluator.parameters[evaluator.coefficient_slices[effect]]
        values = best.fit.theta[evaluator.coefficient_slices[effect]]
        for parameter, value in zip(parameters, values, strict=True):
            low, high = parameter.bounds
            if not low <= value <= high:
                return False
        return True
