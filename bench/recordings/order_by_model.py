"""Which order of joints the model prefers, where a log names none: that in which the forces of the
drives explain the motion best.

With the measured positions smoothed by a Savitzky-Golay filter, inverse dynamics give the force
f_j(t) that each joint needs, and the model's actuators give the force a_j(t) that they exert with
the recorded commands. An order of the columns is worth

    R = sqrt(sum_j mean((f_j - a_j)^2) / sum_j mean(a_j^2))                                      (1)

which is small where the order is right, and of the size of 1 where it is not.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np

from sims.base import Array
from sims.robot.inverse_dynamics import motion_forces
from sims.robot.model import Actuator, Joint, Robot
from sims.robot.quiet import quiet

ALL_ORDERS = 4
"""Maximum number of joints of which every order is tried."""
WINDOW = 11
"""Samples of the smoothing window."""
DEGREE = 3
"""Degree of the smoothing polynomial."""
INSTANTS = 150
"""Maximum number of instants at which forces are compared."""
PREFERRED = 0.5
"""Maximum of (1) for the preferred order over (1) for the model's order."""
EXPLAINED = 0.7
"""Maximum of (1) for the preferred order: a model that explains little prefers nothing."""


class PreferredOrder(NamedTuple):
    """The order that a model prefers.

    Attributes:
        order: for each joint the place of its column.
        residual: (1) for this order.
        usual: (1) for the model's own order.
    """

    order: tuple[int, ...]
    residual: float
    usual: float

    def is_certain(self) -> bool:
        """Return whether the order explains much, and far more than the model's own order."""
        return self.residual < min(EXPLAINED, PREFERRED * self.usual)


def preferred_order(
    robot: Robot,
    driven: Sequence[tuple[Joint, Actuator]],
    times: Array,
    commands: Sequence[Array],
    positions: Sequence[Array],
) -> PreferredOrder | None:
    """Find the order of columns with which a model explains a motion best.

    Args:
        robot: the model.
        driven: joints with their actuators, in the model's order.
        times: (T,) seconds.
        commands: (T,) of each actuator, SI units.
        positions: (T,) of each joint, SI units.

    Returns:
        The order; None where the motion is too short, or the model explains little of it.
    """
    known = np.isfinite(commands).all(axis=0) & np.isfinite(positions).all(axis=0)
    known &= np.diff(times, prepend=-np.inf) > 0
    if known.sum() < 4 * WINDOW or len(driven) < 2:
        return None
    # SciPy's signal module is slow to import.
    from scipy.signal import savgol_filter

    t, u, q = times[known], np.array(commands)[:, known], np.array(positions)[:, known]
    step = float(np.median(np.diff(t)))
    derivatives = [savgol_filter(q, WINDOW, DEGREE, deriv=k, delta=step, axis=1) for k in range(3)]
    motion = np.stack(derivatives)
    inside = np.linspace(WINDOW, t.size - WINDOW - 1, min(INSTANTS, t.size - 2 * WINDOW))
    rows = np.unique(inside.astype(np.intp))
    residuals = {
        order: _residual(robot, driven, u[list(order)][:, rows], motion[:, list(order)][:, :, rows])
        for order in _orders([joint.name for joint, _ in driven])
    }
    best = min(residuals, key=lambda order: residuals[order])
    return PreferredOrder(best, residuals[best], residuals[tuple(range(len(driven)))])


def _orders(names: Sequence[str]) -> Iterator[tuple[int, ...]]:
    """The orders that are tried: all of few joints, else the usual ones with two exchanged."""
    count = len(names)
    if count <= ALL_ORDERS:
        yield from permutations(range(count))
        return
    by_name = sorted(range(count), key=lambda place: names[place])
    as_stated = list(range(count))
    # The column of joint j stands where its name does in the sorted list.
    alphabetical = [by_name.index(j) for j in range(count)]
    for order in (as_stated, alphabetical, as_stated[::-1]):
        yield tuple(order)
        for one, other in combinations(range(count), 2):
            own = list(order)
            own[one], own[other] = own[other], own[one]
            yield tuple(own)


def _residual(
    robot: Robot, driven: Sequence[tuple[Joint, Actuator]], commands: Array, motion: Array
) -> float:
    """(1) of an order; infinite where it takes joints far beyond their ranges.

    Args:
        robot: the model.
        driven: joints with their actuators.
        commands: (J, T) of them.
        motion: (3, J, T) positions, velocities and accelerations of them.
    """
    import mujoco

    for (joint, _), q in zip(driven, motion[0], strict=True):
        if joint.range is not None:
            slack = 0.5 * (joint.range[1] - joint.range[0])
            if q.min() < joint.range[0] - slack or q.max() > joint.range[1] + slack:
                return np.inf
    model = copy.copy(robot.compiled)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    controls = np.zeros((commands.shape[1], model.nu))
    controls[:, [actuator.control for _, actuator in driven]] = commands.T
    joints = [joint for joint, _ in driven]
    with quiet():
        forces = motion_forces(model, joints, np.swapaxes(motion, 1, 2), controls)
    missing = float(np.sum((forces.needed - forces.driven) ** 2))
    acting = float(np.sum(forces.driven**2))
    return float(np.sqrt(missing / acting)) if acting > 0 else np.inf
