"""Tests of the stored machine code of the Kalman recursions."""

import os
import subprocess
import sys
from functools import partial

import numpy as np
import pytest

from bench.diagnosis.kalman.kalman_recursions import LinearRuns, filter_runs, smooth_runs
from sims.engines.compiled import compiled_functions


@pytest.mark.slow
def test_two_files_hold_the_code_and_are_loaded_without_the_compiler(tmp_path):
    pytest.importorskip("numba")
    environment = {**os.environ, "SIMGAP_COMPILED": str(tmp_path)}
    command = [sys.executable, "-m", "bench.diagnosis.kalman.precompile"]
    first = subprocess.run(command, check=True, env=environment, capture_output=True, text=True)
    assert "compiling the Kalman filter, once after an install" in first.stderr
    assert "compiling the effects with memory, once after an install" in first.stderr
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".bin", ".bin", ".lock", ".lock"]
    without = (
        "import sys; sys.modules['numba'] = None; "
        "from bench.diagnosis.kalman.precompile import precompile; precompile()"
    )
    again = [sys.executable, "-c", without]
    second = subprocess.run(again, check=True, env=environment, capture_output=True, text=True)
    assert second.stderr == ""


def make_runs():
    rng = np.random.default_rng(3)
    b, t, c, z, e = 2, 30, 2, 4, 3
    return LinearRuns(
        states=0.9 * np.eye(z) + 0.05 * rng.standard_normal((b, t - 1, z, z)),
        defects=0.1 * rng.standard_normal((b, t - 1, z)),
        forces=rng.standard_normal((b, t - 1, z, e)),
        inputs=np.zeros((b, t - 1, z, e)),
        readings=rng.standard_normal((b, t, c, z)),
        residuals=rng.standard_normal((b, t, c)),
        recorded=rng.random((b, t, c)) < 0.9,
        prior=np.ones(z),
        jumps=np.full((b, t - 1, z), 0.01),
    )


def run_both(runs):
    force, white = np.array([0.1, 0.2, 0.3]), np.array([0.01, 0.02])
    filtered = filter_runs(runs, force, white)
    smoothed = smooth_runs(runs, filtered, force)
    return [
        filtered.predicted,
        filtered.covariances,
        filtered.whitened,
        filtered.log_likelihood,
        smoothed.states,
        smoothed.forces,
        smoothed.score,
    ]


def test_compiled_and_interpreted_recursions_agree(monkeypatch):
    compiled = run_both(make_runs())
    monkeypatch.setattr(
        compiled_functions.CompiledFunctions,
        "_bind",
        lambda _self, function, _sizes, arguments: partial(function, *arguments),
    )
    for fast, slow in zip(compiled, run_both(make_runs()), strict=True):
        np.testing.assert_allclose(fast, slow, rtol=1e-9, atol=1e-12)


def test_arrays_of_another_shape_are_rejected():
    runs = make_runs()
    with pytest.raises(ValueError, match=r"expected a contiguous array of shape \(2, 29, 4\)"):
        filter_runs(
            LinearRuns(**{**vars(runs), "defects": np.zeros((2, 28, 4))}), np.ones(3), np.ones(2)
        )
    longer = np.zeros((2, 30, 4))
    runs = {**vars(runs), "states": np.zeros((2, 30, 4, 4)), "defects": longer, "jumps": longer}
    with pytest.raises(ValueError, match="expected a step between two samples, got 30 steps"):
        filter_runs(LinearRuns(**runs), np.ones(3), np.ones(2))
