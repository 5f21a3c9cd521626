"""Print the Markdown table of results/reference/misspecified/README.md from its CSV tables.

python -m tests.benchmarks.misspecification_tables results/reference/misspecified
"""

import sys
from pathlib import Path

import pandas as pd

FIT = "least_squares"
"""Tuner that finds the best fit if there is one; its error is the error of the model."""
HEAD = (
    "| system | targets | runs | parameter: bias of least squares, as it is | extended "
    "| RMSE of unseen runs, as it is | extended | τ of parameters' ranks | of halves | p |\n"
    "|---|---|---|---|---|---|---|---|---|---|"
)


def number(value):
    """Format a number with two digits."""
    return f"{value:.2g}".replace("-", "−").replace("e−0", "e−")


def between(row):
    """Format a mean with its interval."""
    return f"{number(row['mean'])} ({number(row['low'])} to {number(row['high'])})"


def lines(folder):
    """Return the rows of the table, one per system."""
    table, ranking = (pd.read_csv(folder / f"{name}.csv") for name in ("table", "ranking"))
    rows = []
    for name, part in table.groupby("experiment", sort=False):
        fit = part[part["tuner"] == FIT]
        bias = fit[fit["metric"] == "bias"].set_index(["model", "parameter"])
        worst = bias.loc["plain"]["mean"].abs().idxmax()
        unseen = fit[fit["metric"] == "heldout_error"].set_index("model")
        alike = ranking[(ranking["experiment"] == name) & (ranking["metric"] == "param_error")]
        (tau,) = alike.to_dict("records")
        cells = [
            name.removeprefix("misspecified-"),
            tau["targets"],
            part.groupby(["model", "tuner"])["runs"].first().sum(),
            f"{worst}: {between(bias.loc['plain', worst])}",
            between(bias.loc["extended", worst]),
            f"{between(unseen.loc['plain'])} {unseen.loc['plain', 'unit']}",
            between(unseen.loc["extended"]),
            f"{number(tau['tau'])} ({number(tau['low'])} to {number(tau['high'])})",
            number(tau["tau_of_halves"]),
            number(tau["p_value"]),
        ]
        rows.append(f"| {' | '.join(map(str, cells))} |")
    return rows


if __name__ == "__main__":
    print(HEAD, *lines(Path(sys.argv[1])), sep="\n")
