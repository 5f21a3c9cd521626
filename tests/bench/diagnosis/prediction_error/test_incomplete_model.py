"""Tests of long recordings of real robots, whose models stay incomplete."""

import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from bench.core.plugin_registries import simulators
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.explain import explain
from bench.diagnosis.prediction_error.stepwise_selection_by_filters import is_long
from bench.diagnosis.validation.held_out_runs import HeldOutRuns
from bench.logs.recording_loading import load_recording
from bench.logs.segmentation import segment_recording
from sims.extended_simulator import open_extended
from tests.bench.diagnosis.explained_samples import white
from tests.exams.recordings.recording_cases import SHARED, RecordingQuestion


def explained(name, folder):
    """Explain a recording of the exam; return the answer and the path of its extended model."""
    question = RecordingQuestion(name)
    # An empty path would be the present folder.
    robots = Path(os.environ.get("SIMGAP_ROBOTS") or SHARED / "robots")
    if not (robots / Path(question.system).name).is_dir() or not SHARED.is_dir():
        pytest.skip("no robots (set SIMGAP_ROBOTS)")
    case = replace(question.draw(), folder=robots / Path(question.system).name)
    log = case.write(folder)
    explanation = explain(log)
    explanation.write(folder / "out")
    return log, explanation.answer, folder / "out" / "extended.toml"


def error_in_segments(log, extended_path, seconds):
    """Return the RMS error of an extended model on held-out runs in segments of a duration."""
    extended, kind, _ = open_extended(extended_path, simulators.get)
    recording, _ = segment_recording(load_recording(log)[0], kind, seconds)
    runs = recording.held_out()
    evaluator = RunEvaluator(kind, recording, runs, None, candidates=list(extended.effects))
    theta = evaluator.get_nominal_theta()
    for place, parameter in enumerate(evaluator.parameters[: evaluator.system_parameter_count]):
        theta[place] = extended.parameters[parameter.name].value
    for name, numbers in extended.effects.items():
        coefficients = evaluator.available_effects[name].on(evaluator.simulator.system)
        places = evaluator.get_coefficient_indices(name)
        for place, coefficient in zip(places, coefficients, strict=True):
            theta[place] = numbers[coefficient.name].value
    held_out = HeldOutRuns(evaluator, white(evaluator, 2.4e-5))
    (fit,) = held_out.fit_initial_states([theta])
    error = (evaluator.observed - fit.simulated)[held_out.seen]
    return float(np.sqrt(np.mean(error**2)))


@pytest.mark.long
def test_mass_and_friction_of_the_emps_are_those_of_inverse_dynamics(tmp_path):
    """Published: 95.11 kg; by direction 166.7 and 240.4 N s/m, 20.14 and 20.63 N."""
    log, answer, extended = explained("emps", tmp_path)
    mass = answer.parameters["mass.scale@carriage"].value
    assert 100.0 * (1.0 + mass) == pytest.approx(95.11, rel=0.01)
    causes = {cause.effect: cause.coefficients for cause in answer.causes}
    assert causes.keys() == {"friction.direction@screw", "friction.coulomb@screw"}
    viscous = causes["friction.direction@screw"]
    assert viscous["viscous+"].value == pytest.approx(166.7, rel=0.05)
    assert viscous["viscous-"].value == pytest.approx(240.4, rel=0.05)
    dry = causes["friction.coulomb@screw"]["coefficient"].value
    assert dry == pytest.approx(20.14, rel=0.05)
    assert dry == pytest.approx(20.63, rel=0.05)
    assert answer.verdict == "partial"
    assert error_in_segments(log, extended, 0.5) < 0.1225e-3


@pytest.mark.slow(seconds=40)
def test_inertias_stated_about_the_joints_and_dry_friction_are_found(tmp_path):
    """The file has 0.0319 and 0.0509 kg m^2 for 0.0109 and 0.0100 kg m^2."""
    _, answer, _ = explained("dfki_double_pendulum", tmp_path)
    causes = {cause.effect: cause.coefficients for cause in answer.causes}
    first = 0.0319 * (1.0 + causes["inertia.scale@Link1"]["coefficient"].value)
    second = 0.0509 * (1.0 + causes["inertia.scale@Link2"]["coefficient"].value)
    assert first == pytest.approx(0.0109, abs=0.0025)
    assert second == pytest.approx(0.0100, abs=0.0025)
    # A centre of mass that one run shows does not predict the others.
    assert not any(name.startswith("mass.offset") for name in causes)
    added = causes["friction.coulomb@Joint2"]["coefficient"].value
    assert 0.12 + added == pytest.approx(0.18, abs=0.03)
    assert answer.heldout.rmse_extended < 0.056


@pytest.mark.parametrize(
    ("seconds", "joints", "expected"),
    [((8.0, 25.0), 1, True), ((7.9, 25.0), 1, False), ((8.0, 25.0), 4, False)],
)
def test_only_long_runs_of_few_joints_are_identified_by_filters_alone(seconds, joints, expected):
    runs = [SimpleNamespace(times=np.array([0.0, end])) for end in seconds]
    system = SimpleNamespace(coordinates=["q"] * joints)
    evaluator = SimpleNamespace(runs=runs, simulator=SimpleNamespace(system=system))
    assert is_long(evaluator) is expected
