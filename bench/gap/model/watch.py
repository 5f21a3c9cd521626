"""When the search has to end, how far it is, and what it was still to ask.

A search ends early in one of two ways. Fits leave off after the step that they are at, and keep the
best point so far (`Watch.leaves`); between fits the search is told by an exception. Whatever may
have been left off is followed by a `Watch.check`, so that nothing half fitted is judged.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from bench.gap.model.progress import ProgressListener, SilentListener

By = Literal["budget", "interrupt"]
Stop = Callable[[], bool]
Progress = Callable[[float, str], None]

QUESTIONS: Mapping[str, str] = {
    "base_fit": "the best fit of the simulator's own parameters",
    "search": "the other effects of the library, and several together",
    "rivals": "whether a rival does better once it is fitted to the end",
    "held_out": "whether held-out runs bear it out",
    "structure": "whether a force of any shape would help still",
    "alternatives": "what would explain the same as well",
}
"""What is asked, in this order, by its name in verdict.json."""

STAGES: Mapping[str, str] = {
    "base_fit": "fitting the base model",
    "search": "testing effects",
    "rivals": "comparing similar causes",
    "held_out": "simulating held-out runs",
    "structure": "testing the residual for structure",
    "alternatives": "looking for alternative causes",
}
"""The stage that each question begins with, as the display of progress names it."""

WEIGHTS: Mapping[str, float] = {
    "base_fit": 1.5,
    "search": 4.0,
    "rivals": 3.0,
    "held_out": 1.0,
    "structure": 0.5,
    "alternatives": 0.5,
}
"""What answering each takes, in seconds of a small recording: the bar is laid out by them."""
LARGER = 6.0
"""The same of models with one more effect."""
STEP = 0.4
"""Share of what is left of a question that each look at it takes, as far as the bar knows."""


@dataclass(frozen=True)
class Cut:
    """That the search was ended early.

    Attributes:
        by: ``budget`` or ``interrupt``.
        during: what was being looked at.
        not_asked: questions without an answer: ``base_fit``, ``search``, ``rivals``, ``held_out``,
            ``structure``, ``alternatives``.
    """

    by: By
    during: str
    not_asked: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """As in verdict.json."""
        return {"by": self.by, "during": self.during, "not_asked": list(self.not_asked)}

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Cut:
        """From verdict.json."""
        return cls(document["by"], document["during"], tuple(document["not_asked"]))


class EndedError(Exception):
    """The search has to end now."""


class Watch:
    """Watches over one search.

    Attributes:
        deadline: on the clock `time.monotonic`, the same in all processes; None without an end.

    Args:
        budget: seconds of the clock after which it ends; None without an end.
        stop: asked between two steps: whether somebody wants an end.
        progress: told the share that is done, as far as can be known, and what is looked at.
        listener: receives the stages, steps and findings of the search.
    """

    def __init__(
        self,
        budget: float | None = None,
        stop: Stop = lambda: False,
        progress: Progress | None = None,
        listener: ProgressListener | None = None,
    ) -> None:
        self.deadline = None if budget is None else time.monotonic() + budget
        self._stop = stop
        self._progress = progress
        self._listener = listener or SilentListener()
        self._by: By | None = None
        self._left = False
        self._what = ""
        self._question = "base_fit"
        # Weights of what is done, of what is at hand, and of what follows.
        self._done, self._now = 0.0, WEIGHTS["base_fit"]
        self._ahead = _after("base_fit")
        self._looks = -1

    def stage(self, name: str, total: int | None = None) -> None:
        """Report the stage that begins, and its number of steps where that is known."""
        self._listener.stage(name, total)

    def advance(self, count: int = 1) -> None:
        """Report further finished steps of the stage."""
        self._listener.advance(count)

    def found(self, effects: Sequence[str], share: float) -> None:
        """Report the best model so far and the share of the gap that it closes."""
        self._listener.found(effects, share)

    def over(self) -> bool:
        """Whether the search has to end; once it has, it does."""
        if self._by is None and self._stop():
            self._by = "interrupt"
        if self._by is None and self.deadline is not None and time.monotonic() >= self.deadline:
            self._by = "budget"
        return self._by is not None

    def begin(self, question: str) -> None:
        """Go on to a question of `QUESTIONS`.

        Raises:
            EndedError: there is no time for it.
        """
        self._enter(WEIGHTS[question])
        self._question = question
        self._ahead = _after(question)
        self.stage(STAGES[question])
        self.look(QUESTIONS[question])

    def grow(self) -> None:
        """Go on to larger models, which nobody could foresee."""
        self._enter(LARGER)

    def _enter(self, weight: float) -> None:
        self._done += self._now
        self._now = weight
        self._looks = -1

    def look(self, what: str) -> None:
        """Tell what is looked at next.

        Raises:
            EndedError: there is no time for it.
        """
        self.check()
        self.tell(what)

    def tell(self, what: str) -> None:
        """Tell what is looked at next, where fits leave off by themselves."""
        self._what = what
        self._looks += 1
        self._advance(0.0)

    def check(self) -> None:
        """See whether what was just done was done to its end.

        Raises:
            EndedError: it may have been left off.
        """
        if self.over():
            raise EndedError

    def leaves(self, share: float) -> bool:
        """Whether a fit has to leave off, of which this share is done."""
        self._advance(share)
        self._left |= self.over()
        return self._left

    def left_off(self, left: bool) -> None:
        """Take into account that a fit was left off in another process."""
        self._left |= left

    def left(self) -> bool:
        """Whether any fit was left off."""
        return self._left

    def cut(self, held_out: bool) -> Cut:
        """What was not asked any more.

        Args:
            held_out: whether there are held-out runs to ask.
        """
        names = list(QUESTIONS)
        open_ones = names[names.index(self._question) :]
        if not held_out:
            open_ones = [name for name in open_ones if name != "held_out"]
        return Cut(self._by or "interrupt", self._what, tuple(open_ones))

    def _advance(self, share: float) -> None:
        remaining = (1.0 - STEP) ** self._looks
        # Looks before this one have taken their shares; a fit is a part of this one's.
        within = 1.0 - remaining * (1.0 - STEP * share)
        total = self._done + self._now + self._ahead
        done = (self._done + self._now * within) / total
        self._listener.completed(done)
        if self._progress is not None:
            self._progress(done, self._what)


def _after(question: str) -> float:
    """Weights of the questions behind one."""
    names = list(QUESTIONS)
    return sum(WEIGHTS[name] for name in names[names.index(question) + 1 :])
