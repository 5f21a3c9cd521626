"""Armature behind a stiff servo with dry friction: a linear regression finds no sign of it."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.explain import explain
from bench.diagnosis.kalman import linearised_filter
from bench.diagnosis.kalman.linearised_filter import FollowedRuns
from bench.diagnosis.prediction_error.physically_equivalent_effects import (
    list_similar_dampings,
    list_similar_inertias,
)
from bench.logs.recording_joining import load_joined
from tests.bench.diagnosis.simulated_logs import describe, follow, write_log

ARM = """<mujoco model="arm">
<option timestep="0.002" integrator="implicitfast"/>
<default>
  <geom type="capsule" size="0.02" contype="0" conaffinity="0"/>
  <joint damping="1" frictionloss="1"/>
  <position kp="1000" kv="100" forcerange="-30 30"/>
</default>
<worldbody><body name="turret" pos="0 0 0.1">
  <joint name="base" axis="0 0 1"/>
  <inertial pos="0 0 0.05" mass="0.7" diaginertia="0.0015 0.0014 0.0013"/>
  <body name="upper" pos="0 0 0.05">
    <joint name="shoulder" axis="0 1 0"/>
    <geom fromto="0 0 0 0.35 0 0" mass="1.2"/>
    <body name="lower" pos="0.35 0 0">
      <joint name="elbow" axis="0 1 0"/>
      <geom fromto="0 0 0 0.2 0 0" mass="0.8"/>
    </body>
  </body>
</body></worldbody>
<actuator>
  <position name="m_base" joint="base"/><position name="m_shoulder" joint="shoulder"/>
  <position name="m_elbow" joint="elbow"/>
</actuator>
</mujoco>"""
JOINTS = ("base", "shoulder", "elbow")
NOISE = 1e-4


def write_recording(folder, field, joint, value, seed):
    """Write a log of three runs in which a field of a joint has another value; return its path."""
    model = mujoco.MjModel.from_xml_string(ARM)
    getattr(model, field)[joint] = value
    rng, times, runs = np.random.default_rng(seed), 0.01 * np.arange(301), []
    for _ in range(3):
        frequencies, phases = rng.uniform(0.2, 1.2, (3, 3)), rng.uniform(0.0, 6.0, (3, 3))
        waves = np.sin(2 * np.pi * frequencies[..., None] * times + phases[..., None])
        commands = 0.15 * waves.sum(axis=1).T
        positions = follow(model, commands, 5, settle=1000)
        runs.append((times, commands, positions + rng.normal(0.0, NOISE, positions.shape)))
    units = dict.fromkeys([*(f"u.m_{j}" for j in JOINTS), *(f"q.{j}" for j in JOINTS)], "rad")
    return write_log(folder, describe(units, NOISE), ",".join(units), runs, arm=ARM)


@pytest.fixture
def log(tmp_path):
    """Return a log with a rotor of 0.17 kg m² at the vertical first joint."""
    return write_recording(tmp_path, "dof_armature", 0, 0.17, seed=21)


@pytest.mark.slow
def test_an_armature_is_reported_with_the_inertia_of_the_link_that_acts_alike(log):
    answer = explain(log, jobs=1).answer
    (cause,) = answer.causes
    # The centre of mass of the turret is on the axis, so that its mass acts by its inertia alone.
    assert cause.effect == "inertia.armature@base"
    assert set(cause.alternatives) == {"inertia.scale@turret", "mass.scale@turret"}
    assert cause.coefficients["coefficient"].value == pytest.approx(0.17, rel=0.05)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("inertia.armature@elbow", "inertia.scale@forearm"),
        ("inertia.scale@forearm", "inertia.armature@elbow"),
        ("mass.scale@forearm", "inertia.armature@elbow"),
    ],
)
def test_an_inertia_and_the_armature_that_acts_alike_change_the_mass_matrix_alike(
    example_arm, name, expected
):
    robot = example_arm.simulator.robot
    ((other, coefficients),) = list_similar_inertias(example_arm, name, np.array([0.004]))
    assert other == expected
    changes = {name: 0.004, other: float(coefficients[0])}
    model = mujoco.MjModel.from_xml_path(str(robot.path))
    dof, body = model.joint("elbow").dofadr[0], model.body("forearm").id

    def inertia_of_joint():
        data, matrix = mujoco.MjData(model), np.zeros((model.nv, model.nv))
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, matrix)
        return float(matrix[dof, dof])

    before = inertia_of_joint()
    armature = changes.pop("inertia.armature@elbow")
    ((effect, share),) = changes.items()
    model.body_inertia[body] *= 1.0 + share
    if effect == "mass.scale@forearm":
        model.body_mass[body] *= 1.0 + share
    assert inertia_of_joint() - before == pytest.approx(armature, rel=1e-9)


def test_a_payload_may_be_a_heavier_body(example_arm):
    model = mujoco.MjModel.from_xml_path(str(example_arm.simulator.robot.path))
    ((other, share),) = list_similar_inertias(
        example_arm, "payload@forearm", np.array([0.03, 0.0, 0.0, 0.1])
    )
    assert other == "mass.scale@forearm"
    assert share == pytest.approx([0.03 / model.body("forearm").mass[0]])


def test_other_effects_have_no_similar_inertia(example_arm):
    for name in ("drag.linear@elbow", "mass.offset@forearm", "inertia.armature@*"):
        assert list_similar_inertias(example_arm, name, np.array([0.1])) == []


@pytest.mark.parametrize(
    ("force", "gains", "expected"),
    [(0.05, [], 0), (0.5, [-3.0], 0), (0.5, [400.0, 5.0], 1), (0.5, [400.0, 50.0, 60.0, 70.0], 4)],
)
def test_jacobians_are_recomputed_while_that_helps_a_filter_that_lacks_forces(
    monkeypatch, force, gains, expected
):
    """Forces are in units of typical ones."""
    motions = []

    def linearise(evaluator, theta, noise, run, trajectory, neighbour):
        assert neighbour is None, "no Jacobian of another motion is reused"
        motions.append(trajectory)

    def make_filter(number, log_likelihood):
        return SimpleNamespace(
            number=number, log_likelihood=log_likelihood, force=np.array([0.01, force]),
            typical=np.ones(2), trajectories=[f"motion {number}"], noise=None, is_on_ground=False,
            evaluator=None, theta=None, _filter_linear=lambda *_: remaining.pop(0),
        )  # fmt: skip

    levels = 1000.0 + np.cumsum([0.0, *gains])
    first, *remaining = [make_filter(i, level) for i, level in enumerate(levels)]
    monkeypatch.setattr(linearised_filter, "linearise_run", linearise)
    assert FollowedRuns.recompute_jacobians(first).number == expected
    assert motions == [f"motion {i}" for i in range(len(gains))]


@pytest.mark.slow
def test_a_damping_is_reported_with_that_of_the_servo_that_acts_alike(tmp_path):
    """A servo that reaches its limit at the first step of a simulation chatters there for ever."""
    answer = explain(write_recording(tmp_path, "dof_damping", 2, 3.0, seed=4), jobs=1).answer
    (cause,) = answer.causes
    assert {cause.effect, *cause.alternatives} == {"drag.linear@elbow", "actuator.damping@m_elbow"}
    size = {"drag.linear@elbow": 2.0, "actuator.damping@m_elbow": 0.02}[cause.effect]
    assert cause.coefficients["coefficient"].value == pytest.approx(size, rel=0.01)


SERVO = """<mujoco><option timestep="0.001"/><worldbody><body>
<joint name="hinge" axis="0 1 0" damping="0.2"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="0.8"/></body></worldbody>
<actuator><position name="drive" joint="hinge" kp="20" kv="0.7" gear="3"/></actuator></mujoco>"""


SERVO_DAMPING, JOINT_DAMPING = "actuator.damping@drive", "drag.linear@hinge"


@pytest.fixture
def servo_evaluator(tmp_path):
    """Return the run of a servo with a gear, at rest."""
    times = 0.01 * np.arange(100)
    units = {"u.drive": "rad", "q.hinge": "rad"}
    description = describe(units, NOISE)
    rest = [(times, np.zeros((100, 2)))]
    path = write_log(tmp_path, description, "u.drive,q.hinge", rest, arm=SERVO)
    recording, kind = load_joined([path])
    evaluator = RunEvaluator(kind, recording, recording.training(), kind.default_engine)
    yield evaluator
    evaluator.close()


@pytest.mark.parametrize("name", [JOINT_DAMPING, SERVO_DAMPING])
def test_a_servo_brakes_its_joint_as_the_damping_that_acts_alike(servo_evaluator, name):
    ((other, coefficients),) = list_similar_dampings(servo_evaluator, name, np.array([0.35]))
    changes = {name: 0.35, other: float(coefficients[0])}
    forces = []
    for damping, servo in ((changes[JOINT_DAMPING], 0.0), (0.0, changes[SERVO_DAMPING])):
        model = mujoco.MjModel.from_xml_string(SERVO)
        model.dof_damping[0] += damping
        model.actuator_biasprm[0, 2] *= 1.0 + servo
        data = mujoco.MjData(model)
        data.qvel[0] = 1.7
        mujoco.mj_forward(model, data)
        forces.append(data.qfrc_passive[0] + data.qfrc_actuator[0])
    assert forces[0] == pytest.approx(forces[1], rel=1e-12)
    assert forces[0] < -1.7 * 0.2


def test_other_effects_have_no_similar_damping(servo_evaluator, example_arm):
    for name in ("inertia.armature@hinge", "actuator.stiffness@drive"):
        assert list_similar_dampings(servo_evaluator, name, np.array([0.1])) == []
    # Motors without feedback have no damping.
    assert list_similar_dampings(example_arm, "drag.linear@elbow", np.array([0.1])) == []
