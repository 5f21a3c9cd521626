"""Tests of floating bodies whose pose is recorded, simulated with slides and hinges."""

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.core.plugin_registries import make_robot_simulator
from sims.core.simulator import InputError
from sims.effects import list_effects_for
from sims.robot.parsing.read_model_file import read_robot, restore_floating_joints

QUADROTOR = """<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="RK4"/>
  <default><joint damping="0.3" armature="0.1"/></default>
  <worldbody>
    <frame pos="0.1 0 0.2" euler="0 0 0.5">
      <body name="hull" pos="0.2 -0.1 1" euler="0.3 0.2 -0.4">
        <freejoint name="base"/>
        <inertial pos="0.01 0 0.02" mass="0.6" diaginertia="0.004 0.005 0.007"/>
        <site name="rotor1" pos="0.12 0.12 0"/>
        <site name="rotor2" pos="-0.12 -0.1 0"/>
        <body name="arm" pos="0 0 -0.1">
          <joint name="swing" axis="0 1 0" damping="0.01" armature="0"/>
          <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.01" mass="0.1"/>
        </body>
      </body>
    </frame>
  </worldbody>
  <actuator>
    <motor name="m1" site="rotor1" gear="0 0 1 0 0 0.02"/>
    <motor name="m2" site="rotor2" gear="0 0 1 0 0 -0.02"/>
  </actuator>
  <keyframe><key name="hover" qpos="0 0 1 1 0 0 0 0"/></keyframe>
</mujoco>
"""
BASE = {"recorded_bases": ["base"]}


def simulate(model, steps):
    """Return positions (steps, nq) with constant thrusts, from the pose of the file."""
    data = mujoco.MjData(model)
    data.ctrl[:] = 3.4, 3.1
    rows = []
    for _ in range(steps):
        mujoco.mj_step(model, data)
        rows.append(data.qpos.copy())
    return np.array(rows)


def test_slides_and_hinges_move_as_the_free_joint_does(write):
    path = write(QUADROTOR)
    separate = read_robot(path, engine=BASE)
    floating = mujoco.MjModel.from_xml_path(str(path))
    wanted = simulate(floating, 200)
    found = simulate(separate.compiled, 200)
    # The tumbling body has turned by more than half a radian about several axes.
    assert np.ptp(found[:, 3:6], axis=0).max() > 0.5
    assert found[:, :3] == pytest.approx(wanted[:, :3], abs=1e-7)
    assert found[:, 6] == pytest.approx(wanted[:, 7], abs=1e-7)
    reference = Rotation.from_quat(np.roll(separate.base_orientations["base"], -1))
    turned = Rotation.from_euler("ZYX", found[:, 3:6]) * reference
    expected = Rotation.from_quat(np.roll(wanted[:, 3:7], -1, axis=1))
    assert (turned.inv() * expected).magnitude().max() < 1e-7
    assert "1 keyframes are left out" in " ".join(separate.notes)


def test_the_free_joint_is_restored_for_files(write):
    separate = read_robot(write(QUADROTOR), engine=BASE)
    restored = restore_floating_joints(separate)
    assert [joint.kind for joint in restored.joints] == ["free", "hinge"]
    assert restored.compiled.nkey == 1


def test_a_base_has_no_bearing_and_no_gear(write):
    kind = make_robot_simulator(write(QUADROTOR), engine=BASE)
    names = set(list_effects_for(kind.system))
    assert {"drag.linear@base.x", "force.bias@base.yaw", "friction.coulomb@swing"} <= names
    at_base = {name.partition("@")[0] for name in names if "@base." in name}
    assert at_base == {"drag.linear", "drag.quadratic", "force.bias"}
    assert {"mass.scale@hull", "payload@hull", "input.gain@m1", "sensor.delay@q.base.x"} <= names


@pytest.mark.parametrize(
    ("text", "bases", "message"),
    [
        (QUADROTOR, ["bas"], "pose of bas: .*base"),
        (
            QUADROTOR.replace('<freejoint name="base"/>', '<joint name="base" type="free"/>'),
            ["base"],
            "joint base: expected no damping at a floating joint .* found 0.3",
        ),
    ],
)
def test_bases_that_cannot_be_separated_are_refused(write, text, bases, message):
    with pytest.raises(InputError, match=message):
        read_robot(write(text), engine={"recorded_bases": bases})


def test_a_robot_that_only_floats_names_the_missing_channels(write):
    text = QUADROTOR.replace('<joint name="swing" axis="0 1 0" damping="0.01" armature="0"/>', "")
    text = text.replace('qpos="0 0 1 1 0 0 0 0"', 'qpos="0 0 1 1 0 0 0"')
    with pytest.raises(InputError, match=r"channels q.base.x, y, z, qw, qx, qy, qz"):
        make_robot_simulator(write(text))
