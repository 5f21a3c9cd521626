"""The reference tables, as the accounts of their pages ask for them."""

import json
from functools import cache

import pandas as pd

from tests.docs.documentation_pages import ROOT

REFERENCE = ROOT / "results" / "reference"


@cache
def frame(path):
    """A table below results/reference."""
    return pd.read_csv(REFERENCE / path)


@cache
def document(path):
    """A JSON file below results/reference."""
    return json.loads((REFERENCE / path).read_text(encoding="utf-8"))


def rows(path, **where):
    """The rows of a table in which columns have these values."""
    table = frame(path)
    for column, value in where.items():
        table = table[table[column] == value]
    return table


def one(path, column, **where):
    """The one cell of a column in the row that is meant."""
    return rows(path, **where)[column].item()


def errors(folder, tuner, kind, simulations, metric):
    """(mean, median) of an error over targets after so many simulations; a run that ended before
    counts with its last.
    """
    table = rows(f"{folder}/table.csv", tuner=tuner, range=kind, metric=metric)
    row = table[table.simulations <= simulations].sort_values("simulations").iloc[-1]
    return row["mean"], row["median"]
