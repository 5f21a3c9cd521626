"""Moves between models: an effect taken away, an effect replaced.

Forward selection never takes a step back, and its first pick is often one effect that mimics two.
Dropping and exchanging effects of the larger model corrects that (A. Miller, Subset Selection in
Regression, 2nd ed., 2002, doi:10.1201/9781420035933, chapter 3).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import chain

import numpy as np

from bench.gap.causes.scored import Scored
from bench.gap.model.models import Model
from bench.gap.model.problem import Start
from sims.base import Array

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

Parts = dict[str, Array]
"""Effects with coefficients to begin with."""


@dataclass
class Moves(Scored):
    """Scored models, and the moves from one to another."""

    _lessened: set[frozenset[str]] = field(default_factory=set)
    _simplified: set[tuple[frozenset[str], frozenset[str]]] = field(default_factory=set)

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
        """The model with simpler laws in the place of richer ones that contain them, one of them or
        all together, and with the one place that acts most in the place of all, where these come no
        nearer to the data.
        """
        for name in model.names:
            for parts in self._parts(model, name):
                other = self._with_parts(model, name, parts)
                enough = self.excess(model) > NEARER * self.excess(other) > 0.0
                if other.merit >= model.merit or enough:
                    return self.plainer(other)
        return model

    def _parts(self, model: Model, name: str) -> Iterator[Parts]:
        """The simpler laws at the same place that an effect contains, one by one and all together,
        and of a family the member that changes most; each with coefficients to begin with.
        """
        effects, slots = self.world.effects, self.world.slots
        own = model.fit.theta[slots[name]]
        together, begin = Parts(), 0
        for part in effects[name].contains:
            if part in effects and effects[part].place == effects[name].place:
                # What scales a law comes first in the law that it is part of.
                end = begin + slots[part].stop - slots[part].start
                together[part], begin = own[begin:end], end
        yield from ({part: c} for part, c in together.items())
        # Of several it is the sum where what shapes it lies beyond the data: one law with a time
        # far longer than the runs stands for two that are told, and comes near the data at once.
        if len(together) > 1:
            yield together
        members = getattr(effects[name], "members", ())
        each = len(members[0].coefficients) if members else 0
        # One coefficient for all places says nothing of one of them.
        if len(members) > 1 and own.size == each * len(members):
            free = model.fit.free.tolist()
            columns = [free.index(place) for place in self.world.places(name)]
            responses = np.sqrt(np.square(model.fit.jacobian[..., columns]).sum(axis=(0, 1, 2)))
            sizes = (np.abs(own) * responses).reshape(len(members), each).max(axis=1)
            most = int(np.argmax(sizes))
            yield {members[most].name: own[each * most : each * (most + 1)]}

    def _with_parts(self, model: Model, name: str, parts: Parts) -> Model:
        """The model with simpler effects in the place of a richer one, fitted from here, known or
        not.
        """
        replaced = ([*parts] if n == name else [n] for n in model.names)
        names = tuple(dict.fromkeys(chain.from_iterable(replaced)))
        key, step = frozenset(names), (frozenset(model.names), frozenset(names))
        # A known one may be caught where its own way up has led it; one that is ahead is not.
        behind = key not in self.models or self.models[key].merit < model.merit
        if behind and step not in self._simplified:
            self._simplified.add(step)
            theta = model.fit.theta.copy()
            theta[self.world.slots[name]] = 0.0
            for part, c in parts.items():
                theta[self.world.slots[part]] += c
            return self.fit_one(Start(names, theta, model.fit.states))
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
