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
what is absorbed, are those of `bench.gap.causes.products`, eqs. (1) and (2) there; what a group of
directions explains with G = <D, D> and h = <D, e> is found in `bench.gap.causes.gains`. The sigma
of n samples estimated besides, twice the log likelihood is, up to a constant,

    l(phi) = log det W'W - n log(<e, e> - h'G^-1 h)                                            (3)

and the score of an effect is the likelihood ratio, either side at its own correlation,

    score = max over phi and groups of l(phi) - max over phi of l(phi) without directions      (4)

For effects k and surrogates s, with chance_k the 90 % quantile of score_k over s, the p value is

    p = P(max over k of (score_k(s) - chance_k) >= max over k of (score_k - chance_k))         (5)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.gap.causes.candidates import Directions
from bench.gap.causes.gains import Batch, Group, batches, explained, groups
from bench.gap.causes.products import Design, Products
from bench.gap.model.noise import GRID, Mask, Noise, log_determinant
from bench.gap.model.problem import Fit
from sims.base import Array

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
CLOSE = (3e-4, 0.06)
"""Chances between these may decide, and are found from more surrogates."""
MORE = 4
"""So many times as many."""

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


class ScoreTest:
    """Scores every effect that has directions, against any residuals of one model.

    Args:
        at: the model that the directions are about.
        directions: of the candidates.
        seen: (R, T, C) which samples there are.
        noise: sigma weighs channels against each other; its correlation is not used.
    """

    def __init__(self, at: Fit, directions: Directions, seen: Mask, noise: Noise) -> None:
        self._groups = groups(directions)
        self._batches = batches(self._groups)
        self._count = int(seen.sum())
        blocks = [batch.columns for batch in self._batches]
        self._design = Design(at, directions.values, seen, noise.sigma, blocks)
        self._determinants = {
            phi: 2.0 * log_determinant(seen, np.full(seen.shape[2], phi)) for phi in GRID
        }

    def left(self, residuals: Array) -> Array:
        """What a fit of the model's own freedom leaves of residuals (S, R, T, C)."""
        return self._design.left(residuals)

    def scores(self, residual: Array, surrogate: Array | None = None) -> Scores:
        """Score a residual.

        Args:
            residual: (R, T, C) what the model leaves, zero where nothing was seen.
            surrogate: (S, R, T, C) residuals that mean nothing.
        """
        # The residual is the first of all: they are scored in the same products.
        drawn = np.zeros((0, *residual.shape)) if surrogate is None else surrogate
        table = _Table(self._groups, 1 + len(drawn), self._count)
        products = Products(self._design, residual[None], drawn)
        # A grid: the products of one pass over the samples serve every correlation.
        for phi, determinant in self._determinants.items():
            total, grams, cross = products.projected(phi)
            table.begin(phi, determinant, total)
            for batch, gram in zip(self._batches, grams, strict=True):
                table.enter(batch, *explained(gram, cross[batch.columns], batch.positive))
            table.end()
        return table.ranked()


def calibrated(
    test: ScoreTest, residual: Array, draw: Callable[[int], Array], count: int
) -> Scores:
    """Scores of a residual, from more surrogates where the chance is close to those that decide.

    A chance of one in a hundred that is found from a hundred surrogates is uncertain by a factor of
    three, one that is far from every level need not be known better (J. Besag, P. Clifford,
    Sequential Monte Carlo p-values, Biometrika 78(2), 301, 1991, doi:10.1093/biomet/78.2.301).

    Args:
        test: about the model.
        residual: (R, T, C) what the model leaves.
        draw: makes so many surrogates (S, R, T, C).
        count: how many of them are drawn first.
    """
    first = test.scores(residual, draw(count))
    low, high = CLOSE
    if not low < first.p_value < high:
        return first
    return test.scores(residual, draw(MORE * count))


def score(
    at: Fit,
    residual: Array,
    directions: Directions,
    seen: Mask,
    noise: Noise,
    surrogate: Array | None = None,
) -> Scores:
    """Score every effect that has directions once; arguments as those of `ScoreTest`."""
    return ScoreTest(at, directions, seen, noise).scores(residual, surrogate)


class _Table:
    """The best of every group and effect so far, over the correlations that were entered.

    Args:
        members: the groups of all effects.
        residuals: how many there are.
        count: n of eq. (3).
    """

    def __init__(self, members: Sequence[Group], residuals: int, count: int) -> None:
        self._count = count
        self._groups = members
        self._names = list(dict.fromkeys(group.effect for group in members))
        rows = {name: row for row, name in enumerate(self._names)}
        self._rows = np.array([rows[group.effect] for group in members], dtype=np.intp)
        effects = len(self._names)
        self._best = np.full((effects, residuals), -np.inf)
        self._without = np.full(residuals, -np.inf)
        self._white = np.zeros(effects)
        # Of each group as a hypothesis: twice its log likelihood, correlation, coefficients.
        self._values = np.full(len(members), -np.inf)
        self._phis = np.zeros(len(members))
        widest = max((len(group.columns) for group in members), default=0)
        self._coefficients = np.zeros((len(members), widest))
        self._gains = np.zeros((effects, residuals))
        self._phi = self._determinant = 0.0
        self._total = np.zeros(residuals)

    def begin(self, phi: float, determinant: float, total: Array) -> None:
        """Take a correlation into account, with log det W'W and <e, e> (S,) of eq. (3)."""
        self._phi, self._determinant, self._total = phi, determinant, total
        self._gains[...] = 0.0
        nothing = self._value(total, total)
        self._without = np.maximum(self._without, nothing)

    def _value(self, left: Array, total: Array) -> Array:
        """Eq. (3) of what is left of sums of squares."""
        # What is explained whole leaves rounding, of which the logarithm has a bound.
        floor = 1e-12 * total + 1e-300
        logarithms = np.log(np.maximum(left, floor))
        result: Array = self._determinant - self._count * logarithms
        return result

    def enter(self, batch: Batch, gain: Array, coefficients: Array) -> None:
        """What some groups explain (n, S), and their coefficients (n, k) of the residual."""
        rows = self._rows[batch.places]
        order = np.argsort(rows, kind="stable")
        present, first = np.unique(rows[order], return_index=True)
        largest = np.maximum.reduceat(gain[order], first, axis=0)
        self._gains[present] = np.maximum(self._gains[present], largest)
        own = self._value(self._total[0] - gain[:, 0], self._total[0])
        # The first one is the residual; only its coefficients begin fits.
        better = own > self._values[batch.places]
        places = batch.places[better]
        self._values[places] = own[better]
        self._phis[places] = self._phi
        self._coefficients[places, : coefficients.shape[1]] = coefficients[better]

    def end(self) -> None:
        """All groups have been entered."""
        values = self._value(self._total - self._gains, self._total)
        self._best = np.maximum(self._best, values)
        # White noise is the one of the grid that leaves sums of squares as they are.
        if self._phi == 0 and len(self._names):
            nothing = self._value(self._total[0], self._total[0])
            self._white = np.maximum(values[:, 0] - nothing, 0.0)

    def ranked(self) -> Scores:
        """The scores in order, and how likely the best is by chance."""
        gains = self._best - self._without  # (4)
        observed = gains[:, 0]
        drawn = gains[:, 1:]
        chance = np.zeros(len(self._names))
        p_value = 1.0
        if drawn.shape[1]:
            # An effect with many shapes gains more by chance, and must not set the level for the
            # rest.
            chance = np.quantile(drawn, LUCK, axis=1)
            p_value = tail(drawn - chance[:, None], observed - chance)  # (5)
        by_chance = drawn - chance[:, None]
        order = np.argsort(-observed, kind="stable")
        phi = 0.0
        if order.size:
            members = np.flatnonzero(self._rows == order[0])
            phi = float(self._phis[members[np.argmax(self._values[members])]])
        return Scores(
            effects=tuple(self._names[i] for i in order),
            score=observed[order],
            chance=chance[order],
            peaks=tuple(self._peaks(np.flatnonzero(self._rows == i)) for i in order),
            p_value=p_value,
            phi=phi,
            by_chance=by_chance[order],
            white=self._white[order],
        )

    def _peaks(self, places: NDArray[np.intp]) -> tuple[Peak, ...]:
        """Of an effect's groups the best, and of a dozen and more the next that are better than
        their neighbours.
        """
        values = self._values[places]
        several = len(places) > MANY
        peaks = values == values.max()
        if several:
            # Neighbours of the best are the same answer once more, so only local maxima count.
            around = np.concatenate([[-np.inf], values, [-np.inf]])
            above_former = values >= around[:-2]
            above_latter = values >= around[2:]
            peaks = above_former & above_latter
        order = np.argsort(-values, kind="stable")
        most = PEAKS if several else 1
        chosen = [places[i] for i in order if peaks[i]][:most]
        result = []
        for i in chosen:
            group = self._groups[i]
            result.append((group, self._coefficients[i, : len(group.columns)].copy()))
        return tuple(result)


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
