"""Tests that the numbers of the board's page are those of its tables."""

import re

import pandas as pd
import pytest

from tests.docs.documentation_pages import ROOT

FOLDER = ROOT / "results/reference/diagnosis"
PAGE = (FOLDER / "README.md").read_text(encoding="utf-8")
TABLE = pd.read_csv(FOLDER / "table.csv")
ITEMS = pd.read_csv(FOLDER / "items.csv")
COLUMNS = (
    "false alarms",
    "named, alone",
    "the same, up to equivalence",
    "pairs: both named",
    "foreign causes: unknown or partial",
    "95 % intervals that hold",
)


def line(diagnoser, metric):
    chosen = TABLE[(TABLE["diagnoser"] == diagnoser) & (TABLE["metric"] == metric)]
    return chosen.iloc[0]


@pytest.mark.parametrize("diagnoser", sorted(TABLE["diagnoser"].unique()))
def test_a_line_of_the_board(diagnoser):
    (row,) = re.findall(rf"^\| {diagnoser} \| (\d.*)=(.*) \|$", PAGE, flags=re.M)
    cells = [cell.strip() for cell in (row[0] + "=" + row[1]).split("|")]
    for cell, metric in zip(cells, COLUMNS, strict=False):
        held = line(diagnoser, metric)
        if not held["of"]:
            assert cell == "–"
            continue
        ends = [f"{100 * held[key]:.0f}" for key in ("share", "low", "high")]
        count = f"{int(held['count'])}/{int(held['of'])}"
        assert cell == f"{count} = {ends[0]} % ({ends[1]} to {ends[2]})"


def test_pairs_of_the_page_are_counted_again():
    found = re.findall(
        r"^\| ([\w-]+) \| (\d+) \| (\d+) \| [\d.e-]+ \| (\d+) \| (\d+) \|", PAGE, re.M
    )
    assert len(found) == 7
    singles = ITEMS[(ITEMS["kind"] == "single") & (ITEMS["size"] >= 1.0)]
    clean = ITEMS[ITEMS["kind"] == "clean"]
    for part, right, places in (
        (singles, "found_class", (1, 2)),
        (clean.assign(quiet=~clean["alarm"]), "quiet", (3, 4)),
    ):
        wide = part.pivot(index="question", columns="diagnoser", values=right)
        for row in found:
            ours = int((wide["simgap"] & ~wide[row[0]]).sum())
            theirs = int((~wide["simgap"] & wide[row[0]]).sum())
            assert (ours, theirs) == (int(row[places[0]]), int(row[places[1]]))


def test_how_many_questions():
    asked = ITEMS["question"].nunique()
    assert f"{asked} of the 654 questions" in PAGE
    assert set(ITEMS.groupby("question")["diagnoser"].nunique()) == {8}


def test_what_simgap_does_not_name_stands_first():
    own = ITEMS[ITEMS["diagnoser"] == "simgap"]
    own = own[(own["kind"] == "single") & (own["size"] >= 1.0)]
    first = PAGE[PAGE.index("## Where simgap fails") : PAGE.index("## Who is good at what")]
    listed = set(re.findall(r"^\| `([^`]+)` \|", first, re.M))
    assert listed == set(own[~own["found_class"]]["question"])
    held = line("simgap", "the same, up to equivalence")
    assert f"Of {int(held['of'])} single effects" in first
    assert f"names {int(held['count'])}, alone" in first


def test_every_count_of_the_page_is_in_a_table():
    """Each text `N of M` is a count of a diagnoser and metric, or of a group."""
    groups = pd.read_csv(FOLDER / "groups.csv")
    known = {
        (int(a), int(b)) for frame in (TABLE, groups) for a, b in frame[["count", "of"]].values
    }
    said = {(int(a), int(b)) for a, b in re.findall(r"\b(\d+) of (\d+)\b", PAGE)}
    assert said <= known
