"""Tests of causes applied to a model: numbers of model-field effects and of commands."""

import mujoco
import numpy as np
import pytest

from sims.effects import get_effect
from sims.extended_simulator import FittedValue
from sims.robot import model_field_effects
from sims.robot.coupled_drives import COUPLING_PLACEHOLDER
from sims.robot.export.apply_causes import apply_causes
from sims.robot.export.mjcf_attributes import copy_model_fields
from tests.sims.robot.sample_arms import ARM, robot
from tests.sims.robot.test_model_field_effects import STATED


def number(value, unit="1"):
    """Return a fitted value with an interval of 10 % to either side."""
    return FittedValue(value, unit, 0.9 * value, 1.1 * value)


def one(value):
    """Return the numbers of an effect with one coefficient."""
    return {"coefficient": number(value)}


# A coupling adds an element of its own, which `test_coupled_drives` tests.
@pytest.mark.parametrize(
    ("effect", "place", "c"), [one for one in STATED if one[0] != COUPLING_PLACEHOLDER[1]]
)
def test_a_cause_is_the_same_in_a_batch_element(effect, place, c, tmp_path):
    """The compiled model of a cause has the same fields as a batch element with the effect."""
    arm = robot(tmp_path)
    names = [coefficient.name for coefficient in get_effect(effect).coefficients]
    numbers = {name: number(value) for name, value in zip(names, c, strict=False)}
    applied = apply_causes(arm, {f"{effect}@{place}" if place else effect: numbers})
    lane = copy_model_fields(arm.compiled)
    model_field_effects.MODEL_FIELD_EFFECTS[effect].write(lane, arm, place, np.array(c)[:, None])
    found = copy_model_fields(applied.model)
    for name in model_field_effects.MODEL_FIELD_EFFECTS[effect].fields:
        np.testing.assert_allclose(found[name], lane[name], rtol=1e-12, atol=1e-15, err_msg=name)
    assert "arm" in applied.model.names.decode()


DRIVEN = ARM.replace('name="m_elbow"', 'name="m_elbow" ctrllimited="true" ctrlrange="-2 1.5"')


@pytest.mark.parametrize("control", [-2.5, -0.4, 0.3, 0.9, 4.0])
def test_a_command_passes_gain_bias_and_limit(control, tmp_path):
    """The force is that of the erroneous command, within the control range."""
    arm = robot(tmp_path, DRIVEN)
    causes = {
        "input.saturation@m_elbow": one(1.2),
        "input.gain@m_elbow": one(0.5),
        "input.bias@m_elbow": one(-0.3),
    }
    model = apply_causes(arm, causes).model
    felt = np.clip(np.clip(1.5 * control - 0.3, -1.2, 1.2), -2.0, 1.5)
    assert _forces(model, [0.0, control, 0.0])[1] == pytest.approx(max(felt, -1.0), abs=1e-12)


@pytest.mark.parametrize("place", ["m_shoulder", "m_spin"])
def test_a_servo_is_given_another_set_point(place, tmp_path):
    """A gain and a bias of the set point keep the servo's own gains."""
    arm = robot(tmp_path)
    causes = {
        f"input.bias@{place}": one(0.05),
        f"input.gain@{place}": one(0.1),
        "actuator.damping@m_spin": one(0.5),
        "actuator.stiffness@m_shoulder": one(0.5),
    }
    model = apply_causes(arm, causes).model
    servos = {name: causes[name] for name in causes if name.startswith("actuator")}
    plain = apply_causes(arm, servos).model
    i = arm.actuator(place).id
    commanded, meant = np.zeros(3), np.zeros(3)
    commanded[i], meant[i] = 0.4, 1.1 * 0.4 + 0.05
    np.testing.assert_allclose(_forces(model, commanded), _forces(plain, meant), atol=1e-12)


def _forces(model, control):
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = 0.1, 0.2, control
    mujoco.mj_forward(model, data)
    return np.array(data.actuator_force)


@pytest.mark.parametrize(("place", "force"), [("elbow", 0.7), ("spin", 0.02), ("shoulder", 0.7)])
def test_a_constant_force_is_a_spring_or_a_bias(place, force, tmp_path):
    """The acceleration is that of the force."""
    arm = robot(tmp_path)
    model = apply_causes(arm, {f"force.bias@{place}": one(force)}).model
    pushed = mujoco.MjData(arm.compiled)
    pushed.qpos[:] = 0.3
    pushed.qfrc_applied[arm.joint(place).velocity] = force
    mujoco.mj_forward(arm.compiled, pushed)
    data = mujoco.MjData(model)
    data.qpos[:] = 0.3
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qacc, pushed.qacc, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("backlash@m_elbow", "no such element"),
        ("sensor.bias@q.elbow", "does not state sensor errors"),
        ("input.delay@m_elbow", "negative delay"),
        ("input.gain@m_spin", "a factor of zero or less"),
    ],
)
def test_what_a_file_cannot_say_is_said(name, why, tmp_path):
    """One line each with the number; the model is unchanged."""
    arm = robot(tmp_path)
    applied = apply_causes(arm, {name: one(-2.0)}, "log.csv")
    assert applied.held == ()
    (line,) = applied.notes
    assert name in line
    assert why in line
    assert "-2" in line
    np.testing.assert_array_equal(applied.model.actuator_gainprm, arm.compiled.actuator_gainprm)


MOVING = """
<mujoco><compiler inertiafromgeom="true"/><worldbody>
  <body name="a"><inertial pos="0 0 0" mass="1" fullinertia="1 1.2 1.3 .1 .1 .1"/>
    <joint name="j" axis="0 1 0"/><geom size=".1" pos=".2 .1 0"/>
    <body name="b"><joint name="k" springdamper="0.1 1"/>
      <geom type="capsule" fromto="0 0 0 1 1 0" size=".1"/></body></body></worldbody>
  <actuator><position name="m" joint="j" kp="3" dampratio="1"/></actuator></mujoco>
"""


def test_what_a_mass_would_move_along_stays(tmp_path):
    """Gains and dampings that the compiler derives from masses keep their values."""
    arm = robot(tmp_path, MOVING)
    model, before = apply_causes(arm, {"mass.scale@b": one(0.2)}).model, arm.compiled
    np.testing.assert_allclose(model.body_mass, before.body_mass * [1.0, 1.0, 1.2], rtol=1e-12)
    for name in ("dof_damping", "jnt_stiffness", "actuator_biasprm", "body_ipos"):
        np.testing.assert_allclose(getattr(model, name), getattr(before, name), rtol=1e-12)


def test_the_robot_stays_as_it_is(tmp_path):
    """Applying causes does not change the robot that was read."""
    arm = robot(tmp_path)
    before = arm.spec.to_xml()
    apply_causes(arm, {"mass.scale@fore": one(0.2), "drag.linear@elbow": one(0.1)})
    assert arm.spec.to_xml() == before


def test_numerics_are_options(tmp_path):
    """The step and the integrator that repair a model are in its options."""
    causes = {"numerics.step": {"coefficient": number(5e-4, "s")}, "numerics.integrator": one(1.0)}
    options = {"cone": 1.0, "impratio": 20.0, "noslip": 5.0, "solver": 0.0, "iterations": 30.0}
    causes |= {f"numerics.{name}": one(value) for name, value in options.items()}
    model = apply_causes(robot(tmp_path), causes).model
    assert (model.opt.cone, model.opt.impratio) == (mujoco.mjtCone.mjCONE_ELLIPTIC, 20.0)
    assert (model.opt.noslip_iterations, model.opt.iterations) == (5, 30)
    assert model.opt.solver == mujoco.mjtSolver.mjSOL_PGS
    assert model.opt.timestep == 5e-4
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
