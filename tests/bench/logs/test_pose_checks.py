"""Tests of bodies that overlap in the recorded poses, and of drives that do nothing."""

import re

import mujoco
import numpy as np
import pytest

from bench.logs.quality.pose_checks import find_body_contacts
from bench.logs.recording_loading import load_recording
from tests.bench.diagnosis.simulated_logs import describe, write_log
from tests.command_output import run_command

LEG = """<mujoco model="leg"><worldbody>
<body name="base"><geom name="block" type="box" size="0.1 0.1 0.05"/>
<body name="hip" pos="0 0 {height}"><joint name="hip" axis="0 1 0"/>
<geom name="round" type="sphere" size="0.05"/><geom type="sphere" size="0.03" pos="0 0 0.2"/>
</body></body>
</worldbody><actuator><motor name="m" joint="hip"/></actuator>{more}</mujoco>"""
EXCLUDED = '<contact><exclude body1="base" body2="hip"/></contact>'


def log(folder, height, more=""):
    """Write a log of a leg whose hip is at some height above the middle of its fixed base."""
    k = np.arange(120)
    description = describe({"q.hip": "rad", "u.m": "N*m"}, model="leg")
    run = (k / 50, 0.3 * np.sin(k / 9), np.cos(k / 9))
    leg = LEG.format(height=height, more=more)
    return write_log(folder, description, "q.hip,u.m", [run], leg=leg)


@pytest.mark.parametrize(
    ("height", "more", "depth"),
    [(0.084, "", "16 mm"), (0.084, EXCLUDED, None), (0.11, "", None)],
)
def test_bodies_that_overlap_in_all_poses_are_named(height, more, depth, tmp_path):
    """A base that is welded to the world: MuJoCo does not leave out contacts with its children."""
    path = log(tmp_path, height, more)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "leg.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert bool(data.ncon) == (depth is not None)
    findings = list(find_body_contacts(*load_recording(path)))
    if depth is None:
        assert findings == []
        return
    (finding,) = findings
    assert finding.text.startswith(f"bodies base and hip overlap by up to {depth} in 100% of the")
    assert finding.remedy == f"add {EXCLUDED} in leg.xml"


FEET = """<mujoco model="feet"><worldbody>
<body name="left" pos="0 0.1 1"><joint name="left" axis="1 0 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02"/></body>
<body name="right" pos="0 -0.1 1"><joint name="right" axis="1 0 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02"/></body>
</worldbody><actuator><motor name="l" joint="left"/><motor name="r" joint="right"/></actuator>
</mujoco>"""


@pytest.mark.parametrize(("swing", "share"), [(0.5, 0.396), (0.1, None)])
def test_links_that_touch_each_other_now_and_then_are_named(swing, share, tmp_path):
    """Legs 0.2 m apart and 0.5 m long meet at an angle of arcsin(0.08 / 0.5) = 0.16 rad.

    A sine of 0.5 rad is larger than this in 39.6 % of the time.
    """
    k = np.arange(120)
    angle = swing * np.sin(2 * np.pi * k / 24)
    description = describe(
        {"q.left": "rad", "q.right": "rad", "u.l": "N*m", "u.r": "N*m"}, model="feet"
    )
    run = (k / 50, -angle, angle, 0 * k, 0 * k)
    path = write_log(tmp_path, description, "q.left,q.right,u.l,u.r", [run], feet=FEET)
    recording, kind = load_recording(path)
    findings = [f for f in find_body_contacts(recording, kind) if f.about == "contact"]
    if share is None:
        assert findings == []
        return
    (finding,) = findings
    found = re.match(r"links left and right touch each other in (\d+)% of", finding.text)
    assert found
    assert int(found[1]) / 100 == pytest.approx(share, abs=0.05)


def test_inspect_prints_overlaps_and_drives_that_do_nothing(tmp_path):
    """A servo is switched off at 2 s; the column of its power changes there."""
    text = """<mujoco model="arm"><option timestep="0.002"/><worldbody><body name="link">
    <joint name="hinge" axis="0 1 0" damping="0.05"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02"/></body></worldbody>
    <actuator><position name="servo" joint="hinge" kp="20" kv="0.5"/></actuator></mujoco>"""
    (tmp_path / "arm.xml").write_text(text)
    (tmp_path / "log.toml").write_text(
        'model = "arm.xml"\n[time]\ncolumn = "t"\n[channels."q.hinge"]\nfile = "raw.csv"\n'
        'column = "pos"\nunit = "rad"\n[inputs."u.servo"]\nfile = "raw.csv"\ncolumn = "cmd"\n'
        'unit = "rad"\n[extra.power]\nunit = "1"\n'
    )
    model = mujoco.MjModel.from_xml_string(text)
    data, rows = mujoco.MjData(model), []
    rng = np.random.default_rng(1)
    for k in range(400):
        u = 0.8 * np.sin(3 * k / 100) + 0.3
        q = data.qpos[0] + 1e-4 * rng.standard_normal()
        rows.append(f"{k / 100},{q:.6f},{u:.6f},{int(k < 200)}")
        if k == 200:
            model.actuator_gainprm[:] = model.actuator_biasprm[:] = 0
        data.ctrl[:] = u
        for _ in range(5):
            mujoco.mj_step(model, data)
    (tmp_path / "raw.csv").write_text("t,pos,cmd,power\n" + "\n".join(rows) + "\n")
    output = run_command("inspect", tmp_path / "log.toml", "--out", tmp_path / "look").out
    assert "finding: drive: actuator servo exerts nothing where power is 0" in output
    assert 'state it in log.toml: [actuators.servo] enable = "power"' in output
    assert "convention:" not in output
