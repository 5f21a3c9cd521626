"""Tests of interrupted comparisons: no run is lost, repeated or mixed with another."""

import json
import os
import signal
import subprocess
import sys

import pandas as pd
import pytest
import tomli_w

from bench.benchmark.storage.run_journal import read_statuses
from bench.cli.main import main
from sims.core.simulator import InputError
from tests.command_output import run_command
from tests.conftest import PLUGINS
from tests.finished_statuses import wait_for_runs
from tests.plugins.chaos import STATUSES
from tests.sample_experiments import SPRING
from tests.without_drawing import COMMAND

pytestmark = pytest.mark.usefixtures("undrawn")

SPRING_PLUGIN, CHAOS = str(PLUGINS / "spring.py"), str(PLUGINS / "chaos.py")
MEASURED = ["tuner_seconds", "simulator_seconds", "fit_seconds", "seconds"]


def write(path, **changes):
    path.write_text(tomli_w.dumps({**SPRING, **changes}))
    return path


def simgap(*arguments, **options):
    command = [*COMMAND, *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=300, check=False, **options
    )


def without_times(frame):
    return frame.drop(columns=[name for name in MEASURED if name in frame])


def same(a, b):
    for name in ("status.csv", "table.csv"):
        pd.testing.assert_frame_equal(
            *(without_times(pd.read_csv(folder / name)) for folder in (a, b))
        )
    pd.testing.assert_frame_equal(
        *(without_times(pd.read_parquet(folder / "runs.parquet")) for folder in (a, b))
    )


@pytest.fixture(scope="module")
def finished_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("undisturbed")
    experiment = write(folder / "e.toml", targets=6, tuners={"random": {}, "cma_es": {}})
    done = simgap("compare", experiment, "--plugin", SPRING_PLUGIN, "--out", folder / "out")
    assert done.returncode == 0, done.stderr
    return folder


def start_and_kill(folder, experiment, enough):
    """Start a comparison, kill it once `enough` runs are finished, and return its folder."""
    command = [
        *COMMAND,
        "compare",
        str(experiment),
        "--plugin",
        SPRING_PLUGIN,
    ]
    process = subprocess.Popen(
        [*command, "--out", str(folder)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    wait_for_runs(process, folder, enough)
    process.send_signal(signal.SIGKILL)
    process.wait()
    return folder


@pytest.mark.slow
def test_killed_without_warning_and_resumed_the_result_is_the_undisturbed_one(
    finished_folder, tmp_path
):
    folder = start_and_kill(tmp_path / "out", finished_folder / "e.toml", 5)
    before = read_statuses(folder)
    assert 5 <= len(before) < 48
    said = run_command("status", folder, code=1).out
    assert f"{len(before)} of 48 runs finished" in said
    assert f"--resume {folder}" in said
    done = simgap("compare", "--resume", folder, "--jobs", 1)
    assert done.returncode == 0, done.stderr
    assert f"0/{48 - len(before)}" in done.stderr, "only what is missing is made"
    same(folder, finished_folder / "out")
    kept = pd.read_csv(folder / "status.csv").set_index("run")["seconds"]
    assert all(kept[s.run] == s.seconds for s in before.values()), (
        "what was finished was not made again"
    )
    assert not (folder / "segments").exists()
    assert "48 of 48 runs finished, complete" in run_command("status", folder).out

    again = simgap("compare", "--resume", folder)  # no run is missing, so none is executed
    assert again.returncode == 0
    assert "running" not in again.stderr


@pytest.mark.slow
def test_an_option_and_a_missing_plugin_are_refused_at_resuming(finished_folder, tmp_path):
    folder = start_and_kill(tmp_path / "out", finished_folder / "e.toml", 2)
    error = run_command("compare", "--resume", folder, "--budget", "5", code=2).err
    assert "leave out budget" in error
    environment = json.loads((folder / "environment.json").read_text())
    environment["plugins"][0] += ".gone"
    (folder / "environment.json").write_text(json.dumps(environment))
    assert "no such file" in run_command("compare", "--resume", folder, code=2).err


def test_run_ids_change_with_everything_that_matters_and_nothing_else():
    from bench.benchmark.runner.experiment_runner import prepare_experiment
    from bench.core.plugin_registries import load_plugins
    from tests.sample_experiments import spring_experiment

    load_plugins([SPRING_PLUGIN])

    def ids(**changes):
        tuners = changes.pop("tuners", {"random": {}, "cma_es": {}})
        plan = prepare_experiment(spring_experiment(tuners=tuners, **changes)).plan
        return {job.request.run.rsplit("/", 1)[0]: job.request.run for job in plan}

    plain = ids()
    assert len(set(plain.values())) == len(plain) == 4 * 2 * 4
    assert all(len(run.split("/")) == 4 for run in plain.values())
    for change in (
        {"budget": 13}, {"timeout": 61}, {"memory": 99}, {"noise": {"x": 0.1}},
        {"initial": {"x": [0.8, 1.3]}}, {"sampling": {"rate": 20.0, "samples": 61}},
        {"parameters": {"rate": {"training": [2.0, 3.0]}}},
    ):  # fmt: skip
        assert not set(ids(**change).values()) & set(plain.values()), change
    options = ids(tuners={"random": {}, "cma_es": {"options": {"sigma": 0.2}}})
    assert {k for k in plain if plain[k] != options[k]} == {
        k for k in plain if k.startswith("cma_es")
    }
    assert ids(title="another", says="words") == plain
    assert plain.items() <= ids(targets=5).items()
    assert plain.items() <= ids(tuners={"random": {}, "nelder_mead": {}, "cma_es": {}}).items()


@pytest.mark.slow
def test_every_chaos_tuner_has_its_status_and_the_others_do_not_change_by_a_bit(
    finished_folder, tmp_path
):
    everyone = {"random": {}, **{name: {"seeds": 1} for name in STATUSES}, "cma_es": {}}
    experiment = write(tmp_path / "e.toml", targets=6, timeout=20, memory=400, tuners=everyone)
    plugins = ["--plugin", SPRING_PLUGIN, "--plugin", CHAOS]
    hang_shorter = {**os.environ, "PYTHONPATH": os.getcwd()}
    code = (
        "import sys, bench.benchmark.runner.worker_pools, bench.cli.main; "
        "bench.benchmark.runner.worker_pools.HARD_LIMIT_GRACE_SECONDS = -8.0\n"
        "if __name__ == '__main__':\n    sys.exit(bench.cli.main.main(sys.argv[1:]))\n"
    )
    (tmp_path / "go.py").write_text(code)
    names = ",".join(everyone)
    command = [
        sys.executable,
        tmp_path / "go.py",
        "compare",
        experiment,
        *plugins,
        "--targets",
        2,
        "--tuners",
        names,
    ]
    done = subprocess.run(
        [*map(str, command), "--out", str(tmp_path / "out")],
        capture_output=True, text=True, timeout=300, check=False, env=hang_shorter,
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    statuses = pd.read_csv(tmp_path / "out" / "status.csv", keep_default_na=False)
    found = statuses.groupby("tuner")["status"].agg(lambda s: "/".join(sorted(set(s)))).to_dict()
    assert {name: found[name] for name in STATUSES} == STATUSES
    reasons = statuses.groupby("tuner")["reason"].first()
    assert "MemoryError" in reasons["chaos_memory_hog"]
    assert "f_locals" in reasons["chaos_cheat"], "no frame that calls it knows the simulator"
    assert "read-only" in reasons["chaos_record_spoiler"]
    assert "SIGSEGV" in reasons["chaos_segfault"]
    assert statuses.groupby("tuner")["simulations"].max()[
        ["chaos_over_ask", "chaos_shout"]
    ].tolist() == [12, 12]
    assert "RuntimeError: boom (chaos.py, line " in done.stdout
    assert "xxxx" not in done.stdout
    columns = [
        c
        for c in pd.read_parquet(tmp_path / "out" / "runs.parquet")
        if c not in [*MEASURED, "experiment"]
    ]
    mine, theirs = (
        pd.read_parquet(f / "runs.parquet")[columns]
        for f in (tmp_path / "out", finished_folder / "out")
    )
    shared = (
        theirs[theirs["target"].str.contains("-00[01]")].drop(columns="run").reset_index(drop=True)
    )
    mine = mine[mine["tuner"].isin(["random", "cma_es"])].drop(columns="run").reset_index(drop=True)
    pd.testing.assert_frame_equal(mine, shared)
    table, theirs = (
        pd.read_csv(f / "table.csv") for f in (tmp_path / "out", finished_folder / "out")
    )
    failures = table.groupby("tuner")["failures"].max()
    assert failures["chaos_hang"] == 2
    assert failures["cma_es"] == 0


@pytest.mark.slow
def test_failed_runs_make_the_exit_code_1_unless_allowed(tmp_path):
    experiment = write(
        tmp_path / "e.toml", targets=1, tuners={"random": {}, "chaos_raise": {"seeds": 1}}
    )
    common = [
        "compare",
        str(experiment),
        "--plugin",
        SPRING_PLUGIN,
        "--plugin",
        CHAOS,
        "--jobs",
        "1",
        "--out",
    ]
    said = run_command(*common, tmp_path / "a", code=1).out
    assert (
        "failures\ntuner        runs  status   first reason\n"
        "chaos_raise     2  crashed  RuntimeError: boom (" in said
    )
    assert (
        "chaos_raise     2  crashed" in run_command(*common, tmp_path / "b", "--allow-failures").out
    )
    assert "failures" not in run_command(*common, tmp_path / "c", "--tuners", "random").out


def test_first_line_says_what_and_where():
    from bench.benchmark.isolation.process_errors import format_failure_reason

    chained = (
        "Traceback (most recent call last):\n"
        '  File "/a/b.py", line 3, in inner\n    x\nKeyError: 1\n\n'
        "During handling of the above exception, another exception occurred:\n\n"
        "Traceback (most recent call last):\n"
        '  File "/a/run.py", line 9, in outer\n    y\n'
        '  File "/a/mine.py", line 12, in tune\n    z\n'
        "my.package.OddError: first words\nsecond line\nthird line\n"
    )
    assert (
        format_failure_reason(chained)
        == "my.package.OddError: first words (mine.py, line 12, in tune)"
    )
    assert (
        format_failure_reason("the worker process exited with code 3")
        == "the worker process exited with code 3"
    )
    assert format_failure_reason("") == ""


def test_one_function_tells_which_study_an_experiment_or_a_folder_is(tmp_path, spring):
    from bench.benchmark.comparison_study import Comparison
    from bench.benchmark.problem.experiment_config import load_experiment
    from bench.bounce_shot.shot_study import BounceShotStudy
    from bench.studies.study_kinds import begin_studies, get_study_class, open_study
    from tests.sample_experiments import spring_experiment

    assert get_study_class(load_experiment("bounce-shot")) is BounceShotStudy
    assert get_study_class(load_experiment("ball-drop")) is Comparison
    (start_and_kill,) = begin_studies(spring_experiment(), [SPRING_PLUGIN], tmp_path / "out")
    start_and_kill.results.run_sink.close()
    there = open_study(tmp_path / "out")
    assert isinstance(there, Comparison)
    standing = there.status()
    assert (standing.finished, len(standing.ends), standing.is_complete) == (0, 16, False)
    with pytest.raises(InputError, match="this study is read-only; resume it"):
        there.run()


def test_without_workers_the_command_makes_all_in_its_own_process(tmp_path, capsys, spring):
    experiment = write(tmp_path / "e.toml", targets=1, tuners={"random": {}})
    out = tmp_path / "out"
    assert main(["compare", str(experiment), "--jobs", "0", "--out", str(out)]) == 0
    assert json.loads((out / "environment.json").read_text())["jobs"] == 0
    with pytest.raises(SystemExit):
        main(["compare", str(experiment), "--jobs", "-1", "--out", str(tmp_path / "no")])
    assert "expected a whole number of at least 0, found '-1'" in capsys.readouterr().err
