"""Test whether p-values are correct for short runs.

``OMP_NUM_THREADS=1 python -m tests.benchmarks.null_quantiles [--count N]``

Runs of 60 samples of a pendulum and a slider without a hidden cause are linearised about the true
model, with AR(1) noise of several coefficients, and their residuals are scored against the whole
library. The output is the share of p-values below each level, for the same noise, with the present
surrogates and with those that keep the bias of the fit (`evaluation.autoregressive_surrogates`).
"""

import argparse

import numpy as np

from bench.diagnosis.evaluation.autoregressive_surrogates import draw_surrogates
from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.fitting.base_fit import fit_base_model
from bench.diagnosis.search.candidate_directions import compute_directions
from bench.diagnosis.search.score_test import ScoreTest
from tests.bench.diagnosis.explained_samples import correlated, evaluator, recording, white

LEVELS = (0.3, 0.1, 0.05, 0.01, 0.003)
SYSTEMS = {"pendulum": "q", "slider": "x"}
RUNS, MEMORIES, SURROGATES, SIGMA = (1, 3), (0.0, 0.6, 0.85), 120, 0.01


def tested(system, runs):
    """Return the score test about the true model of 3 s at 20 Hz, and its observation mask."""
    recorded = recording(
        system, runs=runs, seconds=3.0, rate=20.0, seed=5, observe=[SYSTEMS[system]]
    )
    there = evaluator(recorded)
    fit = fit_base_model(there, white(there, SIGMA / 10.0)).fit
    seen = np.ones(fit.simulated.shape, dtype=bool)
    found = compute_directions(there, fit, there.library)
    return ScoreTest(fit, found, seen, NoiseModel(np.full(seen.shape[2], SIGMA), np.zeros(1))), seen


def compute_p_values(test, seen, memory, count):
    """Return p-values (2, count): with the bias of the fit removed, and without."""
    rng = np.random.default_rng(1)
    found = []
    for _ in range(count):
        noise = correlated(rng, memory, SIGMA, seen.shape)
        residual = test.project_out(noise[None])[0]
        bias = (test.project_out, None)
        drawn = (draw_surrogates(residual, seen, SURROGATES, rng, project_out=f) for f in bias)
        found.append([test.compute_scores(residual, some).p_value for some in drawn])
    return np.array(found).T


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=400, help="residuals of each kind")
    count = parser.parse_args().count
    print("| system, runs, memory of noise | " + " | ".join(map(str, LEVELS)) + " |")
    for system in SYSTEMS:
        for runs in RUNS:
            test, seen = tested(system, runs)
            for memory in MEMORIES:
                now, before = compute_p_values(test, seen, memory, count)
                shares = [
                    f"{(now < level).mean():.3f} ({(before < level).mean():.3f})"
                    for level in LEVELS
                ]
                print(f"| {system}, {runs}, {memory} | {' | '.join(shares)} |", flush=True)


if __name__ == "__main__":
    main()
