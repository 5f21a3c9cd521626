"""Selection of effects by linear regression of the innovations on the candidates' responses.

With the whitened innovations e of N samples and the whitened responses W of the candidates,

    G = Wᵀ W,   h = Wᵀ e,   rss(S) = eᵀ e - h_Sᵀ G_SS⁻¹ h_S                                     (1)

for the columns S of a set of effects. Effects are added one by one, first the one that decreases N
log rss most, until none fulfils

    N log(rss(S) / rss(S ∪ g)) > k log N + 2 log M                                              (2)

with k the number of coefficients of the effect g and M the number of candidates. The last term
bounds the gain of the best of M under the null hypothesis (D. P. Foster, E. I. George, Ann. Stat.
22(4), 1947, 1994, doi:10.1214/aos/1176325766). After each addition, effects that no longer fulfil
(2) are removed (A. Miller, Subset Selection in Regression, 2nd ed., 2002, chapter 3). No simulation
is needed.

Scores of single effects are compared with their null distribution: twice the gain in
log-likelihood by k further coefficients has a chi-squared distribution with k degrees of freedom
(S. S. Wilks 1938, doi:10.1214/aoms/1177732360). The score of an effect with n shapes is the best of
them, and the score of the library is the best of its effects. Shapes are assumed independent, which
overestimates the gain under the null hypothesis.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, chdtri

from bench.diagnosis.search.candidate_directions import CandidateDirection
from bench.diagnosis.search.explained_variance import (
    DirectionGroup,
    batch_groups,
    compute_explained_squares,
)
from bench.diagnosis.search.score_test import NULL_QUANTILE, CandidateScores
from sims.core.simulator import Array

IndexArray = NDArray[np.intp]

COLLINEARITY_TOLERANCE = 1e-7
"""Maximum share of a column's sum of squares that remains if it is collinear with other columns."""
MIN_BETTER_RUN_SHARE = 0.5
"""Minimum share of the left-out runs that a larger set must predict better."""
MIN_VISIBLE_GAIN = 7.0
"""Minimum gain of a column in twice the log-likelihood to be visible in the data."""
RIDGE = 1e-10
"""Ridge, as a share of each column's sum of squares."""
SMALLEST_RSS = 1e-9
"""Minimum residual sum of squares, as a share of the sum of squares of the innovations."""


@dataclass
class Regression:
    """Regression of innovations on responses.

    Attributes:
        groups: columns that act together; a set has at most one group of each effect.
        grams: G (R, K, K) of each run.
        crosses: h (R, K) of each run.
        totals: eᵀ e (R,) of each run.
        count: N.
        contains: effects that each effect contains, by name.
        always: columns that are part of every set and belong to no effect.
    """

    groups: Sequence[DirectionGroup]
    grams: Array
    crosses: Array
    totals: Array
    count: int
    contains: Mapping[str, Sequence[str]] = field(default_factory=dict)
    always: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """Sum the products of eq. (1) over all runs, and group the columns by effect."""
        self.gram, self.cross = self.grams.sum(axis=0), self.crosses.sum(axis=0)
        self.total = float(self.totals.sum())
        self._batches = batch_groups(self.groups)
        self.effects = list(dict.fromkeys(group.effect for group in self.groups))
        self._nuisance = DirectionGroup("", self.always, (False,) * len(self.always))

    def nuisance(self, chosen: Sequence[DirectionGroup]) -> float:
        """Return the coefficient of the first column of `always`, fitted together with a set."""
        _, parts = self._fit_groups([*chosen, self._nuisance])
        return float(parts[-1][0]) if self.always else 0.0

    def make_regression_without(self, own_columns: Sequence[int]) -> Regression:
        """Return the regression without an effect that is in the model.

        Args:
            own_columns: columns of the effect, which are part of every set; the first one is its
                whole change.
        """
        whole, always = own_columns[0], tuple(c for c in self.always if c not in own_columns)
        # Innovations without the effect: e + w of its whole change.
        crosses = self.crosses + self.grams[:, :, whole]
        totals = self.totals + 2.0 * self.crosses[:, whole] + self.grams[:, whole, whole]
        return replace(self, crosses=crosses, totals=totals, always=always)

    def compute_gain(self, own: Sequence[int]) -> float:
        """Return the gain of columns in twice the log-likelihood, with any signs."""
        group = DirectionGroup("", tuple(own), (False,) * len(own))
        return self.compute_log_ratio(self.solve([])[0], self.solve([group])[0])

    def shows_nuisance(self, chosen: Sequence[DirectionGroup]) -> bool:
        """Return whether the data show the first column of `always`, in addition to a set."""
        with_it, parts = self._fit_groups([*chosen, self._nuisance])
        others = DirectionGroup("", self.always[1:], (False,) * (len(self.always) - 1))
        without, _ = self._fit_groups([*chosen, others])
        return (
            float(parts[-1][0]) > 0.5
            and self.compute_log_ratio(without, with_it) > MIN_VISIBLE_GAIN
        )

    def solve(self, chosen: Sequence[DirectionGroup]) -> tuple[float, list[Array]]:
        """Fit a set of groups, and return the residual sum of squares and all coefficients."""
        rss, parts = self._fit_groups([*chosen, self._nuisance])
        return rss, parts[:-1]

    def _fit_groups(
        self,
        chosen: Sequence[DirectionGroup],
        gram: Array | None = None,
        cross: Array | None = None,
    ) -> tuple[float, list[Array]]:
        """Fit a set of groups.

        Constrained coefficients that are negative are fixed at zero one by one, the most negative
        first.
        """
        gram = self.gram if gram is None else gram
        cross = self.cross if cross is None else cross
        columns = list_columns(chosen)
        positive = np.array([p for group in chosen for p in group.positive], dtype=bool)
        active = np.ones(columns.size, dtype=bool)
        solution = np.zeros(columns.size)
        while active.any():
            active_columns = columns[active]
            normal, scale = _normalise_gram(gram, active_columns)
            scaled_solution = np.linalg.solve(normal, cross[active_columns] / scale)
            solution[:] = 0.0
            solution[active] = scaled_solution / scale
            negative = np.flatnonzero(active & positive & (solution < 0))
            if not negative.size:
                break
            sizes = solution[negative] * np.sqrt(np.diagonal(gram)[columns[negative]])
            active[negative[np.argmin(sizes)]] = False
            solution[:] = 0.0
        explained_squares = float(solution @ cross[columns])
        # The formula also holds for a solution with some coefficients fixed at zero.
        rss = max(self.total - explained_squares, SMALLEST_RSS * self.total)
        parts, begin = [], 0
        for group in chosen:
            parts.append(solution[begin : begin + len(group.column_indices)].copy())
            begin += len(group.column_indices)
        return rss, parts

    def compute_log_ratio(self, before: float, after: float) -> float:
        """Return twice the gain in log-likelihood, N log(before / after).

        Args:
            before: residual sum of squares of the smaller set.
            after: residual sum of squares of the larger set.
        """
        return float(self.count * np.log(before / after))

    def price(self, group: DirectionGroup) -> float:
        """Return the minimum gain of an effect in twice the log-likelihood.

        It is k log N + 2 log M for k coefficients, N samples and M candidate effects: the right
        side of eq. (2) of the module docstring.
        """
        coefficients = len(group.column_indices) * np.log(max(self.count, 2))
        return float(coefficients + 2.0 * np.log(max(len(self.effects), 2)))

    def gains(self, chosen: Sequence[DirectionGroup]) -> Array:
        """Return the gain (n,) in twice the log-likelihood of each group in addition to a set.

        The columns of the set are projected out first. Groups that are collinear with the set, or
        that the set contains, gain nothing.
        """
        columns = list_columns(chosen)
        columns = np.append(columns, np.array(self.always, dtype=np.intp))
        gram, cross, rss = self.gram, self.cross, self.total
        if columns.size:
            normal, scale = _normalise_gram(gram, columns)
            rows = gram[columns] / scale[:, None]
            solved = np.linalg.solve(normal, np.c_[rows, cross[columns] / scale])
            gram = gram - rows.T @ solved[:, :-1]
            cross = cross - rows.T @ solved[:, -1]
            rss, _ = self.solve(chosen)
        is_collinear = np.diagonal(gram) <= COLLINEARITY_TOLERANCE * np.diagonal(self.gram)
        contained_effects = set(self._list_contained_effects(chosen))
        result = np.zeros(len(self.groups))
        gram = np.where(is_collinear[:, None] | is_collinear[None], 0.0, gram)
        cross = np.where(is_collinear, 0.0, cross)
        for batch in self._batches:
            blocks = gram[batch.columns[:, :, None], batch.columns[:, None, :]]
            explained, _ = compute_explained_squares(
                blocks, cross[batch.columns][..., None], batch.positive
            )
            remaining = np.maximum(rss - explained[:, 0], SMALLEST_RSS * self.total)
            result[batch.group_indices] = self.count * np.log(rss / remaining)
        for i, group in enumerate(self.groups):
            if group.effect in contained_effects:
                result[i] = 0.0
        return result

    def compute_net_gains(self, chosen: Sequence[DirectionGroup] = ()) -> Array:
        """Return the gain of each group in addition to a set, minus its price (n,)."""
        prices = np.array([self.price(group) for group in self.groups])
        net: Array = self.gains(chosen) - prices
        return net

    def _list_contained_effects(self, chosen: Sequence[DirectionGroup]) -> list[str]:
        """Return the effects of a set, with all effects that they contain."""
        effects = [group.effect for group in chosen]
        return effects + [name for effect in effects for name in self.contains.get(effect, ())]

    def select(self, max_groups: int, begin: Sequence[DirectionGroup] = ()) -> list[DirectionGroup]:
        """Select effects by forward and backward steps.

        The effect with the largest gain above its price is added if it predicts left-out runs
        better; then effects that no longer gain their price are removed.

        Args:
            max_groups: maximum number of effects.
            begin: initial set.
        """
        chosen = list(begin)
        while len(chosen) < max_groups:
            gains = self.compute_net_gains(chosen)
            best = int(np.argmax(gains))
            if gains[best] <= 0.0:
                break
            larger = [*chosen, self.groups[best]]
            if not self.generalises(chosen, larger):
                break
            larger = self.prune(larger)
            if self.groups[best] not in larger:
                break
            chosen = larger
        return chosen

    def generalises(
        self, smaller: Sequence[DirectionGroup], larger: Sequence[DirectionGroup]
    ) -> bool:
        """Return whether a larger set predicts left-out runs better.

        Each run is left out in turn (cross-validation; M. Stone, J. R. Stat. Soc. B 36(2), 111,
        1974).

        Args:
            smaller: the smaller set.
            larger: the larger set.
        """
        if len(self.totals) < 2:
            return True
        before, after = self._compute_left_out_rss(smaller), self._compute_left_out_rss(larger)
        return bool(after.sum() < before.sum() and (after < before).mean() >= MIN_BETTER_RUN_SHARE)

    def _compute_left_out_rss(self, chosen: Sequence[DirectionGroup]) -> Array:
        """Return the residual sum of squares (R,) of each run, predicted from the other runs."""
        residual_squares = []
        groups = [*chosen, self._nuisance]
        columns = list_columns(groups)
        for run, total in enumerate(self.totals):
            gram, cross = self.gram - self.grams[run], self.cross - self.crosses[run]
            _, parts = self._fit_groups(groups, gram, cross)
            coefficients = np.concatenate(parts) if parts else np.zeros(0)
            block = self.grams[run][np.ix_(columns, columns)]
            residual_squares.append(
                total
                - 2.0 * coefficients @ self.crosses[run][columns]
                + coefficients @ block @ coefficients
            )
        return np.array(residual_squares)

    def prune(self, chosen: Sequence[DirectionGroup]) -> list[DirectionGroup]:
        """Remove effects one by one whose gain is below their price, the right side of (2).

        The effect with the smallest net gain is removed first.
        """
        remaining = list(chosen)
        while remaining:
            rss, _ = self.solve(remaining)
            losses = []
            for group in remaining:
                others = [other for other in remaining if other is not group]
                rss_without = self.solve(others)[0]
                losses.append(self.compute_log_ratio(rss_without, rss) - self.price(group))
            weakest = int(np.argmin(losses))
            if losses[weakest] > 0:
                break
            del remaining[weakest]
        return remaining


def _normalise_gram(gram: Array, columns: IndexArray) -> tuple[Array, Array]:
    """Return the scaled normal matrix of some columns, and the lengths of these columns.

    Its diagonal is one plus the ridge.
    """
    scale = np.sqrt(np.maximum(np.diagonal(gram)[columns], 1e-300))
    normal = gram[np.ix_(columns, columns)] / scale / scale[:, None]
    normal[np.diag_indices_from(normal)] += RIDGE
    return normal, scale


def list_columns(groups: Sequence[DirectionGroup]) -> IndexArray:
    """Return the columns of some groups, one group after another."""
    return np.array([c for group in groups for c in group.column_indices], dtype=np.intp)


def group_probes(probes: Sequence[CandidateDirection]) -> list[DirectionGroup]:
    """Group the columns of the probes of one effect at one grid point, which act together."""
    columns_by_group: dict[tuple[str, int], list[int]] = {}
    for i, probe in enumerate(probes):
        columns_by_group.setdefault((probe.effect, probe.grid_point), []).append(i)
    return [
        DirectionGroup(
            effect, tuple(columns), tuple(not probes[i].can_be_negative for i in columns)
        )
        for (effect, _), columns in columns_by_group.items()
    ]


NULL_DRAWS = 200
"""Number of draws from the null distribution."""


def compute_p_value_of_gain(gain: float, coefficients: int, candidates: int) -> float:
    """Return the p-value of the largest gain among several candidates.

    Args:
        gain: gain in twice the log-likelihood.
        coefficients: number of coefficients of each candidate.
        candidates: number of candidates.
    """
    return min(candidates * float(chdtrc(coefficients, max(gain, 0.0))), 1.0)


def score_by_regression(
    regression: Regression, names: Collection[str], rng: np.random.Generator
) -> CandidateScores:
    """Score effects by a regression.

    Args:
        regression: regression about the model that lacks the effects.
        names: names of the effects to score.
        rng: random numbers for draws from the null distribution.
    """
    gains = regression.gains([])
    by_effect: dict[str, list[int]] = {}
    for i, group in enumerate(regression.groups):
        if group.effect in names:
            by_effect.setdefault(group.effect, []).append(i)
    names = list(by_effect)
    score = np.array([max(gains[i] for i in by_effect[name]) for name in names])
    null_quantiles, null_draws, p_values, peaks = [], [], [], []
    for name, largest_gain in zip(names, score.tolist(), strict=True):
        group_indices = by_effect[name]
        degrees_of_freedom = max(len(regression.groups[i].column_indices) for i in group_indices)
        shapes = len(group_indices)
        null_quantiles.append(
            float(chdtri(degrees_of_freedom, 1.0 - NULL_QUANTILE ** (1.0 / shapes)))
        )
        uniform = rng.random(NULL_DRAWS) ** (1.0 / shapes)
        null_draws.append(chdtri(degrees_of_freedom, 1.0 - uniform))
        p_values.append(compute_p_value_of_gain(largest_gain, degrees_of_freedom, shapes))
        peak: DirectionGroup = regression.groups[max(group_indices, key=lambda i: gains[i])]
        peaks.append(((peak, regression.solve([peak])[1][0]),))
    order = np.argsort(-score, kind="stable")
    quantiles = np.array(null_quantiles)
    null_excesses = np.array(null_draws).reshape(len(names), NULL_DRAWS) - quantiles[:, None]
    p_value = min(len(names) * min(p_values, default=1.0), 1.0)
    return CandidateScores(
        effects=tuple(names[i] for i in order),
        score=score[order],
        null_quantiles=quantiles[order],
        peaks=tuple(peaks[i] for i in order),
        p_value=p_value,
        phi=0.0,
        null_scores=null_excesses[order],
        white_noise_scores=score[order],
    )
