"""Who is ahead of a tuner, at which number of simulations.

``python -m tests.benchmarks.reference_overlay FOLDER [TUNER]``

Reads the folder of a comparison and makes paired tests over its targets after 1, 2, 3, 5, ...
simulations (`statistics.paired_tests`: Wilcoxon on the logarithms of errors, Holm's correction over
all pairs). Writes behind.csv there and prints it as a table.
"""

import argparse
from pathlib import Path

import pandas as pd

from bench.benchmark.statistics.error_curves import (
    RunRowTable,
    select_checkpoints,
    select_primary_metric,
)
from bench.benchmark.statistics.paired_tests import compare_all_pairs
from bench.benchmark.storage.result_folder import read_comparison, read_configuration


def against(folder, tuner):
    """Return one row per competing tuner, range and number of simulations.

    A row has the median error of `tuner` divided by that of the competitor, and Holm's p-value.
    """
    stored = read_comparison(folder)
    parts = []
    metric, runs, _ = select_primary_metric(stored.runs)
    for k in select_checkpoints(read_configuration(folder).experiment.budget)[1:]:
        found = compare_all_pairs(RunRowTable(runs, stored.statuses, k).build_curves(metric))
        found = found[(found["a"] == tuner) | (found["b"] == tuner)].copy()
        mirrored = found["b"] == tuner
        found.loc[mirrored, "error_ratio"] = 1.0 / found.loc[mirrored, "error_ratio"]
        found.loc[mirrored, "effect"] *= -1.0
        found["rival"] = found["a"].where(mirrored, found["b"])
        found["behind"] = (found["p_holm"] < 0.05) & (found["effect"] < 0.0)
        found["ahead"] = (found["p_holm"] < 0.05) & (found["effect"] > 0.0)
        parts.append(found.assign(simulations=k))
    columns = [
        "range",
        "rival",
        "simulations",
        "targets",
        "error_ratio",
        "effect",
        "p_holm",
        "ahead",
        "behind",
    ]
    return pd.concat(parts)[columns].sort_values(["range", "rival", "simulations"])


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("tuner", nargs="?", default="hybrid")
    options = parser.parse_args()
    table = against(options.folder, options.tuner)
    table.to_csv(options.folder / "behind.csv", index=False, float_format="%.3g")
    words = table["error_ratio"].map("{:.2g}".format) + table["ahead"].map({True: " +", False: ""})
    table["shown"] = words + table["behind"].map({True: " BEHIND", False: ""})
    print(
        f"median error of {options.tuner} over that of the other; + significantly ahead, BEHIND "
        "significantly behind"
    )
    print(table.pivot(index=["range", "rival"], columns="simulations", values="shown").to_string())


if __name__ == "__main__":
    main()
