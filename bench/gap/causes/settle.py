"""Refit the model found by the search and its close rivals to convergence.

The search tests few candidates about each model, and stops fits that fall behind. A diagnosed cause
must be compared with all rivals, each at its own optimum.
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
"""Maximum difference in twice the log-likelihood (merit) of rivals that are refitted."""
NEARLY = 1.5
"""Maximum excess of rivals that are refitted, as a multiple of the excess of the model."""


def settle(search: Search, model: Model) -> Model:
    """Refit a model and its promising rivals of the same size to convergence.

    If the residual is noise, generalised least squares is used. If it has structure, ordinary least
    squares is used, because the structure is not noise and would distort the fit.

    Args:
        search: the search, with all fitted models.
        model: the model that the search found.

    Returns:
        The best of these models.
    """
    size = len(model.names)
    if search.settled != frozenset(model.names):
        model = _among_all(search, model)
    around = list(neighbours(search.world, model.fit))
    # Periodic effects have dozens of local minima.
    if around:
        search.from_pieces(size)
    near = rivals(search, model)
    parts = smaller(search, model)
    noise = _noise_of(search, model)
    judged = [model]
    # With structure in the residual, merit only compares how well models mimic it, so no rival
    # replaces the model.
    if noise is not None:
        judged = [m for m in near if abs(model.merit - m.merit) < NEAR] or [model]
    starts = [m.fit.start() for m in near]
    starts += [m.fit.start() for m in parts]
    starts += [_in_its_place(search, model, m) for m in judged if _differs_in_one(model, m)]
    search.refit([*starts, *around], noise)
    # A refit that ends worse is not stored, so the table contains the best fit of each model.
    refitted = [search.models[frozenset(m.names)] for m in judged]
    return max(refitted, key=lambda m: m.merit)


def _among_all(search: Search, model: Model) -> Model:
    """Return the best among a model and all models with one effect replaced by any other."""
    size = len(model.names)
    known = set(search.models)
    smaller = [search.without(model, name) for name in model.names]
    search.extend(smaller, len(search.world.library))
    best = model
    for key, other in search.models.items():
        # The search has already compared the known models.
        if key in known or len(key) != size:
            continue
        if other.merit > best.merit:
            best = other
    return best


def _differs_in_one(model: Model, other: Model) -> bool:
    """Return whether two models share at least one effect and differ in exactly one."""
    return len(model.names) > 1 and len(set(model.names) - set(other.names)) == 1


def _in_its_place(search: Search, model: Model, other: Model) -> Start:
    """Return a start for a rival in which all shared effects have the values of the model.

    A law with several coefficients converges to slightly different values each time, which would
    make equivalent models look different.
    """
    (own,), (gone,) = (set(m.names) - set(n.names) for m, n in ((other, model), (model, other)))
    slots = search.world.slots
    theta = model.fit.theta.copy()
    theta[slots[gone]] = 0.0
    theta[slots[own]] = other.fit.theta[slots[own]]
    return Start(other.names, theta, model.fit.states)


def rivals(search: Search, model: Model) -> list[Model]:
    """Return models with as many effects that explain the data nearly as well, including the model.

    Args:
        search: the search, with all fitted models.
        model: the model to compare with.
    """
    size = len(model.names)
    return [
        other
        for other in search.models.values()
        if len(other.names) == size and _is_near(search, other, model)
    ]


def _is_near(search: Search, other: Model, model: Model) -> bool:
    """Return whether two models are close in merit or in excess.

    Merit is misleading if the residual has structure.
    """
    if abs(model.merit - other.merit) < NEAR:
        return True
    return search.excess(other) < NEARLY * search.excess(model)


def smaller(search: Search, model: Model) -> list[Model]:
    """Return the models without one of the effects, from which the gain of each is measured.

    Args:
        search: the search, with all fitted models.
        model: the larger model.
    """
    names = set(model.names)
    size = len(names) - 1
    smaller = []
    for other in search.models.values():
        if len(other.names) == size and set(other.names) < names:
            smaller.append(other)
    return smaller


def _noise_of(search: Search, model: Model) -> Noise | None:
    """Return the noise of the residual of a model; None if the residual has structure."""
    if remains(search, model).structure:
        return None
    sigma = np.maximum(model.likelihood.sigma, 1e-300)
    # Correlations are never negative, as in the score test.
    return Noise(sigma, np.maximum(model.likelihood.phi, 0.0))
