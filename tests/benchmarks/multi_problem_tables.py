"""Print the tables of results/reference/multi as Markdown, from the folders of its comparisons.

python -m tests.benchmarks.multi_problem_tables results/multi > results/multi/tables.md
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

from bench.benchmark.problem.fisher_information import STIFF_SIGMA_THRESHOLD

METRICS = {
    "param_error": "parameter error [training widths]",
    "stiff_error": "error along stiff directions [training widths]",
    "sloppy_error": "error along sloppy directions [training widths]",
    "heldout_error": "RMSE in unseen scenarios, in the error channel's unit (ball m, others rad)",
}


def identified(folders):
    """Return what the data of each problem identify, one line per problem and range."""
    lines = [
        "| problem | parameters | range | targets | stiff directions | 1 sigma of the stiffest | "
        "of the sloppiest |",
        "|---|---|---|---|---|---|---|",
    ]
    for folder in folders:
        table = pd.read_csv(folder / "identifiability.csv")
        for kind, part in table.groupby("range", sort=False):
            counts = part.groupby("target")["stiff"].sum()
            spread = (
                f"{counts.min()} to {counts.max()}"
                if counts.min() < counts.max()
                else f"{counts.min()}"
            )
            middle = part.groupby("direction")["sigma"].median()
            lines.append(
                f"| {folder.name} | {part['direction'].max()} | {kind} | {len(counts)} | {spread} "
                f"| {middle.iloc[0]:.1g} | {_number(middle.iloc[-1])} |"
            )
    return "\n".join(lines)


def errors(folders, metric, simulations=None):
    """Return the median of a metric over targets after `simulations` (default: all), by range."""
    columns = {}
    for folder in folders:
        table = pd.read_csv(folder / "table.csv")
        k = simulations or table["simulations"].max()
        part = table[(table["metric"] == metric) & (table["simulations"] == k)]
        columns[folder.name] = part.pivot_table(
            index="tuner", columns="range", values="median", dropna=False
        )
    tuners = sorted({t for c in columns.values() for t in c.index}, key=lambda t: _rank(columns, t))
    lines = ["| tuner | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    for tuner in tuners:
        cells = [
            " / ".join(_number(_of(c, tuner, kind)) for kind in ("in", "wide"))
            for c in columns.values()
        ]
        lines.append(f"| {tuner} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _rank(columns, tuner):
    """Return the mean rank over problems and ranges."""
    ranks = [c.rank().reindex([tuner]).to_numpy() for c in columns.values()]
    return float(np.nanmean(np.concatenate(ranks, axis=1)))


def _of(column, tuner, kind):
    return column[kind].get(tuner, np.nan) if kind in column else np.nan


def _number(value):
    if not np.isfinite(value):
        return "–" if np.isnan(value) else "∞"
    return "> 100" if value > 100 else f"{value:.2g}"


def failures(folders):
    """Return the number of runs and of failed runs."""
    statuses = pd.concat(
        [pd.read_csv(folder / "status.csv", keep_default_na=False) for folder in folders]
    )
    failed = statuses[statuses["status"].isin(("crashed", "timeout", "diverged", "skipped"))]
    named = ", ".join(
        f"{t} {s} {n}" for (t, s), n in failed.groupby(["tuner", "status"]).size().items()
    )
    return (
        f"{len(statuses)} runs, {len(failed)} failed or skipped"
        + (f": {named}" if named else "")
        + "."
    )


def main():
    root = Path(sys.argv[1])
    folders = sorted((f.parent for f in root.glob("*/identifiability.csv")), key=lambda f: f.name)
    print("# Tables\n\nMade by `make multi`; medians over targets, in range / wide.\n")
    print(
        "## What the data identify\n\n"
        f"Stiff: 1 sigma below {STIFF_SIGMA_THRESHOLD:g} of the training width.\n"
    )
    print(identified(folders))
    for metric, title in METRICS.items():
        for k, when in ((10, "10 simulations"), (None, "all 50")):
            print(
                f"\n## {title[0].upper()}{title[1:]}, after {when}\n\n{errors(folders, metric, k)}"
            )
    print(f"\n{failures(folders)}")


if __name__ == "__main__":
    main()
