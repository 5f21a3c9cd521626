"""Measure how the cost of explain grows with samples, runs and candidates.

``OMP_NUM_THREADS=1 python -m tests.benchmarks.explain_cost [--out DIR] [--score]``

Costs are processor seconds on one core: of the score test alone, with surrogates, on generated
directions (two per candidate), and of a whole diagnosis of recordings with hidden friction.
Exponents are slopes of a line through the logarithms of the larger half of each row, so 1 is
proportional. Writes cost.csv and the figure cost.png|pdf; ``--score`` measures the score test
alone.
"""

import argparse
import gc
import tempfile
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.diagnosis.evaluation.autoregressive_surrogates import draw_surrogates
from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.explain import explain
from bench.diagnosis.fitting.trajectory_derivatives import CandidateDirection
from bench.diagnosis.pipeline import simulated_runs
from bench.diagnosis.search.candidate_directions import DirectionSet
from bench.diagnosis.search.score_test import ScoreTest
from sims import effects
from sims.systems.slider import SliderSystem
from tests.bench.diagnosis.explained_samples import linear_fit
from tests.simulation_arguments import simulation_spec, write

DEFAULT_RECORDING = simulation_spec(
    # Record with the engine that explains, so that numerical errors do not grow with the length.
    "slider",
    effects=["friction.coulomb=0.3"],
    noise=["0.005"],
    observe=["x"],
    engine="batch",
)
SCORED = {
    "samples": (100, 300, 1_000, 3_000, 10_000, 30_000, 100_000),
    "candidates": (5, 10, 30, 100, 300),
    "runs": (1, 3, 10, 30, 100),
}
EXPLAINED = {
    "samples": (100, 400, 1_600, 6_400, 25_600, 100_000),
    "candidates": (6, 12, 18, 24),
    "runs": (3, 10, 30, 100),
}
RUNS, SAMPLES, CANDIDATES, SURROGATES = 4, 1_600, 24, 120


def problem(samples, candidates, runs):
    """Return a fit, two smooth directions per candidate, and AR(1) residuals.

    The fit has one parameter, and two initial states per run.
    """
    rng = np.random.default_rng(0)
    length = samples // runs
    times = np.linspace(0.0, 1.0, length)
    jacobian = np.stack([times**2, np.ones(length), times], axis=1)
    jacobian = np.tile(jacobian[None, :, None], (runs, 1, 1, 1))
    jacobian[..., 0] *= rng.normal(size=(runs, 1, 1))
    rates = np.linspace(1.0, 30.0, candidates)
    waves = [turn(rate * times) for rate in rates for turn in (np.sin, np.cos)]
    values = (
        rng.normal(size=(len(waves), runs))[:, :, None, None] * np.stack(waves)[:, None, :, None]
    )
    probes = [
        CandidateDirection(f"effect {k // 2}", 0, k % 2, np.ones(2), True)
        for k in range(len(waves))
    ]
    residual = np.cumsum(rng.normal(size=(runs, length, 1)), axis=1)
    residual -= residual.mean(axis=1, keepdims=True)
    return (
        linear_fit(jacobian, 1),
        DirectionSet(tuple(probes), np.moveaxis(values, 0, -1)),
        residual,
    )


def scoring(samples=SAMPLES, candidates=CANDIDATES, runs=RUNS):
    """Return processor seconds of one scoring with surrogates, the minimum of three."""
    fit, directions, residual = problem(samples, candidates, runs)
    best = np.inf
    for _ in range(3):
        gc.collect()
        begin = time.process_time()
        _scored(fit, directions, residual)
        best = min(best, time.process_time() - begin)
    return best


def _scored(fit, directions, residual):
    seen = np.ones(residual.shape, dtype=bool)
    meaningless = draw_surrogates(residual, seen, SURROGATES, np.random.default_rng(1))
    test = ScoreTest(fit, directions, seen, NoiseModel(np.ones(1), np.zeros(1)))
    return test.compute_scores(residual, meaningless)


def memory(samples, candidates):
    """Return the size of the directions and the additional peak memory of scoring, in MB."""
    fit, directions, residual = problem(samples, candidates, RUNS)
    tracemalloc.start()
    _scored(fit, directions, residual)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return directions.values.nbytes / 1e6, peak / 1e6


def explained(samples=SAMPLES, candidates=None, runs=RUNS):
    """Return processor seconds of explain, the minimum of two calls (one if it is long)."""
    usual, best = simulated_runs.RunEvaluator, np.inf
    if candidates is not None:
        names = [n for n in effects.list_names() if effects.get_effect(n).fits(SliderSystem)]
        names.sort(key=lambda name: name != "friction.coulomb")
        chosen = names[:candidates]
        simulated_runs.RunEvaluator = lambda *given, **more: RunEvaluator(
            *given, **more, candidates=chosen
        )
    try:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "data.csv"
            write(replace(DEFAULT_RECORDING, runs=runs, seconds=samples / runs / 100.0), path)
            for _ in range(2 if samples < 10 * SAMPLES else 1):
                begin = time.process_time()
                explain(path)
                best = min(best, time.process_time() - begin)
    finally:
        simulated_runs.RunEvaluator = usual
    return best


def measured(score_alone):
    """Return rows (part, varied quantity, its value, seconds); the length of runs is constant."""
    asked = [("score", scoring, SCORED)]
    if not score_alone:
        explained()  # The first call includes imports and tracing.
        asked.append(("explain", explained, EXPLAINED))
    for part, cost, counts in asked:
        for what, numbers in counts.items():
            for number in numbers:
                given = {what: number}
                if what == "runs":
                    given["samples"] = SAMPLES // RUNS * number
                row = part, what, number, cost(**given)
                print(*row[:3], f"{row[3]:.4f} s", flush=True)
                yield row


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, default=Path("results/reference/explain-cost"))
    parser.add_argument("--score", action="store_true", help="the score alone")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    rows = list(measured(given.score))
    lines = [f"{part},{what},{count},{seconds:.5f}\n" for part, what, count, seconds in rows]
    (given.out / "cost.csv").write_text("part,what,count,seconds\n" + "".join(lines))
    _draw(rows, given.out)
    for part, what in dict.fromkeys(row[:2] for row in rows):
        print(f"{part} against {what}: exponent {_slope(rows, part, what):.2f}")
    held, peak = memory(100_000, 300)
    print(f"100,000 samples, 300 candidates: directions {held:.0f} MB, scoring {peak:.0f} MB more")


def _of(rows, part, what):
    return np.array([(n, s) for p, w, n, s in rows if (p, w) == (part, what)]).T


def _slope(rows, part, what):
    """Use the larger half, because the constant cost of every call hides the growth below it."""
    counts, costs = _of(rows, part, what)
    upper = slice(counts.size // 2, None)
    return float(np.polyfit(np.log(counts[upper]), np.log(costs[upper]), 1)[0])


def _draw(rows, out):
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    kinds = list(dict.fromkeys(what for _, what, _, _ in rows))
    figure, axes = plt.subplots(1, len(kinds), figsize=(10, 3.4), sharey=True, layout="constrained")
    parts = list(dict.fromkeys(part for part, *_ in rows))
    for axis, what in zip(axes, kinds, strict=True):
        for part, marker in zip(parts, "os", strict=False):
            counts, costs = _of(rows, part, what)
            label = f"{part}, exponent {_slope(rows, part, what):.2f}"
            axis.loglog(counts, costs, f"k{marker}-", markersize=4, label=label)
            axis.loglog(counts, costs[-1] * counts / counts[-1], "k:", linewidth=1)
        axis.set_xlabel(what)
        axis.legend(frameon=False, fontsize=8)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("processor time [s]")
    figure.suptitle("Cost of a score and of explain, one core; dotted: proportional", fontsize=11)
    for ending in ("png", "pdf"):
        figure.savefig(out / f"cost.{ending}", dpi=150)
    plt.close(figure)


if __name__ == "__main__":
    main()
