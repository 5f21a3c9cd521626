"""Tests of planted cases: plain MuJoCo with the changed file makes the same data."""

import csv
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest

from bench.diagnosis.explain import explain
from sims.core.root_mean_square import compute_rms
from tests.exams.exam import UndrawableError
from tests.exams.explain_calls import Outcome
from tests.exams.planted.planted_cases import GAP, PlantedQuestion, questions
from tests.exams.planted.planted_motion import Change
from tests.exams.planted.planted_robots import ROBOTS, MissingModelError, Robot
from tests.exams.runner import digest

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")  # MuJoCo warns about old files.


def drawn(name):
    robot, kind, number = name.split("/")
    try:
        return PlantedQuestion(robot, kind, int(number)).draw()
    except UndrawableError as error:
        pytest.skip(str(error))


def table(path):
    with path.open() as file:
        rows = list(csv.DictReader(file))
    runs = {}
    for row in rows:
        runs.setdefault(row.pop("run"), []).append({k: float(v) for k, v in row.items()})
    return runs


def changed_xml(path, item):
    """Return the recording's MJCF with the planted number written into its text."""
    tree = ElementTree.parse(path)
    defaults = tree.find("default/joint")
    if item.kind == "kp":
        element = next(e for e in tree.find("actuator") if e.get("name") == item.place)
        element.set("kp", repr(float(element.get("kp")) * (1 + item.size)))
    else:
        element = next(e for e in tree.iter("joint") if e.get("name") == item.place)
        stated = element.get(item.kind, defaults.get(item.kind, "0"))
        element.set(item.kind, repr(float(stated) + item.size))
    return mujoco.MjModel.from_xml_string(ElementTree.tostring(tree.getroot(), encoding="unicode"))


def errors(model, item, path):
    """Return the RMS of recorded minus simulated positions in units of the noise.

    This test makes the simulation itself. The recorded commands are held between rows. Runs begin
    in the initial state of the case.
    """
    joints, differences = item.experiment.joints, []
    runs, _ = item.performance
    for name, rows in table(path).items():
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = runs[name].positions, runs[name].velocities
        for row in rows:
            measured = [row[f"q.{joint}"] for joint in joints]
            simulated = [data.joint(joint).qpos[0] for joint in joints]
            differences.append(np.subtract(measured, simulated) / item.noise)
            for index in range(model.nu):
                data.ctrl[index] = row[f"u.{model.actuator(index).name}"]
            for _ in range(round(0.01 / model.opt.timestep)):
                mujoco.mj_step(model, data)
    return compute_rms(np.array(differences))


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("walker-servo/kp/0", marks=pytest.mark.long),
        pytest.param("walker-servo/damping/0", marks=pytest.mark.long),
        "reacher/armature/1",
        "pusher/frictionloss/0",
    ],
)
def test_a_model_file_with_the_planted_number_fits_the_data(name, tmp_path):
    item = drawn(name)
    path = item.write(tmp_path)
    model = tmp_path / "robot.xml"
    assert errors(changed_xml(model, item), item, path) == pytest.approx(1.0, abs=0.1)
    assert errors(mujoco.MjModel.from_xml_path(str(model)), item, path) > GAP[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "reacher/armature/1",
        "reacher/frictionloss/0",
        "double-pendulum-cart/frictionloss/0",
        "double-pendulum/mass/0",
        "iiwa/damping/0",
    ],
)
def test_the_planted_cause_is_found_with_the_file_of_its_package(name, tmp_path):
    """MJCF and URDF files of gymnasium, PyBullet and example-robot-data."""
    item = drawn(name)
    answer = explain(item.write(tmp_path)).answer
    assert item.mark(Outcome(answer.to_document(), 0)).strict, "named alone, its number right"
    assert answer.heldout.rmse_extended < 1.05 * answer.heldout.noise_floor


def test_a_planted_mass_equals_a_changed_urdf():
    robot = ROBOTS["ur5"]
    try:
        tree = ElementTree.fromstring(robot.text)
    except MissingModelError as error:
        pytest.skip(str(error))
    inertial = next(e for e in tree.iter("link") if e.get("name") == "forearm_link").find(
        "inertial"
    )
    for element, keys in ((inertial.find("mass"), ["value"]), (inertial.find("inertia"), None)):
        for key in keys or element.keys():
            element.set(key, repr(float(element.get(key)) * 1.2))
    expected = mujoco.MjModel.from_xml_string(ElementTree.tostring(tree, encoding="unicode"))
    model = robot.compile()
    Change("mass", "forearm_link", 0.2).apply(model)
    body, other = model.body("forearm_link"), expected.body("forearm_link")
    assert body.mass == pytest.approx(other.mass, rel=1e-9)
    assert body.inertia == pytest.approx(other.inertia, rel=1e-6)
    assert body.ipos == pytest.approx(other.ipos)
    assert model.body_subtreemass[1] == pytest.approx(expected.body_subtreemass[1])


@pytest.mark.long
def test_a_case_is_drawn_the_same_every_time(tmp_path):
    first, second = drawn("reacher/damping/0"), drawn("reacher/damping/0")
    assert first == second
    digests = [
        digest(item.write(tmp_path / str(number)).parent)
        for number, item in enumerate((first, second))
    ]
    assert digests[0] == digests[1]
    assert GAP[0] <= first.gap <= GAP[1]
    assert first.change.effect == f"drag.linear@{first.place}"


@pytest.mark.long
def test_no_file_of_a_recording_names_the_answer(tmp_path):
    item = drawn("walker-servo/armature/0")
    path = item.write(tmp_path)
    assert {p.name for p in path.parent.iterdir()} == {"log.csv", "log.toml", "robot.xml"}
    assert repr(item.size) not in (tmp_path / "robot.xml").read_text()
    assert "armature" not in (tmp_path / "log.toml").read_text()


def test_force_limits_are_reached_in_part_of_the_motion():
    item = drawn("ur5/kp/0")
    assert item.force_limits
    simulator = item.experiment.simulator(item.change)
    runs, _ = item.performance
    shares = []
    for run in runs.values():
        simulator.start(run.positions, run.velocities)
        reached = 0
        for command in run.commands[:-1]:
            simulator.advance(command)
            limits = simulator.model.actuator_forcerange[:, 1]
            limited = simulator.model.actuator_forcelimited.astype(bool)
            force = np.abs(simulator.data.actuator_force)
            reached += bool((force >= 0.999 * limits)[limited].any())
        shares.append(reached / len(run.commands))
    assert max(shares) > 0.01
    assert max(shares) < 0.9


def test_the_exam_covers_enough_causes_and_model_files():
    assert len(questions()) >= 130
    files = {robot.path for robot in ROBOTS.values() if not robot.is_urdf}
    assert len(files) >= 5


def test_a_missing_package_is_named():
    robot = Robot("none", "no_such_package", "robot.xml", "motor", {})
    with pytest.raises(MissingModelError, match="no_such_package is not installed"):
        robot.source()
