"""Tests that proposed runs stay within the limits of the model file."""

from types import SimpleNamespace

import numpy as np
import pytest

import simgap
from bench.core.plugin_registries import make_robot_simulator
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.experiment_design.candidate_runs import (
    RigModel,
    RunPlan,
    _compute_largest_factor,
    iterate_changed_runs,
)
from bench.diagnosis.experiment_design.model_file_limits import UNLIMITED, read_model_file_limits
from bench.diagnosis.experiment_design.safety_limits import RigLimits
from sims.core.simulator import Scenario
from sims.recording.recording import Recording, Run
from tests.bench.diagnosis.simulated_logs import describe, write_log

TIMES = np.arange(0.0, 2.0, 0.02)
MOTOR = {"m": {"joint": "hip", "kind": "motor"}}
URDF = """<robot name="arm"><link name="base"/>
<link name="leg"><inertial><origin xyz="0 0 -0.3"/><mass value="1"/>
<inertia ixx="0.03" iyy="0.03" izz="0.003" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hip" type="revolute"><parent link="base"/><child link="leg"/><axis xyz="0 1 0"/>
<limit lower="-0.9" upper="0.9" effort="1" velocity="2.5"/><dynamics damping="0.2"/></joint></robot>
"""
MJCF = """<mujoco model="arm"><option gravity="0 0 -9.81"/><worldbody><body name="leg">
<joint name="hip" axis="0 1 0" range="-0.5 0.4" damping="0.2" armature="0.02"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03" mass="1"/></body></worldbody>
<actuator><position name="s" joint="hip" kp="20" kv="1" ctrlrange="-0.35 0.6"
forcerange="-6 6"/></actuator><compiler angle="radian"/></mujoco>
"""
MANY = """<mujoco><compiler angle="radian"/><worldbody><body name="a">
<joint name="j1" axis="0 1 0" range="-1 2" actuatorfrcrange="-2 3"/><geom size="0.1" mass="1"/>
<body name="b" pos="0 0 1"><joint name="j2" type="slide" axis="0 0 1"/><geom size="0.1"/></body>
</body></worldbody><actuator>
<motor name="m" joint="j1" gear="-2" forcerange="-10 1"/>
<general name="g" joint="j1" gainprm="0.5" ctrlrange="-1 1"/>
<position name="p" joint="j1" kp="3" gear="0.5"/>
<motor name="free" joint="j2"/>
</actuator></mujoco>"""


def kind_of(folder, text, name="arm.urdf", **options):
    """Write a model file and return its simulator class."""
    path = folder / name
    path.write_text(text)
    return make_robot_simulator(path, **options)


def simulated(kind, command, effect=None, coefficient=0.0, begin=0.0):
    """Return the positions by joint under a command of the only actuator, and all inputs."""
    (name,) = (one.name for one in kind.inputs if one.name.startswith("u."))
    inputs = {channel.name: np.zeros(TIMES.size) for channel in kind.inputs} | {name: command}
    names = list(kind.system.coordinates)
    simulator = kind(observe=names, effects=[effect] if effect else [])
    theta = np.array([[coefficient]]) if effect else np.empty((1, 0))
    seen = simulator.simulate(theta, Scenario(TIMES, {"q.hip": begin}, inputs))[0]
    return dict(zip(names, seen.T, strict=True)), inputs


def world_of(kind, command, begin=0.0):
    """Return the run evaluator of one run and a model with its true parameters."""
    seen, inputs = simulated(kind, command, begin=begin)
    run = Run("1", TIMES, seen, inputs, {}, {}, held_out=False)
    recording = RunEvaluator(
        kind, Recording("x.csv", kind.name, "", {}, {}, (run,)), (run,), None, candidates=()
    )
    fit = SimpleNamespace(
        theta=recording.get_nominal_theta(), initial_states=recording.initial_state_guesses
    )
    return recording, SimpleNamespace(fit=fit, effects=())


def log(folder, kind, effect, coefficient, size, noise):
    """Write a recording of three runs with an effect that the model file lacks."""
    rng, runs = np.random.default_rng(0), []
    for number in range(3):
        command = size * np.sin(2.0 * TIMES + number)
        seen, inputs = simulated(kind, command, effect, coefficient, 0.05 * number)
        runs.append((TIMES, command, seen["q.hip"] + noise * rng.standard_normal(TIMES.size)))
    (name,) = (one for one in inputs if one.startswith("u."))
    (unit,) = (one.unit for one in kind.inputs if one.name == name)
    tables = "".join(
        f'[actuators.{n}]\njoint = "{t["joint"]}"\nkind = "motor"\n'
        for n, t in kind.robot.actuator_tables.items()
    )
    description = describe({name: unit, "q.hip": "rad"}, noise, tables, kind.robot.path.name)
    return write_log(folder, description + "[runs.3]\nheld_out = true\n", f"{name},q.hip", runs)


def check_proposals(path, limits):
    """Check that the change that explain proposes and the designed run keep the limits."""
    proposed = simgap.design(path, jobs=1)
    experiment, design = proposed.explanation.answer.next_experiment, proposed.design
    change = {} if experiment is None else experiment.to_document().get("change") or {}
    for name, value in change.items():
        if name in limits.states:
            low, high = limits.states[name]
            assert low <= value <= high, experiment
    for name, value in design.initial.items():
        low, high = limits.states.get(name, UNLIMITED)
        assert low <= value <= high, design.says
    assert limits.commands.keys() & design.inputs.keys()
    for name in limits.commands.keys() & design.inputs.keys():
        low, high = limits.commands[name]
        assert low - 1e-9 <= design.inputs[name].min(), design.says
        assert design.inputs[name].max() <= high + 1e-9, design.says


@pytest.mark.slow
def test_torques_and_starts_keep_to_the_limits_of_a_urdf(tmp_path):
    kind = kind_of(tmp_path, URDF, actuators=MOTOR)
    path = log(tmp_path, kind, "drag.quadratic@hip", 0.06, 0.7, 0.02)
    states = {"q.hip": (-0.9, 0.9), "qd.hip": (-2.5, 2.5)}
    check_proposals(path, SimpleNamespace(commands={"u.m": (-1.0, 1.0)}, states=states))


@pytest.mark.slow
def test_set_points_keep_to_the_limits_of_an_mjcf(tmp_path):
    kind = kind_of(tmp_path, MJCF, "arm.xml")
    path = log(tmp_path, kind, "input.lag@s", 0.02, 0.3, 0.006)
    limits = SimpleNamespace(commands={"u.s": (-0.35, 0.4)}, states={"q.hip": (-0.5, 0.4)})
    check_proposals(path, limits)


def test_all_limits_of_a_urdf_are_read(tmp_path):
    kind = kind_of(tmp_path, URDF, actuators={"m": {**MOTOR["m"], "gear": 4.0}})
    evaluator, _ = world_of(kind, 0.1 * np.sin(TIMES))
    limits = read_model_file_limits(evaluator)
    assert limits.commands == {"u.m": (-0.25, 0.25), "force.hip": (-1.0, 1.0)}
    assert limits.states == {"q.hip": (-0.9, 0.9), "qd.hip": (-2.5, 2.5)}
    assert limits.forces == {"tau.hip": (-1.0, 1.0)}


def test_a_velocity_servo_keeps_to_the_velocity_of_a_urdf(tmp_path):
    servo = {"m": {"joint": "hip", "kind": "velocity", "kv": 2.0, "gear": 2.0}}
    evaluator, _ = world_of(kind_of(tmp_path, URDF, actuators=servo), 0.1 * np.sin(TIMES))
    assert read_model_file_limits(evaluator).commands["u.m"] == (-5.0, 5.0)


def test_limits_of_an_mjcf_are_those_of_joint_and_actuator_together(tmp_path):
    kind = kind_of(tmp_path, MANY, "many.xml")
    found = read_model_file_limits(SimpleNamespace(kind=kind))
    # Two motors share the force range of the joint; the first also has its own range.
    assert found.commands["u.m"] == pytest.approx((-0.75, 0.5))
    assert found.commands["u.g"] == pytest.approx((-1.0, 1.0))
    assert found.commands["u.p"] == pytest.approx((-0.5, 1.0))
    assert found.commands["force.j1"] == (-2.0, 3.0)
    assert not {"u.free", "force.j2"} & set(found.commands)
    assert found.states == {"q.j1": (-1.0, 2.0)}


def test_every_simple_run_of_a_robot_is_within_the_limits(tmp_path):
    kind = kind_of(tmp_path, URDF, actuators=MOTOR)
    # The recorded command exceeds the limits, which hold for runs with this command too.
    evaluator, _ = world_of(kind, 1.3 * np.sin(2.0 * TIMES))
    limits = read_model_file_limits(evaluator)
    runs = list(iterate_changed_runs(evaluator))
    assert len(runs) > 4
    for run in runs:
        assert np.abs(run.scenario.inputs["u.m"]).max() <= 1.0
        states = dict(zip(evaluator.state_names, run.states, strict=True))
        assert abs(states["q.hip"]) <= 0.9
        assert states["qd.hip"] == 0.0
        assert "commands limited" in run.says
        assert set(run.change) <= {"seconds", "q.hip", "u.m"}
    assert limits.commands["u.m"] == (-1.0, 1.0)


def test_a_signal_is_enlarged_up_to_its_limit():
    signal = np.array([-0.5, 0.4])
    assert _compute_largest_factor(signal, (-1.0, 1.0)) == 2.0
    assert _compute_largest_factor(signal, (-2.0, 0.5)) == 1.25
    assert _compute_largest_factor(signal, UNLIMITED) == np.inf
    assert _compute_largest_factor(np.zeros(2), (-1.0, 1.0)) == np.inf


def test_what_the_runs_so_far_did_wrongly_is_not_proposed_again(tmp_path):
    kind = kind_of(tmp_path, URDF.replace('velocity="2.5"', 'velocity="0.5"'), actuators=MOTOR)
    evaluator, model = world_of(kind, 0.9 * np.sin(3.0 * TIMES))
    rig, limits = RigModel(evaluator, 2.0), RigLimits(evaluator, model)
    assert np.abs(limits.present_runs[0]["qd.hip"]).max() > 0.5
    assert limits.bounds["qd.hip"] == (-0.5, 0.5)
    strong, weak = (rig.make_run(RunPlan(("u.m",), "slow sine", size)) for size in (1.0, 0.05))
    assert limits(model, [strong, weak]) == [False, True]


def test_plans_say_that_a_command_is_limited_and_begin_in_range(tmp_path):
    kind = kind_of(tmp_path, URDF, actuators=MOTOR)
    evaluator, _ = world_of(kind, 0.7 * np.sin(2.0 * TIMES), begin=0.6)
    rig = RigModel(evaluator, 2.0)
    run = rig.make_run(RunPlan(("u.m",), "slow sine", 2.0))
    assert np.abs(run.scenario.inputs["u.m"]).max() == 1.0
    assert "u.m limited to -1 to 1" in run.says
    begins = [value for name, value in rig._iterate_initial_states() if name == "q.hip"]
    assert max(begins) == 0.9
    assert min(begins) == pytest.approx(-0.6, abs=0.01)
    assert len(begins) == len(set(begins))
