"""Tests of run plans and of the limits of an experimental setup, by simulation."""

from pathlib import Path

import numpy as np
import pytest

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.experiment_design.candidate_runs import RigModel, RunPlan
from bench.diagnosis.experiment_design.safety_limits import SPEED_AND_FORCE_FACTOR, RigLimits
from sims.recording.recording import Recording, Run
from sims.systems.servo import Servo
from tests.bench.diagnosis.experiment_design.test_model_file_limits import (
    MOTOR,
    TIMES,
    kind_of,
    world_of,
)

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
    """Return a function from the speed limit of the hip to a run evaluator and a model.

    Only positions of a gently swinging arm are recorded.
    """
    folder = tmp_path_factory.mktemp("arm")

    def make_arm(speed):
        text = URDF.replace("SPEED", f"{speed:g}")
        kind = kind_of(folder, text, f"arm{speed:g}.urdf", actuators=MOTOR)
        return world_of(kind, 1.5 * np.sin(3 * TIMES))

    return make_arm


def pushes(rig, size):
    return rig.make_run(RunPlan(("u.m",), "slow sine", size))


def test_a_speed_that_the_file_states_is_kept_though_nobody_recorded_it(arm):
    evaluator, model = arm(9.0)
    assert evaluator.kind.robot.speeds == {"hip": 9.0}
    rig, limits = RigModel(evaluator, 2.0), RigLimits(evaluator, model)
    assert limits.bounds["qd.hip"] == (-9.0, 9.0)
    gentle, strong = pushes(rig, 1.0), pushes(rig, 1.5)
    assert limits(model, [gentle, strong]) == [True, True]
    fastest = np.abs(
        limits._simulate_monitored_channels(model, [strong.scenario], strong.states[None])[0][
            "qd.hip"
        ]
    ).max()
    slower, same = arm(0.9 * fastest)
    assert RigLimits(slower, same)(same, [strong]) == [False]


def test_what_nothing_states_is_as_fast_and_as_strong_as_it_was(arm):
    evaluator, model = arm(0.0)
    limits, rig = RigLimits(evaluator, model), RigModel(evaluator, 2.0)
    past = limits.present_runs[0]
    assert limits.bounds["qd.hip"][1] == pytest.approx(
        SPEED_AND_FORCE_FACTOR * np.abs(past["qd.hip"]).max()
    )
    assert limits.bounds["tau.hip"] == (-30.0, 30.0)
    assert limits.bounds["q.hip"] == (-1.5, 1.5)
    assert limits(model, [pushes(rig, 1.0), pushes(rig, 40.0)]) == [True, False]


def test_commands_keep_to_what_joints_take(arm):
    evaluator, _ = arm(9.0)
    rig = RigModel(evaluator, 2.0)
    assert rig.limits.commands["force.hip"] == (-30.0, 30.0)
    rig.median_commands["force.hip"] = -50.0
    assert (rig.make_run(RunPlan()).scenario.inputs["force.hip"] == -30.0).all()


@pytest.fixture(scope="module")
def servo():
    """Return the experimental setup of a servo with two loads."""
    runs = tuple(
        Run(
            str(mass), TIMES, {"q": 0.3 * np.sin(TIMES)},
            {"goal": 0.4 * np.sin(TIMES), "torque_enable": np.ones(TIMES.size)},
            {"mass": mass}, {}, held_out=False,
        )
        for mass in (0.1, 0.3)
    )  # fmt: skip
    recording = Recording(Path("x.csv"), "servo", "", {}, {}, runs)
    return RigModel(RunEvaluator(Servo, recording, runs, "batch", candidates=()), 4.0)


def test_loads_that_were_there_can_be_had_again(servo):
    plan = RunPlan(("goal",), "slow sine")
    loads = {dict(one.constants)["mass"] for one in servo.list_variants(plan) if one.constants}
    assert loads == {0.1, 0.3}
    other = servo.make_run(RunPlan(("goal",), "slow sine", constants=(("mass", 0.3),)))
    assert other.scenario.constants["mass"] == 0.3
    assert other.says.endswith("with mass = 0.3")
    # A constant input is not driven: the torque is on and stays on.
    assert {name for one in servo.list_basic_plans() for name in one.driven_inputs} == {"goal"}
    assert (other.scenario.inputs["torque_enable"] == 1.0).all()


def test_commands_have_their_form_their_level_and_their_rate(servo):
    def goal(plan):
        run = servo.make_run(plan)
        return run.scenario.times, run.scenario.inputs["goal"] - servo.median_commands["goal"]

    most = servo.largest_commands["goal"]
    _, ramp = goal(RunPlan(("goal",), "ramps up and down", 2.0))
    assert np.abs(ramp).max() == pytest.approx(2.0 * most, rel=0.02)
    assert np.abs(np.diff(ramp)).max() == pytest.approx(8.0 * most / 199, rel=0.01)
    _, holds = goal(RunPlan(("goal",), "holds"))
    assert np.unique(holds / most).round(9).tolist() == [-1.0, -0.5, 0.0, 0.25, 0.5, 1.0]
    times, push = goal(RunPlan(("goal",), "a push, then zero input", level=0.5))
    assert push[times > 1.0] == pytest.approx(0.5 * most)
    assert push[0] == pytest.approx(1.5 * most)
    coarse, _ = goal(RunPlan(("goal",), "holds", hold_factor=4))
    assert np.diff(coarse) == pytest.approx(0.08)
    assert len(coarse) == 50
