"""Test that fits find the first states of robots with stiff servos.

The first velocity of a stiff servo decays within one sample, so that the readings hardly show it.
A step to its best linear estimate takes the servo to its force limit, where nothing is linear.
"""

import mujoco
import numpy as np
import pytest

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.logs.recording_loading import load_recording
from tests.bench.diagnosis.explained_samples import fit_model, white
from tests.bench.diagnosis.simulated_logs import describe, follow, write_log

NOISE, STEPS, LENGTH, RUNS = 1e-4, 5, 301, 3
JOINT = '<joint name="{name}" axis="{axis}" armature="0.1" damping="{damping}"/>'
SERVO = '<position name="{name}" joint="{name}" kp="5000" kv="500" forcerange="-{limit} {limit}"/>'
JOINTS = {
    "lift": ("0 1 0", 10, 330), "elbow": ("0 1 0", 5, 150),
    "bend": ("0 1 0", 2, 56), "turn": ("0 0 1", 2, 56),
}  # fmt: skip
MASSES = (12.0, 4.0, 2.0, 0.5)


def make_arm():
    """Return the MJCF of an arm of four links of 0.3 m, whose last two servos are weak."""
    body, servos = "", ""
    for (name, (axis, damping, limit)), mass in reversed(
        list(zip(JOINTS.items(), MASSES, strict=True))
    ):
        joint = JOINT.format(name=name, axis=axis, damping=damping)
        inertia = " ".join([f"{mass * 0.01:g}"] * 3)
        body = (
            f'<body pos="0.3 0 0">{joint}<inertial pos="0.15 0 0" mass="{mass}" '
            f'diaginertia="{inertia}"/>{body}</body>'
        )
        servos = SERVO.format(name=name, limit=limit) + servos
    return (
        '<mujoco><option timestep="0.002" integrator="implicitfast"/>'
        f"<worldbody>{body}</worldbody><actuator>{servos}</actuator></mujoco>"
    )


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_only_the_noise_is_left(tmp_path, seed):
    rng, arm, runs, noise = np.random.default_rng(seed), make_arm(), [], []
    model = mujoco.MjModel.from_xml_string(arm)
    times = 0.01 * np.arange(LENGTH)
    for _ in range(RUNS):
        phases = rng.uniform(0, 2 * np.pi, (3, 4))
        waves = np.sin(2 * np.pi * np.multiply.outer(times, rng.uniform(0.2, 1.2, (3, 4))) + phases)
        commands = 0.1 * (waves - waves[0]).sum(axis=1)
        readings = follow(model, commands, STEPS, settle=500)
        noise.append(NOISE * rng.standard_normal(readings.shape))
        runs.append((times, commands, readings + noise[-1]))
    units = dict.fromkeys([f"{kind}.{name}" for kind in "uq" for name in JOINTS], "rad")
    path = write_log(tmp_path, describe(units, NOISE), ",".join(units), runs, arm=arm)
    recording, kind = load_recording(path)
    there = RunEvaluator(kind, recording, recording.runs, None, [], ())
    fit = fit_model(there, white(there, NOISE), iterations=30)
    # The true first states leave the noise. With one damping for all states, 30 to 157 more remain.
    assert fit.cost < np.square(np.array(noise) / NOISE).sum() + 10.0
