"""Estimate natural frequency and damping of a servo from its command and position.

The result is a first guess of unknown gains. A joint whose drive pulls it towards the command u by
a spring and a damper moves as

    q'' = w^2 (u - q) - 2 d w q'                                                                 (1)

with the natural frequency w and the damping ratio d. Commands are held over a sample, so (1) is
integrated exactly from sample to sample (K. J. Astrom and B. Wittenmark, Computer-Controlled
Systems, 3rd edition, 1997, section 2.3); w and d are the grid values with the smallest residual of
the position after removal of an offset.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from bench.logs.importing.run_logs import RunLogs, hold_signal
from bench.logs.importing.signal_assignment import SignalAssignment
from sims.core.simulator import Array
from sims.robot.dynamics.joint_scales import compute_joint_scales
from sims.robot.robot_model import Joint

FREQUENCY_GRID = np.geomspace(2.0, 200.0, 33)
"""Grid of natural frequencies in rad/s."""
DAMPING_GRID = np.geomspace(0.3, 6.0, 14)
"""Grid of damping ratios; it does not contain 1, where both poles of (2) are equal."""
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


def estimate_added_servos(logs: RunLogs, signals: SignalAssignment) -> list[AddedServo]:
    """Estimate the gains of all servos that are missing in the model file.

    Args:
        logs: Files of the runs.
        signals: Columns that were assigned to channels and inputs, with the missing servos.
    """
    if not signals.added_servos:
        return []
    inertia = compute_joint_scales(signals.robot).inertia
    return [
        _estimate_gains(
            name,
            joint,
            float(inertia[signals.joints.index(joint)]),
            _collect_servo_samples(logs, signals, name, joint),
        )
        for name, joint in signals.added_servos.items()
    ]


def _collect_servo_samples(
    logs: RunLogs, signals: SignalAssignment, name: str, joint: Joint
) -> list[tuple[Array, Array, Array]]:
    """Collect times (s), commands and positions (T,) of a servo in each run, in rad or m.

    A command holds until the next one, since it has other sample times than the position. Runs
    without one of them are left out.

    Args:
        logs: files of the runs.
        signals: columns that were assigned to channels and inputs.
        name: name of the servo.
        joint: joint that it drives.

    Returns:
        One triple per run; none without a recorded position.
    """
    command = signals.inputs[f"u.{name}"]
    position = signals.get_position(joint.name)
    samples: list[tuple[Array, Array, Array]] = []
    if position is None:
        return samples
    for run in logs.runs:
        command_samples = logs.read(run, command.column)
        measured = logs.read(run, position.column)
        if command_samples is None or measured is None:
            continue
        times, values = measured
        held_command = hold_signal(*command_samples, times)
        samples.append(
            (
                times,
                command.convert(joint.unit, held_command),
                position.convert(joint.unit, values),
            )
        )
    return samples


def _estimate_gains(
    name: str, joint: Joint, inertia: float, runs: Sequence[tuple[Array, Array, Array]]
) -> AddedServo:
    """Estimate the gains kp and kv of a servo that is missing in the model file.

    They follow from the natural frequency w and the damping ratio d of its response and from the
    inertia I of the joint: kp = I w^2, kv = 2 d w I. If the log does not show the response, that of
    a typical servo is taken.

    Args:
        name: name that the servo gets.
        joint: joint that it drives.
        inertia: inertia about the joint, kg m^2, or kg for a slide joint.
        runs: for each run, times (T,) in s, commands (T,) and positions (T,), rad or m.
    """
    estimate = estimate_servo_response(runs)
    response = estimate or DEFAULT_RESPONSE
    frequency, damping = response
    kp, kv = inertia * frequency**2, 2.0 * damping * frequency * inertia
    # The log moves the joint if its response is known, or if the command changes and the position
    # changes by more than `MIN_MOTION`. The gains are then free, and fitted by the diagnosis.
    is_moved = estimate is not None or any(
        np.ptp(u) > 0 and np.ptp(q[np.isfinite(q)]) > MIN_MOTION[joint.unit]
        for _, u, q in runs
        if np.isfinite(q).any()
    )
    return AddedServo(name, joint, response, kp, kv, estimate is not None, is_moved)


def estimate_servo_response(runs: Sequence[tuple[Array, Array, Array]]) -> ServoResponse | None:
    """Estimate how a position follows its command: natural frequency and damping of the servo.

    The servo is modelled as q'' = w^2 (u - q) - 2 d w q' (1). For each pair (w, d) of a grid, the
    response to the commands is computed. The pair with the smallest residual is taken, if it
    explains most of the position's variance.

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
    from scipy.signal import lfilter

    step = float(np.median([np.median(np.diff(t)) for t, _, _ in moving]))
    responses = [ServoResponse(*pair) for pair in product(FREQUENCY_GRID, DAMPING_GRID)]
    numerators, denominators = _compute_transfer_functions(responses, step)
    # Sum of squares of the residual over all runs, by response. The variance ignores a constant
    # offset of the position.
    residuals = np.zeros(len(responses))
    for _, command, position in moving:
        for i in range(len(responses)):
            # The filter begins at zero, so the command is counted from its first value.
            response = lfilter(numerators[i], denominators[i], command - command[0])
            residuals[i] += float(np.var(position - response)) * position.size
    total_squares = sum(float(np.var(position)) * position.size for _, _, position in moving)
    best = int(np.argmin(residuals))
    is_following = residuals[best] < (1.0 - MIN_EXPLAINED_VARIANCE) * total_squares
    return responses[best] if is_following else None


def _compute_transfer_functions(
    responses: Sequence[ServoResponse], step: float
) -> tuple[Array, Array]:
    """Compute the response of servos from sample to sample, for commands that are held over a step.

    The servo is q'' = w^2 (u - q) - 2 d w q' (1), with the command u, natural frequency w and
    damping ratio d. With the poles p1, p2 = -w (d -+ sqrt(d^2 - 1)), which must differ, its
    response to a unit step is

        q(t) = 1 - (p2 exp(p1 t) - p1 exp(p2 t)) / (p2 - p1)                                     (2)

    Sampled, it is a filter of second order: a ratio of two polynomials in z, the shift by a step.
    Its poles are exp(p1 h) and exp(p2 h), with the sampling interval h.

    Args:
        responses: n pairs of natural frequency w in rad/s and damping ratio d.
        step: Sampling interval in s.

    Returns:
        (n, 3) coefficients of the numerators and of the denominators, by descending powers of z.
    """
    frequency, damping = np.array(responses).T
    # Below a damping ratio of 1 the poles are complex.
    root = np.emath.sqrt(damping**2 - 1.0)
    p1, p2 = -frequency * (damping - root), -frequency * (damping + root)
    z1, z2 = np.exp(p1 * step), np.exp(p2 * step)
    zeros, ones = np.zeros_like(frequency), np.ones_like(frequency)
    denominators = np.stack([ones, -(z1 + z2).real, (z1 * z2).real], axis=1)
    first = 1.0 - ((p2 * z1 - p1 * z2) / (p2 - p1)).real  # (2) after one step
    # Under a constant command the position reaches it (gain 1 at z = 1), so the coefficients of
    # both polynomials have the same sum.
    second = denominators.sum(axis=1) - first
    return np.stack([zeros, first, second], axis=1), denominators


def _select_present_samples(
    times: Array, command: Array, position: Array
) -> tuple[Array, Array, Array]:
    """Return the samples that are not missing, at most the first `MAX_SAMPLES`.

    Args:
        times: (T,) times in seconds.
        command: (T,) command, in rad or m; NaN where missing.
        position: (T,) position, in rad or m; NaN where missing.

    Returns:
        Times, command and position of the samples at which both signals are known.
    """
    is_recorded = np.isfinite(position) & np.isfinite(command)
    return (
        times[is_recorded][:MAX_SAMPLES],
        command[is_recorded][:MAX_SAMPLES],
        position[is_recorded][:MAX_SAMPLES],
    )
