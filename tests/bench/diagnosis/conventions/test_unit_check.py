"""Tests that wrong units and reversed signs are detected before a search, without false alarms."""

import json
import re
from dataclasses import replace
from html import unescape
from math import pi
from types import SimpleNamespace

import numpy as np
import pytest

from bench.core.plugin_registries import simulators
from bench.diagnosis.conventions.unit_check import (
    UNITS,
    Subject,
    find_imitated_unit,
    find_wrong_units,
)
from bench.diagnosis.evaluation.noise_floor import compute_noise_floor
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.explain import explain
from bench.diagnosis.fitting.base_fit import fit_base_model
from bench.diagnosis.verdict import Cause, Verdict
from bench.logs.recording_joining import load_joined
from bench.logs.synthetic_recording import simulate_recording
from sims.extended_simulator import FittedValue
from sims.recording.unit_conversion import compute_unit_scale
from tests.bench.diagnosis.explained_samples import white
from tests.command_output import run_command
from tests.conftest import PLUGINS
from tests.simulation_arguments import simulation_spec

ARM = PLUGINS.parents[1] / "examples" / "robot" / "log.csv"
DEGREE = pi / 180.0
SIMULATED_SYSTEMS = {
    "pendulum": {
        "noise": ["q=0.002", "qd=0.02"],
        "inputs": ["u=multisine:0.05:0.2:2"],
        "initial": ["q=-0.8:0.8"],
    },
    "slider": {
        "noise": ["0.002"],
        "inputs": ["u=multisine:2:0.2:2"],
        "initial": ["x=-0.1:0.1"],
    },
    "ball": {"noise": ["0.003"], "initial": ["z=0.5:1.5"]},
}


def swing(folder, stated=None, factors=None):
    """Write a pendulum recording with wrong units or scaled values; return its path.

    Args:
        stated: wrong unit of each of these signals in the description.
        factors: factor by which the values of each of these signals are multiplied.
    """
    simulated = simulate_recording(simulation_spec("pendulum", **SIMULATED_SYSTEMS["pendulum"]))
    path = folder / "swing.csv"
    simulated.write(path)
    text = path.with_suffix(".toml").read_text()
    for name, unit in (stated or {}).items():
        text = re.sub(rf'(\[\w+\.{name}\]\n(noise = .*\n)?unit = )"[^"]*"', rf'\1"{unit}"', text)
    path.with_suffix(".toml").write_text(text)
    if factors:
        head, *lines = path.read_text().splitlines()
        columns = head.split(",")
        rows = [line.split(",") for line in lines]
        for row in rows:
            for name, factor in factors.items():
                row[columns.index(name)] = repr(float(row[columns.index(name)]) * factor)
        path.write_text("\n".join([head, *map(",".join, rows)]) + "\n")
    return path


def find_unit_error(path=None, recording=None, kind=None):
    """Return the wrong unit or sign that the check finds, or None."""
    if recording is None:
        recording, kind = load_joined([path], None, None, ())
    kind = kind or simulators.get(recording.system)
    subject = Subject(kind, recording, "batch" if not kind.own_engine else None)
    evaluator = subject.evaluator(recording)
    noise = white(evaluator, compute_noise_floor(evaluator, recording).sigma)
    return find_wrong_units(subject, evaluator, noise, fit_base_model(evaluator, noise))


@pytest.mark.parametrize(
    ("stated", "factors", "signals", "line"),
    [
        ({"q": "deg"}, {}, ("q",), '[channels.q] unit = "rad"'),
        ({}, {"q": 1 / DEGREE}, ("q",), '[channels.q] unit = "deg"'),
        ({}, {"qd": 30 / pi}, ("qd",), '[channels.qd] unit = "rpm"'),
        ({}, {"q": DEGREE}, ("q",), "[channels.q] scale = 57.2957795"),
        ({}, {"q": -1}, ("q",), "[channels.q] scale = -1"),
        ({}, {"u": -1}, ("u",), "[inputs.u] scale = -1"),
        ({"u": "mN*m"}, {}, ("u",), '[inputs.u] unit = "N*m"'),
        ({}, {"u": 1 / 9.80665}, ("u",), '[inputs.u] unit = "kgf*m"'),
        ({}, {"q": 1 / DEGREE, "qd": 1 / DEGREE}, ("q", "qd"), '[channels.q] unit = "deg"'),
    ],
)
def test_what_is_stated_wrongly_is_named_with_the_line_that_corrects_it(
    stated, factors, signals, line, tmp_path
):
    found = find_unit_error(swing(tmp_path, stated, factors))
    assert found is not None
    assert found.signals == signals
    assert found.lines[0] == line
    # The specified noise is for the correct unit and may be too small by the factor, so only the
    # ratio of the errors is checked in all cases.
    assert found.error_after < 0.02 * found.error_before
    if not factors:
        assert found.error_after < 1.1


def test_a_sign_that_does_not_matter_is_not_questioned():
    options = {"noise": ["q=0.002"], "observe": ["q"], "initial": ["q=-1:1"]}
    recording = simulate_recording(simulation_spec("pendulum", **options)).recording
    subject = Subject(simulators.get("pendulum"), recording, "batch")
    found = find_unit_error(recording=subject.rescale({"q": 1 / DEGREE}))
    assert found.lines == ('[channels.q] unit = "deg"',)
    assert found.alternatives == ()


def test_the_first_line_is_the_correction_and_applying_it_explains_the_recording(tmp_path):
    path = swing(tmp_path, {"q": "deg"})
    said = " ".join(
        run_command("explain", path, "--out", tmp_path / "wrong", "--jobs", "1").out.split()
    )
    assert (
        "The recorded numbers of channel q look like radians, stated as degrees (factor 57.3): "
        'set unit = "rad" in [channels.q] of swing.toml.' in said
    )
    assert "sensor gain" not in said
    document = json.loads((tmp_path / "wrong" / "verdict.json").read_text())
    assert (document["verdict"], document["causes"]) == ("unknown", [])
    (fault,) = document["recording_faults"]
    assert fault["factor"] == pytest.approx(180 / pi)
    assert fault["unit"] == "rad"
    assert Verdict.from_document(document).to_document() == document
    page = (tmp_path / "wrong" / "report.html").read_text()
    assert '<code>[channels.q] unit = "rad"</code>' in unescape(page)

    about = path.with_suffix(".toml")
    about.write_text(about.read_text().replace('"deg"', '"rad"'))
    answer = explain(path).answer
    assert answer.verdict == "adequate"
    assert "recording_faults" not in answer.to_document()


def test_a_scale_is_applied_to_the_column_and_its_noise(tmp_path):
    path = swing(tmp_path, {}, {"q": -1})
    about = path.with_suffix(".toml")
    about.write_text(about.read_text().replace("[channels.q]\n", "[channels.q]\nscale = -1\n"))
    assert find_unit_error(path) is None
    recording, _ = load_joined([path], None, None, ())
    assert recording.noise["q"] == 0.002
    about.write_text(about.read_text().replace("scale = -1", "scale = 0"))
    out = str(tmp_path / "out")
    run_command("inspect", path, "--out", out, code=2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("factors", "line"),
    [
        ({"q.elbow": 1 / DEGREE}, '[channels."q.elbow"] unit = "deg"'),
        (
            {"q.elbow": 1 / DEGREE, "q.shoulder": 1 / DEGREE},
            '[channels."q.shoulder"] unit = "deg"',
        ),
        ({"u.m_elbow": -1}, '[inputs."u.m_elbow"] scale = -1'),
    ],
)
def test_a_wrong_unit_is_reported_although_a_friction_is_missing_too(factors, line):
    recording, kind = load_joined([ARM], None, None, ())
    # 1.5 s of three runs suffice: every step of a simulation takes time.
    runs = tuple(run.part(slice(0, 150)) for run in recording.runs[:3])
    subject = Subject(kind, replace(recording, runs=runs), None)
    found = find_unit_error(recording=subject.rescale(factors), kind=kind)
    assert found is not None
    assert found.signals == tuple(sorted(factors, reverse=True))
    assert found.lines[0] == line


def test_a_missing_friction_is_no_wrong_unit():
    recording, kind = load_joined([ARM], None, None, ())
    assert find_unit_error(recording=recording, kind=kind) is None


@pytest.mark.slow
@pytest.mark.parametrize("system", SIMULATED_SYSTEMS)
def test_neither_clean_recordings_nor_gains_nor_causes_are_called_wrong_units(system):
    """Check eight clean recordings and true errors of 5 % and more for each system."""
    effects = {
        "pendulum": ["sensor.gain=0.05", "input.gain=-0.3", "friction.coulomb=0.01"],
        "slider": ["sensor.gain=-0.05", "input.gain=0.4", "friction.coulomb=1", "force.bias=2"],
        "ball": ["sensor.gain=0.05", "drag.linear=0.3", "wind=2,1", "gravity.scale=0.1"],
    }  # fmt: skip
    clean = [{"seed": seed} for seed in range(8)]
    wrong = [{"seed": seed, "effects": [e]} for e in effects[system] for seed in (1, 2)]
    for options in (*clean, *wrong):
        recording = simulate_recording(
            simulation_spec(system, **SIMULATED_SYSTEMS[system], **options)
        ).recording
        assert find_unit_error(recording=recording) is None, options


def test_a_true_gain_near_a_conversion_is_not_a_unit():
    recording = simulate_recording(
        simulation_spec("pendulum", **SIMULATED_SYSTEMS["pendulum"])
    ).recording
    subject = Subject(simulators.get("pendulum"), recording, "batch")
    # A turn is 2 pi rad, 4.5 % more than 6: its factor reduces the misfit by 95 %.
    assert find_unit_error(recording=subject.rescale({"q": 1 / 6.0})) is None


@pytest.mark.parametrize(
    ("effect", "value", "line"),
    [
        ("sensor.gain", DEGREE - 1, "[channels.q] scale = 57.2957795"),
        ("sensor.gain", 1 / DEGREE - 1.001, '[channels.q] unit = "deg"'),
        ("sensor.gain", -2.0, "[channels.q] scale = -1"),
        ("input.gain", -1.99, "[inputs.u] scale = -1"),
        ("input.gain", 1e-3 - 1, '[inputs.u] unit = "mN*m"'),
        ("sensor.gain", -0.96, None),
        # This is the lower bound of the range; the fit would go below it.
        ("sensor.gain", -0.8, None),
    ],
)
def test_a_fitted_gain_that_is_a_conversion_is_recognised(effect, value, line):
    found = recognised_of(effect, value)
    assert found is not None
    assert found.lines == ((line,) if line else ())
    if line is None:
        assert "nearly independent of the simulation" in found.says


@pytest.mark.parametrize(("effect", "value"), [("sensor.gain", 0.05), ("input.gain", -0.5)])
def test_a_plausible_gain_is_a_gain(effect, value):
    assert recognised_of(effect, value) is None


def recognised_of(effect, value):
    recording = simulate_recording(
        simulation_spec("pendulum", **SIMULATED_SYSTEMS["pendulum"])
    ).recording
    subject = Subject(simulators.get("pendulum"), recording, "batch")
    evaluator = RunEvaluator(subject.kind, recording, recording.training(), candidates=[effect])
    number = FittedValue(value, "1", value - 1e-3, value + 1e-3)
    nowhere = SimpleNamespace(free_indices=np.array([], dtype=int), theta=np.array([]))
    cause = Cause(effect, (), "says so", {"coefficient": number}, 0.0)
    return find_imitated_unit(subject, evaluator, cause, nowhere)


def test_the_gains_of_units_are_those_of_the_unit_library():
    for si, units in UNITS.items():
        for unit, gain in units.items():
            assert compute_unit_scale(unit, si).gain == pytest.approx(gain, rel=1e-9), unit
