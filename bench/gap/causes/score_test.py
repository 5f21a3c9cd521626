"""How much each candidate would explain: a score test in trajectory space, calibrated over the
whole library.

What an effect changes is compared with the residual after taking out of both what the fitted
parameters and initial states can absorb (a Lagrange multiplier test; C. R. Rao 1948,
doi:10.1017/S0305004100023987; R. F. Engle, Handbook of Econometrics II, chapter 13). The score is
twice the gain in log likelihood, each hypothesis with the correlation of noise that suits it best,
so that noise that remembers is no cause. What the best of a whole library reaches by chance is
found by doing the same to surrogate residuals (max-statistic calibration; P. H. Westfall, S. S.
Young 1993).

The inner products <a, b> of residuals e and directions D, whitened by a correlation phi and without
what is absorbed, are those of `bench.gap.causes.products`, eqs. (1) and (2) there.

With G = <D, D> and h = <D, e> a group of directions explains h'G^-1 h of the sum of squares <e, e>.
The sigma of n samples estimated besides, twice the log likelihood is, up to a constant,

    l(phi) = log det W'W - n log(<e, e> - h'G^-1 h)                                            (3)

and the score of an effect is the likelihood ratio, either side at its own correlation,

    score = max over phi and groups of l(phi) - max over phi of l(phi) without directions      (4)

For effects k and surrogates s, with chance_k the 90 % quantile of score_k over s, the p value is

    p = P(max over k of (score_k(s) - chance_k) >= max over k of (score_k - chance_k))         (5)
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from bench.gap.causes.candidates import Directions
from bench.gap.causes.products import RANK, Products
from bench.gap.model.fit import Fit
from bench.gap.model.noise import GRID, Mask, Noise, log_determinant
from sims.base import Array

SMALL = 4
"""Groups of more columns are taken as they are, without a choice of columns."""
MANY = 12
"""An effect with more shapes than this is begun from several of them."""
PEAKS = 3
"""From so many."""
LUCK = 0.9
"""Quantile over surrogates that is an effect's chance."""
EXTREME = 0.8
"""Quantile over surrogates beyond which their tail is taken for exponential."""
BEYOND = 0.2
"""The share of them that lies there."""
FEWEST = 20
"""Of fewer surrogates no tail is guessed."""


@dataclass(frozen=True)
class Group:
    """Columns that act together.

    Attributes:
        effect: whose they are.
        columns: their places among the directions.
        positive: which of them must not be negative.
    """

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


def groups(directions: Directions) -> list[Group]:
    """The directions that act together."""
    places: dict[tuple[str, int], list[int]] = {}
    for i, probe in enumerate(directions.probes):
        key = probe.effect, probe.group
        places.setdefault(key, []).append(i)
    members = []
    for (effect, _), columns in places.items():
        probes = [directions.probes[i] for i in columns]
        positive = tuple(not probe.signed for probe in probes)
        members.append(Group(effect, tuple(columns), positive))
    return members


def explained(gram: Array, cross: Array, group: Group) -> tuple[Array, Array]:
    """Sum of squares (S,) that a group explains, and its coefficients (k, S): the best choice of
    its columns.

    Coefficients that must not be negative are held at zero where they would be: the least squares
    of the constraint are those of some choice of columns, so all are tried (C. L. Lawson, R. J.
    Hanson, Solving Least Squares Problems, 1974, chapter 23).
    """
    count = len(group.columns)
    if count > SMALL:
        return _jointly(gram, cross, group)
    samples = cross.shape[1]
    best = np.zeros(samples)
    coefficients = np.zeros((count, samples))
    for chosen in _choices(count):
        columns = [group.columns[i] for i in chosen]
        solved = _solved(gram, cross, columns)
        if solved is None:
            continue
        gain, c, scaled = solved
        allowed = np.ones(samples, dtype=bool)
        for i, row in zip(chosen, scaled, strict=True):
            if group.positive[i]:
                allowed &= row >= 0
        # More columns must explain more than rounding: else the fewer stand.
        more = gain > best * (1.0 + 1e-9)
        better = allowed & more
        best = np.where(better, gain, best)
        # Columns that are not chosen have no part in it.
        whole = np.zeros_like(coefficients)
        whole[chosen] = c
        coefficients = np.where(better, whole, coefficients)
    return best, coefficients


def _choices(count: int) -> Iterator[list[int]]:
    """Every choice of at least one of so many columns, those of fewer first."""
    for size in range(1, count + 1):
        for chosen in combinations(range(count), size):
            yield list(chosen)


def _solved(gram: Array, cross: Array, columns: list[int]) -> tuple[Array, Array, Array] | None:
    """h'G^-1 h (S,) of some columns, G^-1 h (k, S), and that in units of the columns' lengths; None
    where columns are absorbed or alike.
    """
    powers = np.diagonal(gram)[columns]
    scale = np.sqrt(np.maximum(powers, 0.0))
    if not (scale > 0).all():
        return None
    products = gram[np.ix_(columns, columns)]
    normal = products / np.outer(scale, scale)
    # Columns that are alike share what they explain in any way: a choice with fewer has it.
    if np.linalg.eigvalsh(normal)[0] < RANK:
        return None
    lengths = scale[:, None]
    right = cross[columns] / lengths
    scaled = np.linalg.solve(normal, right)
    gain = np.einsum("ks,ks->s", scaled, right)
    return gain, scaled / lengths, scaled


def _jointly(gram: Array, cross: Array, group: Group) -> tuple[Array, Array]:
    """The same for a group of many columns, none of them held."""
    columns = list(group.columns)
    # Of many columns some nearly repeat others, as hats that overlap do: what they add is rounding.
    powers = np.diagonal(gram)[columns]
    scale = np.sqrt(np.maximum(powers, 1e-300))
    products = gram[np.ix_(columns, columns)]
    scaled = products / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(scaled)
    counted = values > RANK * values[-1]
    some = vectors[:, counted]
    lengths = scale[:, None]
    # Along eigenvectors G is diagonal, and h'G^-1 h a sum of one term for each.
    right = some.T @ (cross[columns] / lengths)
    solved = right / values[counted, None]
    gain: Array = np.einsum("ks,ks->s", right, solved)
    return gain, (some @ solved) / lengths


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
    # One column for the residual and one for each surrogate: all are scored in the same products.
    everything = residual[..., None]
    if surrogate is not None:
        drawn = np.moveaxis(surrogate, 0, -1)
        everything = np.concatenate([everything, drawn], axis=3)
    columns = everything.shape[3]
    table = _Table(groups(directions), columns, int(seen.sum()))
    products = Products(
        at,
        everything,
        directions.values,
        seen,
        noise.sigma,
    )
    # A grid: the products of one pass over the samples serve every correlation.
    for phi in GRID:
        common = np.full(seen.shape[2], phi)
        determinant = 2.0 * log_determinant(seen, common)
        table.enter(phi, determinant, *products.projected(phi))
    gains = table.best - table.without  # (4)
    return _ranked(table.names, gains, table.hypotheses, table.white)


class _Table:
    """The best of every effect so far, over the correlations that were entered.

    Args:
        members: the groups of all effects.
        columns: residual and surrogates.
        count: n of eq. (3).
    """

    def __init__(self, members: Sequence[Group], columns: int, count: int) -> None:
        self._count = count
        self.hypotheses: dict[str, list[_Hypothesis]] = {}
        for group in members:
            unknown = _Hypothesis(-np.inf, group, np.zeros(0), 0.0)
            self.hypotheses.setdefault(group.effect, []).append(unknown)
        self.names = list(self.hypotheses)
        count = len(self.names)
        self.best = np.full((count, columns), -np.inf)
        self.without = np.full(columns, -np.inf)
        self.white = np.zeros(count)

    def enter(
        self, phi: float, determinant: float, total: Array, gram: Array, cross: Array
    ) -> None:
        """Take a correlation into account.

        Args:
            phi: the correlation.
            determinant: log det W'W of eq. (3).
            total: <e, e> (S,).
            gram: G (K, K).
            cross: h (K, S).
        """
        # What is explained whole leaves rounding, of which the logarithm has a bound.
        floor = 1e-12 * total + 1e-300
        left = np.maximum(total, floor)
        nothing = determinant - self._count * np.log(left)  # (3) without directions
        self.without = np.maximum(self.without, nothing)
        for row, name in enumerate(self.names):
            hypotheses = self.hypotheses[name]
            for i, hypothesis in enumerate(hypotheses):
                group = hypothesis.group
                gain, c = explained(gram, cross, group)
                left = np.maximum(total - gain, floor)
                value = determinant - self._count * np.log(left)  # (3)
                self.best[row] = np.maximum(self.best[row], value)
                # The first column is the residual; only its coefficients begin fits.
                own = float(value[0])
                if own > hypothesis.value:
                    hypotheses[i] = _Hypothesis(own, group, c[:, 0], phi)
                # White noise is the one of the grid that leaves sums of squares as they are.
                if phi == 0:
                    ratio = float(np.log(total[0] / left[0]))
                    self.white[row] = max(self.white[row], self._count * ratio)


class _Hypothesis(NamedTuple):
    """The likeliest hypothesis about a group: twice its log likelihood, coefficients, correlation
    of the noise.
    """

    value: float
    group: Group
    c: Array
    phi: float


def _peaks(hypotheses: Sequence[_Hypothesis]) -> tuple[Peak, ...]:
    """The best, and of a dozen and more the next that are better than their neighbours."""
    values = np.array([hypothesis.value for hypothesis in hypotheses])
    several = len(hypotheses) > MANY
    peaks = values == values.max()
    if several:
        # Neighbours of the best are the same answer once more, so only local maxima count.
        around = np.concatenate([[-np.inf], values, [-np.inf]])
        above_former = values >= around[:-2]
        above_latter = values >= around[2:]
        peaks = above_former & above_latter
    order = np.argsort(-values, kind="stable")
    most = PEAKS if several else 1
    chosen = [hypotheses[i] for i in order if peaks[i]][:most]
    return tuple((hypothesis.group, hypothesis.c) for hypothesis in chosen)


def _ranked(
    names: Sequence[str], gains: Array, hypotheses: dict[str, list[_Hypothesis]], white: Array
) -> Scores:
    """The scores in order, and how likely the best is by chance.

    Args:
        names: (E,) effects.
        gains: (E, 1 + S) scores of the residual, then of the surrogates.
        hypotheses: the likeliest of each effect's groups.
        white: (E,) scores without correlation.
    """
    observed = gains[:, 0]
    drawn = gains[:, 1:]
    chance = np.zeros(len(names))
    p_value = 1.0
    if drawn.shape[1]:
        # An effect with many shapes gains more by chance, and must not set the level for the rest.
        chance = np.quantile(drawn, LUCK, axis=1)
        p_value = tail(drawn - chance[:, None], observed - chance)  # (5)
    by_chance = drawn - chance[:, None]
    order = np.argsort(-observed, kind="stable")
    ranked = [names[i] for i in order]
    phi = 0.0
    if ranked:
        best = hypotheses[ranked[0]]
        phi = max(best, key=lambda hypothesis: hypothesis.value).phi
    peaks = [_peaks(hypotheses[name]) for name in ranked]
    return Scores(
        effects=tuple(ranked),
        score=observed[order],
        chance=chance[order],
        peaks=tuple(peaks),
        p_value=p_value,
        phi=phi,
        by_chance=by_chance[order],
        white=white[order],
    )


def tail(by_chance: Array, observed: Array) -> float:
    """Probability that the largest of a column of `by_chance` (E, S) reaches the largest of
    `observed` (E,), eq. (5).

    Beyond the most extreme fifth of the surrogates the tail is taken for exponential, as that of a
    likelihood ratio is.
    """
    if not observed.size:
        return 1.0
    largest = np.sort(by_chance.max(axis=0))
    value = float(observed.max())
    count = largest.size
    above = int((largest >= value).sum())
    # Counting ends at one in the number of surrogates; smaller chances are extrapolated.
    first = int(EXTREME * count)
    extreme = largest[first:]
    begin = extreme[0]
    if value <= begin or count < FEWEST:
        # The residual counts among its surrogates, so that no p value is zero.
        return (1.0 + above) / (1.0 + count)
    # The scale of an exponential is the mean of what lies beyond its beginning.
    beyond = extreme - begin
    mean = max(float(beyond.mean()), 1e-9)
    chance = BEYOND * np.exp(-(value - begin) / mean)
    return float(chance)
