"""Inner products of residuals, directions and Jacobian, whitened, without what a model may absorb
by itself.

Residual e, directions D and Jacobian J are whitened by W(phi), a first-order autoregression, run by
run, where phi is common to all channels. For a sample t that follows another, and a first one f,

    (W a)'(W b) = a_f b_f + (a_t b_t - phi (a_t b_t-1 + a_t-1 b_t) + phi^2 a_t-1 b_t-1)
                  / (1 - phi^2), summed over f and t                                           (1)

so four products of the samples serve every phi. What the model's own freedom absorbs is taken out
of each product of two columns a and b by a Schur complement, the initial states of each run first
and the parameters of all runs after (the theorem of R. Frisch, F. V. Waugh and M. C. Lovell):

    <a, b> = a'b - a'J (J'J)^-1 J'b                                                            (2)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bench.gap.model.fit import Fit
from bench.gap.model.noise import Mask
from sims.base import Array

ABSORBED = 1e-12
"""Of a direction's sum of squares less than this share is left where the model's own freedom
absorbs it.
"""


RANK = 1e-9
"""Directions below this share of the largest eigenvalue of their scaled products are none."""


class Parts(NamedTuple):
    """Products of samples that eq. (1) puts together."""

    first: Array
    """of samples without a forerunner."""
    now: Array
    """of samples with one."""
    mixed: Array
    """of those with their forerunners, both ways."""
    before: Array
    """of the forerunners."""

    def at(self, phi: float) -> Array:
        """The products after whitening by a correlation."""
        follow = self.now - phi * self.mixed + phi * phi * self.before
        return self.first + follow / (1.0 - phi * phi)  # (1)


class _Run(NamedTuple):
    """Products of one run: of residuals with themselves, of columns, of columns with residuals."""

    squares: Parts
    columns: Parts
    cross: Parts


class Products:
    """Inner products of residuals and directions after all that the model's own freedom absorbs is
    taken out, eq. (2).

    Whitening by a correlation phi mixes products of samples with themselves and with those before
    them, so that one pass over the samples serves every phi. All are computed run by run, since
    initial states are a run's own.
    """

    def __init__(
        self, at: Fit, residuals: Array, directions: Array, seen: Mask, sigma: Array
    ) -> None:
        self._own = at.free.size
        self._states = at.jacobian.shape[3] - at.free.size
        self._runs: list[_Run] = []
        # Behind a gap noise starts anew: what it remembers of before is not known.
        follows = np.zeros_like(seen)
        follows[:, 1:] = seen[:, 1:] & seen[:, :-1]
        units = sigma[:, None]
        for r in range(len(seen)):
            columns = np.concatenate([at.jacobian[r], directions[r]], axis=2)
            run = _products(
                columns / units,
                residuals[r] / units,
                seen[r],
                follows[r],
            )
            self._runs.append(run)

    def projected(self, phi: float) -> tuple[Array, Array, Array]:
        """Products of eq. (2) after whitening by a correlation.

        Returns:
            Sums of squares (S,) of the residuals, products of directions (K, K) and of both (K, S).
        """
        q = self._own
        total, cross, normal, whole = self._without_states(phi)
        # (2) once more, for the parameters that all runs share.
        inverse = _inverse(normal[:q, :q])
        shared = cross[:q]
        mixed = normal[q:, :q]
        absorbed = np.einsum("ks,kl,ls->s", shared, inverse, shared)
        left = total - absorbed
        gram = normal[q:, q:] - mixed @ inverse @ normal[:q, q:]
        both = cross[q:] - mixed @ (inverse @ shared)

        # Of directions that are absorbed only rounding is left, which would explain at random.
        acting = np.diagonal(gram) > ABSORBED * whole
        rows = acting[:, None]
        # Rounding has made the two halves differ, and an eigensolver reads one of them.
        symmetric = (gram + gram.T) / 2.0
        gram = np.where(rows & acting, symmetric, 0.0)
        both = np.where(rows, both, 0.0)
        return np.maximum(left, 0.0), gram, both

    def _without_states(self, phi: float) -> tuple[Array, Array, Array, Array]:
        """Sums over runs of what each run's initial states leave: of residuals, of both, of
        parameters and directions; and the squares of directions before anything is taken out.
        """
        q = self._own
        last = q + self._states
        own = slice(q, last)
        total: Array = np.zeros(())
        cross = normal = whole = total
        for run in self._runs:
            n = run.columns.at(phi)
            c = run.cross.at(phi)
            t = run.squares.at(phi)
            whole = whole + np.diagonal(n)[last:]

            # (2) with the initial states of this run for J.
            rest = np.r_[0:q, last : len(n)]
            inverse = _inverse(n[own, own])
            mixed = n[rest][:, own]
            states = c[own]
            absorbed = np.einsum("ks,kl,ls->s", states, inverse, states)
            total = total + t - absorbed
            cross = cross + c[rest] - mixed @ (inverse @ states)
            others = n[np.ix_(rest, rest)]
            normal = normal + others - mixed @ inverse @ n[own][:, rest]
        return total, cross, normal, whole


def _products(columns: Array, residuals: Array, seen: Mask, follows: Mask) -> _Run:
    """The products of one run.

    Args:
        columns: (T, C, M) Jacobian and directions, in sigmas.
        residuals: (T, C, S) in sigmas.
        seen: (T, C) which samples there are.
        follows: (T, C) which of them have a forerunner.
    """
    first = seen & ~follows
    later = follows[1:]
    x_first = _rows(columns, first)
    e_first = _rows(residuals, first)
    x_now = _rows(columns[1:], later)
    e_now = _rows(residuals[1:], later)
    x_before = _rows(columns[:-1], later)
    e_before = _rows(residuals[:-1], later)
    # Of residuals only each with itself is asked for, never one surrogate with another.
    squares = Parts(
        first=np.square(e_first).sum(axis=0),
        now=np.square(e_now).sum(axis=0),
        mixed=2.0 * (e_now * e_before).sum(axis=0),
        before=np.square(e_before).sum(axis=0),
    )
    mixed = x_now.T @ x_before
    products = Parts(
        first=x_first.T @ x_first,
        now=x_now.T @ x_now,
        mixed=mixed + mixed.T,
        before=x_before.T @ x_before,
    )
    cross = Parts(
        first=x_first.T @ e_first,
        now=x_now.T @ e_now,
        mixed=x_now.T @ e_before + x_before.T @ e_now,
        before=x_before.T @ e_before,
    )
    return _Run(squares, products, cross)


def _rows(values: Array, mask: Mask) -> Array:
    """Values (T, C, M) where the mask (T, C) holds, (n, M)."""
    # Without gaps a view will do, and these are the largest arrays of the test.
    if mask.all():
        return values.reshape(-1, values.shape[2])
    return values[mask]


def _inverse(normal: Array) -> Array:
    """Of a positive semidefinite matrix; directions that hardly count are left out."""
    # Columns of any unit on one scale, so that the cut-off means the same for each.
    powers = np.maximum(np.diagonal(normal), 0.0)
    scale = np.sqrt(powers)
    # A row of zeros stays one: divided by infinity it has no part in any direction.
    scale = np.where(scale > 0, scale, np.inf)
    if not scale.size:
        return normal
    units = np.outer(scale, scale)
    values, vectors = np.linalg.eigh(normal / units)
    largest = max(float(values[-1]), 1e-300)
    counted = values > RANK * largest
    some = vectors[:, counted]
    weighted = some / values[counted]
    result: Array = weighted @ some.T / units
    return result
