"""Tests that the README of the reference results agrees with their tables."""

import re

import numpy as np
import pandas as pd
import pytest

from bench.misspecification import misspecification_statistics
from bench.misspecification.misspecification_statistics import compute_joint_ranks
from tests.benchmarks.domain_randomisation import halves
from tests.benchmarks.misspecification_tables import FIT, lines
from tests.docs.documentation_pages import ROOT

FOLDER = ROOT / "results" / "reference" / "misspecified"
README = (FOLDER / "README.md").read_text(encoding="utf-8")
TABLE = pd.read_csv(FOLDER / "table.csv")


def of(metric, model, tuner=FIT):
    """Return the rows of a metric, model and tuner, by system."""
    chosen = TABLE[(TABLE["metric"] == metric) & (TABLE["model"] == model)]
    return chosen[chosen["tuner"] == tuner].set_index("experiment")


def test_its_table_is_that_of_the_tables():
    said = [line for line in README.splitlines() if re.match(r"\| [a-z]+ \| \d", line)]
    assert said == lines(FOLDER)
    assert len(said) >= 5


@pytest.mark.parametrize("model", ["plain", "extended"])
def test_all_tuners_met_every_system_and_none_failed(model):
    part = TABLE[TABLE["model"] == model]
    assert set(part.groupby("experiment")["tuner"].nunique()) == {9}
    assert part["failures"].sum() == 0


def test_the_range_of_what_the_extension_brings_is_that_of_the_tables():
    for metric, words in (
        ("param_error", "parameter error of `hybrid` falls by a factor of"),
        ("heldout_error", "error in held-out runs by a factor of"),
    ):
        plain, extended = (of(metric, model, "hybrid")["mean"] for model in ("plain", "extended"))
        said = re.search(rf"{words} (\d+) to (\d+)", README)
        factors = plain / extended
        assert [int(text) for text in said.groups()] == [round(f(factors)) for f in (min, max)]


def test_who_leads_and_whether_that_is_chance_are_as_the_ranks_say():
    found = compute_joint_ranks(pd.read_csv(FOLDER / "ranks.csv"), "param_error")
    mean_ranks = found.ranked["extended"].mean()
    assert f"(Friedman test, p = {found.friedman['plain']:.2g})" in README
    assert mean_ranks.idxmin() == "hybrid"
    leading = f"`hybrid` has the best mean rank ({mean_ranks['hybrid']:.1f})"
    second = f"`{FIT}` ({mean_ranks[FIT]:.1f}; p = {found.friedman['extended']:.2g})"
    assert f"{leading}, before {second}" in README


def test_the_ranking_changes_on_every_system():
    ranking = pd.read_csv(FOLDER / "ranking.csv")
    assert (ranking[ranking["metric"] == "param_error"]["p_value"] < 0.01).all()


def test_learned_tuners_and_their_intervals_are_as_measured():
    for (system, tuner), part in pd.read_csv(FOLDER / "learned.csv").groupby(["system", "tuner"]):
        cells = [f"| {system} | {tuner} "]
        for _, row in part.sort_values("randomised").iterrows():
            cells.append(f"| {row['error']:.2g} | {row['half_width']:.2g} | {row['covered']:.0%} ")
        assert "".join(cells) + "|" in README
    half = halves(np.arange(1.0, 61.0)[::-1, None])
    assert half == [55.0], "the ceil(61 x 0.9)-th smallest of 60"
    assert halves(np.ones((5, 1))) == [np.inf], "five errors bound no 90 %"


def test_a_pair_whose_p_value_is_zero_is_significant(monkeypatch):
    p_values = pd.DataFrame([[1.0, 0.0, 0.2], [0.0, 1.0, 0.04], [0.2, 0.04, 1.0]])
    monkeypatch.setattr(
        misspecification_statistics, "compute_nemenyi_p_values", lambda _: (0.01, p_values)
    )
    found = compute_joint_ranks(pd.read_csv(FOLDER / "ranks.csv"), "param_error")
    tuner_count = found.ranked["plain"].shape[1]
    assert tuner_count >= 3
    assert found.distinct_tuner_pairs == {"plain": 2, "extended": 2}
