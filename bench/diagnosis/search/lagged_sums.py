"""Sums of products of neighbouring samples, for whitening at any AR(1) correlation.

They give the products of eq. (1) of `bench.diagnosis.search.whitened_products`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.noise_model import Mask
from bench.diagnosis.evaluation.run_evaluator import Indices
from sims.core.simulator import Array


class LaggedSums(NamedTuple):
    """The three sums of eq. (1), each an array of products.

    Attributes:
        whole: products of equal samples.
        mixed: products of each sample with its neighbours.
        ends: products of samples without a neighbour, times the number of missing neighbours.
    """

    whole: Array
    mixed: Array
    ends: Array

    @staticmethod
    def zeros(*shape: int) -> LaggedSums:
        """Return sums of zeros with the given shape."""
        return LaggedSums(np.zeros(shape), np.zeros(shape), np.zeros(shape))

    def combine(self, phi: float) -> Array:
        """Return the products after whitening with the given correlation."""
        square = phi * phi
        follow = (1.0 + square) * self.whole - phi * self.mixed - square * self.ends
        result: Array = follow / (1.0 - square)  # (1)
        return result


class RunSegment(NamedTuple):
    """A section of a run.

    Attributes:
        run: index of the run.
        begin: first sample.
        end: end of the samples (exclusive).
        edge: (m,) indices of the samples that lack a neighbour, all channels in one row.
        lacking: (m,) number of missing neighbours of each of these samples.
    """

    run: int
    begin: int
    end: int
    edge: Indices
    lacking: Array


class SegmentColumns(NamedTuple):
    """Columns over a section of a run in sigmas, all channels in one row.

    Attributes:
        now: (k, n) the samples.
        near: (k, n) sum of the previous and the next sample of each sample.
        edge: (k, m) the samples that lack a neighbour.
    """

    now: Array
    near: Array
    edge: Array


def count_missing_neighbours(seen: Mask) -> Array:
    """Return the number of missing neighbours (R, T, C) of each available sample."""
    lacking = np.full(seen.shape, 2.0)
    lacking[:, 1:] -= seen[:, :-1]
    lacking[:, :-1] -= seen[:, 1:]
    # Missing samples count as zero: AR(1) noise restarts after a gap, because earlier noise is not
    # known.
    return np.where(seen, lacking, 0.0)


def select_run(parts: LaggedSums, run: int) -> LaggedSums:
    """Return the sums of one run, from sums that are stored for each run."""
    return LaggedSums(*(values[run] for values in parts))


def add_cross_products(
    parts: LaggedSums, some: SegmentColumns, others: SegmentColumns, place: RunSegment
) -> None:
    """Add the products of all columns of one set with all columns of another.

    Args:
        parts: sums to add to, in place.
        some: columns of the first set.
        others: columns of the second set.
        place: the section of the run.
    """
    parts.whole[...] += some.now @ np.swapaxes(others.now, -1, -2)
    # Summed over a run, it does not matter to which of the two columns the neighbours belong.
    parts.mixed[...] += some.now @ np.swapaxes(others.near, -1, -2)
    parts.ends[...] += (some.edge * place.lacking) @ np.swapaxes(others.edge, -1, -2)


def add_self_products(parts: LaggedSums, some: SegmentColumns, place: RunSegment) -> None:
    """Add the products of columns with themselves.

    Args:
        parts: sums to add to, in place.
        some: the columns.
        place: the section of the run.
    """
    parts.whole[...] += np.einsum("kn,kn->k", some.now, some.now)
    parts.mixed[...] += np.einsum("kn,kn->k", some.near, some.now)
    parts.ends[...] += np.einsum("km,km,m->k", some.edge, some.edge, place.lacking)
