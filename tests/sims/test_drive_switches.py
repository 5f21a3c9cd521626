"""Tests of ``[actuators.NAME] enable`` and ``disable``: accepted values and one-line error
messages.
"""

import numpy as np
import pytest

from bench.logs.recording_loading import load_recording
from bench.logs.recording_summary import format_summary
from sims.core.simulator import InputError

ROBOT = """
<mujoco>
  <worldbody><body>
    <joint name="hinge" axis="0 1 0" damping="0.1"/>
    <inertial pos="0 0 -0.2" mass="0.5" diaginertia="0.002 0.002 0.001"/>
  </body></worldbody>
  <actuator><position name="m" joint="hinge" kp="5" kv="0.2"/></actuator>
</mujoco>
"""
LOG = 'model = "robot.xml"\n[channels."q.hinge"]\nunit = "rad"\n[inputs."u.m"]\nunit = "rad"\n'


def written(folder, more, column="on", cells=("1", "1", "0", "0", "1")):
    """Write a log of two equal runs and return its path."""
    rows = [f"run,t,u.m,q.hinge,{column}" if column else "run,t,u.m,q.hinge"]
    for run in "ab":
        for k, cell in enumerate(cells):
            rows.append(f"{run},{k},0.1,0.{k}" + (f",{cell}" if column else ""))
    (folder / "robot.xml").write_text(ROBOT)
    (folder / "log.csv").write_text("\n".join(rows) + "\n")
    (folder / "log.toml").write_text(LOG + more)
    return folder / "log.csv"


@pytest.mark.parametrize(
    ("more", "cells", "off"),
    [
        ('[actuators.m]\nenable = "on"\n', "11001", "00110"),
        ('[actuators.m]\ndisable = "on"\n', "11001", "11001"),
        ('[actuators.m]\nenable = "on"\n[extra.on]\nunit = "1"\n', "20030", "01101"),
        # A missing cell repeats the previous value; at the beginning, the first known value.
        ('[actuators.m]\nenable = "on"\n', ("", "1", "0", "", "1"), "00110"),
        ('[actuators.m]\nenable = "on"\n', "11111", None),
    ],
)
def test_samples_in_which_a_drive_is_off(tmp_path, more, cells, off):
    recording, kind = load_recording(written(tmp_path, more, cells=cells), divide=False)
    for run in recording.runs:
        assert run.times.size == len(cells)
        if off is None:
            assert not run.off
        else:
            assert "".join(str(int(value)) for value in run.off["m"]) == off
    assert len(recording.notes) == (off is not None)
    assert set(recording.notes) <= set(format_summary(recording, kind))
    # The table adds no actuator.
    assert recording.model.actuators == {}
    assert [actuator.name for actuator in kind.robot.actuators] == ["m"]


def test_the_message_says_where_and_why(tmp_path):
    recording, _ = load_recording(written(tmp_path, '[actuators.m]\nenable = "on"\n'), divide=False)
    assert recording.notes == (
        "actuator m exerts nothing where on is 0: run a, 2 to 3 s; run b, 2 to 3 s",
    )


def test_an_actuator_of_the_recording_may_have_a_switch(tmp_path):
    more = (
        '[actuators.s]\njoint = "hinge"\nkind = "velocity"\nkv = 0.5\nenable = "on"\n'
        '[inputs."u.s"]\nunit = "rad/s"\n'
    )
    path = written(tmp_path, more)
    text = path.read_text().replace("u.m,", "u.m,u.s,").replace(",0.1,", ",0.1,0.0,")
    path.write_text(text)
    recording, kind = load_recording(path, divide=False)
    assert list(recording.runs[0].off) == ["s"]
    assert [actuator.name for actuator in kind.robot.actuators] == ["m", "s"]


def test_parts_of_a_run_keep_their_own_samples(tmp_path):
    recording, _ = load_recording(written(tmp_path, '[actuators.m]\nenable = "on"\n'), divide=False)
    part = recording.runs[0].part(slice(2, 5))
    assert part.off["m"].tolist() == [True, True, False]
    assert np.array_equal(part.times, [2, 3, 4])


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ('[actuators.x]\nenable = "on"\n', r"unknown actuator 'x'; there are: m"),
        (
            '[actuators.m]\nenable = "on"\ndisable = "on"\n',
            r"expected enable or disable, found both",
        ),
        ("[actuators.m]\nenable = 1\n", r"actuators.m.enable: expected the name of a column"),
        ('[actuators.m]\nenabel = "on"\n', r"unknown entry .*'enabel'.*did you mean enable\?"),
        ('[actuators.m]\nenable = "u.m"\n', r"found u.m, which is a channel or input"),
        ('[actuators.m]\nenable = "of"\n', r"expected column 'of'"),
    ],
)
def test_what_cannot_be_read_is_refused_in_one_line(tmp_path, more, message):
    with pytest.raises(InputError, match=message) as error:
        load_recording(written(tmp_path, more), divide=False)
    assert "\n" not in str(error.value)


def test_a_drive_that_is_never_on_is_refused(tmp_path):
    path = written(tmp_path, '[actuators.m]\nenable = "on"\n', cells="00000")
    with pytest.raises(InputError, match=r"on is 0 in all samples: actuator m is never on"):
        load_recording(path, divide=False)


MAPPED = """[time]
column = "stamp"
unit = "ms"
[channels."q.hinge"]
file = "states.csv"
column = "pos"
unit = "rad"
[inputs."u.m"]
file = "commands.csv"
column = "target"
unit = "rad"
"""


def mapped(folder, more):
    """Write raw logs of one run: states with a power flag, and slower commands."""
    rows = [f"{10 * k},0.{k},{'True' if k < 4 else 'False'}" for k in range(8)]
    (folder / "states.csv").write_text("stamp,pos,Power\n" + "\n".join(rows) + "\n")
    (folder / "commands.csv").write_text("stamp,target\n0,0.1\n35,0.2\n")
    (folder / "safety.csv").write_text("stamp,stop\n0,0\n52,1\n")
    (folder / "robot.xml").write_text(ROBOT)
    (folder / "log.toml").write_text(f'model = "robot.xml"\n{MAPPED}{more}')
    return folder / "log.toml"


@pytest.mark.parametrize(
    ("more", "off"),
    [
        # Times in ms: 0, 10, 20, 30, 35 (a command), 40, 50, 60, 70.
        ('[actuators.m]\nenable = "Power"\n', "000001111"),
        (
            '[actuators.m]\ndisable = "estop"\n'
            '[extra.estop]\nunit = "1"\nfile = "safety.csv"\ncolumn = "stop"\n',
            "000000011",
        ),
    ],
)
def test_raw_logs_have_switches(tmp_path, more, off):
    recording, _ = load_recording(mapped(tmp_path, more), divide=False)
    (run,) = recording.runs
    assert "".join(str(int(value)) for value in run.off["m"]) == off
    assert run.times[4] == pytest.approx(0.035)


def test_a_switch_that_no_log_has_is_refused(tmp_path):
    message = (
        r"column 'on': expected it in one of states.csv, commands.csv, found none there; "
        r'state \[extra.on\] file = "NAME"'
    )
    with pytest.raises(InputError, match=message):
        load_recording(mapped(tmp_path, '[actuators.m]\nenable = "on"\n'), divide=False)
