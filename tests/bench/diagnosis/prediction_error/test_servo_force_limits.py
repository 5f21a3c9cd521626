"""Tests of servos whose forces reach their limits, in logs made by plain MuJoCo."""

import mujoco
import numpy as np
import pytest

from bench.diagnosis.explain import explain
from tests.bench.diagnosis.simulated_logs import describe, follow, write_log

NOISE, RATE, LIMIT = 2e-4, 100, 28.0
SHARES = (0.2, 0.2, 0.25)
ARM = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body pos="0 0 1">
<joint name="shoulder" axis="0 1 0" armature="{armature}"/>
<geom type="capsule" size=".06" fromto="0 0 0 .4 0 0" mass="4"/><body pos=".4 0 0">
<joint name="elbow" axis="0 1 0"/><geom type="capsule" size=".04" fromto="0 0 0 .3 0 0" mass="1.5"/>
<body pos=".3 0 0">
<joint name="wrist" axis="1 0 0" damping="{damping}" actuatorfrcrange="-{limit} {limit}"/>
<geom type="box" size=".05 .08 .05" mass=".6"/></body></body></body></worldbody><actuator>
<position name="s1" joint="shoulder" kp="2000" kv="100"/>
<position name="s2" joint="elbow" kp="{kp}" kv="100"/>
<position name="s3" joint="wrist" kp="2000" kv="100"/></actuator></mujoco>
"""
STATED = {"armature": 0.1, "kp": 2000.0, "damping": 0.0}
TRUE = {"armature": 0.6, "kp": 1700.0, "damping": 6.0}


def explained(folder, changed):
    """Explain three runs of 3 s, in which the wrist reaches its limit, with a changed parameter."""
    model = mujoco.MjModel.from_xml_string(
        ARM.format(limit=LIMIT, **{**STATED, changed: TRUE[changed]})
    )
    times, runs, clamped = np.arange(3 * RATE) / RATE, [], []
    for seed in (1, 2, 3):
        rng = np.random.default_rng(seed)
        phases = rng.uniform(0, 2 * np.pi, (3, 3))
        waves = np.sin(2 * np.pi * np.multiply.outer(times, (0.5, 1.1, 1.9))[:, None] + phases)
        commands = SHARES * waves.mean(axis=2)
        readings = follow(
            model, commands, 5, commands[0],
            act=lambda data: clamped.append(abs(data.qfrc_actuator[2]) >= LIMIT),
        )  # fmt: skip
        runs.append((times, commands, readings + NOISE * rng.standard_normal(readings.shape)))
    assert sum(clamped) > 30
    names = ("u.s1", "u.s2", "u.s3", "q.shoulder", "q.elbow", "q.wrist")
    description = describe(dict.fromkeys(names, "rad"), NOISE, "[runs.3]\nheld_out = true\n")
    known = ARM.format(limit=LIMIT, **STATED)
    return explain(write_log(folder, description, ",".join(names), runs, arm=known)).answer


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changed", "effect", "size"),
    [
        ("armature", "inertia.armature@shoulder", 0.5),
        ("kp", "actuator.stiffness@s2", -0.15),
    ],
)
def test_a_cause_at_another_joint_is_named(tmp_path, changed, effect, size):
    answer = explained(tmp_path, changed)
    (cause,) = answer.causes
    found = {cause.effect, *cause.alternatives}
    assert answer.verdict in ("named", "ambiguous")
    assert effect in found
    if cause.effect == effect:
        assert cause.coefficients["coefficient"].value == pytest.approx(size, rel=0.05)


@pytest.mark.slow
def test_a_cause_at_a_chattering_joint_is_found(tmp_path):
    """The wrist chatters at its force limit, so that no linear response is valid there."""
    answer = explained(tmp_path, "damping")
    (cause,) = answer.causes
    assert cause.effect == "drag.linear@wrist"
    assert cause.coefficients["coefficient"].value == pytest.approx(TRUE["damping"], rel=0.02)
