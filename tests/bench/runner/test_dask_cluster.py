"""Tests with a real Dask scheduler and two workers on the loopback interface."""

import os
import subprocess

import pandas as pd
import pytest

from bench.benchmark.storage.run_journal import read_statuses
from tests.bench.runner.test_comparison_study import CHAOS, SPRING_PLUGIN, same, simgap, write
from tests.command_output import run_command
from tests.finished_statuses import wait_for_runs
from tests.local_cluster import cluster
from tests.without_drawing import COMMAND

pytestmark = pytest.mark.slow
TUNERS = {"random": {}, "least_squares": {}, "regressor": {"seeds": 1}}


@pytest.fixture
def started(tmp_path):
    with cluster(tmp_path) as running:
        yield running


@pytest.mark.long
def test_cluster_gives_the_table_of_two_local_workers_and_a_lost_worker_costs_nothing(
    started, tmp_path
):
    experiment = write(tmp_path / "e.toml", tuners=TUNERS, targets=3, training_budget=60)
    common = ["compare", experiment, "--plugin", SPRING_PLUGIN]
    local = simgap(*common, "--jobs", 2, "--out", tmp_path / "local")
    assert local.returncode == 0, local.stderr
    folder = tmp_path / "far"
    # With a separate cache, the weights trained on the cluster must be returned and sent out again.
    environment = {**os.environ, "SIMGAP_CACHE": str(tmp_path / "cache")}
    command = [*COMMAND, *map(str, common), "--cluster", started.address]
    process = subprocess.Popen(
        [*command, "--out", str(folder)],
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    wait_for_runs(process, folder, 10)
    started.workers()[0].kill()
    _, errors = process.communicate(timeout=240)
    assert process.returncode == 0, errors
    assert set(pd.read_csv(folder / "status.csv")["status"]) <= {"done", "converged"}
    assert list((tmp_path / "cache").glob("regressor-*.npz"))
    same(folder, tmp_path / "local")


@pytest.mark.long
def test_runs_are_isolated_there_too_and_a_lost_scheduler_leaves_a_folder_to_resume(
    started, tmp_path
):
    tuners = {"random": {}, "chaos_exit": {"seeds": 1}, "chaos_raise": {"seeds": 1}}
    experiment = write(tmp_path / "e.toml", tuners=tuners, targets=300)
    folder = tmp_path / "out"
    common = ["--plugin", SPRING_PLUGIN, "--plugin", CHAOS]
    command = [
        *COMMAND,
        "compare",
        str(experiment),
        *common,
        "--cluster",
        started.address,
    ]
    process = subprocess.Popen(
        [*command, "--out", str(folder)], text=True, stdout=-1, stderr=subprocess.PIPE
    )
    wait_for_runs(process, folder, 12)
    started.scheduler.kill()
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 1
    assert f"simgap: cluster {started.address}: the scheduler cannot be reached" in errors
    assert f"simgap compare --resume {folder}" in errors
    assert "Traceback" not in errors, errors
    kept = read_statuses(folder)
    assert 12 <= len(kept) < 2400
    ends = {(s.tuner, s.status) for s in kept.values()}
    assert ends == {("random", "done"), ("chaos_exit", "crashed"), ("chaos_raise", "crashed")}
    assert {s.reason for s in kept.values() if s.tuner == "chaos_exit"} == {
        "the tuner's process exited with code 7"
    }


SHOT = """
simulator = "ball"
salt = "public"
observe = ["z"]
targets = 1
budget = 6
training_budget = 60
settings = { engine = "batch" }
constants = { gravity = 9.81, radius = 0.03 }
noise = { z = 0.01 }
initial = { z = [1.4, 1.8] }
sampling = { rate = 60.0, samples = 100 }
tuners = { least_squares = {}, regressor = {} }
shot = { balls = ["golf"] }
"""


@pytest.mark.long
def test_bounce_shot_on_a_cluster_is_the_one_of_two_local_workers(started, tmp_path):
    """Recordings and weights are sent to the workers, which do not use paths of this machine."""
    (tmp_path / "shot.toml").write_text(SHOT)
    tables = []
    for name, where in (("local", ["--jobs", 2]), ("far", ["--cluster", started.address])):
        environment = {**os.environ, "SIMGAP_CACHE": str(tmp_path / f"cache-{name}")}
        folder = tmp_path / name
        done = simgap("compare", tmp_path / "shot.toml", *where, "--out", folder, env=environment)
        assert done.returncode == 0, done.stderr
        tables.append(pd.read_csv(folder / "shots.csv").drop(columns="seconds"))
    pd.testing.assert_frame_equal(*tables, check_exact=True)
    assert len(tables[0]) == 2 + 2 * 2
    assert set(tables[0]["status"]) <= {"done", "converged"}


@pytest.mark.slow
def test_nobody_there_is_one_line(tmp_path):
    experiment = write(tmp_path / "e.toml")
    common = [
        "compare",
        str(experiment),
        "--plugin",
        SPRING_PLUGIN,
        "--out",
        str(tmp_path / "out"),
        "--cluster",
    ]
    for address in ("tcp://127.0.0.1:1", "nonsense://x", "127.0.0.1:notaport"):
        error = run_command(*common, address, code=2).err
        assert f"--cluster {address}: no Dask scheduler answers there" in error
        assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()
