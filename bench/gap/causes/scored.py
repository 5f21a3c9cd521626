"""Fitted models together with the scores of all effects that they lack.

Each model is scored once against the whole library by a linear test
(`bench.gap.causes.score_test`). The score and the size of the residual show whether the model lacks
something.
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
"""Number of surrogate residuals that calibrate the scores about one model."""
CERTAIN = 1e-6
"""P-value below which surrogates with another spectrum are not needed."""
LOUD = 1.3
"""Maximum ratio of the residual to the noise floor at which the scores alone are trusted.

A larger residual is examined by simulation, whatever the scores are.
"""
FORGOT = 0.01
"""Minimum p-value at which a residual above an estimated noise floor counts as AR(1) noise."""

HELD = 400e6
"""Maximum size in bytes of stored directions, in addition to those of the base model.

The oldest ones are removed; in the rare case that they are needed again, they are recomputed.
"""
SILENT = 0.02
"""Maximum excess of a model at which no richer law is fitted."""
CAUGHT = 1.0
"""Maximum distance in twice the log-likelihood of a model from one that it contains.

A fit that is further behind has stopped in a poor local minimum.
"""
UNMOVED = 0.1
"""Maximum RMS change of a fit, in sigmas, at which its directions are kept.

Directions are derivatives, so they have changed as little as the fit.
"""


class Scanned(NamedTuple):
    """Directions, score test and scores about one model.

    Attributes:
        at: the fit that the directions refer to.
        directions: directions of the effects that the model lacks.
        test: score test with these directions.
        scores: scores of these effects.
    """

    at: Fit
    directions: Directions
    test: ScoreTest
    scores: Scores


@dataclass
class Scored(Models):
    """Models and their scores.

    Attributes:
        scored: scores about each scored model, by its effects.
        scanned: directions, tests and scores about the base model and the latest scored models.
        tests: p-value of the best score about each model, by its effects.
        former: results about models that have been replaced by better fits.
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
        """Scores about the base model or its previous fit; None if there are none."""
        key: frozenset[str] = frozenset()
        if key in self.scored or key not in self.former:
            return self.scored.get(key)
        return self.former[key].scores

    def directions_known(self) -> tuple[Fit, Directions] | None:
        """Return the directions of all candidates about the base model, if already computed.

        Here always None; subclasses may compute them separately from the scores.
        """
        return None

    def replaced(self, key: frozenset[str]) -> None:
        """Discard the scores about a model that was replaced."""
        self.scored.pop(key, None)
        if key in self.scanned:
            self.former[key] = self.scanned.pop(key)

    def scan(self, model: Model, against: Array | None = None) -> Scores:
        """Score every effect that the model lacks.

        Args:
            model: the model.
            against: (R, T, C) residual whose spectrum the surrogates have; None for that of the
                model.
        """
        key = frozenset(model.names)
        if key not in (self.scored if against is None else self.scanned):
            self._survey([model])
        if against is None:
            return self.scored[key]
        known = self.scanned[key]
        self._look(model)
        # Directions cost one simulation per candidate, and are reused with other surrogates. The
        # spectrum of the noise is best estimated from a model with less structure in its residual.
        residual = self.residual(model.fit)
        stream = self.drawing("library", model.names)
        scores = _scored(known.test, residual, against, self.seen, stream)
        self._take(key, known._replace(scores=scores))
        return scores

    def _survey(self, models: Sequence[Model], beside: Sequence[Model] = ()) -> None:
        """Score the effects that each of the models lacks.

        Args:
            models: models to score.
            beside: further models whose stored results must not be removed.
        """
        calls, keys = [], []
        for model in models:
            self._look(model)
            model = self.exact(model)
            key = frozenset(model.names)
            residual, stream = self.residual(model.fit), self.drawing("library", model.names)
            former = self.former.pop(key, None)
            # A model that has hardly moved keeps its directions.
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
            # Scores that were kept when the directions were removed remain valid.
            self._take(key, found[number]._replace(scores=scores))
        self._make_room([*keys, *(frozenset(model.names) for model in beside)])

    def _look(self, model: Model) -> None:
        """Report the scoring of a model as the next step."""
        about = " + ".join(model.names) or "the base model"
        self.world.watch.look(f"scores of the library about {about}")

    def _make_room(self, asked: Sequence[frozenset[str]]) -> None:
        """Remove the oldest stored directions, except those of the base model and of `asked`."""
        for kept in (self.former, self.scanned):
            for key in [k for k in kept if k and k not in asked]:
                held = [*self.former.items(), *self.scanned.items()]
                if sum(one.directions.values.nbytes for k, one in held if k) <= HELD:
                    return
                del kept[key]

    def _take(self, key: frozenset[str], scanned: Scanned) -> None:
        # Insert the entry again, so that it is the newest one.
        """Store results as the latest ones."""
        self.scanned.pop(key, None)
        self.scanned[key] = scanned
        self.enter_scores(key, scanned.scores)

    def enter_scores(self, key: frozenset[str], scores: Scores) -> None:
        """Store the scores about a model.

        Args:
            key: effects of the model.
            scores: the scores.
        """
        self.scored[key] = scores
        self.tests[key] = scores.p_value
        # Kept from the first scan, so that merits remain comparable after a better base fit.
        if not key and not self.chances:
            self.chances = dict(zip(scores.effects, scores.chance.tolist(), strict=True))

    def _moved(self, one: Fit, other: Fit) -> float:
        """Return the RMS difference of two fits at the samples, in sigmas."""
        apart = (one.simulated - other.simulated) / self.noise.sigma
        return float(np.sqrt(np.square(apart[self.seen]).mean()))

    def _lacking(self, model: Model) -> list[str]:
        """Return the effects that a model lacks."""
        held = set(model.names)
        # An effect and one that it contains have no unique solution together.
        for name in model.names:
            held.update(self.world.effects[name].contains)
        return [name for name in self.world.library if name not in held]

    def extend(self, beam: Iterable[Model], most: int, patient: bool = False) -> None:
        """Refit the most promising extensions of models; known ones only if patient.

        Args:
            beam: models to extend.
            most: maximum number of candidates per model.
            patient: whether to include all candidates, and fit the beginnings of the runs first.
        """
        starts = []
        models = list(beam)
        # A better fit may have discarded the scores of some models.
        lost = [model for model in models if frozenset(model.names) not in self.scanned]
        self._survey(lost, beside=models)
        for model in models:
            key = frozenset(model.names)
            known = self.scanned[key]
            # The model may have been improved since it was put into the beam.
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
        # Laws that are evaluated in every step cost most, and the laws that they contain are often
        # sufficient.
        names = {frozenset(start.effects) for start in starts} | set(self.models)
        parts = {id(start): self._contained(start) & names for start in starts}
        plain = [start for start in starts if not parts[id(start)]]
        if plain:
            self.refit(plain)
        richer = [s for s in starts if parts[id(s)] and not self._explained(parts[id(s)])]
        if richer:
            self.refit(richer)

    def _is_new(self, start: Start, model: Model) -> bool:
        """Return whether a fit from this start may find something new.

        This is the case if no fit of these effects is known. For a robot, whose effects start far
        from the optimum, it is also the case if the known fit is worse than a model that it
        contains.
        """
        known = self.models.get(frozenset(start.effects))
        if known is None:
            return True
        behind = model.likelihood.value - known.likelihood.value
        return self.world.linear and behind > CAUGHT

    def _contained(self, start: Start) -> set[frozenset[str]]:
        """Return the models in which one effect is replaced by an effect that it contains."""
        own = frozenset(start.effects)
        effects = self.world.effects
        return {own - {name} | {part} for name in own for part in effects[name].contains}

    def _explained(self, keys: Iterable[frozenset[str]]) -> bool:
        """Return whether one of these models leaves only noise."""
        models = [self.models[key] for key in keys if key in self.models]
        return any(self.quiet(m) and self.excess(m) < SILENT for m in models)

    def missing(self, model: Model, larger: Model) -> float:
        """Return the p-value of the gain of a larger model.

        The null hypothesis is that the smaller model lacks nothing. The surrogates have the
        spectrum of the larger model's residual, which is closer to pure noise.

        Args:
            model: the smaller model.
            larger: the larger model.
        """
        gain = larger.likelihood.value - model.likelihood.value
        model = self.models[frozenset(model.names)]
        first = self.gained(self.scan(model), larger, gain)
        # Such a gain is significant whatever the spectrum of the surrogates.
        if first < CERTAIN:
            return first
        scores = self.scan(model, self.residual(larger.fit))
        return min(scores.p_value, self.gained(scores, larger, gain))

    def gained(self, scores: Scores, larger: Model, gain: float) -> float:
        """Return the p-value of a gain in twice the log-likelihood.

        The null-hypothesis level of the larger model's effects is subtracted first.

        Args:
            scores: scores about the smaller model.
            larger: the larger model.
            gain: gain in twice the log-likelihood.
        """
        chance = dict(zip(scores.effects, scores.chance.tolist(), strict=True))
        # Among several effects, the highest null-hypothesis level is used.
        chances = [chance.get(name, 0.0) for name in larger.names]
        lucky = max(chances, default=0.0)
        excess = np.array([gain - lucky])
        return tail(scores.by_chance, excess)

    def plain(self, model: Model, doubt: float) -> bool:
        """Return whether neither scores nor residual suggest that the model lacks something.

        Args:
            model: the model.
            doubt: p-value threshold of the scores.
        """
        return self.scan(model).p_value > doubt and self.quiet(model)

    def quiet(self, model: Model) -> bool:
        """Return whether the residual of a model may be noise.

        It is at the noise floor, or it is above an estimated floor and AR(1) noise. The floor is
        estimated for white noise, so AR(1) noise may exceed it.
        """
        left = np.nan_to_num(model.likelihood.sigma, nan=np.inf)
        loud = left >= LOUD * self.noise.sigma
        if not loud.any():
            return True
        # Specified noise is known, so a larger residual is not noise, whatever its spectrum.
        if (loud & self.stated).any():
            return False
        # Ljung-Box test, eq. (5) of `bench.gap.model.noise`.
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
    """Score one model; runs in this process or in a worker."""
    candidates = directions(world, at, lacking)
    test = ScoreTest(at, candidates, seen, weights)
    return Scanned(at, candidates, test, _scored(test, residual, residual, seen, stream))


def _scored(
    test: ScoreTest, residual: Array, against: Array, seen: Mask, stream: np.random.Generator
) -> Scores:
    """Return the scores of a residual, with surrogates that have the spectrum of `against`."""
    return calibrated(
        test,
        residual,
        lambda count: surrogates(against, seen, count, stream, left=test.left),
        SURROGATES,
    )
