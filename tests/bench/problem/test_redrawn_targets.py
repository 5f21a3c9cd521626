"""Tests of diverging simulations: targets are redrawn and runs are reported."""

import json
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest

from bench.benchmark.problem.targets import count_redraws, draw_target, draw_targets
from bench.benchmark.problem.tuning_problem import TuningProblem
from sims.core.simulator import Channel, InputError, Parameter, Simulator
from tests.command_output import run_command
from tests.sample_experiments import spring_experiment

PLUGIN = '''
import numpy as np
import simgap


class Exploding(simgap.Simulator):
    """An explicit Euler step, unstable from a rate of 2 / dt = 20 on."""

    name = "exploding"
    parameters = (simgap.Parameter("rate", "1/s", 1.0, (0.1, {high}), training=(0.1, {high})),)
    channels = (simgap.Channel("x", "m"),)

    def simulate(self, theta, scenario):
        x, rows = np.full(len(theta), 1.0), []
        for _ in scenario.times:
            rows.append(x)
            x = x - 0.1 * theta[:, 0] * x * (1 + x**2)
        return np.stack(rows, axis=1)[:, :, None]
'''
EXPERIMENT = """
simulator = "exploding"
ranges = ["in"]
targets = 6
budget = 5
tuners = ["random"]
[sampling]
rate = 10.0
samples = 40
"""


@pytest.fixture
def exploding(tmp_path):
    """Return a function that writes the simulator with bounds up to `high` and the experiment, and
    returns the arguments of `simgap compare`.
    """

    def written(high):
        (tmp_path / "exploding.py").write_text(PLUGIN.replace("{high}", str(high)))
        (tmp_path / "exploding.toml").write_text(EXPERIMENT)
        plugin = ["--plugin", str(tmp_path / "exploding.py")]
        return ["compare", str(tmp_path / "exploding.toml"), *plugin, "--salt", "public"]

    return written


def simgap(*arguments):
    """Run the command in its own process with all warnings shown."""
    command = [sys.executable, "-W", "always", "-m", "simgap", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_diverging_targets_are_drawn_again_and_counted(exploding, tmp_path):
    done = simgap(*exploding(60.0), "--out", tmp_path / "a", "--jobs", "1", "--allow-failures")
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stdout + done.stderr
    environment = json.loads((tmp_path / "a" / "environment.json").read_text())
    redrawn, draws = environment["redrawn_targets"], environment["target_draws"]
    assert 1 <= redrawn <= 6 < draws
    assert f"{redrawn} of 6 targets were drawn again because their own simulation diverged" in (
        done.stdout
    )
    runs = pd.read_parquet(tmp_path / "a" / "runs.parquet")
    assert runs["true_rate"].max() < 20.0
    # Targets have finite errors; a run is reported as diverged if none of its losses is finite.
    status = pd.read_csv(tmp_path / "a" / "status.csv").set_index("run")
    best = runs.groupby("run")["loss"].min()
    np.testing.assert_array_equal(
        status["status"] == "diverged", ~np.isfinite(best[status.index].to_numpy())
    )
    again = simgap(*exploding(60.0), "--out", tmp_path / "b", "--jobs", "0", "--allow-failures")
    assert "Warning" not in again.stdout + again.stderr
    other = pd.read_parquet(tmp_path / "b" / "runs.parquet")
    np.testing.assert_array_equal(other["true_rate"], runs["true_rate"])
    verified = simgap("verify", tmp_path / "a")
    assert "all results are reproducible" in verified.stdout
    assert "Warning" not in verified.stderr


def test_too_many_diverging_targets_are_refused_in_one_message(exploding, tmp_path):
    (line,) = (
        run_command(*exploding(2000.0), "--out", tmp_path / "out", code=2).err.strip().splitlines()
    )
    assert "targets drawn diverges" in line
    assert "expected at most 90%: narrow the bounds and training ranges" in line
    assert not (tmp_path / "out").exists()


class Lossy(Simulator):
    """Simulator that returns `value` for parameters above 0.5."""

    name = "lossy"
    parameters = (Parameter("p", "1", 0.1, (0.0, 1.0), (0.0, 1.0)),)
    channels = (Channel("x", "m", 2.0),)
    value = np.nan

    def simulate(self, theta, scenario):
        bad = np.where(theta > 0.5, self.value, theta)
        return np.repeat(bad[:, :, None], scenario.times.size, axis=1)


@pytest.mark.parametrize("value", [np.nan, np.inf, -3e12])
def test_what_is_not_finite_or_beyond_the_limit_counts_as_diverged(value, monkeypatch):
    monkeypatch.setattr(Lossy, "value", value)
    monkeypatch.setattr(
        "bench.benchmark.problem.tuning_problem.get_simulator_class", lambda _: Lossy
    )
    experiment = spring_experiment(ranges=["in"], targets=30, observe=[], initial={})
    drawn = draw_targets(TuningProblem(experiment, "salt"))
    assert max(float(target.truth[0]) for target in drawn) <= 0.5
    redraws = count_redraws(experiment, drawn)
    assert redraws.redrawn == sum(target.redraws > 0 for target in drawn)
    # Half of all draws fail: 60 draws for 30 targets, with a standard deviation of 8.
    assert 36 <= redraws.draws <= 84
    # Each target has its own random streams, so it is the same when drawn alone.
    alone = draw_target(TuningProblem(experiment, "salt"), "in", 7)
    assert alone.truth.tolist() == drawn[7].truth.tolist()


def test_a_simulator_that_always_diverges_has_no_target(monkeypatch):
    monkeypatch.setattr(Lossy, "value", np.inf)
    monkeypatch.setattr(Lossy, "parameters", (Parameter("p", "1", 0.8, (0.6, 1.0), (0.6, 1.0)),))
    monkeypatch.setattr(
        "bench.benchmark.problem.tuning_problem.get_simulator_class", lambda _: Lossy
    )
    experiment = spring_experiment(ranges=["in"], observe=[], initial={})
    with pytest.raises(InputError, match="200 of 200 targets drawn diverges"):
        draw_target(TuningProblem(experiment), "in", 0)
