"""Read the reference tables for the checks of page numbers."""

import json
from functools import cache

import pandas as pd

from tests.docs.documentation_pages import ROOT

REFERENCE = ROOT / "results" / "reference"


@cache
def frame(path):
    """Return a table below results/reference."""
    return pd.read_csv(REFERENCE / path)


@cache
def document(path):
    """Return a JSON file below results/reference."""
    return json.loads((REFERENCE / path).read_text(encoding="utf-8"))


def rows(path, **where):
    """Return the rows of a table in which columns have these values."""
    table = frame(path)
    for column, value in where.items():
        table = table[table[column] == value]
    return table


def one(path, column, **where):
    """Return the only cell of a column in the selected rows."""
    return rows(path, **where)[column].item()


def errors(folder, tuner, kind, simulations, metric):
    """Return mean and median of an error over targets after a number of simulations.

    A run that ended earlier counts with its last value.
    """
    table = rows(f"{folder}/table.csv", tuner=tuner, range=kind, metric=metric)
    row = table[table.simulations <= simulations].sort_values("simulations").iloc[-1]
    return row["mean"], row["median"]
