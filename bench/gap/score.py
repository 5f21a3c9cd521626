"""How much each candidate would explain: a score test in trajectory space, calibrated over the whole library.

What an effect changes is compared with the residual after taking out of both what the fitted parameters and initial
states can absorb (a Lagrange multiplier test; C. R. Rao 1948, doi:10.1017/S0305004100023987; R. F. Engle, Handbook of
Econometrics II, chapter 13). The score is twice the gain in log likelihood, each hypothesis with the correlation of
noise that suits it best, so that noise that remembers is no cause. What the best of a whole library reaches by chance is
found by doing the same to surrogate residuals (max-statistic calibration; P. H. Westfall, S. S. Young 1993).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from bench.gap.candidates import Directions
from bench.gap.colour import GRID, Mask, Noise, log_determinant, whitened
from bench.gap.fit import Fit
from methods.base import Array

SMALL = 4
"""Groups of more columns are taken as they are, without a choice of columns."""
RANK = 1e-7
"""Directions below this share of the largest singular value are none."""


@dataclass(frozen=True)
class Group:
    """Columns that act together: their places among the directions, and which must not be negative."""

    effect: str
    columns: tuple[int, ...]
    positive: tuple[bool, ...]


@dataclass(frozen=True)
class Scores:
    """Scores of the library about one model.

    Attributes:
        effects: names, the highest score first.
        score: twice the gain in log likelihood of each.
        chance: its 90 % quantile over surrogates (0 without them).
        group: the best group of each.
        c: coefficients of that group's columns, in units of the directions.
        p_value: probability that the highest score of a library, less its chance, is reached with nothing missing.
        phi: correlation of the noise under the best hypothesis.
        by_chance: (E, S) scores of the surrogates, less their chance.
    """

    effects: tuple[str, ...]
    score: Array
    chance: Array
    group: tuple[Group, ...]
    c: tuple[Array, ...]
    p_value: float
    phi: float
    by_chance: Array


class Projected:
    """Residuals and directions after all that the model's own freedom absorbs is taken out, for one correlation."""

    def __init__(self, at: Fit, residuals: Array, directions: Array, seen: Mask, noise: Noise) -> None:
        q = at.free.size
        own = whitened(np.where(seen[..., None], at.jacobian, 0.0), seen, noise)
        d = whitened(np.where(seen[..., None], directions, 0.0), seen, noise)
        r = whitened(np.where(seen[..., None], residuals, 0.0), seen, noise)
        runs = len(seen)
        count = seen.shape[1] * seen.shape[2]
        shared, d, r, inner = (part.reshape(runs, count, part.shape[3]) for part in (own[..., :q], d, r, own[..., q:]))
        for i in range(runs):
            basis = span(inner[i])
            shared[i], d[i], r[i] = (part[i] - basis @ (basis.T @ part[i]) for part in (shared, d, r))
        flat_shared, flat_d, flat_r = (part.reshape(runs * count, part.shape[2]) for part in (shared, d, r))
        basis = span(flat_shared)
        flat_d = flat_d - basis @ (basis.T @ flat_d)
        flat_r = flat_r - basis @ (basis.T @ flat_r)
        self.total = np.einsum("ns,ns->s", flat_r, flat_r)
        self.gram = flat_d.T @ flat_d
        self.cross = flat_d.T @ flat_r


def span(columns: Array) -> Array:
    """An orthonormal basis (n, k) of what the columns span."""
    sizes = np.sqrt(np.einsum("nk,nk->k", columns, columns))
    columns = columns[:, sizes > 0] / sizes[sizes > 0]
    if not columns.size:
        return np.zeros((len(columns), 0))
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    return u[:, s > RANK * s[0]]


def groups(directions: Directions) -> list[Group]:
    """The directions that act together."""
    found: dict[tuple[str, int], list[int]] = {}
    for i, probe in enumerate(directions.probes):
        found.setdefault((probe.effect, probe.group), []).append(i)
    return [
        Group(name, tuple(columns), tuple(not directions.probes[i].signed for i in columns))
        for (name, _), columns in found.items()
    ]


def explained(gram: Array, cross: Array, group: Group) -> tuple[Array, Array]:
    """Sum of squares (S,) that a group explains, and its coefficients (k, S): the best choice of its columns.

    Coefficients that must not be negative are held at zero where they would be.
    """
    count = len(group.columns)
    if count > SMALL:
        return _jointly(gram, cross, group)
    best, coefficients = np.zeros(cross.shape[1]), np.zeros((count, cross.shape[1]))
    scale = np.sqrt(np.maximum(np.diagonal(gram), 0.0))
    for size in range(1, count + 1):
        for chosen in combinations(range(count), size):
            columns = [group.columns[i] for i in chosen]
            if not (scale[columns] > 0).all():
                continue
            normal = gram[np.ix_(columns, columns)] / np.outer(scale[columns], scale[columns])
            if np.linalg.eigvalsh(normal)[0] < RANK:
                continue
            right = cross[columns] / scale[columns, None]
            solved = np.linalg.solve(normal, right)
            gain = np.einsum("ks,ks->s", solved, right)
            allowed = np.ones(cross.shape[1], dtype=bool)
            for i, row in zip(chosen, solved, strict=True):
                if group.positive[i]:
                    allowed &= row >= 0
            better = allowed & (gain > best * (1.0 + 1e-9))
            best = np.where(better, gain, best)
            whole = np.zeros_like(coefficients)
            whole[list(chosen)] = solved / scale[columns, None]
            coefficients = np.where(better, whole, coefficients)
    return best, coefficients


def _jointly(gram: Array, cross: Array, group: Group) -> tuple[Array, Array]:
    """The same for a group of many columns, none of them held."""
    columns = list(group.columns)
    scale = np.sqrt(np.maximum(np.diagonal(gram)[columns], 1e-300))
    values, vectors = np.linalg.eigh(gram[np.ix_(columns, columns)] / np.outer(scale, scale))
    kept = values > RANK * values[-1]
    right = vectors[:, kept].T @ (cross[columns] / scale[:, None])
    gain: Array = np.einsum("ks,ks->s", right, right / values[kept, None])
    return gain, (vectors[:, kept] @ (right / values[kept, None])) / scale[:, None]


def score(
    at: Fit, residual: Array, directions: Directions, seen: Mask, noise: Noise, surrogate: Array | None = None
) -> Scores:
    """Score every effect that has directions.

    Args:
        at: the model that the directions are about.
        residual: (R, T, C) what it leaves.
        directions: of the candidates.
        seen: (R, T, C) which samples there are.
        noise: sigma weighs channels against each other; its correlation is not used.
        surrogate: (S, R, T, C) residuals that mean nothing.
    """
    everything = residual[..., None]
    if surrogate is not None:
        everything = np.concatenate([everything, np.moveaxis(surrogate, 0, -1)], axis=3)
    members = groups(directions)
    names = list(dict.fromkeys(g.effect for g in members))
    count, shape = int(seen.sum()), (len(names), everything.shape[3])
    nothing = np.full(shape[1], -np.inf)
    best = np.full(shape, -np.inf)
    which: dict[str, tuple[float, Group, Array, float]] = {}
    for phi in GRID:
        projected = Projected(at, everything, directions.values, seen, noise.coloured(phi))
        determinant = 2.0 * log_determinant(seen, np.full(seen.shape[2], phi))
        floor = 1e-12 * projected.total + 1e-300
        nothing = np.maximum(nothing, determinant - count * np.log(np.maximum(projected.total, floor)))
        for g in members:
            gain, c = explained(projected.gram, projected.cross, g)
            value = determinant - count * np.log(np.maximum(projected.total - gain, floor))
            row = names.index(g.effect)
            if value[0] > which.get(g.effect, (-np.inf,))[0]:
                which[g.effect] = (float(value[0]), g, c[:, 0], phi)
            best[row] = np.maximum(best[row], value)
    return _ranked(names, best - nothing, which)


def _ranked(names: Sequence[str], gains: Array, which: dict[str, tuple[float, Group, Array, float]]) -> Scores:
    observed, chance = gains[:, 0], np.zeros(len(names))
    p_value = 1.0
    if gains.shape[1] > 1:
        chance = np.quantile(gains[:, 1:], 0.9, axis=1)
        p_value = tail(gains[:, 1:] - chance[:, None], observed - chance)
    order = np.argsort(-observed, kind="stable")
    ranked = [names[i] for i in order]
    return Scores(
        tuple(ranked), observed[order], chance[order], tuple(which[n][1] for n in ranked),
        tuple(which[n][2] for n in ranked), p_value, which[ranked[0]][3] if ranked else 0.0,
        (gains[:, 1:] - chance[:, None])[order],
    )  # fmt: skip


def tail(by_chance: Array, observed: Array) -> float:
    """Probability that the largest of a column of `by_chance` (E, S) reaches the largest of `observed` (E,).

    Beyond the most extreme fifth of the surrogates the tail is taken for exponential, as that of a likelihood ratio is.
    """
    if not observed.size:
        return 1.0
    largest, value = np.sort(by_chance.max(axis=0)), float(observed.max())
    count = largest.size
    above = int((largest >= value).sum())
    begin = largest[int(0.8 * count)]
    if value <= begin or count < 20:
        return (1.0 + above) / (1.0 + count)
    mean = max(float((largest[int(0.8 * count) :] - begin).mean()), 1e-9)
    return float(0.2 * np.exp(-(value - begin) / mean))
