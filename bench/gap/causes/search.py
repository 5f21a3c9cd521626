"""Finds the effects that explain a recording: linear scores nominate, simulation decides, moves
correct.

Forward selection alone is not enough: where two effects act, the first pick is often a third one
that mimics both. So several models are carried along (a beam search), and each larger model is
compared with those that lack or replace one of its effects (A. Miller, Subset Selection in
Regression, 2nd ed., 2002, doi:10.1201/9781420035933, chapter 3).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from bench.gap.causes.candidates import Directions, directions
from bench.gap.causes.nominate import nominated
from bench.gap.causes.score_test import Scores, score, tail
from bench.gap.model.fit import Start
from bench.gap.model.models import Model, Models
from bench.gap.model.multiple_shooting import pieces, whole
from bench.gap.model.noise import forgets, surrogates
from sims.base import Array

SURROGATES = 120
ALPHA = 0.003
"""Chance at which an effect would be taken for real although nothing is missing."""
CERTAIN = 1e-6
"""A chance below which surrogates of another colour are not asked."""
UNLIKELY, DOUBTFUL = 0.1, 0.015
"""Chance of the linear scores above which no effect, or no further one, is tried by simulation."""
LOUD, FORGOT = 1.3, 0.01
"""What is left that exceeds the noise floor by more is looked into by simulation whatever the
scores say; but for an estimated floor, where the chance that it is first-order noise is above the
second."""
MOST_EFFECTS = 3
NOMINATED = 7
MOVES = 2
FAR = 0.5
"""Excess over the noise above which the search looks further ahead."""
HOPELESS = 0.5
"""Share of the base model's excess that two effects leave where a third is not worth a try."""
IDLE = 0.85
"""The same, of the excess that the best single effect leaves: what is left is then nothing that the
library knows.
"""
CLEARLY = 0.5
"""Share of the excess over the noise to which other effects must bring a model to take the place of
fewer.
"""
SKETCHED, TRANSFERRED = 2, 5
"""Models of at most so many effects are sought over short pieces; so many of the best are fitted to
the whole runs.
"""
BEAM, NEAREST = 3, 2
RIVAL = 0.5
"""A model goes on in the beam if it has at least this share of the best one's gain."""
SWITCH = 7.0
"""Twice the log likelihood by which two models must differ to be told apart: odds of 33 to 1."""


@dataclass
class Search(Models):
    """The search, and what has been scored about the models on its way."""

    scanned: dict[frozenset[str], tuple[Directions, Scores]] = field(default_factory=dict)
    tests: dict[frozenset[str], float] = field(default_factory=dict)
    _lessened: set[frozenset[str]] = field(default_factory=set)
    _sketch: Search | None = None

    def replaced(self, key: frozenset[str]) -> None:
        """What was scored about the model before holds no longer."""
        self.scanned.pop(key, None)

    def scan(self, model: Model, against: Array | None = None) -> Scores:
        """Score every effect that the model lacks.

        Args:
            model: about which.
            against: (R, T, C) a residual for surrogates; the model's own if None.
        """
        key = frozenset(model.names)
        if key not in self.scanned:
            held = {*key, *(part for name in key for part in self.world.effects[name].contains)}
            lacking = [name for name in self.world.library if name not in held]
            self.scanned[key] = (directions(self.world, model.fit, lacking), _NOTHING)
        found, scores = self.scanned[key]
        if against is None and scores is not _NOTHING:
            return scores
        residual = self.residual(model.fit)
        like = surrogates(residual if against is None else against, self.seen, SURROGATES, self.rng)
        scores = score(model.fit, residual, found, self.seen, self.weights(model), like)
        self.scanned[key] = (found, scores)
        self.tests[key] = scores.p_value
        if (
            not key and not self.chances
        ):  # kept, so that merits stay comparable when a better base fit turns up
            self.chances = dict(zip(scores.effects, scores.chance.tolist(), strict=True))
        return scores

    def extend(self, beam: Iterable[Model], most: int, patient: bool = False) -> None:
        """Refit the most promising extensions of some models; those that are known already only
        with patience.
        """
        starts = []
        for model in beam:
            key = frozenset(model.names)
            scores = self.scanned[key][1] if key in self.scanned else self.scan(model)
            start = self.models[key]
            found = nominated(
                self.world, self.noise, start, self.scanned[key][0], scores, most, patient
            )
            starts += [s for s in found if patient or frozenset(s.effects) not in self.models]
        if starts:
            self.refit(starts, patient=patient)

    def missing(self, model: Model, larger: Model) -> float:
        """Probability that a model which lacks nothing would seem to gain as much by becoming the
        larger one.

        The surrogates have the colour of what the larger model leaves, which is closer to the noise
        alone.
        """
        gain = larger.likelihood.value - model.likelihood.value
        model = self.models[frozenset(model.names)]
        scores = self.scan(model)
        if (first := self._gained(scores, larger, gain)) < CERTAIN:
            return first
        scores = self.scan(model, self.residual(larger.fit))
        return min(scores.p_value, self._gained(scores, larger, gain))

    def _gained(self, scores: Scores, larger: Model, gain: float) -> float:
        """Chance of a gain in twice the log likelihood, less what chance gives the larger model's
        effects.
        """
        chance = dict(zip(scores.effects, scores.chance.tolist(), strict=True))
        return tail(
            scores.by_chance,
            np.array([gain - max((chance.get(n, 0.0) for n in larger.names), default=0.0)]),
        )

    def plain(self, model: Model, doubt: float) -> bool:
        """Whether nothing suggests that the model lacks something: neither a score nor the size of
        what it leaves.
        """
        return self.scan(model).p_value > doubt and self._quiet(model)

    def _quiet(self, model: Model) -> bool:
        """Whether what a model leaves may be noise: as small as the floor, or larger where the
        floor is an estimate.

        The floor is estimated as if noise forgot itself; what is left may exceed it if it is of
        first order.
        """
        loud = np.nan_to_num(model.likelihood.sigma, nan=np.inf) >= LOUD * self.noise.sigma
        if not loud.any():
            return True
        if (loud & self.stated).any():
            return False
        return forgets(self.residual(model.fit), self.seen, model.likelihood) > FORGOT

    def without(self, model: Model, name: str) -> Model:
        """The model with one of its effects taken away."""
        rest = frozenset(n for n in model.names if n != name)
        if rest not in self.models:
            self._lessen(model, [name])
        return self.models[rest]

    def _lessen(self, model: Model, names: Iterable[str]) -> None:
        """Fit the model without each of these effects, from where it stands itself."""
        starts = []
        for name in names:
            theta = model.fit.theta.copy()
            theta[self.world.slots[name]] = 0.0
            starts.append(
                Start(tuple(n for n in model.names if n != name), theta, model.fit.states)
            )
        self.refit(starts)

    def drop(self, model: Model) -> Model:
        """The model without effects that it does not need; each smaller one is fitted from here,
        known or not.
        """
        if len(model.names) > 1 and frozenset(model.names) not in self._lessened:
            self._lessened.add(frozenset(model.names))
            self._lessen(model, model.names)
        for name in model.names:
            smaller = self.without(model, name)
            if smaller.merit >= model.merit:
                return self.drop(smaller)
        return model

    def swap(self, model: Model) -> Model:
        """The best model that has one effect replaced."""
        for _ in range(MOVES):
            self.extend([self.without(model, name) for name in model.names], NOMINATED)
            better = self.best(len(model.names))
            if better is None or better.merit <= model.merit + 1e-6:
                break
            model = self.drop(better)
        return model

    def run(self) -> Model:
        """The model of all effects that the data show.

        While much is left to explain the search goes on although no step of it pays by itself: of
        two effects that only together come near the data neither is worth much alone.
        """
        best = self.models[frozenset()]
        for size in range(1, MOST_EFFECTS + 1):
            if self.plain(best, DOUBTFUL if best.names else UNLIKELY):
                break
            larger = self._grown(size)
            if larger is None:
                break
            if size == 1:
                larger = self._simpler(larger)
            else:
                larger = self._conservative(best, self.drop(self.swap(self.drop(larger))))
            if larger.merit > best.merit and self.missing(best, larger) <= ALPHA:
                best = larger
            elif self.excess(best) < FAR or self._quiet(best):
                break
            if size > 1 and self._hopeless(larger):
                break
        return best

    def _hopeless(self, larger: Model) -> bool:
        """Whether a model of several effects is so far from the data that one more is not worth a
        try.
        """
        singles = [self.excess(m) for m in self.models.values() if len(m.names) == 1]
        before = self.excess(self.models[frozenset()])
        return self.excess(larger) > min(HOPELESS * before, IDLE * min(singles, default=np.inf))

    def _grown(self, size: int) -> Model | None:
        """The best model of so many effects: from the best smaller one, then from its rivals, or
        with patience.
        """
        beam = self._beam(size - 1)
        self.extend(beam[:1], NOMINATED)
        first = self.best(size)
        if first is not None and self.plain(first, ALPHA):
            return first
        self.from_pieces(size)
        first = self.best(size)
        if first is not None and self.plain(first, ALPHA):
            return first
        if size == 1:
            self.extend(beam, NOMINATED, patient=True)
        else:
            self.extend(beam[1:], NOMINATED)
        return self.best(size)

    def from_pieces(self, size: int) -> None:
        """Refit the models of so many effects that explain short pieces of the runs best."""
        if size > SKETCHED or (cut := pieces(self.world)) is None:
            return
        if self._sketch is None:
            base = self.models[frozenset()].fit
            self._sketch = Search(cut, self.noise, self.frozen, self.rng, self.stated)
            self._sketch.refit([Start((), base.theta, cut.guess)])
        sketch = self._sketch
        sketch.extend(sketch._beam(size - 1), NOMINATED)
        found = sorted(
            (m for m in sketch.models.values() if len(m.names) == size), key=lambda m: -m.merit
        )
        self.refit([whole(self.world, m.fit) for m in found[:TRANSFERRED]])

    def _simpler(self, single: Model) -> Model:
        """The effect that the single one contains, where structure is left to which the rest of it
        may have bent.
        """
        if self.plain(single, ALPHA):
            return single
        held = self.world.effects[single.names[0]].contains
        there = [
            self.models[frozenset([name])] for name in held if frozenset([name]) in self.models
        ]
        return next((m for m in there if self.excess(single) > CLEARLY * self.excess(m)), single)

    def _conservative(self, best: Model, larger: Model) -> Model:
        """The larger model, unless it puts other effects in place of the best one's and is hardly
        nearer to the noise.

        Two effects mimic many a third; where neither account reaches the noise, the shorter one is
        built upon.
        """
        if set(best.names) <= set(larger.names) or self.excess(larger) < CLEARLY * self.excess(
            best
        ):
            return larger
        there = [
            m
            for m in self.models.values()
            if set(best.names) < set(m.names) and m.merit > best.merit
        ]
        return max(
            (m for m in there if len(m.names) == len(best.names) + 1),
            key=lambda m: m.merit,
            default=best,
        )

    def _beam(self, size: int) -> list[Model]:
        """Models of so many effects to go on from: those of the most merit, and those that come
        nearest to the data.
        """
        there = sorted(
            (m for m in self.models.values() if len(m.names) == size), key=lambda m: -m.merit
        )
        base = self.models[frozenset()].merit
        if not size or not there:
            return there
        rivals = [m for m in there if m.merit - base >= RIVAL * (there[0].merit - base)][:BEAM]
        return rivals + [
            m for m in sorted(there, key=lambda m: m.fit.cost)[:NEAREST] if m not in rivals
        ]


_NOTHING = Scores((), np.zeros(0), np.zeros(0), (), 1.0, 0.0, np.zeros((0, 0)), np.zeros(0))
