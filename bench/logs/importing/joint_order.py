"""Find the joint of each column of a log without joint names.

Joints with position servos follow their commands, so a position belongs to the joint whose command
it is closest to. With the commands u_i and the positions q_j of a run, both in SI units, the order
of the columns is the permutation p that minimises the root mean square distance

    d(p) = sqrt(sum_i mean((u_i - q_p(i))^2))                                                    (1)

(linear assignment; H. W. Kuhn, Naval Research Logistics 2, 83, 1955).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sims.core.simulator import Array

MAX_DISTANCE_RATIO = 0.5
"""Maximum ratio of distances (1), another order over the present one, for changing the order."""
MIN_SAMPLES = 20
"""Minimum number of samples for determining an order."""


def order_of_commands(commands: Sequence[Array], positions: Sequence[Array]) -> list[int] | None:
    """Find the order of positions that follows commands best.

    Args:
        commands: (T,) command of each joint, SI units.
        positions: (T,) position of each joint at the same times, SI units.

    Returns:
        For each command the index of the position that follows it; None if the present order
            follows about as well, or the motion is not informative.
    """
    distances = _compute_square_distances(commands, positions)
    if distances is None:
        return None
    order = find_best_order(distances)
    moved_places = [i for i, place in enumerate(order) if place != i]
    if not moved_places:
        return None
    unchanged_distance = float(np.sqrt(distances[moved_places, moved_places].sum()))
    reordered_distance = float(
        np.sqrt(distances[moved_places, [order[i] for i in moved_places]].sum())
    )
    return order if reordered_distance < MAX_DISTANCE_RATIO * unchanged_distance else None


def follow(commands: Sequence[Array], positions: Sequence[Array]) -> bool:
    """Return whether each position is closer to its own command than to any other one.

    Args:
        commands: (T,) command of each joint, SI units.
        positions: (T,) position of each joint at the same times, SI units.
    """
    distances = _compute_square_distances(commands, positions)
    if distances is None:
        return False
    return bool((np.argmin(distances, axis=1) == np.arange(len(distances))).all())


def find_best_order(distances: Array) -> list[int]:
    """Return the order of columns with the smallest sum of mean square distances (1).

    It is found by linear assignment.

    Args:
        distances: (J, J) mean square distance of each command (rows) from each position (columns).
    """
    # SciPy's optimisers are slow to import.
    from scipy.optimize import linear_sum_assignment

    _, assigned = linear_sum_assignment(distances)
    order: list[int] = assigned.tolist()
    return order


def _compute_square_distances(
    commands: Sequence[Array], positions: Sequence[Array]
) -> Array | None:
    """Return the (J, J) mean square distance of each command from each position.

    Returns None if the motion is too short, or of one joint only.
    """
    u, q = np.array(commands), np.array(positions)
    finite = np.isfinite(u).all(axis=0) & np.isfinite(q).all(axis=0)
    if finite.sum() < MIN_SAMPLES or len(u) < 2:
        return None
    squares: Array = np.mean((u[:, None, finite] - q[None][:, :, finite]) ** 2, axis=2)
    return squares
