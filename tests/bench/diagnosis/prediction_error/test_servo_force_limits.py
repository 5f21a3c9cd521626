"""Tests of servos whose forces reach their limits, in logs made by plain MuJoCo."""

import mujoco
import numpy as np
import pytest

from bench.diagnosis.explain import explain

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


def log_of(changed, seed):
    """Return rows of 3 s with one changed parameter, and how often the wrist is at its limit."""
    rng = np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(
        ARM.format(limit=LIMIT, **{**STATED, changed: TRUE[changed]})
    )
    data, rows, clamped = mujoco.MjData(model), [], 0
    phases, shares = rng.uniform(0, 2 * np.pi, (3, 3)), SHARES
    data.qpos[:] = shares * np.sin(phases).mean(axis=1)
    for k in range(3 * RATE):
        t = k / RATE
        waves = [np.sin(2 * np.pi * f * t + phases[:, i]) for i, f in enumerate((0.5, 1.1, 1.9))]
        data.ctrl[:] = shares * np.mean(waves, axis=0)
        read = data.qpos + NOISE * rng.standard_normal(3)
        rows.append([seed, t, *data.ctrl, *read])
        for _ in range(5):
            mujoco.mj_step(model, data)
            clamped += abs(data.qfrc_actuator[2]) >= LIMIT
    return rows, clamped


def explained(folder, changed):
    (folder / "arm.xml").write_text(ARM.format(limit=LIMIT, **STATED))
    names = ("shoulder", "elbow", "wrist")
    lines, clamped = ["run,t,u.s1,u.s2,u.s3," + ",".join(f"q.{n}" for n in names)], 0
    for seed in (1, 2, 3):
        rows, count = log_of(changed, seed)
        lines += [",".join(f"{value:.9g}" for value in row) for row in rows]
        clamped += count
    assert clamped > 30
    (folder / "log.csv").write_text("\n".join(lines) + "\n")
    inputs = "".join(f'[inputs."u.s{k}"]\nunit = "rad"\n' for k in (1, 2, 3))
    channels = "".join(f'[channels."q.{n}"]\nunit = "rad"\nnoise = {NOISE}\n' for n in names)
    description = f'model = "arm.xml"\n{inputs}{channels}[runs.3]\nheld_out = true\n'
    (folder / "log.toml").write_text(description)
    return explain(folder / "log.csv").answer


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
