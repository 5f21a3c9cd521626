"""Tests that the numbers on the page about choosing a tuner equal the reference tables."""

import pandas as pd
import pytest

from tests.docs.documentation_pages import ROOT, quoted, section, tables, text_of

PAGE = text_of("choosing-a-tuner.md")
REFERENCE = ROOT / "results" / "reference"


def median(folder, metric, tuner, kind, simulations):
    """Return a tuner's median over targets with two digits; `all` selects the last checkpoint."""
    table = pd.read_csv(REFERENCE / folder / "table.csv")
    rows = table[(table.metric == metric) & (table.tuner == tuner) & (table.range == kind)]
    at = rows.simulations.max() if simulations == "all" else int(simulations)
    return f"{rows[rows.simulations == at]['median'].item():.2g}"


@pytest.mark.parametrize("moment", ["3", "all"])
def test_medians_are_those_of_the_reference(moment):
    names = {"3": "### After three simulations", "all": "### At the end"}
    (head, *rows) = tables(section(PAGE, names[moment]))[0]
    columns = {
        "ball-drop": ("ball-drop", "param_error"),
        "servo-step": ("comparison/servo-step", "param_error"),
        "pendulum-driven": ("multi/pendulum-driven", "stiff_error"),
        "arm-swing": ("multi/arm-swing", "stiff_error"),
        "ball-crossengine": ("comparison/ball-crossengine", "param_error"),
    }
    # Count the cells: a table that is not read would pass without any comparison.
    cells = 0
    for tuner, *values in rows:
        for heading, value in zip(head[1:], values, strict=True):
            if value != "–":
                folder, metric = columns[quoted(heading)[0]]
                asked = folder, metric, quoted(tuner)[0]
                expected = [median(*asked, kind, moment) for kind in ("in", "wide")]
                assert value == " / ".join(expected), (tuner, heading)
                cells += 1
    assert cells > 35


def test_seconds_are_those_of_the_reference():
    table = pd.read_csv(REFERENCE / "ball-drop" / "table.csv")
    last = table[(table.range == "in") & (table.simulations == 50)].drop_duplicates("tuner")
    seconds = last.set_index("tuner").tuner_seconds
    for tuner, milliseconds in tables(section(PAGE, "## What a tuner costs"))[0][1:]:
        assert milliseconds == f"{1e3 * seconds[quoted(tuner)[0]]:.2g}"


def test_break_even_is_that_of_the_reference():
    rows = tables(section(PAGE, "## When a training pays"))[0][1:]
    for problem, kind, threshold, learned, targets, interval in rows:
        table = pd.read_csv(REFERENCE / quoted(problem)[0] / "break_even.csv")
        (row,) = table[
            (table.range == kind)
            & (table.threshold == float(threshold))
            & (table.learned == quoted(learned)[0])
            & (table.search == "least_squares")
        ].itertuples()
        numbers = (row.targets, row.low, row.high)
        even, low, high = (f"{number:.0f}".replace("inf", "never") for number in numbers)
        assert (targets, interval) == (even, f"{low} to {high}")
