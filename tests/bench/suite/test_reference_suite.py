"""The published results of the suite: headline, guide and pages follow from the stored runs."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from bench.benchmark.problem.experiment_config import load_experiment
from bench.suite.suite_report import LOSS_FACTOR, build_headline, describe_losses
from bench.suite.suite_runs import RUN_KEYS, read_suite_runs
from bench.suite.suite_statistics import FREE, SuiteTables, build_guide

FOLDER = Path(__file__).parents[3] / "results" / "reference" / "suite"


@pytest.fixture(scope="module")
def tables():
    return SuiteTables(read_suite_runs(FOLDER))


def test_stored_runs_are_of_this_version(tables):
    experiment = load_experiment("suite")
    assert tables.suite.version == experiment.suite
    assert tables.suite.budget == experiment.budget
    assert tables.suite.runs.groupby("cell")["target"].nunique().min() >= 2


def test_no_run_is_stored_twice(tables):
    assert not tables.suite.runs.duplicated(RUN_KEYS).any()


def test_tables_follow_from_the_runs(tables):
    for name, frame in {**tables.build_tables(), "guide": build_guide(tables)}.items():
        stored = pd.read_csv(FOLDER / f"{name}.csv", keep_default_na=False, na_values=["nan"])
        assert len(stored) == len(frame), name
        for column in frame.select_dtypes("number"):
            expected = pd.to_numeric(stored[column], errors="coerce").to_numpy()
            np.testing.assert_allclose(
                frame[column].to_numpy(), expected, rtol=1e-6, atol=1e-12, err_msg=name
            )


def test_pages_state_the_headline_and_where_the_methods_lose(tables):
    readme = (FOLDER / "README.md").read_text(encoding="utf-8")
    page = (FOLDER / "report.html").read_text(encoding="utf-8")
    for text in (readme, page):
        assert build_headline(tables) in text
    for line in describe_losses(tables):
        assert line in page
    columns = [("hybrid", 10), ("tunenet", 10), ("tunenet", 100)]
    for place, (tuner, simulations) in enumerate(columns):
        losses = tables.find_losses(tuner, simulations, LOSS_FACTOR).itertuples()
        expected = {row.cell: f"{row.winner}, {float(f'{row.ratio:.2g}'):g}" for row in losses}
        rows = re.findall(r"^\| ([a-z0-9 -]+) \|(.*)\|(.*)\|(.*)\|$", readme, re.MULTILINE)
        stated = {row[0]: row[1 + place].strip() for row in rows if row[0] in set(tables.curves)}
        assert {cell: text for cell, text in stated.items() if text} == expected
    assert tables.find_losses("hybrid", 100, LOSS_FACTOR).empty
    assert "After 100 simulations, `hybrid` is in no cell worse by this factor." in readme
    ranks = tables.ranks[tables.ranks["training"] == FREE]
    for row in ranks[ranks["simulations"] == 100].itertuples():
        assert f"| `{row.tuner}` |" in readme
        assert f"| {row.mean_rank:.1f} |" in readme


def test_readme_states_the_targets_and_seeds_of_each_method(tables):
    readme = (FOLDER / "README.md").read_text(encoding="utf-8")
    for row in tables.coverage.itertuples():
        numbers = [row.min_targets, row.max_targets, row.seeds_1, row.seeds_3]
        assert f"| `{row.tuner}` | {' | '.join(map(str, numbers))} |" in readme
