"""Estimate natural frequency and damping of a servo from its command and position.

The result is a first guess of unknown gains. A joint whose drive pulls it towards the command u by
a spring and a damper moves as

    q'' = w^2 (u - q) - 2 d w q'                                                                 (1)

with the natural frequency w and the damping ratio d. Commands are held over a sample, so (1) is
integrated exactly from sample to sample (C. Van Loan, IEEE Trans. Autom. Control 23(3), 395, 1978);
w and d are the grid values with the smallest residual of the position after removal of an offset.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from sims.core.simulator import Array
from sims.robot.robot_model import Joint

FREQUENCY_GRID = np.geomspace(2.0, 200.0, 33)
"""Grid of natural frequencies in rad/s."""
DAMPING_GRID = np.geomspace(0.3, 6.0, 14)
MIN_EXPLAINED_VARIANCE = 0.8
"""Minimum share of a position's variance that (1) must explain."""
MAX_SAMPLES = 4000
"""Maximum number of samples per run that are used."""
MIN_SAMPLES = 20
"""Minimum number of samples of a run."""


class ServoResponse(NamedTuple):
    """Natural frequency in rad/s, and damping ratio."""

    frequency: float
    damping: float


DEFAULT_RESPONSE = ServoResponse(20.0, 0.7)
"""Natural frequency in rad/s and damping ratio of a servo whose gains are unknown."""
MIN_MOTION = {"rad": 0.02, "m": 0.002}
"""Smallest motion of a joint, by its unit, that shows something about the gains of its servo."""


class AddedServo(NamedTuple):
    """Position servo that is missing in the model file.

    Attributes:
        name: Name that it gets.
        joint: Joint that it drives.
        response: Natural frequency and damping ratio from which the gains follow.
        kp: Stiffness, N·m/rad.
        kv: Damping, N·m·s/rad.
        is_measured: Whether the response was estimated from the log, and is not the default.
        is_free: Whether its gains are fitted, because the log moves the joint.
    """

    name: str
    joint: Joint
    response: ServoResponse
    kp: float
    kv: float
    is_measured: bool
    is_free: bool


def estimate_added_servo(
    name: str, joint: Joint, inertia: float, runs: Sequence[tuple[Array, Array, Array]]
) -> AddedServo:
    """Estimate the gains kp and kv of a servo that is missing in the model file.

    They follow from frequency and damping of its response and from the inertia of the joint.
    Without motion, the gains of a usual servo are taken.

    Args:
        name: Name that the servo gets.
        joint: Joint that it drives.
        inertia: Inertia about the joint, kg m^2 or kg.
        runs: Times, commands and positions of each run, as in `estimate_servo_response`.
    """
    estimate = estimate_servo_response(runs)
    response = estimate or DEFAULT_RESPONSE
    frequency, damping = response
    kp, kv = inertia * frequency**2, 2.0 * damping * frequency * inertia
    is_moved = estimate is not None or any(
        np.ptp(u) > 0 and np.ptp(q[np.isfinite(q)]) > MIN_MOTION[joint.unit]
        for _, u, q in runs
        if np.isfinite(q).any()
    )
    return AddedServo(name, joint, response, kp, kv, estimate is not None, is_moved)


def estimate_servo_response(runs: Sequence[tuple[Array, Array, Array]]) -> ServoResponse | None:
    """Estimate how a position follows its command.

    Args:
        runs: For each run (T,) times in s, about uniform, (T,) commands, each held to the next
            sample, and (T,) positions in the same unit.

    Returns:
        Frequency and damping; None if the position hardly moves or does not follow.
    """
    present_samples = [_select_present_samples(*run) for run in runs]
    moving = [
        (t, u, q)
        for t, u, q in present_samples
        if t.size >= MIN_SAMPLES and np.std(u) > 0 and np.std(q) > 0
    ]
    if not moving:
        return None
    # Import SciPy's signal module only here, since it is large.
    from scipy.signal import cont2discrete, lfilter

    step = float(np.median([np.median(np.diff(t)) for t, _, _ in moving]))
    total_variation = sum(float(np.var(q)) * q.size for _, _, q in moving)
    best, smallest_residual = None, (1.0 - MIN_EXPLAINED_VARIANCE) * total_variation
    for frequency, damping in product(FREQUENCY_GRID.tolist(), DAMPING_GRID.tolist()):
        system = [frequency**2], [1.0, 2.0 * damping * frequency, frequency**2]
        numerator, denominator, _ = cont2discrete(system, step)
        residual = 0.0
        for _, u, q in moving:
            residual += (
                float(np.var(q - lfilter(np.ravel(numerator), denominator, u - u[0]))) * q.size
            )
        if residual < smallest_residual:
            best, smallest_residual = ServoResponse(frequency, damping), residual
    return best


def _select_present_samples(
    times: Array, command: Array, position: Array
) -> tuple[Array, Array, Array]:
    """Return the samples that are not missing, at most the first `MAX_SAMPLES`."""
    is_recorded = np.isfinite(position) & np.isfinite(command)
    return (
        times[is_recorded][:MAX_SAMPLES],
        command[is_recorded][:MAX_SAMPLES],
        position[is_recorded][:MAX_SAMPLES],
    )
