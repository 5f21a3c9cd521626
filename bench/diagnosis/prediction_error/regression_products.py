"""Inner products of whitened responses W and innovations e, which a regression needs.

All K candidates of a library have K² products, but a regression uses few of them: those within
each group of columns, and those of the chosen columns with all others. So the products of a long
library are computed when they are needed, in double precision from responses in single precision.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy

import numpy as np
from numpy.typing import NDArray

from bench.diagnosis.kalman.kalman_recursions import IndexArray
from sims.core.simulator import Array

MAX_SMALL_GROUP = 4
"""Maximum number of columns of a group whose products are not computed by a matrix product."""
SAMPLES_PER_BLOCK = 128
"""Number of samples that are converted to double precision together; they fit in the CPU cache."""


class GramMatrices:
    """All inner products of the columns, as matrices.

    Attributes:
        grams: Wᵀ W (R, K, K).
        squares: (R, K) sums of squares of the columns.
        crosses: Wᵀ e (R, K).
        totals: eᵀ e (R,).
    """

    def __init__(self, grams: Array, crosses: Array, totals: Array) -> None:
        """Store known products of K columns and the innovations in each of R runs.

        Args:
            grams: Wᵀ W (R, K, K) of the whitened responses W, the columns of a regression.
            crosses: Wᵀ e (R, K) of the columns with the innovations e.
            totals: eᵀ e (R,).
        """
        self.grams, self.crosses, self.totals = grams, crosses, totals
        self.squares: Array = np.diagonal(grams, axis1=1, axis2=2)

    def select_rows(self, columns: IndexArray) -> Array:
        """Return the products (c, K) of c columns with all columns, summed over all runs."""
        rows: Array = self.grams[:, columns].sum(axis=0)
        return rows

    def select(self, columns: IndexArray) -> Array:
        """Return the products (R, c, c) of c columns with each other."""
        products: Array = self.grams[:, columns[:, None], columns]
        return products

    def sum_within(self, groups: IndexArray) -> Array:
        """Return the products (n, k, k) within n groups of k columns, summed over all runs."""
        products: Array = self.grams.sum(axis=0)[groups[:, :, None], groups[:, None, :]]
        return products

    def add_to_innovations(self, column: int) -> GramMatrices:
        """Return the products of the same columns with innovations that contain one of them.

        Args:
            column: index of the column w; the new innovations are e + w.
        """
        row = self.grams[:, column]
        # (e + w)'(e + w) = e'e + 2 w'e + w'w
        totals = self.totals + 2.0 * self.crosses[:, column] + row[:, column]
        return GramMatrices(self.grams, self.crosses + row, totals)


class ResponseProducts:
    """Inner products that are computed from the responses when they are needed.

    Attributes:
        squares: (R, K) sums of squares of the columns.
        crosses: Wᵀ e (R, K).
        totals: eᵀ e (R,).
    """

    def __init__(
        self, responses: Sequence[NDArray[np.floating]], innovations: Sequence[Array]
    ) -> None:
        """Compute the products with the innovations, and the sums of squares of the columns.

        Products of columns with each other are computed later, when they are needed.

        Args:
            responses: whitened responses W (N, K) of each run: K columns of N samples.
            innovations: whitened innovations e (N,) of each run.
        """
        self._responses, self._innovations = responses, innovations
        count = responses[0].shape[1]
        self.squares = np.zeros((len(responses), count))
        self.crosses = np.zeros((len(responses), count))
        self.totals = np.array([float(e @ e) for e in innovations])
        for run, samples, block in self._iterate_blocks():
            self.squares[run] += np.einsum("sk,sk->k", block, block)
            self.crosses[run] += innovations[run][samples] @ block
        # Products (K,) of a column with all others, and products within groups by their columns.
        self._known_rows: dict[int, Array] = {}
        self._known_groups: dict[tuple[int, bytes], Array] = {}

    def _iterate_blocks(self) -> Iterator[tuple[int, slice, Array]]:
        """Iterate over the run, the samples and the responses (s, K) of all blocks of samples."""
        for run, responses in enumerate(self._responses):
            for begin in range(0, len(responses), SAMPLES_PER_BLOCK):
                samples = slice(begin, begin + SAMPLES_PER_BLOCK)
                yield run, samples, responses[samples].astype(np.float64)

    def select_rows(self, columns: IndexArray) -> Array:
        """Return the products (c, K) of c columns with all K columns, summed over all runs.

        Known products are reused, because a selection adds one group of columns after another.

        Args:
            columns: (c,) indices of the columns.
        """
        new_columns = [c for c in dict.fromkeys(columns.tolist()) if c not in self._known_rows]
        if new_columns:
            rows = np.zeros((len(new_columns), self.squares.shape[1]))
            for _, _, block in self._iterate_blocks():
                rows += block[:, new_columns].T @ block
            self._known_rows |= dict(zip(new_columns, rows, strict=True))
        result = np.zeros((columns.size, self.squares.shape[1]))
        for i, column in enumerate(columns.tolist()):
            result[i] = self._known_rows[column]
        return result

    def select(self, columns: IndexArray) -> Array:
        """Return the products (R, c, c) of c columns with each other."""
        products = []
        for responses in self._responses:
            chosen = responses[:, columns].astype(np.float64)
            products.append(chosen.T @ chosen)
        return np.array(products)

    def sum_within(self, groups: IndexArray) -> Array:
        """Return the products (n, k, k) within n groups of k columns, summed over all runs.

        Known products are reused, because several regressions have the same groups.

        Args:
            groups: (n, k) indices of the columns of each group.
        """
        key = groups.shape[1], groups.tobytes()
        if key not in self._known_groups:
            self._known_groups[key] = self._compute_within(groups)
        return self._known_groups[key]

    def _compute_within(self, groups: IndexArray) -> Array:
        """Return the products (n, k, k) within groups that are not known yet."""
        group_count, size = groups.shape
        result = np.zeros((group_count, size, size))
        # The sums of squares are known.
        if size == 1:
            result[:, 0, 0] = self.squares.sum(axis=0)[groups[:, 0]]
            return result
        if size > MAX_SMALL_GROUP:
            for responses in self._responses:
                for group, products in zip(groups, result, strict=True):
                    chosen = responses[:, group].astype(np.float64)
                    products += chosen.T @ chosen
            return result
        for _, _, block in self._iterate_blocks():
            members = [block[:, groups[:, i]] for i in range(size)]
            for i in range(size):
                for j in range(i, size):
                    result[:, i, j] += np.einsum("sn,sn->n", members[i], members[j])
        # The products are symmetric.
        rows, columns = np.tril_indices(size, -1)
        result[:, rows, columns] = result[:, columns, rows]
        return result

    def add_to_innovations(self, column: int) -> ResponseProducts:
        """Return the products of the same columns with innovations that contain one of them.

        Args:
            column: index of the column w; the new innovations are e + w.
        """
        # Products of columns with columns do not depend on the innovations, and are shared.
        result = copy(self)
        result._innovations = [
            e + responses[:, column]
            for responses, e in zip(self._responses, self._innovations, strict=True)
        ]
        result.totals = np.array([float(e @ e) for e in result._innovations])
        result.crosses = np.zeros_like(self.crosses)
        for run, samples, block in self._iterate_blocks():
            result.crosses[run] += result._innovations[run][samples] @ block
        return result
