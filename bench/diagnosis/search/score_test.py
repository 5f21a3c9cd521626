"""Score test of every candidate effect in trajectory space, calibrated over the whole library.

With G = <D, D> and h = <D, e> of the directions D of a group and a residual e, the coefficients
G^-1 h explain h'G^-1 h of the sum of squares <e, e>.

The response to an effect is compared with the residual after both are projected onto the complement
of what fitted parameters and initial states can absorb (a Lagrange multiplier test; C. R. Rao 1948,
doi:10.1017/S0305004100023987; R. F. Engle, Handbook of Econometrics II, chapter 13). The score is
twice the gain in log-likelihood. Each hypothesis uses the noise correlation that suits it best, so
that autocorrelated noise is not mistaken for a cause. The distribution of the best score under the
null hypothesis is found from surrogate residuals (max-statistic calibration; P. H. Westfall, S. S.
Young 1993).

The inner products <a, b> of residuals e and directions D, whitened with correlation phi and
projected, are defined in `search.whitened_products`, eqs. (1) and (2). The part that a group of
directions explains, with G = <D, D> and h = <D, e>, is computed in `search.score_test`.
With sigma also estimated from n samples, twice the log-likelihood is, up to a constant,

    l(phi) = log det W'W - n log(<e, e> - h'G^-1 h)                                            (3)

and the score of an effect is the likelihood ratio, with the best correlation on either side,

    score = max over phi and groups of l(phi) - max over phi of l(phi) without directions      (4)

For effects k and surrogates s, with chance_k the 90 % quantile of score_k over s, the p-value is

    p = P(max over k of (score_k(s) - chance_k) >= max over k of (score_k - chance_k))         (5)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.diagnosis.evaluation.noise_model import (
    PHI_GRID,
    Mask,
    NoiseModel,
    compute_log_determinant,
)
from bench.diagnosis.evaluation.run_evaluator import Indices
from bench.diagnosis.fitting.levenberg_marquardt import TrajectoryFit
from bench.diagnosis.fitting.trajectory_derivatives import CandidateDirection
from bench.diagnosis.search.candidate_directions import DirectionSet
from bench.diagnosis.search.whitened_products import RANK_TOLERANCE, InnerProducts, WhiteningDesign
from sims.core.simulator import Array

MAX_COLUMNS_FOR_SUBSETS = 4
"""Maximum number of columns of a group for which subsets of columns are tried."""


@dataclass(frozen=True)
class DirectionGroup:
    """Directions that act together.

    Attributes:
        effect: name of the effect.
        column_indices: indices of the directions.
        positive: whether each coefficient must be nonnegative.
    """

    effect: str
    column_indices: tuple[int, ...]
    positive: tuple[bool, ...]


@dataclass(frozen=True)
class GroupBatch:
    """Groups that are solved together: same number of columns, same sign constraints.

    Attributes:
        group_indices: (n,) indices of the groups.
        columns: (n, k) indices of their directions.
        positive: (k,) whether each coefficient must be nonnegative.
    """

    group_indices: Indices
    columns: Indices
    positive: tuple[bool, ...]


def group_probes(probes: Sequence[CandidateDirection]) -> list[DirectionGroup]:
    """Group the probes of one effect at one grid point, whose directions are scored together.

    A direction is the response of the runs to one coefficient of an effect. A grid point is one
    choice of the shape parameters of the effect, such as one frequency. The probes of a group
    differ in the coefficient that scales them, such as the sine and the cosine of a ripple.

    Args:
        probes: probes of all candidate effects. The index of a column of a group is that of its
            probe.
    """
    columns_by_grid_point: dict[tuple[str, int], list[int]] = {}
    for i, probe in enumerate(probes):
        columns_by_grid_point.setdefault((probe.effect, probe.grid_point), []).append(i)
    return [
        DirectionGroup(
            effect, tuple(columns), tuple(not probes[i].can_be_negative for i in columns)
        )
        for (effect, _), columns in columns_by_grid_point.items()
    ]


def batch_groups(members: Sequence[DirectionGroup]) -> list[GroupBatch]:
    """Collect groups with equal sign constraints in batches, so that one call solves all of them.

    The groups of a batch also have the same number of columns, one for each sign constraint.

    Args:
        members: groups of directions that act together.
    """
    groups_by_signs: dict[tuple[bool, ...], list[int]] = {}
    for i, group in enumerate(members):
        groups_by_signs.setdefault(group.positive, []).append(i)
    batches = []
    for positive, group_indices in groups_by_signs.items():
        columns = [members[i].column_indices for i in group_indices]
        batches.append(
            GroupBatch(
                np.array(group_indices, dtype=np.intp),
                np.array(columns, dtype=np.intp),
                positive,
            )
        )
    return batches


def compute_explained_squares(
    gram: Array, cross: Array, positive: Sequence[bool]
) -> tuple[Array, Array]:
    """Compute the sum of squares that each group of directions explains of each residual.

    This is the largest h'G^-1 h of any subset of the group's columns. A constrained coefficient is
    fixed at zero if it would be negative. The constrained least-squares solution is the
    unconstrained solution of some subset of columns, so all subsets are tried (C. L. Lawson, R. J.
    Hanson, Solving Least Squares Problems, 1974, chapter 23). Groups with more than
    `MAX_COLUMNS_FOR_SUBSETS` columns are solved without sign constraints.

    Args:
        gram: (n, k, k) inner products G = <D, D> of the k directions of each of n groups.
        cross: (n, k, S) inner products h = <D, e> of the directions with S residuals.
        positive: (k,) whether each coefficient must be nonnegative.

    Returns:
        The explained sums of squares (n, S), and the coefficients (n, k) for the first residual.
    """
    group_count, column_count, residual_count = cross.shape
    # There are too many subsets of large groups, such as families at many joints.
    if column_count > MAX_COLUMNS_FOR_SUBSETS:
        return _solve_unconstrained(gram, cross)
    best = np.zeros((group_count, residual_count))
    coefficients = np.zeros((group_count, column_count))
    remaining_groups = np.arange(group_count)
    # Most effects have no constraint, and then all columns together explain most. Groups without a
    # unique solution remain.
    if not any(positive):
        solution = _solve_subset(gram, cross, list(range(column_count)))
        best[solution.groups] = solution.gain
        coefficients[solution.groups] = solution.coefficients
        remaining_groups = np.setdiff1d(remaining_groups, solution.groups)
    if remaining_groups.size:
        best[remaining_groups], coefficients[remaining_groups] = _solve_best_subset(
            gram[remaining_groups], cross[remaining_groups], positive
        )
    return best, coefficients


def _solve_best_subset(gram: Array, cross: Array, positive: Sequence[bool]) -> tuple[Array, Array]:
    """Find, for each group and residual, the subset of columns that explains most.

    A subset counts only if its constrained coefficients are not negative. The explained sum of
    squares of a subset (`gain`) is h'G^-1 h, with G and h of its columns. It is zero if no subset
    counts.

    Args:
        gram: (n, k, k) inner products G of the k directions of each of n groups.
        cross: (n, k, S) inner products h of the directions with S residuals.
        positive: (k,) whether each coefficient must be nonnegative.

    Returns:
        Explained sums of squares (n, S), and coefficients (n, k) for the first residual.
    """
    group_count, column_count, residual_count = cross.shape
    best = np.zeros((group_count, residual_count))
    coefficients = np.zeros((group_count, column_count))
    for subset in _enumerate_subsets(column_count):
        solution = _solve_subset(gram, cross, subset)
        # Positions within the subset of the columns whose coefficients must not be negative.
        constrained = [j for j, column in enumerate(subset) if positive[column]]
        previous_best = best[solution.groups]
        # More columns must explain more than rounding error, otherwise the smaller subset is kept.
        is_better = solution.gain > previous_best * (1.0 + 1e-9)
        if constrained:
            is_better &= (solution.scaled[:, constrained] >= 0).all(axis=1)
        best[solution.groups] = np.where(is_better, solution.gain, previous_best)
        # Coefficients for the first residual; columns outside the subset get zero.
        is_better_for_first = is_better[:, 0]
        improved_groups = solution.groups[is_better_for_first]
        coefficients[improved_groups] = 0.0
        coefficients[improved_groups[:, None], subset] = solution.coefficients[is_better_for_first]
    return best, coefficients


def _enumerate_subsets(count: int) -> Iterator[list[int]]:
    """Yield every nonempty subset of `count` columns, the smallest first."""
    for size in range(1, count + 1):
        for subset in combinations(range(count), size):
            yield list(subset)


class _SubsetSolution(NamedTuple):
    """Least-squares solution for a subset of columns.

    Attributes:
        groups: (g,) indices of the groups in which the m columns are neither absorbed nor
            collinear.
        gain: (g, S) h'G^-1 h, the sum of squares that the columns explain of each residual.
        scaled: (g, m, S) G^-1 h for columns of unit length.
        coefficients: (g, m) G^-1 h of the first residual.
    """

    groups: Indices
    gain: Array
    scaled: Array
    coefficients: Array


def _solve_subset(gram: Array, cross: Array, subset: list[int]) -> _SubsetSolution:
    """Solve the normal equations G c = h of each group for a subset of its columns.

    Groups in which such a column is zero, or the columns are collinear, have no unique solution and
    are left out; a smaller subset of their columns explains the same. Columns are scaled to unit
    length, so that collinearity does not depend on units.

    Args:
        gram: (n, k, k) inner products G = <D, D> of the k directions D (columns) of each of n
            groups.
        cross: (n, k, S) inner products h = <D, e> of the directions with S residuals e.
        subset: indices of the m columns to use, below k.

    Returns:
        Solution of the groups that have a unique one, with the sum of squares h'c of each residual
        that the columns explain (`gain`).
    """
    products = gram[:, subset][:, :, subset]  # (n, m, m)
    lengths = np.sqrt(np.maximum(np.diagonal(products, axis1=1, axis2=2), 0.0))
    # Indices of the groups without a column of zeros, whose columns can be scaled.
    nonzero_groups = np.flatnonzero((lengths > 0).all(axis=1))
    nonzero_lengths = lengths[nonzero_groups]
    scaled_products = (
        products[nonzero_groups] / nonzero_lengths[:, :, None] / nonzero_lengths[:, None, :]
    )
    # Of these, the groups whose columns are not collinear. Eigenvalues are in ascending order.
    has_full_rank = np.linalg.eigvalsh(scaled_products)[:, 0] >= RANK_TOLERANCE
    solvable_groups = nonzero_groups[has_full_rank]
    scale = nonzero_lengths[has_full_rank][:, :, None]
    right_hand_side = cross[solvable_groups[:, None], subset] / scale
    # With hundreds of right-hand sides, inverses are faster, and these matrices have unit
    # diagonals.
    scaled_solution = np.linalg.inv(scaled_products[has_full_rank]) @ right_hand_side
    gain = np.einsum("nks,nks->ns", scaled_solution, right_hand_side)
    return _SubsetSolution(
        groups=solvable_groups,
        gain=gain,
        scaled=scaled_solution,
        # For the first residual, in the units of the columns.
        coefficients=scaled_solution[:, :, 0] / scale[:, :, 0],
    )


def _solve_unconstrained(gram: Array, cross: Array) -> tuple[Array, Array]:
    """Solve G c = h with all columns by eigenvalues, without sign constraints.

    It is used for groups with too many columns to try all subsets. Components with very small
    eigenvalues are left out (pseudoinverse).

    Args:
        gram: (n, k, k) inner products G = <D, D> of the k directions of each of n groups.
        cross: (n, k, S) inner products h = <D, e> of the directions with S residuals.

    Returns:
        The explained sums of squares (n, S), and the coefficients (n, k) for the first residual.
    """
    # Of many columns, some nearly repeat others, as overlapping basis functions do. What they add
    # is rounding.
    squared_lengths = np.diagonal(gram, axis1=1, axis2=2)
    scale = np.sqrt(np.maximum(squared_lengths, 1e-300))[:, :, None]
    # Eigenvalues (n, k) in ascending order, and eigenvectors of G with columns of unit length.
    eigenvalues, eigenvectors = np.linalg.eigh(gram / scale / scale.transpose(0, 2, 1))
    is_counted = eigenvalues > RANK_TOLERANCE * eigenvalues[:, -1:]
    inverses = np.where(is_counted, 1.0 / np.where(is_counted, eigenvalues, 1.0), 0.0)
    # In the eigenbasis G is diagonal, so h'G^-1 h is a sum with one term for each eigenvector.
    right_hand_side = eigenvectors.transpose(0, 2, 1) @ (cross / scale)
    solution = inverses[:, :, None] * right_hand_side
    gain: Array = np.einsum("nks,nks->ns", right_hand_side, solution)
    # For the first residual, in the original columns and their units.
    coefficients = (eigenvectors @ solution[:, :, :1]) / scale
    return gain, coefficients[:, :, 0]


SHAPE_COUNT_FOR_MULTISTART = 12
"""Number of shapes above which fits of an effect start from several of them."""
STARTS_PER_EFFECT = 3
"""Maximum number of shapes from which fits of an effect with many shapes start."""
NULL_QUANTILE = 0.9
"""Quantile of a score over the surrogates that is subtracted as its null-hypothesis level."""
TAIL_QUANTILE = 0.8
"""Quantile over the surrogates above which the tail of the distribution is exponential."""
TAIL_SHARE = 0.2
"""Share of the surrogates in the exponential tail."""
MIN_SURROGATES_FOR_TAIL = 20
"""Minimum number of surrogates for which a tail is extrapolated."""
UNCERTAIN_P_VALUE_RANGE = (3e-4, 0.06)
"""Range of p-values that may decide, and are therefore computed from more surrogates."""
SURROGATE_COUNT_FACTOR = 4
"""Factor by which the number of surrogates is increased for such p-values."""

ScorePeak = tuple[DirectionGroup, Array]
"""A group of directions with the coefficients of its columns, from which a fit may start."""


@dataclass(frozen=True)
class CandidateScores:
    """Scores of the library about one model.

    Attributes:
        effects: names of the effects, the highest score first.
        score: twice the gain in log-likelihood of each effect.
        null_quantiles: 90 % quantile of the score over surrogates (0 without them).
        peaks: for each effect, its best group with the coefficients of its columns, in units of the
            directions; for effects with many shapes, followed by further local maxima.
        p_value: p-value of the highest score minus its null-hypothesis level.
        phi: correlation of the noise under the best hypothesis.
        null_scores: (E, S) scores of the surrogates minus their null-hypothesis level.
        white_noise_scores: (E,) scores for white noise.
    """

    effects: tuple[str, ...]
    score: Array
    null_quantiles: Array
    peaks: tuple[tuple[ScorePeak, ...], ...]
    p_value: float
    phi: float
    null_scores: Array
    white_noise_scores: Array


class ScoreTest:
    """Score test of candidate effects against any residuals of one model."""

    def __init__(
        self, fit: TrajectoryFit, directions: DirectionSet, observed_mask: Mask, noise: NoiseModel
    ) -> None:
        """Prepare what does not depend on the residual: groups, products and log-determinants.

        A group has the directions of one effect that act together. `_count` is n of eq. (3), the
        number of samples. `_determinants` has twice log det W for each correlation phi of the grid,
        which is log det W'W of eq. (3).

        Shapes: R runs, T samples, C channels.

        Args:
            fit: the fitted model that the directions refer to.
            directions: directions of the candidates.
            observed_mask: (R, T, C) mask of available samples.
            noise: its sigma weights the channels; its correlation is not used.
        """
        self._groups = group_probes(directions.candidates)
        self._batches = batch_groups(self._groups)
        self._count = int(observed_mask.sum())
        blocks = [batch.columns for batch in self._batches]
        self._design = WhiteningDesign(
            fit, directions.responses, observed_mask, noise.sigma, blocks
        )
        self._determinants = {
            phi: 2.0 * compute_log_determinant(observed_mask, np.full(observed_mask.shape[2], phi))
            for phi in PHI_GRID
        }

    def project_out(self, residuals: Array) -> Array:
        """Subtract from residuals (S, R, T, C) what parameters and initial states can absorb.

        The real residual is what a fit leaves, so it contains no such component. Surrogate
        residuals (random noise) are comparable with it only after this projection.
        """
        return self._design.project_out(residuals)

    def compute_scores(self, residual: Array, surrogate: Array | None = None) -> CandidateScores:
        """Score each candidate effect by how much of the residual its sensitivities explain.

        The score of an effect is twice its gain in log-likelihood, eq. (4) of the module docstring.
        It is the maximum over a grid of AR(1) correlations phi of the noise. Surrogate residuals
        are random noise that contains no effect: their scores show which scores noise alone
        reaches.

        Shapes: R runs, T samples, C channels.

        Args:
            residual: (R, T, C) residual of the model, zero where no sample exists.
            surrogate: (S, R, T, C) surrogate residuals for the null hypothesis; None to omit the
                p-value, which is then 1.
        """
        # The residual comes first, and is scored with the same products as the surrogates.
        surrogates = np.zeros((0, *residual.shape)) if surrogate is None else surrogate
        table = _BestScores(self._groups, residuals=1 + len(surrogates), count=self._count)
        products = InnerProducts(self._design, residual[None], surrogates)
        # The sums of products from one pass over the samples serve every correlation of the grid.
        for phi, determinant in self._determinants.items():
            # Sums of squares of the residuals, products of directions that act together, and those
            # of directions with residuals.
            total, grams, cross = products.project(phi)
            table.begin_correlation(phi, determinant, total)
            # Each batch has the groups with the same number of columns and sign constraints.
            for batch, gram in zip(self._batches, grams, strict=True):
                table.add_batch(
                    batch, *compute_explained_squares(gram, cross[batch.columns], batch.positive)
                )
            table.end_correlation()
        return table.rank_effects()


def compute_calibrated_scores(
    test: ScoreTest, residual: Array, draw: Callable[[int], Array], count: int
) -> CandidateScores:
    """Score a residual, and use more surrogates if the p-value is close to a threshold.

    A p-value of 0.01 from a hundred surrogates is uncertain by a factor of three. Far from every
    threshold this does not matter, and surrogates cost time (J. Besag, P. Clifford, Sequential
    Monte Carlo p-values, Biometrika 78(2), 301, 1991, doi:10.1093/biomet/78.2.301).

    Shapes: R runs, T samples, C channels.

    Args:
        test: score test of the candidate effects about the fitted model.
        residual: (R, T, C) residual of the fitted model.
        draw: function that draws the given number of surrogates (S, R, T, C).
        count: number of surrogates that are drawn first.
    """
    first = test.compute_scores(residual, draw(count))
    low, high = UNCERTAIN_P_VALUE_RANGE
    if not low < first.p_value < high:
        return first
    return test.compute_scores(residual, draw(SURROGATE_COUNT_FACTOR * count))


class _BestScores:
    """Best likelihood of every group of directions and every effect over the correlations so far.

    For each correlation, the caller calls `begin_correlation`, then `add_batch` for all groups, and
    then `end_correlation`.
    """

    def __init__(self, members: Sequence[DirectionGroup], residuals: int, count: int) -> None:
        """Create an empty table of E effects by S residuals.

        With l(phi) twice the log-likelihood, eq. (3) of the module docstring, `_effect_rows` has
        the row of each group's effect, `_best_log_likelihoods` (E, S) the largest l(phi) so far,
        `_best_without_effects` (S,) that without any direction, and `_white_noise_scores` (E,) the
        score without autocorrelation. `_explained_squares` (E, S) has the explained sums of squares
        at the present correlation `_phi`, and `_total_squares` (S,) the sums of squares before.

        Args:
            members: groups of all effects.
            residuals: number S of residuals: the observed one first, then the surrogates.
            count: number n of samples.
        """
        self._count = count
        self._groups = members
        self._effect_names = list(dict.fromkeys(group.effect for group in members))
        rows = {name: row for row, name in enumerate(self._effect_names)}
        self._effect_rows = np.array([rows[group.effect] for group in members], dtype=np.intp)
        effects = len(self._effect_names)
        self._best_log_likelihoods = np.full((effects, residuals), -np.inf)
        self._best_without_effects = np.full(residuals, -np.inf)
        self._white_noise_scores = np.zeros(effects)
        # For each group: twice its log-likelihood, its correlation and its coefficients.
        self._group_log_likelihoods = np.full(len(members), -np.inf)
        self._group_phis = np.zeros(len(members))
        max_columns = max((len(group.column_indices) for group in members), default=0)
        self._group_coefficients = np.zeros((len(members), max_columns))
        self._explained_squares = np.zeros((effects, residuals))
        self._phi = self._determinant = 0.0
        self._total_squares = np.zeros(residuals)

    def begin_correlation(self, phi: float, determinant: float, total: Array) -> None:
        """Start a value of the AR(1) correlation: compute the likelihoods without effects.

        All calls of `add_batch` until `end_correlation` refer to this correlation.

        Args:
            phi: AR(1) correlation of the noise.
            determinant: log-determinant log det W'W of the whitening W.
            total: (S,) sums of squares of the whitened residuals.
        """
        self._phi, self._determinant, self._total_squares = phi, determinant, total
        # `add_batch` collects the explained squares at this correlation.
        self._explained_squares[...] = 0.0
        value_without_effects = self._compute_log_likelihood(total, total)
        self._best_without_effects = np.maximum(self._best_without_effects, value_without_effects)

    def _compute_log_likelihood(self, remaining_squares: Array, total_squares: Array) -> Array:
        """Return twice the log-likelihood at the present correlation, with the best noise level.

        It is l(phi) = log det W'W - n log(<e, e> - h'G^-1 h), eq. (3) of the module docstring: n is
        the number of samples, e the whitened residual, and h'G^-1 h the part of <e, e> that the
        directions explain.

        Args:
            remaining_squares: sums of squares of the residual after the directions have explained
                their part.
            total_squares: sums of squares before, which limit the logarithm.
        """
        # A fully explained residual leaves only rounding, so the logarithm is bounded.
        floor = 1e-12 * total_squares + 1e-300
        logarithms = np.log(np.maximum(remaining_squares, floor))
        result: Array = self._determinant - self._count * logarithms
        return result

    def add_batch(self, batch: GroupBatch, gain: Array, coefficients: Array) -> None:
        """Update the best scores of groups and effects with the results of one batch.

        An effect may have several groups (shapes), of which the best counts, for each residual on
        its own. The best groups of the observed residual are kept with their coefficients,
        from which fits start.

        Args:
            batch: groups that were solved together.
            gain: (n, S) sums of squares that the groups explain of each residual.
            coefficients: (n, k) coefficients of the groups for the first residual, the observed
                one.
        """
        # Best group of each effect of this batch: groups are sorted by effect, so that the groups
        # of an effect are neighbours, and `reduceat` takes the maximum over each effect.
        effect_rows = self._effect_rows[batch.group_indices]
        order = np.argsort(effect_rows, kind="stable")
        batch_rows, first_of_effect = np.unique(effect_rows[order], return_index=True)
        largest_squares = np.maximum.reduceat(gain[order], first_of_effect, axis=0)
        self._explained_squares[batch_rows] = np.maximum(
            self._explained_squares[batch_rows], largest_squares
        )
        # Best correlation of each group.
        log_likelihoods = self._compute_log_likelihood(
            self._total_squares[0] - gain[:, 0], self._total_squares[0]
        )
        # The first residual is the observed one; only its coefficients are used as starts of fits.
        is_better = log_likelihoods > self._group_log_likelihoods[batch.group_indices]
        improved_groups = batch.group_indices[is_better]
        self._group_log_likelihoods[improved_groups] = log_likelihoods[is_better]
        self._group_phis[improved_groups] = self._phi
        self._group_coefficients[improved_groups, : coefficients.shape[1]] = coefficients[is_better]

    def end_correlation(self) -> None:
        """Finish a value of the AR(1) correlation: update the best likelihood of each effect.

        It is called once for each correlation phi of the grid, after all groups were scored with
        it.
        """
        values = self._compute_log_likelihood(
            self._total_squares - self._explained_squares, self._total_squares
        )
        self._best_log_likelihoods = np.maximum(self._best_log_likelihoods, values)
        # With phi = 0, whitening leaves sums of squares unchanged.
        if self._phi == 0 and len(self._effect_names):
            value_without_effects = self._compute_log_likelihood(
                self._total_squares[0], self._total_squares[0]
            )
            self._white_noise_scores = np.maximum(values[:, 0] - value_without_effects, 0.0)

    def rank_effects(self) -> CandidateScores:
        """Return the scores of eq. (4) in descending order, with the p-value of eq. (5).

        A score is the largest l(phi) of the effect's groups minus the largest l(phi) without any
        direction (4), where l is twice the log-likelihood and phi the AR(1) correlation. The
        p-value is the probability that the best score of a surrogate, relative to the 90 % quantile
        of its effect, is at least the observed one (5).
        """
        # (E, S): the observed residual first, then the surrogates.
        gains = self._best_log_likelihoods - self._best_without_effects  # (4)
        observed = gains[:, 0]
        surrogate_gains = gains[:, 1:]
        null_quantiles = np.zeros(len(self._effect_names))
        p_value = 1.0
        if surrogate_gains.shape[1]:
            # An effect with many shapes has higher scores under the null hypothesis, which must not
            # raise the level of other effects.
            null_quantiles = np.quantile(surrogate_gains, NULL_QUANTILE, axis=1)
            p_value = estimate_tail_p_value(
                surrogate_gains - null_quantiles[:, None], observed - null_quantiles
            )  # (5)
        null_scores = surrogate_gains - null_quantiles[:, None]
        order = np.argsort(-observed, kind="stable")
        phi = 0.0
        # The correlation of the noise is that of the best group of the best effect.
        if order.size:
            members = np.flatnonzero(self._effect_rows == order[0])
            phi = float(self._group_phis[members[np.argmax(self._group_log_likelihoods[members])]])
        return CandidateScores(
            effects=tuple(self._effect_names[i] for i in order),
            score=observed[order],
            null_quantiles=null_quantiles[order],
            peaks=tuple(self._get_peaks(np.flatnonzero(self._effect_rows == i)) for i in order),
            p_value=p_value,
            phi=phi,
            null_scores=null_scores[order],
            white_noise_scores=self._white_noise_scores[order],
        )

    def _get_peaks(self, group_indices: NDArray[np.intp]) -> tuple[ScorePeak, ...]:
        """Return the groups of an effect from which its fit may start, the best first.

        A group has the directions of one shape, such as one frequency. Usually only the best group
        is returned. An effect with many shapes may have several local maxima of the likelihood over
        its shapes; then the best of them are returned.

        Args:
            group_indices: indices of the groups of the effect, in the order of its shapes.

        Returns:
            Groups, each with the coefficients of its columns.
        """
        values = self._group_log_likelihoods[group_indices]
        has_many_shapes = len(group_indices) > SHAPE_COUNT_FOR_MULTISTART
        is_peak = values == values.max()
        if has_many_shapes:
            # Neighbours of the best group give the same result, so only local maxima count.
            padded = np.concatenate([[-np.inf], values, [-np.inf]])
            previous_values, next_values = padded[:-2], padded[2:]
            is_peak = (values >= previous_values) & (values >= next_values)
        order = np.argsort(-values, kind="stable")
        max_peaks = STARTS_PER_EFFECT if has_many_shapes else 1
        peak_groups = [group_indices[i] for i in order if is_peak[i]][:max_peaks]
        peaks = []
        for i in peak_groups:
            group = self._groups[i]
            peaks.append((group, self._group_coefficients[i, : len(group.column_indices)].copy()))
        return tuple(peaks)


def estimate_tail_p_value(null_values: Array, observed: Array) -> float:
    """Return the p-value of the largest observed score, eq. (5) of the module docstring.

    It is the probability that the largest score of a surrogate (random noise that contains no
    effect) is at least as large. Probabilities below one in the number of surrogates are
    extrapolated: beyond the most extreme fifth of the surrogates, the tail is assumed to be
    exponential, as that of a likelihood ratio is.

    Args:
        null_values: (E, S) scores of E effects for S surrogates; the maximum over E is compared.
        observed: (E,) scores of the effects for the recorded residual.
    """
    if not observed.size:
        return 1.0
    # Largest score of each surrogate, in ascending order.
    null_maxima = np.sort(null_values.max(axis=0))
    observed_maximum = float(observed.max())
    surrogate_count = null_maxima.size
    exceedance_count = int((null_maxima >= observed_maximum).sum())
    # Counting cannot give less than one in the number of surrogates; smaller p-values are
    # extrapolated.
    tail = null_maxima[int(TAIL_QUANTILE * surrogate_count) :]
    tail_begin = tail[0]
    if observed_maximum <= tail_begin or surrogate_count < MIN_SURROGATES_FOR_TAIL:
        # The residual counts as one of the surrogates, so the p-value is never zero.
        return (1.0 + exceedance_count) / (1.0 + surrogate_count)
    # The scale of an exponential distribution is its mean excess over the threshold. It is zero if
    # all values of the tail are equal, and must not be a divisor then.
    mean_excess = max(float((tail - tail_begin).mean()), 1e-9)
    return float(TAIL_SHARE * np.exp(-(observed_maximum - tail_begin) / mean_excess))
