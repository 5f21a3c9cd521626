"""Tests of the MuJoCo class of a data sheet: it loads, and a model with it reproduces the log."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bench.core.plugin_registries import make_robot_simulator
from bench.diagnosis.datasheet.datasheet import DataSheet
from bench.diagnosis.datasheet.datasheet_joint import make_subject
from bench.diagnosis.datasheet.datasheet_mjcf import build_mjcf, make_class_name
from bench.diagnosis.score_extended import score_model
from sims.extended_simulator import FittedValue
from tests.bench.diagnosis.datasheet.drive_recordings import CONSTANTS, FRICTION, TRUE_PARAMETERS
from tests.bench.diagnosis.test_extended_robot_files import EXAMPLE, extended_of

ELBOW = {"friction.coulomb@elbow": {"coefficient": FittedValue(0.03, "N*m", 0.029, 0.031)}}
USER = """<mujoco>
  <include file="class.xml"/>
  <worldbody><body><joint name="hip" class="servo_i_one_i"/><geom size="0.1"/></body></worldbody>
  <actuator><position joint="hip" class="servo_i_one_i"/></actuator>
</mujoco>
"""


def test_a_users_file_takes_the_numbers_from_the_class(files: Path, tmp_path: Path) -> None:
    (tmp_path / "class.xml").write_bytes((files / "class.xml").read_bytes())
    (tmp_path / "leg.xml").write_text(USER)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "leg.xml"))
    stall = (
        TRUE_PARAMETERS["torque_constant"] * CONSTANTS["voltage"] / TRUE_PARAMETERS["resistance"]
    )
    damping = TRUE_PARAMETERS["torque_constant"] ** 2 / TRUE_PARAMETERS["resistance"]
    assert model.dof_frictionloss[0] == pytest.approx(FRICTION, rel=0.02)
    assert model.dof_armature[0] == pytest.approx(TRUE_PARAMETERS["armature"], rel=0.03)
    assert model.dof_damping[0] == pytest.approx(damping, rel=0.03)
    assert model.actuator_forcerange[0] == pytest.approx([-stall, stall], rel=0.01)
    gain = stall * CONSTANTS["kp"] * CONSTANTS["error_gain"]
    assert model.actuator_gainprm[0, 0] == pytest.approx(gain, rel=0.01)


def test_the_class_alone_is_a_file_that_mujoco_loads(files: Path) -> None:
    mujoco.MjModel.from_xml_path(str(files / "class.xml"))
    text = (files / "class.xml").read_text()
    assert "friction.coulomb@joint: 0.0" in text
    assert "(95 %: " in text
    assert "torque_enable" in text


def test_it_reproduces_the_log(files: Path, tmp_path: Path) -> None:
    """The residual is below 1.1 times the noise; without the friction of the class it exceeds 3."""
    found = score_model(files / "model.xml", files / "model.toml", held_out=True)
    assert found["runs"] == 3
    assert found["normalised_rmse"] < 1.1
    model = (files / "model.xml").read_text()
    (tmp_path / "loose.xml").write_text(re.sub(r'frictionloss="[^"]*"', "", model))
    loose = score_model(tmp_path / "loose.xml", files / "model.toml", held_out=True)
    assert loose["normalised_rmse"] > 3


def test_a_law_that_mujoco_lacks_is_its_mean(sheet: DataSheet, tmp_path: Path) -> None:
    """Stribeck friction with an extra part of zero becomes dry friction of its Coulomb value."""
    numbers = {"coulomb": 0.03, "extra": 0.0, "speed": 0.1}
    law = {name: FittedValue(value, "1", None, None) for name, value in numbers.items()}
    other = replace(sheet, extended=replace(sheet.extended, effects={"friction.stribeck": law}))
    made = build_mjcf(other, tmp_path)
    model = mujoco.MjModel.from_xml_string(made.contents["model.xml"])
    assert model.dof_frictionloss[0] == pytest.approx(0.03, rel=1e-9)
    assert any(line.startswith("friction.stribeck: MuJoCo has no such law") for line in made.notes)


def test_settings_that_differ_have_a_class_each(sheet: DataSheet, tmp_path: Path) -> None:
    first, second, _ = sheet.recording.runs
    runs = (replace(first, constants={"kp": 100.0}), replace(second, constants={"kp": 400.0}))
    made = build_mjcf(replace(sheet, recording=replace(sheet.recording, runs=runs)), tmp_path)
    gains = [
        mujoco.MjModel.from_xml_string(made.contents[f"model_kp{kp}.xml"]).actuator_gainprm[0, 0]
        for kp in (100, 400)
    ]
    assert gains[1] == pytest.approx(4 * gains[0])
    assert made.contents["class.xml"].count("<default class=") == 2


def test_a_robots_joint_is_the_same_with_its_class(sheet: DataSheet, tmp_path: Path) -> None:
    """The dry friction of the elbow is the value of the file plus the identified one."""
    kind = make_robot_simulator(EXAMPLE / "arm2.xml")
    extended = extended_of(kind, effects=ELBOW)
    arm = replace(sheet, subject=make_subject(kind, "elbow"), extended=extended, name="elbow")
    made = build_mjcf(arm, tmp_path)
    model = mujoco.MjModel.from_xml_string(made.contents["model.xml"])
    bare = mujoco.MjModel.from_xml_path(str(EXAMPLE / "arm2.xml"))
    elbow = model.joint("elbow").dofadr[0]
    found = 0.03
    stated = bare.dof_frictionloss[bare.joint("elbow").dofadr[0]]
    assert model.dof_frictionloss[elbow] == pytest.approx(stated + found)
    np.testing.assert_allclose(model.dof_damping, bare.dof_damping)
    assert 'class="elbow"' in made.contents["class.xml"]
    mujoco.MjModel.from_xml_string(made.contents["class.xml"])


def test_a_name_is_one_that_xml_takes() -> None:
    assert make_class_name('SO-101 "base"/<1>') == "SO-101_base_1"
    assert make_class_name("***") == "drive"
