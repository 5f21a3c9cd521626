"""Alternative causes that explain the data as well as the effects found.

A model is compared with every model of the same size that shares all effects but one. The differing
effect is an alternative if that model is not worse by odds of 33 to 1, on fitted and held-out runs
together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.gap.causes.moves import NEARER
from bench.gap.causes.rules import behind_in_excess, is_alike, ratio_of
from bench.gap.causes.score_test import tail
from bench.gap.causes.search import Search
from bench.gap.causes.trial import Trial
from bench.gap.model.models import Model


@dataclass(frozen=True)
class Evidence:
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
class Alternatives:
    """Collects alternatives for the effects of a model.

    Attributes:
        search: the search, with every fitted model.
        trial: results on held-out runs; None if there are none.
        structure: whether the residual of the model has structure that no effect explains.
        simulates: False to use only existing fits and scores.
    """

    search: Search
    trial: Trial | None
    structure: bool
    simulates: bool = True

    def evidence(self, model: Model) -> tuple[Evidence, ...]:
        """Return the evidence for each effect of the model, strongest first."""
        effects = [self._evidence(model, name) for name in model.names]
        return tuple(sorted(effects, key=lambda evidence: -evidence.gain))

    def _evidence(self, model: Model, effect: str) -> Evidence:
        """Return the evidence for one effect of the model."""
        rest = self._rest(model, effect)
        gain = model.likelihood.value - rest.likelihood.value
        p_value = self._p_value(rest, effect, gain)
        rivals = self._rivals(model, effect)
        # Effects with implausible coefficients come last in their set.
        rivals.sort(key=lambda rival: (not self._is_plausible(rival[1]), rival))
        ordered = [name for _, name in rivals]
        alternatives = tuple(name for name in ordered if name != effect)
        # With structure in the residual, indistinguishable does not mean equally likely, so the
        # effect found is kept.
        preferred = effect if self.structure and effect in ordered else ordered[0]
        return Evidence(
            effect=effect,
            alternatives=alternatives,
            p_value=float(np.clip(p_value, 0.0, 1.0)),
            gain=float(gain),
            preferred=preferred,
        )

    def _rest(self, model: Model, effect: str) -> Model:
        """Return the model without the effect, or the base model if that would need a new fit."""
        if self.simulates:
            return self.search.without(model, effect)
        rest = frozenset(model.names) - {effect}
        return self.search.models.get(rest, self.search.base)

    def _p_value(self, rest: Model, effect: str, gain: float) -> float:
        """Return the p-value of a gain about the model without the effect.

        It is the smaller one of the p-values of the gain and of the best score.
        """
        search = self.search
        key = frozenset(rest.names)
        known = search.scored.get(key)
        if known is None and not self.simulates:
            return search.tests.get(key, 1.0)
        scores = known or search.scan(rest)
        chances = dict(zip(scores.effects, scores.chance.tolist(), strict=True))
        # A score is linear and the gain of a fit is not; either may be more sensitive.
        excess = gain - chances.get(effect, 0.0)
        by_refit = tail(scores.by_chance, np.array([excess]))
        by_score = search.tests.get(key, 1.0)
        return min(by_score, by_refit)

    def _rivals(self, model: Model, effect: str) -> list[tuple[float, str]]:
        """Return equivalent effects in place of the given one, with their distance."""
        shared = set(model.names) - {effect}
        rivals = [(0.0, effect)]
        for other in list(self.search.models.values()):
            names = set(other.names)
            same_size = len(names) == len(model.names)
            # Only a model that differs in this one effect shows what could replace it.
            if not same_size or not shared < names:
                continue
            (added,) = names - shared
            # Skip the model itself, and other fits of the same effects.
            if added == effect:
                continue
            behind = self._behind(model, other)
            if is_alike(behind) and not self._buys_nothing(effect, added, behind):
                rivals.append((behind, added))
        return self._without_richer(rivals)

    def _buys_nothing(self, effect: str, other: str, behind: float) -> bool:
        """Return whether another effect needs more coefficients without reducing the excess enough.

        If the residual has structure, likelihoods do not account for the number of coefficients.
        Each further coefficient must then reduce the excess as much as a richer law must.
        """
        if not self.structure:
            return False
        slots = self.search.world.slots
        mine, others = (int(slots[name].stop - slots[name].start) for name in (effect, other))
        further = others - mine
        return further > 0 and behind > further * behind_in_excess([NEARER])

    def _without_richer(self, rivals: list[tuple[float, str]]) -> list[tuple[float, str]]:
        """Return the rivals without those that contain another rival.

        These are families of which one member explains as much, and richer laws of which the
        simpler one does.
        """
        effects = self.search.world.effects
        names = {name for _, name in rivals}
        return [
            (behind, name) for behind, name in rivals if not names & set(effects[name].contains)
        ]

    def _behind(self, model: Model, other: Model) -> float:
        """Return the distance of another model in twice the log-likelihood.

        It is negative if the other model is better. If the residual has structure that neither
        model explains, likelihoods only compare how each model mimics it. The distance then depends
        on the excesses.
        """
        trial = self.trial
        # Held-out runs compare the models only if both were evaluated there.
        if trial is not None and not {model.names, other.names} <= trial.measured.keys():
            trial = None
        if self.structure:
            left = self.search.excess(other)
            ratios = [ratio_of(left, self.search.excess(model))]
            if trial is not None:
                left = trial.excess(other.names)
                ratios.append(ratio_of(left, trial.excess(model.names)))
            return behind_in_excess(ratios)
        behind = self._merit(model) - self._merit(other)
        # Held-out runs are further data, so their log-likelihoods are added.
        if trial is not None:
            mine = trial.measured[model.names]
            others = trial.measured[other.names]
            behind += mine.merit - others.merit
        return behind

    def _merit(self, model: Model) -> float:
        """Return the merit; for robots without the null-hypothesis penalty of single-shape effects.

        Two such effects differ, for example, only in a sign constraint: if all commands have the
        same sign, a dead band is equivalent to a bias.
        """
        world = self.search.world
        if not world.linear:
            return model.merit
        lucky = 0.0
        for name in model.names:
            parameters = world.parameters[world.slots[name]]
            if not any(parameter.bounds[0] > 0 for parameter in parameters):
                lucky += self.search.chance_of(name)
        return model.merit + lucky

    def _is_plausible(self, effect: str) -> bool:
        """Return whether the best fit with an effect has plausible coefficients."""
        world = self.search.world
        having = [m for m in self.search.models.values() if effect in m.names]
        if not having:
            return False
        best = max(having, key=lambda m: m.merit)
        parameters = world.parameters[world.slots[effect]]
        values = best.fit.theta[world.slots[effect]]
        for parameter, value in zip(parameters, values, strict=True):
            low, high = parameter.bounds
            if not low <= value <= high:
                return False
        return True
