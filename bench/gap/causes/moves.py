"""Moves between models: an effect taken away, an effect replaced.

Forward selection never takes a step back, and its first pick is often one effect that mimics two.
Dropping and exchanging effects of the larger model corrects that (A. Miller, Subset Selection in
Regression, 2nd ed., 2002, doi:10.1201/9781420035933, chapter 3).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from bench.gap.causes.scored import Scored
from bench.gap.model.models import Model
from bench.gap.model.problem import Start

NOMINATED = 7
"""Candidates of the best scores that are refitted about one model."""
MOVES = 2
"""Exchanges of one effect tried in a row, at most."""
NEARER = 0.95
"""A richer law stands where it brings a model to less than this share of the excess over the noise
that its simpler form leaves.
"""
BETTER = 1e-6
"""A merit must grow by more than this for an exchange to count; less is rounding."""


@dataclass
class Moves(Scored):
    """Scored models, and the moves from one to another."""

    _lessened: set[frozenset[str]] = field(default_factory=set)

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
            # Off is zero, and no parameter of the fit: everything else begins where it stands.
            theta = model.fit.theta.copy()
            theta[self.world.slots[name]] = 0.0
            rest = tuple(n for n in model.names if n != name)
            known = model.fit.known().without(self.world.places(name))
            starts.append(Start(rest, theta, model.fit.states, known))
        self.refit(starts)

    def drop(self, model: Model) -> Model:
        """The model without effects that it does not need; each smaller one is fitted from here,
        known or not.
        """
        key = frozenset(model.names)
        # From here the smaller model may reach a minimum that its own way up has missed.
        if len(model.names) > 1 and key not in self._lessened:
            self._lessened.add(key)
            self._lessen(model, model.names)
        for name in model.names:
            smaller = self.without(model, name)
            if smaller.merit >= model.merit:
                return self.drop(smaller)
        return model

    def plainer(self, model: Model) -> Model:
        """The model with simpler laws in the place of richer ones that contain them, where these
        come no nearer to the data.
        """
        for name in model.names:
            for part in self._parts(name):
                other = self._with_part(model, name, part)
                enough = self.excess(model) > NEARER * self.excess(other) > 0.0
                if other.merit >= model.merit or enough:
                    return self.plainer(other)
        return model

    def _parts(self, name: str) -> list[str]:
        """The simpler laws at the same place that an effect contains."""
        effects = self.world.effects
        own = effects[name]
        return [
            part for part in own.contains if part in effects and effects[part].place == own.place
        ]

    def _with_part(self, model: Model, name: str, part: str) -> Model:
        """The model with a simpler law in the place of a richer one."""
        names = tuple(dict.fromkeys(part if n == name else n for n in model.names))
        key = frozenset(names)
        if key not in self.models:
            theta = model.fit.theta.copy()
            slot, richer = self.world.slots[part], self.world.slots[name]
            # What scales a law comes first in the law that it is part of.
            count = slot.stop - slot.start
            theta[slot] = theta[richer][:count]
            theta[richer] = 0.0
            self.refit([Start(names, theta, model.fit.states)], race=False)
        return self.models[key]

    def swap(self, model: Model) -> Model:
        """The best model that has one effect replaced."""
        for _ in range(MOVES):
            # Each smaller model is extended again: the effect taken away may not be the best.
            self.extend([self.without(model, name) for name in model.names], NOMINATED)
            better = self.best(len(model.names))
            if better is None or better.merit <= model.merit + BETTER:
                break
            model = self.drop(better)
        return model
