"""Tests that noise-free data give no false alarm from differences between integrators."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from bench.diagnosis.evaluation.noise_floor import (
    INTEGRATION_ERROR_SHARE,
    add_minimal_noise,
    compute_noise_floor,
    compute_value_range,
)
from bench.diagnosis.explain import explain
from bench.diagnosis.pipeline.verdict_builder import _is_refuted
from bench.diagnosis.search.diagnose import DiagnosisResult
from bench.diagnosis.search.lack_of_fit import LackOfFitResult
from tests.bench.diagnosis.explained_samples import changed, evaluator, recording
from tests.bench.diagnosis.simulated_logs import describe, follow, write_log


@pytest.mark.parametrize("system", ["pendulum", "servo", "ball"])
def test_noise_free_data_of_the_simulator_itself_are_explained_by_it(system):
    answer = explain(recording(system, runs=4, seconds=2)).answer
    assert (answer.verdict, answer.causes) == ("adequate", ())


def test_a_cause_in_noise_free_data_is_named_with_its_number():
    made = recording(
        runs=4, seconds=2, observe=["q"], effects=["drag.linear=2e-4"], initial=["q=0.5:1.5"]
    )
    answer = explain(made).answer
    (cause,) = answer.causes
    assert (answer.verdict, cause.effect) == ("named", "drag.linear")
    assert cause.coefficients["coefficient"].value == pytest.approx(2e-4, rel=5e-3)


def test_noise_is_added_where_there_is_none_and_nowhere_else():
    made = recording(runs=2, seconds=2, noise=["q=0.002"])
    again, names = add_minimal_noise(made, ["q", "qd"])
    assert names == ["qd"]
    for before, after in zip(made.runs, again.runs, strict=True):
        np.testing.assert_array_equal(before.channels["q"], after.channels["q"])
        added = after.channels["qd"] - before.channels["qd"]
        size = INTEGRATION_ERROR_SHARE * compute_value_range(
            np.concatenate([run.channels["qd"] for run in made.runs])
        )
        assert np.std(added) == pytest.approx(size, rel=0.2)


def test_the_added_noise_is_the_same_each_time():
    made = recording(runs=2, seconds=1)
    once, twice = (add_minimal_noise(made, ["q"])[0] for _ in range(2))
    np.testing.assert_array_equal(once.runs[1].channels["q"], twice.runs[1].channels["q"])
    assert not np.array_equal(once.runs[0].channels["q"], once.runs[1].channels["q"])


@pytest.mark.parametrize("digits", [6, 8])
def test_rounding_of_a_file_is_not_noise(digits):
    made = recording(runs=2, seconds=2)
    rounded = [changed(run, q=lambda v: np.round(v, digits)) for run in made.runs]
    assert add_minimal_noise(replace(made, runs=tuple(rounded)), ["q"])[1] == ["q"]


def test_a_quantised_channel_at_rest_gets_no_noise():
    """More than half of the samples are equal, so that their differences show no noise."""
    made = recording(runs=2, seconds=2)
    step = 0.002

    def hold_and_round(v):
        return np.round(np.where(np.arange(v.size) < 0.7 * v.size, v[0], v) / step) * step

    rounded = [changed(run, q=hold_and_round) for run in made.runs]
    made = replace(made, runs=tuple(rounded), noise={})
    assert add_minimal_noise(made, ["q"])[1] == []
    floor = compute_noise_floor(evaluator(made, candidates=[]), made)
    assert floor.sigma[0] == pytest.approx(step / 12**0.5)


def test_a_channel_that_never_changes_has_the_noise_of_what_no_sample_tells_of():
    made = recording(runs=2, seconds=1, noise=["0.001"])
    still = [changed(run, qd=lambda v: np.zeros_like(v)) for run in made.runs]
    made = replace(made, runs=tuple(still), noise={})
    assert add_minimal_noise(made, ["qd"])[1] == []
    assert compute_noise_floor(evaluator(made, candidates=[]), made).sigma[1] == pytest.approx(
        1e-3 * 10.0
    )


NOTHING = LackOfFitResult(0.3, "", np.ones(1), ())


def judged(fitted, held_out, left=NOTHING, base_error=1.0):
    """Return the verdict on an `unknown` finding without causes.

    The dictionaries give penalised log-likelihoods of models with one effect on the fitted and on
    the held-out runs; the base model has 100 on both.
    """
    base = SimpleNamespace(effects=(), penalised_log_likelihood=100.0)
    models = {
        (name,): SimpleNamespace(effects=(name,), penalised_log_likelihood=m)
        for name, m in fitted.items()
    }
    search = SimpleNamespace(base_model=base, models={(): base, **models})
    simulated = np.full((1, 4, 1), base_error)
    measured = {(): SimpleNamespace(simulated=simulated, penalised_log_likelihood=100.0)}
    measured |= {
        (name,): SimpleNamespace(penalised_log_likelihood=m) for name, m in held_out.items()
    }
    runs = SimpleNamespace(
        predicted=SimpleNamespace(observed=np.zeros((1, 4, 1))),
        floor=SimpleNamespace(sigma=np.ones(1)),
    )
    finding = DiagnosisResult("unknown", base, base, (), left, held_out_fits=measured)
    result = SimpleNamespace(runs=runs, search=search, finding=finding)
    return _is_refuted(result)


@pytest.mark.parametrize(
    ("fitted", "held_out", "refuted"),
    [
        ({"force.ripple@a": 90.0}, {}, True),
        # Overfitting: the effect is better on the fitted runs, but not on the held-out runs.
        ({"force.ripple@a": 105.0}, {"force.ripple@a": 64.0}, True),
        ({"force.ripple@a": 105.0}, {"force.ripple@a": 101.0}, False),
        # Without a simulation of the held-out runs, nothing contradicts the effect.
        ({"force.ripple@a": 105.0}, {}, False),
        # A score without any fit is not refuted.
        ({}, {}, False),
    ],
)
def test_a_score_that_no_simulation_confirms_is_no_finding(fitted, held_out, refuted):
    assert judged(fitted, held_out) is refuted


def test_structure_and_a_gap_on_held_out_runs_are_findings():
    fitted = {"force.ripple@a": 90.0}
    assert not judged(fitted, {}, left=replace(NOTHING, p_value=1e-9))
    assert not judged(fitted, {}, base_error=3.0)


FOUR_BAR = """<mujoco><option timestep="0.002" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="crank"><joint name="crank" axis="0 1 0" damping="0.05" armature="0.002"/>
      <geom type="capsule" fromto="0 0 0 0 0 0.1" size="0.01" mass="0.3"/>
      <body name="coupler" pos="0 0 0.1"><joint name="knee" axis="0 1 0" damping="0.01"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0.1" size="0.01" mass="0.4"/></body></body>
    <body name="rocker" pos="0.3 0 0"><joint name="rocker" axis="0 1 0" damping="0.02"/>
      <geom type="capsule" fromto="0 0 0 0 0 0.2" size="0.01" mass="0.3"/></body>
  </worldbody>
  <equality><connect body1="coupler" body2="rocker" anchor="0.3 0 0.1"/></equality>
  <actuator><position name="servo" joint="crank" kp="20" kv="1"/></actuator></mujoco>"""
GRIPPER = """<mujoco><option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body name="arm"><joint name="arm" axis="0 1 0" damping="0.2" armature="0.01"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="1" contype="0" conaffinity="0"/>
      <body name="finger" pos="0.3 0 0">
        <joint name="finger" type="slide" axis="0 1 0" range="0 0.04" damping="5"/>
        <geom type="box" size="0.02 0.01 0.02" mass="0.05" contype="0" conaffinity="0"/>
      </body></body></worldbody>
  <actuator><position name="servo" joint="arm" kp="40" kv="2"/>
    <position name="grip" joint="finger" kp="200"/></actuator></mujoco>"""


def robot_log(folder, text, units, places, noise):
    """Simulate a log with the step of the file: the first servo moves, the others stay at zero.

    Args:
        folder: folder of the log.
        text: model file.
        units: unit by signal; the first one is the command of the moving servo.
        places: index of the coordinate of each channel.
        noise: standard deviation of the noise, which is stated if it is not zero.
    """
    model, rng, runs = mujoco.MjModel.from_xml_string(text), np.random.default_rng(5), []
    times = 5 * model.opt.timestep * np.arange(200)
    for _ in range(3):
        rate, size = rng.uniform(3, 7), rng.uniform(0.3, 0.6)
        commands = np.zeros((200, model.nu))
        commands[:, 0] = size * np.sin(rate * times)
        readings = follow(model, commands, 5)[:, places]
        runs.append((times, commands, readings + noise * rng.standard_normal(readings.shape)))
    description = describe(units, noise or None, "[runs.3]\nheld_out = true\n", "robot")
    return write_log(folder, description, ",".join(units), runs, robot=text)


@pytest.mark.slow
def test_a_closed_loop_without_a_cause_is_adequate(tmp_path):
    units = dict.fromkeys(("u.servo", "q.crank", "q.rocker"), "rad")
    path = robot_log(tmp_path, FOUR_BAR, units, [0, 2], 0.0)
    assert explain(path).answer.verdict == "adequate"


@pytest.mark.slow
@pytest.mark.parametrize("noise", [5e-4, 0.0])
def test_a_gripper_at_rest_is_adequate(tmp_path, noise):
    units = {"u.servo": "rad", "u.grip": "m", "q.arm": "rad", "q.finger": "m"}
    path = robot_log(tmp_path, GRIPPER, units, [0, 1], noise)
    assert explain(path).answer.verdict == "adequate"
