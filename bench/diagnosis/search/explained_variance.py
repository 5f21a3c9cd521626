"""Explained sums of squares of groups of directions: least squares for many groups and residuals.

With G = <D, D> and h = <D, e> of the directions D of a group and a residual e, the coefficients
G^-1 h explain h'G^-1 h of the sum of squares <e, e>.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.run_evaluator import Indices
from bench.diagnosis.search.candidate_directions import DirectionSet
from bench.diagnosis.search.whitened_products import RANK_TOLERANCE
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


def group_directions(directions: DirectionSet) -> list[DirectionGroup]:
    """Group the directions of each effect at each grid point of its shape; they act together."""
    columns_by_group: dict[tuple[str, int], list[int]] = {}
    for i, probe in enumerate(directions.candidates):
        columns_by_group.setdefault((probe.effect, probe.grid_point), []).append(i)
    groups = []
    for (effect, _), columns in columns_by_group.items():
        probes = [directions.candidates[i] for i in columns]
        positive = tuple(not probe.can_be_negative for probe in probes)
        groups.append(DirectionGroup(effect, tuple(columns), positive))
    return groups


def batch_groups(members: Sequence[DirectionGroup]) -> list[GroupBatch]:
    """Collect groups with equal sign constraints in batches, which are solved at once."""
    groups_by_signs: dict[tuple[bool, ...], list[int]] = {}
    for i, group in enumerate(members):
        groups_by_signs.setdefault(group.positive, []).append(i)
    result = []
    for positive, group_indices in groups_by_signs.items():
        columns = [members[i].column_indices for i in group_indices]
        result.append(
            GroupBatch(
                np.array(group_indices, dtype=np.intp),
                np.array(columns, dtype=np.intp),
                positive,
            )
        )
    return result


def compute_explained_squares(
    gram: Array, cross: Array, positive: Sequence[bool]
) -> tuple[Array, Array]:
    """Compute the sums of squares that groups explain, each with its best subset of columns.

    A constrained coefficient is fixed at zero if it would be negative. The constrained
    least-squares solution is the unconstrained solution of some subset of columns, so all subsets
    are tried (C. L. Lawson, R. J. Hanson, Solving Least Squares Problems, 1974, chapter 23).

    Args:
        gram: G (n, k, k) of each group.
        cross: h (n, k, S).
        positive: (k,) whether each coefficient must be nonnegative.

    Returns:
        The explained sums of squares (n, S), and the coefficients (n, k) for the first residual.
    """
    number, count, samples = cross.shape
    if count > MAX_COLUMNS_FOR_SUBSETS:
        return _solve_unconstrained(gram, cross)
    best = np.zeros((number, samples))
    coefficients = np.zeros((number, count))
    remaining_groups = np.arange(number)
    # Most effects have no constraint, and then all columns together explain most.
    if not any(positive):
        solution = _solve_subset(gram, cross, list(range(count)))
        best[solution.groups] = solution.gain
        coefficients[solution.groups] = solution.coefficients
        remaining_groups = np.setdiff1d(remaining_groups, solution.groups)
    if remaining_groups.size:
        best[remaining_groups], coefficients[remaining_groups] = _solve_best_subset(
            gram[remaining_groups], cross[remaining_groups], positive
        )
    return best, coefficients


def _solve_best_subset(gram: Array, cross: Array, positive: Sequence[bool]) -> tuple[Array, Array]:
    """Try all subsets of columns, and keep for each group and residual the one that explains most.

    A subset counts only if its constrained coefficients are not negative. Arguments and result are
    those of `compute_explained_squares`.
    """
    number, count, samples = cross.shape
    best = np.zeros((number, samples))
    coefficients = np.zeros((number, count))
    for subset in _enumerate_subsets(count):
        solution = _solve_subset(gram, cross, subset)
        constrained = [j for j, column in enumerate(subset) if positive[column]]
        previous_best = best[solution.groups]
        # More columns must explain more than rounding error, otherwise the smaller subset is kept.
        is_better = solution.gain > previous_best * (1.0 + 1e-9)
        if constrained:
            is_better &= (solution.scaled[:, constrained] >= 0).all(axis=1)
        best[solution.groups] = np.where(is_better, solution.gain, previous_best)
        # Columns outside the subset get zero coefficients.
        is_improved = is_better[:, 0]
        rows = solution.groups[is_improved]
        coefficients[rows] = 0.0
        coefficients[rows[:, None], subset] = solution.coefficients[is_improved]
    return best, coefficients


def _enumerate_subsets(count: int) -> Iterator[list[int]]:
    """Yield every nonempty subset of `count` columns, the smallest first."""
    for size in range(1, count + 1):
        for subset in combinations(range(count), size):
            yield list(subset)


class _SubsetSolution(NamedTuple):
    """Least-squares solution for a subset of columns.

    Attributes:
        groups: (m,) indices of the groups in which the columns are neither absorbed nor collinear.
        gain: (m, S) h'G^-1 h.
        scaled: (m, k, S) G^-1 h in units of the lengths of the columns.
        coefficients: (m, k) G^-1 h of the first residual.
    """

    groups: Indices
    gain: Array
    scaled: Array
    coefficients: Array


def _solve_subset(gram: Array, cross: Array, subset: list[int]) -> _SubsetSolution:
    """Solve the normal equations G c = h of each group for a subset of its columns.

    Groups whose columns are zero or collinear are left out. `gram` G is (n, k, k), `cross` h (n, k,
    S), and `subset` has the indices of the columns.
    """
    products = gram[:, subset][:, :, subset]
    lengths = np.sqrt(np.maximum(np.diagonal(products, axis1=1, axis2=2), 0.0))
    nonzero_groups = np.flatnonzero((lengths > 0).all(axis=1))
    scale = lengths[nonzero_groups][:, :, None]
    normal = products[nonzero_groups] / scale / scale.transpose(0, 2, 1)
    # Collinear columns have no unique solution, and a smaller subset explains the same.
    has_full_rank = np.linalg.eigvalsh(normal)[:, 0] >= RANK_TOLERANCE
    solvable = nonzero_groups[has_full_rank]
    scale = scale[has_full_rank]
    right_hand_side = cross[solvable[:, None], subset] / scale
    # With hundreds of right-hand sides, inverses are faster, and these matrices have unit
    # diagonals.
    scaled = np.linalg.inv(normal[has_full_rank]) @ right_hand_side
    gain = np.einsum("nks,nks->ns", scaled, right_hand_side)
    return _SubsetSolution(solvable, gain, scaled, scaled[:, :, 0] / scale[:, :, 0])


def _solve_unconstrained(gram: Array, cross: Array) -> tuple[Array, Array]:
    """Solve G c = h with all columns by eigenvalues, without sign constraints.

    It is used for groups with too many columns to try all subsets.

    Args:
        gram: G (n, k, k) of each group.
        cross: h (n, k, S).

    Returns:
        The explained sums of squares (n, S), and the coefficients (n, k) for the first residual.
    """
    # Some of many columns nearly repeat others, as overlapping basis functions do; their
    # contribution is rounding.
    powers = np.diagonal(gram, axis1=1, axis2=2)
    scale = np.sqrt(np.maximum(powers, 1e-300))[:, :, None]
    values, vectors = np.linalg.eigh(gram / scale / scale.transpose(0, 2, 1))
    is_counted = values > RANK_TOLERANCE * values[:, -1:]
    weights = np.where(is_counted, 1.0 / np.where(is_counted, values, 1.0), 0.0)
    # In the eigenbasis G is diagonal, so h'G^-1 h is a sum with one term for each eigenvector.
    right_hand_side = vectors.transpose(0, 2, 1) @ (cross / scale)
    scaled_coefficients = weights[:, :, None] * right_hand_side
    gain: Array = np.einsum("nks,nks->ns", right_hand_side, scaled_coefficients)
    coefficients = (vectors @ scaled_coefficients[:, :, :1]) / scale
    return gain, coefficients[:, :, 0]
