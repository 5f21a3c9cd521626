"""When a search has to end, and how far it says it is."""

import pytest

from bench.gap.model import watch as watching
from bench.gap.model.watch import QUESTIONS, WEIGHTS, Cut, EndedError, Watch


class Clock:
    """A clock that stands still unless it is set."""

    now = 100.0

    def monotonic(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    made = Clock()
    monkeypatch.setattr(watching, "time", made)
    return made


def test_a_budget_ends_between_fits_and_within_them(clock):
    watch = Watch(budget=2.0)
    watch.look("scores")
    clock.now += 1.9
    assert not watch.leaves(0.5)
    watch.check()
    clock.now += 0.1
    assert watch.leaves(0.6)
    for ask in (watch.check, lambda: watch.look("more"), lambda: watch.begin("rivals")):
        with pytest.raises(EndedError):
            ask()
    assert watch.left()


def test_without_a_budget_there_is_no_end(clock):
    watch = Watch()
    clock.now += 1e9
    watch.check()
    assert not watch.leaves(0.0)
    assert not watch.left()


def test_an_interrupt_counts_however_often_it_is_asked(clock):
    answers = iter([False, True, False, False])
    watch = Watch(budget=50.0, stop=lambda: next(answers))
    watch.look("refit of drag.linear")
    assert watch.over()
    assert watch.over(), "who has wanted an end still does"
    clock.now += 60.0
    assert watch.cut(held_out=True).by == "interrupt", "the first of two reasons is the reason"


def test_what_was_not_asked_begins_with_the_question_at_hand(clock):
    watch = Watch(budget=1.0)
    assert watch.cut(held_out=True).not_asked == tuple(QUESTIONS)
    watch.begin("search")
    watch.look("refit of drag.linear")
    clock.now += 2.0
    with pytest.raises(EndedError):
        watch.begin("rivals")
    cut = watch.cut(held_out=False)
    assert cut == Cut("budget", "refit of drag.linear", ("rivals", "structure", "alternatives"))
    assert Cut.of(cut.document()) == cut
    assert "held_out" in watch.cut(held_out=True).not_asked


def test_the_share_that_is_done_grows_to_the_whole():
    told = []
    watch = Watch(progress=lambda share, what: told.append((share, what)))
    for question in QUESTIONS:
        watch.begin(question)
        for k in range(20):
            watch.look(f"{question} {k}")
            assert not watch.leaves(0.5)
    shares = [share for share, _ in told]
    assert shares == sorted(shares)
    assert 0.0 <= shares[0] < 0.3
    assert 0.95 < shares[-1] < 1.0
    assert told[-1][1] == "alternatives 19"
    assert list(WEIGHTS) == list(QUESTIONS)


def test_larger_models_are_more_to_do():
    told = []
    watch = Watch(progress=lambda share, what: told.append(share))
    watch.begin("search")
    watch.look("one effect")
    watch.grow()
    watch.look("two effects")
    assert 0 < told[1] < (WEIGHTS["base_fit"] + WEIGHTS["search"]) / sum(WEIGHTS.values())
