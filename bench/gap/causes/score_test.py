"""How much each candidate would explain: a score test in trajectory space, calibrated over the
whole library.

What an effect changes is compared with the residual after taking out of both what the fitted
parameters and initial states can absorb (a Lagrange multiplier test; C. R. Rao 1948,
doi:10.1017/S0305004100023987; R. F. Engle, Handbook of Econometrics II, chapter 13). The score is
twice the gain in log likelihood, each hypothesis with the correlation of noise that suits it best,
so that noise that remembers is no cause. What the best of a whole library reaches by chance is
found by doing the same to surrogate residuals (max-statistic calibration; P. H. Westfall, S. S.
Young 1993).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from bench.gap.causes.candidates import Directions
from bench.gap.model.fit import Fit
from bench.gap.model.noise import GRID, Mask, Noise, log_determinant
from sims.base import Array

SMALL = 4
"""Groups of more columns are taken as they are, without a choice of columns."""
ABSORBED = 1e-12
"""Of a direction's sum of squares less than this share is left where the model's own freedom
absorbs it.
"""
MANY, PEAKS = 12, 3
"""An effect with more shapes than the first is begun from so many of them."""
RANK = 1e-9
"""Directions below this share of the largest eigenvalue of their scaled products are none."""


@dataclass(frozen=True)
class Group:
    """Columns that act together: their places among the directions, and which must not be negative."""

    effect: str
    columns: tuple[int, ...]
    positive: tuple[bool, ...]


Peak = tuple[Group, Array]


@dataclass(frozen=True)
class Scores:
    """Scores of the library about one model.

    Attributes:
        effects: names, the highest score first.
        score: twice the gain in log likelihood of each.
        chance: its 90 % quantile over surrogates (0 without them).
        peaks: of each its best group with the coefficients of its columns, in units of the
            directions; behind it, where an effect has shapes by the dozen, further ones that are
            better than their neighbours.
        p_value: probability that the highest score of a library, less its chance, is reached with
            nothing missing.
        phi: correlation of the noise under the best hypothesis.
        by_chance: (E, S) scores of the surrogates, less their chance.
        white: (E,) scores if noise does not remember.
    """

    effects: tuple[str, ...]
    score: Array
    chance: Array
    peaks: tuple[tuple[Peak, ...], ...]
    p_value: float
    phi: float
    by_chance: Array
    white: Array


class Products:
    """Inner products of residuals and directions after all that the model's own freedom absorbs is
    taken out.

    Whitening by a correlation phi mixes products of samples with themselves and with those before
    them, so that one pass over the samples serves every phi. All are computed run by run, since
    initial states are a run's own.
    """

    def __init__(
        self, at: Fit, residuals: Array, directions: Array, seen: Mask, sigma: Array
    ) -> None:
        self._own, self._states = at.free.size, at.jacobian.shape[3] - at.free.size
        self._directions, self._runs = directions.shape[3], []
        follows = np.zeros_like(seen)
        follows[:, 1:] = seen[:, 1:] & seen[:, :-1]
        for r in range(len(seen)):
            left = np.concatenate([at.jacobian[r], directions[r]], axis=2) / sigma[:, None]
            right = residuals[r] / sigma[:, None]
            self._runs.append(_laid(left, right, seen[r], follows[r]))

    def projected(self, phi: float) -> tuple[Array, Array, Array]:
        """Sums of squares (S,) of the residuals, products of directions (K, K) and of both (K, S)."""
        q, s = self._own, self._states
        total: Array = np.zeros(())
        normal, cross, whole = total, total, total
        for squares, products, mixed in self._runs:
            n, c, t = (
                part[0] + (part[1] - phi * part[2] + phi * phi * part[3]) / (1.0 - phi * phi)
                for part in (products, mixed, squares)
            )
            own = slice(q, q + s)
            whole = whole + np.diagonal(n)[q + s :]
            rest = np.r_[0:q, q + s : len(n)]
            inverse = _inverse(n[own, own])
            total = total + t - np.einsum("ks,kl,ls->s", c[own], inverse, c[own])
            cross = cross + c[rest] - n[rest][:, own] @ (inverse @ c[own])
            normal = normal + n[np.ix_(rest, rest)] - n[rest][:, own] @ inverse @ n[own][:, rest]
        inverse = _inverse(normal[:q, :q])
        total = total - np.einsum("ks,kl,ls->s", cross[:q], inverse, cross[:q])
        gram = normal[q:, q:] - normal[q:, :q] @ inverse @ normal[:q, q:]
        kept = np.diagonal(gram) > ABSORBED * whole  # of the others only rounding is left
        gram = np.where(kept[:, None] & kept, (gram + gram.T) / 2.0, 0.0)
        both = np.where(kept[:, None], cross[q:] - normal[q:, :q] @ (inverse @ cross[:q]), 0.0)
        return np.maximum(total, 0.0), gram, both


Parts = tuple[Array, Array, Array, Array]


def _laid(left: Array, right: Array, seen: Mask, follows: Mask) -> tuple[Parts, Parts, Parts]:
    """Products of samples without a forerunner, of those with one, of both with each other, and of
    the forerunners.
    """
    here, later = seen & ~follows, follows[1:]
    first, second = (_rows(part, here) for part in (left, right))
    now, then = ((_rows(part[1:], later), _rows(part[:-1], later)) for part in (left, right))
    mixed = now[0].T @ now[1]
    products = (first.T @ first, now[0].T @ now[0], mixed + mixed.T, now[1].T @ now[1])
    cross = (
        first.T @ second,
        now[0].T @ then[0],
        now[0].T @ then[1] + now[1].T @ then[0],
        now[1].T @ then[1],
    )
    squares = (
        np.square(second).sum(axis=0),
        np.square(then[0]).sum(axis=0),
        2.0 * (then[0] * then[1]).sum(axis=0),
        np.square(then[1]).sum(axis=0),
    )
    return squares, products, cross


def _rows(values: Array, mask: Mask) -> Array:
    """Values (T, C, M) where the mask (T, C) holds, (n, M)."""
    return values.reshape(-1, values.shape[2]) if mask.all() else values[mask]


def _inverse(normal: Array) -> Array:
    """Of a positive semidefinite matrix; directions that hardly count are left out."""
    scale = np.sqrt(np.maximum(np.diagonal(normal), 0.0))
    scale = np.where(scale > 0, scale, np.inf)
    if not scale.size:
        return normal
    values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    kept = values > RANK * max(float(values[-1]), 1e-300)
    result: Array = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T / np.outer(scale, scale)
    return result


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
    """Sum of squares (S,) that a group explains, and its coefficients (k, S): the best choice of
    its columns.

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
    at: Fit,
    residual: Array,
    directions: Directions,
    seen: Mask,
    noise: Noise,
    surrogate: Array | None = None,
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
    nothing, white = np.full(shape[1], -np.inf), np.zeros(len(names))
    best = np.full(shape, -np.inf)
    which: dict[str, list[_Found]] = {
        n: [_Found(-np.inf, g, np.zeros(0), 0.0) for g in members if g.effect == n] for n in names
    }
    products = Products(at, everything, directions.values, seen, noise.sigma)
    for phi in GRID:
        total, gram, cross = products.projected(phi)
        determinant = 2.0 * log_determinant(seen, np.full(seen.shape[2], phi))
        floor = 1e-12 * total + 1e-300
        nothing = np.maximum(nothing, determinant - count * np.log(np.maximum(total, floor)))
        for row, name in enumerate(names):
            for i, found in enumerate(which[name]):
                gain, c = explained(gram, cross, found.group)
                value = determinant - count * np.log(np.maximum(total - gain, floor))
                if value[0] > found.value:
                    which[name][i] = _Found(float(value[0]), found.group, c[:, 0], phi)
                best[row] = np.maximum(best[row], value)
                if phi == 0:
                    white[row] = max(
                        white[row],
                        count * float(np.log(total[0] / max(total[0] - gain[0], floor[0]))),
                    )
    return _ranked(names, best - nothing, which, white)


class _Found(NamedTuple):
    """The likeliest hypothesis about a group: twice its log likelihood, coefficients, correlation
    of the noise.
    """

    value: float
    group: Group
    c: Array
    phi: float


def _peaks(found: Sequence[_Found]) -> tuple[Peak, ...]:
    """The best, and of a dozen and more the next that are better than their neighbours."""
    values = np.array([f.value for f in found])
    around = np.concatenate([[-np.inf], values, [-np.inf]])
    local = (
        (values >= around[:-2]) & (values >= around[2:])
        if len(found) > MANY
        else values == values.max()
    )
    order = [i for i in np.argsort(-values, kind="stable") if local[i]]
    return tuple((found[i].group, found[i].c) for i in order[: PEAKS if len(found) > MANY else 1])


def _ranked(
    names: Sequence[str], gains: Array, which: dict[str, list[_Found]], white: Array
) -> Scores:
    observed, chance = gains[:, 0], np.zeros(len(names))
    p_value = 1.0
    if gains.shape[1] > 1:
        chance = np.quantile(gains[:, 1:], 0.9, axis=1)
        p_value = tail(gains[:, 1:] - chance[:, None], observed - chance)
    order = np.argsort(-observed, kind="stable")
    ranked = [names[i] for i in order]
    phi = max(which[ranked[0]], key=lambda found: found.value).phi if ranked else 0.0
    return Scores(
        tuple(ranked),
        observed[order],
        chance[order],
        tuple(_peaks(which[n]) for n in ranked),
        p_value,
        phi,
        (gains[:, 1:] - chance[:, None])[order],
        white[order],
    )


def tail(by_chance: Array, observed: Array) -> float:
    """Probability that the largest of a column of `by_chance` (E, S) reaches the largest of
    `observed` (E,).

    Beyond the most extreme fifth of the surrogates the tail is taken for exponential, as that of a
    likelihood ratio is.
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
