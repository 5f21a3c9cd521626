import os
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from sims.core.simulator import Channel, Constant, InputError, Simulator
from sims.recording.csv_table import read_csv_fast
from sims.recording.recording import Run, read_recording, read_system_name
from sims.recording.recording_frame import make_frame_recording
from sims.recording.recording_writer import write_recording
from sims.systems.ball import Ball
from sims.systems.pendulum import Pendulum
from sims.systems.servo import ServoSystem

TOML = """
system = "cart"
[channels.x]
unit = "m"
noise = 0.01
[inputs.u]
unit = "N"
[constants]
mass = 2.0
"""
CSV = """run,t,x,u
1,0,0.0,1
1,0.5,0.1,1
1,1.0,,0
b,0,5e-1,0
b,0.25,0.6,0
"""


class Cart(Simulator):
    name = "cart"
    channels = (Channel("x", "m"),)
    inputs = (Channel("u", "N"),)
    constants = (Constant("mass", "kg", 1.0, positive=True), Constant("drift", "m/s", 0.0))
    states = {"x": 0.0}  # noqa: RUF012


def written(tmp_path, csv=CSV, toml=TOML, name="log"):
    (tmp_path / f"{name}.csv").write_text(csv)
    (tmp_path / f"{name}.toml").write_text(toml)
    return tmp_path / f"{name}.csv"


def test_reads_runs_of_different_length_missing_samples_and_marks(tmp_path):
    recording = read_recording(
        written(tmp_path, toml=TOML + "[runs.b]\nheld_out = true\nmass = 3.0\n"), Cart
    )
    first, second = recording.runs
    np.testing.assert_array_equal(first.times, [0.0, 0.5, 1.0])
    np.testing.assert_array_equal(first.channels["x"], [0.0, 0.1, np.nan])
    np.testing.assert_array_equal(first.inputs["u"], [1.0, 1.0, 0.0])
    assert (second.name, second.held_out, second.constants) == ("b", True, {"mass": 3.0})
    assert recording.noise == {"x": 0.01}
    assert recording.constants == {"mass": 2.0}
    assert (recording.training(), recording.held_out()) == ((first,), (second,))


def test_byte_order_mark_and_windows_line_ends(tmp_path):
    path = written(tmp_path)
    path.write_bytes(b"\xef\xbb\xbf" + CSV.replace("\n", "\r\n").encode())
    np.testing.assert_array_equal(read_recording(path, Cart).runs[1].channels["x"], [0.5, 0.6])


def test_without_marks_whole_runs_are_held_out(tmp_path):
    rows = [f"{run},{t},{run},0" for run in range(6) for t in range(3)]
    recording = read_recording(written(tmp_path, "run,t,x,u\n" + "\n".join(rows)), Cart)
    assert [run.name for run in recording.held_out()] == ["2", "5"]
    assert all(len(run.times) == 3 for run in recording.runs)


def test_without_marks_a_single_run_loses_its_last_third(tmp_path):
    rows = [f"1,{t},{t},0" for t in range(9)]
    recording = read_recording(written(tmp_path, "run,t,x,u\n" + "\n".join(rows)), Cart)
    np.testing.assert_array_equal(recording.training()[0].times, range(6))
    np.testing.assert_array_equal(recording.held_out()[0].times, [6, 7, 8])


def check_refused(path, message):
    with pytest.raises(InputError, match=message) as caught:
        read_recording(path, Cart)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("0.5,0.1", "0.5,abc", "log.csv, row 3, column x: expected a finite number, found 'abc'"),
        ("0.5,0.1", "0.5,abc", "found 'abc'; leave the cell empty if the sample is missing"),
        ("0.5,0.1", "0.5,inf", "row 3, column x: expected a finite number, found 'inf'"),
        ("0.5,0.1", "0.5,nan", "row 3, column x: expected a finite number, found 'nan'"),
        ("1,0.5,", "1,,", "row 3, column t: expected a finite number, found ''"),
        ("1,0.5,", "1,0,", "row 3, column t: expected more than 0 s, found 0 s"),
        ("1,1.0,", "1,0.2,", "row 4, column t: expected more than 0.5 s, found 0.2 s"),
        (",,0\n", ",,\n", "row 4, column u: expected a finite number, found ''"),
        (",,0\n", ",,\n", "an input has no missing samples"),
        ("run,t,x,u", "run,time,x,u", "expected column 't', found columns run, time, x, u"),
        (",", ";", "row 1: expected columns run, t, u, x between commas, found semicolons"),
        (",", "\t", "between commas, found tabs"),
        ("\nb,0,", "\n\n\nb,x,", "row 7, column t: expected a finite number, found 'x'"),
        ("0.1", "1_0", "row 3, column x: expected a finite number, found '1_0'"),
        ("0.1", "٣", "row 3, column x: expected a finite number, found '٣'"),
        ("0.1", "1e999", "row 3, column x: expected a finite number, found '1e999'"),
        ("0.1", '"0.1', "row 6: not a CSV table: unexpected end of data"),
        ("0.1", "a\x1b[31m", r"found 'a\\x1b\[31m'"),
        ("run,t,x,u", "run,t,x,x", "row 1: column 'x' is given twice"),
        ("run,t,x,u", "run,t,x,", "row 1: column 4 has no name"),
    ],
)
def test_faulty_table_is_one_line_that_says_where(tmp_path, old, new, message):
    assert old in CSV
    assert "log.csv" in check_refused(written(tmp_path, CSV.replace(old, new)), message)


@pytest.mark.parametrize(
    ("csv", "message"),
    [
        ("run,t,x,u\n", "expected rows of data, found none"),
        ("", "row 1: expected columns run, t, u, x between commas, found ''"),
        (
            CSV + "b,1,2,3,4,5\n",
            "row 7: expected 4 cells as in the header, found 6; correct",
        ),
        (CSV + "b,1,2\n", "row 7: expected 4 cells as in the header, found 3"),
        # The message of a log that was cut does not hide that of a row before its end.
        (CSV.replace("0.5,0.1,1", "0.5,abc,1") + "b,1,2\n", "row 3, column x: expected a finite"),
        (
            CSV.replace("x,u", "x,u,v").replace("\n1,", "\n1,0,"),
            "column 'v' is not declared; log.toml declares u, x; add it with its unit under "
            r"\[inputs\], \[channels\] or, if nothing reads it, \[extra\]",
        ),
        (CSV + "1,2,3,4\n", "row 7, column run: run '1' continues after another run began"),
        (CSV + ",2,3,4\n,3,3,4\n", "row 7, column run: expected the name of a run, found none"),
        (CSV + "c,2,3,4\n", "row 7, column run: run 'c' has one row; expected at least two"),
        (CSV + "c,2,,4\nc,3,,4\n", "row 7, column x: run 'c' has no sample of any channel"),
        ("run,t,x,u\n1,0,,0\n1,1,,0\n", "column x has no sample; leave the channel out"),
    ],
)
def test_table_with_faulty_rows_is_one_line_that_says_where(tmp_path, csv, message):
    assert "log.csv" in check_refused(written(tmp_path, csv), message)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('unit = "m"', 'unit = "kg"', "channel x: expected a unit that converts to m, found 'kg'"),
        (
            'unit = "m"',
            'unit = "ftt"',
            "channel x: unknown unit 'ftt'; expected one that converts to m",
        ),
        (
            'unit = "m"',
            'unit = "degC"',
            "channel x: expected a unit that converts to m, found 'degC'",
        ),
        (
            'unit = "m"',
            'unit = "9**9**9"',
            "channel x: expected a unit that converts to m, found '9",
        ),
        ('unit = "m"', 'unit = "m\\u0000"', r"channel x: expected a unit .*, found 'm\\x00'"),
        ('unit = "N"', 'unit = "m"', "input u: expected a unit that converts to N, found 'm'"),
        (
            'unit = "m"\n',
            "",
            'channel x: expected unit = "m" or one that converts to it, found None',
        ),
        (
            '[channels.x]\nunit = "m"\nnoise = 0.01',
            '[channels]\nx = "m"',
            "expected a table with unit",
        ),
        (
            "noise",
            "nosie",
            r"unknown entry in \[channels.x\] of .*'nosie'; there are: column, file, matrix, noise",
        ),
        (
            "0.01",
            "0",
            r"channels.x.noise: expected more than 0 \(leave it out if unknown\), found 0",
        ),
        ("2.0", "-1", "constants.mass: expected more than 0 kg, found -1"),
        ("2.0", "9" * 400, "constants.mass: expected a number, found 9999"),
        ("2.0", "true", "constants.mass: expected a number, found True"),
        ("channels.x", "channels.y", "unknown channel in .*log.toml 'y'; there are: x"),
        ("mass", "mas", r"unknown entry in \[constants\] of .*'mas'; there are: drift, mass"),
        ("2.0", '"heavy"', "constants.mass: expected a number, found 'heavy'"),
        ("0.01", "nan", "channels.x.noise: expected a number, found nan"),
        ('system = "cart"', "", 'expected system = "NAME", found None'),
    ],
)
def test_faulty_description_is_one_line_that_says_where(tmp_path, old, new, message):
    assert old in TOML
    check_refused(written(tmp_path, toml=TOML.replace(old, new)), message)


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        (
            TOML + "[runs.b]\nmass = 1\nconstants = {mass = 2}\n",
            "runs.b: constant mass is given twice",
        ),
        (TOML + "[runs.b]\nmass = 0\n", "runs.b.mass: expected more than 0 kg, found 0"),
        (
            TOML + "[runs.b.initial]\nv = 0\n",
            r"unknown entry in \[runs.b.initial\] of .*'v'; there are: x",
        ),
        (TOML + "[runs]\nb = 3\n", "runs.b: expected a table, found 3"),
        ("title = 3\n" + TOML, "title: expected text, found 3"),
        ("a = " + "[" * 100_000, "not valid TOML"),
        ('"a\\nb" = 1', r"unknown entry of .*'a\\nb'"),
        (TOML + "[runs.7]\nheld_out = true\n", r"unknown entry in \[runs\].*'7'; there are: 1, b"),
        (
            TOML + '[runs.b]\nheld_out = "yes"\n',
            "runs.b.held_out: expected true or false, found 'yes'",
        ),
        (
            TOML + "[runs.b]\nheldout = true\n",
            "'heldout'; there are: constants, drift, file, folder, held_out, initial, mass",
        ),
        (TOML + "[oops]\n", "unknown entry of .*'oops'"),
        ("system = ", "not valid TOML"),
        (TOML + "[runs.1]\nheld_out = true\n[runs.b]\nheld_out = true\n", "every run .* held_out"),
    ],
)
def test_description_with_faulty_tables_is_one_line_that_says_where(tmp_path, toml, message):
    check_refused(written(tmp_path, toml=toml), message)


def test_missing_files(tmp_path):
    with pytest.raises(InputError, match=r"none.csv: no such file"):
        read_recording(tmp_path / "none.csv", Cart)
    path = written(tmp_path)
    path.unlink()
    with pytest.raises(InputError, match=r"log.csv: no such file"):
        read_recording(path, Cart)


def test_units_convert_with_the_noise(tmp_path):
    toml = TOML.replace('unit = "m"', 'unit = "cm"').replace('unit = "N"', 'unit = "mN"')
    recording = read_recording(written(tmp_path, toml=toml), Cart)
    np.testing.assert_allclose(recording.runs[1].channels["x"], [0.005, 0.006], rtol=1e-15)
    np.testing.assert_allclose(recording.runs[0].inputs["u"], [1e-3, 1e-3, 0.0], rtol=1e-15)
    assert recording.noise == {"x": pytest.approx(1e-4, rel=1e-15)}
    assert recording.constants == {"mass": 2.0}, "constants are plain SI numbers"
    toml = TOML.replace('unit = "m"', 'unit = "km"')
    with pytest.raises(
        InputError, match=r"log.csv: run '1', column x: a value is too large to convert"
    ):
        read_recording(written(tmp_path, CSV.replace("0.1", "1e308"), toml), Cart)


def test_a_unit_with_an_offset_moves_the_values_and_not_the_spread(tmp_path):
    class Warm(Cart):
        name = "cart"
        channels = (Channel("x", "K"),)

    toml = TOML.replace('unit = "m"', 'unit = "degF"').replace("noise = 0.01", "noise = 0.9")
    recording = read_recording(written(tmp_path, toml=toml), Warm)
    kelvin = [273.15 + (0.5 - 32) * 5 / 9, 273.15 + (0.6 - 32) * 5 / 9]
    np.testing.assert_allclose(recording.runs[1].channels["x"], kelvin, rtol=1e-12)
    assert recording.noise == {"x": pytest.approx(0.5, rel=1e-9)}


def test_initial_states_and_constants_by_run(tmp_path):
    marks = "[runs.1]\nmass = 3\n[runs.1.initial]\nx = 0.25\n[runs.b.constants]\ndrift = -1\n"
    first, second = read_recording(written(tmp_path, toml=TOML + marks), Cart).runs
    assert (first.constants, first.initial) == ({"mass": 3.0}, {"x": 0.25})
    assert (second.constants, second.initial) == ({"drift": -1.0}, {})


def test_the_table_may_order_columns_as_it_likes_and_hold_blank_lines(tmp_path):
    csv = '\nu, "x",t,run\n1,0.5,0,"a, b"\n\n1,,1.5,"a, b"\n2,1,0,c\n2,1,1,c\n\n\n'
    recording = read_recording(written(tmp_path, csv), Cart)
    assert [run.name for run in recording.runs] == ["a, b", "c"]
    np.testing.assert_array_equal(recording.runs[0].channels["x"], [0.5, np.nan])


def test_system_of_and_names_that_cannot_be_a_table(tmp_path):
    assert read_system_name(written(tmp_path)) == "cart"
    assert read_system_name(tmp_path / "log.toml") == "cart"
    with pytest.raises(InputError, match=r"expected a recording's table, NAME.csv, found "):
        read_system_name("")
    (tmp_path / "folder.csv").mkdir()
    written(tmp_path, name="other")
    (tmp_path / "other.csv").unlink()
    (tmp_path / "other.csv").mkdir()
    with pytest.raises(InputError, match=r"other.csv: not a file"):
        read_recording(tmp_path / "other.csv", Cart)


def test_a_run_too_short_to_split(tmp_path):
    with pytest.raises(
        InputError, match=r"log.toml: the only run is too short .* 3 rows; expected at least 4"
    ):
        read_recording(written(tmp_path, "run,t,x,u\n1,0,0,0\n1,1,0,0\n1,2,0,0\n"), Cart)


def test_large_tables_are_read_fast_and_the_same(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    rows = ["run,t,x,u"]
    for run in range(4):
        values = rng.standard_normal((60, 2)) * 10.0 ** rng.integers(-300, 300, size=(60, 1))
        rows += [
            f"r{run},{i / 7!r},{'' if i % 11 == 3 else repr(x)},{u!r}"
            for i, (x, u) in enumerate(values.tolist())
        ]
    path = written(tmp_path, "\n".join(rows) + "\n")
    slow = read_recording(path, Cart)
    monkeypatch.setattr("sims.recording.csv_table.MIN_FAST_PARSE_BYTES", 0)
    assert read_csv_fast(path, rows[0].split(","), ["t", "u", "x"], ["x"]) is not None
    fast = read_recording(path, Cart)
    for a, b in zip(slow.runs, fast.runs, strict=True):
        assert a.name == b.name
        np.testing.assert_array_equal(a.times, b.times)
        np.testing.assert_array_equal(a.channels["x"], b.channels["x"])
        np.testing.assert_array_equal(a.inputs["u"], b.inputs["u"])
    path.write_text(path.read_text().replace("\nr2,", "\nr2,0x", 1))
    with pytest.raises(
        InputError, match=r"row 122, column t: expected a finite number, found '0x0.0'"
    ):
        read_recording(path, Cart)


def test_what_is_written_reads_the_same(tmp_path):
    recording = read_recording(
        written(
            tmp_path, toml=TOML + "[runs.b]\nheld_out = true\nmass = 3.0\ninitial = {x = 0.125}\n"
        ),
        Cart,
    )
    write_recording(tmp_path / "again.csv", recording, Cart)
    again = read_recording(tmp_path / "again.csv", Cart)
    assert (again.system, again.title, again.constants, again.noise) == (
        "cart",
        "log",
        {"mass": 2.0},
        {"x": 0.01},
    )
    for a, b in zip(recording.runs, again.runs, strict=True):
        assert (a.name, a.constants, a.initial, a.held_out) == (
            b.name,
            b.constants,
            b.initial,
            b.held_out,
        )
        np.testing.assert_array_equal(a.times, b.times)
        np.testing.assert_array_equal(a.channels["x"], b.channels["x"])
        np.testing.assert_array_equal(a.inputs["u"], b.inputs["u"])
    before = sorted((p.name, p.read_bytes()) for p in tmp_path.iterdir())
    for name, message in (
        ("again", "exists already"),
        ("none/new", "cannot be written"),
        ("new.txt", "ends in .csv"),
    ):
        with pytest.raises(InputError, match=message):
            write_recording(tmp_path / f"{name}{'' if '.' in name else '.csv'}", recording, Cart)
    (tmp_path / "half.toml").touch()
    with pytest.raises(InputError, match=r"half.toml: exists already"):
        write_recording(tmp_path / "half.csv", recording, Cart)
    (tmp_path / "half.toml").unlink()
    assert before == sorted((p.name, p.read_bytes()) for p in tmp_path.iterdir()), (
        "nothing is left behind"
    )


def test_a_failed_write_takes_back_what_it_had_written(tmp_path, monkeypatch):
    recording = read_recording(written(tmp_path), Cart)
    place = os.link
    before = sorted(tmp_path.iterdir())

    def fails(source, target):
        if str(target).endswith(".toml"):
            raise FileExistsError
        place(source, target)

    monkeypatch.setattr(os, "link", fails)
    with pytest.raises(InputError, match=r"new.toml: exists already"):
        write_recording(tmp_path / "new.csv", recording, Cart)
    assert sorted(tmp_path.iterdir()) == before


def test_runs_that_cannot_stand_in_one_table(tmp_path):
    rows = [f"1,{t},{t},0" for t in range(9)]
    halves = read_recording(written(tmp_path, "run,t,x,u\n" + "\n".join(rows)), Cart)
    with pytest.raises(InputError, match="two runs are called '1'"):
        write_recording(tmp_path / "new.csv", halves, Cart)
    run = Run("2", halves.runs[0].times, {"y": halves.runs[0].times}, {}, {}, {}, False)
    with pytest.raises(InputError, match="run 2"):
        write_recording(tmp_path / "new.csv", replace(halves, runs=(halves.runs[0], run)), Cart)


def test_real_pendulum(recordings):
    recording = read_recording(recordings / "pendulum_free_swing" / "recording.csv", Pendulum)
    assert [run.name for run in recording.training()] == list("123456")
    assert [run.name for run in recording.held_out()] == ["7", "8", "9", "10", "11"]
    assert all(run.times.size == 1000 for run in recording.runs)
    assert recording.runs[0].channels["q"][0] == -1.618429
    assert recording.constants == {"mass": 0.1476, "length": 0.1478, "gravity": 9.81}


def test_real_servo_with_its_gain_by_run(recordings):
    path = recordings / "servo_pendulum" / "recording.csv"
    recording = read_recording(path, ServoSystem)
    assert [run.constants["kp"] for run in recording.runs] == [100.0] * 4 + [200.0] * 4 + [
        400.0
    ] * 4 + [800.0] * 4
    assert sum(run.times.size for run in recording.runs) == 19452
    assert recording.runs[0].inputs["goal"][1] == 0.00839795
    assert len(recording.training()) == 8


@pytest.mark.parametrize(("name", "runs", "held_out"), [("fall", 22, 11), ("up_down", 16, 8)])
def test_real_phone(name, runs, held_out, recordings):
    path = recordings / "smartphone_fall" / f"{name}.csv"
    assert read_system_name(path) == "ball"
    recording = read_recording(path, Ball)
    assert (len(recording.runs), len(recording.held_out())) == (runs, held_out)
    assert recording.noise == {"accel_z": 0.022}


def test_real_balls(recordings):
    paths = sorted((recordings / "ball_drops").glob("*.csv"))
    assert len(paths) == 11
    for path in paths:
        recording = read_recording(path, Ball)
        assert [run.held_out for run in recording.runs] == [False, True]
        assert 40 < recording.runs[0].channels["z"][0] < 50


def test_extra_columns_are_kept_with_their_units_and_gaps(tmp_path):
    csv = CSV.replace("run,t,x,u", "run,t,x,u,v_px").replace("1\n", "1,7.5\n", 1)
    lines = csv.splitlines()
    rows = [line if line.count(",") == 4 else f"{line}," for line in lines]
    path = written(tmp_path, csv="\n".join(rows) + "\n", toml=TOML + '[extra.v_px]\nunit = "px"\n')
    recording = read_recording(path, Cart)
    assert recording.extra == {"v_px": "px"}
    np.testing.assert_array_equal(recording.runs[0].extra["v_px"], [7.5, np.nan, np.nan])
    write_recording(tmp_path / "again.csv", recording, Cart)
    again = read_recording(tmp_path / "again.csv", Cart)
    np.testing.assert_array_equal(again.runs[0].extra["v_px"], [7.5, np.nan, np.nan])


def test_a_misspelt_column_is_answered_with_the_nearest_name(tmp_path):
    rows = [f"{row},0" for row in CSV.replace("run,t,x,u", "run,t,x,u,v_pz").splitlines()]
    rows[0] = rows[0].removesuffix(",0")
    path = written(tmp_path, csv="\n".join(rows) + "\n", toml=TOML + '[extra.v_px]\nunit = "px"\n')
    message = r"expected column 'v_px', found columns run, t, x, u, v_pz; did you mean v_pz\?"
    with pytest.raises(InputError, match=message):
        read_recording(path, Cart)


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        ('[extra.x]\nunit = "px"\n', "declare it as channel or input"),
        ("[extra.v_px]\n", "expected a table with unit"),
        ('[extra.v_px]\nunit = "px"\n', "expected column 'v_px'"),
    ],
)
def test_extra_columns_that_cannot_be(tmp_path, toml, message):
    with pytest.raises(InputError, match=message):
        read_recording(written(tmp_path, toml=TOML + toml), Cart)


def test_long_run_numbers_in_a_column_of_floats_stay_apart():
    """A column of integers has the type float if a cell was missing once."""
    frame = pd.DataFrame(
        {"run": np.repeat([20240101.0, 20240102.0], 3), "t": [0.0, 0.5, 1.0] * 2,
         "x": np.arange(6.0), "u": np.zeros(6)}
    )  # fmt: skip
    meta = {"system": "cart", "channels": {"x": {"unit": "m"}}, "inputs": {"u": {"unit": "N"}}}
    recording = make_frame_recording(frame, Cart, meta, {})
    assert [run.name for run in recording.runs] == ["20240101", "20240102"]
