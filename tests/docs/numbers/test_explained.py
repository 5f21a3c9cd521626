"""The pages on how often explain is right say what the summaries beside them say."""

import json
from operator import not_

import pytest

from bench.gap.causes.rules import FAULTY, MEANING, OPEN
from bench.shot.table import wilson
from tests.docs.numbers.account import NUMBER, Account
from tests.docs.numbers.tables import document, frame
from tests.docs.pages import quoted, section, tables, text_of
from tests.exam import report as exam_report
from tests.exam.summary import share
from tests.robots import report as robots_report


def percent(share):
    """A share as the pages say it, and as they bound it."""
    return 100 * share["share"], 100 * share["low"], 100 * share["high"]


def exam():
    """results/reference/exam."""
    page = Account("results/reference/exam/README.md")
    summary = document("exam/summary.json")
    items = frame("exam/items.csv")
    page.written(exam_report.page(summary))
    single, double = (
        summary["single"]["named as data tell"],
        summary["double"]["named as data tell"],
    )
    page.says("no alarm (none of {})", summary["clean"]["alarms"]["of"])
    assert summary["clean"]["alarms"]["count"] == 0
    page.says("Of single causes {} %", 100 * single["share"])
    page.says("of pairs {} of {} (", double["count"], double["of"])
    page.says("a median of {} s", summary["seconds"]["median"])
    page.says("the slowest twentieth {} s", summary["seconds"]["p95"])
    amiss = items[(items.part == "marks") & items.outcome.isin(["unnamed", "missed"])]
    sizes = dict(zip(amiss.question.str.split("/").str[3], amiss["size"], strict=True))
    page.says("a flexible joint at {} times", sizes["joint.flexibility"])
    page.says("a ripple at {}, a slip at {},", sizes["force.ripple"], sizes["sensor.slip"])
    page.says("a limit of the input's rate at {}", sizes["input.rate"])
    page.known("All 883 questions, asked of one version (d961f13, 56 effects) in 10", "of that day")
    for before in (
        "with 55 effects (d4ff51a, 873 questions), and with 42 before",
        "(98.6 % with 55, 98.9 with 42)",
        "(41 and 43; other pairs",
        "all 48 (46)",
        "(0.7 and 4.4 with 55 effects)",
    ):
        page.known(before, "of the exams before, which are not kept")
    return page


def robots():
    """results/reference/robots."""
    page = Account("results/reference/robots/README.md")
    summary = document("robots/summary.json")
    page.written(robots_report.page(summary))
    told = frame("robots/items.csv")
    asked = len(told) + len(summary["cannot show"])
    page.says("sheet {}, in an order", asked)
    page.known("Of the 726 questions", "the sheet of that day")
    page.known("with 900 s at most", "how it was asked")
    page.known("(that of 23 November)", "how it was asked")
    page.known("(the last 39 with 1,500)", "how it was asked")
    assert len(summary["failed"]) == 3
    page.known("end in 900 s", "how it was asked")
    page.known("the library of 24 November", "which has not been asked yet")
    between = frame("robots/transmission.csv")
    right, play = between.outcome == "right", between.question.str.contains("backlash")
    drawn = between.outcome != "not drawn"
    page.says("{} of the sheet, `transmission.csv`", len(between))
    page.known("of later on 24 November", "which library it was")
    page.says("{} of {} right (one cannot be drawn)", right.sum(), drawn.sum())
    assert len(between) - drawn.sum() == 1
    page.says("of elastic joints\n{} of {}; before", right[~play].sum(), (~play).sum())
    page.known("ran into 900 s", "how it was asked")
    page.says("Of play {} of {} are right", right[play].sum(), (play & drawn).sum())
    page.says("of {} more it is named, and beside", (between.outcome == "extra").sum())
    asked_again(page)
    return page


def asked_again(page):
    """What the page says of again.csv."""
    again = frame("robots/again.csv")
    single = again[(again.kind == "single") & (again.outcome != "not drawn")]
    rubs = again.question.str.contains("friction")
    page.known("By the library of 25 November", "which library it was")
    page.known("with 1,500 s at most", "how it was asked")
    page.says("as in the middle of a step) {} of the 740", len(again))
    page.known("of the 740 questions of today's sheet", "the sheet of that day")
    page.says("{} s of a processor at the median", again.processor.median())
    page.says("single causes\n{} of {} are named alone", single.strict.sum(), len(single))
    page.says("{} alone or in a set of at most", single.few.sum())
    page.known("a set of at most 4, 151", "`score.FEW`")
    page.says("{} ({} %) alone or in a set whose", single.fair.sum(), 100 * single.fair.mean())
    held, count = again.held.sum(), again.intervals.sum()
    page.says("of {} intervals {} hold ({} %", count, held, 100 * held / count)
    low, high = (100 * share for share in wilson(int(held), int(count)))
    page.says("%, {} to {}: the mark", low, high)
    page.says("frictions {} of {}, where", again[rubs].held.sum(), again[rubs].intervals.sum())
    page.known("where it had been 78 %", "of the exam before")
    clean = again[again.kind == "clean"]
    assert (clean.outcome == "right").all()
    page.says("Of {} clean recordings none", len(clean))
    # what none of n says with 95 % confidence: (1 - share)^n = 0.05
    page.says("they are fewer than {} %, where", 100 * (1 - 0.05 ** (1 / len(clean))))
    page.known("an alarm: with 95 % confidence", "as the share below")
    page.known("where 1 % is the mark", "issue and page say it")
    page.says("are answered in {} s of", clean.processor.median())
    pairs, foreign = (again[again.kind == kind] for kind in ("double", "foreign"))
    count, found = len(pairs), pairs.fair.sum()
    page.says("Of {} pairs {} are right ({} %)", count, found, 100 * found / count)
    page.says("of {} foreign causes, taken in no order, {}; the", len(foreign), foreign.fair.sum())
    page.says("the others, {} and {}, take hours", 36 - len(pairs), 72 - len(foreign))
    page.known("of the iiwa that is 25 % too soft", "what was hidden")
    page.known("(7 to 14 and 45 of its standard deviations)", "of verdicts that are not kept")


def next_recording():
    """results/reference/next-recording."""
    page = Account("results/reference/next-recording/README.md")
    sets, fresh = frame("next-recording/sets.csv"), frame("next-recording/fresh.csv")
    told, kept = said(sets), sets.kept & sets.outcome.isin(["settled", "split"])
    page.says("of {} sets |", len(sets))
    page.says("said to be told | 12 | {} |", told.sum())
    page.known("| said to be told | 12", "of the code before")
    page.says("and told, the truth kept | 5 | {} |", (told & kept).sum())
    page.known("and told, the truth kept | 5", "of the code before")
    page.says("no run of this kind | 12 | {} |", (~told).sum())
    page.known("by no run of this kind | 12", "of the code before")
    page.says("of {} {} were said to be told", len(fresh), said(fresh).sum())
    assert (fresh.kept & (fresh.outcome == "settled"))[said(fresh)].all()
    rest = fresh[~said(fresh)].outcome.value_counts()
    page.says("of the {} that no run was said", rest.sum())
    page.says("to tell {} were split", rest["split"])
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
    page.known("drawn by seed 0, the first 24", "how it was asked")
    page.known("4 s or up to 20 s", "how it was asked")
    page.known("begun up to 1 %", "how it was asked")
    page.known("of the 25 squared noises", "the threshold of design")
    return page


def verdicts():
    """docs/verdicts.md."""
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
        """Count, of how many, and what else the cell has: percent, and its interval."""
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
    page.known("Above 12,000 samples that lie closer than 10 ms", "bench/gap/causes/foresee.py")
    page.known("odds of 33 to 1", "held by the thresholds, below")
    return page


TILT = {"gravity.tilt", "sensor.bias"}
LATE = {"input.delay", "input.lag", "sensor.delay", "sensor.lag"}


def members(groups):
    """The causes of a set."""
    return set(groups.replace(" | ", "/").split("/"))


def said(sets):
    """Whether the proposed run was said to tell all of a set apart."""
    return sets.groups.str.contains("|", regex=False)


PAGES = {"verdicts": verdicts, "exam": exam, "robots": robots, "next-recording": next_recording}


@pytest.mark.parametrize("name", PAGES)
def test_every_number_is_that_of_the_tables(name):
    page = PAGES[name]()
    assert page.wrong == []
    assert page.left() == []


def test_the_words_of_the_verdicts_are_those_of_the_rules():
    first, second = tables(section(text_of("verdicts.md"), "## The six verdicts"))
    assert {quoted(verdict)[0]: says for verdict, says, _ in first[1:]} == MEANING
    told = {quoted(verdict)[0]: says for verdict, says, _ in second[1:]}
    assert told == {"partial": OPEN, "unknown": FAULTY}
