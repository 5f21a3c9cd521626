"""Tests of `simgap import`: raw logs become a description that each command reads."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import simgap
from bench.core.plugin_registries import make_robot_simulator
from bench.logs.recording_loading import load_recording
from sims.core.simulator import InputError, Scenario
from tests.bench.diagnosis.test_robot_input_errors import ARM
from tests.command_output import run_command

TIMES = np.arange(200) / 50.0


@pytest.fixture
def arm(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    return tmp_path / "arm.xml"


@pytest.fixture
def bare(tmp_path):
    """Return the model file of the arm without its actuators."""
    (tmp_path / "bare.xml").write_text(ARM[: ARM.index("<actuator>")] + "</mujoco>")
    return tmp_path / "bare.xml"


def motion(arm):
    """Return commands (T, 2) and the simulated positions and rates (T, 2) of the arm."""
    names = ["q.shoulder", "q.elbow", "qd.shoulder", "qd.elbow"]
    commands = np.column_stack([np.sin(3 * TIMES), 0.7 * np.cos(2 * TIMES)])
    given = {"u.m_shoulder": commands[:, 0], "u.m_elbow": commands[:, 1]}
    kind = make_robot_simulator(arm)
    seen = kind(observe=names).simulate(np.empty((1, 0)), Scenario(TIMES, {"q.elbow": 0.7}, given))
    order = [[c.name for c in kind(observe=names).channels].index(name) for name in names]
    seen = seen[0][:, order]
    return commands, seen[:, :2], seen[:, 2:]


def logged(folder, commands, positions, rates):
    """Write one run as two files: degrees, a microsecond clock, lists and text in cells."""
    stamps = 1.7e15 + 1e6 * TIMES
    degrees = np.degrees(positions)
    rows = ["TIMESTAMP;Elbow Position;Shoulder Position;note;Joint_Vel;temperature"]
    for t, (s, e), v in zip(stamps, degrees, np.degrees(rates), strict=True):
        cells = f"{t:.0f};{e:.6f};{s:.6f};ok;[{v[0]:.5f} {v[1]:.5f}];20,5"
        rows.append(cells.replace(".", ","))
    (folder / "motor_state.csv").write_text("\n".join(rows).replace(",", ".") + "\n")
    table = ["TIMESTAMP,target[0],target[1]"]
    table += [f"{t:.0f},{a:.8f},{b:.8f}" for t, (a, b) in zip(stamps, commands, strict=True)]
    (folder / "commands.csv").write_text("\n".join(table) + "\n")
    return [folder / "motor_state.csv", folder / "commands.csv"]


def test_a_log_of_other_words_and_units_is_read_as_what_it_is(arm, tmp_path):
    commands, positions, rates = motion(arm)
    files = logged(tmp_path, commands, positions, rates)
    out = tmp_path / "log.toml"
    said = run_command("import", *files, "--model", arm, "--out", out).out
    assert "q.elbow: motor_state.csv, column Elbow Position, by its name; in deg" in said
    assert "time: column TIMESTAMP in us, 50 Hz" in said
    assert "column temperature: its meaning is unknown; left out" in said
    recording, _ = load_recording(out)
    run = recording.runs[0]
    seen = np.concatenate([r.channels["q.elbow"] for r in recording.runs])
    np.testing.assert_allclose(seen, positions[:, 1], atol=2e-8)
    rate = np.concatenate([r.channels["qd.shoulder"] for r in recording.runs])
    np.testing.assert_allclose(rate, rates[:, 0], atol=2e-7)
    assert set(run.inputs) == {"u.m_shoulder", "u.m_elbow"}
    np.testing.assert_allclose(run.inputs["u.m_elbow"], commands[: run.times.size, 1], atol=1e-8)
    assert "# guess" in out.read_text()


def test_a_robot_without_actuators_gets_servos_whose_gains_are_not_known(arm, bare, tmp_path):
    files = logged(tmp_path, *motion(arm))
    made = simgap.import_logs(files, bare, tmp_path / "log.toml")
    assert any("gains of the servo of elbow" in line for line in made.guessed)
    _, kind = load_recording(tmp_path / "log.toml")
    assert [a.kind for a in kind.robot.actuators] == ["position", "position"]
    assert 'free = ["actuator.stiffness@*", "actuator.damping@*"]  # not known' in made.text
    assert kind.free == ("actuator.stiffness@*", "actuator.damping@*")


def test_runs_that_are_held_out_by_name(arm, tmp_path):
    folders = []
    for name in ("one", "two", "three"):
        (tmp_path / name).mkdir()
        logged(tmp_path / name, *motion(arm))
        folders.append(tmp_path / name)
    simgap.import_logs(folders, arm, tmp_path / "log.toml", held_out=["one"])
    recording, _ = load_recording(tmp_path / "log.toml")
    assert [run.name for run in recording.held_out()] == ["one"]
    with pytest.raises(
        InputError, match=r"unknown run held out 'four'; there are: one, three, two"
    ):
        simgap.import_logs(folders, arm, tmp_path / "other.toml", held_out=["four"])
    assert not (tmp_path / "other.toml").exists()


def test_a_velocity_that_is_late_is_left_out(arm, tmp_path):
    commands, positions, rates = motion(arm)
    late = np.vstack([rates[:2], rates[:-2]])
    made = simgap.import_logs(logged(tmp_path, commands, positions, late), arm, tmp_path / "l.toml")
    assert "qd.shoulder" not in made.text
    assert any("samples behind the derivative of Shoulder Pos" in line for line in made.untold)


def test_what_cannot_be_is_left_out_and_said(arm, tmp_path):
    commands, positions, rates = motion(arm)
    wrong = np.column_stack([rates[:, 1], np.zeros(len(rates))])
    made = simgap.import_logs(
        logged(tmp_path, commands, positions, wrong), arm, tmp_path / "l.toml"
    )
    told = "\n".join(made.untold)
    assert "Joint_Vel[0]: is not the derivative of Shoulder Position" in told
    assert "Joint_Vel[1]: never changes" in told
    assert "qd." not in made.text


INVALID_INPUTS = {
    "nothing": ({"a.csv": "t,heat\n0,20\n0.1,21\n0.2,20\n"}, r"no column is a joint's position"),
    "no stamps": ({"a.csv": "q1,q2\n0,0\n1,1\n0,0\n"}, r"no column increases from row to row"),
    "no rate": ({"a.csv": "t,q1\n0,0\n0.00001,1\n0.00002,0\n"}, r"stamps 1e-05 apart are not "
    "plausible"),
    "two clocks": (
        {"a.csv": "t,q1\n0,0\n0.1,1\n0.2,0\n", "b.csv": "time,u1\n0,0\n100,1\n200,0\n"},
        r"its stamps are called time \(ms\), those of the files before t \(s\)",
    ),
    "none": ({}, r"a.csv: no such file"),
}  # fmt: skip


@pytest.mark.parametrize("name", INVALID_INPUTS)
def test_a_fault_is_one_line_and_nothing_is_written(name, arm, tmp_path):
    files, message = INVALID_INPUTS[name]
    for file, text in files.items():
        (tmp_path / file).write_text(text)
    out = tmp_path / "new" / "log.toml"
    with pytest.raises(InputError, match=message):
        simgap.import_logs([tmp_path / file for file in files or ["a.csv"]], arm, out)
    assert not out.exists()


def test_what_is_there_is_not_overwritten(arm, tmp_path):
    out = tmp_path / "log.toml"
    out.write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        simgap.import_logs(logged(tmp_path, *motion(arm)), arm, out)
    with pytest.raises(InputError, match=r"expected a description to write, NAME\.toml"):
        simgap.import_logs(logged(tmp_path, *motion(arm)), arm, tmp_path / "log.csv")
    assert out.read_text() == "mine"


CELLS = st.sampled_from(
    ["", "0", "1.5", "-3", "nan", "1e400", "[1, 2]", "[1]", "x", '"', ";", "inf"]
)


@settings(max_examples=150, deadline=None)
@given(
    st.lists(st.sampled_from(["t", "q0", "q1", "u0", "vel", "", "t"]), min_size=1, max_size=4),
    st.lists(st.lists(CELLS, min_size=1, max_size=4), max_size=6),
    st.sampled_from([",", ";", "\t"]),
)
def test_malformed_logs_are_one_line_and_leave_nothing(tmp_path_factory, head, rows, separator):
    folder = tmp_path_factory.mktemp("log")
    (folder / "arm.xml").write_text(ARM)
    text = "\n".join(separator.join(cells) for cells in (head, *rows))
    (folder / "log.csv").write_text(text)
    out = folder / "made.toml"
    said = ""
    try:
        simgap.import_logs([folder / "log.csv"], folder / "arm.xml", out)
    except InputError as error:
        said = str(error)
    assert bool(said) != out.exists()
    assert "\n" not in said
    if not said:
        load_recording(out)


# -- joints that stand still, and publishers that alternate

WAVES = np.column_stack([np.sin(3 * TIMES - 0.1), 0.7 * np.cos(2 * TIMES - 0.1)])
SLOPES = np.column_stack([3 * np.cos(3 * TIMES - 0.1), -1.4 * np.sin(2 * TIMES - 0.1)])


def written(folder, name, columns):
    """Write a table of columns by name; NaN is an empty cell."""
    folder.mkdir(exist_ok=True)
    pd.DataFrame(columns).to_csv(folder / name, index=False)
    return folder / name


def log_with_held_joint(folder, moving):
    """Write a log in which one joint of the arm moves and the other is held, with noise."""
    rng, columns = np.random.default_rng(3), {"t": TIMES}
    commands = np.sin(3 * TIMES), 0.7 * np.cos(2 * TIMES)
    for k, joint in enumerate(("shoulder", "elbow")):
        noise = 1e-3 * rng.standard_normal(TIMES.size)
        held = 0.3 + 0.02 * noise, noise, np.full(TIMES.size, 0.3)
        signals = (WAVES[:, k], SLOPES[:, k], commands[k]) if joint == moving else held
        columns |= dict(zip((f"{joint}_pos", f"{joint}_vel", f"{joint}_cmd"), signals, strict=True))
    return written(folder, "log.csv", columns)


def test_two_logs_of_one_logger_have_the_same_velocities(arm, tmp_path):
    texts = []
    for moving in ("shoulder", "elbow"):
        log = log_with_held_joint(tmp_path / moving, moving)
        made = simgap.import_logs([log], arm, tmp_path / f"{moving}.toml")
        texts.append([line for line in made.text.splitlines() if "qd." in line])
        held_joint = "elbow" if moving == "shoulder" else "shoulder"
        line = f"in rad/s, as the other velocities are; {held_joint} hardly moves"
        assert any(line in guess for guess in made.guessed)
    assert [sorted(line.partition("]")[0] for line in text) for text in texts] == [
        ['[channels."qd.elbow"', '[channels."qd.shoulder"']
    ] * 2


def test_gains_of_a_joint_that_the_log_does_not_move_are_said_and_not_fitted(bare, tmp_path):
    made = simgap.import_logs(
        [log_with_held_joint(tmp_path / "a", "shoulder")], bare, tmp_path / "log.toml"
    )
    (check,) = made.checks
    assert check.startswith("gains of the servo of elbow: the log does not move this joint")
    assert "state those of the drive in [actuators.m_elbow]" in check
    _, kind = load_recording(tmp_path / "log.toml")
    assert kind.free == ("actuator.stiffness@m_shoulder", "actuator.damping@m_shoulder")


def test_velocities_of_two_publishers_that_alternate_are_read(arm, tmp_path):
    """One topic, two publishers: each row has the joints of one of them."""
    first = np.arange(TIMES.size) % 2 == 0
    columns = {"t": TIMES}
    for k, (joint, mine) in enumerate((("shoulder", first), ("elbow", ~first))):
        columns[f"position.{joint}"] = np.where(mine, WAVES[:, k], np.nan)
        columns[f"velocity.{joint}"] = np.where(mine, SLOPES[:, k], np.nan)
    made = simgap.import_logs(
        [written(tmp_path, "states.csv", columns)], arm, tmp_path / "log.toml"
    )
    assert "in rad/s, as the derivative of position.elbow" in "\n".join(made.guessed)
    recording, _ = load_recording(tmp_path / "log.toml", divide=False)
    seen = recording.runs[0].channels["qd.elbow"]
    np.testing.assert_allclose(seen[~first], SLOPES[~first, 1], atol=1e-6)
    assert np.isnan(seen[first]).all()


def test_a_column_of_zeros_and_ones_that_changes_is_kept_as_a_switch(arm, tmp_path):
    columns = {"t": TIMES, "shoulder_pos": WAVES[:, 0], "elbow_pos": WAVES[:, 1]}
    columns |= {"torque_enable": (TIMES < 2.0) * 1.0, "mode": np.ones(TIMES.size)}
    made = simgap.import_logs([written(tmp_path, "log.csv", columns)], arm, tmp_path / "log.toml")
    assert any("column torque_enable, zeros and ones; if it shows" in g for g in made.guessed)
    assert "column mode: its meaning is unknown; left out" in "\n".join(made.untold)
    recording, _ = load_recording(tmp_path / "log.toml", divide=False)
    np.testing.assert_array_equal(
        recording.runs[0].extra["torque_enable"], columns["torque_enable"]
    )
