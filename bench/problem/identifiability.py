"""Which combinations of parameters a target's data can identify, and a recommendation's error along
them.

Of N samples with white noise, each with a standard deviation of its own, the derivatives with
respect to the parameters in units of their training ranges make the Jacobian

    J_nk = (d y_n / d theta_k) / sigma_n                            (1)
    F = J^T J = V diag(lambda) V^T                                  (2)

with F the Fisher information. Along the eigenvector v_k no unbiased estimate has a smaller standard
deviation than (Cramer-Rao bound)

    sigma(v_k) = 1 / sqrt(lambda_k)                                 (3)

Where that is small, the data tell much (stiff), elsewhere next to nothing (sloppy): R. N.
Gutenkunst et al., PLoS Comput. Biol. 3(10), e189 (2007), doi:10.1371/journal.pcbi.0030189; M. K.
Transtrum et al., J. Chem. Phys. 143, 010901 (2015), doi:10.1063/1.4923066. An error along a sloppy
direction is no fault of the tuner: nobody could have known better.
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
        with np.errstate(divide="ignore"):  # data may say nothing of a direction
            sigmas: Array = 1.0 / np.sqrt(self.values)  # (3)
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
        squares = (errors @ self.vectors) ** 2
        return _rms(squares[:, self.stiff]), _rms(squares[:, ~self.stiff])


def _rms(squares: Array) -> Array:
    """(k,) root means of squares (k, directions); NaN where there is no direction."""
    if squares.shape[1] == 0:  # numpy would warn of an empty mean
        return np.full(len(squares), np.nan)
    rms: Array = np.sqrt(squares.mean(axis=1))
    return rms


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
    widths = ranges[:, 1] - ranges[:, 0]
    dim = len(parameters)
    # One parameter up in each of the first points, down in each of the others.
    steps = np.concatenate([np.diag(widths), -np.diag(widths)])
    moved = np.clip(truth + STEP * steps, low, high)
    # At a bound only one side moves, and the difference is over what is left of the step.
    apart = np.diagonal(moved[:dim] - moved[dim:]) / widths
    observations = simulate(moved)
    changes = (observations[:dim] - observations[dim:]) / scale
    # A simulation that failed has no slope.
    changes = np.nan_to_num(changes, nan=0.0, posinf=0.0, neginf=0.0)
    return of_jacobian((changes.reshape(dim, -1) / apart[:, None]).T)  # (1)


def of_jacobian(jacobian: Array) -> Spectrum:
    """The spectrum of the information J^T J of a Jacobian (N, dim) of observations over their
    noise.

    From the singular values of J, which keeps the small eigenvalues that rounding in J^T J would
    drown.
    """
    dim = jacobian.shape[1]
    # J = Q R, and the orthogonal Q changes no singular value: the long side need not be decomposed.
    _, sizes, rows = np.linalg.svd(np.linalg.qr(jacobian, mode="r"))
    values, vectors = np.zeros(dim), rows.T
    values[: sizes.size] = sizes**2  # (2); with fewer samples than parameters the others are 0
    # Either sign of an eigenvector is one; the same data must always give the same.
    places = np.abs(vectors).argmax(axis=0)[None]
    largest = np.take_along_axis(vectors, places, axis=0)
    return Spectrum(values, vectors * np.where(largest < 0, -1.0, 1.0))
