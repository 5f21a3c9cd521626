"""Tests of robot cases: reproducible, of the stated size, with the cause in no file."""

import csv
import dataclasses
import json

import numpy as np
import pytest
import tomllib

pytest.importorskip("pinocchio", reason="pin has no wheel here")

from bench.diagnosis_benchmark.case_generation.recording_conditions import SensorNoise
from sims.core.root_mean_square import compute_rms
from tests.exams import runner
from tests.exams.robots import planted_effects, robot_cases
from tests.exams.robots.cause_sizing import CompetingCauses
from tests.exams.robots.reference_world import Run, World
from tests.exams.robots.robot_signals import observed

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def item():
    return robot_cases.draw_robot_case("single", "arm2-servo", "friction.coulomb", 0)


def test_a_case_is_determined_by_its_name(item):
    first = robot_cases.draw_robot_case("clean", "arm2-servo", "any", 0)
    was = robot_cases.setting_of(first.name)
    robot_cases.setting_of.cache_clear()
    again = robot_cases.setting_of(first.name)
    assert robot_cases.draw_robot_case("clean", "arm2-servo", "any", 0) == first
    assert again.machine == was.machine != robot_cases.setting_of(item.name).machine
    for run, other in zip(again.runs, was.runs, strict=True):
        assert {name: u.tolist() for name, u in run.commands.items()} == {
            name: u.tolist() for name, u in other.commands.items()
        }


def test_a_saved_case_has_the_same_recording(item, tmp_path):
    question = robot_cases.RobotQuestion("single", "arm2-servo", "friction.coulomb", 0)
    restored = question.restore(json.loads(json.dumps(item.save())))
    assert restored == item
    item.write(tmp_path / "drawn")
    restored.write(tmp_path / "restored")
    assert runner.digest(tmp_path / "drawn") == runner.digest(tmp_path / "restored")


def test_a_hidden_cause_has_the_stated_size(item):
    assert 2.9 < item.size < 10.3
    gauge = robot_cases.gauge_of(item.name)
    assert gauge.gap(item.effects) == pytest.approx(item.size, rel=1e-6)
    assert gauge.gap({}) == 0.0


def test_the_size_excludes_what_initial_states_absorb(item):
    gauge, setting = robot_cases.gauge_of(item.name), robot_cases.setting_of(item.name)
    base = [seen.copy() for seen in gauge.base]
    for seen, basis in zip(base, gauge.free, strict=True):
        seen += (7.0 * basis[:, 0]).reshape(seen.shape)
    assert compute_rms(gauge.beyond_states(base)) < 1e-9
    assert all(basis.shape[1] == 2 * len(setting.machine.joints) for basis in gauge.free)


def test_files_state_known_values_and_not_the_hidden_cause(item, tmp_path):
    path = item.write(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "recording.csv", "recording.toml", "robot.urdf",
    ]  # fmt: skip
    stated = tomllib.loads(path.with_suffix(".toml").read_text())
    assert stated["model"] == "robot.urdf"
    assert stated["engine"] == {"timestep": item.step, "integrator": "RK4"}
    assert {name: a["kind"] for name, a in stated["actuators"].items()} == {
        "m_shoulder": "position", "m_elbow": "position",
    }  # fmt: skip
    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 6 * 401
    assert {row["run"] for row in rows if row["run"] in stated["runs"]} == {"4", "5"}
    text = path.with_suffix(".toml").read_text() + path.read_text()
    assert "friction" not in text + (tmp_path / "robot.urdf").read_text().replace(
        'friction="0"', ""
    )


def test_every_effect_can_be_drawn_at_every_place(item):
    setting = robot_cases.setting_of(item.name)
    rng = np.random.default_rng(0)
    for effect in planted_effects.effects("arm2-servo"):
        for place in planted_effects.places(setting.machine, effect):
            c = planted_effects.shape(effect, place, setting, rng)(0.1)
            assert np.isfinite(c).all()
            assert any(c)
    assert {q.kind for q in robot_cases.questions()} == set(robot_cases.KINDS)
    assert sum(q.kind == "clean" for q in robot_cases.questions()) >= 200


def test_a_slipping_encoder_jumps_and_stays(item):
    setting = robot_cases.setting_of(item.name)
    of = planted_effects.drawn("slip", 1, setting, np.random.default_rng(0))
    slips = planted_effects.slips_of(of(0.5), 0)
    assert 1 <= len(slips) <= 2
    gauge = robot_cases.gauge_of(item.name)
    jump = gauge.seen(of(0.5))[0][:, 1] - gauge.base[0][:, 1]
    before = setting.runs[0].times < min(instant for _, instant, _ in slips)
    assert np.all(jump[before] == 0.0)
    total = sum(size for _, _, size in slips) / setting.sigma[1]
    assert jump[-1] == pytest.approx(total)


def test_equivalent_causes_in_a_servo_are_separated_by_a_force_sensor(item):
    """A constant force is equivalent to a command offset multiplied by kp."""
    whole = robot_cases.setting_of(item.name)
    runs = tuple(
        Run(r.times[:60], {name: u[:60] for name, u in r.commands.items()}, r.q, r.v)
        for r in whole.runs
    )
    for split, channels in enumerate((("q.shoulder", "q.elbow"), ("q.elbow", "tau.elbow"))):
        noise = SensorNoise(
            {"q.shoulder": 5e-4, "q.elbow": 5e-4, "tau.elbow": 5e-3}, "white", 0.0, 0.0
        )
        noise = dataclasses.replace(noise, sigma={name: noise.sigma[name] for name in channels})
        setting = dataclasses.replace(whole, runs=runs, channels=channels, noise=noise)
        hidden, rng = {"force.bias@elbow": (0.2,)}, np.random.default_rng(0)
        world = World(setting.machine, hidden)
        values = [noise.add_to(observed(world, run, channels), rng) for run in runs]
        competing_causes = CompetingCauses(setting, hidden, values)
        assert competing_causes.true_cause_error() == pytest.approx(1.0, abs=0.2)
        assert competing_causes.ratio("force.bias@elbow") == pytest.approx(1.0, abs=0.05)
        assert (
            competing_causes.ratio("input.bias@m_elbow") > robot_cases.STANDARD.equal_below
        ) == bool(split)
        assert competing_causes.ratio("drag.linear@elbow") > 1.5
    assert competing_causes.ratio("backlash@m_elbow") is None
