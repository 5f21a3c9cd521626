"""Tests of the stability of servos against MuJoCo's own steps."""

import mujoco
import numpy as np
import pytest

from sims.robot.integrator_settings import IntegratorSettings
from sims.robot.parsing.read_model_file import read_robot
from sims.robot.servo_stability import list_unstable_servos

ONE = """<mujoco><option timestep="{step}" integrator="{integrator}" gravity="0 0 0"/>
<worldbody><body name="arm"><joint name="a" type="hinge" axis="0 0 1" damping="{damping}"/>
<geom type="sphere" size="0.1" mass="0"/>
<inertial pos="0 0 0" mass="1" diaginertia="1 1 {inertia}"/>
</body></worldbody><actuator><general name="servo" joint="a" gear="{gear}" gainprm="{kp}"
biastype="affine" biasprm="0 -{kp} -{kv}"/></actuator></mujoco>"""
TWO = """<mujoco><option timestep="0.002"/><worldbody><body><joint name="a" axis="0 0 1"/>
<geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.02" mass="2"/>
<body pos="0.5 0 0"><joint name="b" axis="0 0 1"/>
<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.2"/></body></body></worldbody>
<actuator><position name="one" joint="a" kp="100" kv="5"/>
<position name="two" joint="b" kp="100" kv="20" forcerange="-5 5"/></actuator></mujoco>"""


def growth_of_errors(model, steps=40):
    """Return the mean growth of a small error in a step, over the second half of the steps."""
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0] = 1e-12, 1e-9
    sizes = []
    for _ in range(steps):
        mujoco.mj_step(model, data)
        sizes.append(np.hypot(data.qpos[0], data.qvel[0] * model.opt.timestep))
    half = steps // 2
    return (sizes[-1] / sizes[half - 1]) ** (1.0 / half)


def read(tmp_path, text):
    path = tmp_path / "robot.xml"
    path.write_text(text, encoding="utf-8")
    return read_robot(path)


def unstable(robot, integrator, step):
    data = mujoco.MjData(robot.compiled)
    mujoco.mj_forward(robot.compiled, data)
    return list_unstable_servos(robot, IntegratorSettings(step, integrator), [data])


@pytest.mark.parametrize(
    ("integrator", "gear", "damping", "kp", "kv"),
    [
        ("Euler", 1, 0.0, 100, 9.9),  # 2 h d slightly below 4 m
        ("Euler", 1, 0.0, 100, 10.1),
        ("Euler", 1, 2.0, 100, 11.5),  # damping of the joint allows 2 h b more
        ("Euler", 1, 2.0, 100, 12.5),
        ("Euler", 2, 0.5, 50, 2.4),  # the gear divides inertia and damping by 4
        ("Euler", 2, 0.5, 50, 3.2),
        ("RK4", 1, 0.0, 100, 13.0),  # |z| slightly below 2.785
        ("RK4", 1, 0.0, 100, 14.6),
        ("RK4", 1, 3.0, 100, 11.6),
    ],
)
def test_errors_grow_as_stated(tmp_path, integrator, gear, damping, kp, kv):
    text = ONE.format(
        step=0.002, integrator=integrator, damping=damping, inertia=0.01, gear=gear, kp=kp, kv=kv
    )
    robot = read(tmp_path, text)
    growth = growth_of_errors(mujoco.MjModel.from_xml_string(text))
    servos = unstable(robot, integrator, 0.002)
    assert [servo.name for servo in servos] == (["servo"] if growth > 1.01 else [])
    for servo in servos:
        assert servo.growth == pytest.approx(growth, rel=0.02)
        assert servo.stable_step in (0.001, 0.0005)


def test_an_implicit_integrator_is_stable(tmp_path):
    text = ONE.format(
        step=0.002, integrator="implicitfast", damping=0, inertia=0.01, gear=1, kp=100, kv=50
    )
    assert unstable(read(tmp_path, text), "implicitfast", 0.002) == []
    assert growth_of_errors(mujoco.MjModel.from_xml_string(text)) < 1.0


def test_the_inertia_is_that_of_all_joints_together(tmp_path):
    """The inertia at the second joint is det M / M_11 of the textbook's two-link arm."""
    robot = read(tmp_path, TWO)
    (servo,) = unstable(robot, "Euler", 0.002)
    assert servo.name == "two"
    first, second = robot.compiled.body_inertia[1:].max(axis=1)
    m12 = second + 0.2 * (0.15**2 + 0.5 * 0.15)
    m22 = second + 0.2 * 0.15**2
    m11 = first + 2.0 * 0.25**2 + second + 0.2 * (0.5 + 0.15) ** 2
    inertia = (m11 * m22 - m12**2) / m11
    determinant = 1.0 - 0.002 * 20.0 / inertia
    trace = 1.0 + determinant - 0.002**2 * 100.0 / inertia
    expected = max(abs(np.roots([1.0, -trace, determinant])))
    assert servo.growth == pytest.approx(expected, rel=1e-6)
