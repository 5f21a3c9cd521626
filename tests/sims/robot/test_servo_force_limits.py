import mujoco
import numpy as np
import pytest

from sims.robot.dynamics.servo_force_limits import find_stiff_force_limits

STEP, INERTIA, KP, KV, LIMIT = 0.002, 0.02, 2000.0, 100.0, 28.0
SERVO = """
<mujoco><option timestep="{step}" integrator="{integrator}" gravity="0 0 0"/><worldbody>
<body><joint name="j" axis="0 0 1" {joint}/>
<inertial pos="0 0 0" mass="1" diaginertia="{inertia} {inertia} {inertia}"/></body>
</worldbody><actuator>
<position name="s" joint="j" kp="{kp}" kv="{kv}" {actuator}/></actuator></mujoco>
"""
WHERE = {
    "joint": {"joint": f'actuatorfrcrange="-{LIMIT} {LIMIT}"', "actuator": ""},
    "actuator": {"joint": "", "actuator": f'forcerange="-{LIMIT} {LIMIT}"'},
}


def servo(where="joint", integrator="implicitfast", kv=KV):
    values = {"step": STEP, "integrator": integrator, "inertia": INERTIA, "kp": KP, "kv": kv}
    return mujoco.MjModel.from_xml_string(SERVO.format(**values, **WHERE[where]))


def moved(model, share):
    """Return the position after one step from rest, with a command for this fraction of the
    limit.
    """
    data = mujoco.MjData(model)
    data.ctrl[:] = share * LIMIT / KP
    mujoco.mj_step(model, data)
    return data.qpos[0]


@pytest.mark.parametrize("where", WHERE)
def test_the_jump_is_that_of_a_step_on_either_side_of_the_limit(where):
    model = servo(where)
    found = find_stiff_force_limits(model)
    ratio = STEP * KV / INERTIA
    assert found.jumps.shape == (1, 1)
    assert found.jumps[0, 0] == pytest.approx(STEP**2 * LIMIT / INERTIA * ratio / (1 + ratio))
    measured = moved(model, 1.0001) - moved(model, 0.9999)
    assert found.jumps[0, 0] == pytest.approx(measured, rel=1e-3)
    assert found.sizes[0] < LIMIT


@pytest.mark.parametrize("settings", [{"integrator": "Euler"}, {"kv": 0.5}])
def test_other_servos_have_none(settings):
    model = servo(**settings)
    assert find_stiff_force_limits(model).sizes.size == 0
    measured = moved(model, 1.0001) - moved(model, 0.9999)
    assert abs(measured) < 0.1 * STEP**2 * LIMIT / INERTIA


def test_a_coupled_joint_moves_the_other_as_well():
    text = """
    <mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
    <body><joint name="a" axis="0 0 1"/><geom type="capsule" size=".05" fromto="0 0 0 .4 0 0"/>
    <body pos=".4 0 0"><joint name="b" axis="0 0 1" actuatorfrcrange="-5 5"/>
    <geom type="capsule" size=".04" fromto="0 0 0 .3 0 0"/></body></body></worldbody><actuator>
    <position joint="a" kp="500" kv="5"/><position joint="b" kp="2000" kv="100"/></actuator>
    </mujoco>"""
    model = mujoco.MjModel.from_xml_string(text)
    ends = []
    for share in (0.9999, 1.0001):
        data = mujoco.MjData(model)
        data.ctrl[1] = share * 5.0 / 2000.0
        mujoco.mj_step(model, data)
        ends.append(data.qpos.copy())
    np.testing.assert_allclose(
        find_stiff_force_limits(model).jumps[0], np.abs(ends[1] - ends[0]), rtol=1e-2
    )
