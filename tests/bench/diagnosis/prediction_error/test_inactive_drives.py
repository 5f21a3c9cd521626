"""Tests that samples with inactive drives are found, without false detections.

Plain MuJoCo makes the motion, with other gains, limits and brakes than the model file states.
"""

from dataclasses import dataclass, field

import mujoco
import numpy as np
import pytest

from bench.diagnosis.prediction_error.inactive_drives import (
    OFF,
    _Intervals,
    find_inactive_drives,
    remove_inactive_drives,
)
from bench.logs.recording_loading import load_recording

NOISE = 5e-4
ARM = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body>
      <joint name="shoulder" axis="0 1 0" damping="{damping}" armature="0.02" {shoulder}/>
      <inertial pos="0.12 0 0" mass="0.6" diaginertia="0.002 0.006 0.006"/>
      <body pos="0.25 0 0">
        <joint name="elbow" axis="0 1 0" damping="0.1" armature="0.01"/>
        <inertial pos="0.1 0 0" mass="0.3" diaginertia="0.001 0.002 0.002"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="s1" joint="shoulder" kp="{kp}" kv="3" {servo}/>
    <position name="s2" joint="elbow" kp="20" kv="1"/>
  </actuator>
</mujoco>
"""
DEFAULTS = {"damping": 0.2, "shoulder": "", "kp": 60, "servo": ""}
TIMES = 0.01 * np.arange(301)
LOG = "".join(
    ['model = "arm.xml"\n']
    + [f'[channels."q.{j}"]\nunit = "rad"\nnoise = {NOISE}\n' for j in ("shoulder", "elbow")]
    + [f'[inputs."u.{m}"]\nunit = "rad"\n' for m in ("s1", "s2")]
)


@dataclass
class Rig:
    """Differences between the recorded arm and its model file.

    Attributes:
        off: for each run, first time, last time and the servos that are off.
        brakes: for each run, the interval in which brakes stop the arm.
        delay: number of samples by which commands are delayed.
        dead: half width of the dead zone of the shoulder's servo.
        model: entries of the model file.
        column: name of an extra column, and its values while drives are on and off.
    """

    off: dict = field(default_factory=dict)
    brakes: dict = field(default_factory=dict)
    delay: int = 0
    dead: float = 0.0
    model: dict = field(default_factory=dict)
    column: tuple = ()


def recorded(folder, rig):
    """Write a log of three runs; return its path."""
    rng = np.random.default_rng(3)
    model = mujoco.MjModel.from_xml_string(ARM.format(**{**DEFAULTS, **rig.model}))
    gains, biases = model.actuator_gainprm.copy(), model.actuator_biasprm.copy()
    rows = ["run,t,u.s1,u.s2,q.shoulder,q.elbow" + (f",{rig.column[0]}" if rig.column else "")]
    for run in (1, 2, 3):
        rates, phases = rng.uniform(3, 7, 2), rng.uniform(1, 2, 2)
        u = np.array([0.5, 0.6]) * np.sin(TIMES[:, None] * rates + phases)
        data = mujoco.MjData(model)
        data.qpos[:] = u[0]
        first, last, servos = rig.off.get(run, (9.0, 9.0, ()))
        for k, t in enumerate(TIMES):
            is_off = first - 1e-9 <= t < last - 1e-9
            q = data.qpos + NOISE * rng.standard_normal(2)
            row = f"{run},{t:.3f},{u[k, 0]:.9f},{u[k, 1]:.9f},{q[0]:.7f},{q[1]:.7f}"
            rows.append(row + (f",{rig.column[1 + is_off]}" if rig.column else ""))
            model.actuator_gainprm[:], model.actuator_biasprm[:] = gains, biases
            for servo in servos if is_off else ():
                model.actuator_gainprm[servo], model.actuator_biasprm[servo] = 0.0, 0.0
            for _ in range(5):
                data.ctrl[:] = u[max(k - rig.delay, 0)]
                error = data.ctrl[0] - data.qpos[0]
                data.ctrl[0] -= np.clip(error, -rig.dead, rig.dead)
                if t >= rig.brakes.get(run, 9.0):
                    data.qvel[:] = 0.0
                else:
                    mujoco.mj_step(model, data)
    (folder / "arm.xml").write_text(ARM.format(**DEFAULTS))
    (folder / "log.csv").write_text("\n".join(rows) + "\n")
    extra = f'[extra.{rig.column[0]}]\nunit = "1"\n' if rig.column else ""
    (folder / "log.toml").write_text(LOG + extra)
    return folder / "log.csv"


def times_of(recording, mask, run):
    """Return the first and last time of a run at which a mask is set."""
    return recording.runs[run].times[mask][[0, -1]].tolist()


@pytest.fixture
def load(tmp_path):
    """Return a function from a rig to its recording and the simulator of the model file."""
    return lambda rig: load_recording(recorded(tmp_path, rig), divide=False)


def test_a_servo_that_is_switched_off_is_found_and_its_samples_are_left_out(load):
    rig = Rig(off={1: (1.2, 2.1, (0,)), 3: (2.0, 9.0, (0,))})
    recording, kind = load(rig)
    (drive,) = find_inactive_drives(recording, kind)
    assert (drive.joint, drive.actuators, drive.is_held) == ("shoulder", ("s1",), False)
    assert times_of(recording, drive.masks[0], 0) == pytest.approx((1.2, 2.1), abs=0.05)
    assert not drive.masks[1].any()
    assert times_of(recording, drive.masks[2], 2) == pytest.approx((2.0, 3.0), abs=0.05)
    left = remove_inactive_drives(recording, kind)
    assert [run.name.partition(" ")[0] for run in left.runs] == ["1", "1", "2", "3"]
    assert left.runs[0].times[-1] < 1.2
    assert left.runs[1].times[0] > 2.1
    assert left.runs[1].before["u.s1"].size
    assert left.runs[3].times[-1] < 2.0
    (note,) = left.notes
    assert "the drives of joint shoulder exert no force in some samples, which are excluded" in note
    assert '[actuators.s1] enable = "COLUMN"' in note
    assert "\n" not in note


@pytest.mark.parametrize(
    ("column", "line"),
    [
        (("torque_enable", 1, 0), '[actuators.s2] enable = "torque_enable"'),
        (("stopped", 0, 1), '[actuators.s2] disable = "stopped"'),
    ],
)
def test_a_column_that_says_so_is_taken_for_the_switch(load, tmp_path, column, line):
    rig = Rig(off={run: (1.0 + 0.3 * run, 9.0, (1,)) for run in (1, 2, 3)}, column=column)
    recording, kind = load(rig)
    found = remove_inactive_drives(recording, kind)
    for number, run in enumerate(found.runs):
        assert run.times.size == TIMES.size
        assert list(run.off) == ["s2"]
        assert times_of(found, run.off["s2"], number)[0] == pytest.approx(1.3 + 0.3 * number)
    (note,) = found.notes
    assert f"state it in log.toml: {line}" in note
    stated = tmp_path / "log.toml"
    stated.write_text(stated.read_text() + line.replace("] ", "]\n") + "\n")
    again, _ = load_recording(tmp_path / "log.csv", divide=False)
    assert all(
        np.array_equal(one.off["s2"], two.off["s2"])
        for one, two in zip(again.runs, found.runs, strict=True)
    )
    assert remove_inactive_drives(again, kind) is again


def test_another_column_that_changes_then_is_named(load):
    rig = Rig(off={2: (1.5, 9.0, (0, 1))}, column=("status", 3, 7))
    recording, kind = load(rig)
    (note,) = remove_inactive_drives(recording, kind).notes
    assert "the drives of joints shoulder, elbow exert no force" in note
    assert "column status changes there" in note


def test_a_servo_that_is_limp_in_a_whole_run_is_found(load):
    rig = Rig(off={2: (0.0, 9.0, (0,))})
    recording, kind = load(rig)
    left = remove_inactive_drives(recording, kind)
    assert [run.name for run in left.runs] == ["1", "3"]


def test_an_emergency_stop_with_brakes_is_found(load):
    rig = Rig(brakes={1: 1.5, 3: 2.0})
    recording, kind = load(rig)
    drives = find_inactive_drives(recording, kind)
    assert [(drive.joint, drive.is_held) for drive in drives] == [
        ("shoulder", True),
        ("elbow", True),
    ]
    assert times_of(recording, drives[0].masks[0], 0) == pytest.approx((1.5, 3.0), abs=0.05)
    left = remove_inactive_drives(recording, kind)
    assert [round(float(run.times[-1]), 1) for run in left.runs] == [1.4, 3.0, 1.9]
    assert "the joints stand still, whatever the command is" in left.notes[0]


@pytest.mark.parametrize(
    "rig",
    [
        Rig(),
        Rig(model={"damping": 3.0}),
        Rig(model={"kp": 20}),
        Rig(model={"kp": 240}),
        Rig(model={"shoulder": 'frictionloss="1.5"'}),
        Rig(model={"shoulder": 'frictionloss="4"'}),
        Rig(model={"servo": 'forcerange="-2.5 2.5"'}),
        Rig(model={"servo": 'forcerange="-1 1"'}),
        Rig(model={"shoulder": 'range="-0.3 0.25"'}),
        Rig(delay=8),
        Rig(dead=0.05),
        Rig(dead=0.2),
    ],
    ids=str,
)
def test_what_is_wrong_at_all_times_is_not_taken_for_a_drive_that_does_nothing(load, rig):
    recording, kind = load(rig)
    assert find_inactive_drives(recording, kind) == []
    assert remove_inactive_drives(recording, kind) is recording


class _SyntheticForces:
    """Force residuals of one joint in one run.

    Args:
        drive_errors: (T,) residual of an active drive; that of an inactive one is small where it is
            one.
    """

    def __init__(self, drive_errors):
        rng = np.random.default_rng(5)
        noise = 0.02 * rng.normal(size=(2, drive_errors.size))
        off = np.where(drive_errors == 1.0, 0.0, 1.0)
        self.needed = self.velocity = np.ones((drive_errors.size, 1))
        self._residuals = np.stack([drive_errors + noise[0], off + noise[1], off + 1.0])

    def residuals(self, _):
        return self._residuals


def _is_off_accepted(drive_errors):
    return _Intervals([_SyntheticForces(drive_errors)], [0], OFF).any()


@pytest.mark.parametrize(("share", "is_accepted"), [(0.3, True), (0.65, True), (0.9, False)])
def test_a_drive_that_hardly_ever_works_is_not_called_inactive(share, is_accepted):
    drive_errors = np.where(np.arange(1000) < 1000 * share, 1.0, 0.0)
    assert _is_off_accepted(drive_errors) is is_accepted


@pytest.mark.parametrize(("error", "is_accepted"), [(0.5, True), (0.8, False)])
def test_an_equal_error_elsewhere_speaks_against_an_inactive_drive(error, is_accepted):
    drive_errors = np.zeros(1000)
    drive_errors[:100] = 1.0
    drive_errors[600:750] = error
    assert _is_off_accepted(drive_errors) is is_accepted
