"""What the models of a recording seem to lack: each scored against the whole library, once.

A model is scored by a linear test (`bench.gap.causes.score_test`); whether it lacks something is
then asked of that score and of the size of what it leaves.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from bench.gap.causes.candidates import Directions, directions
from bench.gap.causes.nominate import nominated
from bench.gap.causes.score_test import Scores, ScoreTest, calibrated, tail
from bench.gap.model.models import Model, Models
from bench.gap.model.noise import Mask, Noise, forgets
from bench.gap.model.problem import Fit, Start
from bench.gap.model.surrogates import surrogates
from bench.gap.model.world import World
from sims.base import Array

SURROGATES = 120
"""Residuals that mean nothing, drawn to calibrate the scores about one model."""
CERTAIN = 1e-6
"""A chance below which surrogates of another colour are not asked."""
LOUD = 1.3
"""What is left that exceeds the noise floor by this factor is looked into by simulation, whatever
the scores say.
"""
FORGOT = 0.01
"""But not over an estimated floor, where the chance that all of it is first-order noise is above
this.
"""

HELD = 400e6
"""Bytes of directions that are held besides the base model's; what was scored longest ago makes
room, and is scored again in the rare case that somebody asks for it once more.
"""
SILENT = 0.02
"""Excess over the noise below which nothing richer is fitted before something asks for it."""
CAUGHT = 1.0
"""In twice the log likelihood, what a model may be behind one that it contains."""
UNMOVED = 0.1
"""A fit that has moved by less than so many sigmas, RMS, since its directions were simulated keeps
them: they are derivatives, and have changed by as little.
"""


class Scanned(NamedTuple):
    """What each effect would change about a model, the test of that, and its scores; the
    directions are those at a fit.
    """

    at: Fit
    directions: Directions
    test: ScoreTest
    scores: Scores


@dataclass
class Scored(Models):
    """Models, and what has been scored about them.

    Attributes:
        scored: of each model that was, by its effects, the scores.
        scanned: of the base model and those that were scored last, all of it.
        tests: the p value of the best score about each, by its effects.
        former: what was scored about models that have been fitted better since.
    """

    scored: dict[frozenset[str], Scores] = field(default_factory=dict)
    scanned: dict[frozenset[str], Scanned] = field(default_factory=dict)
    tests: dict[frozenset[str], float] = field(default_factory=dict)
    former: dict[frozenset[str], Scanned] = field(default_factory=dict)

    @property
    def base(self) -> Model:
        """The model without any effect."""
        return self.models[frozenset()]

    @property
    def about_base(self) -> Scores | None:
        """What was scored about it, or about the one before a better fit was found; None where
        nothing was.
        """
        key: frozenset[str] = frozenset()
        if key in self.scored or key not in self.former:
            return self.scored.get(key)
        return self.former[key].scores

    def directions_known(self) -> tuple[Fit, Directions] | None:
        """Return what every candidate changes about the base model's runs; None where it has not
        been found beside the scores.
        """
        return None

    def replaced(self, key: frozenset[str]) -> None:
        """What was scored about the model before holds no longer."""
        self.scored.pop(key, None)
        if key in self.scanned:
            self.former[key] = self.scanned.pop(key)

    def scan(self, model: Model, against: Array | None = None) -> Scores:
        """Score every effect that the model lacks.

        Args:
            model: about which.
            against: (R, T, C) a residual for surrogates; the model's own if None.
        """
        key = frozenset(model.names)
        if key not in (self.scored if against is None else self.scanned):
            self._survey([model])
        if against is None:
            return self.scored[key]
        known = self.scanned[key]
        self._look(model)
        # Directions cost a simulation of each candidate; other surrogates need no new ones. The
        # colour of noise is best known from a model that leaves less structure.
        residual = self.residual(model.fit)
        stream = self.drawing("library", model.names)
        scores = _scored(known.test, residual, against, self.seen, stream)
        self._take(key, known._replace(scores=scores))
        return scores

    def _survey(self, models: Sequence[Model], beside: Sequence[Model] = ()) -> None:
        """Score every effect that models lack, each for itself; what is known of those beside them
        is held.
        """
        calls, keys = [], []
        for model in models:
            self._look(model)
            model = self.exact(model)
            key = frozenset(model.names)
            residual, stream = self.residual(model.fit), self.drawing("library", model.names)
            former = self.former.pop(key, None)
            # What has hardly moved keeps its directions, which nobody else has.
            if former is not None and self._moved(former.at, model.fit) < UNMOVED:
                scores = _scored(former.test, residual, residual, self.seen, stream)
                self._take(key, former._replace(scores=scores))
                continue
            keys.append(key)
            calls.append(
                (model.fit, self._lacking(model), self.weights(model), residual, self.seen, stream)
            )
        if calls:
            most = max(len(lacking) for _, lacking, *_ in calls)
            several = f" beside {len(calls)} models" if len(calls) > 1 else ""
            self.world.watch.stage(f"testing {most} effects{several}", len(calls))
        found = {}
        for number, scanned in self.world.crew.each(self.world, _scanned, calls):
            found[number] = scanned
            self.world.watch.advance()
        for number, key in enumerate(keys):
            scores = self.scored.get(key, found[number].scores)
            # What had made room is as it was.
            self._take(key, found[number]._replace(scores=scores))
        self._make_room([*keys, *(frozenset(model.names) for model in beside)])

    def _look(self, model: Model) -> None:
        about = " + ".join(model.names) or "the base model"
        self.world.watch.look(f"scores of the library about {about}")

    def _make_room(self, asked: Sequence[frozenset[str]]) -> None:
        """Let go what was scored longest ago, but for the base model and what is asked now."""
        for kept in (self.former, self.scanned):
            for key in [k for k in kept if k and k not in asked]:
                held = [*self.former.items(), *self.scanned.items()]
                if sum(one.directions.values.nbytes for k, one in held if k) <= HELD:
                    return
                del kept[key]

    def _take(self, key: frozenset[str], scanned: Scanned) -> None:
        # The last stands behind the others.
        self.scanned.pop(key, None)
        self.scanned[key] = scanned
        self.enter_scores(key, scanned.scores)

    def enter_scores(self, key: frozenset[str], scores: Scores) -> None:
        """Take the scores about a model, by its effects, into account."""
        self.scored[key] = scores
        self.tests[key] = scores.p_value
        # Kept from the first scan, so that merits stay comparable when a better base fit turns up.
        if not key and not self.chances:
            self.chances = dict(zip(scores.effects, scores.chance.tolist(), strict=True))

    def _moved(self, one: Fit, other: Fit) -> float:
        """How far two fits are apart where samples are, in sigmas, RMS."""
        apart = (one.simulated - other.simulated) / self.noise.sigma
        return float(np.sqrt(np.square(apart[self.seen]).mean()))

    def _lacking(self, model: Model) -> list[str]:
        """The effects that a model lacks."""
        held = set(model.names)
        # Of an effect and one that it contains nothing would fix how they share what they explain.
        for name in model.names:
            held.update(self.world.effects[name].contains)
        return [name for name in self.world.library if name not in held]

    def extend(self, beam: Iterable[Model], most: int, patient: bool = False) -> None:
        """Refit the most promising extensions of some models; those that are known already only
        with patience.
        """
        starts = []
        models = list(beam)
        # A better fit since then has taken the scores of some away.
        lost = [model for model in models if frozenset(model.names) not in self.scanned]
        self._survey(lost, beside=models)
        for model in models:
            key = frozenset(model.names)
            known = self.scanned[key]
            # The model may have been fitted better since it was put into the beam.
            newest = self.models[key]
            further = nominated(
                self.world,
                self.noise,
                newest,
                known.directions,
                known.scores,
                most,
                patient,
            )
            starts += [s for s in further if patient or self._is_new(s, newest)]
        if not self.world.linear or patient:
            if starts:
                self.refit(starts, patient=patient)
            return
        # Laws that are asked in every step cost most, and what they contain is often all there is.
        names = {frozenset(start.effects) for start in starts} | set(self.models)
        parts = {id(start): self._contained(start) & names for start in starts}
        plain = [start for start in starts if not parts[id(start)]]
        if plain:
            self.refit(plain)
        richer = [s for s in starts if parts[id(s)] and not self._explained(parts[id(s)])]
        if richer:
            self.refit(richer)

    def _is_new(self, start: Start, model: Model) -> bool:
        """Whether a fit may tell what none of these effects has: there is none, or, of a robot,
        whose effects begin far away, it was caught behind a model that it contains.
        """
        known = self.models.get(frozenset(start.effects))
        if known is None:
            return True
        behind = model.likelihood.value - known.likelihood.value
        return self.world.linear and behind > CAUGHT

    def _contained(self, start: Start) -> set[frozenset[str]]:
        """The models with what one of its effects contains in that one's place."""
        own = frozenset(start.effects)
        effects = self.world.effects
        return {own - {name} | {part} for name in own for part in effects[name].contains}

    def _explained(self, keys: Iterable[frozenset[str]]) -> bool:
        """Whether one of these models leaves no more than noise does."""
        models = [self.models[key] for key in keys if key in self.models]
        return any(self.quiet(m) and self.excess(m) < SILENT for m in models)

    def missing(self, model: Model, larger: Model) -> float:
        """Probability that a model which lacks nothing would seem to gain as much by becoming the
        larger one.

        The surrogates have the colour of what the larger model leaves, which is closer to the noise
        alone.
        """
        gain = larger.likelihood.value - model.likelihood.value
        model = self.models[frozenset(model.names)]
        first = self.gained(self.scan(model), larger, gain)
        # No colour of the surrogates makes such a gain a matter of chance.
        if first < CERTAIN:
            return first
        scores = self.scan(model, self.residual(larger.fit))
        return min(scores.p_value, self.gained(scores, larger, gain))

    def gained(self, scores: Scores, larger: Model, gain: float) -> float:
        """Chance of a gain in twice the log likelihood, less what chance gives the larger model's
        effects.
        """
        chance = dict(zip(scores.effects, scores.chance.tolist(), strict=True))
        # Of several effects the one that gains most by chance counts.
        chances = [chance.get(name, 0.0) for name in larger.names]
        lucky = max(chances, default=0.0)
        excess = np.array([gain - lucky])
        return tail(scores.by_chance, excess)

    def plain(self, model: Model, doubt: float) -> bool:
        """Whether nothing suggests that the model lacks something: neither a score nor the size of
        what it leaves.
        """
        return self.scan(model).p_value > doubt and self.quiet(model)

    def quiet(self, model: Model) -> bool:
        """Whether what a model leaves may be noise: as small as the floor, or larger where the
        floor is an estimate.

        The floor is estimated as if noise forgot itself; what is left may exceed it if it is of
        first order.
        """
        left = np.nan_to_num(model.likelihood.sigma, nan=np.inf)
        loud = left >= LOUD * self.noise.sigma
        if not loud.any():
            return True
        # Stated noise is known, so more than it is no noise, whatever its colour.
        if (loud & self.stated).any():
            return False
        # The test of Ljung and Box, eq. (5) of `bench.gap.model.noise`.
        residual = self.residual(model.fit)
        return forgets(residual, self.seen, model.likelihood) > FORGOT


def _scanned(
    world: World,
    at: Fit,
    lacking: Sequence[str],
    weights: Noise,
    residual: Array,
    seen: Mask,
    stream: np.random.Generator,
) -> Scanned:
    """A model scored, whoever does it."""
    candidates = directions(world, at, lacking)
    test = ScoreTest(at, candidates, seen, weights)
    return Scanned(at, candidates, test, _scored(test, residual, residual, seen, stream))


def _scored(
    test: ScoreTest, residual: Array, against: Array, seen: Mask, stream: np.random.Generator
) -> Scores:
    """Scores of a residual, with surrogates of the colour of another one."""
    return calibrated(
        test,
        residual,
        lambda count: surrogates(against, seen, count, stream, left=test.left),
        SURROGATES,
    )
