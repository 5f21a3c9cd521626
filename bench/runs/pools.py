"""Worker processes that can be killed: one run at a time in each, a hard limit, and a death costs
no more than a run.

Every worker is a pebble pool of its own with a single process. pebble shares one channel, guarded
by two locks, among the workers of a pool: a worker that is killed while it holds them would stop
all of them, and here stops only itself.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from concurrent.futures import TimeoutError as FutureTimeoutError
from dataclasses import dataclass, field
from time import monotonic
from typing import Any, Protocol

from bench.runs.guard import initialise
from sims.base import InputError

GRACE = 30.0
"""Seconds by which the hard limit, which kills, exceeds the soft one, which a cooperative run meets
by itself.
"""
RETRIES = 3
"""How often a call is made again whose worker was killed from outside, which says nothing about the
call.
"""
_OUTSIDE = (-9, -15, 15)
"""Exit codes of a worker that was told to end: SIGKILL (also the kernel's, short of memory),
SIGTERM.
"""
_FUTILE = 10
"""Workers that may die one after another before they do anything; then it is not chance."""
_SHORT = 1.0
"""Seconds below which a worker is given its next call ahead of time."""

Call = tuple[Callable[..., Any], tuple[Any, ...]]


class DeathError(RuntimeError):
    """The worker process of a call died; the message says how."""


class LostError(RuntimeError):
    """What makes the calls is gone, and with it the calls that had no end; the message says what
    is.
    """


class Pool(Protocol):
    """What makes calls in isolation: worker processes here, or a cluster's."""

    def load(self, plugins: Sequence[str]) -> None:
        """Make these plugin files known to the workers; before the first call."""
        ...

    def results(self, calls: Sequence[Call], seconds: float) -> Iterator[tuple[int, Any]]:
        """Place and result (or exception) of each call, as they end; `seconds` is the soft limit of
        one.
        """
        ...

    def __enter__(self) -> Pool: ...

    def __exit__(self, *_: object) -> None: ...


@dataclass
class _Given:
    """A call handed to a worker."""

    place: int
    deaths: int = 0
    given: float = field(default_factory=monotonic)


class LocalPool:
    """Worker processes on this machine, each a fresh interpreter with one arithmetic thread.

    Args:
        jobs: how many.
    """

    _THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

    def __init__(self, jobs: int) -> None:
        for name in self._THREADS:
            os.environ.setdefault(name, "1")
        self._jobs = jobs
        self._plugins: list[str] = []
        self._slots: list[_Slot] = []

    def load(self, plugins: Sequence[str]) -> None:
        """Make these plugin files known to the workers; before the first call."""
        self._plugins = list(plugins)

    def __enter__(self) -> LocalPool:
        return self

    def __exit__(self, *_: object) -> None:
        for slot in self._slots:
            slot.stop()

    def results(self, calls: Sequence[Call], seconds: float) -> Iterator[tuple[int, Any]]:
        """Place and result (or exception) of each call, as they end.

        A call past its limit ends in `TimeoutError`, one whose worker dies in `DeathError`; after
        `RETRIES` deaths from outside (the kernel's, an operator's) too.

        Raises:
            InputError: workers die before they do anything.
        """
        limit = None if math.isinf(seconds) else seconds + GRACE
        self._slots = self._slots or [_Slot(self._plugins) for _ in range(self._jobs)]
        following = deque(_Given(place) for place in range(len(calls)))
        depth, finished, busy = 1, 0, 0.0
        while True:
            for _ in range(depth):
                for slot in self._slots:
                    if following and len(slot.given) < depth:
                        slot.give(following.popleft(), calls, limit)
            futures = [future for slot in self._slots for future in slot.given]
            if not futures:
                return
            wait(futures, timeout=1.0, return_when=FIRST_COMPLETED)
            for slot in self._slots:
                for one, result in slot.collect(following):
                    finished += 1
                    busy += monotonic() - one.given
                    yield one.place, result
            depth = 2 if finished and busy / finished < depth * _SHORT else 1


class _Slot:
    """One worker process, made anew whenever it is lost: what a dying process leaves in its pipe is
    never read.
    """

    def __init__(self, plugins: list[str]) -> None:
        self._plugins = plugins
        self._futile = 0
        self.given: dict[Future[Any], _Given] = {}
        self._start()

    def _start(self) -> None:
        from pebble import ProcessPool

        context = multiprocessing.get_context("spawn")
        # Each process that the pool starts tells of its birth here: a second one means that the
        # first is dead, which pebble does not notice where it exited with code 0.
        self._births, telling = context.Pipe(duplex=False)
        arguments = (self._plugins, telling)
        self._born, self._pool = (
            0,
            ProcessPool(1, initializer=initialise, initargs=arguments, context=context),
        )

    def stop(self) -> None:
        """End the process, and whatever it is at."""

        def end(pool: Any = self._pool) -> None:
            pool.stop()
            pool.join()

        # In a thread, since pebble would wait for ever for the rest of a message whose sender was
        # killed.
        ending = threading.Thread(target=end, daemon=True, name="ending-a-worker")
        ending.start()
        ending.join(timeout=5.0)

    def give(self, one: _Given, calls: Sequence[Call], limit: float | None) -> None:
        """Hand a call over; a pool that broke in the meantime is replaced."""
        function, arguments = calls[one.place]
        one.given = monotonic()
        try:
            future = self._pool.schedule(function, args=arguments, timeout=limit)
        except RuntimeError:  # it broke between two calls
            self._renew()
            future = self._pool.schedule(function, args=arguments, timeout=limit)
        self.given[future] = one

    def collect(self, again: deque[_Given]) -> list[tuple[_Given, Any]]:
        """The calls that ended; what a lost worker never began goes back in front of `again`."""
        ended: list[tuple[_Given, Any]] = []
        lost = False
        for future in [future for future in self.given if future.done()]:
            one, error = self.given.pop(future), future.exception()
            code = getattr(error, "exitcode", None)
            lost = (
                lost or code is not None or isinstance(error, BrokenExecutor | FutureTimeoutError)
            )
            if error is None:
                self._futile = 0
                ended.append((one, future.result()))
            elif isinstance(error, BrokenExecutor) or (code in _OUTSIDE and one.deaths < RETRIES):
                one.deaths += code is not None
                again.appendleft(one)
            elif isinstance(error, FutureTimeoutError):
                ended.append(
                    (one, TimeoutError(str(error)))
                )  # before Python 3.11 the two are different classes
            else:
                ended.append((one, error if code is None else DeathError(_says(code))))
        if not lost and self._died_quietly():
            lost = True
            at = next(future for future in self.given if future.running())
            ended.append((self.given.pop(at), DeathError(_says(0))))
        if lost:
            self._futile = 0 if ended else self._futile
            again.extendleft(reversed(self.given.values()))
            self._renew()
        return ended

    def _died_quietly(self) -> bool:
        """Whether the process was replaced although a call that it was at has no end."""
        while self._births.poll():
            self._births.recv()
            self._born += 1
        return self._born > 1 and any(future.running() for future in self.given)

    def _renew(self) -> None:
        self._futile += 1
        if self._futile > _FUTILE:
            raise InputError(
                "worker processes die as soon as they start; what they say stands above, if anything"
            )
        self.given.clear()
        self.stop()
        self._births.close()
        self._start()


def _says(code: int) -> str:
    """How a worker process ended, in words."""
    import signal

    if code >= 0:
        return f"the worker process exited with code {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    return f"the worker process was killed by {name}" + (" (out of memory?)" if code == -9 else "")
