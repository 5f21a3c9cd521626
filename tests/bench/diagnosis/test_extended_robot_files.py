"""Tests of the model file written next to extended.toml for a robot, and of its score."""

from html import unescape
from pathlib import Path

import mujoco
import pytest

from bench.core.plugin_registries import make_robot_simulator
from bench.diagnosis.explanation import Explanation
from bench.diagnosis.extended_robot_files import ExtendedRobotFiles, build_robot_files
from bench.diagnosis.score_extended import score_model
from sims.extended_simulator import ExtendedSimulator, FittedValue, get_robot_reference
from sims.robot.export import round_trip_check
from sims.robot.fitted_causes import collect_causes
from sims.robot.integrator_settings import IntegratorSettings
from sims.robot.robot_model import RobotModel
from sims.robot.robot_simulator import make_robot_simulator as robot_simulator
from tests.bench.diagnosis.sample_report_data import make_report

EXAMPLE = Path(__file__).parents[3] / "examples" / "robot"
FRICTION = {
    "friction.coulomb@elbow": {
        "coefficient": FittedValue(0.03, "N*m", 0.029, 0.031, stated=0.0, total=0.03)
    }
}


OBSERVED = ["q.shoulder", "q.elbow"]


def extended_of(kind, parameters=None, effects=None):
    own, added, stored = (
        parameters or {},
        effects or {},
        get_robot_reference(kind) if kind else None,
    )
    return ExtendedSimulator(
        "arm2_extended", "arm2", None, "a log", own, added, {}, OBSERVED, kind, stored
    )


@pytest.fixture(scope="module")
def arm():
    return make_robot_simulator(EXAMPLE / "arm2.xml")


def test_it_is_written_with_the_rest_and_its_changed_lines_are_in_the_report(arm, tmp_path):
    shown = make_report()
    explanation = Explanation(shown.verdict, shown, extended_of(arm, effects=FRICTION))
    paths = explanation.write(tmp_path)
    assert [path.name for path in paths[:3]] == ["verdict.json", "extended.toml", "extended.xml"]
    (line,) = explanation.unsaid
    assert "friction" in line
    model = mujoco.MjModel.from_xml_path(str(paths[2]))
    assert model.dof_frictionloss.tolist() == [0.0, 0.03]
    assert "0.031), from 0 to 0.03 N·m, fitted to a log" in paths[2].read_text()
    report = paths[-1].read_text()
    assert "Changes of the model file" in report
    assert report.count('<ins class="line">') == 1
    before = '<joint name="elbow" type="hinge" axis="0 1 0" damping="0.1" armature="0.005"/>'
    assert f"− {before}</del>" in unescape(report)
    assert 'armature="0.005" frictionloss="0.03"' in unescape(report)
    assert "dry friction is stiff in the file" in report
    nothing = make_report("adequate")
    explanation = Explanation(nothing.verdict, nothing, extended_of(arm))
    assert "Changes of the model file" not in explanation._repr_html_()


def test_it_errs_by_the_noise_where_its_cause_is_true(arm, tmp_path):
    shown = make_report()
    explanation = Explanation(shown.verdict, shown, extended_of(arm, effects=FRICTION))
    paths = {path.name: path for path in explanation.write(tmp_path / "out")}
    log = EXAMPLE / "log.csv"
    assert score_model(EXAMPLE / "arm2.xml", log, held_out=True)["normalised_rmse"] > 10
    found = score_model(paths["extended.xml"], log, held_out=True)
    assert found["normalised_rmse"] < 1.5
    assert found["runs"] == 2
    assert set(found["rmse"]) == {"q.shoulder", "q.elbow"}
    same = score_model(paths["extended.toml"], log, held_out=True)
    assert found["normalised_rmse"] == pytest.approx(same["normalised_rmse"], rel=1e-6)


def test_freed_numbers_and_numerics_are_written(arm):
    free = make_robot_simulator(EXAMPLE / "arm2.xml", free=["damping@*", "ipos@forearm"])
    freed = {p.name: FittedValue(0.01, p.unit, 0.009, 0.011) for p in free.parameters}
    free.numerics = IntegratorSettings(0.001, "implicitfast")
    causes = collect_causes(extended_of(free, freed, FRICTION))
    assert set(causes["mass.offset@forearm"]) == {"x", "y", "z"}
    files, said, _, _ = build_robot_files(extended_of(free, freed, FRICTION))
    model = mujoco.MjModel.from_xml_string(files["extended.xml"])
    assert model.dof_damping == pytest.approx([0.31, 0.11])
    assert model.body_ipos[2] == pytest.approx([0.01, 0.01, -0.14])
    assert model.opt.timestep == 0.001
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert len(said) == 1


def test_a_fault_in_a_file_costs_the_file_alone(arm, monkeypatch):
    def differs(*_):
        raise RuntimeError("extended.xml differs from the intended model: dof_damping")

    monkeypatch.setattr(round_trip_check, "check_written_files", differs)
    files, said, _, _ = build_robot_files(extended_of(arm, effects=FRICTION))
    assert files == {}
    assert said == (
        "no model file is written because of an internal error of simgap: "
        "extended.xml differs from the intended model: dof_damping",
    )


def test_actuators_that_a_recording_adds_are_not_added_twice(tmp_path):
    log = EXAMPLE / "log.csv"
    text = (EXAMPLE / "log.toml").read_text()
    tables = [
        f'[actuators.m_{joint}]\njoint = "{joint}"\nkind = "motor"\n'
        for joint in ("shoulder", "elbow")
    ]
    (tmp_path / "log.csv").write_text("\n".join(log.read_text().splitlines()[:401]) + "\n")
    bare = (EXAMPLE / "arm2.xml").read_text()
    bare = bare[: bare.index("<actuator>")] + "</mujoco>"
    (tmp_path / "arm2.xml").write_text(bare)
    lines = "\n".join([text.split("[runs.5]")[0], *tables])
    (tmp_path / "log.toml").write_text(lines)
    alone = score_model(tmp_path / "arm2.xml", tmp_path / "log.csv")
    assert alone["normalised_rmse"] > 5
    spec = mujoco.MjSpec.from_file(str(EXAMPLE / "arm2.xml"))
    kind = robot_simulator(RobotModel(EXAMPLE / "arm2.xml", "mjcf", spec))
    files = build_robot_files(extended_of(kind, effects=FRICTION)).contents
    path = tmp_path / "extended.xml"
    path.write_text(files["extended.xml"])
    assert score_model(path, tmp_path / "log.csv")["normalised_rmse"] < 1.5


def test_what_is_no_robot_has_no_such_file():
    assert build_robot_files(extended_of(None)) == ExtendedRobotFiles({})
