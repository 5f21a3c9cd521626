"""Interface of an exam: questions, the case of a question, and targets."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

from tests.exams.marking import Mark


class UndrawableError(Exception):
    """A question has no case: no drawing shows the cause, or a model file is missing."""


class Question(ABC):
    """Specification of a case.

    Attributes:
        name: unique name; everything that is drawn follows from it and the seed.
        kind: kind of the case, for example clean, single or double.
        system: system or robot.
        effect: the hidden effect as far as the question states it.
    """

    name: str
    kind: str
    system: str
    effect: str

    @abstractmethod
    def draw(self, seed):
        """Return the `Case`.

        Raises:
            UndrawableError: there is none.
        """


class Case(ABC):
    """A recording with a known cause."""

    @abstractmethod
    def write(self, folder):
        """Write the files of a user into a folder, and return the path of the recording.

        No file reveals the cause.
        """

    @abstractmethod
    def describe(self):
        """Return the cells hidden, size, noise and conditions of the table of answers."""

    @abstractmethod
    def mark(self, outcome) -> Mark:
        """Grade the outcome of a call of `simgap explain`."""

    def answer(self, recording, out, call):
        """Explain the recording and return the `Outcome`."""
        return call(recording, out)


@dataclass(frozen=True)
class Target:
    """Share of good answers that `explain` must reach.

    Attributes:
        description: what counts, in words.
        kind: kind of the cases; None for all that hide a cause.
        level: strict, few, equivalent, fair or any.
        min_share: smallest share; None if only reported.
    """

    description: str
    kind: str | None
    level: str
    min_share: float | None = None


@dataclass(frozen=True)
class Exam:
    """Source of cases.

    Attributes:
        title, about: heading and introduction of the page.
        questions: function from the seed to all questions.
        targets: what `explain` must reach.
        quick: function that returns a few questions, or None.
        spread: function that returns each effect once, or None.
        groups: columns and conditions by which the page counts answers.
        cpu_limit: default limit of a call, processor seconds.
        needs_command: whether it calls the command, not the function.
        quick_share: smallest share of right answers in a quick exam.
    """

    title: str
    about: str
    questions: Callable
    targets: tuple[Target, ...] = ()
    quick: Callable | None = None
    spread: Callable | None = None
    groups: tuple[str, ...] = ("system", "effect", "noise")
    cpu_limit: float = 120.0
    needs_command: bool = False
    quick_share: float = 0.8
