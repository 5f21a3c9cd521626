"""Tests of robot recordings: simulated from a model file, read again and inspected."""

import numpy as np
import pytest

from bench.core.input_signals import evaluate_signal
from bench.logs.recording_loading import load_recording
from bench.logs.synthetic_recording import SimulationSpec, simulate_recording
from sims.core.simulator import InputError
from sims.core.toml_validation import read_toml
from tests.bench.diagnosis.pendulum_recordings import SWINGING, written
from tests.bench.diagnosis.simulated_logs import describe, write_log
from tests.command_output import run_command

SHORT = {"runs": 2, "seconds": 0.4, "rate": 100.0}


def test_what_is_simulated_of_a_model_file_is_read_again(tmp_path):
    model = written(tmp_path)
    (tmp_path / "logs").mkdir()
    made = simulate_recording(
        SimulationSpec(model=model, effects={"friction.coulomb@elbow": 0.3}, noise=1e-3, **SHORT)
    )
    made.write(tmp_path / "logs" / "log.csv")
    description = read_toml(tmp_path / "logs" / "log.toml")
    assert description["model"] == "../swinging.xml", "as seen from the log"
    assert "system" not in description
    truth = read_toml(tmp_path / "logs" / "log.truth.toml")
    assert truth["model"] == str(model)
    assert truth["effects"] == {"friction.coulomb@elbow": [0.3]}
    recording, kind = load_recording(tmp_path / "logs" / "log.csv")
    assert recording.model.path.samefile(model)
    assert [c.name for c in kind.inputs][:2] == ["u.m_shoulder", "u.s_elbow"]
    first, again = made.recording.runs[0], recording.runs[0]
    np.testing.assert_allclose(again.channels["q.elbow"], first.channels["q.elbow"], rtol=1e-8)
    # The recording in memory has the same robot.
    assert load_recording(made.recording)[1].system.coordinates == kind.system.coordinates


def test_actuators_that_the_file_lacks_travel_with_the_recording(tmp_path):
    model = written(tmp_path, SWINGING.replace("<actuator>", "<!--").replace("</actuator>", "-->"))
    given = {"m": {"joint": "elbow", "kind": "motor"}}
    simulate_recording(SimulationSpec(model=model, actuators=given, **SHORT)).write(
        tmp_path / "log.csv"
    )
    recording, _ = load_recording(tmp_path / "log.csv")
    assert recording.model.actuators == given
    assert list(recording.runs[0].inputs) == ["u.m"]
    bare = simulate_recording(SimulationSpec(model=model, **SHORT)).recording
    assert list(bare.runs[0].inputs) == ["force.shoulder", "force.elbow"], "pushed at its joints"


def test_one_coefficient_of_a_family_is_that_of_every_place(tmp_path):
    model = written(tmp_path)
    alike = simulate_recording(SimulationSpec(model=model, effects={"drag.linear@*": 0.2}, **SHORT))
    assert alike.truth["effects"] == {"drag.linear@*": [0.2, 0.2]}
    each = simulate_recording(
        SimulationSpec(model=model, effects={"drag.linear@*": [0.2, 0.0]}, **SHORT)
    )
    shoulder = simulate_recording(
        SimulationSpec(model=model, effects={"drag.linear@shoulder": 0.2}, **SHORT)
    )
    same, other, one = (m.recording.runs[0].channels["q.elbow"] for m in (alike, each, shoulder))
    np.testing.assert_array_equal(other, one)
    assert np.abs(same - one).max() > 1e-4


def test_a_specification_names_a_system_or_a_model(tmp_path):
    with pytest.raises(InputError, match="found neither"):
        simulate_recording(SimulationSpec())
    with pytest.raises(InputError, match="found both"):
        simulate_recording(SimulationSpec("pendulum", model=tmp_path / "arm.xml"))
    with pytest.raises(InputError, match=r"'elbo'; there are: \*, elbow, shoulder"):
        simulate_recording(
            SimulationSpec(model=written(tmp_path), effects={"drag.linear@elbo": 0.1})
        )


@pytest.fixture
def odd_log(tmp_path):
    """Log in which degrees are declared as radians and one command is missing."""
    written(tmp_path)
    k = np.arange(20)
    description = describe({"q.shoulder": "rad", "u.s_elbow": "rad"}, model="swinging")
    run = (k / 50, 0.1 * k, 30.0 * np.sin(k))
    return write_log(tmp_path, description, "u.s_elbow,q.shoulder", [run, run])


def test_inspect_says_what_is_odd_about_a_robots_log(odd_log, tmp_path):
    said = run_command("inspect", odd_log, "--out", tmp_path / "figures").out
    assert "(MJCF): 2 joints, 2 actuators, 2 moving bodies; implicitfast at 5 ms" in said
    assert "warning: not in the log, assumed to be zero: u.m_shoulder" in said
    assert "with initial values from the model file: elbow" in said
    assert "q.shoulder ranges from -30 to 29.72 rad in runs 1, 2, and swinging.xml" in said
    assert (
        "u.s_elbow ranges from 0 to 1.9 in runs 1, 2, and swinging.xml states -0.5 to 0.9" in said
    )


def test_inspect_says_nothing_odd_of_a_sound_log(tmp_path):
    made = simulate_recording(SimulationSpec(model=written(tmp_path), noise=1e-3, **SHORT))
    made.write(tmp_path / "log.csv")
    assert (
        "warning:"
        not in run_command("inspect", tmp_path / "log.csv", "--out", tmp_path / "figures").out
    )


def test_repairs_of_a_model_are_reported(tmp_path):
    urdf = """<robot name="r"><link name="base"/><link name="arm"><inertial><mass value="1"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
    <joint name="j" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
    <limit effort="5" velocity="1"/></joint><transmission name="t"/></robot>"""
    (tmp_path / "r.urdf").write_text(urdf)
    said = run_command("list", "places", "--model", tmp_path / "r.urdf").out
    assert "note: ignored, since MuJoCo has no equivalent: <transmission>" in said
    assert "hinge, effort 5 N·m" in said
    words = said.partition("MuJoCo's words: ")[2]
    assert "damping" in words
    assert "kp" not in words, "it has no servo"


def test_places_of_a_robot_are_listed(tmp_path):
    model = str(written(tmp_path))
    said = run_command("list", "places", "--model", model).out
    for words in (
        "shoulder                 hinge, -1.5 to 1.5 rad",
        "m_shoulder               motor on shoulder, -3 to 3 N·m",
        "fore                     0.8 kg",
        "u.s_elbow                rad",
        "tau.elbow",
        "effects at a joint, as drag.linear@NAME or @*",
        "damping",
    ):
        assert words in said
    run_command("list", "places", code=2)
    run_command("list", "effects", "--model", model, code=2)


def test_signals_are_added_and_a_multisine_begins_at_rest_within_its_amplitude():
    times = np.arange(400) / 100.0
    waves = evaluate_signal("multisine:0.4:0.3:2", times, np.random.default_rng(3))
    assert waves[0] == 0.0
    assert np.abs(waves).max() == pytest.approx(0.4)
    power = np.abs(np.fft.rfft(waves)) ** 2
    hertz = np.fft.rfftfreq(times.size, 0.01)
    assert power[(hertz < 0.2) | (hertz > 2.5)].sum() < 0.2 * power.sum()
    about = evaluate_signal("-0.7 + multisine:0.4:0.3:2", times, np.random.default_rng(3))
    np.testing.assert_allclose(about, waves - 0.7)
    with pytest.raises(InputError, match="multisine:AMPLITUDE:HERTZ:HERTZ"):
        evaluate_signal("multisine:0.4:0.3", times, np.random.default_rng(0))
