"""Tests of joints with compliance, backlash or hysteresis: closed forms, initial states,
linearisation, and the written file.
"""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sims.core.simulator import Scenario
from sims.extended_simulator import FittedValue
from sims.robot.dynamics.linearisation_about_simulation import RunLinearisation
from sims.robot.export.apply_causes import apply_causes
from sims.robot.export.write_model_file import write_model_files
from sims.robot.robot_model import RobotModel
from sims.robot.robot_simulator import make_robot_simulator
from tests.sims.robot.sample_arms import ARM, write_and_check
from tests.sims.robot.sample_arms import robot as arm

DRIVE, LINK = 0.02, 0.08  # kg m^2
WHEEL = f"""
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="RK4" gravity="0 0 -9.81"/>
  <worldbody>
    <body>
      <joint name="axle" axis="0 0 1" armature="{DRIVE}"/>
      <inertial pos="0 0 0" mass="1" diaginertia="{LINK} {LINK} {LINK}"/>
    </body>
  </worldbody>
  <actuator><motor name="m_axle" joint="axle"/></actuator>
</mujoco>
"""
TIMES = np.arange(101) / 100.0
STIFF = 30.0  # N m/rad


def make_simulator(text, **given):
    spec = mujoco.MjSpec.from_string(text)
    return make_robot_simulator(RobotModel(Path("robot.xml"), "mjcf", spec, digest=text, **given))


def moved(kind, effects, coefficients, scenario, observe=("q.axle",)):
    """Return (T, C) of one batch element; coefficients are concatenated."""
    simulator = kind(observe=list(observe), effects=list(effects))
    return simulator.simulate(np.array([coefficients]), scenario)[0]


def pushed(torque, times=TIMES):
    return Scenario(times, {}, {"u.m_axle": np.full(times.size, torque)})


def test_the_drive_that_a_file_does_not_state_is_a_number():
    """With a drive inertia of J = 0.25 M the common motion is that of 1.25 M."""
    kind = make_simulator(WHEEL.replace(f'armature="{DRIVE}"', ""))
    names = [c.name for c in kind.system.effect("joint.flexibility@axle").coefficients]
    assert names == ["compliance", "damping", "rotor"]
    seen = moved(kind, ["joint.flexibility@axle"], [1 / STIFF, 0.2, 0.25], pushed(0.5))[:, 0]
    slope = np.polyfit(TIMES[60:], np.gradient(seen, TIMES)[60:], 1)[0]
    assert slope == pytest.approx(0.5 / (1.25 * LINK), rel=2e-3)
    stated = make_simulator(WHEEL).system.effect("joint.flexibility@axle").coefficients
    assert [c.name for c in stated] == ["compliance", "damping"], "the armature is the drive's"


PENDULUM = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body>
      <joint name="axle" axis="0 1 0" armature="0.02"/>
      <inertial pos="0.3 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
    </body>
  </worldbody>
  <actuator><position name="m_axle" joint="axle" kp="60" kv="3"/></actuator>
</mujoco>
"""


@pytest.mark.parametrize(
    ("effects", "c"),
    [
        (["joint.flexibility@axle"], [0.003, 0.05]),
        (["joint.backlash@axle"], [0.01]),
        (["joint.backlash@axle", "joint.flexibility@axle"], [0.01, 0.003, 0.05]),
    ],
)
def test_links_load_their_springs_and_flanks_when_a_run_begins(effects, c):
    """A servo that holds the weight of the link keeps it at rest."""
    held = {"u.m_axle": np.full(TIMES.size, -9.81 * 0.3 / 60.0)}
    seen = moved(make_simulator(PENDULUM), effects, c, Scenario(TIMES, {}, held))
    # Without initial deflection the link would fall by about 5 mrad.
    np.testing.assert_allclose(seen, 0.0, atol=2e-4)


PLANAR = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.0005" integrator="RK4" gravity="0 0 -9.81"/>
  <worldbody>
    <body>
      <joint name="shoulder" axis="0 0 1"/>
      <inertial pos="0.2 0 0" mass="1.5" diaginertia="0.02 0.02 0.02"/>
      <body pos="0.4 0 0">
        <joint name="elbow" axis="0 0 1" armature="0.02"/>
        <inertial pos="0.15 0 0" mass="0.8" diaginertia="0.008 0.008 0.008"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="m_elbow" joint="elbow"/></actuator>
</mujoco>
"""
GIVES, RATIO, GAP = 0.02, 0.1, 0.06  # rad/(N m), fraction of critical damping, rad


def through(deflection, speed, stiffness, damping, gap):
    """Return the transmitted torque: gap first, then spring and damper; the flanks push and never
    pull.
    """
    beyond = deflection - min(max(deflection, -gap / 2), gap / 2)
    force = stiffness * beyond + damping * speed
    if gap == 0.0:
        return force
    return max(force, 0.0) if beyond > 0 else min(force, 0.0) if beyond < 0 else 0.0


def planar(times, torque, gap, compliance=GIVES):
    """Return (T, 2) joint angles of the arm from SciPy, the elbow's on the drive side; it starts at
    rest.
    """
    moved = 0.008 + 0.8 * 0.15**2
    stiffness = 1 / compliance
    # With the inertias that the file states for the joint: links and drive.
    damping = 2 * RATIO * np.sqrt(stiffness * (moved + 0.02))

    def rates(t, s):
        _, y, x, first, link, drive = s
        cosine, sine = 0.8 * 0.4 * 0.15 * np.cos(y), 0.8 * 0.4 * 0.15 * np.sin(y)
        far = moved + cosine
        near = 0.02 + 1.5 * 0.2**2 + 0.8 * 0.4**2 + moved + 2 * cosine
        passed = through(x - y, drive - link, stiffness, damping, gap)
        pulls = sine * (2 * first * link + link**2), passed - sine * first**2
        bends = np.linalg.solve([[near, far], [far, moved]], pulls)
        return [first, link, drive, *bends, (torque(t) - passed) / 0.02]

    given = {"rtol": 1e-8, "atol": 1e-10, "max_step": 1e-3, "t_eval": times}
    state = solve_ivp(rates, (0, times[-1]), np.zeros(6), **given).y
    return state[[0, 2]].T


def test_a_gap_before_a_spring_moves_an_arm_as_scipy_does():
    """Both form one element: no torque within the gap, spring and damper behind it."""
    times = np.arange(81) / 100.0
    run = Scenario(times, {}, {"u.m_elbow": np.where(times < 0.4, 0.6, -0.6)})
    spring, play, both = (
        "joint.flexibility@elbow",
        "joint.backlash@elbow",
        ("q.shoulder", "q.elbow"),
    )
    seen = moved(make_simulator(PLANAR), [spring, play], [GIVES, RATIO, GAP], run, both)
    turned = moved(make_simulator(PLANAR), [play, spring], [GAP, GIVES, RATIO], run, both)
    np.testing.assert_array_equal(seen, turned)
    exact, flexible, loose = (
        planar(times, lambda t: 0.6 if t < 0.4 else -0.6, *one)
        for one in ((GAP,), (0.0,), (GAP, GIVES / 100))
    )
    np.testing.assert_allclose(seen, exact, atol=1e-4)
    for alone in (flexible, loose):
        assert np.abs(alone - exact).max() > 0.02


SWUNG = Scenario(
    np.arange(61) / 100.0,
    {"q.elbow": 0.3, "qd.shoulder": 0.5},
    {"u.m_elbow": 0.4 * np.sin(9.0 * np.arange(61) / 100.0)},
)


def about(kind, effects, c):
    """Return a simulator with the effects, its parameters, and the linearisation about its
    motion.
    """
    simulator = kind(observe=["q.shoulder", "q.elbow", "qd.elbow"], effects=list(effects))
    theta = np.array(c)
    x, v = np.array([0.0, 0.3, 0.0]), np.array([0.5, 0.0, 0.0])
    return simulator, theta, RunLinearisation(simulator, theta, SWUNG, x, v)


@pytest.mark.parametrize(
    ("effect", "c"),
    [
        ("joint.flexibility@elbow", (0.02, 0.1, 0.3)),
        ("friction.hysteresis@elbow", (0.1, 0.05)),
        ("friction.hysteresis@shoulder", (0.6, 0.03)),
    ],
)
def test_the_tangent_about_such_a_motion_is_that_of_the_simulation(effect, c):
    kind = make_simulator(ARM.replace('frictionloss="0.05"', ""))
    others = {"force.bias@elbow": 1e-4, "drag.linear@shoulder": 1e-4}
    simulator, theta, linear = about(kind, [effect, *others], [*c, 0.0, 0.0])
    added = [(simulator.effects[1 + k], np.array([d])) for k, d in enumerate(others.values())]
    found, _ = linear.compute_effect_responses(added)
    lanes = np.tile(theta, (3, 1))
    for k, size in enumerate(others.values()):
        lanes[1 + k, len(c) + k] = size
    seen = simulator.simulate(lanes, SWUNG)
    for response, other in zip(found, seen[1:], strict=True):
        exact = other - seen[0]
        error = np.abs(response - exact).max(axis=0) / np.abs(exact).max()
        assert error.max() < 0.05, effect
    begun = linear.compute_initial_state_responses()
    nudged = Scenario(SWUNG.times, {**SWUNG.initial, "q.elbow": 0.3 + 1e-5}, SWUNG.inputs)
    exact = (simulator.simulate(theta[None], nudged)[0] - seen[0]) / 1e-5
    # The initial deflection of links changes with their pose; the tangent neglects this.
    assert np.abs(begun[1] - exact).max() < 0.1 * np.abs(exact).max()


def test_what_such_effects_change_is_what_the_simulation_shows():
    kind = make_simulator(ARM.replace('frictionloss="0.05"', ""))
    effects = ["joint.flexibility@elbow", "joint.backlash@shoulder", "friction.hysteresis@elbow"]
    sizes = [np.array([0.02, 0.1, 0.3]), np.array([0.01]), np.array([1e-4, 0.05])]
    simulator, theta, linear = about(kind, effects, np.zeros(6))
    found, _ = linear.compute_effect_responses(list(zip(simulator.effects, sizes, strict=True)))
    begin = 0
    for k, c in enumerate(sizes):
        lanes = np.tile(theta, (2, 1))
        lanes[1, begin : begin + c.size] = c
        begin += c.size
        plain, other = simulator.simulate(lanes, SWUNG)
        exact = other - plain
        close = 1e-9 if k < 2 else 0.02 * np.abs(exact).max()
        np.testing.assert_allclose(found[k], exact, atol=close, err_msg=effects[k])


def number(value):
    return FittedValue(value, "1", None, None)


CAUSES = {
    "joint.flexibility@elbow": {
        "compliance": number(0.02), "damping": number(0.05), "rotor": number(0.3)
    },
    "joint.backlash@shoulder": {"gap": number(0.02)},
    "mass.scale@fore": {"coefficient": number(0.1)},
}  # fmt: skip


WITH_BACKLASH = {**CAUSES, "joint.backlash@elbow": {"gap": number(0.02), "rotor": number(0.0)}}


def test_a_file_holds_joints_in_series_and_moves_as_the_simulator_does(tmp_path):
    robot = arm(tmp_path)
    done = write_and_check(robot, CAUSES)
    assert "the elbow is the one that wears" in done.xml, "it stays its author's"
    assert done.xml.count("fitted to log.csv") == 4
    model = mujoco.MjSpec.from_string(done.xml).compile()
    assert model.joint("elbow_flexibility").stiffness[0] == pytest.approx(50.0)
    assert model.joint("shoulder_backlash").range == pytest.approx([-0.01, 0.01])


def test_a_file_holds_a_gap_before_a_spring_as_flanks_that_give(tmp_path):
    robot = arm(tmp_path)
    done = write_and_check(robot, WITH_BACKLASH)
    model = mujoco.MjSpec.from_string(done.xml).compile()
    joint = model.joint("elbow_transmission")
    assert joint.range == pytest.approx([-0.01, 0.01])
    inverse = model.dof_invweight0[joint.dofadr[0]]
    assert model.jnt_solref[joint.id, 0] == pytest.approx(-50.0 * inverse)


@pytest.mark.parametrize("causes", [CAUSES, WITH_BACKLASH], ids=["spring", "gap before it"])
def test_a_rollout_of_the_file_moves_as_the_simulator_does(tmp_path, causes):
    """Without gravity, elements in series have equal initial states in simulator and file."""
    robot = arm(tmp_path, ARM.replace("0 0 -9.81", "0 0 0"))
    model = mujoco.MjSpec.from_string(write_model_files(robot, causes).xml).compile()
    data = mujoco.MjData(model)
    data.ctrl[:2] = 0.1, 0.3
    rows = []
    for _ in range(50):
        rows.append([data.joint(name).qpos[0] for name in ("shoulder", "elbow")])
        mujoco.mj_step(model, data, 10)
    simulator = make_robot_simulator(robot)(observe=["q.shoulder", "q.elbow"], effects=list(causes))
    lane = np.array([[n.value for cause in causes.values() for n in cause.values()]])
    pushed = {"u.m_shoulder": np.full(50, 0.1), "u.m_elbow": np.full(50, 0.3)}
    seen = simulator.simulate(lane, Scenario(TIMES[:50], {}, pushed))[0]
    np.testing.assert_allclose(seen, rows, atol=1e-9)
    assert np.ptp(seen, axis=0).min() > 0.02


def test_keyframes_that_lack_coordinates_are_left_out_and_said(tmp_path):
    text = ARM.replace("</mujoco>", '<keyframe><key qpos="0 0.1 0"/></keyframe></mujoco>')
    applied = apply_causes(arm(tmp_path, text), CAUSES)
    assert applied.model.nkey == 0
    assert any(line.startswith("keyframes are left out") for line in applied.notes)


def test_a_spring_behind_a_drive_that_was_found_before_takes_its_inertia_over():
    """An armature identified before becomes the rotor inertia, and the given rotor coefficient is
    ignored. An almost rigid spring therefore hardly changes the motion.
    """
    kind = make_simulator(WHEEL.replace(f'armature="{DRIVE}"', ""))
    run = Scenario(TIMES, {}, {"u.m_axle": 0.4 * np.sin(9.0 * TIMES)})
    names = ["inertia.armature@axle", "joint.flexibility@axle"]
    simulator = kind(observe=["q.axle"], effects=names)
    spring = simulator.effects[1]
    theta = np.array([DRIVE, 0.0, 0.0, 0.0])
    about = RunLinearisation(simulator, theta, run, np.zeros(1), np.zeros(1))
    sizes = [np.array([c, 0.05, 0.5]) for c in (1 / STIFF, 1e-4 / STIFF)]
    (given, slight), _ = about.compute_effect_responses([(spring, c) for c in sizes])
    lanes = np.array([theta, [0.0, 1 / STIFF, 0.05, DRIVE / LINK]])
    plain, other = simulator.simulate(lanes, run)
    np.testing.assert_allclose(given, other - plain, atol=1e-9)
    assert np.abs(slight).max() < 0.01 * np.abs(given).max()
    np.testing.assert_array_equal(sizes[0], [1 / STIFF, 0.05, 0.5], "nobody's numbers are changed")
    taken = spring.taking(sizes[0], "inertia.armature@axle", np.array([DRIVE]))
    assert taken == pytest.approx([1 / STIFF, 0.05, DRIVE / LINK])
