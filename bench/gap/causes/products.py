"""Inner products of residuals, directions and Jacobian, whitened, without what a model may absorb
by itself.

Residual e, directions D and Jacobian J are whitened by W(phi), a first-order autoregression, run by
run, where phi is common to all channels. W'W has three diagonals. With a_t, b_t samples of two
columns, zero where nothing was seen, and n_t how many of the two neighbours of t are missing,

    (W a)'(W b) = ((1 + phi^2) sum a_t b_t - phi sum a_t (b_t-1 + b_t+1) - phi^2 sum n_t a_t b_t)
                  / (1 - phi^2)                                                                (1)

so three products of the samples serve every phi, the last of them over the ends of runs alone. What
the model's own freedom absorbs is taken out of each product of two columns a and b by a Schur
complement, the initial states of each run first and the parameters of all runs after (the theorem
of R. Frisch, F. V. Waugh and M. C. Lovell), with L a root of the inverse, L L' = (J'J)^-1:

    <a, b> = a'b - (L'J'a)'(L'J'b)                                                             (2)

Directions are multiplied with each other only where they act together, so that the cost is
proportional to their number, as it is to that of samples and of residuals.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from bench.gap.causes.sums import (
    Columns,
    Parts,
    Place,
    add_squares,
    gather,
    lacking,
    part_of,
)
from bench.gap.model.noise import Mask
from bench.gap.model.problem import Fit
from bench.gap.model.world import Indices
from sims.base import Array

ABSORBED = 1e-12
"""Of a direction's sum of squares less than this share is left where the model's own freedom
absorbs it.
"""
RANK = 1e-9
"""Directions below this share of the largest eigenvalue of their scaled products are none."""
CHUNK = 400_000
"""Numbers of one array that are worked on at once: more would not stay in the cache."""
SHORTEST = 64
"""But so many samples at least, or each stretch would cost more than its products."""


class _Reduced(NamedTuple):
    """What a design is after whitening, without what is absorbed.

    Attributes:
        states: (R, s, s) roots of the inverse normal matrices of initial states.
        by_states: (R s, q + K) L'J'a of eq. (2), of parameters and directions.
        own: (q, q) the root for the parameters.
        by_own: (q, K) what they take from directions.
        grams: (n, k, k) products of directions in each block.
        acting: (K,) which of them are not absorbed.
    """

    states: Array
    by_states: Array
    own: Array
    by_own: Array
    grams: list[Array]
    acting: Mask


class Design:
    """What products about one model have in common, whatever the residuals: its Jacobian and the
    directions.

    Attributes:
        blocks: as given.

    Args:
        at: the model.
        directions: (R, T, C, K) what each would change.
        seen: (R, T, C) which samples there are.
        sigma: (C,) that weighs the channels.
        blocks: (n, k) each, columns of the directions that act together, as many in every row.
    """

    def __init__(
        self, at: Fit, directions: Array, seen: Mask, sigma: Array, blocks: Sequence[Indices]
    ) -> None:
        self.blocks = list(blocks)
        self._own = at.free.size
        self._jacobian = np.moveaxis(at.jacobian, 3, 0)
        self._directions = np.moveaxis(directions, 3, 0)
        self._weights = seen / sigma
        self._lacking = lacking(seen)
        size, runs, *_ = self._jacobian.shape
        count = len(self._directions)
        self._normal = Parts.of(runs, size, size)
        self._mixed = Parts.of(runs, size, count)
        self._powers = Parts.of(count)
        self._grams = [Parts.of(*block.shape, block.shape[1]) for block in self.blocks]
        self._known: dict[float, _Reduced] = {}
        for place in self._places():
            self._add(place)

    def _places(self) -> Iterator[Place]:
        """All runs, in stretches that stay in the cache."""
        count, runs, length, channels = self._directions.shape
        step = max(CHUNK // (max(count, 1) * channels), SHORTEST)
        for run in range(runs):
            for begin in range(0, length, step):
                end = min(begin + step, length)
                without = self._lacking[run, begin:end].ravel()
                edge = np.flatnonzero(without)
                yield Place(run, begin, end, edge, without[edge])

    def _columns(self, values: Array, place: Place, beside: bool = True) -> Columns:
        """Of values (k, R, T, C); the neighbours only where they are asked for."""
        run, begin, end = place.run, place.begin, place.end
        rows = len(values)
        # One sample more at either side, as a neighbour of the outermost.
        first, last = (max(begin - 1, 0), end + 1) if beside else (begin, end)
        around = values[:, run, first:last] * self._weights[run, first:last]
        now = around[:, begin - first : end - first]
        near = np.zeros_like(now)
        if beside:
            former = around[:, : end - first - 1]
            near[:, now.shape[1] - former.shape[1] :] += former
            latter = around[:, begin - first + 1 :]
            near[:, : latter.shape[1]] += latter
        # Written out, as -1 is ambiguous where there are no rows.
        size = rows, now.shape[1] * now.shape[2]
        flat = now.reshape(size)
        return Columns(flat, near.reshape(size), flat[:, place.edge])

    def _add(self, place: Place) -> None:
        """The products of one stretch."""
        own = self._columns(self._jacobian, place)
        some = self._columns(self._directions, place)
        gather(part_of(self._normal, place.run), own, own, place)
        gather(part_of(self._mixed, place.run), own, some, place)
        add_squares(self._powers, some, place)
        for block, parts in zip(self.blocks, self._grams, strict=True):
            # A column that acts alone has its square already.
            if block.shape[1] > 1:
                members = Columns(some.now[block], some.near[block], some.edge[block])
                gather(parts, members, members, place)

    def crossed(self, *residuals: Array) -> tuple[Parts, Parts, Parts]:
        """Products of residuals (S, R, T, C), any number of arrays one after another, with
        themselves (S,), with the Jacobian run by run (R, q + s, S), and of directions with them
        (K, S).
        """
        size, runs, *_ = self._jacobian.shape
        samples = sum(len(some) for some in residuals)
        squares = Parts.of(samples)
        shared = Parts.of(runs, size, samples)
        cross = Parts.of(len(self._directions), samples)
        for place in self._places():
            # Stretch by stretch: side by side as a whole they would take their memory once more.
            parts = [self._columns(some, place) for some in residuals]
            left = Columns(*(np.concatenate(rows) for rows in zip(*parts, strict=True)))
            own = self._columns(self._jacobian, place)
            some = self._columns(self._directions, place, beside=False)
            add_squares(squares, left, place)
            gather(part_of(shared, place.run), own, left, place)
            gather(cross, some, left, place)
        return squares, shared, cross

    def left(self, residuals: Array) -> Array:
        """What a fit of all that the model may absorb, by least squares, leaves of residuals
        (S, R, T, C).
        """
        known = self.reduced(0.0)
        q = self._own
        weighted = self._jacobian * self._weights
        shared = np.stack(
            [
                _flat(own) @ _flat(residuals[:, run] * self._weights[run]).T
                for run, own in enumerate(np.moveaxis(weighted, 1, 0))
            ]
        )
        by_states, by_own = _taken(known, shared)
        # Backwards: coefficients of the parameters, then of each run's initial states.
        parameters = known.own @ by_own
        rest = by_states - known.by_states[:, :q] @ parameters
        runs, size, _ = known.states.shape
        states = known.states @ rest.reshape(runs, size, len(residuals))
        result = np.empty_like(residuals)
        for run in range(runs):
            coefficients = np.concatenate([parameters, states[run]])
            followed = coefficients.T @ _flat(self._jacobian[:, run])
            result[:, run] = residuals[:, run] - followed.reshape(residuals[:, run].shape)
        return np.where(self._weights > 0, result, 0.0)

    def reduced(self, phi: float) -> _Reduced:
        """Whitened by a correlation, without what is absorbed; kept for the next residuals."""
        if phi not in self._known:
            self._known[phi] = self._reduce(phi)
        return self._known[phi]

    def _reduce(self, phi: float) -> _Reduced:
        q = self._own
        normal = self._normal.at(phi)
        mixed = self._mixed.at(phi)
        powers = self._powers.at(phi)

        # (2) with the initial states of each run for J, then with the parameters.
        states = _root(normal[:, q:, q:])
        others = np.concatenate([normal[:, q:, :q], mixed[:, q:]], axis=2)
        by_states = _absorbed(states, others)
        by_parameters, by_directions = by_states[:, :q], by_states[:, q:]
        left = normal[:, :q, :q].sum(axis=0) - by_parameters.T @ by_parameters
        own = _root(left)
        by_own = own.T @ (mixed[:, :q].sum(axis=0) - by_parameters.T @ by_directions)

        # Of directions that are absorbed only rounding is left, which would explain at random.
        taken = np.concatenate([by_directions, by_own])
        remaining = powers - np.einsum("ak,ak->k", taken, taken)
        acting = remaining > ABSORBED * powers
        remaining = np.where(acting, remaining, 0.0)
        grams = []
        for block, parts in zip(self.blocks, self._grams, strict=True):
            if block.shape[1] == 1:
                grams.append(remaining[block][:, :, None])
                continue
            columns = np.moveaxis(taken[:, block], 0, 2)
            gram = parts.at(phi) - columns @ columns.transpose(0, 2, 1)
            # Rounding has made the two halves differ, and an eigensolver reads one of them.
            symmetric = (gram + gram.transpose(0, 2, 1)) / 2.0
            both = acting[block][:, :, None] & acting[block][:, None, :]
            grams.append(np.where(both, symmetric, 0.0))
        return _Reduced(states, by_states, own, by_own, grams, acting)


class Products:
    """Inner products of residuals and directions after all that the model's own freedom absorbs is
    taken out, eq. (2).

    Args:
        design: the model's Jacobian and the directions.
        residuals: (S, R, T, C), zero where nothing was seen; any number of arrays.
    """

    def __init__(self, design: Design, *residuals: Array) -> None:
        self._design = design
        self._squares, self._shared, self._cross = design.crossed(*residuals)

    def projected(self, phi: float) -> tuple[Array, list[Array], Array]:
        """Products of eq. (2) after whitening by a correlation.

        Returns:
            Sums of squares (S,) of the residuals, products (n, k, k) of the directions in each
            block, and of directions with residuals (K, S).
        """
        known = self._design.reduced(phi)
        q = len(known.own)
        by_states, by_own = _taken(known, self._shared.at(phi))
        taken = np.concatenate([by_states, by_own])
        total = self._squares.at(phi) - np.einsum("as,as->s", taken, taken)
        others = np.concatenate([known.by_states[:, q:], known.by_own])
        cross = self._cross.at(phi) - others.T @ taken
        return np.maximum(total, 0.0), known.grams, np.where(known.acting[:, None], cross, 0.0)


def _flat(values: Array) -> Array:
    """Rows (k, T, C) with all channels in a row."""
    return values.reshape(len(values), -1)


def _taken(known: _Reduced, shared: Array) -> tuple[Array, Array]:
    """L'J'e of eq. (2) for initial states (R s, S) and for parameters (q, S), of the products
    (R, q + s, S) of the Jacobian with residuals.
    """
    q = len(known.own)
    # With the initial states of each run for J, then with the parameters.
    by_states = _absorbed(known.states, shared[:, q:])
    left = shared[:, :q].sum(axis=0) - known.by_states[:, :q].T @ by_states
    return by_states, known.own.T @ left


def _absorbed(roots: Array, products: Array) -> Array:
    """(R s, n) L'J'a of eq. (2), of products (R, s, n)."""
    runs, size, count = products.shape
    return (roots.transpose(0, 2, 1) @ products).reshape(runs * size, count)


def _root(normal: Array) -> Array:
    """L of eq. (2) for positive semidefinite matrices (..., s, s); directions that hardly count are
    left out.
    """
    if not normal.shape[-1]:
        return normal
    # Columns of any unit on one scale, so that the cut-off means the same for each.
    powers = np.diagonal(normal, axis1=-2, axis2=-1)
    scale = np.sqrt(np.maximum(powers, 0.0))
    # A row of zeros stays one: divided by infinity it has no part in any direction.
    scale = np.where(scale > 0, scale, np.inf)[..., None]
    values, vectors = np.linalg.eigh(normal / scale / np.swapaxes(scale, -1, -2))
    largest = np.maximum(values[..., -1:], 1e-300)
    counted = values > RANK * largest
    root = np.where(counted, 1.0 / np.sqrt(np.where(counted, values, 1.0)), 0.0)
    result: Array = vectors * root[..., None, :] / scale
    return result
