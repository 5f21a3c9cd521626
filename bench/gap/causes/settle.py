"""Fits what the search ended with, and its rivals, to the end, before anything is named.

The search asks few candidates about each model and stops fits that fall behind; a cause that it
names must stand against all of them, each at its own best.
"""

from __future__ import annotations

import numpy as np

from bench.gap.causes.candidates import neighbours
from bench.gap.causes.search import Search
from bench.gap.causes.structure import remains
from bench.gap.model.models import Model
from bench.gap.model.noise import Noise
from bench.gap.model.problem import Start

NEAR = 30.0
"""Rivals this near in twice the log likelihood are fitted once more before they are judged."""
NEARLY = 1.5
"""So are those that leave less than so many times the model's excess over the noise."""


def settle(search: Search, model: Model) -> Model:
    """The best model after it and its rivals of the same size, all that are promising, were fitted
    to the end.

    By generalised least squares where what is left is noise; by ordinary ones where structure is
    left, which is none and would pull the fit away from the data.
    """
    size = len(model.names)
    if search.settled != frozenset(model.names):
        model = _among_all(search, model)
    around = list(neighbours(search.world, model.fit))
    # What repeats has minima by the dozen.
    if around:
        search.from_pieces(size)
    near = rivals(search, model)
    parts = smaller(search, model)
    noise = _noise_of(search, model)
    judged = [model]
    # Where structure is left merits only compare how each model mimics it, so none takes its place.
    if noise is not None:
        judged = [m for m in near if abs(model.merit - m.merit) < NEAR] or [model]
    starts = [m.fit.start() for m in near]
    starts += [m.fit.start() for m in parts]
    starts += [_in_its_place(search, model, m) for m in judged if _differs_in_one(model, m)]
    search.refit([*starts, *around], noise)
    # A refit that ends worse than before is not kept, so the table holds the best of each.
    refitted = [search.models[frozenset(m.names)] for m in judged]
    return max(refitted, key=lambda m: m.merit)


def _among_all(search: Search, model: Model) -> Model:
    """The best of a model and those that have any other effect of the library in place of one."""
    size = len(model.names)
    known = set(search.models)
    smaller = [search.without(model, name) for name in model.names]
    search.extend(smaller, len(search.world.library))
    best = model
    for key, other in search.models.items():
        # Those that were known have been compared with it by the search.
        if key in known or len(key) != size:
            continue
        if other.merit > best.merit:
            best = other
    return best


def _differs_in_one(model: Model, other: Model) -> bool:
    """Whether it has one other effect, and shares others."""
    return len(model.names) > 1 and len(set(model.names) - set(other.names)) == 1


def _in_its_place(search: Search, model: Model, other: Model) -> Start:
    """Where a rival begins with all that it shares as the model has it: a law of several numbers
    ends a little elsewhere each time, and what is alike would be told apart by that.
    """
    (own,), (gone,) = (set(m.names) - set(n.names) for m, n in ((other, model), (model, other)))
    slots = search.world.slots
    theta = model.fit.theta.copy()
    theta[slots[gone]] = 0.0
    theta[slots[own]] = other.fit.theta[slots[own]]
    return Start(other.names, theta, model.fit.states)


def rivals(search: Search, model: Model) -> list[Model]:
    """Models of as many effects that explain nearly as much, the model itself among them."""
    size = len(model.names)
    return [
        other
        for other in search.models.values()
        if len(other.names) == size and _is_near(search, other, model)
    ]


def _is_near(search: Search, other: Model, model: Model) -> bool:
    """By merit, or by what is left over the noise: merit is misled where structure is left."""
    if abs(model.merit - other.merit) < NEAR:
        return True
    return search.excess(other) < NEARLY * search.excess(model)


def smaller(search: Search, model: Model) -> list[Model]:
    """The models without one of the effects: the gain of each is measured against them."""
    names = set(model.names)
    size = len(names) - 1
    smaller = []
    for other in search.models.values():
        if len(other.names) == size and set(other.names) < names:
            smaller.append(other)
    return smaller


def _noise_of(search: Search, model: Model) -> Noise | None:
    """The noise that a model leaves, to weigh samples with; None where it leaves structure."""
    if remains(search, model).structure:
        return None
    sigma = np.maximum(model.likelihood.sigma, 1e-300)
    # As in the score test, correlations are never negative.
    return Noise(sigma, np.maximum(model.likelihood.phi, 0.0))
