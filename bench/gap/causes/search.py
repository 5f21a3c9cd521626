"""Finds the effects that explain a recording: linear scores nominate, simulation decides, moves
correct.

Forward selection alone is not enough: where two effects act, the first pick is often a third one
that mimics both. So several models are carried along (a beam search), and each larger model is
compared with those that lack or replace one of its effects (A. Miller, Subset Selection in
Regression, 2nd ed., 2002, doi:10.1201/9781420035933, chapter 3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bench.gap.causes.moves import NOMINATED, Moves
from bench.gap.causes.rules import ALPHA
from bench.gap.model.models import Model, Models
from bench.gap.model.multiple_shooting import forgets, pieces, whole
from bench.gap.model.problem import Start

UNLIKELY = 0.1
"""Chance of the linear scores above which no effect is tried by simulation."""
DOUBTFUL = 0.015
"""Chance of the linear scores above which no further effect is tried by simulation."""
MOST_EFFECTS = 3
"""Effects of the largest model."""
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
SKETCHED = 2
"""Models of at most so many effects are sought over short pieces."""
TRANSFERRED = 5
"""So many of the best over short pieces are fitted to the whole runs."""
NEAR = 100.0
"""Models this near in twice the log likelihood are fitted again when what the engine's step leaves
has been taken out.
"""
BEAM = 3
"""Models of the most merit from which the search goes on."""
NEAREST = 2
"""Models nearest to the data, by sum of squares, from which it goes on besides."""
RIVAL = 0.5
"""A model goes on in the beam if it has at least this share of the best one's gain."""


@dataclass
class Search(Moves):
    """The search: from the base model to the model of all effects that the data show.

    Attributes:
        supported: the model that the data support as far as the search has come.
        settled: effects of a model that was compared with all its neighbours already, on fewer
            samples.
        corrected: effects of the model of which what the engine's step leaves was taken out last.
        thorough: whether it goes on while the nearest models come nearer, whichever is built upon.
    """

    supported: Model | None = None
    settled: frozenset[str] | None = None
    corrected: frozenset[str] | None = None
    thorough: bool = False
    _sketch: Search | None = None

    def run(self) -> Model:
        """The model of all effects that the data show.

        While much is left to explain the search goes on although no step of it pays by itself: of
        two effects that only together come near the data neither is worth much alone.
        """
        best = self.base
        for size in range(1, MOST_EFFECTS + 1):
            self.supported = best
            # A further effect is looked for on stronger evidence than the first.
            if self.plain(best, DOUBTFUL if best.names else UNLIKELY):
                break
            larger = self._larger(best, size)
            if larger is None:
                break
            if larger.merit > best.merit and self.missing(best, larger) <= ALPHA:
                best = self.without_step_errors(larger)
            # Near the noise, or where all that is left may be noise, two steps at once find chance.
            elif self.excess(best) < FAR or self.quiet(best):
                break
            # What is missing then is nothing of the library, and triples would only mimic it.
            if size > 1 and is_hopeless(self, larger):
                break
        self.supported = best
        return best

    def without_step_errors(self, model: Model) -> Model:
        """The model without what the engine's own step leaves of it, where that can be taken out;
        or a simpler one that does as well then.
        """
        key = frozenset(model.names)
        if not self.world.linear or key == self.corrected:
            return model
        self.corrected = key
        # loaded where there is a robot alone
        from bench.gap.model.tangents import correct

        correct(self.world, self.noise, model.fit.theta, model.fit.states)
        size = len(model.names)
        # What a richer effect bent to may have been that alone.
        near = [m for m in of_size(self, size) if m.merit > model.merit - NEAR]
        self.refit([m.fit.start() for m in near], race=False)
        return of_size(self, size)[0]

    def so_far(self) -> Model:
        """What a search that has to end here supports best; nothing is simulated for it.

        A model that was fitted already takes the place of the one that was judged if its gain is
        none of chance by the scores that there are.
        """
        best = self.models[frozenset((self.supported or self.base).names)]
        larger = [m for m in self.models.values() if len(m.names) > len(best.names)]
        scores = self.scored.get(frozenset(best.names))
        if scores is None or not larger:
            return best
        found = max(larger, key=lambda model: model.merit)
        gain = found.likelihood.value - best.likelihood.value
        real = self.gained(scores, found, gain) <= ALPHA
        return found if real and found.merit > best.merit else best

    def _larger(self, best: Model, size: int) -> Model | None:
        """The model of so many effects, or fewer, to compare with the best one of fewer."""
        if size > 1:
            self.world.watch.grow()
        larger = self._grown(size)
        if larger is None:
            return None
        if size == 1:
            return self.plainer(self._simpler(larger))
        # An idle effect goes before the exchange, which else puts another idle one in its place.
        return self.plainer(conservative(self, best, self.drop(self.swap(self.drop(larger)))))

    def _grown(self, size: int) -> Model | None:
        """The best model of so many effects: from the best smaller one, then from its rivals, or
        with patience.
        """
        smaller = beam(self, size - 1)
        self.extend(smaller[:1], NOMINATED)
        # Each further means costs more simulations, so none is used where the data are explained.
        if self._explained_by(size):
            return self.best(size)
        self.from_pieces(size)
        if self._explained_by(size):
            return self.best(size)
        if size == 1:
            self.extend(smaller, NOMINATED, patient=True)
        else:
            for members in self._turns(smaller[1:]):
                self.extend(members, NOMINATED)
                if self._explained_by(size):
                    break
        return self.best(size)

    def _explained_by(self, size: int) -> bool:
        """Whether the best model of so many effects leaves nothing to explain; what is loud is not
        scored to know it.
        """
        model = self.best(size)
        if model is None:
            return False
        # What the step leaves of friction, say, would be taken for more that is missing.
        if self.world.linear and self.excess(model) < FAR:
            model = self.without_step_errors(model)
        return self.quiet(model) and self.plain(model, ALPHA)

    def _turns(self, rivals: Sequence[Model]) -> Sequence[Sequence[Model]]:
        """Which of them are extended at once: where a simulation costs much, one after the other,
        until the data are explained.
        """
        return [[rival] for rival in rivals] if self.world.linear else [rivals]

    def from_pieces(self, size: int) -> None:
        """Refit the models of so many effects that explain short pieces of the runs best."""
        if size > SKETCHED or self._forgets:
            return
        cut = pieces(self.world)
        if cut is None:
            return
        # One search over pieces serves every size; it decides nothing, and finds where to begin.
        if self._sketch is None:
            self._sketch = Search(cut, self.noise, self.frozen, self.drawing("pieces"), self.stated)
            self._sketch.refit([Start((), self.base.fit.theta, cut.guess)])
        sketch = self._sketch
        sketch.extend(beam(sketch, size - 1), NOMINATED)
        best = of_size(sketch, size)[:TRANSFERRED]
        if best:
            self.refit([whole(self.world, model.fit) for model in best])

    @cached_property
    def _forgets(self) -> bool:
        """Whether pieces of the runs are no easier to follow than the whole of them."""
        fit, world = self.base.fit, self.world
        by_states = world.derivatives if world.linear else fit.jacobian[..., fit.free.size :]
        return by_states is not None and forgets(world, self.noise, by_states)

    def _simpler(self, single: Model) -> Model:
        """The effect that the single one contains, where structure is left to which the rest of it
        may have bent.
        """
        if self.plain(single, ALPHA):
            return single
        for name in self.world.effects[single.names[0]].contains:
            part = self.models.get(frozenset([name]))
            # The richer effect must come clearly nearer, or its extra shape mimics what is missing.
            if part is not None and self.excess(single) > CLEARLY * self.excess(part):
                return part
        return single


def of_size(models: Models, size: int) -> list[Model]:
    """The models of so many effects, those of the most merit first."""
    members = [model for model in models.models.values() if len(model.names) == size]
    return sorted(members, key=lambda model: -model.merit)


def beam(search: Search, size: int) -> list[Model]:
    """Models of so many effects to go on from: those of the most merit, and those that come nearest
    to the data.

    Far from the data merit is misled, since noise that remembers explains almost anything there.
    """
    members = of_size(search, size)
    if not size or not members:
        return members
    base = search.base.merit
    best_gain = members[0].merit - base
    rivals = [model for model in members if model.merit - base >= RIVAL * best_gain][:BEAM]
    nearest = sorted(members, key=lambda model: model.fit.cost)[:NEAREST]
    return rivals + [model for model in nearest if model not in rivals]


def is_hopeless(search: Search, larger: Model) -> bool:
    """Whether a model of several effects is too far from the data for one more to be tried; of a
    thorough search, whether all of as many are.
    """
    # Two effects that leave as much as the best single one are no way to a third.
    of_base = HOPELESS * search.excess(search.base)
    of_single = IDLE * min(_excesses(search, 1), default=np.inf)
    left = search.excess(larger)
    if search.thorough:
        # The one that is built upon need not be the nearest: far from the noise merit is misled.
        left = min(left, *_excesses(search, len(larger.names)))
    return left > min(of_base, of_single)


def _excesses(search: Search, size: int) -> list[float]:
    """What the models of so many effects leave over the noise."""
    return [search.excess(m) for m in search.models.values() if len(m.names) == size]


def conservative(search: Search, best: Model, larger: Model) -> Model:
    """The larger model, unless it puts other effects in place of the best one's and is hardly
    nearer to the noise.

    Two effects mimic many a third; where neither account reaches the noise, the shorter one is
    built upon.
    """
    # A model that keeps the best one's effects puts none in their place.
    kept = set(best.names) <= set(larger.names)
    if kept or search.excess(larger) < CLEARLY * search.excess(best):
        return larger
    built = [
        model
        for model in search.models.values()
        if set(best.names) < set(model.names)
        and len(model.names) == len(best.names) + 1
        and model.merit > best.merit
    ]
    return max(built, key=lambda model: model.merit, default=best)
