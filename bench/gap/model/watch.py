"""Deadline, interruption and progress of a search, and the questions that it has not answered.

A search ends early in one of two ways. A fit stops after its present step and keeps the best point
so far (`Watch.leaves`). Between fits, an exception ends the search. `Watch.check` follows every
computation that may have been stopped, so an incomplete fit is never evaluated.
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
"""Questions of a search in their order, by their name in verdict.json."""

STAGES: Mapping[str, str] = {
    "base_fit": "fitting the base model",
    "search": "testing effects",
    "rivals": "comparing similar causes",
    "held_out": "simulating held-out runs",
    "structure": "testing the residual for structure",
    "alternatives": "looking for alternative causes",
}
"""Name of the first stage of each question, as the progress display shows it."""

WEIGHTS: Mapping[str, float] = {
    "base_fit": 1.5,
    "search": 4.0,
    "rivals": 3.0,
    "held_out": 1.0,
    "structure": 0.5,
    "alternatives": 0.5,
}
"""Time to answer each question, in seconds for a small recording; it scales the progress bar."""
LARGER = 6.0
"""Time to search models with one more effect, in seconds for a small recording."""
STEP = 0.4
"""Share of the remaining progress of a question that each step is assumed to take."""


@dataclass(frozen=True)
class Cut:
    """Early end of a search.

    Attributes:
        by: reason, ``budget`` or ``interrupt``.
        during: the step that was running.
        not_asked: questions without an answer: ``base_fit``, ``search``, ``rivals``, ``held_out``,
            ``structure``, ``alternatives``.
    """

    by: By
    during: str
    not_asked: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """Return the entry of verdict.json."""
        return {"by": self.by, "during": self.during, "not_asked": list(self.not_asked)}

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Cut:
        """Create an instance from the entry of verdict.json."""
        return cls(document["by"], document["during"], tuple(document["not_asked"]))


class EndedError(Exception):
    """Raised when the search has to end now."""


class Watch:
    """Deadline and progress of one search.

    Attributes:
        deadline: end of the search on the clock `time.monotonic`, which all processes share; None
            for no limit.

    Args:
        budget: wall-clock time limit in seconds; None for no limit.
        stop: callback that returns whether the user wants to stop; called between two steps.
        progress: callback that receives the estimated finished share and the current step.
        listener: receives the stages, steps and results of the search.
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
        # Weights of finished questions, of the present question, and of the later ones.
        self._done, self._now = 0.0, WEIGHTS["base_fit"]
        self._ahead = _after("base_fit")
        self._looks = -1

    def stage(self, name: str, total: int | None = None) -> None:
        """Report the start of a stage.

        Args:
            name: description of the stage.
            total: number of steps of the stage; None if unknown.
        """
        self._listener.stage(name, total)

    def advance(self, count: int = 1) -> None:
        """Report further finished steps of the stage."""
        self._listener.advance(count)

    def found(self, effects: Sequence[str], share: float) -> None:
        """Report the best model so far.

        Args:
            effects: names of its effects.
            share: share of the discrepancy that the model removes, 0 to 1.
        """
        self._listener.found(effects, share)

    def over(self) -> bool:
        """Return whether the search has to end; once true, it stays true."""
        if self._by is None and self._stop():
            self._by = "interrupt"
        if self._by is None and self.deadline is not None and time.monotonic() >= self.deadline:
            self._by = "budget"
        return self._by is not None

    def begin(self, question: str) -> None:
        """Begin a question of `QUESTIONS`.

        Raises:
            EndedError: the search has to end.
        """
        self._enter(WEIGHTS[question])
        self._question = question
        self._ahead = _after(question)
        self.stage(STAGES[question])
        self.look(QUESTIONS[question])

    def grow(self) -> None:
        """Begin the search of larger models, whose number cannot be predicted."""
        self._enter(LARGER)

    def _enter(self, weight: float) -> None:
        """Move the progress to a part of the search with the given weight."""
        self._done += self._now
        self._now = weight
        self._looks = -1

    def look(self, what: str) -> None:
        """Report the next step, and check that the search may continue.

        Raises:
            EndedError: the search has to end.
        """
        self.check()
        self.tell(what)

    def tell(self, what: str) -> None:
        """Report the next step without a check, where fits stop by themselves."""
        self._what = what
        self._looks += 1
        self._advance(0.0)

    def check(self) -> None:
        """Raise an error if the last computation may have been stopped early.

        Raises:
            EndedError: the search has to end.
        """
        if self.over():
            raise EndedError

    def leaves(self, share: float) -> bool:
        """Return whether a fit has to stop now.

        Args:
            share: share of the fit that is finished, 0 to 1.
        """
        self._advance(share)
        self._left |= self.over()
        return self._left

    def left_off(self, left: bool) -> None:
        """Record whether a fit was stopped in another process."""
        self._left |= left

    def left(self) -> bool:
        """Return whether any fit was stopped early."""
        return self._left

    def cut(self, held_out: bool) -> Cut:
        """Return the reason of the early end and the questions that were skipped.

        Args:
            held_out: whether there are held-out runs.
        """
        names = list(QUESTIONS)
        open_ones = names[names.index(self._question) :]
        if not held_out:
            open_ones = [name for name in open_ones if name != "held_out"]
        return Cut(self._by or "interrupt", self._what, tuple(open_ones))

    def _advance(self, share: float) -> None:
        """Report the finished share of the search.

        Args:
            share: finished share of the present fit, 0 to 1.
        """
        remaining = (1.0 - STEP) ** self._looks
        # Earlier steps have taken their shares; the fit is a part of the present step.
        within = 1.0 - remaining * (1.0 - STEP * share)
        total = self._done + self._now + self._ahead
        done = (self._done + self._now * within) / total
        self._listener.completed(done)
        if self._progress is not None:
            self._progress(done, self._what)


def _after(question: str) -> float:
    """Return the total weight of the questions after the given one."""
    names = list(QUESTIONS)
    return sum(WEIGHTS[name] for name in names[names.index(question) + 1 :])
