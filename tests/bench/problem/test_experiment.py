from pathlib import Path

import pytest
import tomli_w

from bench.problem.experiment import load, names, parse
from bench.store.folder import _plain
from sims.base import InputError
from sims.recording.recording import tomllib
from tests.experiments import SPRING, spring_experiment


@pytest.mark.parametrize("name", names())
def test_document_of_every_shipped_experiment_gives_it_back(name):
    experiment = load(name)
    document = tomllib.loads(tomli_w.dumps(_plain(experiment.document())))
    assert parse(name, document, Path("x.toml")) == experiment
    assert experiment.says


def test_published_setting_of_ball_drop():
    experiment = load("ball-drop")
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
        ({"buget": 3}, r"unknown entry of .*'buget'; there are: .*budget"),
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
            "'option'; there are: budget, options, seeds, tuner",
        ),
        ({"simulator": ""}, "expected simulator"),
    ],
)
def test_faults_are_one_line_that_names_file_and_entry(change, message):
    with pytest.raises(InputError, match=message) as caught:
        parse("e", {**SPRING, **change}, Path("mine.toml"))
    assert "mine.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unknown_experiment_lists_those_there_are():
    with pytest.raises(
        InputError,
        match=r"unknown experiment 'ball'; there are: arm-drive, .*pendulum-real",
    ):
        load("ball")


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
