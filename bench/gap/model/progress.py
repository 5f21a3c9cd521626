"""The events by which a search reports its progress.

A search reports events to a `ProgressListener`; a display of progress is one. Neither depends on
the other, so that the same display serves any search.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable


@runtime_checkable
class ProgressListener(Protocol):
    """Receives the events of one search, in the order in which they happen.

    Every method returns quickly, and none raises: a listener never ends or delays a search.
    """

    def stage(self, name: str, total: int | None = None) -> None:
        """Begin a stage, which ends the one before.

        Args:
            name: what is being done, as in ``testing 38 effects``.
            total: number of steps of the stage; None where it is not known.
        """

    def advance(self, count: int = 1) -> None:
        """Finish `count` further steps of the stage."""

    def found(self, effects: Sequence[str], share: float) -> None:
        """Report the best model so far.

        Args:
            effects: names of its effects, as ``friction.coulomb@elbow``.
            share: share of the gap on the fitted runs that it closes, 0 to 1.
        """

    def completed(self, share: float) -> None:
        """Report the estimated share of the whole search that is done, 0 to 1."""


class SilentListener:
    """A `ProgressListener` that ignores all events."""

    def stage(self, name: str, total: int | None = None) -> None:
        """Ignore it."""

    def advance(self, count: int = 1) -> None:
        """Ignore it."""

    def found(self, effects: Sequence[str], share: float) -> None:
        """Ignore it."""

    def completed(self, share: float) -> None:
        """Ignore it."""
