"""Deadline, interruption and progress of a search, and the questions that it has not answered.

A search reports events to a `ProgressListener`, for example a progress display. The search and the
display do not depend on each other, so one display serves every search.

A search ends early in one of two ways. A fit stops after its present step and keeps the best point
so far (`SearchControl.should_abandon_fit`). Between fits, an exception ends the search.
`SearchControl.check_not_stopped` follows every
computation that may have been stopped, so an incomplete fit is never evaluated.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal, Protocol, runtime_checkable

from sims.core.json_documents import Document


@runtime_checkable
class ProgressListener(Protocol):
    """Receives the events of one search in the order in which they happen.

    Every method returns quickly and never raises: a listener must not end or delay a search.
    """

    def stage(self, name: str, total: int | None = None) -> None:
        """Begin a stage, which ends the previous one.

        Args:
            name: description of the stage, such as ``testing 38 effects``.
            total: number of steps of the stage; None if unknown.
        """

    def advance(self, count: int = 1) -> None:
        """Report `count` further finished steps of the stage."""

    def found(self, effects: Sequence[str], share: float) -> None:
        """Report the best model so far.

        Args:
            effects: names of its effects, such as ``friction.coulomb@elbow``.
            share: share of the discrepancy on the fitted runs that the model removes, 0 to 1.
        """

    def completed(self, share: float) -> None:
        """Report the estimated share of the whole search that is finished, 0 to 1."""


class SilentListener:
    """A `ProgressListener` that ignores all events."""

    def stage(self, name: str, total: int | None = None) -> None:
        """Ignore the event.

        Args:
            name: unused.
            total: unused.
        """

    def advance(self, count: int = 1) -> None:
        """Ignore the event."""

    def found(self, effects: Sequence[str], share: float) -> None:
        """Ignore the event.

        Args:
            effects: unused.
            share: unused.
        """

    def completed(self, share: float) -> None:
        """Ignore the event."""


StopReason = Literal["budget", "interrupt"]
StopCallback = Callable[[], bool]
ProgressCallback = Callable[[float, str], None]

QUESTION_TEXTS: Mapping[str, str] = {
    "base_fit": "the best fit of the simulator's own parameters",
    "search": "the other effects of the library, alone and combined",
    "rivals": "the full fits of similar causes",
    "held_out": "the validation on held-out runs",
    "structure": "the test for unmodelled forces",
    "alternatives": "the search for alternative causes",
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

QUESTION_SECONDS: Mapping[str, float] = {
    "base_fit": 1.5,
    "search": 4.0,
    "rivals": 3.0,
    "held_out": 1.0,
    "structure": 0.5,
    "alternatives": 0.5,
}
"""Time to answer each question, in seconds for a small recording; it scales the progress bar."""
LARGER_MODEL_SECONDS = 6.0
"""Time to search models with one more effect, in seconds for a small recording."""
VALIDATION_RESERVE = 0.07
"""Share of the time limit that is kept for predicting held-out runs with the best model so far."""
PROGRESS_STEP_SHARE = 0.4
"""Share of the remaining progress of a question that each step is assumed to take."""


@dataclass(frozen=True)
class EarlyStop(Document):
    """Early end of a search, as in verdict.json.

    Attributes:
        reason: ``budget`` or ``interrupt``.
        during_question: the step that was running.
        skipped_questions: questions without an answer: ``base_fit``, ``search``, ``rivals``,
            ``held_out``, ``structure``, ``alternatives``.
    """

    reason: StopReason = field(metadata={"key": "by"})
    during_question: str = field(metadata={"key": "during"})
    skipped_questions: tuple[str, ...] = field(metadata={"key": "not_asked"})


class SearchStoppedError(Exception):
    """Raised when the search has to end now."""


class SearchControl:
    """Deadline and progress of one search.

    Attributes:
        deadline: end of the search on the clock `time.monotonic`, which all processes share; None
            for no limit. A part of the time limit is left (`use_reserve`).
    """

    def __init__(
        self,
        budget: float | None = None,
        stop: StopCallback = lambda: False,
        progress: ProgressCallback | None = None,
        listener: ProgressListener | None = None,
    ) -> None:
        """Set the deadline, and start the progress estimate at the fit of the base model.

        A search answers a sequence of questions, such as ``base_fit``. Each has a weight, its usual
        duration in seconds, from which the finished share is estimated.

        Args:
            budget: wall-clock time limit in seconds; None for no limit.
            stop: callback that returns whether the user wants to stop; called between two steps.
            progress: callback that receives the estimated finished share and the current step.
            listener: receives the stages, steps and results of the search.
        """
        self.deadline: float | None = None
        self._reserve = 0.0
        if budget is not None:
            self._reserve = VALIDATION_RESERVE * budget
            self.deadline = time.monotonic() + budget - self._reserve
        self._stop = stop
        self._progress = progress
        self._listener = listener or SilentListener()
        self._stop_reason: StopReason | None = None
        self._has_abandoned_fits = False
        self._step_text = ""
        self._question = "base_fit"
        # Weights of finished questions, of the present question, and of the later ones. The first
        # step of a question is not finished when it is reported, so the count begins at -1.
        self._finished_weight, self._current_weight = 0.0, QUESTION_SECONDS["base_fit"]
        self._later_weight = _list_later_weights("base_fit")
        self._finished_steps = -1

    def begin_stage(self, name: str, total: int | None = None) -> None:
        """Report the start of a stage.

        Args:
            name: description of the stage.
            total: number of steps of the stage; None if unknown.
        """
        self._listener.stage(name, total)

    def advance(self, count: int = 1) -> None:
        """Report further finished steps of the stage."""
        self._listener.advance(count)

    def report_best_model(self, effects: Sequence[str], share: float) -> None:
        """Report the best model so far.

        Args:
            effects: names of its effects.
            share: share of the discrepancy that the model removes, 0 to 1.
        """
        self._listener.found(effects, share)

    def should_stop(self) -> bool:
        """Return whether the search has to end, because the user stops it or at the deadline.

        Once true, it stays true.
        """
        if self._stop_reason is None and self._stop():
            self._stop_reason = "interrupt"
        if (
            self._stop_reason is None
            and self.deadline is not None
            and time.monotonic() >= self.deadline
        ):
            self._stop_reason = "budget"
        return self._stop_reason is not None

    def begin_question(self, question: str) -> None:
        """Begin a question of `QUESTION_TEXTS`.

        Raises:
            SearchStoppedError: the search has to end.
        """
        self._enter_part(QUESTION_SECONDS[question])
        self._question = question
        self._later_weight = _list_later_weights(question)
        self.begin_stage(STAGES[question])
        self.report_and_check(QUESTION_TEXTS[question])

    def begin_larger_models(self) -> None:
        """Begin the search of larger models, whose number cannot be predicted."""
        self._enter_part(LARGER_MODEL_SECONDS)

    def _enter_part(self, weight: float) -> None:
        """Move the progress to a part of the search with the given weight."""
        self._finished_weight += self._current_weight
        self._current_weight = weight
        self._finished_steps = -1

    def report_and_check(self, step_text: str) -> None:
        """Report the next step, and check that the search may continue.

        Raises:
            SearchStoppedError: the search has to end.
        """
        self.check_not_stopped()
        self.report(step_text)

    def report(self, step_text: str) -> None:
        """Report the next step without a check, where fits stop by themselves."""
        self._step_text = step_text
        self._finished_steps += 1
        self._report_progress(0.0)

    def check_not_stopped(self) -> None:
        """Raise an error if the last computation may have been stopped early.

        Raises:
            SearchStoppedError: the search has to end.
        """
        if self.should_stop():
            raise SearchStoppedError

    def should_abandon_fit(self, share: float) -> bool:
        """Report the progress of a fit, and return whether it has to stop now.

        Once a fit has been stopped, all later fits are stopped, too.

        Args:
            share: share of the fit that is finished, 0 to 1.
        """
        self._report_progress(share)
        self._has_abandoned_fits |= self.should_stop()
        return self._has_abandoned_fits

    def record_abandoned_fit(self, is_abandoned: bool) -> None:
        """Record whether a fit was stopped in another process."""
        self._has_abandoned_fits |= is_abandoned

    def has_abandoned_fits(self) -> bool:
        """Return whether any fit was stopped early."""
        return self._has_abandoned_fits

    def is_over(self) -> bool:
        """Return whether the search has to end, so that no further fits or filters are started."""
        return self._has_abandoned_fits or self.should_stop()

    @contextmanager
    def use_reserve(self) -> Iterator[None]:
        """Continue a search that its time limit ended, until the reserve is used up.

        The reserve is the part of the time limit after the deadline of the search, for the
        validation of its result. A search that the user ended is not continued. Afterwards the
        search is over as before.
        """
        state = self.deadline, self._stop_reason, self._has_abandoned_fits
        if self.deadline is not None:
            self.deadline += self._reserve
        # If the user has stopped the search, `should_stop` detects this again by its callback.
        self._stop_reason, self._has_abandoned_fits = None, False
        try:
            yield
        finally:
            self.deadline, self._stop_reason, self._has_abandoned_fits = state

    def make_early_stop(self, held_out: bool) -> EarlyStop:
        """Return the reason of the early end and the questions that were skipped.

        Args:
            held_out: whether there are held-out runs.
        """
        # The present question and all later ones.
        names = list(QUESTION_TEXTS)
        skipped_questions = names[names.index(self._question) :]
        if not held_out:
            skipped_questions = [name for name in skipped_questions if name != "held_out"]
        return EarlyStop(
            self._stop_reason or "interrupt", self._step_text, tuple(skipped_questions)
        )

    def _report_progress(self, share: float) -> None:
        """Estimate and report the finished share of the search.

        A question has an unknown number of steps, each of which is assumed to take the same share
        of what remains of the question. The weight of a question is its usual duration.

        Args:
            share: finished share of the present step, 0 to 1.
        """
        # Each step takes the share `PROGRESS_STEP_SHARE` of what remains. First the part of the
        # question that remains after the finished steps, then the finished part, with that of the
        # present step.
        remaining_share = (1.0 - PROGRESS_STEP_SHARE) ** self._finished_steps
        finished_share = 1.0 - remaining_share * (1.0 - PROGRESS_STEP_SHARE * share)
        total_weight = self._finished_weight + self._current_weight + self._later_weight
        finished_weight = self._finished_weight + self._current_weight * finished_share
        total_share = finished_weight / total_weight
        self._listener.completed(total_share)
        if self._progress is not None:
            self._progress(total_share, self._step_text)


def _list_later_weights(question: str) -> float:
    """Return the total weight of the questions after the given one."""
    names = list(QUESTION_TEXTS)
    return sum(QUESTION_SECONDS[name] for name in names[names.index(question) + 1 :])
