"""Tests of logs in their original layout: any columns, several files, joined time stamps, no
resampling.
"""

import numpy as np
import pytest

from sims.core.simulator import InputError
from sims.recording.log_formats.log_files import read_log
from sims.recording.recording import read_recording
from sims.systems.slider import Slider

TOML = """system = "slider"
[time]
column = "stamp"
unit = "ms"
[channels.x]
file = "sensors.csv"
column = "pos[1]"
unit = "mm"
[inputs.u]
file = "commands.csv"
column = "Force"
unit = "N"
"""
SENSORS = 'stamp,pos\n100,"[9, 0]"\n110,"[9, 1.5]"\n120,"[9, 4]"\n130,"[9, 7]"\n140,"[9, 9]"\n'
COMMANDS = "stamp,note,force\n95,a,0.5\n112,b,1.5\n134,b,-2\n150,b,0\n"


def written(folder, toml=TOML, **files):
    (folder / "log.toml").write_text(toml)
    for name, text in {"sensors": SENSORS, "commands": COMMANDS, **files}.items():
        (folder / f"{name}.csv").write_text(text)
    return folder / "log.toml"


def test_two_files_are_joined_at_every_stamp_and_commands_hold(tmp_path):
    (run,) = read_recording(written(tmp_path), Slider, whole=True).runs
    # From the first to the last sample of the sensor, in seconds since the first time stamp of all
    # files.
    expected = np.array([100, 110, 112, 120, 130, 134, 140]) / 1e3 - 0.095
    np.testing.assert_allclose(run.times, expected, atol=1e-12)
    np.testing.assert_array_equal(run.inputs["u"], [0.5, 0.5, 1.5, 1.5, 1.5, -2, -2])
    x = [0, 1.5e-3, np.nan, 4e-3, 7e-3, np.nan, 9e-3]
    np.testing.assert_allclose(run.channels["x"], x, atol=1e-15)


def test_commands_that_go_straight_are_what_they_are_in_between(tmp_path):
    straight = written(tmp_path, TOML + 'hold = "linear"\n')
    (run,) = read_recording(straight, Slider, whole=True).runs
    assert run.linear == {"u"}
    between = np.interp([100, 110, 112, 120, 130, 134, 140], [95, 112, 134, 150], [0.5, 1.5, -2, 0])
    np.testing.assert_allclose(run.inputs["u"], between, atol=1e-12)


def test_each_folder_is_a_run(tmp_path):
    for name, first in (("slow", 100), ("quick", 1e12)):
        (tmp_path / name).mkdir()
        stamps = first + np.arange(4) * 10
        rows = "".join(f'{t:.0f},"[0, {k}]"\n' for k, t in enumerate(stamps))
        (tmp_path / name / "sensors.csv").write_text("stamp,pos\n" + rows)
        (tmp_path / name / "commands.csv").write_text(f"stamp,Force\n{first:.0f},1\n")
    runs = '[runs.slow]\nfolder = "slow"\n[runs.quick]\nfolder = "quick"\nheld_out = true\n'
    slow, quick = read_recording(written(tmp_path, TOML + runs), Slider).runs
    assert (slow.name, quick.name, slow.held_out, quick.held_out) == ("slow", "quick", False, True)
    np.testing.assert_allclose(quick.times, [0, 0.01, 0.02, 0.03], atol=1e-12)


def test_one_table_with_other_words_and_a_run_column(tmp_path):
    toml = 'system = "slider"\n[time]\nunit = "us"\n[channels.x]\ncolumn = "Position"\nunit = "m"\n'
    rows = "run;t;position\n" + "".join(f"{r};{1000 * k};0,{k}\n" for r in (3, 4) for k in range(4))
    (tmp_path / "log.toml").write_text(toml)
    (tmp_path / "log.csv").write_text(rows)
    three, four = read_recording(tmp_path / "log.csv", Slider).runs
    assert (three.name, four.name) == ("3", "4")
    np.testing.assert_allclose(three.channels["x"], [0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(three.times, [0, 1e-3, 2e-3, 3e-3], atol=1e-15)


def test_archives_and_parquet_hold_the_same(tmp_path):
    import pandas

    stamp = np.array([100, 110, 120, 130, 140])
    pos = np.column_stack([np.full(5, 9.0), [0, 1.5, 4, 7, 9]])
    np.savez(tmp_path / "sensors.npz", stamp=stamp, pos=pos, name=np.array(["a"]))
    pandas.DataFrame({"stamp": stamp, "pos": list(pos)}).to_parquet(tmp_path / "sensors.parquet")
    runs = [
        read_recording(
            written(tmp_path, TOML.replace("sensors.csv", f"sensors.{kind}")), Slider, whole=True
        ).runs[0]
        for kind in ("csv", "npz", "parquet")
    ]
    for other in runs[1:]:
        np.testing.assert_array_equal(other.channels["x"], runs[0].channels["x"])
    assert read_log(tmp_path / "sensors.npz").texts == ("name",)


def test_the_scale_and_the_offset_of_a_signal_are_applied_before_its_unit(tmp_path):
    # A gear of 1:5 that inverts the sign, and the zero of an encoder, in the unit of the column.
    toml = TOML.replace('unit = "mm"', 'unit = "mm"\nscale = -0.2\noffset = 1.5\nnoise = 2')
    toml = toml.replace('unit = "N"', 'unit = "N"\nscale = 2\noffset = -1')
    recording = read_recording(written(tmp_path, toml), Slider, whole=True)
    x = recording.runs[0].channels["x"]
    seen = np.array([0, 1.5, 4, 7, 9])
    np.testing.assert_allclose(x[np.isfinite(x)], 1e-3 * (1.5 - 0.2 * seen), atol=1e-15)
    assert recording.runs[0].inputs["u"].tolist() == [0, 0, 2, 2, 2, -5, -5]
    # An offset does not change the noise.
    assert recording.noise["x"] == pytest.approx(0.4e-3)


def test_a_row_of_a_coupling_matrix_makes_a_signal_of_several_columns(tmp_path):
    """Two motors of a differential wrist: pitch = (a - b) / 2, behind a gear of 1:4."""
    toml = TOML.replace(
        'column = "pos[1]"\nunit = "mm"',
        'column = ["pos[0]", "pos[1]"]\nmatrix = [0.5, -0.5]\nscale = 0.25\nunit = "mm"',
    )
    toml = toml.replace('column = "Force"', 'column = ["Force", "force"]\nmatrix = [2.0, 1]')
    (run,) = read_recording(written(tmp_path, toml), Slider, whole=True).runs
    x = run.channels["x"]
    expected = 0.25e-3 * (9 - np.array([0, 1.5, 4, 7, 9])) / 2
    np.testing.assert_allclose(x[np.isfinite(x)], expected, atol=1e-15)
    assert run.inputs["u"].tolist() == [1.5, 1.5, 4.5, 4.5, 4.5, -6, -6]


def test_a_coupling_matrix_in_a_table_with_runs(tmp_path):
    toml = 'system = "slider"\n[channels.x]\nunit = "m"\n[inputs.u]\nunit = "N"\n'
    toml += 'column = ["left", "right"]\nmatrix = [1.0, -1.0]\n'
    (tmp_path / "log.toml").write_text(toml)
    rows = [f"{r},{k / 10},0.{k},{k},1" for r in "ab" for k in range(4)]
    (tmp_path / "log.csv").write_text("run,t,x,left,right\n" + "\n".join(rows) + "\n")
    recording = read_recording(tmp_path / "log.csv", Slider, whole=True)
    assert [run.inputs["u"].tolist() for run in recording.runs] == [[-1, 0, 1, 2]] * 2


def test_rows_at_a_rate_stand_for_stamps(tmp_path):
    toml = TOML.replace('column = "stamp"\nunit = "ms"', "rate = 50")
    (run,) = read_recording(written(tmp_path, toml), Slider, whole=True).runs
    np.testing.assert_allclose(run.times, np.arange(5) / 50, atol=1e-15)
    assert run.inputs["u"].tolist() == [0.5, 1.5, -2, 0, 0]


def test_a_stamp_that_repeats_leaves_its_row_out_and_is_said(tmp_path):
    rows = "".join(f'{100 + 10 * k},"[9, {k}]"\n' for k in range(40))
    sensors = "stamp,pos\n" + rows.replace('120,"', '110,"[9, 77]"\n120,"')
    recording = read_recording(written(tmp_path, sensors=sensors), Slider, whole=True)
    x = recording.runs[0].channels["x"]
    assert 0.077 not in x[np.isfinite(x)]
    (note,) = recording.notes
    assert note.endswith(
        "sensors.csv: 1 of 41 stamps repeat the one before; their rows are left out"
    )


INVALID_MAPPINGS = {
    "a matrix of one column": ({"toml": TOML.replace('unit = "mm"', 'unit = "mm"\nmatrix = [1.0]')},
                               r"x.matrix: expected it with several columns"),
    "a short matrix": ({"toml": TOML.replace('"pos[1]"', '["pos[0]", "pos[1]"]\nmatrix = [1]')},
                       r"x.matrix: expected a row of 2 numbers, one for each column, found \[1\]"),
    "a matrix of zeros": ({"toml": TOML.replace('"Force"', '["Force"]\nmatrix = [0]')},
                          r"u.matrix: expected a number that is not zero"),
    "columns without a matrix": ({"toml": TOML.replace('"Force"', '["Force", "note"]')},
                                 r"u.matrix: expected a row of 2 numbers"),
    "a rate and stamps": ({"toml": TOML.replace("[time]", "[time]\nrate = 100")}, r"time: expected "
                          r"a rate, or column and unit of stamps, found both"),
    "no rate": ({"toml": TOML.replace('column = "stamp"\nunit = "ms"', "rate = 0")}, r"time.rate: "
                r"expected a number of rows a second, more than 0, found 0"),
    "many stamps twice": ({"commands": COMMANDS.replace("134", "112")}, r"row 4: expected more "
                          r"than 112, found 112; take out rows that came twice"),
    "no such column": ({"toml": TOML.replace("Force", "Push")}, r"commands.csv: unknown column "
                       r"'Push'; there are: stamp, force"),
    "text": ({"toml": TOML.replace("Force", "note")}, r"'note': expected numbers, found text"),
    "a list": ({"toml": TOML.replace("pos[1]", "pos")}, r"'pos' contains lists; its entries are "
               r"pos\[0\] to pos\[1\]"),
    "too far": ({"toml": TOML.replace("pos[1]", "pos[2]")}, r"unknown column 'pos\[2\]'"),
    "no file": ({"toml": TOML.replace("sensors.csv", "sensor.csv")}, r"sensor.csv: no such file"),
    "another format": ({"toml": TOML.replace("sensors.csv", "sensors.bag")}, r"no such file"),
    "a cell": ({"commands": COMMANDS.replace("1.5", "1.5N")}, r"commands.csv, row 3, column force: "
               r"expected a number, found '1.5N'"),
    "a list's cell": ({"sensors": SENSORS.replace("[9, 4]", "[9]")}, r"sensors.csv, row 4, column "
                      r"pos: expected a list of 2 numbers, found '\[9\]'"),
    "a missing command": ({"commands": COMMANDS.replace("1.5", "")}, r"row 3, column Force: "
                          r"expected a number, found none"),
    "stamps back": ({"commands": COMMANDS.replace("134", "104")}, r"column stamp, row 4: expected "
                    r"more than 112, found 104"),
    "no unit of time": ({"toml": TOML.replace('"ms"', '"kg"')}, r"time.unit: "),
    "a word too many": ({"toml": TOML.replace("unit = \"ms", "units = \"ms")},
                        r"'units'; there are: column, offset, rate, unit"),
    "not a table": ({"sensors": ""}, r"sensors.csv: expected a table with a header and rows, found"
                    r" an empty file"),
}  # fmt: skip


@pytest.mark.parametrize("name", INVALID_MAPPINGS)
def test_a_fault_is_one_line(name, tmp_path):
    change, message = INVALID_MAPPINGS[name]
    with pytest.raises(InputError, match=message) as error:
        read_recording(written(tmp_path, **change), Slider)
    assert "\n" not in str(error.value)


def test_nothing_is_unpickled(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (pytest.fail, ("it was unpickled",))

    np.savez(tmp_path / "sensors.npz", stamp=np.array([Bomb()], dtype=object))
    with pytest.raises(InputError, match=r"sensors.npz: not an archive of arrays of numbers"):
        read_log(tmp_path / "sensors.npz")
