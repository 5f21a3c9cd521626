"""Tests that the pages on the accuracy of explain agree with their summaries."""

import json

import pytest

from bench.bounce_shot.hit_rate_table import compute_wilson_interval
from bench.diagnosis.search.verdict_rules import FAULTY, OPEN, VERDICT_MEANINGS
from tests.docs.documentation_pages import quoted, section, tables, text_of
from tests.docs.page_numbers.number_sources import NUMBER, Account
from tests.docs.page_numbers.source_tables import REFERENCE, frame
from tests.exams import exam_report
from tests.exams.answer_rows import read_table
from tests.exams.robots import robot_cases
from tests.exams.systems import system_cases


def percent(got):
    """Return a fraction and its confidence limits in percent."""
    return [100 * part for part in got[2:]]


def answers(path):
    """Return the graded answers of a table below results/reference."""
    return exam_report.graded(read_table(REFERENCE / path))


def level(table, kind, name):
    """Return the share of answers of a kind that reach a level, with its interval."""
    return exam_report.share(table[table.kind == kind][name], exact=kind == "clean")


def results(folder, exam):
    """Check the generated part of the page of an exam."""
    page = Account(f"results/reference/{folder}/README.md")
    page.written(exam_report.format_page(exam, read_table(page.path.parent / "items.csv")))
    return page


def exam():
    """Check results/reference/exam."""
    page = results("exam", system_cases.EXAM)
    items = answers("exam/items.csv")
    seconds = exam_report.drawn(read_table(page.path.parent / "items.csv")).wall_s
    alarms, foreign = level(items, "clean", "strict"), level(items, "foreign", "strict")
    double = level(items, "double", "fair")
    page.says("no false alarm on {} clean recordings", alarms[1])
    assert alarms[0] == alarms[1]
    page.says("finds {} % of single hidden", percent(level(items, "single", "fair"))[0])
    page.says("Of pairs it finds {} of {},", *double[:2])
    page.says("a median of {} s", seconds.median())
    page.says("the slowest twentieth {} s", seconds.quantile(0.95))
    amiss = items[items.outcome.isin(["unnamed", "missed"])]
    sizes = dict(zip(amiss.effect, amiss["size"], strict=True))
    page.says("a flexible joint at {} times", sizes["joint.flexibility"])
    page.says("a ripple at {}, a slip at {},", sizes["force.ripple"], sizes["sensor.slip"])
    page.says("a limit of the input's rate at {}", sizes["input.rate"])
    page.known("All 883 cases were run with one version (d961f13, 56 effects) in 10", "of that day")
    page.says("outside the library all {}.", foreign[1])
    assert foreign[0] == foreign[1]
    return page


def robots():
    """Check results/reference/robots."""
    page = results("robots", robot_cases.EXAM)
    told = read_table(REFERENCE / "robots/items.csv")
    page.says("the sheet of that day {} were asked", len(told))
    page.known("Recordings of robots of 2 to 7 joints", "the exam")
    page.known("or in a set of\nat most 4; `fair`".replace("\n", " "), "the exam")
    page.known("(error at most 5 % larger)", "the exam")
    page.known("Of the 726 questions", "the sheet of that day")
    page.known("with at most 900 s", "how it was asked")
    page.known("(that of 23 November)", "how it was asked")
    page.known("(the last 39 with 1,500)", "how it was asked")
    assert (told.outcome == "failed").sum() == 3
    page.known("end in 900 s", "how it was asked")
    between = read_table(REFERENCE / "robots/transmission.csv")
    right, play = between.outcome == "right", between.item.str.contains("backlash")
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
    again = read_table(REFERENCE / "robots/again.csv")
    single = again[(again.kind == "single") & (again.outcome != "not drawn")]
    rubs = again.item.str.contains("friction")
    clean = again[again.kind == "clean"]
    opening = "names {} of {} single causes with their place, and gives no false alarm on {} clean"
    page.says(opening, single.strict.sum(), len(single), len(clean))
    page.known("Library of 25 November", "which library it was")
    page.known("with at most 1,500 s", "how it was asked")
    page.says("in the middle of a step): {} of 740", len(again))
    page.known("of 740 questions of the sheet", "the sheet of that day")
    page.says("{} s of processor time at the median", again.cpu_s.median())
    page.says("single causes {} of {} are named alone", single.strict.sum(), len(single))
    page.says("{} alone or in a set of at most", single.few.sum())
    page.known("a set of at most 4, 151", "`score.FEW`")
    page.says("{} ({} %) alone or in a set whose", single.fair.sum(), 100 * single.fair.mean())
    held, count = again.intervals_held.sum(), again.intervals.sum()
    page.says("Of {} intervals {} hold ({} %", count, held, 100 * held / count)
    low, high = (100 * share for share in compute_wilson_interval(int(held), int(count)))
    page.says("%, {} to {})", low, high)
    page.says("frictions {} of {}.", again[rubs].intervals_held.sum(), again[rubs].intervals.sum())
    assert (clean.outcome == "right").all()
    page.says("Of {} clean recordings none", len(clean))
    # Upper 95 % confidence limit of a fraction when none of n cases occurs: (1 - fraction)^n =
    # 0.05.
    page.says("fewer than {} %; the goal", 100 * (1 - 0.05 ** (1 / len(clean))))
    page.known("alarm (with 95 % confidence", "as the share below")
    page.known("the goal is 1 %", "issue and page say it")
    page.says("take {} s of processor", clean.cpu_s.median())
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
    exam, again = answers("exam/items.csv"), answers("robots/again.csv")

    def pair(kind, name="fair"):
        """Return the shares of both exams."""
        return level(exam, kind, name), level(again, kind, name)

    def covered(table):
        """Return the share of intervals that hold the truth."""
        held, count = int(table.intervals_held.sum()), int(table.intervals.sum())
        return exam_report.share([True] * held + [False] * (count - held))

    # A false alarm is the complement of a right answer.
    alarms = [exam_report.share(~t[t.kind == "clean"].strict, exact) for t, exact in
              ((exam, True), (again, False))]  # fmt: skip
    counts = {
        "nothing hidden": alarms,
        "one cause: named, or": pair("single"),
        "one cause: named alone": pair("single", "strict"),
        "two causes": pair("double"),
        "a cause that": pair("foreign", "strict"),
        "95 % intervals": (covered(exam), covered(again)),
    }

    def value(row, heading):
        """Return the count, the total, and the percentage and interval if the cell has them."""
        if heading == "":
            return None
        (shares,) = (pair for words, pair in counts.items() if row[""].startswith(words))
        got = shares["robots" in heading]
        numbers = [*got[:2], *percent(got)]
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
