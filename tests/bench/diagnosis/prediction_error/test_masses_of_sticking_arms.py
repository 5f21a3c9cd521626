"""Test that explain finds a wrong mass where dry friction bears a part of the load.

Plain MuJoCo makes the motion of an arm with hobby servos, whose joints stick between movements.
"""

import mujoco
import numpy as np
import pytest

from bench.diagnosis.explain import explain
from tests.bench.diagnosis.simulated_logs import describe, follow, write_log

NOISE, STATED, TRUE = 1e-4, 0.09, 0.36
JOINTS = ("pan", "lift", "elbow", "wrist")
MASSES, LENGTHS = (0.1, 0.1, 0.1, STATED), (0.06, 0.115, 0.135, 0.08)


def make_arm(mass):
    """Return the MJCF of an arm of four links, whose last one has the given mass in kg."""
    body = ""
    for i in (3, 2, 1, 0):
        m, length = mass if i == 3 else MASSES[i], LENGTHS[i]
        body = (
            f'<body name="{JOINTS[i]}_link" pos="{LENGTHS[i - 1] if i else 0} 0 0">'
            f'<joint name="{JOINTS[i]}" axis="{"0 1 0" if i else "0 0 1"}"/>'
            f'<inertial pos="{length / 2} 0 0.01" mass="{m}" diaginertia="{m * 4e-4:g} '
            f'{m * 1e-3:g} {m * 1e-3:g}"/>{body}</body>'
        )
    servos = "".join(
        f'<position name="{name}" joint="{name}" kp="998" kv="2.7" forcerange="-3 3"/>'
        for name in JOINTS
    )
    return (
        '<mujoco><option timestep="0.005" integrator="implicitfast"/><default>'
        '<joint damping="0.6" frictionloss="0.05" armature="0.028"/></default>'
        f"<worldbody>{body}</worldbody><actuator>{servos}</actuator></mujoco>"
    )


@pytest.mark.slow
def test_the_mass_is_named_alone(tmp_path):
    rng, model, runs = np.random.default_rng(1), mujoco.MjModel.from_xml_string(make_arm(TRUE)), []
    times = 0.01 * np.arange(301)
    for _ in range(3):
        phases = rng.uniform(0, 2 * np.pi, (3, 4))
        waves = np.sin(2 * np.pi * np.multiply.outer(times, rng.uniform(0.2, 1.2, (3, 4))) + phases)
        commands = np.array([0.0, -0.4, 0.6, 0.3]) + 0.1 * (waves - waves[0]).sum(axis=1)
        readings = follow(model, commands, 2, start=commands[0], settle=200)
        runs.append((times, commands, readings + NOISE * rng.standard_normal(readings.shape)))
    units = dict.fromkeys([f"{kind}.{name}" for kind in "uq" for name in JOINTS], "rad")
    path = write_log(tmp_path, describe(units, NOISE), ",".join(units), runs, arm=make_arm(STATED))
    answer = explain(path).answer
    (cause,) = answer.causes
    assert (answer.verdict, cause.effect) == ("named", "mass.scale@wrist_link")
    assert cause.coefficients["coefficient"].value == pytest.approx(TRUE / STATED - 1, rel=0.02)
