"""Compare the tuner that reads histories with the other learned ones.

Tables of a few numbers, from comparisons and from studies of a missing effect.

    simgap compare ball-drop --tuners least_squares,regressor,tunenet,hybrid,in_context \\
        --targets 20 --seeds 1 --budget 20 --salt public --out results/history/ball-drop
    python -m tests.benchmarks.history_tuner_study OUT.csv results/history/ball-drop ...
    python -m tests.benchmarks.history_tuner_study --missing OUT.csv results/misspecified-learned...
"""

import sys
from pathlib import Path

import pandas as pd

from sims.core.files import write_atomically

AFTER = (0, 1, 2, 3, 5, 10, 20)
"""Simulation counts at which errors are reported."""


def compared(folder):
    """Return parameter errors by simulation count, and the number of training simulations."""
    table = pd.read_csv(folder / "table.csv")
    kept = table[(table.metric == "param_error") & table.simulations.isin(AFTER)]
    columns = ["range", "tuner", "simulations", "mean", "median", "low", "high", "runs"]
    kept = kept[[*columns, "fit_simulations"]].rename(columns={"fit_simulations": "trained_on"})
    kept.insert(0, "experiment", folder.name.removesuffix("-variants"))
    return kept


def missing(folder):
    """Return errors before and after explain, of tuners without failures."""
    parts = []
    for path in sorted(folder.glob("*/table.csv")):
        table = pd.read_csv(path)
        table = table[table.metric.isin(["param_error", "heldout_error"]) & (table.failures == 0)]
        parts.append(table)
    columns = ["experiment", "tuner", "model", "metric", "mean", "low", "high", "targets"]
    return pd.concat(parts)[columns]


if __name__ == "__main__":
    studies = "--missing" in sys.argv
    out, *folders = (argument for argument in sys.argv[1:] if argument != "--missing")
    read = missing if studies else compared
    frame = pd.concat([read(Path(folder)) for folder in folders])
    # Of repeated runs, keep the later ones.
    frame = frame.drop_duplicates(list(frame.columns[:4]), keep="last")
    write_atomically(Path(out), frame.to_csv(index=False, float_format="%.4g"))
