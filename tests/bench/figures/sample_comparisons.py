"""Synthetic comparison that allows each figure: two tuners, one learned, and both target ranges."""

import numpy as np
import pandas as pd

from bench.benchmark.comparison_charts import AxisLabels
from bench.benchmark.problem.experiment_config import load_experiment
from bench.benchmark.storage.result_folder import StoredComparison

LABELS = AxisLabels("z [m]", "restitution")
BUDGET = 12
TARGETS = ("in-0", "in-1", "in-2", "wide-0", "wide-1", "wide-2")
RATES = {"random": 0.1, "tunenet": 0.5}


def _rows(tuner, target, rng):
    k = np.arange(BUDGET + 1)
    kind, number = target.split("-")
    error = np.exp(-RATES[tuner] * k) * rng.uniform(0.5, 1.5)
    return pd.DataFrame(
        {
            "run": f"{tuner}/{target}/0",
            "experiment": "ball-crossengine",
            "tuner": tuner,
            "target": target,
            "seed": 0,
            "range": kind,
            "k": k,
            "param_error": error,
            "param_abs_error": 0.4 * error,
            "stiff_error": 0.9 * error,
            "sloppy_error": 2.0 * error,
            "obs_error": 0.1 + error,
            "heldout_error": 0.2 + error,
            "outside": 0.3 * int(number) if kind == "wide" else 0.0,
            "tuner_seconds": 1e-3,
            "simulator_seconds": 2e-3,
        }
    )


def _spectra():
    lines = [
        ("ball-crossengine", target, target.split("-")[0], i + 1, 1e4, 0.01 * 10.0**i, i < 1, *row)
        for target in TARGETS
        for i, row in enumerate(((0.8, 0.6), (-0.6, 0.8)))
    ]
    columns = ["experiment", "target", "range", "direction", "eigenvalue", "sigma", "stiff"]
    return pd.DataFrame(lines, columns=[*columns, "restitution", "drag"])


def stored(**changes):
    """Return the comparison; `changes` replace its fields."""
    rng = np.random.default_rng(0)
    experiment = load_experiment("ball-crossengine").chosen(budget=BUDGET)
    experiment = experiment.with_tuners(list(RATES))
    runs = pd.concat([_rows(tuner, target, rng) for tuner in RATES for target in TARGETS])
    names = runs["run"].unique()
    statuses = pd.DataFrame(
        {"run": names, "tuner": [n.split("/")[0] for n in names], "status": "done", "reason": ""}
    )
    complete = StoredComparison(experiment, runs, statuses, {"tunenet": (800.0, 3.0)}, _spectra())
    return complete._replace(**changes)
