"""Make the recording of examples/rover again: `python -m tests.example_logs.rover FOLDER`.

The "real" rover is a differential drive whose wheels roll without slip. SciPy integrates its
equations of motion (R. Siegwart et al., Autonomous Mobile Robots, 2011, chapter 3); MuJoCo is not
used. The bearing of the left wheel drags six times as much as in the model `rover.xml`. The log has
the commands, the wheel angles, and the pose of the chassis from motion capture.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]

RATE, SECONDS = 100, 3
"""Sampling rate of commands and poses in Hz, and length of a run in s."""
RUNS = range(1, 5)
"""Numbers of the runs."""
NOISE = np.array([3e-4] * 3 + [5e-4] * 4 + [5e-4] * 2)
"""Standard deviations of the noise: positions (m), quaternions, and wheel angles (rad)."""
DAMPING = np.array([0.012, 0.002])
"""Damping of the left and the right axle in N m s/rad; the left one is the hidden cause."""
RADIUS, TRACK, GAIN = 0.05, 0.2, 0.05
"""Radius and distance of the wheels (m), and gain of their drives (N m s/rad)."""
MASS, OFFSET, WHEEL_INERTIA = 2.3, 2.0 * 0.03 / 2.3, 1.9e-4
"""Mass (kg), distance of its centre from the axle (m), and spin inertia of a wheel (kg m^2)."""
YAW_INERTIA = 0.015 + 2.0 * 0.03**2 + 2.0 * (1.2e-4 + 0.15 * 0.1**2)
"""Moment of inertia about the vertical through the middle of the axle, kg m^2."""
ROLLING = np.array([[1.0, -TRACK / 2], [1.0, TRACK / 2]]) / RADIUS
"""Speeds of both wheels by the forward speed and the yaw rate."""
INERTIA = np.diag([MASS, YAW_INERTIA]) + WHEEL_INERTIA * ROLLING.T @ ROLLING
"""Inertia matrix by forward speed and yaw rate."""


def compute_rates(_: float, state: Array, command: Array) -> Array:
    """Compute the rates of x, y, yaw, wheel angles, forward speed and yaw rate.

    Args:
        state: (7,) state.
        command: (2,) commanded speeds of the wheels, rad/s.
    """
    yaw, speed, turn = state[2], state[5], state[6]
    spins = ROLLING @ state[5:]
    torques = GAIN * (command - spins) - DAMPING * spins
    coriolis = MASS * OFFSET * turn * np.array([turn, -speed])
    accelerations = np.linalg.solve(INERTIA, ROLLING.T @ torques + coriolis)
    return np.concatenate([[speed * np.cos(yaw), speed * np.sin(yaw), turn], spins, accelerations])


def drive(run: int) -> tuple[Array, Array, Array]:
    """Return times (T,), commands (T, 2), and poses with wheel angles (T, 9) of a run."""
    rng = np.random.default_rng(run)
    times = np.arange(SECONDS * RATE + 1) / RATE
    frequencies = 2.0 * np.pi * rng.uniform((0.2, 0.5), (0.5, 1.2), (2, 2))
    phases = rng.uniform(0.0, 2.0 * np.pi, (2, 2, 1))
    waves = np.sin(frequencies[..., None] * times + phases) * np.array([5.0, 2.5])[:, None]
    commands = np.round(4.0 + waves.sum(axis=1).T, 4)
    state, rows = np.zeros(7), []
    for command in commands:
        x, y, z, w = Rotation.from_euler("ZYX", [state[2], 0.0, 0.0]).as_quat()
        rows.append([*state[:2], RADIUS, w, x, y, z, *state[3:5]])
        solution = solve_ivp(
            compute_rates, (0.0, 1.0 / RATE), state, args=(command,), rtol=1e-10, atol=1e-12
        )
        state = solution.y[:, -1]
    return times, commands, np.array(rows)


def write_log(folder: Path) -> Path:
    """Write log.csv into a folder, and return its path."""
    pose = [f"q.base.{c}" for c in ("x", "y", "z", "qw", "qx", "qy", "qz")]
    names = ["run", "t", "u.drive_left", "u.drive_right", *pose, "q.left", "q.right"]
    lines = [",".join(names)]
    for run in RUNS:
        times, commands, readings = drive(run)
        readings += NOISE * np.random.default_rng(100 + run).standard_normal(readings.shape)
        for t, command, row in zip(times, commands, readings, strict=True):
            values = [*(f"{u:.4f}" for u in command), *(f"{value:.5f}" for value in row)]
            lines.append(",".join([str(run), f"{t:.2f}", *values]))
    path = folder / "log.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


if __name__ == "__main__":
    write_log(Path(sys.argv[1]))
