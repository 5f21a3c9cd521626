"""Tests of runs without worker processes: equal tables, and tuners that can be observed."""

import os
import sys

import pandas as pd
import pytest

from bench.benchmark.comparison_study import Comparison
from bench.benchmark.runner.experiment_runner import prepare_experiment, run_experiment
from bench.benchmark.runner.plugin_inspection import load_plugins_for_experiment
from bench.benchmark.runner.study_base import prepare_study
from bench.benchmark.runner.worker_pools import InProcessPool, WorkerDiedError, make_pool
from bench.benchmark.storage.result_folder import read_comparison
from bench.core.plugin_registries import load_plugins, tuners
from methods.tuner import Tuner
from sims.core.simulator import InputError
from tests.conftest import PLUGINS
from tests.notebook_cells import define_in_cell
from tests.sample_experiments import spring_experiment

PLUGIN_FILES = [str(PLUGINS / "spring.py"), str(PLUGINS / "awkward.py")]
EVERYONE = {
    "random": {},
    "cma_es": {},
    "least_squares": {},
    "regressor": {"seeds": 1},
    "crashing": {},
    "nan_proposing": {},
    "over_asking": {},
    "stopping": {"seeds": 1},
}
CELL = """
import sys
from methods.tuner import Tuner

class Mine(Tuner):
    name = "mine"

    def tune(self, task, rng):
        print("looked at", task.budget)
        yield task.start
        {then}
"""

pytestmark = pytest.mark.usefixtures("fresh_registries")


@pytest.fixture(autouse=True)
def plugins():
    load_plugins(PLUGIN_FILES[:1])


def in_a_cell(monkeypatch, then):
    """Register a tuner that is defined as in a notebook cell."""
    return tuners.register(define_in_cell(monkeypatch, CELL.format(then=then)))


def small(**changes):
    once = {"targets": 1, "seeds": 1, "ranges": ["in"], "trusted": True}
    return spring_experiment(**{**once, **changes})


def here(experiment):
    results = prepare_experiment(experiment)
    run_experiment(results, jobs=0)
    return results


@pytest.mark.slow
def test_table_is_the_same_without_workers_and_with_one_or_two(tmp_path, monkeypatch):
    experiment = spring_experiment(tuners=EVERYONE, targets=2, training_budget=60)
    tables = []
    for jobs in (1, 2, 0):
        # Each run trains anew, because weights cached by the first would hide a difference.
        monkeypatch.setenv("SIMGAP_CACHE", str(tmp_path / f"cache{jobs}"))
        folder = tmp_path / str(jobs)
        load_plugins_for_experiment(PLUGIN_FILES, experiment.chosen(trusted=not jobs))
        assert (
            Comparison.begin(prepare_study(experiment, PLUGIN_FILES, folder, jobs))
            .run(jobs)
            .is_complete
        )
        tables.append(read_comparison(folder))
    assert [table.experiment.trusted for table in tables] == [False, False, True]
    # An isolated tuner gives bitwise the same results as a tuner in this process.
    unlike = ["run", "trusted", "tuner_seconds", "simulator_seconds", "seconds", "reason"]
    for other in tables[1:]:
        for frames in ((tables[0].runs, other.runs), (tables[0].statuses, other.statuses)):
            pd.testing.assert_frame_equal(
                *(frame.drop(columns=unlike, errors="ignore") for frame in frames), check_exact=True
            )


def test_prints_show_and_the_tuner_is_in_this_process(monkeypatch, capsys):
    in_a_cell(monkeypatch, "return str(__import__('os').getpid())")
    results = here(small(tuners={"mine": {}}))
    (status,) = results.run_sink.statuses.values()
    assert (status.status, status.reason) == ("converged", str(os.getpid()))
    assert capsys.readouterr().out == "looked at 12\n"


def test_a_crash_is_a_status_with_the_cells_own_line_and_said_when_it_happens(monkeypatch, capsys):
    in_a_cell(monkeypatch, "raise ValueError('oh')  # here")
    (status,) = here(small(tuners={"mine": {}})).run_sink.statuses.values()
    assert status.status == "crashed"
    assert status.simulations == 1
    for text in (status.reason, capsys.readouterr().err):
        assert "raise ValueError('oh')  # here" in text
        assert text.strip().endswith("ValueError: oh")


def test_soft_time_limit_holds(monkeypatch):
    in_a_cell(monkeypatch, "while True: yield task.start")
    (status,) = here(
        small(tuners={"mine": {}}, budget=10**6, timeout=0.2)
    ).run_sink.statuses.values()
    assert status.status == "timeout"
    assert 1 <= status.simulations < 10**6


def test_interrupt_ends_it_and_what_was_finished_is_kept(tmp_path, monkeypatch):
    in_a_cell(monkeypatch, "raise KeyboardInterrupt")
    experiment = small(tuners={"random": {}, "mine": {}, "cma_es": {}})
    made = Comparison.begin(prepare_study(experiment, PLUGIN_FILES, tmp_path / "out", jobs=0)).run(
        jobs=0
    )
    assert (made.finished, made.planned, made.interrupted) == (1, 3, True)
    in_a_cell(monkeypatch, "raise KeyboardInterrupt")
    standing = Comparison(tmp_path / "out").status()
    assert [(end.group, end.status) for end in standing.ends] == [
        ("random", "done"), ("mine", "missing"), ("cma_es", "missing"),
    ]  # fmt: skip


def test_exit_and_exceptions_outside_the_loop_are_results_of_their_call(capsys):
    def leave():
        sys.exit(3)

    def fail():
        raise KeyError("lost")

    with InProcessPool() as pool:
        results = dict(pool.iterate_results([(leave, ()), (fail, ()), (int, ("7",))], 1.0))
    assert isinstance(results[0], WorkerDiedError)
    assert "exit with 3" in str(results[0])
    assert isinstance(results[1], KeyError)
    assert results[2] == 7
    assert "KeyError: 'lost'" in capsys.readouterr().err


def test_class_of_a_notebook_is_refused_for_workers_before_anything_is_written(
    tmp_path, monkeypatch
):
    in_a_cell(monkeypatch, "return ''")
    experiment = small(tuners={"mine": {}})
    with pytest.raises(InputError, match="tuner mine: class Mine is defined in") as e:
        Comparison.begin(prepare_study(experiment, PLUGIN_FILES, tmp_path / "out", jobs=2))
    assert "jobs=0" in str(e.value)
    assert "\n" not in str(e.value)
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="which worker processes do not import"):
        run_experiment(prepare_experiment(experiment), PLUGIN_FILES, jobs=1)


def test_simulator_of_a_notebook_is_refused_too_and_a_redefined_one_is_not_cached(monkeypatch):
    from bench.core.plugin_registries import simulators

    spring = simulators.get("spring")

    def defined(times):
        text = (
            "class Mine(spring):\n    name = 'mine'\n\n    def simulate(self, theta, scenario):\n"
            f"        return {times} * super().simulate(theta, scenario)\n"
        )
        simulators.register(define_in_cell(monkeypatch, text, "<sim>", spring=spring))

    class Same(Tuner):
        name = "same"
        source_digest = "same"

        def tune(self, task, rng):
            seen = yield task.start
            return str(seen.observations[0, 0, 0] / task.observed[0, 0])

    tuners.register(Same)
    reasons = []
    for times in (1, 3):
        defined(times)
        results = here(small(simulator="mine", tuners={"same": {}}))
        reasons += [status.reason for status in results.run_sink.statuses.values()]
    assert reasons[0] == reasons[1], "targets and tuner meet the same simulator, the new one"
    with pytest.raises(InputError, match="simulator mine: class Mine is defined in"):
        run_experiment(results, PLUGIN_FILES, jobs=1)


def test_jobs_below_zero_are_refused():
    with pytest.raises(InputError, match="jobs: expected a number of worker processes from 0"):
        make_pool(-1)
