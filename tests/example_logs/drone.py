"""Make the recording of examples/drone again: `python -m tests.example_logs.drone FOLDER`.

The "real" quadrotor is a rigid body, whose Newton-Euler equations SciPy integrates; MuJoCo is not
used. A controller flies it along slow waves. Rotor 3 gives a tenth less thrust than commanded,
which the model `quadrotor.xml` does not know. The log has the commands, and the pose as a motion
capture system measures it.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]

RATE = 100
"""Sampling rate of commands and poses in Hz; a command is held until the next."""
SECONDS = 3
"""Length of a run, s."""
RUNS = range(1, 5)
"""Numbers of the runs."""
POSITION_NOISE, QUATERNION_NOISE = 3e-4, 5e-4
"""Standard deviations of the noise of positions (m) and of the entries of quaternions."""
MASS, GRAVITY = 0.027, 9.81
"""Mass in kg, and acceleration of gravity in m/s^2."""
INERTIA = np.array([1.4e-5, 1.4e-5, 2.2e-5])
"""Moments of inertia about the axes of the body, kg m^2."""
ARM, TORQUE_RATIO = 0.033, 0.006
"""Distance of the rotors from both axes, and torque of a rotor by its thrust, m."""
MAX_THRUST = 0.15
"""Largest command of a rotor, N."""
EFFICIENCY = np.array([1.0, 1.0, 0.9, 1.0])
"""Hidden cause: thrust of each rotor as a share of its command."""
MIXER = np.array([1.0, ARM, ARM, TORQUE_RATIO])[:, None] * np.array(
    [[1, 1, 1, 1], [1, 1, -1, -1], [-1, 1, 1, -1], [1, -1, 1, -1]]
)
"""Thrust, and torques about the axes of the body, by the thrusts of the rotors."""


def compute_rates(_: float, state: Array, thrusts: Array) -> Array:
    """Compute the rates of position, quaternion (x, y, z, w), velocity and angular velocity.

    Args:
        state: (13,) state; the angular velocity is along the axes of the body, in rad/s.
        thrusts: (4,) thrusts of the rotors, N.
    """
    quaternion, velocity, spin = state[3:7], state[7:10], state[10:]
    force, *torques = MIXER @ thrusts
    lift = Rotation.from_quat(quaternion).apply([0.0, 0.0, force / MASS])
    x, y, z, w = quaternion
    p, q, r = spin
    turning = 0.5 * np.array(
        [
            w * p + y * r - z * q,
            w * q + z * p - x * r,
            w * r + x * q - y * p,
            -x * p - y * q - z * r,
        ]
    )
    angular = (np.array(torques) - np.cross(spin, INERTIA * spin)) / INERTIA
    return np.concatenate([velocity, turning, lift - [0.0, 0.0, GRAVITY], angular])


def compute_command(state: Array, target: Array) -> Array:
    """Compute the commands (4,) in N that a controller of position and yaw gives.

    Args:
        state: (13,) state.
        target: (4,) wanted position relative to the start, m, and yaw, rad.
    """
    yaw, pitch, roll = Rotation.from_quat(state[3:7]).as_euler("ZYX")
    wanted = 6.0 * (target[:3] - state[:3] + [0.0, 0.0, 1.0]) - 4.5 * state[7:10]
    ahead = wanted[0] * np.cos(yaw) + wanted[1] * np.sin(yaw)
    aside = wanted[0] * np.sin(yaw) - wanted[1] * np.cos(yaw)
    tilts = np.clip(np.array([aside, ahead]) / GRAVITY, -0.5, 0.5)
    errors = np.array([tilts[0] - roll, tilts[1] - pitch, target[3] - yaw])
    torques = INERTIA * (np.array([150.0, 150.0, 20.0]) * errors - [20.0, 20.0, 6.0] * state[10:])
    lift = MASS * (GRAVITY + wanted[2]) / (np.cos(pitch) * np.cos(roll))
    command = np.clip(np.linalg.solve(MIXER, [lift, *torques]), 0.0, MAX_THRUST)
    # The controller sends what the table states.
    return np.round(command, 6)


def fly(run: int) -> tuple[Array, Array, Array]:
    """Return times (T,), commands (T, 4) and true poses (T, 7) of a run."""
    rng = np.random.default_rng(run)
    times = np.arange(SECONDS * RATE + 1) / RATE
    frequencies = 2.0 * np.pi * rng.uniform((0.2, 0.5, 1.0), (0.5, 1.0, 2.0), (4, 3))
    waves = np.sin(frequencies[..., None] * times) * np.array([0.6, 0.3, 0.15])[:, None]
    targets = (np.array([0.5, 0.5, 0.3, 0.6])[:, None] * waves.sum(axis=1)).T
    state = np.zeros(13)
    state[[2, 6]] = 1.0
    commands, poses = [], []
    for target in targets:
        command = compute_command(state, target)
        commands.append(command)
        poses.append([*state[:3], state[6], *state[3:6]])
        thrusts = EFFICIENCY * command
        solution = solve_ivp(
            compute_rates, (0.0, 1.0 / RATE), state, args=(thrusts,), rtol=1e-10, atol=1e-12
        )
        state = solution.y[:, -1]
        state[3:7] /= np.linalg.norm(state[3:7])
    return times, np.array(commands), np.array(poses)


def write_log(folder: Path) -> Path:
    """Write log.csv into a folder, and return its path."""
    columns = ["x", "y", "z", "qw", "qx", "qy", "qz"]
    names = ["run", "t", *(f"u.m{i}" for i in (1, 2, 3, 4)), *(f"q.base.{c}" for c in columns)]
    noise = np.array([POSITION_NOISE] * 3 + [QUATERNION_NOISE] * 4)
    lines = [",".join(names)]
    for run in RUNS:
        times, commands, poses = fly(run)
        poses += noise * np.random.default_rng(100 + run).standard_normal(poses.shape)
        for t, command, pose in zip(times, commands, poses, strict=True):
            values = [*(f"{u:.6f}" for u in command), *(f"{value:.5f}" for value in pose)]
            lines.append(",".join([str(run), f"{t:.2f}", *values]))
    path = folder / "log.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


if __name__ == "__main__":
    write_log(Path(sys.argv[1]))
