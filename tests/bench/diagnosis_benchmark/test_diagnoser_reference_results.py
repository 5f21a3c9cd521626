"""Tests that tables and page of the reference diagnosis benchmark agree with its answers."""

import io
import re

import pandas as pd

from bench.diagnosis_benchmark.diagnoser_training import read_training_costs
from bench.diagnosis_benchmark.result_tables import build_all_tables, read_table
from tests.docs.documentation_pages import ROOT, section

FOLDER = ROOT / "results/reference/diagnosis"
PAGE = (FOLDER / "README.md").read_text(encoding="utf-8")


def test_stored_tables_are_those_of_the_answers():
    answers = read_table(FOLDER, "items")
    order = list(dict.fromkeys(answers["diagnoser"]))
    for name, table in build_all_tables(answers, order, read_training_costs(FOLDER)).items():
        present = pd.read_csv(io.StringIO(table.to_csv(index=False)))
        stored = pd.read_csv(FOLDER / f"{name}.csv")
        pd.testing.assert_frame_equal(stored, present, check_dtype=False, rtol=1e-5)


def test_numbers_of_questions_agree_with_the_answers():
    answers = read_table(FOLDER, "items")
    assert f"{answers['question'].nunique()} of the 654 questions" in PAGE
    assert set(answers.groupby("question")["diagnoser"].nunique()) == {8}


def test_the_section_on_failures_counts_the_causes_that_simgap_names():
    table = pd.read_csv(FOLDER / "table.csv").set_index(["diagnoser", "metric"])
    row = table.loc["simgap", "the same, up to equivalence"]
    failures = section(PAGE, "## Where simgap fails")
    assert f"Of {row['of']:.0f} single effects" in failures
    assert f"names {row['count']:.0f}, alone" in failures
    assert f"`simgap` names {row['count']:.0f} of {row['of']:.0f} single causes" in PAGE


def test_every_count_of_the_page_is_in_a_table():
    """Each text `N of M` is a count of a diagnoser and metric, or of a group."""
    known = {
        (int(count), int(of))
        for name in ("table", "groups")
        for count, of in pd.read_csv(FOLDER / f"{name}.csv")[["count", "of"]].to_numpy()
    }
    written = {(int(count), int(of)) for count, of in re.findall(r"\b(\d+) of (\d+)\b", PAGE)}
    assert written <= known
