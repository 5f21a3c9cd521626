"""Tests of experiments on a recording: fitted and held-out runs, errors and units."""

import numpy as np
import pytest
import tomli_w

from bench.benchmark.problem.experiment_config import parse_experiment
from bench.benchmark.runner.experiment_runner import prepare_experiment, run_experiment
from bench.core.plugin_registries import tuners
from methods.tuner import Tuner
from tests.sample_experiments import SPRING

TIMES = np.arange(60) / 20
OFF = {"1": 0.1, "2": 0.1, "3": 0.25}
"""Offset in m of each run from the spring of 3 rad/s and 0.3 1/s; the third run is held out."""

pytestmark = pytest.mark.usefixtures("spring", "fresh_registries")


class Knowing(Tuner):
    """Tuner that simulates and recommends the spring of 3 rad/s and 0.3 1/s."""

    name = "knowing"
    source_digest = "knowing"

    def tune(self, task, rng):
        assert task.observed.shape == (120, 1)
        assert task.lengths == (60, 60)
        yield np.array([0.5, 0.3])
        return f"scale {task.scale[0]:g}"


def recorded(folder, **changes):
    """Run the tuner `knowing` on a recording; return the columns and the reason for its end."""
    lines = [
        f"{name},{t},{np.exp(-0.3 * t) * np.cos(3.0 * t) + off}"
        for name, off in OFF.items()
        for t in TIMES
    ]
    (folder / "swing.csv").write_text("\n".join(["run,t,x", *lines]))
    runs = {name: {"initial": {"x": 1.0}, "held_out": name == "3"} for name in OFF}
    about = {"system": "spring", "channels": {"x": {"unit": "m", "noise": 0.02}}, "runs": runs}
    (folder / "swing.toml").write_text(tomli_w.dumps(about))
    document = {k: v for k, v in SPRING.items() if k != "initial"}
    document |= {"ranges": ["real"], "recording": {"path": "swing.csv"}, "tuners": ["knowing"]}
    tuners.register(Knowing)
    results = prepare_experiment(
        parse_experiment(
            "swing",
            {**document, "targets": 1, "seeds": 1, "trusted": True, **changes},
            folder / "e.toml",
        )
    )
    run_experiment(results, jobs=0)
    (columns,) = results.run_sink.columns.values()
    (status,) = results.run_sink.statuses.values()
    assert status.status == "converged", status.reason
    return columns, status.reason


def test_fitted_runs_are_fitted_and_held_out_ones_measure(tmp_path):
    columns, _ = recorded(tmp_path)
    assert columns["obs_error"][1] == pytest.approx(0.1, rel=1e-9)
    assert columns["obs_error_x"][1] == pytest.approx(0.1, rel=1e-9)
    assert columns["heldout_error"][1] == pytest.approx(0.25, rel=1e-9)
    assert columns["heldout_error_x"][1] == pytest.approx(0.25, rel=1e-9)
    assert np.isnan(columns["param_error"]).all(), "the true parameters are unknown"


@pytest.mark.parametrize(("noise", "sigma"), [({}, 0.02), ({"x": 0.05}, 0.05)])
def test_errors_are_in_the_channels_unit_and_in_that_of_its_noise(tmp_path, noise, sigma):
    """The noise given in the experiment overrides the noise given in the recording."""
    columns, reason = recorded(tmp_path, noise=noise)
    assert reason == f"scale {sigma:g}"
    assert columns["loss"][1] == pytest.approx(0.1 / sigma, rel=1e-9)
    assert columns["obs_error_x_in_noise"][1] == pytest.approx(0.1 / sigma, rel=1e-9)
