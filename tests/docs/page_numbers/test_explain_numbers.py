"""Tests that the pages on the accuracy of explain agree with their summaries."""

import json
from operator import not_

import pytest

from bench.bounce_shot.hit_rate_table import compute_wilson_interval
from bench.diagnosis.search.verdict_rules import FAULTY, OPEN, VERDICT_MEANINGS
from tests.docs.documentation_pages import quoted, section, tables, text_of
from tests.docs.page_numbers.number_sources import NUMBER, Account
from tests.docs.page_numbers.source_tables import document, frame
from tests.robot_exam import robot_exam_report as robots_report
from tests.simple_exam import exam_report
from tests.simple_exam.exam_summary import share


def percent(share):
    """Return a fraction and its confidence limits in percent."""
    return 100 * share["share"], 100 * share["low"], 100 * share["high"]


def exam():
    """Check results/reference/exam."""
    page = Account("results/reference/exam/README.md")
    summary = document("exam/summary.json")
    items = frame("exam/items.csv")
    page.written(exam_report.page(summary))
    single, double = (
        summary["single"]["named as data tell"],
        summary["double"]["named as data tell"],
    )
    page.says("no false alarm on {} clean recordings", summary["clean"]["alarms"]["of"])
    assert summary["clean"]["alarms"]["count"] == 0
    page.says("finds {} % of single hidden", 100 * single["share"])
    page.says("Of pairs it finds {} of {},", double["count"], double["of"])
    page.says("a median of {} s", summary["seconds"]["median"])
    page.says("the slowest twentieth {} s", summary["seconds"]["p95"])
    amiss = items[(items.part == "marks") & items.outcome.isin(["unnamed", "missed"])]
    sizes = dict(zip(amiss.question.str.split("/").str[3], amiss["size"], strict=True))
    page.says("a flexible joint at {} times", sizes["joint.flexibility"])
    page.says("a ripple at {}, a slip at {},", sizes["force.ripple"], sizes["sensor.slip"])
    page.says("a limit of the input's rate at {}", sizes["input.rate"])
    page.known("All 883 cases were run with one version (d961f13, 56 effects) in 10", "of that day")
    foreign = summary["foreign"]["right"]
    page.says("outside the library all {}.", foreign["of"])
    assert foreign["count"] == foreign["of"]
    return page


def robots():
    """Check results/reference/robots."""
    page = Account("results/reference/robots/README.md")
    summary = document("robots/summary.json")
    page.written(robots_report.page(summary))
    told = frame("robots/items.csv")
    asked = len(told) + len(summary["cannot show"])
    page.says("the sheet of that day {} were asked", asked)
    page.known("Of the 726 questions", "the sheet of that day")
    page.known("with at most 900 s", "how it was asked")
    page.known("(that of 23 November)", "how it was asked")
    page.known("(the last 39 with 1,500)", "how it was asked")
    assert len(summary["failed"]) == 3
    page.known("end in 900 s", "how it was asked")
    between = frame("robots/transmission.csv")
    right, play = between.outcome == "right", between.question.str.contains("backlash")
    drawn = between.outcome != "not drawn"
    page.says("{} of the sheet, `transmission.csv`", len(between))
    page.known("by a library of 24 November", "which library it was")
    page.says("{} of {} are right (one cannot be sampled)", right.sum(), drawn.sum())
    assert len(between) - drawn.sum() == 1
    page.says("Of elastic joints {} of {} are right", right[~play].sum(), (~play).sum())
    page.known("ran into 900 s", "how it was asked")
    page.says("Of backlash {} of {} are right", right[play].sum(), (play & drawn).sum())
    page.says("in {} more it is named together with", (between.outcome == "extra").sum())
    asked_again(page)
    return page


def asked_again(page):
    """Check the statements of the page about again.csv."""
    again = frame("robots/again.csv")
    single = again[(again.kind == "single") & (again.outcome != "not drawn")]
    rubs = again.question.str.contains("friction")
    clean = again[again.kind == "clean"]
    opening = "names {} of {} single causes with their place, and gives no false alarm on {} clean"
    page.says(opening, single.strict.sum(), len(single), len(clean))
    page.known("Library of 25 November", "which library it was")
    page.known("with at most 1,500 s", "how it was asked")
    page.says("in the middle of a step): {} of 740", len(again))
    page.known("of 740 questions of the sheet", "the sheet of that day")
    page.says("{} s of processor time at the median", again.processor.median())
    page.says("single causes {} of {} are named alone", single.strict.sum(), len(single))
    page.says("{} alone or in a set of at most", single.few.sum())
    page.known("a set of at most 4, 151", "`score.FEW`")
    page.says("{} ({} %) alone or in a set whose", single.fair.sum(), 100 * single.fair.mean())
    held, count = again.held.sum(), again.intervals.sum()
    page.says("Of {} intervals {} hold ({} %", count, held, 100 * held / count)
    low, high = (100 * share for share in compute_wilson_interval(int(held), int(count)))
    page.says("%, {} to {})", low, high)
    page.says("frictions {} of {}.", again[rubs].held.sum(), again[rubs].intervals.sum())
    assert (clean.outcome == "right").all()
    page.says("Of {} clean recordings none", len(clean))
    # Upper 95 % confidence limit of a fraction when none of n cases occurs: (1 - fraction)^n =
    # 0.05.
    page.says("fewer than {} %; the goal", 100 * (1 - 0.05 ** (1 / len(clean))))
    page.known("alarm (with 95 % confidence", "as the share below")
    page.known("the goal is 1 %", "issue and page say it")
    page.says("take {} s of processor", clean.processor.median())
    pairs, foreign = (again[again.kind == kind] for kind in ("double", "foreign"))
    count, found = len(pairs), pairs.fair.sum()
    page.says("Of {} pairs {} are right ({} %)", count, found, 100 * found / count)
    page.says("Of {} causes outside the library all {}; the", len(foreign), foreign.fair.sum())
    page.says("the others, {} and {}, would take hours", 36 - len(pairs), 72 - len(foreign))
    page.known("of the iiwa that is 25 % too soft", "what was hidden")
    page.known("(7 to 14 and 45 of its standard deviations)", "of verdicts that are not kept")


def next_recording():
    """Check results/reference/next-recording."""
    page = Account("results/reference/next-recording/README.md")
    sets, fresh = frame("next-recording/sets.csv"), frame("next-recording/fresh.csv")
    told, kept = said(sets), sets.kept & sets.outcome.isin(["settled", "split"])
    page.says("in {} of {} cases, and", (told & kept).sum(), told.sum())
    page.says("`simgap design` | of {} sets |", len(sets))
    page.says("a run distinguishes the causes | {} |", told.sum())
    page.says("and it did, the true cause kept | {} |", (told & kept).sum())
    page.says("this kind distinguishes them | {} |", (~told).sum())
    page.says("of {} {} were predicted to be", len(fresh), said(fresh).sum())
    assert (fresh.kept & (fresh.outcome == "settled"))[said(fresh)].all()
    rest = fresh[~said(fresh)].outcome.value_counts()
    page.says("Of the {} others {} were split", rest.sum(), rest["split"])
    page.says("{} stayed open, none was lost", rest["open"])
    untold = sets[~told]
    page.says(
        "Of these {} one more run still split {}", len(untold), (untold.outcome == "split").sum()
    )
    page.says("{} of delays were lost", (untold.outcome == "lost").sum())
    most = {row.Index: max(json.loads(row.worth).values()) for row in untold.itertuples()}
    tilts = [most[i] for i in untold.index[untold.groups.map(members) == TILT]]
    page.says("a driven pendulum ({})", len(tilts))
    page.says("tilt's square | {} to {} |", min(tilts), max(tilts))
    late = [most[i] for i in untold.index[untold.groups.map(members) <= LATE]]
    page.says("of a few ms ({})", len(late))
    page.says("of that length nearly | {} to {} |", min(late), max(late))
    for words, member in (
        ("on the slider", "wind"),
        ("0.7 %)", "spring.cubic"),
        ("pendulum", "drag.linear"),
    ):
        (worth,) = (most[i] for i in untold.index if member in members(untold.groups[i]))
        page.says(f"{words} | {{}} |", worth)
    page.known("a gain of 0.7 %", "the truth of that question")
    page.known("sampled with seed 0: the first 24", "how it was asked")
    page.known("4 s or up to 20 s", "how it was asked")
    page.known("started up to 1 %", "how it was asked")
    page.known("; 25 squared noises are", "the threshold of design")
    return page


def verdicts():
    """Check docs/verdicts.md."""
    page = Account("docs/verdicts.md")
    exam, again = document("exam/summary.json"), frame("robots/again.csv")
    again = again[again.outcome != "not drawn"]

    def of(kind, how="fair"):
        return share(again[again.kind == kind][how], bool)

    held = [n < row.held for row in again.itertuples() for n in range(row.intervals)]
    counts = {
        "nothing hidden": (exam["clean"]["alarms"], share(again[again.kind == "clean"].fair, not_)),
        "one cause: named, or": (exam["single"]["named as data tell"], of("single")),
        "one cause: named alone": (exam["single"]["named alone"], of("single", "strict")),
        "two causes": (exam["double"]["named as data tell"], of("double")),
        "a cause that": (exam["foreign"]["right"], of("foreign")),
        "95 % intervals": (exam["coverage"]["all"], share(held, bool)),
    }

    def value(row, heading):
        """Return the count, the total, and the percentage and interval if the cell has them."""
        if heading == "":
            return None
        (shares,) = (pair for words, pair in counts.items() if row[""].startswith(words))
        share = shares["robots" in heading]
        numbers = [share["count"], share["of"], *percent(share)]
        return numbers[: len(NUMBER.findall(row[heading]))]

    assert page.table("| [ball", value) == 12 * 2 + 8
    page.known("95 % intervals that contain", "the level")
    page.known("with the library of 25 November", "which library it was")
    page.known("95 % intervals are in brackets", "the level")
    page.known(
        "Above 12,000 samples that lie closer than 10 ms",
        "bench/diagnosis/search/subsampled_search.py",
    )
    page.known("odds of 33 to 1", "held by the thresholds, below")
    return page


TILT = {"gravity.tilt", "sensor.bias"}
LATE = {"input.delay", "input.lag", "sensor.delay", "sensor.lag"}


def members(groups):
    """Return the causes of a set."""
    return set(groups.replace(" | ", "/").split("/"))


def said(sets):
    """Return whether the proposed run was predicted to distinguish all causes of a set."""
    return sets.groups.str.contains("|", regex=False)


PAGES = {"verdicts": verdicts, "exam": exam, "robots": robots, "next-recording": next_recording}


@pytest.mark.parametrize("name", PAGES)
def test_every_number_is_that_of_the_tables(name):
    page = PAGES[name]()
    assert page.wrong == []
    assert page.left() == []


def test_the_words_of_the_verdicts_are_those_of_the_rules():
    first, second = tables(section(text_of("verdicts.md"), "## The six verdicts"))
    assert {quoted(verdict)[0]: says for verdict, says, _ in first[1:]} == VERDICT_MEANINGS
    told = {quoted(verdict)[0]: says for verdict, says, _ in second[1:]}
    assert told == {"partial": OPEN, "unknown": FAULTY}
