"""Sums over samples from which products come that are whitened by any correlation: eq. (1) of
`bench.gap.causes.products`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bench.gap.model.noise import Mask
from bench.gap.model.world import Indices
from sims.base import Array


class Parts(NamedTuple):
    """The three sums that eq. (1) puts together, each an array of products."""

    whole: Array
    mixed: Array
    ends: Array

    @staticmethod
    def of(*shape: int) -> Parts:
        """Nothing yet, to be added to."""
        return Parts(np.zeros(shape), np.zeros(shape), np.zeros(shape))

    def at(self, phi: float) -> Array:
        """The products after whitening by a correlation."""
        square = phi * phi
        follow = (1.0 + square) * self.whole - phi * self.mixed - square * self.ends
        result: Array = follow / (1.0 - square)  # (1)
        return result


class Place(NamedTuple):
    """A stretch of a run.

    Attributes:
        run: which.
        begin, end: its samples.
        edge: which of them lack a neighbour, all channels in a row.
        lacking: (m,) how many each of those lacks.
    """

    run: int
    begin: int
    end: int
    edge: Indices
    lacking: Array


class Columns(NamedTuple):
    """Columns over a stretch in sigmas, all channels in a row.

    Attributes:
        now: (k, n) the samples.
        near: (k, n) those before and behind each, added.
        edge: (k, m) those that lack a neighbour.
    """

    now: Array
    near: Array
    edge: Array


def lacking(seen: Mask) -> Array:
    """(R, T, C) how many of its two neighbours each sample lacks that is there."""
    lacking = np.full(seen.shape, 2.0)
    lacking[:, 1:] -= seen[:, :-1]
    lacking[:, :-1] -= seen[:, 1:]
    # Behind a gap noise starts anew: what it remembers of before is not known.
    return np.where(seen, lacking, 0.0)


def part_of(parts: Parts, run: int) -> Parts:
    """Those of one run, where they are kept."""
    return Parts(*(values[run] for values in parts))


def gather(parts: Parts, some: Columns, others: Columns, place: Place) -> None:
    """Add the products of all columns of some with all of others."""
    parts.whole[...] += some.now @ np.swapaxes(others.now, -1, -2)
    # Summed over a run it makes no difference on which side the neighbours are.
    parts.mixed[...] += some.now @ np.swapaxes(others.near, -1, -2)
    parts.ends[...] += (some.edge * place.lacking) @ np.swapaxes(others.edge, -1, -2)


def add_squares(parts: Parts, some: Columns, place: Place) -> None:
    """Add the products of columns with themselves."""
    parts.whole[...] += np.einsum("kn,kn->k", some.now, some.now)
    parts.mixed[...] += np.einsum("kn,kn->k", some.near, some.now)
    parts.ends[...] += np.einsum("km,km,m->k", some.edge, some.edge, place.lacking)
