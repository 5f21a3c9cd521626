"""Which combinations of parameters a target's data can identify, and a recommendation's error along
them.

The Fisher information at the truth, in units of the training ranges, has eigenvectors along which
the data tell much (stiff) or next to nothing (sloppy): R. N. Gutenkunst et al., PLoS Comput. Biol.
3(10), e189 (2007), doi:10.1371/journal.pcbi.0030189; M. K. Transtrum et al., J. Chem. Phys. 143,
010901 (2015), doi:10.1063/1.4923066. An error along a sloppy direction is no fault of the tuner:
nobody could have known better.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sims.base import Array, Parameter

STIFF = 0.1
"""A direction is stiff where its 1 sigma (Cramer-Rao bound) is below this share of the training
range.
"""
STEP = 1e-4
"""Step of the central differences, in training ranges."""


@dataclass(frozen=True)
class Spectrum:
    """What one target's data say of each direction in parameter space, the stiffest first.

    Attributes:
        values: (dim,) eigenvalues of the Fisher information, per squared training range, falling.
        vectors: (dim, dim) their directions as columns, of length one, components in training
            ranges; the largest component is positive.
    """

    values: Array
    vectors: Array

    @property
    def sigmas(self) -> Array:
        """(dim,) the least 1 sigma of any unbiased estimate along each direction, in training
        ranges; may be inf.
        """
        with np.errstate(divide="ignore"):
            sigmas: Array = 1.0 / np.sqrt(self.values)
        return sigmas

    @property
    def stiff(self) -> NDArray[np.bool_]:
        """(dim,) which directions are stiff."""
        known: NDArray[np.bool_] = self.sigmas < STIFF
        return known

    def errors(self, errors: Array) -> tuple[Array, Array]:
        """Root mean squares (k,) of the components along stiff and along sloppy directions; NaN
        where there is none.

        Args:
            errors: (k, dim) recommended minus true parameters, in training ranges.
        """
        squares, stiff = (errors @ self.vectors) ** 2, self.stiff
        rms = [
            np.sqrt(squares[:, s].mean(axis=1)) if s.any() else np.full(len(errors), np.nan)
            for s in (stiff, ~stiff)
        ]
        return rms[0], rms[1]


def spectrum(
    simulate: Callable[[Array], Array], truth: Array, parameters: Sequence[Parameter], scale: Array
) -> Spectrum:
    """The spectrum at `truth`, by central differences that stay within the bounds.

    A sample that a simulation near the truth does not give (NaN) tells nothing of the parameter
    moved.

    Args:
        simulate: parameters (n, dim), physical -> observations (n, T, C).
        truth: (dim,), physical.
        parameters: with their bounds and training ranges.
        scale: (C,) 1 sigma of each channel's white noise, or its typical magnitude where no noise
            is known.
    """
    low, high = np.array([p.bounds for p in parameters]).T
    ranges = np.array([p.training_range for p in parameters])
    widths, dim = ranges[:, 1] - ranges[:, 0], len(parameters)
    moved = np.clip(truth + STEP * np.concatenate([np.diag(widths), -np.diag(widths)]), low, high)
    apart = np.diagonal(moved[:dim] - moved[dim:]) / widths
    seen = simulate(moved)
    changes = np.nan_to_num((seen[:dim] - seen[dim:]) / scale, nan=0.0, posinf=0.0, neginf=0.0)
    return of_jacobian((changes.reshape(dim, -1) / apart[:, None]).T)


def of_jacobian(jacobian: Array) -> Spectrum:
    """The spectrum of the information J^T J of a Jacobian (N, dim) of observations over their
    noise.

    From the singular values of J, which keeps the small eigenvalues that rounding in J^T J would
    drown.
    """
    dim = jacobian.shape[1]
    _, sizes, rows = np.linalg.svd(np.linalg.qr(jacobian, mode="r"))
    values, vectors = np.zeros(dim), rows.T
    values[: sizes.size] = sizes**2
    largest = np.take_along_axis(vectors, np.abs(vectors).argmax(axis=0)[None], axis=0)
    return Spectrum(values, vectors * np.where(largest < 0, -1.0, 1.0))
