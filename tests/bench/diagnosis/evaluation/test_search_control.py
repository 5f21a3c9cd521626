"""Tests of the deadline and the progress of a search."""

import pytest

from bench.diagnosis.evaluation import search_control as watching
from bench.diagnosis.evaluation.search_control import (
    QUESTION_SECONDS,
    QUESTION_TEXTS,
    EarlyStop,
    SearchControl,
    SearchStoppedError,
)


class Clock:
    """Clock that changes only when a test sets it."""

    now = 100.0

    def monotonic(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    made = Clock()
    monkeypatch.setattr(watching, "time", made)
    return made


def test_a_budget_ends_between_fits_and_within_them(clock):
    watch = SearchControl(budget=2.0)
    watch.report_and_check("scores")
    clock.now += 1.85
    assert not watch.should_abandon_fit(0.5)
    watch.check_not_stopped()
    # The last 7 % are kept for the validation.
    clock.now += 0.02
    assert watch.should_abandon_fit(0.6)
    for ask in (
        watch.check_not_stopped,
        lambda: watch.report_and_check("more"),
        lambda: watch.begin_question("rivals"),
    ):
        with pytest.raises(SearchStoppedError):
            ask()
    assert watch.has_abandoned_fits()


def test_without_a_budget_there_is_no_end(clock):
    watch = SearchControl()
    clock.now += 1e9
    watch.check_not_stopped()
    assert not watch.should_abandon_fit(0.0)
    assert not watch.has_abandoned_fits()


def test_an_interrupt_counts_however_often_it_is_asked(clock):
    answers = iter([False, True, False, False])
    watch = SearchControl(budget=50.0, stop=lambda: next(answers))
    watch.report_and_check("refit of drag.linear")
    assert watch.should_stop()
    assert watch.should_stop(), "who has wanted an end still does"
    clock.now += 60.0
    assert watch.make_early_stop(held_out=True).reason == "interrupt", (
        "the first of two reasons is the reason"
    )


def test_what_was_not_asked_begins_with_the_question_at_hand(clock):
    watch = SearchControl(budget=1.0)
    assert watch.make_early_stop(held_out=True).skipped_questions == tuple(QUESTION_TEXTS)
    watch.begin_question("search")
    watch.report_and_check("refit of drag.linear")
    clock.now += 2.0
    with pytest.raises(SearchStoppedError):
        watch.begin_question("rivals")
    cut = watch.make_early_stop(held_out=False)
    assert cut == EarlyStop(
        "budget", "refit of drag.linear", ("rivals", "structure", "alternatives")
    )
    assert EarlyStop.from_document(cut.to_document()) == cut
    assert "held_out" in watch.make_early_stop(held_out=True).skipped_questions


def test_the_share_that_is_done_grows_to_the_whole():
    told = []
    watch = SearchControl(progress=lambda share, what: told.append((share, what)))
    for question in QUESTION_TEXTS:
        watch.begin_question(question)
        for k in range(20):
            watch.report_and_check(f"{question} {k}")
            assert not watch.should_abandon_fit(0.5)
    shares = [share for share, _ in told]
    assert shares == sorted(shares)
    assert 0.0 <= shares[0] < 0.3
    assert 0.95 < shares[-1] < 1.0
    assert told[-1][1] == "alternatives 19"
    assert list(QUESTION_SECONDS) == list(QUESTION_TEXTS)


def test_larger_models_are_more_to_do():
    told = []
    watch = SearchControl(progress=lambda share, what: told.append(share))
    watch.begin_question("search")
    watch.report_and_check("one effect")
    watch.begin_larger_models()
    watch.report_and_check("two effects")
    assert (
        0
        < told[1]
        < (QUESTION_SECONDS["base_fit"] + QUESTION_SECONDS["search"])
        / sum(QUESTION_SECONDS.values())
    )


def test_a_part_of_the_budget_is_left_for_validation(clock):
    watch = SearchControl(budget=100.0)
    clock.now += 92.9
    assert not watch.should_stop()
    clock.now += 0.2
    assert watch.should_abandon_fit(0.5)
    with watch.use_reserve():
        assert not watch.is_over()
        clock.now += 7.0
        assert watch.should_stop()
    assert watch.is_over()
    assert watch.make_early_stop(held_out=True).reason == "budget"


def test_an_interrupt_leaves_no_time_for_validation(clock):
    watch = SearchControl(budget=100.0, stop=lambda: True)
    assert watch.should_stop()
    with watch.use_reserve():
        assert watch.should_stop()
