"""Which column is of which joint where a log does not say it: servos' joints follow their commands,
so a position is that of the joint whose command it stays closest to.

With the commands u_i and the positions q_j of a run, both in SI units, the order of the columns is
the permutation p that makes the root mean square distance

    d(p) = sqrt(sum_i mean((u_i - q_p(i))^2))                                                    (1)

least (H. W. Kuhn, Naval Research Logistics 2, 83, 1955).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sims.base import Array

MAX_DISTANCE_RATIO = 0.5
"""Maximum of (1) for another order over (1) for the order as it is, at which the other is taken."""
MIN_SAMPLES = 20
"""Minimum number of samples from which an order is told."""


def order_of_commands(commands: Sequence[Array], positions: Sequence[Array]) -> list[int] | None:
    """Find the order of positions that follows commands best.

    Args:
        commands: (T,) of each joint, SI units.
        positions: (T,) of each joint at the same instants, SI units.

    Returns:
        For each command the place of the position that follows it; None where the order as it is
        follows about as well, or the motion tells nothing.
    """
    distances = _distances(commands, positions)
    if distances is None:
        return None
    order = least_order(distances)
    moved = [i for i, place in enumerate(order) if place != i]
    if not moved:
        return None
    stays = float(np.sqrt(distances[moved, moved].sum()))
    moves = float(np.sqrt(distances[moved, [order[i] for i in moved]].sum()))
    return order if moves < MAX_DISTANCE_RATIO * stays else None


def follow(commands: Sequence[Array], positions: Sequence[Array]) -> bool:
    """Return whether each position is closer to its own command than to any other one."""
    distances = _distances(commands, positions)
    if distances is None:
        return False
    return bool((np.argmin(distances, axis=1) == np.arange(len(distances))).all())


def least_order(distances: Array) -> list[int]:
    """Return the order that makes (1) least, by linear assignment.

    Args:
        distances: (J, J) mean square distance of each command (rows) from each position (columns).
    """
    # SciPy's optimisers are slow to import.
    from scipy.optimize import linear_sum_assignment

    _, places = linear_sum_assignment(distances)
    order: list[int] = places.tolist()
    return order


def _distances(commands: Sequence[Array], positions: Sequence[Array]) -> Array | None:
    """Return the mean square distance (J, J) of each command from each position; None where the
    motion is too short, or of one joint.
    """
    u, q = np.array(commands), np.array(positions)
    finite = np.isfinite(u).all(axis=0) & np.isfinite(q).all(axis=0)
    if finite.sum() < MIN_SAMPLES or len(u) < 2:
        return None
    squares: Array = np.mean((u[:, None, finite] - q[None][:, :, finite]) ** 2, axis=2)
    return squares
