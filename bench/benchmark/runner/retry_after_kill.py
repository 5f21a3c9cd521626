"""Repeat work whose processes were killed externally, and check that it repeats its requests."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from bench.benchmark.isolation.process_errors import KilledExternallyError, RunEndedError

Result = TypeVar("Result")
MAX_RETRIES = 3
"""Maximum number of attempts at work whose processes are killed externally.

An external kill gives no information about the work itself.
"""
NOT_REPRODUCIBLE_REASON = "it was killed, and the repeated training requested other simulations"
"""Reason of a training or run that cannot be repeated."""


def retry_if_killed(work: Callable[[], Result]) -> Result:
    """Call a function, again if one of its processes was killed externally.

    Args:
        work: function without arguments.

    Returns:
        The result of the function.

    Raises:
        RunEndedError: processes were killed in each of `MAX_RETRIES` attempts.
    """
    for _ in range(MAX_RETRIES):
        try:
            return work()
        except KilledExternallyError as killed:
            message = str(killed)
    # After several kills the work itself is the more likely cause.
    raise RunEndedError("crashed", f"{message}, {MAX_RETRIES} times")


class RepeatedRequests:
    """Requests of work that is repeated if its process is killed externally.

    The repeated work must make the same requests. Otherwise a tuner that causes its own kill could
    repeat its run until the result is good.
    """

    def __init__(self) -> None:
        # All different requests so far in their order, and the number of those made since the last
        # restart.
        self._earlier: list[bytes] = []
        self._position = 0

    def restart(self) -> None:
        """Begin the work, or begin it again."""
        self._position = 0

    def check(self, request: bytes) -> None:
        """Store a new request; in a repetition, compare it with the request at this position.

        Args:
            request: what the work requests, as bytes; equal requests have equal bytes.

        Raises:
            RunEndedError: it differs from the one before the kill.
        """
        # The work has reached a request that no earlier attempt made.
        if self._position == len(self._earlier):
            self._earlier.append(request)
        elif self._earlier[self._position] != request:
            raise RunEndedError("crashed", NOT_REPRODUCIBLE_REASON)
        self._position += 1
