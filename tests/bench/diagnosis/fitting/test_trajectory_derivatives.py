"""Tests of linearised robot runs, and of whether the motion forgets its initial state."""

from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.levenberg_marquardt import FitStart
from bench.diagnosis.fitting.multiple_shooting import forgets_initial_state
from bench.diagnosis.fitting.trajectory_derivatives import compute_state_jacobian
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from bench.logs.recording_loading import load_recording
from sims.core.simulator import Scenario
from tests.bench.diagnosis.explained_samples import white
from tests.bench.diagnosis.simulated_logs import describe, write_log
from tests.sims.robot.test_robot_motion import kind_of

ARM = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
<joint name="hinge" axis="0 1 0" damping="{damping}"/>
<inertial pos="0 0 -0.3" mass="0.8" diaginertia="0.002 0.002 0.002"/></body></worldbody>
{drive}</mujoco>
"""
SERVO = '<actuator><position name="m" joint="hinge" kp="30" kv="2"/></actuator>'
TIMES = np.arange(0, 2, 0.02)


def evaluator(tmp_path, text):
    """Return the run evaluator of a log with two runs of an arm."""
    simulator, runs = kind_of(text)(observe=["q.hinge"]), []
    for run, angle in enumerate((0.3, -0.2)):
        inputs = {c.name: 0.2 * np.sin(3 * TIMES + run) for c in simulator.inputs if "u." in c.name}
        given = {c.name: inputs.get(c.name, np.zeros(TIMES.size)) for c in simulator.inputs}
        seen = simulator.simulate(np.empty((1, 0)), Scenario(TIMES, {"q.hinge": angle}, given))[0]
        runs.append((TIMES, seen, *inputs.values()))
    units = dict.fromkeys(("q.hinge", *inputs), "rad")
    path = write_log(tmp_path, describe(units), ",".join(units), runs, arm=text)
    recording, kind = load_recording(path)
    return RunEvaluator(kind, recording, recording.runs, None, [], ())


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (ARM.format(damping=0.1, drive=SERVO), True),
        (ARM.format(damping=0.01, drive=""), False),
        (ARM.format(damping=3.0, drive=""), False),
        (ARM.format(damping=0.4, drive=""), True),
    ],
    ids=["servo", "swinging", "creeping", "damped"],
)
def test_what_is_held_or_damped_forgets_and_what_swings_or_creeps_does_not(
    tmp_path, text, expected
):
    there = evaluator(tmp_path, text)
    noise = white(there, 1e-3)
    by_states = compute_state_jacobian(
        there, there.get_nominal_theta(), there.initial_state_guesses
    )
    assert forgets_initial_state(there, noise, by_states) is expected
    known = np.zeros_like(by_states)
    assert not forgets_initial_state(there, noise, known), (
        "what is known shows nothing of how long it acts"
    )


def test_a_simulated_element_is_not_simulated_again(tmp_path):
    there = evaluator(tmp_path, ARM.format(damping=0.4, drive=SERVO))
    theta = np.tile(there.get_nominal_theta(), (3, 1))
    runs = np.array([0, 1, 0])
    states = there.initial_state_guesses[runs] + np.array([[0.0], [0.0], [0.1]])
    first = there.simulate(theta, runs, states)
    assert there.simulation_count == 3
    again = there.simulate(theta[::-1], runs[::-1], states[::-1])
    assert there.simulation_count == 3
    np.testing.assert_array_equal(again[::-1], first)
    # A part of a run is a separate batch element with its own simulation.
    half = there.simulate(theta[:1], runs[:1], states[:1], 0.5)
    assert there.simulation_count == 4
    assert np.isnan(half).any()
    # A correction of all simulations is not part of the cached results.
    there.discretisation_correction = np.full(there.observed.shape, 1.0)
    np.testing.assert_array_equal(there.simulate(theta, runs, states), first + 1.0)
    assert there.simulation_count == 4


def test_a_fit_that_continues_from_a_converged_one_simulates_nothing(tmp_path):
    there = evaluator(tmp_path, ARM.format(damping=0.4, drive=SERVO))
    name, theta = "drag.linear@hinge", there.get_nominal_theta().copy()
    theta[there.coefficient_slices[name]] = 0.05
    fitter = TrajectoryFitter(there, white(there, 1e-3), is_final_fit=True)
    (fit,) = fitter.fit_models([FitStart((name,), theta, there.initial_state_guesses)], 20)
    assert fit.is_own_jacobian
    np.testing.assert_allclose(fit.theta[there.coefficient_slices[name]], 0.0, atol=1e-3)
    count = there.simulation_count
    (continued,) = fitter.fit_models([fit.make_start_with_derivatives()], 20)
    assert there.simulation_count == count
    assert continued.is_own_jacobian
    np.testing.assert_array_equal(continued.theta, fit.theta)
    np.testing.assert_array_equal(continued.jacobian, fit.jacobian)
    # Without them, each run is simulated once more, with the coefficient displaced.
    fitter.fit_models([fit.make_start()], 20)
    assert there.simulation_count == count + 2
    # Derivatives of another point are not those at the start.
    start = replace(fit, is_own_jacobian=False).make_start_with_derivatives()
    assert start.known_jacobian is None
