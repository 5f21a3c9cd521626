import importlib.util
import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from bench.benchmark.problem.experiment_config import (
    TunerEntry,
    list_experiment_names,
    load_experiment,
    parse_experiment,
)
from bench.benchmark.problem.fisher_information import compute_target_spectrum
from bench.benchmark.problem.missing_requirements import explain_missing_model_file
from bench.benchmark.problem.robot_experiment import (
    complete_robot_experiment,
    find_model,
    get_simulator_class,
    make_robot_experiment,
)
from bench.benchmark.problem.targets import draw_target
from bench.benchmark.problem.tuning_problem import TuningProblem
from bench.benchmark.runner.run_fingerprint import (
    RunIds,
    compute_fingerprint,
    hash_class_source,
    hash_effect_sources,
)
from bench.benchmark.runner.tuner_training import compute_training_key
from bench.cli.commands import list_catalogue
from bench.cli.commands.list_catalogue import format_documents
from sims import effects
from sims.core.registry import PartUnavailableError
from sims.core.simulator import InputError
from tests.bench.diagnosis.pendulum_recordings import SWINGING, written

ROBOTS = Path(__file__).parents[4] / "shared" / "robots"
"""Folder of shared robots; tests that need it are skipped on machines without it."""
ARM = {
    "model": "swinging.xml",
    "free": ["damping@elbow", "mass@fore"],
    "sampling": {"rate": 50.0, "samples": 40},
    "salt": "public",
    "tuners": ["random"],
}


@pytest.fixture
def arm(tmp_path):
    """Return a function that builds the arm experiment with changes, next to its model file."""
    written(tmp_path)

    def parse_arm(**changes):
        return parse_experiment("arm", {**ARM, **changes}, tmp_path / "arm.toml")

    return parse_arm


def test_a_model_file_stands_instead_of_a_simulator(arm, tmp_path):
    experiment = arm()
    assert experiment.model == str(tmp_path / "swinging.xml"), "known from everywhere"
    assert experiment.simulator == "swinging"
    again = parse_experiment(
        "arm", experiment.document(), tmp_path / "elsewhere" / "experiment.toml"
    )
    assert again == experiment
    problem = TuningProblem(experiment)
    assert [p.name for p in problem.cube.parameters] == ["drag.linear@elbow", "mass.scale@fore"]
    assert [c.name for c in problem.channels] == ["q.shoulder", "q.elbow"]
    (scenario,) = problem.draw_scenarios(np.random.default_rng(0))
    assert set(scenario.inputs) == {"u.m_shoulder", "u.s_elbow"}
    with pytest.raises(InputError, match="model = "):
        parse_experiment("arm", {"tuners": ["random"]}, tmp_path / "arm.toml")
    with pytest.raises(InputError, match=r"free and actuators are of a robot"):
        parse_experiment("arm", {"simulator": "ball", "free": ["damping@*"]}, tmp_path / "arm.toml")


def test_usual_commands_move_every_joint_and_keep_within_limits(arm):
    problem = TuningProblem(arm(sampling={"rate": 100.0, "samples": 400}))
    controls = {"u.m_shoulder": (-3.0, 3.0), "u.s_elbow": (-0.5, 0.9)}
    for seed in range(4):
        (scenario,) = problem.draw_scenarios(np.random.default_rng(seed))
        for name, (low, high) in controls.items():
            told = scenario.inputs[name]
            assert low <= told.min()
            assert told.max() <= high
            assert abs(told[0]) < 1e-12, "it begins at the pose of the file"
        theta = np.array([[p.nominal for p in problem.cube.parameters]])
        q = problem.simulator.simulate(theta, scenario)[0]
        assert (np.ptp(q, axis=0) > 0.1).all()
        assert np.abs(q[:, 0]).max() < 1.5


def ids(experiment):
    """Return the id of a run and the key of a training."""
    target = draw_target(TuningProblem(experiment), "in", 0).blinded
    run = RunIds(experiment).make_run_id(experiment.tuners[0], target, 0, 12)
    return run, compute_training_key(experiment, TunerEntry("regressor", "regressor"), 0)


def test_what_a_model_file_says_enters_names_of_runs_and_of_weights(arm, tmp_path):
    experiment = complete_robot_experiment(arm())
    before = ids(experiment)
    moved = tmp_path / "moved"
    moved.mkdir()
    written(moved, name="other.xml")
    elsewhere = experiment.chosen(model=str(moved / "other.xml"))
    assert ids(elsewhere) == before, "where a file lies and what it is called is nothing"
    changes = (
        {"free": ("damping@elbow", "damping@shoulder")},
        {"settings": {"timestep": 0.0025}},
        {"actuators": {"extra": {"joint": "elbow", "kind": "motor"}}},
    )
    others = [ids(experiment.chosen(**change)) for change in changes]
    held = compute_fingerprint(experiment, [])
    written(tmp_path, SWINGING.replace('mass="0.8"', 'mass="0.81"'))
    others.append(ids(experiment))
    for run, weights in others:
        assert run != before[0]
        assert weights != before[1]
    assert len({run for run, _ in others}) == len({weights for _, weights in others}) == 4
    changed = {k for k, v in compute_fingerprint(experiment, []).items() if held[k] != v}
    assert changed == {"model file", "simulator and tuners"}


def test_an_effect_at_a_place_is_hashed_as_the_effect_that_it_is():
    settings = {"effects": ["input.delay@s_elbow"], "fixed": {"friction.coulomb@*": 0.1}}
    expected = [
        hash_class_source(effects.get_effect(name)) for name in ("friction.coulomb", "input.delay")
    ]
    assert hash_effect_sources(settings) == expected


def test_names_that_do_not_exist_come_with_those_that_do(arm):
    with pytest.raises(InputError, match=r"number of robot .*'dampng'; did you mean damping\?"):
        get_simulator_class(arm(free=["dampng@*"]))
    with pytest.raises(InputError, match=r"'elbo'; there are: \*, elbow, shoulder"):
        get_simulator_class(arm(free=["damping@elbo"]))
    with pytest.raises(InputError, match=r"damping@\*.*found none"):
        get_simulator_class(arm(free=[]))
    with pytest.raises(InputError, match=r"parameter .*'mass'; there are: drag.linear@elbow"):
        TuningProblem(arm(parameters={"mass": {"nominal": 1.0}}))


def test_what_no_robot_could_be_is_one_line(arm):
    for changes, message in (
        ({"model": "x" * 5000}, "no such file"),
        ({"model": "package://"}, "expected package://NAME/FILE"),
        ({"simulator": "../x"}, "simulator: expected letters"),
        ({"actuators": {"m": 5}}, "actuators.m: expected a table"),
        ({"settings": {"effects": ["drag.linear@elbow"]}}, "its coefficient is free already"),
    ):
        with pytest.raises(InputError, match=message) as raised:
            TuningProblem(arm(**changes))
        assert "\n" not in str(raised.value)
        assert len(str(raised.value)) < 400


def test_what_is_late_everywhere_is_one_number(arm):
    several = [p.name for p in get_simulator_class(arm(free=["damping@*"])).parameters]
    assert several == ["drag.linear@shoulder", "drag.linear@elbow"]
    assert [p.name for p in get_simulator_class(arm(free=["input.delay@*"])).parameters] == [
        "input.delay@*"
    ]


def test_model_files_are_found_in_packages_and_in_the_folder_of_robots(tmp_path, monkeypatch):
    found = find_model("package://bench/experiments/arm2.xml", "mine")
    assert found.samefile("bench/experiments/arm2.xml")
    monkeypatch.setenv("SIMGAP_ROBOTS", str(tmp_path))
    written(tmp_path)
    assert find_model("swinging.xml", "mine") == tmp_path / "swinging.xml"
    with pytest.raises(PartUnavailableError, match=r"experiment mine .*in .* \(SIMGAP_ROBOTS\)"):
        find_model("nowhere.xml", "mine")
    with pytest.raises(PartUnavailableError, match=r"needs nopackage, not installed"):
        find_model("package://nopackage/arm.xml", "mine")
    with pytest.raises(PartUnavailableError, match="package bench has no such file"):
        find_model("package://bench/nowhere.xml", "mine")


def test_what_a_shipped_experiment_lacks_is_said_in_the_list(tmp_path, monkeypatch):
    from bench.cli.commands.list_catalogue import list_experiments

    monkeypatch.setenv("SIMGAP_ROBOTS", str(tmp_path))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    monkeypatch.setitem(sys.modules, "pybullet_data", None)
    listed = {line.split()[0]: line for line in format_documents("experiments", list_experiments())}
    assert listed["robot-so101"].split(maxsplit=1)[1].startswith("needs `simgap download so101`.")
    assert "skipped: needs pybullet_data, not installed" in listed["robot-iiwa"]
    assert not [line for line in listed.values() if "skipped" in line and "iiwa" not in line]


def without(monkeypatch, *packages):
    """Simulate that these packages are not installed."""
    find = importlib.util.find_spec

    def found(name, *more):
        return None if name.split(".")[0] in packages else find(name, *more)

    monkeypatch.setattr(importlib.util, "find_spec", found)


def test_the_list_marks_experiments_whose_engine_or_tuners_are_absent(monkeypatch):
    without(monkeypatch, "torch", "pybullet", "pybullet_data")
    listed = {each["name"]: each for each in list_catalogue.list_experiments()}
    pybullet = "needs pybullet, not installed (pip install pybullet)"
    for name in ("ball-drop", "ball-crossengine", "pendulum-real"):
        assert listed[name]["skipped"] == pybullet, name
    assert "pybullet_data" in listed["robot-iiwa"]["skipped"]
    assert listed["bounce-shot"]["skipped"] is None, "it asks for the engine batch"
    assert listed["robot-arm2"]["skipped"] is None
    absent = listed["robot-arm2"]["tuners_skipped"]
    assert set(absent) == {"regressor", "tunenet", "hybrid"}
    assert set(absent.values()) == {"needs torch, not installed (pip install torch)"}
    assert "least_squares" not in absent
    words = {
        line.split()[0]: line for line in format_documents("experiments", list(listed.values()))
    }
    assert f"skipped: {pybullet}." in words["ball-drop"]
    torch = "needs torch, not installed (pip install torch)"
    said = f"without regressor, tunenet, hybrid: {torch}. {listed['robot-arm2']['says']}"
    assert said in words["robot-arm2"]
    together = listed["misspecified"]
    assert together["skipped"] is None
    assert set(together["tuners_skipped"]) == {"regressor", "tunenet", "hybrid"}


@pytest.mark.parametrize(
    "name", [name for name in list_experiment_names() if name.startswith("robot-")]
)
def test_shipped_experiments_on_robots_are_sound_and_their_numbers_show(name, monkeypatch):
    if ROBOTS.is_dir():
        monkeypatch.setenv("SIMGAP_ROBOTS", os.environ.get("SIMGAP_ROBOTS", str(ROBOTS)))
    experiment = load_experiment(name)
    if reason := explain_missing_model_file(experiment):
        pytest.skip(reason)
    problem = TuningProblem(experiment)
    assert 4 <= problem.cube.dim <= 8
    for kind in experiment.ranges:
        target = draw_target(problem, kind, 0)
        assert np.isfinite(target.blinded.fitting.observed).all()
    told = compute_target_spectrum(problem, draw_target(problem, "in", 0))
    assert told.is_stiff[:4].all(), "these commands tell of most numbers"


def test_the_arm_of_the_experiments_is_that_of_the_example():
    from pathlib import Path

    shipped = Path("bench/experiments/arm2.xml").read_text()
    assert shipped == Path("examples/robot/arm2.xml").read_text()


def test_what_is_asked_on_a_command_line_is_an_experiment_of_its_own(tmp_path):
    experiment = make_robot_experiment(written(tmp_path), None, ["damping@*"])
    assert experiment.ranges == ("in", "wide")
    assert experiment.noise == {"q.shoulder": 1e-3, "q.elbow": 1e-3}
    assert set(experiment.inputs) == {"u.m_shoulder", "u.s_elbow"}, "as they will be kept"
    json.dumps(experiment.document())
    with pytest.raises(InputError, match="no such file"):
        make_robot_experiment(tmp_path / "none.xml", None, ["damping@*"])
