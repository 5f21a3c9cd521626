"""Tests of wrong arguments of public functions: one line names argument, expectation and value."""

import inspect
from pathlib import Path

import numpy as np
import pytest

import simgap
from simgap import InputError

FUNCTIONS = [
    simgap.compare,
    simgap.sweep,
    simgap.explain,
    simgap.score,
    simgap.design,
    simgap.datasheet,
    simgap.simulate,
    simgap.read_recording,
    simgap.import_logs,
    simgap.ComparisonResult,
]
NEEDED = {
    simgap.sweep: {"experiment": "nope"},
    simgap.explain: {"recording": "nope.csv"},
    simgap.design: {"recording": "nope.csv"},
    simgap.datasheet: {"recording": "nope.csv"},
    simgap.score: {"model": "nope.toml", "recording": "nope.csv"},
    simgap.read_recording: {"path": "nope.csv"},
    simgap.import_logs: {"logs": "nope.csv", "model": "nope.xml", "out": "nope.toml"},
}


class Odd:
    """Object that is not valid as any argument."""


CASES = [
    pytest.param(function, name, id=f"{function.__name__}-{name}")
    for function in FUNCTIONS
    for name in inspect.signature(function).parameters
]


@pytest.mark.parametrize(("function", "name"), CASES)
def test_an_object_that_an_argument_cannot_be_is_refused_by_name(function, name):
    with pytest.raises(InputError) as error:
        function(**{**NEEDED.get(function, {}), name: Odd()})
    message = str(error.value)
    assert message.startswith(f"{name}: expected "), message
    assert message.endswith("found a Odd"), message
    assert "Any" not in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: simgap.compare("ball-drop", budget="ten"),
            "budget: expected a whole number of at least 1, found 'ten'",
        ),
        (
            lambda: simgap.compare("ball-drop", budget=0),
            "budget: expected a whole number of at least 1, found 0",
        ),
        (
            lambda: simgap.compare("ball-drop", jobs=1.5),
            "jobs: expected a whole number of at least 0, found 1.5",
        ),
        (lambda: simgap.compare("ball-drop", trust="no"), "trust: expected True or False"),
        (lambda: simgap.compare("ball-drop", tuners="randm"), "did you mean random?"),
        (
            lambda: simgap.compare("ball-drop", tuners=["random", 3]),
            "tuners[1]: expected a name or a subclass of Tuner, found 3",
        ),
        (lambda: simgap.compare("ball-drop", tuners=dict), "found the class dict"),
        (
            lambda: simgap.compare("ball-drop", tuner="random"),
            "unknown argument of compare 'tuner'; did you mean tuners",
        ),
        (
            lambda: simgap.compare("ball-drop", ["random"]),
            "compare: expected at most 1 argument without a name, found 2",
        ),
        (lambda: simgap.compare(), "compare: expected an experiment, as simgap.compare('ball-dro"),
        (lambda: simgap.explain(), "explain: expected recording, the path of NAME.csv, a Record"),
        (
            lambda: simgap.explain(None),
            "recording: expected the path of NAME.csv, a Recording (of read_recording), a Simul",
        ),
        (lambda: simgap.explain([]), "found an empty list"),
        (lambda: simgap.explain(["a.csv", None]), "recording[1]: expected the path of NAME.csv"),
        (lambda: simgap.explain("a.csv", budget=0), "budget: expected a number of seconds above 0"),
        (lambda: simgap.explain("a.csv", jobs=0), "jobs: expected a whole number of at least 1"),
        (
            lambda: simgap.explain("a.csv", units={"q": "rad"}),
            "units: expected only with a DataFrame; a.csv has a description",
        ),
        (
            lambda: simgap.simulate("pendulum", effects="1e-4"),
            "effects: expected coefficients by the names of effects, as {'drag.linear': 2e-4}, "
            "found '1e-4'",
        ),
        (
            lambda: simgap.simulate("pendulum", effects={"drag.linear": "1e-4"}),
            "effects['drag.linear']: expected a number or",
        ),
        (lambda: simgap.simulate("Pendulum"), "did you mean pendulum?"),
        (lambda: simgap.simulate("pendulum", seed=1.5), "seed: expected a whole number, found 1.5"),
        (
            lambda: simgap.simulate("pendulum", runs=1, seconds=0.1).write(None),
            "path: expected a path, found None",
        ),
        (lambda: simgap.load_plugins(3), "plugins: expected a path or a list of paths, found 3"),
        (lambda: simgap.load_plugins("nope.py"), "nope.py: no such file"),
        (lambda: simgap.tuners.get(3), "unknown tuner '3'"),
    ],
)
def test_a_wrong_argument_is_named(call, message):
    with pytest.raises(InputError) as error:
        call()
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_names_and_numbers_may_be_given_as_people_write_them(tmp_path):
    """Names may be separated by commas, and numbers may be NumPy scalars or floats such as 3.0."""
    run = simgap.compare(
        "ball-drop",
        tuners="random, least_squares",
        targets=np.int64(1),
        seeds=1.0,
        budget=0.3e1,
        jobs=0,
        salt="public",
        out=tmp_path / "out",
    )
    assert [entry.label for entry in run.experiment.tuners] == ["random", "least_squares"]
    assert run.experiment.targets == 1
    assert run.experiment.budget == 3
    assert isinstance(run.experiment.budget, int)


@pytest.mark.parametrize("read", [simgap.explain, simgap.read_recording, simgap.design])
def test_the_file_that_was_named_is_the_one_that_is_missing(read, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("noise.csv").write_text("t,q\n")
    with pytest.raises(InputError) as error:
        read("nope.csv")
    assert str(error.value) == (
        "nope.csv: no such file; expected a recording, NAME.csv with NAME.toml next to it; "
        "did you mean noise.csv?"
    )
    with pytest.raises(InputError, match=r"^noise.toml: no such file; expected the description of"):
        read("noise.csv")
    with pytest.raises(InputError, match=r"^no/nope.csv: no such file; .* there is no folder 'no'"):
        read("no/nope.csv")
    with pytest.raises(InputError, match="not a path"):
        read("x" * 5000)
