"""Tests that the first pages display results that agree with the reference results."""

from tests.docs.documentation_pages import blocks, section, text_of
from tests.docs.page_numbers.number_sources import Account
from tests.docs.page_numbers.source_tables import REFERENCE, document, frame, rows

ROBOT = REFERENCE / "robot-example"


def test_the_readme_says_what_the_tables_say():
    page = Account("README.md")
    status = frame("ball-drop/status.csv")
    targets = status[status.target.str.startswith("in-")].target.nunique()
    page.says("{} targets in each panel", targets)
    page.says("budget {}, two trainings", status.simulations.max())
    assert status.seed.nunique() == 2
    page.known("Python 3.10 to 3.13", "pyproject.toml and the lock")
    page.known("1.1 GB in place of 3.8 GB", "docs/installation.md")
    page.known("(40 lines)", "the examples")
    page.known("an effect (15 lines)", "the examples")
    assert page.wrong == []
    assert page.left() == []


def test_the_robot_of_the_page_is_the_one_that_is_kept():
    verdict = document("robot-example/verdict.json")
    (cause,) = verdict["causes"]
    held, number = verdict["heldout"], cause["coefficients"]["coefficient"]
    part = section(text_of("robots.md"), "## The example")
    (_, printed), *_ = [block for block in blocks(part, "text") if "closes" in block[1]]
    page = Account("docs/robots.md", printed)
    closed = [100 * held[key] for key in ("gap_closed", "low", "high")]
    page.says("It closes {} % of the gap ({} to {} %)", *closed)
    page.says("(RMSE) is {} rad before and {} rad after", held["rmse_base"], held["rmse_extended"])
    page.says("noise would leave {} rad", held["noise_floor"])
    page.says("coefficient {} ({} to {}) N·m", *(number[key] for key in ("value", "low", "high")))
    page.known("p < 1×10", "the least that is told")
    assert page.wrong == []
    assert page.left() == []
    (_, lines), *_ = blocks(part, "xml")
    kept = (ROBOT / "extended.xml").read_text(encoding="utf-8")
    assert len(lines.splitlines()) == 2
    assert [line for line in lines.splitlines() if line not in kept] == []


def test_the_page_on_films_says_what_the_tracker_reached():
    text = "\n" + section(text_of("video.md"), "## Accuracy").partition("Half of all")[2]
    page = Account("docs/video.md", f"Half of all{text[1:]}")
    (every,) = rows("tracker/table.csv", by="all").itertuples()
    (long,) = rows("tracker/table-400.csv", by="all").itertuples()
    page.says("are within {} px of the truth", every.median_px)
    page.says("over all frames is {} px ({} px in", every.rms_px, long.rms_px)
    page.says("{} % of the frames with", 100 * every.missed_of_whole_balls)
    page.says("not measured ({} % in the long", 100 * long.missed_of_whole_balls)
    page.says("over the {} films of", every.drops)
    page.known("films of 120 frames)", "the benchmark")
    page.known("On 40 films of `ball-drop-video`, with 26", "of a run that is not kept")
    page.known("more than 5 px off", "of a run that is not kept")
    page.known("330 to 340 frames a second", "the clock of that day")
    page.known("slower, 0.6 times", "the clock of another day")
    assert page.wrong == []
    assert page.left() == []
