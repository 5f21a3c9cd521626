"""Tests that a time step or integrator is a cause only if that of the model file is worse."""

from contextlib import closing
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from bench.diagnosis.evaluation.forked_workers import ForkedWorkerPool
from bench.diagnosis.explain import explain
from bench.diagnosis.explain_options import ExplainOptions
from bench.diagnosis.pipeline.base_model import filter_and_fit
from bench.diagnosis.pipeline.recording_preparation import prepare_runs
from bench.diagnosis.pipeline.simulated_runs import DiagnosisContext
from bench.diagnosis.pipeline.time_step_choice import (
    MIN_FINER_STEP_GAIN,
    TimeStepChoice,
    closes_gap_alone,
    is_clearly_better,
)
from tests.bench.diagnosis.arm_model import ARM
from tests.bench.diagnosis.simulated_logs import describe, follow, write_log

HEAVY = ('mass="0.8"', 'mass="1.2"')
DAMPED = ('damping="0.1"', 'damping="0.4"')
UNITS = dict.fromkeys(("u.m_shoulder", "u.m_elbow", "q.shoulder", "q.elbow"), "rad")
NOISE, EVERY, SAMPLES = 3e-4, 2, 375


def log(folder, change=("", ""), noise=NOISE, divide=1, integrator="Euler", arm=ARM):
    """Write a log of a changed arm, simulated with the step of the file or a part of it.

    The step of the file misses the fine motion by 7 times this noise.
    """
    model = mujoco.MjModel.from_xml_string(arm.replace(*change) if change[0] else arm)
    step = model.opt.timestep
    model.opt.timestep /= divide
    model.opt.integrator = int(getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}"))
    rng, times, runs = np.random.default_rng(3), EVERY * step * np.arange(SAMPLES), []
    for _ in range(3):
        rates, sizes = rng.uniform(1, 5, 2), rng.uniform(0.4, 0.9, 2)
        commands = sizes * np.sin(times[:, None] * rates)
        readings = follow(model, commands, EVERY * divide)
        runs.append((times, commands, readings + noise * rng.standard_normal(readings.shape)))
    description = describe(UNITS, noise or None, "[runs.3]\nheld_out = true\n")
    return write_log(folder, description, ",".join(UNITS), runs, arm=arm)


URDF = """<robot name="arm">
  <link name="base"/>
  <link name="upper"><inertial><origin xyz="0 0 -0.2"/><mass value="1.2"/>
    <inertia ixx="0.02" iyy="0.02" izz="0.002" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="fore"><inertial><origin xyz="0 0 -0.1"/><mass value="0.8"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/>
    <axis xyz="0 1 0"/><dynamics damping="0.3"/></joint>
  <joint name="elbow" type="continuous"><parent link="upper"/><child link="fore"/>
    <origin xyz="0 0 -0.4"/><axis xyz="0 1 0"/><dynamics damping="0.1"/></joint>
</robot>
"""
SERVOS = "".join(
    f'[actuators.m_{joint}]\njoint = "{joint}"\nkind = "position"\nkp = {kp}\nkv = {kv}\n'
    for joint, kp, kv in (("shoulder", 150, 6), ("elbow", 60, 2))
)


def describe_by_urdf(path):
    """Replace the model file of a log by a URDF of the same arm, which has no time step."""
    (path.parent / "arm.urdf").write_text(URDF)
    description = path.with_suffix(".toml")
    text = description.read_text().replace("arm.xml", "arm.urdf")
    description.write_text(text + SERVOS)
    return path


def chosen(path):
    """Return the choice of the step of a log after the base fit, and the runs with this step."""
    context = DiagnosisContext(ExplainOptions(), ForkedWorkerPool(1))
    with closing(context):
        choice = TimeStepChoice()
        model = choice.choose(filter_and_fit(prepare_runs([path], context)))
    return choice, model.runs


@pytest.mark.parametrize("noise", [NOISE, 0.0])
def test_a_missing_mass_does_not_make_the_files_own_step_look_worse(tmp_path, noise):
    choice, runs = chosen(log(tmp_path, HEAVY, noise))
    assert choice.finding is None
    assert runs.kind.numerics.integrator == "Euler"
    # The alternative step remains available for the comparison with other causes.
    assert next(iter(choice._refinements)).error > 5.0


def test_a_step_that_is_the_only_thing_wrong_is_found_before_any_cause(tmp_path):
    choice, runs = chosen(log(tmp_path, divide=4, integrator="RK4"))
    assert choice.finding is not None
    assert choice.finding.gain > MIN_FINER_STEP_GAIN
    assert runs.kind.numerics.integrator == "RK4"


def test_a_step_is_found_although_the_innovations_do_not_show_its_errors(tmp_path):
    # Stiffer dampers: the linear response to the errors has the coefficient 0.02.
    arm = ARM.replace('kv="6"', 'kv="12"').replace('kv="2"', 'kv="4"')
    choice, runs = chosen(log(tmp_path, divide=4, integrator="RK4", arm=arm))
    assert choice.finding is not None
    assert runs.kind.numerics.integrator == "RK4"


def test_a_table_of_the_recording_states_the_step_of_a_urdf(tmp_path):
    path = describe_by_urdf(log(tmp_path, divide=4, integrator="RK4"))
    description = path.with_suffix(".toml")
    engine = '[engine]\ntimestep = 0.002\nintegrator = "Euler"\n'
    description.write_text(description.read_text() + engine)
    assert chosen(path)[0].finding is not None


def test_a_urdf_has_no_step_that_could_be_wrong(tmp_path):
    choice, runs = chosen(describe_by_urdf(log(tmp_path, divide=4, integrator="RK4")))
    # The better integrator is used, and is no finding about the model file.
    assert runs.kind.numerics.integrator == "RK4"
    assert choice.finding is None
    assert runs.before is None


@pytest.mark.parametrize(
    ("gain", "gap", "left", "better"),
    [
        (400.0, 6.0, 0.1, True),
        # Most of the gap remains, so another effect is missing.
        (279.0, 12.8, 12.7, False),
        (12.0, 1.0, 0.0, False),
        # A residual below the noise does not close more than the whole gap.
        (30.0, 0.5, -0.02, True),
    ],
)
def test_when_a_finer_step_is_used_in_the_search(gain, gap, left, better):
    assert closes_gap_alone(gain, gap, left) is better


@pytest.mark.parametrize(
    ("file", "finer", "better"),
    [
        ((24327.0, -0.02), (24346.0, -0.02), True),
        ((24327.0, -0.02), (24333.0, -0.02), False),
        # Likelihood and residual both increase, so neither model is near the data.
        ((1903.0, 2.2), (2030.0, 3.4), False),
        ((1903.0, 2.2), (2030.0, 0.1), True),
        ((2030.0, -0.01), (1500.0, 6.0), False),
    ],
)
def test_when_a_finer_step_is_better_once_causes_are_known(file, finer, better):
    assert is_clearly_better(file, finer) is better


@pytest.mark.slow
def test_data_made_with_the_files_own_step_are_not_explained_by_another(tmp_path):
    answer = explain(log(tmp_path, DAMPED, noise=0.0)).answer
    (cause,) = answer.causes
    names = {cause.effect, *cause.alternatives}
    assert "drag.linear@elbow" in names
    assert not any(name.startswith("numerics.") for name in names)
    value = SimpleNamespace(**cause.coefficients).coefficient.value
    if cause.effect == "drag.linear@elbow":
        assert value == pytest.approx(0.3, rel=0.01)


@pytest.mark.long
def test_a_coarse_step_is_found_with_a_cause(tmp_path):
    answer = explain(log(tmp_path, DAMPED, divide=4, integrator="RK4")).answer
    step, cause = answer.causes
    assert step.effect == "numerics.integrator"
    assert "drag.linear@elbow" in {cause.effect, *cause.alternatives}
