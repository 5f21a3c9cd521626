"""Tests of `simgap import` for common log formats: nothing is misread without a message. Most logs
are written here; shared cases of the same formats are read where available.
"""

import json
import os
from pathlib import Path

import numpy as np
import pytest

import simgap
from bench.core.plugin_registries import make_robot_simulator
from bench.logs.importing.joint_order import find_order_by_commands
from bench.logs.quality.log_quality import check_recording_plausible
from bench.logs.recording_loading import load_recording
from sims.core.simulator import InputError, Scenario
from tests.bench.logs import log_writers
from tests.bench.logs.log_writers import make_dataset_folder, make_episode
from tests.command_output import run_command

CASES = Path(os.environ.get("SIMGAP_DATA", "")).parent / "cases"
JOINTS = ("yaw", "lift", "bend")
ARM = """<mujoco model="arm"><compiler angle="radian" autolimits="true"/><worldbody>
<body><joint name="yaw" axis="0 0 1" range="-2 2"/><geom size="0.1" pos="0.1 0 0"/>
<body pos="0.3 0 0"><joint name="lift" axis="0 1 0" range="-2 2"/><geom size="0.1" pos="0.1 0 0"/>
<body pos="0.3 0 0"><joint name="bend" axis="0 1 0" range="-2 2"/><geom size="0.1" pos="0.1 0 0"/>
</body></body></body></worldbody><actuator>{}</actuator></mujoco>"""
SERVO = '<position name="m_{0}" joint="{0}" kp="100" kv="10"/>'
MOTOR = '<motor name="m_{0}" joint="{0}"/>'
VELOCITY = '<velocity name="m_{0}" joint="{0}" kv="10"/>'
TIMES = np.arange(200) / 50.0
COMMANDS, POSITIONS = (
    np.column_stack(
        [
            0.8 * np.sin(3 * TIMES - lag),
            0.5 * np.cos(2 * TIMES - lag) - 0.4,
            0.6 * np.sin(5 * TIMES - lag) + 0.3,
        ]
    )
    for lag in (0.0, 0.1)
)
RATES = np.gradient(POSITIONS, TIMES, axis=0)


@pytest.fixture
def arm(tmp_path):
    return model(tmp_path, SERVO)


def model(folder, drive):
    path = folder / "arm.xml"
    path.write_text(ARM.format("".join(drive.format(joint) for joint in JOINTS)))
    return path


def table(path, columns, separator=",", comma=False, above=""):
    """Write a text table from columns by name."""
    rows = [separator.join(columns)]
    for row in np.column_stack(list(columns.values())):
        cells = separator.join(f"{value:.9g}" for value in row)
        rows.append(cells.replace(".", ",") if comma else cells)
    path.write_text(above + "\n".join(rows) + "\n", encoding="utf-8")
    return path


def named(word, values, size=1.0):
    """Return a column of values (T, 3) for each joint, by names such as ``{}_pos``."""
    return {word.format(joint): size * values[:, k] for k, joint in enumerate(JOINTS)}


def imported(folder, columns, arm, name="log"):
    """Import a table of columns after the stamps as NAME.toml."""
    log = table(folder / f"{name}.csv", {"t": TIMES} | columns)
    return simgap.import_logs([log], arm, folder / f"{name}.toml")


def check_lines(*words):
    """Return the lines of `simgap import` that ask the user to check a guess."""
    lines = run_command("import", *words).out.splitlines()
    return [line for line in lines if line.startswith("check: ")]


def channel(out, name):
    return first_run(out).channels[name]


def inputs(out):
    return first_run(out).inputs


def first_run(out):
    recording, _ = load_recording(out, divide=False)
    return recording.runs[0]


def right(out, atol=1e-6):
    """Check that positions and commands are assigned to the right joints."""
    for k, joint in enumerate(JOINTS):
        seen = channel(out, f"q.{joint}")
        np.testing.assert_allclose(seen[np.isfinite(seen)], POSITIONS[:, k], atol=atol)
        if f"u.m_{joint}" in inputs(out):
            np.testing.assert_allclose(inputs(out)[f"u.m_{joint}"], COMMANDS[:, k], atol=atol)


# -- names and order


@pytest.mark.parametrize("commanded", [log_writers.JOINTS, log_writers.JOINTS[::-1]])
def test_joint_names_of_rostopic_are_used_and_commands_follow(commanded, tmp_path):
    log_writers.write_rostopic(tmp_path, 0, 200, commanded)
    (tmp_path / "two.xml").write_text(log_writers.ARM)
    out = tmp_path / "l.toml"
    made = simgap.import_logs([tmp_path / "run0"], tmp_path / "two.xml", out)
    assert made.checks == []
    assert "column field.position.knee, by its name" in "\n".join(made.guessed)
    _, q, u = log_writers.motion(0)
    np.testing.assert_allclose(channel(out, "q.knee"), q[:, 1], atol=1e-8)
    np.testing.assert_allclose(inputs(out)["u.m_knee"], u[:, 1], atol=1e-8)


def test_an_order_that_nothing_tells_is_said_to_be_a_guess(arm, tmp_path):
    np.savez(tmp_path / "log.npz", timestamp=TIMES, actual_q=POSITIONS, actual_qd=RATES,
             target_q=COMMANDS)  # fmt: skip
    files = [str(tmp_path / "log.npz"), "--model", str(arm), "--out", str(tmp_path / "log.toml")]
    (line,) = check_lines(*files)
    assert line.startswith("check: order of joints: the log does not name those of its columns")
    assert "yaw, lift, bend, which is a guess (sorted by name, as ROS drivers have it" in line
    assert "# check: order of joints" in (tmp_path / "log.toml").read_text()


@pytest.mark.parametrize("order", [(0, 1, 2), (0, 2, 1), (1, 2, 0)])
@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_an_order_without_names_is_the_one_that_the_model_prefers(order, friction, arm, tmp_path):
    real = tmp_path / "real.xml"
    real.write_text(arm.read_text().replace('axis="0 1 0"', f'axis="0 1 0" damping="{friction}"'))
    names = [f"q.{joint}" for joint in JOINTS]
    given = {f"u.m_{joint}": COMMANDS[:, k] for k, joint in enumerate(JOINTS)}
    kind = make_robot_simulator(real)
    seen = kind(observe=names).simulate(np.empty((1, 0)), Scenario(TIMES, {}, given))[0]
    places = [[c.name for c in kind(observe=names).channels].index(name) for name in names]
    positions = seen[:, places] + 1e-4 * np.random.default_rng(0).standard_normal(seen.shape)
    rates = np.gradient(positions, TIMES, axis=0)
    own = list(order)
    np.savez(tmp_path / "log.npz", t=TIMES, actual_q=positions[:, own], actual_qd=rates[:, own],
             target_q=COMMANDS[:, own])  # fmt: skip
    made = simgap.import_logs([tmp_path / "log.npz"], arm, tmp_path / "log.toml")
    for k, joint in enumerate(JOINTS):
        np.testing.assert_allclose(channel(tmp_path / "log.toml", f"q.{joint}"), positions[:, k])
        np.testing.assert_allclose(channel(tmp_path / "log.toml", f"qd.{joint}"), rates[:, k])
        np.testing.assert_allclose(inputs(tmp_path / "log.toml")[f"u.m_{joint}"], COMMANDS[:, k])
    (check,) = made.checks
    assert "which is a guess" in check or "it is a guess: compare it" in check
    if order != (0, 1, 2):
        assert (
            f"taken in the order {', '.join(JOINTS[k] for k in order)}, in which the model" in check
        )


@pytest.mark.parametrize("order", [(0, 2, 1), (2, 0, 1)])
def test_positions_without_names_go_where_they_follow_named_commands(order, arm, tmp_path):
    columns = named("{}_cmd", COMMANDS)
    columns |= {f"q{place}": POSITIONS[:, k] for place, k in enumerate(order)}
    columns |= {f"qd{place}": RATES[:, k] for place, k in enumerate(order)}
    made = imported(tmp_path, columns, arm)
    right(tmp_path / "log.toml")
    np.testing.assert_allclose(channel(tmp_path / "log.toml", "qd.bend"), RATES[:, 2], atol=1e-6)
    assert "in the order in which positions follow their commands" in "\n".join(made.guessed)
    assert made.checks == []


def test_an_array_of_names_is_the_order(arm, tmp_path):
    order = [2, 0, 1]
    names = np.array([JOINTS[k] for k in order])
    np.savez(tmp_path / "log.npz", t=TIMES, q=POSITIONS[:, order], target=COMMANDS[:, order],
             joint_names=names)  # fmt: skip
    made = simgap.import_logs([tmp_path / "log.npz"], arm, tmp_path / "log.toml")
    right(tmp_path / "log.toml")
    assert made.checks == []


def test_numbers_of_joints_are_no_guess(tmp_path):
    arm = tmp_path / "arm.xml"
    text = ARM.format("")
    for k, joint in enumerate(JOINTS, start=1):
        text = text.replace(joint, f"axis{k}")
    arm.write_text(text)
    made = imported(tmp_path, {f"q{k + 1}": POSITIONS[:, k] for k in range(3)}, arm)
    assert not any("order of joints" in line for line in made.checks)


def test_an_order_is_found_by_the_distance_of_positions_from_commands():
    u, q = COMMANDS.T, POSITIONS.T
    assert find_order_by_commands(u, q) is None
    assert find_order_by_commands(u, q[[1, 2, 0]]) == [2, 0, 1]
    # Two joints with equal motion, or a few samples, do not determine the order.
    assert find_order_by_commands([u[0], u[0]], [q[0], q[0]]) is None
    assert find_order_by_commands(u[:, :9], q[[1, 2, 0]][:, :9]) is None


# -- units


UNITS = {
    "{} [deg]": ("t [ms]", 180 / np.pi), "{}_deg": ("t_ms", 180 / np.pi),
    "{} (rad)": ("Zeit (ms)", 1.0), "pos {} / mrad": ("time / ms", 1e3),
    "{}Deg": ("tMs", 180 / np.pi),
    "{} [turns]": ("t {ms}", 1 / (2 * np.pi)),
}  # fmt: skip


@pytest.mark.parametrize("style", UNITS)
@pytest.mark.parametrize(("separator", "comma"), [(";", True), ("\t", True), (",", False)])
def test_units_in_names_are_read(style, separator, comma, arm, tmp_path):
    time, size = UNITS[style]
    columns = {time: 1e3 * TIMES} | named(style, POSITIONS, size)
    columns |= named(style.format("{}_soll"), COMMANDS, size)
    log = table(tmp_path / "log.csv", columns, separator, comma, "# exported 26.11.2026\n")
    made = simgap.import_logs([log], arm, tmp_path / "log.toml")
    right(tmp_path / "log.toml")
    assert made.untold == made.checks == []
    assert f"time: column {time} in ms, 50 Hz" in made.guessed


def test_a_row_of_units_is_read(arm, tmp_path):
    log = table(tmp_path / "log.csv", {"t": 1e3 * TIMES} | named("{}", np.degrees(POSITIONS)), ";")
    log.write_text(log.read_text().replace("bend\n", "bend\n[ms];[deg];[deg];[deg]\n"))
    simgap.import_logs([log], arm, tmp_path / "log.toml")
    right(tmp_path / "log.toml")


def test_counts_of_an_encoder_are_no_angles(arm, tmp_path):
    columns = {"yaw [counts]": np.round(100 * POSITIONS[:, 0]), "lift": POSITIONS[:, 1]}
    made = imported(tmp_path, columns, arm)
    assert any("column yaw [counts]: is in counts, expected an angle" in line
               for line in made.untold)  # fmt: skip
    assert "q.yaw" not in made.text


# -- kind of a command


@pytest.mark.parametrize("word", ["q_des", "desired_position", "cmd"])
def test_a_desired_position_is_no_torque(word, tmp_path):
    arm = model(tmp_path, MOTOR)
    columns = named("{}", POSITIONS) | named(word + "_{}", COMMANDS)
    made = imported(tmp_path, columns, arm)
    line = f"column {word}_yaw: is a desired position of yaw, and m_yaw takes a torque"
    assert line in "\n".join(made.untold)
    assert inputs(tmp_path / "log.toml") == {}
    (check,) = made.checks
    assert check.startswith("actuators without an input: m_yaw, m_lift, m_bend; their commands")
    assert f"possible columns: {word}_yaw" in check


@pytest.mark.parametrize(
    ("drive", "word", "line"),
    [
        (SERVO, "tau_cmd_{}", "is a desired torque of yaw, and m_yaw takes a position"),
        (SERVO, "desired_velocity_{}", "is a desired velocity of yaw, and m_yaw takes a position"),
        (
            VELOCITY,
            "position_target_{}",
            "is a desired position of yaw, and m_yaw takes a velocity",
        ),
        ("", "desired_velocity_{}", "commands a velocity of yaw, but no actuator has this command"),
    ],
)
def test_a_command_of_another_kind_is_left_out(drive, word, line, tmp_path):
    columns = named("{}", POSITIONS) | named(word, COMMANDS)
    made = imported(tmp_path, columns, model(tmp_path, drive))
    assert f"column {word.format('yaw')}: {line}; left out" in "\n".join(made.untold)
    assert inputs(tmp_path / "log.toml") == {}


@pytest.mark.parametrize(
    ("drive", "name", "word"),
    [(MOTOR, "u.m_{}", "effort_{}"), ("", "force.{}", "tau_{}"), (MOTOR, "u.m_{}", "{} [Nm]")],
)
def test_torques_drive_what_nothing_commands(drive, name, word, tmp_path):
    columns = named("{}_pos", POSITIONS) | named(word, COMMANDS, 7)
    made = imported(tmp_path, columns, model(tmp_path, drive))
    assert made.checks == []
    assert "measured, because no column has its command" in "\n".join(made.guessed)
    np.testing.assert_allclose(
        inputs(tmp_path / "log.toml")[name.format("bend")], 7 * COMMANDS[:, 2], atol=1e-6
    )


def test_of_several_torques_the_measured_one_drives_else_none(tmp_path):
    arm = model(tmp_path, "")
    columns = named("{}_pos", POSITIONS)
    for k, word in enumerate(("tau_con", "tau_fric", "tau_meas")):
        columns |= named("{}_" + word, COMMANDS, k + 1)
    imported(tmp_path, columns, arm)
    seen = inputs(tmp_path / "log.toml")["force.bend"]
    np.testing.assert_allclose(seen, 3 * COMMANDS[:, 2], atol=1e-6)
    columns = {name.replace("meas", "other"): values for name, values in columns.items()}
    made = imported(tmp_path, columns, arm, "o")
    assert inputs(tmp_path / "o.toml") == {}
    (check,) = made.checks
    assert "no actuator drives it; possible columns: yaw_tau_con, lift_tau_con" in check


def test_a_model_without_an_input_is_said(tmp_path):
    columns = named("{}_pos", POSITIONS) | named("{}_current", COMMANDS)
    made = imported(tmp_path, columns, model(tmp_path, ""))
    (check,) = made.checks
    assert check.startswith("the model has no input, so no actuator drives it; possible columns")
    assert "possible columns: yaw_current, lift_current, bend_current" in check


def test_a_temperature_is_no_angle_and_a_current_position_no_current(arm, tmp_path):
    columns = {"yaw_temp": 20 + TIMES, "yaw_current_position": POSITIONS[:, 0],
               "lift_error": 0.1 * TIMES, "lift": POSITIONS[:, 1]}  # fmt: skip
    made = imported(tmp_path, columns, arm)
    assert 'column = "yaw_current_position"' in made.text
    assert 'column = "lift"' in made.text
    assert "column yaw_temp: its meaning is unknown" in "\n".join(made.untold)


def test_words_that_every_joint_of_a_model_has_are_not_needed(tmp_path):
    text = ARM.format("")
    for joint in JOINTS:
        text = text.replace(f'"{joint}"', f'"{joint}_joint"')
    (tmp_path / "arm.xml").write_text(text)
    made = imported(tmp_path, named("{}_pos", POSITIONS), tmp_path / "arm.xml")
    assert "q.bend_joint: log.csv, column bend_pos, by its name" in "\n".join(made.guessed)


# -- files, headers and stamps


def logged(folder, name="log.csv"):
    columns = {"t": TIMES} | named("{}_pos", POSITIONS) | named("{}_cmd", COMMANDS)
    folder.mkdir(exist_ok=True)
    return table(folder / name, columns)


EVENTS = {
    "an event each second": "t,event\n0.5,1\n1.8,2\n",
    "texts": "when,what\nnow,begin\nlater,end\n",
    "one row": "t,event\n0.5,1\n",
    "nothing": "",
    "another clock": "stamp_ms,level\n0,1\n20,1\n40,2\n",
    "no header": "0.5,1\n1.5,2\n2.5,7\n",
    "uneven": "t,a\n0,1,2\n",
}


@pytest.mark.parametrize("name", EVENTS)
def test_a_small_file_of_events_does_not_stop_the_others(name, arm, tmp_path):
    for run in ("one", "two"):
        logged(tmp_path / run)
        (tmp_path / run / "events.csv").write_text(EVENTS[name])
    made = simgap.import_logs([tmp_path / "one", tmp_path / "two"], arm, tmp_path / "log.toml")
    right(tmp_path / "log.toml")
    (line,) = (line for line in made.untold if line.startswith("events.csv: "))
    assert line.endswith("; left out")
    # A file that the user names explicitly must be readable.
    files = [tmp_path / "one" / "log.csv", tmp_path / "one" / "events.csv"]
    with pytest.raises(InputError, match=r"events\.csv"):
        simgap.import_logs(files, arm, tmp_path / "other.toml")


def test_a_table_without_a_header_is_refused_and_nothing_written(arm, tmp_path):
    log = logged(tmp_path / "run")
    log.write_text(log.read_text().partition("\n")[2])
    out = tmp_path / "new" / "log.toml"
    said = run_command("import", log, "--model", arm, "--out", out, code=2).err.splitlines()
    assert len(said) == 1
    assert (
        "log.csv, row 1: expected a header that names the 7 columns, found numbers; put one"
        in (said[0])
    )
    assert "t,yaw_pos,lift_pos,bend_pos" in said[0]
    assert not out.exists()


@pytest.mark.parametrize("bad_row", ["0.5,1\n", "0.5,1,2,3,4,5,6,7,8\n", '0.5,"1,2,3,4,5,6\n'])
def test_a_broken_row_is_one_line_and_nothing_is_written(bad_row, arm, tmp_path):
    log = logged(tmp_path / "run")
    lines = log.read_text().splitlines(keepends=True)
    log.write_text("# a note\n" + "".join([*lines[:50], bad_row, *lines[50:]]))
    out = tmp_path / "log.toml"
    (line,) = run_command("import", log, "--model", arm, "--out", out, code=2).err.splitlines()
    assert "log.csv, row 52: " in line
    assert not any(word in line.lower() for word in ("tokeniz", "c error", "parser", "traceback"))
    assert not out.exists()


def test_rows_without_stamps_need_a_rate(arm, tmp_path):
    columns = named("{}", POSITIONS) | named("{}_cmd", COMMANDS)
    log, out = table(tmp_path / "log.csv", columns), tmp_path / "log.toml"
    files = [str(log), "--model", str(arm), "--out", str(out)]
    assert "state the rate of the rows with --rate HZ" in run_command("import", *files, code=2).err
    run_command("import", *files, "--rate", "50")
    assert "[time]\nrate = 50.0\n" in out.read_text()
    right(out)
    np.testing.assert_allclose(first_run(out).times, TIMES, atol=1e-12)
    run_command("import", *files[:-1], tmp_path / "o.toml", "--rate", "0", code=2)


def test_a_stamp_that_comes_twice_is_said_and_its_row_left_out(arm, tmp_path):
    log = logged(tmp_path / "run")
    lines = log.read_text().splitlines(keepends=True)
    log.write_text("".join([*lines[:30], lines[29], *lines[30:]]))
    made = simgap.import_logs([log], arm, tmp_path / "log.toml")
    right(tmp_path / "log.toml")
    line = "log.csv: 1 of 201 stamps repeat the one before; their rows are left out"
    assert line in made.untold
    recording, kind = load_recording(tmp_path / "log.toml")
    assert any(
        "1 of 201 stamps repeat" in odd for odd in check_recording_plausible(recording, kind)
    )


def test_files_of_the_same_columns_are_runs(arm, tmp_path):
    files = [logged(tmp_path / "logs", f"run{k}.csv") for k in (1, 2, 3)]
    for given in (files, [tmp_path / "logs"]):
        out = tmp_path / f"{len(given)}.toml"
        made = simgap.import_logs(given, arm, out, held_out=["run2"])
        recording, _ = load_recording(out)
        assert [run.name for run in recording.runs] == ["run1", "run2", "run3"]
        assert [run.name for run in recording.held_out()] == ["run2"]
        assert made.untold == []
        right(out)


# -- normalised positions of LeRobot


def dataset(folder, positions, commands):
    data = make_dataset_folder(folder, "3.0", JOINTS, 50)
    make_episode(0, TIMES, positions, commands).to_parquet(data / "file-000.parquet")
    return folder


RANGES = {"yaw": (1000, 3000, 0), "lift": (500, 3500, 1), "bend": (1200, 3000, 0)}
CALIBRATION = {
    joint: {"id": k, "drive_mode": mode, "homing_offset": 17, "range_min": low, "range_max": high}
    for k, (joint, (low, high, mode)) in enumerate(RANGES.items())
}


def normalised(angles):
    """Normalise positions (T, 3) to -100..100 as LeRobot does."""
    columns = []
    for k, (low, high, mode) in enumerate(RANGES.values()):
        counts = np.degrees(angles[:, k]) * 4095 / 360 + 0.5 * (low + high)
        value = (counts - low) / (high - low) * 200 - 100
        columns.append(-value if mode else value)
    return np.column_stack(columns)


def test_positions_of_lerobot_may_be_normalised_and_it_is_said(arm, tmp_path):
    folder = dataset(tmp_path / "set", normalised(POSITIONS), normalised(COMMANDS))
    out = tmp_path / "log.toml"
    (line,) = check_lines(folder, "--model", arm, "--out", out)
    assert line.startswith("check: positions lie within -100 to 100: they are read as degrees")
    assert "--calibration FILE" in line
    odd = check_recording_plausible(*load_recording(out))
    assert any(
        text.startswith("positions of a LeRobot dataset are read as degrees") for text in odd
    )


@pytest.mark.parametrize("where", ["", "set/meta/calibration.json", "set/arm.json", "arm.json"])
def test_a_calibration_makes_angles_of_normalised_positions(where, arm, tmp_path):
    folder = dataset(tmp_path / "set", normalised(POSITIONS), normalised(COMMANDS))
    file = tmp_path / (where or "elsewhere.toml")
    file.write_text(json.dumps(CALIBRATION))
    out, more = tmp_path / "log.toml", {} if where else {"calibration": file}
    made = simgap.import_logs([folder], arm, out, **more)
    right(out)
    assert made.checks == []
    assert any(f"of the ranges in {file.name}, zero in the middle" in line for line in made.guessed)
    recording, kind = load_recording(out)
    assert check_recording_plausible(recording, kind) == []


def test_normalised_positions_without_a_calibration_are_of_the_models_ranges(arm, tmp_path):
    folder = dataset(tmp_path / "set", 50 * POSITIONS, 50 * COMMANDS)
    simgap.import_logs([folder], arm, tmp_path / "log.toml", position_unit="normalised")
    right(tmp_path / "log.toml")


def test_degrees_that_a_user_states_are_not_doubted(arm, tmp_path):
    folder = dataset(tmp_path / "set", np.degrees(POSITIONS), np.degrees(COMMANDS))
    made = simgap.import_logs([folder], arm, tmp_path / "log.toml", position_unit="deg")
    right(tmp_path / "log.toml")
    assert made.checks == []
    recording, kind = load_recording(tmp_path / "log.toml")
    assert check_recording_plausible(recording, kind) == []


def test_degrees_beyond_100_are_degrees(tmp_path):
    arm = model(tmp_path, SERVO)
    folder = dataset(tmp_path / "set", np.degrees(2.2 * POSITIONS), np.degrees(2.2 * COMMANDS))
    made = simgap.import_logs([folder], arm, tmp_path / "log.toml")
    assert made.checks == []
    with pytest.raises(
        InputError, match=r"expected normalised positions within -100 to 100, found"
    ):
        simgap.import_logs([folder], arm, tmp_path / "o.toml", position_unit="normalised")
    with pytest.raises(InputError, match=r"unknown position unit 'grad'"):
        simgap.import_logs([folder], arm, tmp_path / "o.toml", position_unit="grad")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[1, 2]", r"expected a calibration file of LeRobot, a table for each motor"),
        ("nonsense", r"expected JSON, a calibration file"),
        (json.dumps({"yaw": {"range_min": 9, "range_max": 3}}), r"expected range_min below"),
    ],
)
def test_a_faulty_calibration_is_one_line(text, message, arm, tmp_path):
    folder = dataset(tmp_path / "set", normalised(POSITIONS), normalised(COMMANDS))
    (tmp_path / "mine.json").write_text(text)
    with pytest.raises(InputError, match=message) as error:
        simgap.import_logs([folder], arm, tmp_path / "l.toml", calibration=tmp_path / "mine.json")
    assert "\n" not in str(error.value)
    assert not (tmp_path / "l.toml").exists()


# -- shared cases


@pytest.mark.data
@pytest.mark.skipif(not CASES.is_dir(), reason="the shared cases are not there")
@pytest.mark.parametrize(
    ("case", "logs", "lines"),
    [
        ("rostopic_csv", ["run1", "run2", "run3"],
         ["q.elbow: joint_states.csv, column field.position.elbow, by its name"]),
        ("spreadsheet_export", ["run1.csv", "run2.csv", "run3.csv"],
         ["q.elbow: run1.csv, column elbow [deg], by its name; in deg by its name"]),
        ("npz_alphabetical", ["run1.npz"],
         ["check: order of joints: ", "order base_yaw, elbow, shoulder, in which the model"]),
        ("lerobot_normalised", ["dataset"], ["check: positions lie within -100 to 100"]),
    ],
)  # fmt: skip
def test_the_shared_cases(case, logs, lines, tmp_path):
    folder, out = CASES / case, tmp_path / "log.toml"
    files = [str(folder / log) for log in logs]
    said = run_command("import", *files, "--model", folder / "arm3.xml", "--out", out).out
    assert all(line in said for line in lines)
    run_command("inspect", out, "--out", tmp_path / "figures")
