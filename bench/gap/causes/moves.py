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
