"""Selection of effects by linear regression of the innovations, with repeated fits of the noise.

With the whitened innovations e of N samples and the whitened responses W of the candidates,

    G = Wᵀ W,   h = Wᵀ e,   rss(S) = eᵀ e - h_Sᵀ G_SS⁻¹ h_S                                     (1)

for the columns S of a set of effects. Effects are added one by one, first the one that decreases N
log rss most, until none fulfils

    N log(rss(S) / rss(S ∪ g)) > k log N + 2 log(M n)                                           (2)

with k the number of coefficients of the effect g, n the number of its shapes, and M the number of
candidates. The last term bounds the gain of the best of M n under the null hypothesis (D. P.
Foster, E. I. George, Ann. Stat. 22(4), 1947, 1994, doi:10.1214/aos/1176325766). After each
addition, effects that no longer fulfil (2) are removed (A. Miller, Subset Selection in Regression,
2nd ed., 2002, chapter 3). No simulation is needed.

Scores of single effects are compared with their null distribution: twice the gain in
log-likelihood by k further coefficients has a chi-squared distribution with k degrees of freedom
(S. S. Wilks 1938, doi:10.1214/aoms/1177732360). The score of an effect with n shapes is the best of
them, and the score of the library is the best of its effects. Shapes are assumed independent, which
overestimates the gain under the null hypothesis.

    1. Follow the runs with the model by a Kalman filter about the measured motion.
    2. Compute the response of the innovations to every candidate effect.
    3. Select effects by regression, whatever their number.
    4. Put them into the linear model, fit the process noise again, and continue with 3, because the
       innovations contain more information with less process noise.

(L. Ljung, System Identification, 2nd ed., 1999, chapters 3, 7 and 16.)
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from bench.benchmark.statistics.chi_squared import chi_squared_quantile, chi_squared_tail
from bench.diagnosis.evaluation.noise_model import Mask
from bench.diagnosis.kalman.candidate_responses import (
    Columns,
    compute_columns,
    compute_responses,
    compute_step_error_response,
)
from bench.diagnosis.kalman.kalman_recursions import IndexArray
from bench.diagnosis.kalman.linearised_filter import FollowedRuns
from bench.diagnosis.prediction_error.regression_products import GramMatrices, ResponseProducts
from bench.diagnosis.search.score_test import (
    NULL_QUANTILE,
    CandidateScores,
    DirectionGroup,
    batch_groups,
    compute_explained_squares,
    group_probes,
)
from sims.core.simulator import Array

COLLINEARITY_TOLERANCE = 1e-7
"""Maximum share of a column's sum of squares that remains if it is collinear with other columns."""
MIN_BETTER_RUN_SHARE = 0.5
"""Minimum share of the left-out runs that a larger set must predict better."""
MIN_LEFT_OUT_GAIN = 1.0
"""Minimum gain in left-out runs, in twice the log-likelihood, of a set that predicts better."""
MIN_SHRUNK_GAIN_SHARE = 0.5
"""Minimum share of the gain in all runs that shrunk coefficients keep in left-out runs."""
MIN_VISIBLE_GAIN = 7.0
"""Minimum gain of a column in twice the log-likelihood to be visible in the data."""
RIDGE = 1e-10
"""Ridge, as a share of each column's sum of squares."""
SMALLEST_RSS = 1e-9
"""Minimum residual sum of squares, as a share of the sum of squares of the innovations."""
NULL_DRAWS = 200
"""Number of draws from the null distribution."""
MAX_REGRESSIONS = 4
"""Maximum number of regressions, each with the process noise of the previous selection."""
MAX_SET_SIZE = 8
"""Maximum number of effects in a set."""


class LeastSquaresFit(NamedTuple):
    """Fit of a set of groups of columns.

    Attributes:
        rss: residual sum of squares.
        coefficients: coefficients of each group, one for each of its columns.
    """

    rss: float
    coefficients: list[Array]


@dataclass
class Regression:
    """Regression of innovations on responses.

    Attributes:
        groups: columns that act together: one shape of an effect, with a column for each of its
            coefficients. A set has at most one group of each effect.
        products: G, h and eᵀ e of each run.
        count: N.
        contains: effects that each effect contains as special cases, by name.
        always: columns that are part of every set and belong to no effect ("nuisance").
        only_proposed: columns of single effects that are not selected together with others.
    """

    groups: Sequence[DirectionGroup]
    products: GramMatrices | ResponseProducts
    count: int
    contains: Mapping[str, Sequence[str]] = field(default_factory=dict)
    always: tuple[int, ...] = ()
    only_proposed: frozenset[int] = frozenset()

    def __post_init__(self) -> None:
        """Sum the products of eq. (1) over all runs, and group the columns by effect."""
        self._squares = self.products.squares.sum(axis=0)
        self._cross = self.products.crosses.sum(axis=0)
        self.total = float(self.products.totals.sum())
        self._batches = batch_groups(self.groups)
        self.effects = list(dict.fromkeys(group.effect for group in self.groups))
        self._nuisance = DirectionGroup("", self.always, (False,) * len(self.always))

    @cached_property
    def _is_selectable(self) -> Mask:
        """Which groups may be selected together with others (n,)."""
        return np.array(
            [self.only_proposed.isdisjoint(group.column_indices) for group in self.groups]
        )

    @cached_property
    def _products_within_groups(self) -> list[Array]:
        """Products (n, k, k) within the n groups of each batch."""
        return [self.products.sum_within(batch.columns) for batch in self._batches]

    def nuisance(self, chosen: Sequence[DirectionGroup]) -> float:
        """Return the coefficient of the first column of `always`, fitted together with a set."""
        _, parts = self._fit_groups([*chosen, self._nuisance])
        # The nuisance group is the last one; its first column is meant.
        return float(parts[-1][0]) if self.always else 0.0

    def make_regression_without(self, own_columns: Sequence[int]) -> Regression:
        """Return the regression of the innovations that a model without one of its effects has.

        Args:
            own_columns: columns of the effect, which are part of every set; the first one is the
                response w to the effect as it is in the model.
        """
        whole, always = own_columns[0], tuple(c for c in self.always if c not in own_columns)
        # The effect has removed w from the innovations e, so they are e + w without it.
        return replace(self, products=self.products.add_to_innovations(whole), always=always)

    def compute_gain(self, own: Sequence[int]) -> float:
        """Return the gain of columns in twice the log-likelihood, with any signs."""
        group = DirectionGroup("", tuple(own), (False,) * len(own))
        return self.compute_log_ratio(self.solve([]).rss, self.solve([group]).rss)

    def shows_nuisance(self, chosen: Sequence[DirectionGroup]) -> bool:
        """Return whether the data show the first column of `always`, in addition to a set.

        That column is the response to the integrator's step errors. Its coefficient must be nearer
        to one (the full error) than to zero, and it must improve the fit. `always` are columns that
        are part of every fit, such as the derivatives by coefficients of the present model.

        Args:
            chosen: the set, with one group of columns for each effect.
        """
        # The other columns of `always` are in both fits.
        others = DirectionGroup("", self.always[1:], (False,) * (len(self.always) - 1))
        rss_with, coefficients = self._fit_groups([*chosen, self._nuisance])
        rss_without = self._fit_groups([*chosen, others]).rss
        # The nuisance group is the last one; its first column is meant.
        return (
            float(coefficients[-1][0]) > 0.5
            and self.compute_log_ratio(rss_without, rss_with) > MIN_VISIBLE_GAIN
        )

    def solve(self, chosen: Sequence[DirectionGroup]) -> LeastSquaresFit:
        """Fit a set of groups together with `always`, whose coefficients are left out."""
        rss, coefficients = self._fit_groups([*chosen, self._nuisance])
        return LeastSquaresFit(rss, coefficients[:-1])

    def _fit_groups(
        self, chosen: Sequence[DirectionGroup], left_out: int | None = None
    ) -> LeastSquaresFit:
        """Fit a set of groups by least squares, with some coefficients that must be nonnegative.

        A group has the columns of one effect: the responses of the whitened innovations to each of
        its coefficients. The normal equations are G c = h, with G = W'W of the columns W and
        h = W'e of the innovations e. Constrained coefficients that are negative are fixed at zero
        one by one, the most negative (in units of the length of its column) first, and the others
        are fitted again.

        Args:
            chosen: the groups.
            left_out: run that is not fitted; None to fit all runs. The residual sum of squares is
                valid for all runs only.
        """
        columns = list_columns(chosen)
        is_constrained = np.array([p for group in chosen for p in group.positive], dtype=bool)
        fitted_runs = [r for r in range(len(self.products.totals)) if r != left_out]
        gram = self.products.select(columns)[fitted_runs].sum(axis=0)
        cross = self.products.crosses[fitted_runs].sum(axis=0)[columns]
        # Coefficients that are not fixed at zero.
        active = np.ones(columns.size, dtype=bool)
        solution = np.zeros(columns.size)
        while active.any():
            normal, scale = _normalise_gram(gram[np.ix_(active, active)])
            scaled_solution = np.linalg.solve(normal, cross[active] / scale)
            solution[:] = 0.0
            solution[active] = scaled_solution / scale
            negative = np.flatnonzero(active & is_constrained & (solution < 0))
            if not negative.size:
                break
            sizes = solution[negative] * np.sqrt(np.diagonal(gram)[negative])
            active[negative[np.argmin(sizes)]] = False
            # The result if no coefficient remains active.
            solution[:] = 0.0
        explained_squares = float(solution @ cross)
        # rss = e'e - c'h, eq. (1), also holds for coefficients c some of which are fixed at zero.
        rss = max(self.total - explained_squares, SMALLEST_RSS * self.total)
        ends = np.cumsum([len(group.column_indices) for group in chosen])
        return LeastSquaresFit(rss, np.split(solution, ends[:-1]))

    def compute_log_ratio(self, before: float, after: float) -> float:
        """Return twice the gain in log-likelihood, N log(before / after).

        Args:
            before: residual sum of squares of the smaller set.
            after: residual sum of squares of the larger set.
        """
        return float(self.count * np.log(before / after))

    def price(self, group: DirectionGroup) -> float:
        """Return the minimum gain of an effect in twice the log-likelihood.

        It is k log N + 2 log(M n) for k coefficients and n shapes of the effect, N samples and M
        candidate effects: the right side of eq. (2) of the module docstring.

        Args:
            group: one shape of the effect, with a column for each of its coefficients.
        """
        coefficients = len(group.column_indices) * np.log(max(self.count, 2))
        candidates = max(len(self.effects), 2) * self._shape_counts[group.effect]
        return float(coefficients + 2.0 * np.log(candidates))

    @cached_property
    def _shape_counts(self) -> Counter[str]:
        """Number of shapes of each effect."""
        return Counter(group.effect for group in self.groups)

    def gains(self, chosen: Sequence[DirectionGroup]) -> Array:
        """Return the gain (n,) in twice the log-likelihood of each group in addition to a set.

        The columns of the set are projected out of the others first (Schur complement), so that all
        n groups are fitted at once without solving for the set again. Groups that are collinear
        with the set, and those of effects that the set contains, gain nothing. K is the number of
        all columns of the regression.

        Args:
            chosen: groups of the set; empty for gains over the model itself.
        """
        columns = list_columns(chosen)
        columns = np.append(columns, np.array(self.always, dtype=np.intp))
        # Residual sum of squares with the set alone.
        rss = self.solve(chosen).rss
        # Products (c, K) of the c columns of the set and of `always`, scaled to unit length, with
        # all K columns.
        rows = self.products.select_rows(columns)
        normal, scale = _normalise_gram(rows[:, columns])
        rows = rows / scale[:, None]
        # Coefficients of the set that explain each column and, in the last column, the innovations.
        solved = np.linalg.solve(normal, np.c_[rows, self._cross[columns] / scale])
        # Sum of squares of each column, and product with the innovations, after the projection.
        squares = self._squares - np.einsum("ck,ck->k", rows, solved[:, :-1])
        cross = self._cross - rows.T @ solved[:, -1]
        # Almost nothing of a collinear column remains after the projection.
        remains = squares > COLLINEARITY_TOLERANCE * self._squares
        contained_effects = set(self._list_contained_effects(chosen))
        result = np.zeros(len(self.groups))
        # Collinear columns get zero products, so that they explain nothing.
        cross = np.where(remains, cross, 0.0)
        # A batch has groups with the same number of columns.
        for batch, products in zip(self._batches, self._products_within_groups, strict=True):
            # The part of the products (g, k, k) within the g groups that the set explains.
            explained_by_set = np.einsum(
                "cgi,cgj->gij", rows[:, batch.columns], solved[:, batch.columns]
            )
            is_used = remains[batch.columns]
            is_pair_used = is_used[:, :, None] & is_used[:, None, :]
            grams = np.where(is_pair_used, products - explained_by_set, 0.0)
            # Sums of squares (g, 1) that each group explains of the only residual, the innovations.
            explained, _ = compute_explained_squares(
                grams, cross[batch.columns][..., None], batch.positive
            )
            # Residual sum of squares with each group in addition.
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

    def rank_effects(self) -> list[tuple[DirectionGroup, float]]:
        """Return the best shape of each effect with its net gain, the largest gain first."""
        gains = self.compute_net_gains()
        best_of_each = dict[str, tuple[DirectionGroup, float]]()
        for i in np.argsort(-gains, kind="stable").tolist():
            group = self.groups[i]
            best_of_each.setdefault(group.effect, (group, float(gains[i])))
        return list(best_of_each.values())

    def _list_contained_effects(self, chosen: Sequence[DirectionGroup]) -> list[str]:
        """Return the effects of a set, with all effects that they contain."""
        effects = [group.effect for group in chosen]
        return effects + [name for effect in effects for name in self.contains.get(effect, ())]

    def select(self, max_groups: int, begin: Sequence[DirectionGroup] = ()) -> list[DirectionGroup]:
        """Select effects by forward and backward steps.

        The effect whose gain exceeds its minimum gain (`price`) most is added; then effects that no
        longer gain their price are removed. The selection ends when no effect gains its price, when
        the best one does not predict left-out runs better, or when it is removed again at once.

        Args:
            max_groups: maximum number of effects.
            begin: initial set.

        Returns:
            The set: groups of columns, one for each effect.
        """
        chosen = list(begin)
        while len(chosen) < max_groups:
            gains = np.where(self._is_selectable, self.compute_net_gains(chosen), -np.inf)
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
        1974). If the left-out run alone determines a coefficient, the estimate from the other runs
        is arbitrary and may predict badly. Such a coefficient is therefore also tried shrunk
        towards zero; the prediction must then keep much of the gain in all runs together.

        Args:
            smaller: the smaller set.
            larger: the larger set.
        """
        # A single run cannot be left out.
        if len(self.products.totals) < 2:
            return True
        if self._compute_left_out_gain(smaller, larger) > MIN_LEFT_OUT_GAIN:
            return True
        gain = self.compute_log_ratio(self.solve(smaller).rss, self.solve(larger).rss)
        shrunk_gain = self._compute_left_out_gain(smaller, larger, is_shrunk=True)
        return shrunk_gain > max(MIN_LEFT_OUT_GAIN, MIN_SHRUNK_GAIN_SHARE * gain)

    def _compute_left_out_gain(
        self,
        smaller: Sequence[DirectionGroup],
        larger: Sequence[DirectionGroup],
        is_shrunk: bool = False,
    ) -> float:
        """Return the gain of a larger set in left-out runs, in twice the log-likelihood.

        It is minus infinity if the larger set predicts too few of the runs better: an effect that
        acts in one run only predicts nothing in it from the others.

        Args:
            smaller: the smaller set.
            larger: the larger set.
            is_shrunk: whether coefficients are shrunk.
        """
        before = self._compute_left_out_rss(smaller, is_shrunk)
        after = self._compute_left_out_rss(larger, is_shrunk)
        if (after < before).mean() < MIN_BETTER_RUN_SHARE:
            return -np.inf
        remaining = max(float(after.sum()), SMALLEST_RSS * self.total)
        return self.compute_log_ratio(float(before.sum()), remaining)

    def _compute_left_out_rss(
        self, chosen: Sequence[DirectionGroup], is_shrunk: bool = False
    ) -> Array:
        """Return the residual sum of squares (R,) of each run, predicted from the other runs.

        With the products G = W'W and h = W'e of the left-out run, and coefficients c that are
        fitted to the other runs, rss = e'e - 2 c'h + c'G c. Shrunk coefficients are those of a fit
        in which the left-out run stays, but with zero innovations: those that it mainly determines
        become small.

        Args:
            chosen: the groups.
            is_shrunk: whether coefficients are shrunk.
        """
        residual_squares = []
        groups = [*chosen, self._nuisance]
        columns = list_columns(groups)
        grams = self.products.select(columns)
        for run, total in enumerate(self.products.totals):
            coefficients = np.concatenate(self._fit_groups(groups, left_out=run).coefficients)
            # Coefficients that the sign constraints do not fix at zero.
            used = coefficients != 0
            if is_shrunk and used.any():
                # G is that of all runs. The innovations of the left-out run count as zero, so it is
                # left out of h only.
                normal, scale = _normalise_gram(grams[:, used][:, :, used].sum(axis=0))
                cross = self.products.crosses[:, columns[used]].sum(axis=0)
                cross = cross - self.products.crosses[run][columns[used]]
                coefficients[used] = np.linalg.solve(normal, cross / scale) / scale
            residual_squares.append(
                total
                - 2.0 * coefficients @ self.products.crosses[run][columns]
                + coefficients @ grams[run] @ coefficients
            )
        return np.array(residual_squares)

    def prune(self, chosen: Sequence[DirectionGroup]) -> list[DirectionGroup]:
        """Return a set without the effects whose gain is below their minimum gain (`price`).

        The gain of an effect is the loss in twice the log-likelihood without it. The effect with
        the smallest gain minus price is removed first, and the gains of the others are computed
        again.

        Args:
            chosen: the set, with one group of columns for each effect; it is not changed.
        """
        remaining = list(chosen)
        while remaining:
            rss = self.solve(remaining).rss
            net_gains = []
            for group in remaining:
                others = [other for other in remaining if other is not group]
                rss_without = self.solve(others).rss
                net_gains.append(self.compute_log_ratio(rss_without, rss) - self.price(group))
            weakest = int(np.argmin(net_gains))
            if net_gains[weakest] > 0:
                break
            del remaining[weakest]
        return remaining


def _normalise_gram(gram: Array) -> tuple[Array, Array]:
    """Return the scaled normal matrix of some regression columns, and their lengths.

    Columns of effects differ by many orders of magnitude. Scaling them to unit length, and adding
    a small ridge to the diagonal, keeps the normal equations well conditioned.

    Args:
        gram: (k, k) inner products of the columns, G = Wᵀ W of the module's eq. (1).

    Returns:
        Matrix (k, k), and lengths (k,).
    """
    scale = np.sqrt(np.maximum(np.diagonal(gram), 1e-300))
    normal = gram / scale / scale[:, None]
    normal[np.diag_indices_from(normal)] += RIDGE
    return normal, scale


def list_columns(groups: Sequence[DirectionGroup]) -> IndexArray:
    """Return the columns of some groups, one group after another."""
    return np.array([c for group in groups for c in group.column_indices], dtype=np.intp)


def compute_p_value_of_gain(gain: float, coefficients: int, candidates: int) -> float:
    """Return the p-value of the largest gain among several candidates.

    The gain of each has a chi-squared law; the p-value is multiplied by the number of candidates
    (Bonferroni correction).

    Args:
        gain: gain in twice the log-likelihood.
        coefficients: number of coefficients of each candidate.
        candidates: number of candidates.
    """
    return min(candidates * chi_squared_tail(coefficients, gain), 1.0)


def score_by_regression(
    regression: Regression, names: Collection[str], rng: np.random.Generator
) -> CandidateScores:
    """Score effects by a regression: gains, their null distributions and p-values.

    An effect has several shapes, such as the frequencies of a periodic force, and a gain for each
    of them. Its score is the largest gain of its shapes. Under the null hypothesis each gain
    follows a chi-squared law, so the maximum over shapes follows from draws and quantiles of it.
    The p-value of the best effect is multiplied by the number of effects (Bonferroni correction).

    Args:
        regression: regression about the model that lacks the effects.
        names: names of the effects to score; those without a column in the regression are left out.
        rng: random numbers for draws from the null distribution.

    Returns:
        The scores of the effects, the highest first. The p-value is 1 if there are none.
    """
    gains = regression.gains([])
    by_effect: dict[str, list[int]] = {}
    for i, group in enumerate(regression.groups):
        if group.effect in names:
            by_effect.setdefault(group.effect, []).append(i)
    # The groups of an effect are its shapes.
    scored_names = list(by_effect)
    score = np.array([max(gains[i] for i in indices) for indices in by_effect.values()])
    null_quantiles, null_draws, p_values, peaks = [], [], [], []
    for group_indices, largest_gain in zip(by_effect.values(), score.tolist(), strict=True):
        degrees_of_freedom = max(len(regression.groups[i].column_indices) for i in group_indices)
        shapes = len(group_indices)
        null_quantiles.append(
            # The quantile of the maximum of independent draws, one for each shape.
            chi_squared_quantile(degrees_of_freedom, 1.0 - NULL_QUANTILE ** (1.0 / shapes))
        )
        null_draws.append(
            rng.chisquare(degrees_of_freedom, (NULL_DRAWS, shapes)).max(axis=1, initial=0.0)
        )
        p_values.append(compute_p_value_of_gain(largest_gain, degrees_of_freedom, shapes))
        peak: DirectionGroup = regression.groups[max(group_indices, key=lambda i: gains[i])]
        (peak_coefficients,) = regression.solve([peak]).coefficients
        # `CandidateScores` may have several peaks of an effect; here there is one.
        peaks.append(((peak, peak_coefficients),))
    order = np.argsort(-score, kind="stable")
    quantiles = np.array(null_quantiles)
    # Draws minus the quantile of each effect, so that effects with many shapes are comparable.
    null_excesses = np.array(null_draws).reshape(-1, NULL_DRAWS) - quantiles[:, None]
    # Without a scored effect nothing is significant.
    p_value = min(len(scored_names) * min(p_values), 1.0) if p_values else 1.0
    # Innovations are white: their autocorrelation phi is zero, and scores for white noise are the
    # scores themselves.
    return CandidateScores(
        effects=tuple(scored_names[i] for i in order),
        score=score[order],
        null_quantiles=quantiles[order],
        peaks=tuple(peaks[i] for i in order),
        p_value=p_value,
        phi=0.0,
        null_scores=null_excesses[order],
        white_noise_scores=score[order],
    )


@dataclass(frozen=True)
class Selected:
    """The result of a selection.

    Attributes:
        groups: the selected groups of columns.
        coefficients: coefficients of each group, in units of the probes' coefficients.
        regression: the last regression.
        log_likelihood: log-likelihood of the innovations with the selected effects.
        followed: the runs, with the selected effects in the linear model.
        numerics: share of the integrator's step errors in the linear model.
        shows_steps: whether the innovations show these errors.
    """

    groups: Sequence[DirectionGroup]
    coefficients: Sequence[Array]
    regression: Regression
    log_likelihood: float
    followed: FollowedRuns
    numerics: float
    shows_steps: bool

    @property
    def effects(self) -> list[str]:
        """Names of the selected effects."""
        return [group.effect for group in self.groups]


def shows_step_errors(followed: FollowedRuns) -> bool:
    """Return whether the innovations show the errors of the integrator's steps.

    They do if the recorded motion is one of continuous time, and do not if the engine generated it.
    """
    return regress(followed, [compute_columns(followed, [])]).shows_nuisance([])


def identify(followed: FollowedRuns, columns: Columns, first: Regression | None = None) -> Selected:
    """Select effects, with the process noise fitted again after each selection.

    Process noise stands for missing forces: while it is large, it hides effects. With the selected
    effects in the linear model the filter needs less noise, and a regression of the new innovations
    may select others. This is repeated until the log-likelihood gains less than 1.

    Args:
        followed: the runs, without any effect.
        columns: inputs of the candidates.
        first: regression of these runs on the columns, if it is known; None to compute it.

    Returns:
        The selection with the highest log-likelihood.
    """
    # The runs, filtered with the effects of the previous selection in the linear model.
    refitted, selected_before = followed, list[DirectionGroup]()
    coefficients: list[Array] = []
    result: Selected | None = None
    # Share of the integrator's step errors in the linear model.
    numerics = 0.0
    for _ in range(MAX_REGRESSIONS):
        regression = first or regress(refitted, [columns], selected_before, coefficients, numerics)
        # The given regression is valid only before any effect is selected.
        first = None
        # Drop effects that are not needed any more, and add others.
        selected = regression.prune(selected_before) if selected_before else []
        selected = regression.select(MAX_SET_SIZE, selected)
        new_coefficients = regression.solve(selected).coefficients
        numerics = regression.nuisance(selected)
        refitted = follow_linear_with_effects(
            followed, columns, selected, new_coefficients, numerics
        )
        likelihood = refitted.log_likelihood
        has_converged = result is not None and likelihood < result.log_likelihood + 1.0
        if result is None or likelihood > result.log_likelihood:
            result = Selected(
                selected,
                new_coefficients,
                regression,
                likelihood,
                refitted,
                numerics,
                regression.shows_nuisance(selected),
            )
        if has_converged:
            break
        selected_before, coefficients = selected, new_coefficients
    # The first selection is always stored.
    assert result is not None
    return result


def regress(
    followed: FollowedRuns,
    columns: Sequence[Columns],
    chosen: Sequence[DirectionGroup] = (),
    coefficients: Sequence[Array] = (),
    numerics: float = 0.0,
    always: Sequence[int] = (),
) -> Regression:
    """Set up the regression of all that effects explain, including those in the linear model.

    The innovations of the filter are what the chosen effects do not explain. The responses to these
    effects, and the share `numerics` of the response to the integrator's step errors, are added to
    the innovations. So all effects compete on equal terms. The last column is the response to the
    step errors; it is part of every set.

    Args:
        followed: the runs, filtered with the chosen effects in the linear model.
        columns: inputs of the candidates, in one or more parts.
        chosen: the effects in the linear model.
        coefficients: coefficients of these effects.
        numerics: share of the integrator's step errors that is in the linear model.
        always: indices of probes that are part of every set, and are not candidates.

    Returns:
        The regression, with a group of columns for each shape of each effect.
    """
    # R runs, T samples, C channels, K candidates and one column for the step errors. A column of a
    # run has T C rows, one for each reading.
    run_count, samples, channels = followed.runs.residuals.shape
    # K + 1
    count = sum(len(part.probes) for part in columns) + 1
    responses = np.empty((run_count, samples, channels, count), dtype=np.float32)
    first = 0
    for part in columns:
        end = first + len(part.probes)
        compute_responses(followed, part, responses[..., first:end])
        first = end
    responses[..., -1] = compute_step_error_response(followed)
    rows = responses.reshape(run_count, -1, count)
    # Coefficients of the columns that are in the linear model.
    weights = np.zeros(count)
    weights[list_columns(chosen)] = np.concatenate([*coefficients, np.zeros(0)])
    weights[-1] = numerics
    # Add what these columns explain to the innovations again.
    in_use = np.flatnonzero(weights)
    innovations = followed.filtered.whitened.reshape(run_count, -1)
    innovations = innovations + rows[:, :, in_use].astype(np.float64) @ weights[in_use]
    contains = {
        name: effect.contains for name, effect in followed.evaluator.available_effects.items()
    }
    probes = [probe for part in columns for probe in part.probes]
    # Columns of `always` form no group, so that they are no candidates.
    groups = [g for g in group_probes(probes) if not set(g.column_indices) & set(always)]
    readings = int(followed.runs.recorded.sum())
    products = ResponseProducts(list(rows), list(innovations))
    only_proposed = frozenset(i for i, probe in enumerate(probes) if probe.is_only_proposed)
    return Regression(groups, products, readings, contains, (count - 1, *always), only_proposed)


def follow_linear_with_effects(
    followed: FollowedRuns,
    columns: Columns,
    chosen: Sequence[DirectionGroup],
    coefficients: Sequence[Array],
    numerics: float,
) -> FollowedRuns:
    """Put effects into the linear models of the runs, and fit the process noise again.

    Their forces are subtracted from the defects (by how much a step misses the next state), and
    their changes of the readings from the residuals.

    Shapes: R runs, T samples, Z states of the filter, E forces and controls.

    Args:
        followed: the runs, without any effect.
        columns: inputs of the candidates.
        chosen: groups of columns of the effects.
        coefficients: coefficients of each group.
        numerics: share of the integrator's errors to put into the linear model.
    """
    own_columns = [c for group in chosen for c in group.column_indices]
    runs = followed.runs
    defects, residuals = runs.defects - numerics * followed.step_errors, runs.residuals
    if own_columns:
        # Sums over the effects: inputs (R, T - 1, E) between samples, and readings (R, T, C).
        inputs, readings = columns.total(own_columns, np.concatenate(list(coefficients)))
        defects = defects - np.einsum("rtze,rte->rtz", runs.inputs, inputs)
        residuals = np.where(runs.recorded, residuals - readings, 0.0)
    return followed.refit_noise(replace(runs, defects=defects, residuals=residuals))
