"""Tests of the floating-base world and of `simgap explain` on its recordings."""

import json
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="pin has no wheel here")

from bench.cli.main import main
from tests.exams.robots import exam_settings, floating_robots
from tests.exams.robots.reference_world import Run, World
from tests.exams.robots.robot_cases import RobotQuestion, bare_case, setting_of, write_setting

SECONDS = 1.5


@pytest.fixture(scope="module", params=floating_robots.NAMES)
def machine(request):
    return floating_robots.machine(request.param, np.random.default_rng(5))


def make_zero_command_run(machine):
    """Return a run with zero commands."""
    rng, hinges = np.random.default_rng(6), len(machine.hinges)
    pose, rate = exam_settings.draw_base_state(machine, rng)
    q = np.concatenate([rng.uniform(-0.4, 0.4, hinges), pose])
    v = np.concatenate([rng.uniform(-1.0, 1.0, hinges), rate])
    times = np.arange(0.0, SECONDS, 0.01)
    return Run(times, {drive.name: 0 * times for drive in machine.drives}, q, v)


@pytest.mark.parametrize("friction", [0.0, 0.05])
def test_simgap_agrees_with_the_world_from_the_recorded_state(machine, friction, tmp_path):
    """simgap and the reference world, with different pose conventions, make the same motion."""
    from bench.core.plugin_registries import make_robot_simulator
    from sims.core.simulator import Scenario

    (tmp_path / "robot.xml").write_text(machine.mjcf())
    run = make_zero_command_run(machine)
    run = replace(run, commands={n: 0.05 * np.sin(6.0 * run.times) for n in run.commands})
    effect = f"friction.coulomb@{machine.hinges[0]}"
    motion = World(machine, {effect: (friction,)} if friction else {}).move(run, run.times)
    hinges = len(machine.hinges)
    initial = machine.stated_initial_state(run)
    for number, name in enumerate(machine.hinges):
        initial |= {f"q.{name}": run.q[number], f"qd.{name}": run.v[number]}
    inputs = {f"u.{name}": command for name, command in run.commands.items()}
    simulator = make_robot_simulator(tmp_path / "robot.xml")(
        observe=[f"q.{name}" for name in machine.hinges], effects=[effect]
    )
    scenario = Scenario(run.times, initial, inputs)
    seen, free = simulator.simulate(np.array([[friction], [0.0]]), scenario)
    changed = np.abs(seen - free).max()
    np.testing.assert_allclose(seen, motion.q[:, :hinges], atol=2e-6 + 0.03 * changed)
    assert np.abs(seen - seen[0]).max() > 0.1
    assert changed >= 0.05 * friction


@pytest.mark.slow
def test_a_wrong_mass_below_a_ball_joint_is_found_by_the_command(tmp_path):
    """The command finds a wrong mass from four runs of an exam question."""
    name, truth = "single/hung-motor/mass.scale/0", 0.0787
    case, setting = bare_case(name, {"mass.scale@upper": (truth,)}), setting_of(name)
    log = write_setting(case, replace(setting, runs=setting.runs[2:]), tmp_path)
    assert main(["explain", str(log), "--out", str(tmp_path / "out")]) == 0
    verdict = json.loads((tmp_path / "out" / "verdict.json").read_text())
    (cause,) = verdict["causes"]
    assert (cause["effect"], cause["alternatives"]) == ("mass.scale@upper", [])
    (said,) = cause["coefficients"].values()
    assert said["low"] <= truth <= said["high"]
    assert said["high"] - said["low"] < 0.2 * truth
    assert verdict["heldout"]["gap_closed"] > 0.9


@pytest.mark.slow
def test_a_chaotic_held_out_run_is_no_gap(tmp_path):
    """A chaotic held-out run must not count as a discrepancy.

    Errors of its initial state grow by a factor of 1,400. A fit with derivatives at the wrong state
    ends at twice the noise.
    """
    case = RobotQuestion("clean", "hung-motor", "any", 27).draw()
    setting = setting_of(case.name)
    log = write_setting(case, replace(setting, runs=setting.runs[3:]), tmp_path)
    assert main(["explain", str(log), "--out", str(tmp_path / "out")]) == 0
    verdict = json.loads((tmp_path / "out" / "verdict.json").read_text())
    heldout = verdict["heldout"]
    assert verdict["verdict"] == "adequate"
    assert heldout["rmse_base"] == pytest.approx(heldout["noise_floor"], rel=0.05)
