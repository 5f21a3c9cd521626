"""Sizes of hidden causes: RMS residuals, the part that initial states explain, and the strength.

All generators of cases use these functions with their own simulations.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import block_diag

from sims.core.simulator import Array

MAX_STRENGTH_FACTOR = 8.0  # maximum factor of the strength per step, so that a fit can follow
MIN_SINGULAR_VALUE = 1e-6
"""Singular value, relative to the largest one, below which columns are dependent."""
FIRST_STRENGTH = 1e-3
"""Strength that is tried first."""
SIZE_TOLERANCE = 0.03
"""Relative deviation from the requested size that is accepted."""
BRACKET_MARGIN = 0.05
"""Smallest distance of a trial from the ends of a bracket, as a share of its logarithmic width."""


def compute_orthonormal_basis(columns: Array) -> Array:
    """Compute an orthonormal basis of the span of columns by singular value decomposition.

    Directions with a singular value below 1e-6 of the largest are left out, because they come from
    columns that are nearly dependent.

    Args:
        columns: P columns of N numbers, (N, P).

    Returns:
        Basis of K <= P orthonormal columns, (N, K).
    """
    # Columns of length 1, so that their units do not decide which ones are nearly dependent.
    scale = np.sqrt(np.square(columns).sum(axis=0))
    left_vectors, singular_values, _ = np.linalg.svd(
        columns / np.where(scale > 0, scale, 1.0), full_matrices=False
    )
    basis: Array = left_vectors[:, singular_values > MIN_SINGULAR_VALUE * singular_values[0]]
    return basis


def arrange_slopes(slopes: Array, shared_count: int) -> Array:
    """Arrange the slopes of all runs as the columns of one Jacobian (R N, P + R S).

    Shapes: R runs, N samples, P shared unknowns, S unknowns of each run.

    Args:
        slopes: derivatives of each run's samples, (R, P + S, N); those of the shared unknowns, such
            as parameters, come first, those of the run's own unknowns, such as initial states,
            last.
        shared_count: number of shared unknowns, P.

    Returns:
        Jacobian with the samples of all runs in rows. The P shared unknowns are the first columns;
        S columns of each run follow, which are zero in the rows of the other runs.
    """
    columns = slopes.swapaxes(1, 2)  # (R, N, P + S)
    # The own unknowns of a run do not change the other runs.
    own_columns: Array = block_diag(*columns[:, :, shared_count:])
    return np.hstack([np.concatenate(columns[:, :, :shared_count]), own_columns])


def find_strength_for_size(
    compute_size: Callable[[float], float],
    target_size: float,
    largest: float,
    first: float = FIRST_STRENGTH,
    max_exponent: float = 2.0,
    tolerance: float = SIZE_TOLERANCE,
) -> tuple[float, float] | None:
    """Find the strength at which the size of a cause has the requested value.

    The strength scales the coefficients of a cause; the size is the residual that the cause leaves
    in a fit without it, in units of the noise. The method is the secant method on logarithmic
    scales, within a bracket as soon as there is one, with at most twelve trials.

    Args:
        compute_size: size as a function of the strength, increasing from zero.
        target_size: requested size.
        largest: maximum strength.
        first: first strength to try.
        max_exponent: power of the strength faster than which the size does not grow; infinite if
            nothing is known. It ends the search early if the requested size cannot be reached.
        tolerance: relative tolerance of the size.

    Returns:
        The strength and the size there; None if no strength up to `largest` is found.
    """
    # Bracket: (strength, size) below and above the requested size.
    low, high, strength = (0.0, 0.0), (np.inf, np.inf), first
    for _ in range(12):
        size = compute_size(strength)
        if abs(size / target_size - 1) < tolerance:
            return strength, size
        if size < target_size:
            # At the largest strength the size would be too small even if it grew fastest.
            if strength >= largest or size * (largest / strength) ** max_exponent < target_size:
                return None
            low = strength, size
        else:  # also if it is NaN or infinite
            high = strength, size
        strength = float(min(_choose_next_strength(low, high, target_size), largest))
    return None


def _choose_next_strength(
    low: tuple[float, float], high: tuple[float, float], target_size: float
) -> float:
    """Return the next strength to try, from the nearest trials below and above the requested size.

    * Only a trial above: the size is assumed to be proportional to the strength; a fifth of the
      strength if the size is not finite.
    * Only a trial below: the same, but the strength grows by at most `MAX_STRENGTH_FACTOR`.
    * Both: interpolation on logarithmic scales, or the middle on a logarithmic scale if the
      strengths differ much or the upper size is not finite.

    Args:
        low: strength and size below the requested size; strength 0 if there is none.
        high: strength and size above it; infinite strength if there is none.
        target_size: requested size.
    """
    (low_strength, low_size), (high_strength, high_size) = low, high
    if not low_strength:
        if not np.isfinite(high_size):
            return high_strength / 5
        # From 1 % to 90 % of the upper strength.
        return high_strength * min(max(target_size / high_size, 1e-2), 0.9)
    if not np.isfinite(high_strength):
        return low_strength * min(target_size / max(low_size, 1e-9), MAX_STRENGTH_FACTOR)
    if not np.isfinite(high_size) or high_strength / low_strength > MAX_STRENGTH_FACTOR**2:
        return float(np.sqrt(low_strength * high_strength))
    # Relative position of the requested size between both sizes, on a logarithmic scale.
    log_position = float(np.log(target_size / low_size) / np.log(high_size / low_size))
    limited_position = min(max(log_position, BRACKET_MARGIN), 1.0 - BRACKET_MARGIN)
    return float(low_strength * (high_strength / low_strength) ** limited_position)
