"""Tests of dry friction in MuJoCo's soft form: effects give the motion of MuJoCo with the same
file.
"""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from sims.core.simulator import InputError, Scenario
from sims.extended_simulator import (
    ExtendedSimulator,
    FittedValue,
    get_robot_reference,
    load_extended,
    read_extended,
    write_extended,
)
from sims.robot.dry_friction import get_friction_constraint
from sims.robot.dynamics.linearisation_about_simulation import RunLinearisation
from sims.robot.export.write_model_file import write_model_files
from sims.robot.integrator_settings import INTEGRATOR_IDS
from sims.robot.parsing.read_model_file import read_robot
from sims.robot.robot_model import RobotModel
from sims.robot.robot_simulator import make_robot_simulator

ARM = """<mujoco>
<option timestep="0.002" integrator="{integrator}"/>
<worldbody><body name="upper">
  <joint name="shoulder" axis="0 1 0" damping="0.05"/>
  <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="1" contype="0" conaffinity="0"/>
  <body name="fore" pos="0 0 -0.3">
    <joint name="elbow" axis="0 1 0" damping="0.03" {elbow}/>
    <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.25" mass="0.5" contype="0"
          conaffinity="0"/>
  </body>
</body></worldbody>
<actuator><motor name="m1" joint="shoulder"/><motor name="m2" joint="elbow"/></actuator>
</mujoco>"""
STEPS = 500
CONTROLS = np.array([1.5, 0.5]) * np.sin(np.arange(STEPS)[:, None] * 0.002 * np.array([5.0, 8.0]))
"""(STEPS, 2) torques, N m, constant over each step."""
START = (0.4, -0.6)
"""Initial positions, rad."""


def simulator(folder, integrator="implicitfast", elbow="", form="soft", effects=()):
    path = Path(folder) / "arm.xml"
    path.write_text(ARM.format(integrator=integrator, elbow=elbow))
    kind = make_robot_simulator(read_robot(path)).with_friction_form(form)
    return kind(observe=["q.shoulder", "q.elbow"], effects=list(effects))


def scenario():
    times = 0.002 * np.arange(STEPS + 1)
    held = np.concatenate([CONTROLS, CONTROLS[-1:]])
    inputs = {"u.m1": held[:, 0], "u.m2": held[:, 1]}
    return Scenario(times, {"q.shoulder": START[0], "q.elbow": START[1]}, inputs)


def plain(text):
    """Return the positions (STEPS + 1, 2) of a model file with `mj_step`."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.qpos[:] = START
    rows = [data.qpos.copy()]
    for control in CONTROLS:
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
        rows.append(data.qpos.copy())
    return np.array(rows)


def off(seen, true):
    """Return the RMS error as a fraction of the true change."""
    return np.sqrt(np.square(seen - true).sum() / np.square(true).sum())


@pytest.mark.parametrize("integrator", INTEGRATOR_IDS)
@pytest.mark.parametrize("stated", ["", 'solreffriction="0.05 1" solimpfriction="0.8 0.9 0.001"'])
def test_soft_friction_is_that_of_the_file_with_the_same_frictionloss(tmp_path, integrator, stated):
    """The motion agrees for a model-field effect and for an effect evaluated per step."""
    native = simulator(tmp_path, integrator, stated, effects=["friction.coulomb@elbow"])
    seen = native.simulate(np.array([[0.06]]), scenario())[0]
    wanted = plain(ARM.format(integrator=integrator, elbow=f'frictionloss="0.06" {stated}'))
    np.testing.assert_allclose(seen, wanted, atol=1e-10)
    asked = simulator(tmp_path, integrator, stated, effects=["friction.position@elbow"])
    names = [p.name.rpartition(".")[2] for p in asked.parameters]
    theta = np.array([[{"least": 0.06}.get(name, 0.0) for name in names]])
    assert theta.any()
    np.testing.assert_allclose(asked.simulate(theta, scenario())[0], wanted, atol=1e-10)
    stiff = simulator(tmp_path, integrator, stated, "stiff", ["friction.coulomb@elbow"])
    assert np.abs(stiff.simulate(np.array([[0.06]]), scenario())[0] - wanted).max() > 1e-3


def test_friction_damping_is_that_of_the_constraint(tmp_path):
    """MuJoCo's reference acceleration of a friction loss constraint is -b v."""
    for stated in ("", 'solreffriction="0.001 1"', 'solreffriction="-3 -70"',
                   'solimpfriction="0.7 0.9 0"',
                   'solimpfriction="1 1 0.001"'):  # fmt: skip
        text = ARM.format(integrator="Euler", elbow=f'frictionloss="0.06" {stated}')
        robot = RobotModel(Path("arm.xml"), "mjcf", mujoco.MjSpec.from_string(text))
        model = robot.compiled
        data = mujoco.MjData(model)
        data.qvel[:] = (0.0, 0.3)
        mujoco.mj_forward(model, data)
        assert data.efc_type.tolist() == [mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF]
        damping, impedance = get_friction_constraint(robot.with_friction_form("soft"), 1)
        assert -damping * 0.3 == pytest.approx(data.efc_aref[0])
        assert impedance == pytest.approx(data.efc_KBIP[0, 2])
        assert get_friction_constraint(robot, 1) == pytest.approx((1 / 0.002 / 0.9999, 0.9999))


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
@pytest.mark.parametrize("already", [0.0, 0.05])
def test_the_tangent_of_soft_friction_is_what_a_small_change_makes(tmp_path, integrator, already):
    effects = ["friction.coulomb@elbow", "friction.coulomb@shoulder"]
    soft = simulator(tmp_path, integrator, effects=effects)
    theta = np.array([already, 0.0])
    tangent = RunLinearisation(soft, theta, scenario(), np.array(START), np.zeros(2))
    for number, effect in enumerate(soft.effects):
        more = theta + 0.002 * np.eye(2)[number]
        before, after = soft.simulate(np.stack([theta, more]), scenario())
        (seen,), _ = tangent.compute_effect_responses([(effect, np.array([0.002]))])
        assert off(seen, after - before) < (0.08 if already else 0.02)


def test_each_form_has_a_tangent_of_its_own(tmp_path):
    """The tangent of stiff friction does not fit soft friction, which reverses earlier."""
    small = np.array([0.002])
    seen, true = {}, {}
    for form in ("soft", "stiff"):
        arm = simulator(tmp_path, form=form, effects=["friction.coulomb@elbow"])
        before, after = arm.simulate(np.stack([0 * small, small]), scenario())
        tangent = RunLinearisation(arm, 0 * small, scenario(), np.array(START), np.zeros(2))
        seen[form], true[form] = (
            tangent.compute_effect_responses([(arm.effects[0], small)])[0][0],
            after - before,
        )
    assert off(seen["stiff"], true["soft"]) > 3 * off(seen["soft"], true["soft"])
    assert off(seen["soft"], true["stiff"]) > 2 * off(seen["stiff"], true["stiff"])


@pytest.fixture
def extended(tmp_path):
    """Return an extended simulator with soft friction at the elbow."""
    kind = type(simulator(tmp_path))
    effects = {"friction.coulomb@elbow": {"coefficient": FittedValue(0.06, "N*m", 0.059, 0.061)}}
    observe = ["q.shoulder", "q.elbow"]
    return ExtendedSimulator(
        "arm_extended",
        "arm",
        None,
        "a log",
        {},
        effects,
        {},
        observe,
        kind,
        get_robot_reference(kind),
    )


def test_extended_toml_states_the_form(extended, tmp_path):
    path = tmp_path / "extended.toml"
    write_extended(extended, path)
    assert 'friction_form = "soft"' in path.read_text()
    assert read_extended(path).robot.friction_form == "soft"
    fitted = load_extended(path, lambda _: None)()
    theta = np.array([[p.nominal for p in fitted.parameters]])
    wanted = plain(ARM.format(integrator="implicitfast", elbow='frictionloss="0.06"'))
    np.testing.assert_allclose(fitted.simulate(theta, scenario())[0], wanted, atol=1e-10)


def test_extended_toml_without_the_form_is_stiff(extended, tmp_path):
    path = tmp_path / "extended.toml"
    write_extended(extended, path)
    soft = load_extended(path, lambda _: None)
    path.write_text(path.read_text().replace('friction_form = "soft"\n', ""))
    stiff = load_extended(path, lambda _: None)
    assert stiff.robot.friction_form == "stiff"
    assert stiff.source_digest != soft.source_digest
    kind = extended.kind.with_friction_form("stiff")
    assert kind.source_digest != extended.kind.source_digest
    write_extended(
        ExtendedSimulator(**{**vars(extended), "kind": kind, "robot": get_robot_reference(kind)}),
        path,
    )
    assert "friction_form" not in path.read_text()


def test_a_form_that_does_not_exist_is_refused(extended, tmp_path):
    path = tmp_path / "extended.toml"
    write_extended(extended, path)
    path.write_text(path.read_text().replace('"soft"', '"spongy"'))
    with pytest.raises(InputError, match="friction_form: expected stiff or soft, found 'spongy'"):
        read_extended(path)


@pytest.mark.parametrize("form", ["soft", "stiff"])
def test_the_model_file_states_solver_parameters_of_stiff_friction_alone(extended, form):
    robot = extended.kind.robot.with_friction_form(form)
    done = write_model_files(robot, extended.effects, "log.csv")
    assert 'frictionloss="0.06"' in done.xml
    assert ("solreffriction=" in done.xml) == (form == "stiff")
    (line,) = done.notes
    assert ("soft form" in line) == (form == "soft")
    moved = plain(done.xml)
    kind = extended.kind.with_friction_form(form)
    arm = kind(observe=["q.shoulder", "q.elbow"], effects=["friction.coulomb@elbow"])
    np.testing.assert_allclose(arm.simulate(np.array([[0.06]]), scenario())[0], moved, atol=1e-9)


@pytest.mark.parametrize("form", ["soft", "stiff"])
def test_less_friction_than_the_file_states_keeps_the_form_of_the_file(tmp_path, form):
    stated = 'frictionloss="0.1" solreffriction="0.03 1"'
    arm = simulator(tmp_path, "implicitfast", stated, form, ["friction.coulomb@elbow"])
    wanted = plain(ARM.format(integrator="implicitfast", elbow=stated.replace("0.1", "0.06")))
    np.testing.assert_allclose(arm.simulate(np.array([[-0.04]]), scenario())[0], wanted, atol=1e-10)
