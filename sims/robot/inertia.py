"""Principal moments of inertia that a body can have."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sims.base import Array

LEAST = 1e-9
"""kg m^2: what is taken for moments that are not positive; those of a gram on a millimetre."""
NONE = 1e-14
"""kg m^2 that are as good as zero; MuJoCo's limit is 1e-15."""
ROUNDING = 1e-9
"""Part of a moment by which sums are kept on the right side."""


def lack(moments: Array) -> float:
    """By how much the largest moment exceeds the sum of the two others, kg m^2."""
    return float(2 * np.max(moments) - np.sum(moments))


def nearest(moments: Array) -> Array:
    """The moments nearest to these, in kg m^2, that a body can have: positive, and A + B >= C."""
    raised: Array = np.maximum(moments, np.where(moments < NONE, LEAST, 0.0))
    third = (lack(raised) + ROUNDING * np.max(raised)) / 3
    if third <= ROUNDING * np.max(raised) / 3:
        return raised
    return np.where(raised == np.max(raised), raised - third, raised + third)


def principal(full: Sequence[float]) -> tuple[Array, Array]:
    """Moments (3) and axes (3, 3), as columns, of a tensor: xx, yy, zz, xy, xz, yz in kg m^2."""
    xx, yy, zz, xy, xz, yz = full
    moments, axes = np.linalg.eigh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    return moments, axes


def tensor(moments: Array, axes: Array) -> list[float]:
    """The tensor of these moments about these axes, in the order that `principal` takes."""
    full = axes @ np.diag(moments) @ axes.T
    return [float(full[at]) for at in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]


def shown(before: Array, after: Array) -> str:
    """Moments before and after, kg m^2, as a note shows them."""
    rows = (", ".join(f"{moment:.4g}" for moment in sorted(row)) for row in (before, after))
    return " -> ".join(rows)
