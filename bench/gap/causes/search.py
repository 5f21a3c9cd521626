"""Beam search for the set of effects that explains a recording.

Linear scores select candidates, full fits decide, and moves between models correct errors. Forward
selection alone is not enough: if two effects act, the first choice is often a third effect that
mimics both. Therefore several models are extended (beam search), and each larger model is compared
with those that lack or replace one of its effects (A. Miller, Subset Selection in Regression, 2nd
ed., 2002, doi:10.1201/9781420035933, chapter 3).
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
"""Maximum p-value of the linear scores at which a first effect is tried by simulation."""
DOUBTFUL = 0.015
"""Maximum p-value of the linear scores at which a further effect is tried by simulation."""
MOST_EFFECTS = 3
"""Maximum number of effects in a model."""
FAR = 0.5
"""Minimum excess over the noise at which the search continues although no effect was added."""
HOPELESS = 0.5
"""Maximum share of the base model's excess left by two effects at which a third is tried."""
IDLE = 0.85
"""Maximum excess of a model with two effects at which a third is tried, relative to single effects.

It is a share of the excess of the best single effect. Above it, no effect of the library explains
the residual.
"""
CLEARLY = 0.5
"""Maximum excess of a model that replaces effects of a smaller one, as a share of its excess."""
SKETCHED = 2
"""Maximum number of effects of models that are searched on short segments."""
TRANSFERRED = 5
"""Number of best models on short segments that are fitted to the whole runs."""
NEAR = 100.0
"""Maximum distance in merit of models that are refitted after a discretisation correction."""
BEAM = 3
"""Maximum number of models with the highest merit that are extended."""
NEAREST = 2
"""Number of models with the lowest sum of squares that are extended in addition."""
RIVAL = 0.5
"""Minimum gain of a model in the beam, as a share of the gain of the best model."""


@dataclass
class Search(Moves):
    """Search from the base model to the model of all effects that the data show.

    Attributes:
        supported: the model that the data support so far.
        settled: effects of a model that was already compared with all its neighbours on thinned
            runs.
        corrected: effects of the model for which the discretisation error was last corrected.
        thorough: whether the search continues while the models with the lowest excess improve, even
            if the model that it extends does not.
    """

    supported: Model | None = None
    settled: frozenset[str] | None = None
    corrected: frozenset[str] | None = None
    thorough: bool = False
    _sketch: Search | None = None

    def run(self) -> Model:
        """Return the model of all effects that the data show.

        While the excess is large, the search continues although no single step pays off: if two
        effects explain the data only together, neither has much merit alone.
        """
        best = self.base
        for size in range(1, MOST_EFFECTS + 1):
            self.supported = best
            # A further effect requires stronger evidence than the first one.
            if self.plain(best, DOUBTFUL if best.names else UNLIKELY):
                break
            larger = self._larger(best, size)
            if larger is None:
                break
            if larger.merit > best.merit and self.missing(best, larger) <= ALPHA:
                best = self.without_step_errors(larger)
            # Near the noise, or if the residual may be noise, adding two effects at once would fit
            # noise.
            elif self.excess(best) < FAR or self.quiet(best):
                break
            # The missing effect is then not in the library, and three effects would only mimic it.
            if size > 1 and is_hopeless(self, larger):
                break
        self.supported = best
        return best

    def without_step_errors(self, model: Model) -> Model:
        """Correct the discretisation error about a model, and refit its close rivals.

        Returns:
            The best model of the same size after the correction, which may be a simpler one.
        """
        key = frozenset(model.names)
        if not self.world.linear or key == self.corrected:
            return model
        self.corrected = key
        # Imported here, because only robots need it.
        from bench.gap.model.tangents import correct

        correct(self.world, self.noise, model.fit.theta, model.fit.states)
        size = len(model.names)
        # A richer effect may have fitted only the discretisation error.
        near = [m for m in of_size(self, size) if m.merit > model.merit - NEAR]
        self.refit([m.fit.start() for m in near], race=False)
        return of_size(self, size)[0]

    def so_far(self) -> Model:
        """Return the best supported model of a search that has to end now, without any simulation.

        A larger fitted model replaces the present one if its gain is significant by the known
        scores.
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
        """Return a model with at most `size` effects to compare with the best smaller one."""
        if size > 1:
            self.world.watch.grow()
        larger = self._grown(size)
        if larger is None:
            return None
        if size == 1:
            return self.plainer(self._simpler(larger))
        # An idle effect is dropped before the exchange, which would replace it by another idle one.
        return self.plainer(conservative(self, best, self.drop(self.swap(self.drop(larger)))))

    def _grown(self, size: int) -> Model | None:
        """Return the best model with `size` effects.

        First only the best smaller model is extended. If that does not explain the data, segments,
        further models of the beam or patient fits are used.
        """
        smaller = beam(self, size - 1)
        self.extend(smaller[:1], NOMINATED)
        # Each further method needs more simulations, so it is skipped if the data are explained.
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
        """Return whether the best model with `size` effects leaves nothing to explain.

        A residual above the noise answers this without a score test.
        """
        model = self.best(size)
        if model is None:
            return False
        # The discretisation error, of friction for example, could be mistaken for a missing effect.
        if self.world.linear and self.excess(model) < FAR:
            model = self.without_step_errors(model)
        return self.quiet(model) and self.plain(model, ALPHA)

    def _turns(self, rivals: Sequence[Model]) -> Sequence[Sequence[Model]]:
        """Return groups of models to extend together.

        If simulations are expensive, models are extended one by one until the data are explained.
        """
        return [[rival] for rival in rivals] if self.world.linear else [rivals]

    def from_pieces(self, size: int) -> None:
        """Fit the models with `size` effects that explain short segments of the runs best."""
        if size > SKETCHED or self._forgets:
            return
        cut = pieces(self.world)
        if cut is None:
            return
        # One search on segments serves every size; it decides nothing, and only provides starts.
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
        """Whether segments of the runs are no easier to fit than whole runs."""
        fit, world = self.base.fit, self.world
        by_states = world.derivatives if world.linear else fit.jacobian[..., fit.free.size :]
        return by_states is not None and forgets(world, self.noise, by_states)

    def _simpler(self, single: Model) -> Model:
        """Return the effect that a single effect contains if the simpler one is preferable.

        This applies if the residual has structure to which the richer effect may have adapted.
        """
        if self.plain(single, ALPHA):
            return single
        for name in self.world.effects[single.names[0]].contains:
            part = self.models.get(frozenset([name]))
            # The richer effect must reduce the excess clearly, otherwise it mimics a missing
            # effect.
            if part is not None and self.excess(single) > CLEARLY * self.excess(part):
                return part
        return single


def of_size(models: Models, size: int) -> list[Model]:
    """Return the models with `size` effects, those with the highest merit first."""
    members = [model for model in models.models.values() if len(model.names) == size]
    return sorted(members, key=lambda model: -model.merit)


def beam(search: Search, size: int) -> list[Model]:
    """Return the models with `size` effects to extend: highest merit, and lowest sum of squares.

    Far from the data merit is misleading, because AR(1) noise explains almost any residual there.
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
    """Return whether a model of several effects is too far from the data to try another effect.

    In a thorough search, all models of the same size must be too far.

    Args:
        search: the search, with all fitted models.
        larger: the model of several effects.
    """
    # If two effects leave as much as the best single one, a third effect will not help.
    of_base = HOPELESS * search.excess(search.base)
    of_single = IDLE * min(_excesses(search, 1), default=np.inf)
    left = search.excess(larger)
    if search.thorough:
        # The model to extend need not have the lowest excess, because merit is misleading there.
        left = min(left, *_excesses(search, len(larger.names)))
    return left > min(of_base, of_single)


def _excesses(search: Search, size: int) -> list[float]:
    """Return the excess of each model with `size` effects."""
    return [search.excess(m) for m in search.models.values() if len(m.names) == size]


def conservative(search: Search, best: Model, larger: Model) -> Model:
    """Return the larger model, or one that extends the best smaller model.

    Two effects can mimic many a third one. A larger model that replaces effects of the best smaller
    one must reduce the excess clearly. Otherwise the best one-effect extension of the smaller model
    is returned, or the smaller model itself.

    Args:
        search: the search, with all fitted models.
        best: the best smaller model.
        larger: the larger model.
    """
    # A model that contains the effects of the best one replaces none of them.
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
