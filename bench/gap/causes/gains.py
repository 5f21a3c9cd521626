"""What groups of directions explain of residuals: least squares, many groups and residuals at once.

With G = <D, D> and h = <D, e> of a group's directions D and a residual e, the coefficients G^-1 h
explain h'G^-1 h of the sum of squares <e, e>.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from bench.gap.causes.candidates import Directions
from bench.gap.causes.products import RANK
from bench.gap.model.world import Indices
from sims.base import Array

SMALL = 4
"""Groups of more columns are taken as they are, without a choice of columns."""


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


@dataclass(frozen=True)
class Batch:
    """Groups that are solved at once: of as many columns, the same of them held.

    Attributes:
        places: (n,) which of the groups.
        columns: (n, k) their places among the directions.
        positive: (k,) which of them must not be negative.
    """

    places: Indices
    columns: Indices
    positive: tuple[bool, ...]


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


def batches(members: Sequence[Group]) -> list[Batch]:
    """The groups by what they have in common."""
    alike: dict[tuple[bool, ...], list[int]] = {}
    for i, group in enumerate(members):
        alike.setdefault(group.positive, []).append(i)
    result = []
    for positive, places in alike.items():
        columns = [members[i].columns for i in places]
        result.append(
            Batch(
                np.array(places, dtype=np.intp),
                np.array(columns, dtype=np.intp),
                positive,
            )
        )
    return result


def explained(gram: Array, cross: Array, positive: Sequence[bool]) -> tuple[Array, Array]:
    """Sums of squares (n, S) that n groups explain, each with the best choice of its columns, and
    the coefficients (n, k) of the first residual.

    Coefficients that must not be negative are held at zero where they would be: the least squares
    of the constraint are those of some choice of columns, so all are tried (C. L. Lawson, R. J.
    Hanson, Solving Least Squares Problems, 1974, chapter 23).

    Args:
        gram: G (n, k, k) of each group.
        cross: h (n, k, S).
        positive: (k,) which columns must not have negative coefficients.
    """
    number, count, samples = cross.shape
    if count > SMALL:
        return _jointly(gram, cross)
    best = np.zeros((number, samples))
    coefficients = np.zeros((number, count))
    rest = np.arange(number)
    # Nothing is held of most effects, and all columns together explain most.
    if not any(positive):
        solved = _solved(gram, cross, list(range(count)))
        best[solved.groups] = solved.gain
        coefficients[solved.groups] = solved.own
        rest = np.setdiff1d(rest, solved.groups)
    if rest.size:
        best[rest], coefficients[rest] = _chosen(gram[rest], cross[rest], positive)
    return best, coefficients


def _chosen(gram: Array, cross: Array, positive: Sequence[bool]) -> tuple[Array, Array]:
    """The same by the best of all choices of columns."""
    number, count, samples = cross.shape
    best = np.zeros((number, samples))
    coefficients = np.zeros((number, count))
    for chosen in _choices(count):
        solved = _solved(gram, cross, chosen)
        held = [place for place, i in enumerate(chosen) if positive[i]]
        former = best[solved.groups]
        # More columns must explain more than rounding: else the fewer stand.
        better = solved.gain > former * (1.0 + 1e-9)
        if held:
            better &= (solved.scaled[:, held] >= 0).all(axis=1)
        best[solved.groups] = np.where(better, solved.gain, former)
        # Columns that are not chosen have no part in it.
        improved = better[:, 0]
        rows = solved.groups[improved]
        coefficients[rows] = 0.0
        coefficients[rows[:, None], chosen] = solved.own[improved]
    return best, coefficients


def _choices(count: int) -> Iterator[list[int]]:
    """Every choice of at least one of so many columns, those of fewer first."""
    for size in range(1, count + 1):
        for chosen in combinations(range(count), size):
            yield list(chosen)


class _Solved(NamedTuple):
    """What some columns of groups explain by themselves.

    Attributes:
        groups: (m,) those in which they are neither absorbed nor alike.
        gain: (m, S) h'G^-1 h.
        scaled: (m, k, S) G^-1 h in units of the columns' lengths.
        own: (m, k) G^-1 h of the first residual.
    """

    groups: Indices
    gain: Array
    scaled: Array
    own: Array


def _solved(gram: Array, cross: Array, chosen: list[int]) -> _Solved:
    """Solve for some columns of each group."""
    products = gram[:, chosen][:, :, chosen]
    lengths = np.sqrt(np.maximum(np.diagonal(products, axis1=1, axis2=2), 0.0))
    acting = np.flatnonzero((lengths > 0).all(axis=1))
    scale = lengths[acting][:, :, None]
    normal = products[acting] / scale / scale.transpose(0, 2, 1)
    # Columns that are alike share what they explain in any way: a choice with fewer has it.
    apart = np.linalg.eigvalsh(normal)[:, 0] >= RANK
    solvable = acting[apart]
    scale = scale[apart]
    right = cross[solvable[:, None], chosen] / scale
    # For hundreds of right sides inverses are quicker, and these matrices have unit diagonals.
    scaled = np.linalg.inv(normal[apart]) @ right
    gain = np.einsum("nks,nks->ns", scaled, right)
    return _Solved(solvable, gain, scaled, scaled[:, :, 0] / scale[:, :, 0])


def _jointly(gram: Array, cross: Array) -> tuple[Array, Array]:
    """The same for groups of many columns, none of them held."""
    # Of many columns some nearly repeat others, as hats that overlap do: what they add is rounding.
    powers = np.diagonal(gram, axis1=1, axis2=2)
    scale = np.sqrt(np.maximum(powers, 1e-300))[:, :, None]
    values, vectors = np.linalg.eigh(gram / scale / scale.transpose(0, 2, 1))
    counted = values > RANK * values[:, -1:]
    weights = np.where(counted, 1.0 / np.where(counted, values, 1.0), 0.0)
    # Along eigenvectors G is diagonal, and h'G^-1 h a sum of one term for each.
    right = vectors.transpose(0, 2, 1) @ (cross / scale)
    solved = weights[:, :, None] * right
    gain: Array = np.einsum("nks,nks->ns", right, solved)
    coefficients = (vectors @ solved[:, :, :1]) / scale
    return gain, coefficients[:, :, 0]
