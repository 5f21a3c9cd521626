"""Files of the suites: problems, versions, entrants, and a whole suite in brief."""

import re
import shutil
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from bench.benchmark.problem.experiment_config import (
    compute_problem_hash,
    expand_sweep,
    load_experiment,
)
from bench.benchmark.problem.missing_requirements import leave_out_missing_problems
from bench.benchmark.problem.targets import draw_target
from bench.benchmark.problem.tuning_problem import TuningProblem
from bench.core.plugin_registries import tuners
from bench.studies.archive_bundle import write_bundle
from bench.studies.result_verification import verify_results
from bench.studies.study_kinds import begin_studies, report_jointly
from bench.suite import suite_runs
from bench.suite.suite_runs import read_suite_runs, write_suite_runs
from sims.core.simulator import InputError

FOLDER = Path(str(resources.files("bench.experiments")))
ENTRANTS = Path(str(resources.files("methods.suite_entrants")))


def test_problems_of_the_suite_are_described_and_of_this_version():
    problems = expand_sweep(load_experiment("suite"))
    assert len(problems) >= 14
    for problem in problems:
        assert len(problem.says) > 40
        assert len(problem.identifiable) > 20
        assert problem.suite == load_experiment("suite").suite
    small = {problem.name for problem in expand_sweep(load_experiment("suite-small"))}
    assert small < {problem.name for problem in problems}
    assert load_experiment("suite-small").suite == load_experiment("suite").suite
    assert load_experiment("suite-small").budget == load_experiment("suite").budget


def copy_suite(folder):
    """Copy the small suite and its problems, so that they can be changed."""
    shutil.copytree(FOLDER / "suite", folder / "suite")
    text = (FOLDER / "suite-small.toml").read_text()
    (folder / "mine.toml").write_text(text)
    return folder / "mine.toml"


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("pushed-slider.toml", "x = 0.001", "x = 0.002"),
        ("stiff-pendulum.toml", "q = 0.001", "q = 0.002"),
    ],
)
def test_a_changed_problem_is_refused(tmp_path, file, old, new):
    suite = copy_suite(tmp_path)
    assert len(expand_sweep(load_experiment(str(suite)))) == 7
    path = tmp_path / "suite" / file
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(InputError, match="a changed problem needs a new version"):
        expand_sweep(load_experiment(str(suite)))


def test_the_hash_of_a_problem_covers_its_model_and_its_recording(tmp_path):
    problem = tmp_path / "mine.toml"
    problem.write_text('model = "arm.xml"\n[recording]\npath = "log.csv"\n')
    hashes = set()
    for name in ("arm.xml", "log.csv", "log.toml"):
        (tmp_path / name).write_text("first")
    hashes.add(compute_problem_hash(problem, frozenset()))
    for name in ("arm.xml", "log.csv", "log.toml"):
        (tmp_path / name).write_text("second")
        hashes.add(compute_problem_hash(problem, frozenset()))
    assert len(hashes) == 4


@pytest.fixture
def without_data_sets(tmp_path, monkeypatch):
    for name in ("SIMGAP_DATA", "SIMGAP_ROBOTS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "nothing"))
    monkeypatch.chdir(tmp_path)


def test_problems_without_their_data_are_left_out_with_the_reason(without_data_sets):
    suite = load_experiment("suite")
    kept, reasons = leave_out_missing_problems(suite)
    assert set(reasons) == {"robot-so101", "measured-swing", "measured-servo"}
    assert "run `simgap download so101`" in reasons["robot-so101"]
    assert "run `simgap download pendulum_free_swing`" in reasons["measured-swing"]
    assert "set SIMGAP_DATA" in reasons["measured-servo"]
    assert len(kept.experiments) == len(suite.experiments) - 3
    small = load_experiment("suite-small")
    assert leave_out_missing_problems(small) == (small, {})


def test_a_suite_without_any_data_is_refused(without_data_sets):
    suite = load_experiment("suite")
    measured = tuple(file for file in suite.experiments if "measured-swing" in file)
    assert measured
    suite = suite.chosen(experiments=measured)
    with pytest.raises(InputError, match="no problem can run here: measured-swing needs"):
        leave_out_missing_problems(suite)


def test_words_of_a_problem_may_change(tmp_path):
    suite = copy_suite(tmp_path)
    path = tmp_path / "suite" / "pushed-slider.toml"
    path.write_text(re.sub(r"(?m)^says = .*$", 'says = "Other words."', path.read_text()))
    assert len(expand_sweep(load_experiment(str(suite)))) == 7


def test_quantised_observations():
    (problem,) = [p for p in expand_sweep(load_experiment("suite")) if "quantised" in p.name]
    tuning = TuningProblem(problem)
    observed = draw_target(tuning, "in", 0).blinded.fitting.observed
    steps = observed / 0.04
    assert np.abs(steps - np.round(steps)).max() < 1e-9
    assert len(np.unique(np.round(steps))) > 10


@pytest.mark.parametrize("path", sorted(ENTRANTS.glob("[a-z]*.py")), ids=lambda path: path.stem)
def test_an_entrant_is_a_short_plugin_with_its_source(path):
    lines = path.read_text().splitlines()
    assert len(lines) <= 40
    source = path.read_text().split('"""')[1]
    assert re.search(r"Sources: .*(\d{4}|https://)", source, re.DOTALL)
    names = re.findall(r'name: ClassVar\[str\] = "(\w+)"', path.read_text())
    assert len(names) == 1
    assert names[0] in tuners.names()
    assert names[0] in [entry.tuner for entry in load_experiment("suite").tuners]


MINE = """
import numpy as np
from methods.tuner import Tuner


class Mine(Tuner):
    def tune(self, task, rng):
        radius, best, lowest = 0.3, task.start, np.inf
        while True:
            evaluation = yield np.clip(best + radius * rng.standard_normal((1, task.dim)), 0, 1)
            if evaluation.losses[0] < lowest:
                best, lowest = evaluation.proposals[0], evaluation.losses[0]
            radius *= 0.97
"""


def run_suite(experiment, folder, plugins=()):
    for study in begin_studies(experiment, plugins, folder, jobs=0):
        study.run(jobs=0)
        study.report(lambda line: None)
    lines = []
    report_jointly(folder, lines.append)
    return "\n".join(lines)


@pytest.fixture
def small_suite(tmp_path):
    """Two problems of the small suite, with few targets."""
    suite = copy_suite(tmp_path)
    text = suite.read_text().replace("targets = 4", "targets = 2").replace("= 100", "= 12")
    kept = ("pushed-slider", "idle-parameter")
    lines = [
        line
        for line in text.splitlines()
        if not line.startswith('  "suite/') or any(name in line for name in kept)
    ]
    suite.write_text("\n".join(lines))
    return load_experiment(str(suite))


@pytest.mark.usefixtures("undrawn")
def test_a_method_of_ones_own_is_ranked_among_the_stored_ones(tmp_path, small_suite, monkeypatch):
    reference = tmp_path / "reference"
    monkeypatch.setattr(suite_runs, "REFERENCE_FOLDERS", (reference,))
    stored = small_suite.with_tuners(["random", "least_squares"]).chosen(trusted=True)
    printed = run_suite(stored, tmp_path / "stored")
    assert "Use " in printed
    (reference / "suite").mkdir(parents=True)
    write_suite_runs(read_suite_runs(tmp_path / "stored"), reference / "suite")

    plugin = tmp_path / "mine.py"
    plugin.write_text(MINE)
    from bench.benchmark.runner.plugin_inspection import load_plugins_for_experiment

    own = small_suite.with_tuners(["mine"]).chosen(trusted=True)
    load_plugins_for_experiment([str(plugin)], own)
    printed = run_suite(own, tmp_path / "own", [str(plugin)])
    assert "stored results of 2 other methods on the same targets are included" in printed
    # Printed as a table of mean ranks, one row per method.
    assert {"mine", "random", "least_squares"} <= {
        line.split()[0] for line in printed.splitlines() if line.strip()
    }
    page = (tmp_path / "own" / "report.html").read_text()
    assert 'title="mine on pushed-slider' in page
    # The version is in every result.
    for cell in ("pushed-slider", "idle-parameter"):
        text = (tmp_path / "own" / cell / "experiment.toml").read_text()
        assert 'suite = "suite 1"' in text
    assert set(read_suite_runs(tmp_path / "own").cells["suite"]) == {"suite 1"}
    bundle = write_bundle(tmp_path / "own", tmp_path / "own.zip")
    assert bundle.command == "simgap compare suite --plugin own/plugins/mine.py --tuners mine"
    assert verify_results(bundle.archive, lambda line: None, [str(plugin)]).is_consistent


@pytest.mark.usefixtures("undrawn")
def test_a_cell_comes_out_again_with_its_salt(tmp_path, small_suite, monkeypatch):
    monkeypatch.setattr(suite_runs, "REFERENCE_FOLDERS", ())
    for number in range(2):
        chosen = small_suite.with_tuners(["random", "cma_es"]).chosen(trusted=True, salt="again")
        run_suite(chosen, tmp_path / str(number))
    first, second = (read_suite_runs(tmp_path / str(number)) for number in range(2))
    assert np.array_equal(first.errors, second.errors, equal_nan=True)
    assert len(first.runs) == 2 * 3 * 2


@pytest.mark.parametrize("name", ["diagnosis-small", "diagnosis-full", "diagnosis-machines"])
def test_questions_for_diagnosers_have_a_version(name, tmp_path):
    assert load_experiment(name).suite == "diagnosers 1"
    text = (FOLDER / f"{name}.toml").read_text()
    path = tmp_path / "board.toml"
    path.write_text(text.replace('title = "', 'title = "My '))
    assert load_experiment(str(path)).diagnosis == load_experiment(name).diagnosis
    path.write_text(re.sub(r"(?m)^seed = \d+", "seed = 7", text))
    with pytest.raises(InputError, match="problem questions has the hash"):
        load_experiment(str(path))
