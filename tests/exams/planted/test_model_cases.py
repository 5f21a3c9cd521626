"""Tests of recordings of model files as people have them."""

import csv
import json

import mujoco
import numpy as np
import pytest

from bench.cli.main import main
from bench.diagnosis.explain import explain
from sims.core.toml_validation import tomllib
from tests.exams.exam import UndrawableError
from tests.exams.planted.model_cases import MIN_GAP, ModelExperiment, ModelQuestion, questions
from tests.exams.planted.model_files import MODELS
from tests.exams.planted.planted_motion import Change
from tests.exams.robot_files import FORCE_UNITS

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")  # MuJoCo warns about old files.


def drawn(system, index):
    try:
        return ModelQuestion(system, index).draw()
    except UndrawableError as error:
        pytest.skip(str(error))


def test_each_of_25_models_has_three_wrong_numbers_and_a_clean_recording():
    names = [question.name for question in questions()]
    assert len({question.system for question in questions()}) == 25
    assert len(names) == len(set(names)) == 100
    assert sum(question.kind == "clean" for question in questions()) == 25


@pytest.mark.parametrize("name", ["arm-included", "arm-absent-meshes", "quadruped-hanging"])
def test_a_recording_holds_the_file_as_a_user_has_it(name, tmp_path):
    case = drawn(name, -1)
    case.write(tmp_path)
    text = (tmp_path / "robot.xml").read_text()
    description = tomllib.loads((tmp_path / "log.toml").read_text())
    if name == "arm-included":
        assert '<include file="parts/arm_body.xml"/>' in text
        assert "arm/elbow" in (tmp_path / "parts/arm_body.xml").read_text()
    elif name == "arm-absent-meshes":
        assert "shoulder_pan_visual.stl" in text
        assert not list(tmp_path.rglob("*.stl"))
    else:
        assert "freejoint" in text
        assert description["engine"] == {"fix_base": True}


def test_a_wrong_number_shows_and_a_clean_recording_has_only_noise(tmp_path):
    case = drawn("arm-filtered", 0)
    assert case.gap > MIN_GAP
    clean = drawn("arm-filtered", -1)
    path = clean.write(tmp_path)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    with path.open() as file:
        rows = [row for row in csv.DictReader(file) if row["run"] == "r2"]
    runs, _ = clean.performance
    data, errors = mujoco.MjData(model), []
    data.qpos[:], data.qvel[:] = runs["r2"].positions, runs["r2"].velocities
    data.act[:] = [float(rows[0][f"u.{model.actuator(i).name}"]) for i in range(model.nu)]
    for row in rows:
        errors.append(float(row["q.elbow"]) - data.joint("elbow").qpos[0])
        data.ctrl[:] = [float(row[f"u.{model.actuator(i).name}"]) for i in range(model.nu)]
        mujoco.mj_step(model, data, nstep=5)
    assert np.std(errors) == pytest.approx(1e-3, rel=0.12)


def test_a_point_mass_moves_the_centre_and_adds_its_own_inertia():
    model = MODELS["arm-included"].compile()
    body = model.body("arm/elbow_link")
    mass, centre, inertia = float(body.mass[0]), body.ipos.copy(), body.inertia.copy()
    Change("payload", "arm/elbow_link", 0.3).apply(model)
    assert body.mass == pytest.approx(mass + 0.3)
    assert body.ipos == pytest.approx(centre * (1 + 0.3 / (mass + 0.3)))
    # Two masses at a distance: the reduced mass times the square of the distance.
    across = 0.3 * mass / (0.3 + mass) * centre[0] ** 2
    assert max(body.inertia) == pytest.approx(max(inertia) + across)


def test_a_servo_of_a_site_or_tendon_has_the_unit_of_its_length(tmp_path):
    drawn("quadrotor", -1).write(tmp_path / "flight")
    drawn("hand", -1).write(tmp_path / "hand")
    flight = tomllib.loads((tmp_path / "flight/log.toml").read_text())
    hand = tomllib.loads((tmp_path / "hand/log.toml").read_text())
    assert flight["inputs"]["u.m1"]["unit"] == FORCE_UNITS["m"]
    assert hand["inputs"]["u.a_thumb_curl"]["unit"] == "rad"
    assert flight["channels"]["q.base.qw"] == {"unit": "1", "noise": 5e-4}


def test_unmeasured_joints_of_a_loop_have_no_channel():
    experiment = ModelExperiment("biped-with-rods", 0)
    assert "q.left_knee" not in experiment.channel_names
    assert "left_knee" in experiment.places


@pytest.mark.long
def test_a_large_armature_and_the_inertia_of_its_body_are_equals(tmp_path):
    # The regression is linear and far off; the competing filter needs several steps.
    case = drawn("quadruped-hanging", 1)
    assert case.change.effect == "inertia.armature@RR_hip_joint"
    case.write(tmp_path)
    assert main(["explain", str(tmp_path / "log.csv"), "--out", str(tmp_path / "out")]) == 0
    verdict = json.loads((tmp_path / "out" / "verdict.json").read_text())
    (cause,) = verdict["causes"]
    assert {cause["effect"], *cause["alternatives"]} == {case.change.effect, "inertia.scale@RR_hip"}


@pytest.mark.long
def test_wheels_that_roll_as_the_file_says_raise_no_alarm(tmp_path):
    """The noise of the recorded pose is larger than the depth of the contacts, 0.15 mm."""
    case = drawn("differential-drive", -1)
    answer = explain(case.write(tmp_path)).answer
    assert answer.verdict == "adequate"
    assert not answer.causes
