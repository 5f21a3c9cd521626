"""Tests of --json: each command prints one document that conforms to its published schema."""

import copy
import json
import subprocess

import pytest
import tomli_w

from bench.cli.main import COMMANDS, main
from bench.schemas import find_violations, list_schema_names, load_schema
from tests.command_output import run_command
from tests.conftest import PLUGINS
from tests.sample_experiments import SPRING
from tests.without_drawing import COMMAND, undrawn

PLUGIN = ["--plugin", str(PLUGINS / "spring.py")]
ARM = """<mujoco><worldbody><body name="arm"><joint name="hinge" type="hinge" axis="0 1 0"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="0.5"/></body></worldbody>
<actuator><motor name="motor" joint="hinge"/></actuator></mujoco>
"""


def answered(*arguments, code=0):
    """Return the document that a command prints, and check that it is the only output."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", "80")
        return json.loads(run_command(*arguments, "--json", code=code).out)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Folder with a small experiment and a robot model, to which other fixtures add results."""
    folder = tmp_path_factory.mktemp("json")
    document = {
        **SPRING, "targets": 2, "seeds": 1, "budget": 4, "tuners": ["random", "least_squares"]
    }  # fmt: skip
    (folder / "spring-small.toml").write_text(tomli_w.dumps(document))
    (folder / "arm.xml").write_text(ARM)
    return folder


@pytest.fixture(scope="module")
def compared(place):
    """Document printed by `simgap compare`."""
    command = ["compare", place / "spring-small.toml", *PLUGIN, "--jobs", 0, "--out", place / "run"]
    with undrawn():
        return answered(*command)


@pytest.fixture(scope="module")
def run(place, compared):
    """Folder of the comparison."""
    return place / "run"


@pytest.fixture(scope="module")
def log(place):
    """Recording of a pendulum with a hidden drag."""
    path = place / "swing.csv"
    command = ["simulate", "pendulum", "--effect", "drag.linear=4e-4", "--noise", "q=0.01"]
    command += ["qd=0.05", "--runs", "3", "--seconds", "3", "--rate", "50", "--out", path]
    run_command(*command)
    return path


@pytest.fixture(scope="module")
def explanation(place, log):
    """Document printed by `simgap explain` for the recording."""
    return answered("explain", log, "--jobs", 1, "--out", place / "explained")


@pytest.fixture(scope="module")
def explained(place, explanation):
    """Folder of the explanation."""
    return place / "explained"


CASES = {}
"""For each command, the generator that runs it and yields its documents."""


def case(function):
    CASES[function.__name__.removesuffix("_")] = function
    return function


@case
def compare(ask, compared, **_):
    (one,) = compared["comparisons"]
    assert (one["name"], one["complete"], one["failed"]) == ("spring-small", True, 0)
    assert {row["simulations"] for row in one["results"]} == {4}
    assert {row["tuner"] for row in one["results"]} == {"random", "least_squares"}
    yield compared


@case
def status(ask, run, **_):
    found = ask("status", run)
    groups = found["studies"][0]["groups"]
    assert {name: sum(ends.values()) for name, ends in groups.items()} == {
        "random": 4, "least_squares": 4
    }  # fmt: skip
    yield found
    every = ask("status", run, "--runs")
    assert len(every["studies"][0]["runs"]) == 8
    yield every
    yield ask("status")


@case
def verify(ask, place, run, explained, **_):
    found = ask("verify", run, *PLUGIN)
    assert found["follows"]
    assert found["comparisons"][0]["doubts"] == []
    yield found
    yield ask("verify", explained)
    ask("bundle", run, "--out", place / "run.zip")
    found = ask("verify", place / "run.zip", *PLUGIN)
    assert found["archive"]["kind"] == "comparison"
    yield found


@case
def bundle(ask, place, explained, log, **_):
    found = ask("bundle", explained, "--with", log, "--out", place / "explained.zip")
    assert found["kind"] == "explanation"
    yield found


@case
def diff(ask, run, explained, **_):
    yield ask("diff", run, run)
    yield ask("diff", explained, explained)


@case
def plot(ask, place, run, **_):
    yield ask("plot", run, *PLUGIN)
    found = ask("plot", run, run, *PLUGIN, "--out", place / "across")
    assert found["mean_ranks"].keys() == {"random", "least_squares"}
    yield found


@case
def check(ask, **_):
    found = ask("check", "force.bias")
    assert found["passed"]
    assert {each["outcome"] for each in found["checks"]} <= {"passed", "not applicable"}
    yield found


@case
def simulate(ask, place, **_):
    found = ask("simulate", "ball", "--runs", 2, "--seconds", 1, "--out", place / "ball.csv")
    assert found["channels"]
    yield found


@case
def inspect(ask, place, log, **_):
    found = ask("inspect", log, "--out", place / "drawn", "--check")
    assert [run["samples"] for run in found["runs"]] == [150, 150, 150]
    assert found["signals"][0]["estimated"] == pytest.approx(0.01, rel=0.2)
    assert {number["name"] for number in found["check"]} >= {"inertia"}
    yield found


@case
def explain(ask, place, log, explanation, **_):
    assert explanation["verdict"]["verdict"] == "named"
    assert explanation["verdict"]["causes"][0]["effect"] == "drag.linear"
    yield explanation
    each = ask("explain", log, "--each", "--jobs", 1, "--out", place / "each")
    assert each["logs"][0]["causes"] == explanation["verdict"]["causes"]
    yield each


@case
def score(ask, explained, log, **_):
    found = ask("score", explained / "extended.toml", log)
    assert found["normalised_rmse"] == pytest.approx(1.0, abs=0.2)
    yield found


@case
def design(ask, place, log, **_):
    yield ask("design", log, "--jobs", 1, "--seconds", 2, "--out", place / "next.csv")


@case
def datasheet(ask, place, log, explained, **_):
    yield ask("datasheet", log, "--from", explained, "--out", place / "sheet")


@case
def train(ask, place, **_):
    yield ask("train", "regressor", "ball", "--budget", 40, "--seeds", 1, "--experiment",
              "ball-drop", "--trust", "--out", place / "train")  # fmt: skip


@case
def import_(ask, place, **_):
    rows = "\n".join(f"{i / 100},{0.01 * i},{0.0}" for i in range(100))
    (place / "log.csv").write_text(f"t,q.hinge,u.motor\n{rows}\n")
    found = ask("import", place / "log.csv", "--model", place / "arm.xml", "--out",
                place / "log.toml")  # fmt: skip
    assert found["guesses"]
    yield found


@case
def film(ask, place, **_):
    pytest.importorskip("av")
    table = "run,t,z\n" + "".join(f"1,{i / 50},{1.5 - 4.9 * (i / 50) ** 2}\n" for i in range(25))
    (place / "drop.csv").write_text(table)
    (place / "drop.toml").write_text('system = "ball"\n[channels.z]\nunit = "m"\n')
    found = ask("film", place / "drop.csv", "--out", place / "drop.mp4")
    assert found["frames"] == 25
    yield found


@case
def track(ask, place, **_):
    pytest.importorskip("cv2")
    if not (place / "drop.mp4").exists():
        list(film(ask, place))
    found = ask("track", place / "drop.mp4", "--out", place / "tracked.csv")
    assert found["frames_with_ball"] <= found["frames"]
    yield found


@case
def list_(ask, place, **_):
    whole = ask("list")
    assert {each["name"] for each in whole["commands"]} == {name for name, *_ in COMMANDS}
    budget = next(
        option
        for command in whole["commands"] if command["name"] == "compare"
        for option in command["options"] if option["name"] == "budget"
    )  # fmt: skip
    assert (budget["type"], budget["flags"]) == ("whole number", ["--budget"])
    (drag,) = [each for each in whole["effects"] if each["name"] == "drag.linear"]
    assert (drag["hook"], drag["places"]) == ("force", "joint")
    assert {"kind": "rotary", "unit": "N*m*s/rad"}.items() <= drag["coefficients"][0]["on"][
        2
    ].items()
    yield whole
    yield ask("list", "effects")
    found = ask("list", "places", "--model", place / "arm.xml")
    assert [joint["name"] for joint in found["places"]["joints"]] == ["hinge"]
    yield found


@case
def download(ask, place, **_):
    yield ask("download")
    for name in ("so101.urdf", "LICENSE"):
        (place / "so101").mkdir(exist_ok=True)
        (place / "so101" / name).write_text("")
    found = ask("download", "so101", "--out", place)
    assert found["downloaded"] == []
    assert found["data_sets"][0]["folder"] == str(place / "so101")
    yield found


@case
def schema_(ask, **_):
    found = ask("schema", "status")
    assert found == load_schema("status")
    yield found


@case
def info(ask, **_):
    found = ask("info")
    assert [engine["name"] for engine in found["engines"]] == ["batch", "pybullet", "mujoco"]
    assert found["engines"][2]["missing"] is None
    yield found


@case
def completion(ask, **_):
    yield ask("completion", "fish")


def test_every_command_has_a_case_and_a_schema():
    there = {name for name, *_ in COMMANDS}
    assert set(CASES) == there
    assert there <= set(list_schema_names())


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_what_a_command_prints_is_of_the_form_that_its_schema_publishes(name, request):
    code = CASES[name].__code__
    wanted = code.co_varnames[: code.co_argcount]
    given = {each: request.getfixturevalue(each) for each in wanted if each != "ask"}
    documents = list(CASES[name](ask=answered, **given))
    assert documents
    for document in documents:
        assert find_violations(document, name) == []
        # A document is rejected if a key is removed or an unknown key is added.
        if "required" in load_schema(name) or "anyOf" in load_schema(name):
            for key in document:
                assert find_violations({k: v for k, v in document.items() if k != key}, name) or (
                    name in ("list", "schema")
                )
            assert find_violations({**document, "unheard": 1}, name) or name == "schema"


def test_schemas_are_sound_and_refuse_what_is_damaged_deep_inside(run):
    from jsonschema import Draft202012Validator

    for name in list_schema_names():
        Draft202012Validator.check_schema(load_schema(name))
    found = answered("status", run)
    for change in (
        lambda d: d["studies"][0]["seal"].pop("missing"),
        lambda d: d["studies"][0].update(finished=-1),
        lambda d: d["studies"][0]["groups"]["random"].update(done="four"),
    ):
        damaged = copy.deepcopy(found)
        change(damaged)
        assert find_violations(damaged, "status")


@pytest.mark.parametrize(
    ("arguments", "kind", "message"),
    [
        (["status", "nowhere"], "input", "expected the folder of a comparison"),
        (["status", "--runz"], "usage", "unknown option '--runz'; did you mean --runs"),
        (["score"], "usage", "required: MODEL"),
        (["nothing"], "usage", "unknown command 'nothing'"),
        (["schema", "verdikt"], "input", "verdict"),
        (["list"], None, ""),
    ],
)
def test_a_fault_has_one_form_and_exit_code_2(arguments, kind, message):
    found = answered(*arguments, code=2 if kind else 0)
    if kind is None:
        assert "error" not in found
        return
    assert find_violations(found, "error") == []
    assert (found["error"]["kind"], found["error"]["code"]) == (kind, 2)
    assert message in found["error"]["message"]


def test_an_internal_fault_is_a_document_too_and_keeps_its_traceback(capsys, monkeypatch):
    def fail():
        raise RuntimeError("none of yours")

    monkeypatch.setattr("bench.cli.commands.info.collect_info", fail)
    with pytest.raises(RuntimeError):
        main(["info", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert find_violations(found, "error") == []
    assert found["error"] == {
        "kind": "internal", "message": "RuntimeError: none of yours", "code": 1
    }  # fmt: skip


PRINTING_TUNER = """import ctypes
import os
from methods.tuner import Tuner

class Verbose(Tuner):
    def tune(self, task, rng):
        print("from Python")
        os.write(1, b"from a system call\\n")
        ctypes.CDLL(None).puts(b"from C, and kept there")
        yield rng.uniform(size=(1, task.dim))
        raise ValueError("enough")
"""


@pytest.mark.slow
def test_what_a_tuner_prints_does_not_come_to_stand_in_the_document(place):
    (place / "verbose.py").write_text(PRINTING_TUNER)
    command = ["compare", place / "spring-small.toml", *PLUGIN, "--plugin", place / "verbose.py"]
    command += ["--tuners", "verbose", "--jobs", "0", "--out", place / "verbose", "--json"]
    done = subprocess.run(
        [*COMMAND, *map(str, command)], capture_output=True, text=True, timeout=120, check=False
    )
    found = json.loads(done.stdout)
    assert find_violations(found, "compare") == []
    # A crashed run is a result, and the exit code reports it.
    assert (done.returncode, found["comparisons"][0]["failed"]) == (1, 4)
    for said in ("from Python", "from a system call", "from C, and kept there"):
        assert said in done.stderr
