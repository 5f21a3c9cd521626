"""Events with which a search reports its progress.

A search reports events to a `ProgressListener`, for example a progress display. The search and the
display do not depend on each other, so one display serves every search.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable


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
        """Ignore the event."""

    def advance(self, count: int = 1) -> None:
        """Ignore the event."""

    def found(self, effects: Sequence[str], share: float) -> None:
        """Ignore the event."""

    def completed(self, share: float) -> None:
        """Ignore the event."""
