"""Find the order of joints that a model prefers if a log names no joints.

With the measured positions smoothed by a Savitzky-Golay filter, inverse dynamics give the force
f_j(t) that each joint needs, and the model's actuators give the force a_j(t) that they exert under
the recorded commands. An order of the columns is rated by

    R = sqrt(sum_j mean((f_j - a_j)^2) / sum_j mean(a_j^2))                                      (1)

which is small if the order is right, and about 1 otherwise.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np

from sims.core.simulator import Array
from sims.robot.dynamics.inverse_dynamics import motion_forces
from sims.robot.mujoco_messages import capture_mujoco_warnings
from sims.robot.robot_model import Actuator, Joint, RobotModel

ALL_ORDERS = 4
"""Maximum number of joints for which every order is tested."""
SMOOTHING_WINDOW = 11
"""Length of the smoothing window in samples."""
SMOOTHING_DEGREE = 3
"""Degree of the smoothing polynomial."""
MAX_INSTANTS = 150
"""Maximum number of times at which forces are compared."""
MAX_PREFERRED_RATIO = 0.5
"""Maximum ratio of R in (1) for the preferred order to R for the model's order."""
MAX_UNEXPLAINED = 0.7
"""Maximum R in (1) for the preferred order; a model that explains little prefers no order."""


class PreferredOrder(NamedTuple):
    """The order that a model prefers.

    Attributes:
        order: For each joint the index of its column.
        residual: R of equation (1) for this order.
        model_order_residual: R of equation (1) for the model's own order.
    """

    order: tuple[int, ...]
    residual: float
    model_order_residual: float

    def is_certain(self) -> bool:
        """Return whether the order explains much, and far more than the model's own order."""
        return self.residual < min(MAX_UNEXPLAINED, MAX_PREFERRED_RATIO * self.model_order_residual)


def find_order_by_model(
    robot: RobotModel,
    driven: Sequence[tuple[Joint, Actuator]],
    times: Array,
    commands: Sequence[Array],
    positions: Sequence[Array],
) -> PreferredOrder | None:
    """Find the order of columns with which a model explains a motion best.

    Args:
        robot: The model.
        driven: Joints with their actuators, in the model's order.
        times: (T,) seconds.
        commands: (T,) command of each actuator, SI units.
        positions: (T,) position of each joint, SI units.

    Returns:
        The best order; None if the motion is too short or there are fewer than two joints.
    """
    is_usable = np.isfinite(commands).all(axis=0) & np.isfinite(positions).all(axis=0)
    is_usable &= np.diff(times, prepend=-np.inf) > 0
    if is_usable.sum() < 4 * SMOOTHING_WINDOW or len(driven) < 2:
        return None
    # SciPy's signal module is slow to import.
    from scipy.signal import savgol_filter

    t, u, q = times[is_usable], np.array(commands)[:, is_usable], np.array(positions)[:, is_usable]
    step = float(np.median(np.diff(t)))
    derivatives = [
        savgol_filter(q, SMOOTHING_WINDOW, SMOOTHING_DEGREE, deriv=k, delta=step, axis=1)
        for k in range(3)
    ]
    motion = np.stack(derivatives)
    window_centres = np.linspace(
        SMOOTHING_WINDOW,
        t.size - SMOOTHING_WINDOW - 1,
        min(MAX_INSTANTS, t.size - 2 * SMOOTHING_WINDOW),
    )
    rows = np.unique(window_centres.astype(np.intp))
    residuals = {
        order: _compute_order_residual(
            robot, driven, u[list(order)][:, rows], motion[:, list(order)][:, :, rows]
        )
        for order in _iterate_orders([joint.name for joint, _ in driven])
    }
    best = min(residuals, key=lambda order: residuals[order])
    return PreferredOrder(best, residuals[best], residuals[tuple(range(len(driven)))])


def _iterate_orders(names: Sequence[str]) -> Iterator[tuple[int, ...]]:
    """Yield the orders of the columns that are tested, each as the column index of every joint.

    For few joints they are all permutations; otherwise the stated, the alphabetical and the
    reversed order, each also with two joints exchanged.
    """
    count = len(names)
    if count <= ALL_ORDERS:
        yield from permutations(range(count))
        return
    by_name = sorted(range(count), key=lambda place: names[place])
    as_stated = list(range(count))
    # The column of joint j is at the index of its name in the sorted list.
    alphabetical = [by_name.index(j) for j in range(count)]
    for order in (as_stated, alphabetical, as_stated[::-1]):
        yield tuple(order)
        for first, second in combinations(range(count), 2):
            exchanged_order = list(order)
            exchanged_order[first], exchanged_order[second] = (
                exchanged_order[second],
                exchanged_order[first],
            )
            yield tuple(exchanged_order)


def _compute_order_residual(
    robot: RobotModel, driven: Sequence[tuple[Joint, Actuator]], commands: Array, motion: Array
) -> float:
    """Compute the RMS force that actuators do not explain, relative to their forces (1).

    It is infinite if joints would be far beyond their ranges.

    Args:
        robot: The model.
        driven: Joints with their actuators.
        commands: (J, T) their commands.
        motion: (3, J, T) their positions, velocities and accelerations.
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
    with capture_mujoco_warnings():
        forces = motion_forces(model, joints, np.swapaxes(motion, 1, 2), controls)
    missing = float(np.sum((forces.needed - forces.driven) ** 2))
    total_square = float(np.sum(forces.driven**2))
    return float(np.sqrt(missing / total_square)) if total_square > 0 else np.inf
