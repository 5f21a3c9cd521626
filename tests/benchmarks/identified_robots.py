"""Show which parameter combinations the data of multi-parameter problems identify.

Run: `python -m tests.benchmarks.identified_robots [--out FILE.csv]`. For each problem and range,
print medians over targets of the smallest and largest standard error (1 sigma) of an unbiased
estimate along a direction, the counts of stiff directions, and the parameters of the sloppiest
direction: the mean of its squared components. The table of docs/problems.md uses these numbers.
"""

import argparse
from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd

from bench.benchmark.problem.experiment_config import load_experiment
from bench.benchmark.problem.fisher_information import compute_target_spectrum
from bench.benchmark.problem.targets import draw_target
from bench.benchmark.problem.tuning_problem import TuningProblem

PROBLEMS = {
    "slider-push": 20, "pendulum-swing": 20, "servo-step": 20, "ball-wind": 20, "ball-tilt": 20,
    "pendulum-driven": 20, "servo-friction": 20, "arm-swing": 10, "arm-drive": 10,
}  # fmt: skip
"""Number of targets in each range."""
OUT = Path(__file__).resolve().parents[2] / "results" / "reference" / "multi" / "identified.csv"


def identified(name, count):
    """Yield a row for each range of a problem."""
    problem = TuningProblem(load_experiment(name).chosen(targets=count))
    for kind in ("in", "wide"):
        spectra = [
            compute_target_spectrum(problem, draw_target(problem, kind, i)) for i in range(count)
        ]
        sigmas = np.array([one.sigmas for one in spectra])
        stiff = Counter(int(one.is_stiff.sum()) for one in spectra)
        shares = np.mean([one.vectors[:, -1] ** 2 for one in spectra], axis=0)
        names = [parameter.name for parameter in problem.cube.parameters]
        order = np.argsort(-shares)
        yield {
            "experiment": name, "range": kind, "targets": count,
            "stiffest": np.median(sigmas.min(axis=1)), "sloppiest": np.median(sigmas.max(axis=1)),
            "stiff": ", ".join(f"{n} ({stiff[n]})" for n in sorted(stiff, reverse=True)),
            "made_of": ", ".join(f"{names[i]} {100 * shares[i]:.0f}" for i in order[:3]),
        }  # fmt: skip


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args()
    rows = []
    for name, count in PROBLEMS.items():
        rows += identified(name, count)
        print(pd.DataFrame(rows[-2:]).to_string(header=False, index=False), flush=True)
    pd.DataFrame(rows).to_csv(options.out, index=False, float_format="%.6g")


if __name__ == "__main__":
    main()
