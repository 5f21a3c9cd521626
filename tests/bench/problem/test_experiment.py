from pathlib import Path

import pytest
import tomli_w

from bench.benchmark.problem.experiment_config import (
    TunerEntry,
    expand_sweep,
    list_experiment_names,
    load_experiment,
    parse_experiment,
)
from bench.benchmark.problem.experiment_recording import find_recording
from bench.benchmark.problem.targets import draw_target
from bench.benchmark.problem.tuning_problem import TuningProblem
from bench.benchmark.runner.run_fingerprint import RunIds
from bench.benchmark.runner.tuner_training import compute_training_key
from sims.core.simulator import InputError
from sims.core.toml_validation import to_toml_value, tomllib
from tests.sample_experiments import SPRING, spring_experiment


@pytest.mark.parametrize("name", list_experiment_names())
def test_document_of_every_shipped_experiment_gives_it_back(name):
    experiment = load_experiment(name)
    document = tomllib.loads(tomli_w.dumps(to_toml_value(experiment.document())))
    assert parse_experiment(name, document, Path("x.toml")) == experiment
    assert experiment.says


def test_published_setting_of_ball_drop():
    experiment = load_experiment("ball-drop")
    assert experiment.sampling.samples == 400
    assert experiment.sampling.rate == 60
    assert experiment.constants == {"gravity": 9.8, "radius": 0.5, "mass": 1.0}
    assert experiment.settings == {
        "engine": "pybullet", "time_step": 1 / 60, "native_contact": True,
        "lateral_friction": 0.2, "plane_restitution": 1.0, "linear_damping": 0.04,
    }  # fmt: skip
    assert experiment.initial == {"z": (4.0, 5.0)}
    assert experiment.parameters["restitution"]["training"] == (0.3, 0.7)
    assert (experiment.targets, experiment.seeds, experiment.budget) == (100, 5, 100)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"buget": 3}, r"unknown entry of .*'buget'; did you mean budget"),
        ({"budget": 0}, "budget must be at least 1, found 0"),
        ({"budget": "ten"}, "budget: expected a whole number, found 'ten'"),
        ({"budget": True}, "budget: expected a whole number, found True"),
        ({"observe": "x"}, "observe: expected a list, found 'x'"),
        ({"ranges": ["inside"]}, "unknown range 'inside'; there are: in, real, wide"),
        ({"ranges": ["real"]}, "go together"),
        ({"noise": {"x": "small"}}, r"noise.x: expected a number, found 'small'"),
        ({"initial": {"x": [2, 1]}}, r"initial.x: expected low < high, found \[2, 1\]"),
        ({"initial": {"x": [1, 2, 3]}}, r"initial.x: expected \[low, high\]"),
        (
            {"parameters": {"rate": {"trainig": [2, 3]}}},
            r"unknown entry of \[parameters.rate\].*'trainig'",
        ),
        ({"sampling": {"rate": 20.0, "sample": 5}}, "'sample'"),
        (
            {"tuners": {"random": {"seeds": 0}}},
            r"tuners.random.seeds: expected at least 1, found 0",
        ),
        (
            {"tuners": {"random": {"option": {}}}},
            "'option'; there are: budget, options, randomised, seeds, tuner",
        ),
        ({"simulator": ""}, "expected simulator"),
    ],
)
def test_faults_are_one_line_that_names_file_and_entry(change, message):
    with pytest.raises(InputError, match=message) as caught:
        parse_experiment("e", {**SPRING, **change}, Path("mine.toml"))
    assert "mine.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_seeds_on_the_command_line_never_exceed_an_entry_that_asks_for_fewer():
    experiment = spring_experiment(tuners={"random": {"seeds": 1}, "cma_es": {}}).with_seeds(3)
    assert experiment.seeds == 3
    assert [e.seeds for e in experiment.tuners] == [1, None]


def test_chosen_tuners_keep_their_entries_and_new_ones_get_one():
    experiment = spring_experiment(tuners={"mine": {"tuner": "random", "seeds": 2}}).with_tuners(
        ["cma_es", "mine"]
    )
    assert [(e.label, e.tuner, e.seeds) for e in experiment.tuners] == [
        ("cma_es", "cma_es", None),
        ("mine", "random", 2),
    ]


def test_tuners_may_be_a_list_of_names_and_of_tables_that_name_one():
    listed = spring_experiment(
        tuners=["random", {"tuner": "cma_es", "seeds": 1}, {"label": "mine", "tuner": "cma_es"}]
    )
    tables = {"random": {}, "cma_es": {"seeds": 1}, "mine": {"tuner": "cma_es"}}
    assert listed == spring_experiment(tuners=tables)


@pytest.mark.parametrize(
    ("tuners", "message"),
    [
        ("random", "tuners: expected a list of names or a table for each tuner, found 'random'"),
        (["random", 3], r"tuners\[1\]: expected a name or a table, found 3"),
        ([{"seeds": 1}], r"tuners\[0\]: expected a table with tuner = \"NAME\", found"),
        (["random", "random"], "tuners: random is listed twice; give one of them a label"),
        ([{"tuner": "random", "budget": 0}], r"tuners\[0\].budget: expected at least 1, found 0"),
        (
            [{"tuner": "random", "option": {}}],
            "'option'; there are: budget, options, randomised, seeds, tuner",
        ),
    ],
)
def test_faults_in_a_list_of_tuners_are_one_line(tuners, message):
    with pytest.raises(InputError, match=message) as caught:
        spring_experiment(path="mine.toml", tuners=tuners)
    assert "mine.toml" in str(caught.value)


@pytest.mark.parametrize("change", [{"noise": {"x": 10**400}}, {"timeout": 10**400}])
def test_a_number_without_end_is_refused(change):
    with pytest.raises(InputError, match=r"mine.toml: .*: expected a number, found 1000"):
        spring_experiment(path="mine.toml", **change)


def test_a_sweep_is_an_experiment_for_each_combination():
    swept = spring_experiment(
        title="A spring",
        tags=["quick"],
        parameters={"rate": {"training": [2.0, 3.0]}},
        sweep={"budget": [3, 9], "noise.x": [0.001, 0.01], "parameters.rate.log": [True]},
    )
    expanded = expand_sweep(swept)
    assert [e.name for e in expanded] == [
        "spring-test[budget=3,noise.x=0.001,parameters.rate.log=true]",
        "spring-test[budget=3,noise.x=0.01,parameters.rate.log=true]",
        "spring-test[budget=9,noise.x=0.001,parameters.rate.log=true]",
        "spring-test[budget=9,noise.x=0.01,parameters.rate.log=true]",
    ]
    last = expanded[-1]
    assert (last.budget, last.noise, last.sweep) == (9, {"x": 0.01}, {})
    assert last.parameters == {"rate": {"training": (2.0, 3.0), "log": True}}
    assert last.tuners == swept.tuners
    assert last.tags == ("quick",)
    assert last.title.startswith("A spring (budget = 9, noise.x = 0.01, ")
    assert [expand_sweep(e) for e in expanded] == [[e] for e in expanded]


def test_experiments_of_a_sweep_meet_the_same_targets(spring):
    small, large = (
        draw_target(TuningProblem(e), "in", 1)
        for e in expand_sweep(spring_experiment(sweep={"noise.x": [1e-9, 1e-3]}))
    )
    alone = draw_target(TuningProblem(spring_experiment()), "in", 1)
    assert small.truth.tolist() == large.truth.tolist() == alone.truth.tolist()
    assert small.blinded.start.tolist() == large.blinded.start.tolist()
    apart = large.blinded.fitting.observed - small.blinded.fitting.observed
    assert 1e-4 < apart.std() < 1e-2


def test_a_sweep_names_entries_whose_names_have_dots():
    swept = spring_experiment(
        parameters={"drag.linear": {"nominal": 0.5}},
        sweep={"parameters.drag.linear.nominal": [0.1], "observe": [["x"], ["x", "v"]]},
    )
    first, second = expand_sweep(swept)
    assert first.parameters == {"drag.linear": {"nominal": 0.1}}
    assert second.observe == ("x", "v")
    assert second.name == "spring-test[parameters.drag.linear.nominal=0.1,observe=x_v]"


@pytest.mark.parametrize(
    ("sweep", "message"),
    [
        ({"budgte": [1]}, r"unknown entry of mine.toml 'budgte'; did you mean budget"),
        ({"budget": 3}, "mine.toml: sweep.budget: expected a list, found 3"),
        ({"budget": []}, "mine.toml: sweep.budget: expected at least one value"),
        ({"budget": [3, "x"]}, "mine.toml: budget: expected a whole number, found 'x'"),
        ({"budget": [3, 3]}, "mine.toml: sweep.budget: 3 is given twice"),
        ({"budget": [0]}, "mine.toml: .*budget must be at least 1"),
        ({"budget.x": [1]}, "mine.toml: sweep.budget.x: budget is not a table"),
        ({"sampling.rat": [1]}, r"unknown entry of \[sampling\] in mine.toml 'rat'"),
        (
            {"sampling": [{"rate": 1}]},
            "sweep.sampling: expected strings, numbers, booleans or lists",
        ),
    ],
)
def test_faults_in_a_sweep_are_one_line_that_names_the_file(sweep, message):
    with pytest.raises(InputError, match=message):
        spring_experiment(path="mine.toml", sweep=sweep)


def test_what_is_not_expanded_is_not_run(spring):
    with pytest.raises(
        InputError,
        match=r"spring-test: sweeps over budget; run the experiments "
        "that",
    ):
        TuningProblem(spring_experiment(sweep={"budget": [3]}))


def test_what_only_describes_enters_no_name_of_a_run_or_of_weights(spring):
    described = {"title": "Another", "says": "Words.", "tags": ["quick"]}
    plain, told = spring_experiment(), spring_experiment(**described)
    entry, target = plain.tuners[0], draw_target(TuningProblem(plain), "in", 0).blinded
    ids = [RunIds(e).make_run_id(entry, target, 0, 12) for e in (plain, told)]
    assert ids[0] == ids[1]
    regressor = TunerEntry("regressor", "regressor")
    assert compute_training_key(plain, regressor, 0) == compute_training_key(told, regressor, 0)


def test_every_shipped_experiment_has_tags():
    assert {tag for name in list_experiment_names() for tag in load_experiment(name).tags} == {
        "diagnosis", "misspecified", "other-engine", "published", "quick", "real", "robot",
        "several-parameters", "suite", "video",
    }  # fmt: skip
    assert all(load_experiment(name).tags for name in list_experiment_names())


RECORDED = SPRING | {"ranges": ["real"], "recording": {"path": "logs/swing.csv"}}


def test_a_recording_is_looked_for_in_its_folder_and_next_to_the_experiment(tmp_path, monkeypatch):
    monkeypatch.delenv("SIMGAP_DATA", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "xdg"))
    beside, data = tmp_path / "mine" / "logs", tmp_path / "data" / "logs"
    for folder in (beside, data):
        folder.mkdir(parents=True)
        (folder / "swing.csv").touch()
    file = tmp_path / "mine" / "mine.toml"
    document = {k: v for k, v in RECORDED.items() if k != "initial"}
    found = parse_experiment("mine", document, file).recording.path
    assert found == str(beside / "swing.csv")
    again = parse_experiment(
        "mine", {**document, "recording": {"path": found}}, tmp_path / "x" / "e.toml"
    )
    assert again.recording.path == found, "as from a folder of results"
    monkeypatch.setenv("SIMGAP_DATA", str(tmp_path / "data"))
    assert parse_experiment("mine", document, file).recording.path == "logs/swing.csv"
    assert find_recording("logs/swing.csv") == data / "swing.csv"
    monkeypatch.chdir(tmp_path / "mine")
    monkeypatch.setenv("SIMGAP_DATA", str(tmp_path / "nowhere"))
    assert find_recording("logs/swing.csv").samefile(beside / "swing.csv"), "as it stands"
    downloaded = tmp_path / "xdg" / "simgap" / "logs"
    downloaded.mkdir(parents=True)
    (downloaded / "swing.csv").touch()
    assert find_recording("logs/swing.csv") == downloaded / "swing.csv"
    monkeypatch.setenv("SIMGAP_DATA", str(tmp_path / "data"))
    assert find_recording("logs/swing.csv") == data / "swing.csv", "the one that is named wins"


def test_a_recording_that_is_missing_says_what_to_set(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SIMGAP_DATA", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    with pytest.raises(InputError, match=r"SIMGAP_DATA is not set.*; set SIMGAP_DATA to the folde"):
        find_recording("swing/recording.csv")
    monkeypatch.setenv("SIMGAP_DATA", "/elsewhere")
    with pytest.raises(InputError, match=r"no such file in /elsewhere \(SIMGAP_DATA\) or next to"):
        find_recording("swing/recording.csv")
