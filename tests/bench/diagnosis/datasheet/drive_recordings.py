"""Simulated servo with a pendulum and dry friction, independent of the code under test."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.bench.diagnosis.simulated_logs import write_log

TRUE_PARAMETERS = {"torque_constant": 0.4, "resistance": 5.0, "armature": 0.002}
FRICTION = 0.06
"""Dry friction in N m."""
CONSTANTS = {
    "mass": 0.4,
    "length": 0.1,
    "gravity": 9.81,
    "voltage": 7.4,
    "error_gain": 0.003,
    "kp": 200.0,
}
NOISE = 0.004
"""Standard deviation of the sensor noise in rad."""
STEP = 1e-4
EVERY = 100
"""Number of integration steps per sample."""
SAMPLES = 300
HELD = 5000
"""Number of integration steps for which each command is held."""


def swings(rng: np.random.Generator) -> list[tuple[float, float, float]]:
    """Return (time, command, noisy angle) of one run from the equations of a DC motor."""
    k, c = TRUE_PARAMETERS, CONSTANTS
    inertia = k["armature"] + c["mass"] * c["length"] ** 2
    goals = rng.uniform(-1.5, 1.5, 1 + EVERY * SAMPLES // HELD)
    angle = rate = 0.0
    rows = []
    for step in range(EVERY * SAMPLES):
        goal = goals[step // HELD]
        if step % EVERY == 0:
            rows.append((step * STEP, goal, angle + rng.normal(0.0, NOISE)))
        duty = np.clip(c["kp"] * c["error_gain"] * (goal - angle), -1.0, 1.0)
        current = (duty * c["voltage"] - k["torque_constant"] * rate) / k["resistance"]
        weight = c["mass"] * c["gravity"] * c["length"] * np.sin(angle)
        pull = k["torque_constant"] * current - weight
        if rate == 0.0 and abs(pull) <= FRICTION:
            continue
        way = np.sign(rate) if rate else np.sign(pull)
        faster = rate + STEP * (pull - FRICTION * way) / inertia
        # Friction stops a motion but does not reverse it.
        rate = 0.0 if faster * rate < 0 else float(faster)
        angle += STEP * rate
    return rows


def written(folder: Path, runs: int = 3, seed: int = 0) -> Path:
    """Write a recording of the servo; return its path."""
    rng = np.random.default_rng(seed)
    constants = "".join(f"{name} = {value}\n" for name, value in CONSTANTS.items())
    description = (
        f'system = "servo"\ntitle = "a <b>servo</b>"\n[constants]\n{constants}'
        f'[channels.q]\nunit = "rad"\nnoise = {NOISE}\n'
        '[inputs.goal]\nunit = "rad"\n[inputs.torque_enable]\nunit = "1"\n'
    )
    columns = [np.array(swings(rng)).T for _ in range(runs)]
    rows = [(times, goals, np.ones(times.size), angles) for times, goals, angles in columns]
    return write_log(folder, description, "goal,torque_enable,q", rows)
