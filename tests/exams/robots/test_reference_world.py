"""Tests of the reference world against closed-form solutions and against MuJoCo."""

import numpy as np
import pytest

from sims.core.simulator import Scenario
from sims.robot.parsing.read_model_file import read_robot
from sims.robot.robot_simulator import make_robot_simulator
from tests.exams.robots import exam_robots, robot_models
from tests.exams.robots.exam_robots import Drive, Machine
from tests.exams.robots.reference_plant import Cogging
from tests.exams.robots.reference_world import Run, World, _Course, held

pytest.importorskip("pinocchio", reason="pin has no wheel here")
STAMPS = np.arange(401) / 100
ROLLER = robot_models.urdf(
    "roller",
    robot_models.link("disc", 2.0, (0, 0, 0), (0.1, 0.1, 0.4)),
    robot_models.joint("axle", "revolute", "base", "disc", (0, 0, 0), "0 0 1", (-100, 100, 50)),
)


def roll(effects, command=0.0, speed=0.0):
    """Return the motion of a disc on a vertical axle, with its initial speed and a torque.

    Its inertia is 0.4 kg m^2, and gravity has no effect.
    """
    disc = Machine("roller", ROLLER, (Drive("axle", "motor", 30.0, 3.0, 50.0),), (0.0,))
    commands = {"m_axle": np.broadcast_to(command, STAMPS.shape)}
    run = Run(STAMPS, commands, np.zeros(1), np.array([speed]))
    return World(disc, effects).move(run, STAMPS)


def driven(machine, amplitude, frequency=3.0, stamps=STAMPS):
    """Return a run with sinusoidal commands around the values that hold the pose."""
    pose = np.array(machine.pose)
    hold = World(machine).plant.needed(pose, 0 * pose)
    commands = {}
    for joint, drive in zip(machine.driven, machine.drives, strict=True):
        middle = pose[joint] + hold[joint] / drive.kp if drive.kp else hold[joint]
        commands[drive.name] = middle + amplitude * np.sin(frequency * stamps + joint)
    return Run(stamps, commands, pose, 0 * pose)


def test_friction_holds_exactly_below_its_limit_and_breaks_loose_above_it():
    pull = np.where(STAMPS < 2.0, 0.4999, 0.75)
    motion = roll({"friction.coulomb@axle": (0.5,)}, pull)
    held_still = STAMPS <= 2.0
    assert np.all(motion.q[held_still, 0] == 0.0)
    expected = (0.75 - 0.5) / 0.4 * (STAMPS[-1] - 2.0) ** 2 / 2
    assert motion.q[-1, 0] == pytest.approx(expected, rel=1e-9)


def test_friction_of_coupled_joints_is_the_solution_of_its_complementarity_problem():
    rng = np.random.default_rng(0)
    for _ in range(20):
        root = rng.normal(size=(6, 6))
        coupling, free = root @ root.T + 0.3 * np.eye(6), 3.0 * rng.normal(size=6)
        limits = rng.uniform(0.0, 2.0, 6)
        forces, pulls = held(coupling, free, limits)
        inside = np.abs(forces) < limits
        np.testing.assert_allclose(pulls[inside], 0.0, atol=1e-10)
        assert np.all(forces[~inside] * pulls[~inside] <= 1e-12)
        assert np.all(np.abs(forces) <= limits)


def test_joints_that_stick_together_in_an_arm_do_not_creep():
    machine = robot_models.machine("arm2-motor", np.random.default_rng(1))
    effects = {f"friction.coulomb@{name}": (5.0,) for name in machine.joints}
    motion = World(machine, effects).move(driven(machine, 1.0), STAMPS)
    assert np.ptp(motion.q, axis=0).tolist() == [0.0, 0.0]


@pytest.mark.parametrize("name", ["arm2-motor", "cartpole-motor", "ur5-servo", "iiwa-servo"])
def test_a_clean_robot_moves_as_mujoco_says_at_a_tenth_of_its_step(name):
    machine = robot_models.machine(name, np.random.default_rng(5))
    run = driven(machine, 0.2, stamps=np.arange(201) / 100)
    expected, _ = exam_robots.moved(machine, run, step=2e-4, integrator="RK4")
    np.testing.assert_allclose(World(machine).move(run, run.times).q, expected, atol=1e-4)
    assert np.ptp(expected, axis=0).max() > 0.03


def test_halving_the_step_changes_nothing_that_a_sensor_sees():
    machine = robot_models.machine("panda-servo", np.random.default_rng(2))
    effects = {"friction.coulomb@panda_joint2": (3.0,), "friction.coulomb@panda_joint4": (1.0,)}
    run = driven(machine, 0.2, stamps=np.arange(101) / 100)
    first, second = (World(machine, effects, step=h).move(run, run.times).q for h in (1e-3, 5e-4))
    np.testing.assert_allclose(first, second, atol=1e-6)


@pytest.mark.parametrize(
    ("effect", "c", "close"),
    [
        ("joint.flexibility@elbow", (0.02, 0.05, 0.15), 2e-3),
        ("joint.backlash@elbow", (0.01, 0.15), 0.03),
        ("friction.hysteresis@elbow", (0.02, 0.03), 3e-3),
        ("friction.coulomb@elbow", (0.3,), 1e-4),
        ("friction.position@elbow", (0.1, 0.1, -0.15, 1.3), 1e-4),
        ("friction.load@elbow", (0.2,), 1e-4),
        ("friction.load_direction@elbow", (0.3, 0.1), 1e-4),
        ("friction.load_quadratic@elbow", (0.1, 0.05), 1e-4),
        ("friction.warming@elbow", (0.3, 0.2, 0.9), 1e-4),
        ("inertia.armature@elbow", (0.1,), 1e-6),
        ("mass.scale@elbow_link", (0.2,), 1e-6),
        ("mass.offset@elbow_link", (0.01, 0.0, -0.02), 1e-6),
        ("input.delay@m_elbow", (0.105,), 1e-5),
        ("input.gain@m_elbow", (0.5,), 1e-6),
        ("input.deadband@m_elbow", (0.3,), 1e-6),
        ("input.lag@m_elbow", (0.1,), 1e-5),
    ],
)
def test_the_library_agrees_with_the_reference_world(effect, c, close, tmp_path):
    """The library agrees with the reference world for the second joint of an arm.

    The difference is given as a fraction of the change that the effect causes.
    """
    machine = robot_models.machine("arm2-motor", np.random.default_rng(5))
    off, changed = differs(machine, effect, c, 0.5, tmp_path)
    assert changed > 1e-3
    assert off < close


@pytest.mark.parametrize("robot", ["arm2-motor", "arm2-servo", "ur5-servo"])
@pytest.mark.parametrize(
    ("effect", "c", "close"),
    [("joint.coupling", -0.3, 1e-3), ("supply.sag", 0.02, 0.03), ("supply.braking", 0.5, 0.11)],
)
def test_drives_of_the_library_agree_with_the_reference_world(robot, effect, c, close, tmp_path):
    """The library agrees with the reference world for coupling, a shared battery and braking loss.

    The tolerances are larger where the library uses values of the previous step, which is accurate
    to first order in the step length.
    """
    machine = robot_models.machine(robot, np.random.default_rng(5))
    last = {"joint.coupling": machine.joints[-1], "supply.braking": machine.drives[-1].name}
    place = f"@{last[effect]}" if effect in last else ""
    moves = 0.5 if robot.endswith("motor") else 0.2
    off, changed = differs(machine, effect + place, (c,), moves, tmp_path)
    assert changed > 1e-4
    assert off < close


def differs(machine, name, c, moves, folder):
    """Compare the library with the reference world.

    Returns:
        The difference of the motions as a fraction of the effect's change, and the RMS change.
    """
    run = driven(machine, moves, stamps=np.arange(101) / 100)
    bare, hidden = (World(machine, of).move(run, run.times).q for of in ({}, {name: c}))
    (folder / "robot.urdf").write_text(machine.urdf)
    kind = make_robot_simulator(read_robot(folder / "robot.urdf", **machine.description))
    simulator = kind(observe=[f"q.{joint}" for joint in machine.joints], effects=[name])
    initial = {f"q.{joint}": q for joint, q in zip(machine.joints, run.q, strict=True)}
    inputs = {f"u.{drive}": u for drive, u in run.commands.items()}
    seen = simulator.simulate(np.array([c]), Scenario(run.times, initial, inputs))[0]
    changed = np.linalg.norm(hidden - bare)
    return np.linalg.norm(seen - hidden) / changed, np.sqrt(np.mean((hidden - bare) ** 2))


def test_friction_follows_the_load_of_another_drive():
    """Friction follows the heat of another joint, which grows with its work and decays in time."""
    machine = robot_models.machine("arm2-motor", np.random.default_rng(1))
    world = World(machine, {"heated": (1, 0, 0.5, 0.2, 1.0)})
    run = driven(machine, 0.5, stamps=np.arange(101) / 100)
    motion, bare = world.move(run, run.times), World(machine).move(run, run.times)
    apart = np.abs(motion.q - bare.q).max(axis=1)
    assert 100 * apart[3] < apart[-1], "it begins cold"
    power = np.abs(motion.force[:, 0] * motion.v[:, 0])
    heat = np.zeros(power.size)
    for k, step in enumerate(np.diff(run.times)):
        middle = 0.5 * (power[k] + power[k + 1]) / 0.2
        heat[k + 1] = heat[k] + step * (middle - (heat[k] + 0.5 * step * middle))
    course = _Course(world, run)
    course.through(run.times)
    assert course.state[-1] == pytest.approx(heat[-1], rel=0.05)


def test_friction_with_teeth_lags_by_half_a_tooth():
    teeth = Cogging(0, 0.3, 0.4)
    assert teeth.caught(0.0, [0.1]) == 0.0
    assert teeth.caught(0.0, [1.0]) == pytest.approx(0.8)
    assert teeth.caught(0.8, [0.5]) == pytest.approx(0.7)
    assert teeth.push(0.8, [1.0]) == pytest.approx(0.3 * np.sin(2 * np.pi * 2.0))


def test_a_binding_range_has_friction_only_within_it():
    v = roll({"binding": (0, 0.5, 3.0, 0.5)}, speed=2.0).v[:, 0]
    np.testing.assert_allclose(v[STAMPS < 1.15], 2.0, rtol=1e-5)
    # The work of friction is that over the width of the range, with soft borders too.
    assert v[-1] ** 2 == pytest.approx(4.0 - 2 * 0.5 * 1.0 / 0.4, rel=1e-4)
