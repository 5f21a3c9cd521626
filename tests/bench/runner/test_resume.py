"""Tests of resuming: a comparison is not resumed if one of its inputs has changed."""

import json
from dataclasses import replace

import numpy as np
import pytest

import simgap
from bench.benchmark.comparison_study import Comparison
from bench.benchmark.problem.experiment_config import parse_experiment
from bench.benchmark.problem.experiment_recording import ObservedRuns
from bench.benchmark.problem.targets import draw_target
from bench.benchmark.problem.tuning_problem import TuningProblem
from bench.benchmark.runner.run_fingerprint import RunIds
from bench.benchmark.runner.study_base import prepare_study
from bench.benchmark.storage.result_folder import read_comparison
from bench.benchmark.storage.run_journal import (
    RunJournal,
    read_plan,
    read_statuses,
    write_plan,
)
from bench.core.plugin_registries import load_plugins
from sims.core.simulator import InputError
from tests.conftest import PLUGINS
from tests.sample_experiments import spring_experiment

EFFECT = """
from sims.effects.drag import LinearDrag

class Mine(LinearDrag):
    name = "drag.mine"
    number = 1
"""
RECORDING = "run,t,q\n" + "".join(
    f"{run},{0.05 * i:.2f},{0.5 - 0.01 * i * run}\n" for run in (1, 2) for i in range(20)
)

DESCRIPTION = """
system = "pendulum"
[channels.q]
unit = "rad"
noise = 0.01
[constants]
mass = 0.15
[runs.2]
held_out = true
"""

pytestmark = pytest.mark.usefixtures("fresh_registries")


class Interrupting(simgap.Tuner):
    """Tuner that raises KeyboardInterrupt once, before its first simulation, as Ctrl-C does."""

    name = "interrupting"
    source_digest = "interrupting"
    left = 1

    def tune(self, task, rng):
        if Interrupting.left:
            Interrupting.left -= 1
            raise KeyboardInterrupt
        yield task.start


def run_interrupted(experiment, plugins, folder):
    """Run a comparison whose first run is finished and whose second is interrupted."""
    Interrupting.left = 1
    made = Comparison.begin(prepare_study(experiment, plugins, folder, jobs=0)).run(jobs=0)
    assert made.interrupted
    assert len(read_statuses(folder)) == 1
    return folder


def refused(folder, what, words="its {} changed since it was started"):
    """Check that resuming is refused with one line and changes no file of the folder."""
    before = {p: p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
    with pytest.raises(InputError, match=words.format(what)) as caught:
        Comparison.resume(folder)
    assert "\n" not in str(caught.value)
    assert before == {p: p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def goes_on(folder):
    """Check that resuming executes the missing run only."""
    kept = read_statuses(folder)
    made = Comparison.resume(folder).run(jobs=0)
    assert made.is_complete
    statuses = read_comparison(folder, ["run", "tuner", "k"]).statuses
    assert statuses["status"].tolist() == ["done", "converged"]
    assert all(kept[0].seconds == s for s in statuses["seconds"][:1])


@pytest.mark.parametrize("name", ["hung.py", "mine.py"])
def test_a_changed_plugin_is_refused_and_the_same_one_goes_on(name, tmp_path):
    """This includes a plugin that holds neither simulator nor tuner and so enters no other hash."""
    from bench.core.plugin_registries import tuners

    tuners.register(Interrupting)
    simulator = (PLUGINS / "spring.py").read_text().replace('name = "spring"', 'name = "hung"')
    (tmp_path / "hung.py").write_text(simulator)
    (tmp_path / "mine.py").write_text(EFFECT)
    plugins = [str(tmp_path / "hung.py"), str(tmp_path / "mine.py")]
    load_plugins(plugins)
    experiment = spring_experiment(
        simulator="hung", targets=1, seeds=1, ranges=["in"], tuners=["random", "interrupting"]
    )
    folder = run_interrupted(experiment, plugins, tmp_path / "out")
    text = (tmp_path / name).read_text()
    (tmp_path / name).write_text(text + "\n# another word\n")
    refused(folder, "plugins")
    (tmp_path / name).write_text(text)
    goes_on(folder)


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("swing.csv", "1,0.30,0.44", "1,0.30,0.45"),
        ("swing.csv", "2,0.30,0.38", "2,0.30,0.39"),  # held out, only for scoring
        ("swing.toml", "mass = 0.15", "mass = 0.16"),
        ("swing.toml", "noise = 0.01", "noise = 0.02"),
        ("swing.toml", 'system = "pendulum"', '# words\nsystem = "pendulum"'),
    ],
)
def test_a_changed_recording_is_refused_and_the_same_one_goes_on(name, old, new, tmp_path):
    from bench.core.plugin_registries import tuners

    tuners.register(Interrupting)
    (tmp_path / "swing.csv").write_text(RECORDING)
    (tmp_path / "swing.toml").write_text(DESCRIPTION)
    document = {
        "simulator": "pendulum", "observe": ["q"], "ranges": ["real"], "targets": 1, "seeds": 1,
        "budget": 2, "settings": {"engine": "batch"}, "recording": {"path": "swing.csv"},
        "tuners": ["random", "interrupting"],
    }  # fmt: skip
    experiment = parse_experiment("swing", document, tmp_path / "swing-experiment.toml")
    folder = run_interrupted(experiment, [], tmp_path / "out")
    text = (tmp_path / name).read_text()
    assert text.count(old) == 1
    (tmp_path / name).write_text(text.replace(old, new))
    refused(folder, "recording")
    (tmp_path / name).write_text(text)
    goes_on(folder)


@pytest.fixture
def folder(tmp_path, spring):
    from bench.core.plugin_registries import tuners

    tuners.register(Interrupting)
    experiment = spring_experiment(
        targets=1, seeds=1, ranges=["in"], tuners=["random", "interrupting"]
    )
    return run_interrupted(experiment, [], tmp_path / "out")


@pytest.mark.parametrize(
    ("function", "what"),
    [("hash_source_folders", "code"), ("hash_package_versions", "package versions")],
)
def test_changed_code_and_other_packages_are_refused(folder, monkeypatch, function, what):
    monkeypatch.setattr(
        f"bench.benchmark.runner.run_fingerprint.{function}", lambda *_: "0123456789"
    )
    refused(folder, what)
    monkeypatch.undo()
    goes_on(folder)


def test_a_changed_class_is_refused_that_is_in_no_plugin_file(folder, monkeypatch):
    monkeypatch.setattr(Interrupting, "source_digest", "another")
    refused(folder, "simulator and tuners")


@pytest.mark.parametrize(
    ("old", "new"),
    [("budget = 12", "budget = 13"), ("targets = 1", "targets = 2"), ("20.0", "21.0")],
)
def test_a_changed_configuration_is_refused(folder, old, new):
    path = folder / "experiment.toml"
    text = path.read_text()
    assert text.count(old) == 1
    path.write_text(text.replace(old, new))
    refused(folder, "configuration")
    path.write_text(text)
    goes_on(folder)


def test_what_was_begun_without_a_hash_is_refused(folder):
    path = folder / "environment.json"
    environment = json.loads(path.read_text())
    for what in ("configuration", "recording", "plugins", "code", "package versions"):
        hashes = {k: v for k, v in environment["fingerprint"].items() if k != what}
        path.write_text(json.dumps({**environment, "fingerprint": hashes}))
        refused(folder, what)
    path.write_text(json.dumps({**environment, "fingerprint": {}}))
    refused(folder, "", "written by an older simgap, which cannot be resumed")


def test_another_plan_is_refused(folder):
    ids = read_plan(folder)
    write_plan(folder, [ids[0], ids[1] + "0"])
    refused(folder, "", "its plan is not the one that its configuration gives")
    write_plan(folder, ids)
    goes_on(folder)


def test_a_finished_run_of_another_plan_is_refused(folder):
    journal = RunJournal(folder)
    foreign = replace(journal.statuses[0], run="random/in-000/0/0123456789")
    journal.append(1, {"run": [foreign.run], "k": np.zeros(1, dtype=int)}, foreign)
    journal.close()
    words = r"runs.journal, run 1: run: expected interrupting/in-000/0/\w+ by plan.txt, found"
    refused(folder, "", words)


def test_a_run_is_called_by_all_that_its_target_has(spring):
    experiment = spring_experiment(held_out={"scenarios": 1})
    target = draw_target(TuningProblem(experiment), "in", 0).blinded
    (scenario,), observed = target.fitting

    def with_side(name, **changes):
        (scene,), seen = getattr(target, name)
        return replace(target, **{name: ObservedRuns((replace(scene, **changes),), seen)})

    changed = [
        target,
        replace(target, start=target.start + 1e-9),
        replace(target, fitting=ObservedRuns((scenario,), observed + 1e-9)),
        replace(
            target,
            held_out=ObservedRuns(target.held_out.scenarios, target.held_out.observed + 1e-9),
        ),
    ]
    for side in ("fitting", "held_out"):
        changed += [
            with_side(side, times=scenario.times * 2),
            with_side(side, initial={"x": 0.5}),
            with_side(side, inputs={"u": np.zeros(60)}),
            with_side(side, inputs={"u": np.ones(60)}),
            with_side(side, constants={"mass": 2.0}),
        ]
    ids = [RunIds(experiment).make_run_id(experiment.tuners[0], each, 0, 12) for each in changed]
    assert len(set(ids)) == len(changed)
    assert ids[0] == RunIds(experiment).make_run_id(experiment.tuners[0], target, 0, 12)
