"""What a rig may be made to do: plans in its own terms, and its limits, by simulation."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from bench.gap.model.world import World
from bench.gap.rig.limits import FASTER, Limits
from bench.gap.rig.plans import Plan, Rig
from bench.registry import robot
from sims.base import Scenario
from sims.recording.recording import Recording, Run
from sims.servo.simulator import Servo

TIMES = np.arange(100) / 50.0
URDF = """<robot name="arm"><link name="base"/>
<link name="leg"><inertial><origin xyz="0 0 -0.5"/><mass value="1"/>
<inertia ixx="0.1" iyy="0.1" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="foot"><inertial><origin xyz="0 0 -0.2"/><mass value="0.2"/>
<inertia ixx="0.01" iyy="0.01" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hip" type="revolute"><parent link="base"/><child link="leg"/><axis xyz="0 1 0"/>
<limit lower="-1.5" upper="1.5" effort="30" velocity="SPEED"/><dynamics damping="0.5"/></joint>
<joint name="knee" type="continuous"><parent link="leg"/><child link="foot"/><axis xyz="0 1 0"/>
<origin xyz="0 0 -1"/><limit effort="0" velocity="0"/><dynamics damping="0.3"/></joint></robot>
"""


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """A function of the hip's fastest speed: the world of a run in which it swings gently, of which
    positions alone are recorded.
    """
    folder = tmp_path_factory.mktemp("arm")

    def made(speed):
        path = folder / f"arm{speed:g}.urdf"
        path.write_text(URDF.replace("SPEED", f"{speed:g}"))
        actuators = {"m": {"joint": "hip", "kind": "motor"}}
        kind = robot(path, actuators=actuators)
        inputs = {c.name: np.zeros(TIMES.size) for c in kind.inputs}
        inputs["u.m"] = 1.5 * np.sin(3 * TIMES)
        simulator = kind(observe=["q.hip", "q.knee"])
        seen = simulator.simulate(np.empty((1, 0)), Scenario(TIMES, {}, inputs))[0]
        channels = dict(zip(("q.hip", "q.knee"), seen.T, strict=True))
        run = Run("1", TIMES, channels, inputs, {}, {}, held_out=False)
        recording = Recording(Path("x.csv"), kind.name, "", {}, {}, (run,))
        world = World(kind, recording, (run,), None, candidates=())
        fit = SimpleNamespace(theta=world.nominal(), states=world.guess)
        return world, SimpleNamespace(fit=fit, names=())

    return made


def pushes(rig, size):
    return rig.run(Plan(("u.m",), "slow sine", size))


def test_a_speed_that_the_file_states_is_kept_though_nobody_recorded_it(arm):
    world, model = arm(9.0)
    assert world.kind.robot.speeds == {"hip": 9.0}
    rig, limits = Rig(world, 2.0), Limits(world, model)
    assert limits.bounds["qd.hip"] == (-9.0, 9.0)
    gentle, strong = pushes(rig, 1.0), pushes(rig, 1.5)
    assert limits(model, [gentle, strong]) == [True, True]
    fastest = np.abs(limits._seen(model, [strong.scenario], strong.states[None])[0]["qd.hip"]).max()
    slower, same = arm(0.9 * fastest)
    assert Limits(slower, same)(same, [strong]) == [False]


def test_what_nothing_states_is_as_fast_and_as_strong_as_it_was(arm):
    world, model = arm(0.0)
    limits, rig = Limits(world, model), Rig(world, 2.0)
    past = limits.past[0]
    assert limits.bounds["qd.hip"][1] == pytest.approx(FASTER * np.abs(past["qd.hip"]).max())
    assert limits.bounds["tau.hip"] == (-30.0, 30.0)
    assert limits.bounds["q.hip"] == (-1.5, 1.5)
    assert limits(model, [pushes(rig, 1.0), pushes(rig, 40.0)]) == [True, False]


def test_commands_keep_to_what_joints_take(arm):
    world, _ = arm(9.0)
    rig = Rig(world, 2.0)
    assert rig.limits.commands["force.hip"] == (-30.0, 30.0)
    assert np.abs(rig._limited("force.hip", np.array([-50.0, 7.0]))).max() == 30.0


@pytest.fixture(scope="module")
def servo():
    """The rig of a servo with two loads."""
    runs = tuple(
        Run(
            str(mass), TIMES, {"q": 0.3 * np.sin(TIMES)},
            {"goal": 0.4 * np.sin(TIMES), "torque_enable": np.ones(TIMES.size)},
            {"mass": mass}, {}, held_out=False,
        )
        for mass in (0.1, 0.3)
    )  # fmt: skip
    recording = Recording(Path("x.csv"), "servo", "", {}, {}, runs)
    return Rig(World(Servo, recording, runs, "batch", candidates=()), 4.0)


def test_loads_that_were_there_can_be_had_again(servo):
    plan = Plan(("goal",), "slow sine")
    loads = {dict(one.constants)["mass"] for one in servo.variants(plan) if one.constants}
    assert loads == {0.1, 0.3}
    other = servo.run(Plan(("goal",), "slow sine", constants=(("mass", 0.3),)))
    assert other.scenario.constants["mass"] == 0.3
    assert other.says.endswith("with mass = 0.3")
    # What was the same all the time is no knob: torque is on, and stays on.
    assert {name for one in servo.basic() for name in one.driven} == {"goal"}
    assert (other.scenario.inputs["torque_enable"] == 1.0).all()


def test_commands_have_their_form_their_level_and_their_rate(servo):
    def goal(plan):
        run = servo.run(plan)
        return run.scenario.times, run.scenario.inputs["goal"] - servo.rest["goal"]

    most = servo.largest["goal"]
    _, ramp = goal(Plan(("goal",), "ramps up and down", 2.0))
    assert np.abs(ramp).max() == pytest.approx(2.0 * most, rel=0.02)
    assert np.abs(np.diff(ramp)).max() == pytest.approx(8.0 * most / 199, rel=0.01)
    _, holds = goal(Plan(("goal",), "holds"))
    assert np.unique(holds / most).round(9).tolist() == [-1.0, -0.5, 0.0, 0.25, 0.5, 1.0]
    times, push = goal(Plan(("goal",), "a push, then let go", level=0.5))
    assert push[times > 1.0] == pytest.approx(0.5 * most)
    assert push[0] == pytest.approx(1.5 * most)
    coarse, _ = goal(Plan(("goal",), "holds", coarser=4))
    assert np.diff(coarse) == pytest.approx(0.08)
    assert len(coarse) == 50
