"""Worker processes that can be killed: one run at a time in each, a hard limit, and a death costs
no more than a run. Or no worker process at all, where somebody wants to look on.

Every worker is a pebble pool of its own with a single process. pebble shares one channel, guarded
by two locks, among the workers of a pool: a worker that is killed while it holds them would stop
all of them, and here stops only itself.
"""

from __future__ import annotations

import math
import os
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from concurrent.futures import TimeoutError as FutureTimeoutError
from dataclasses import dataclass, field
from time import monotonic
from typing import TYPE_CHECKING, Any, Protocol

from bench.runs.births import WorkerContext
from bench.runs.guard import initialise
from bench.runs.threads import THREADS, one_thread
from bench.sealing.ended import how_it_ended
from sims.base import InputError
from sims.engines import stepping

if TYPE_CHECKING:
    from bench.runs.survey import Plugin

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
    """What makes calls: worker processes here, a cluster's, or this process itself."""

    def load(self, plugins: Sequence[Plugin]) -> None:
        """Make these plugins known to the workers; before the first call."""
        ...

    def results(self, calls: Sequence[Call], seconds: float) -> Iterator[tuple[int, Any]]:
        """Place and result (or exception) of each call, as they end; `seconds` is the soft limit of
        one.
        """
        ...

    def __enter__(self) -> Pool: ...

    def __exit__(self, *_: object) -> None: ...


def pool_of(jobs: int) -> Pool:
    """So many worker processes on this machine; for 0 this process makes the calls itself.

    Raises:
        InputError: fewer than 0.
    """
    if jobs < 0:
        raise InputError(f"jobs: expected a number of worker processes from 0 on, found {jobs}")
    return LocalPool(jobs) if jobs else InProcessPool()


class InProcessPool:
    """Makes the calls in this process, one after another: prints show, and breakpoints hold.

    Nothing is isolated. A call that hangs hangs all, one that ends its process ends all, a class
    need not be in a file, and nothing but a tuner's good manners keeps it from the truth.
    """

    def load(self, plugins: Sequence[Plugin]) -> None:
        """Nothing is to be done: who makes the calls has loaded the plugins."""

    def __enter__(self) -> InProcessPool:
        return self

    def __exit__(self, *_: object) -> None:
        from bench.runs.worker import release

        # A notebook may define a simulator anew under its old name before the next comparison.
        release()

    def results(
        self,
        calls: Sequence[Call],
        seconds: float,  # noqa: ARG002 - there is nobody who could end a call past its limit
    ) -> Iterator[tuple[int, Any]]:
        """Place and result (or exception) of each call, in their order.

        What a call raises is said on stderr too, while the person who wrote it is looking.
        """
        with one_thread():
            for place in range(len(calls)):
                function, arguments = calls[place]
                try:
                    result = function(*arguments)
                except InputError as error:
                    result = error
                except Exception as error:
                    traceback.print_exc()
                    result = error
                except SystemExit as error:
                    traceback.print_exc()
                    result = DeathError(f"it asked to exit with {error.code!r}")
                yield place, result


@dataclass
class _Given:
    """A call handed to a worker."""

    place: int
    deaths: int = 0
    given: float = field(default_factory=monotonic)


@dataclass
class _Pace:
    """How many calls a worker has at a time: short ones come in twos, so that none waits for the
    next.
    """

    depth: int = 1
    ended: int = 0
    busy: float = 0.0

    def note(self, seconds: float) -> None:
        """Count a call that ended after so many seconds."""
        self.ended += 1
        self.busy += seconds

    def adapt(self) -> None:
        """Choose the depth for what comes."""
        # While two are given ahead, a call's time counts the wait for the one before it.
        short = self.ended and self.busy / self.ended < self.depth * _SHORT
        self.depth = 2 if short else 1


class LocalPool:
    """Worker processes on this machine, each a fresh interpreter with one arithmetic thread.

    Args:
        jobs: how many.
    """

    def __init__(self, jobs: int) -> None:
        # Workers inherit it; libraries read it when they are first loaded.
        for name in THREADS:
            os.environ.setdefault(name, "1")
        self._jobs = jobs
        self._plugins: list[Plugin] = []
        self._slots: list[_Slot] = []

    def load(self, plugins: Sequence[Plugin]) -> None:
        """Make these plugins known to the workers; before the first call."""
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
        if not self._slots:
            stepping()  # made here: a worker says nothing of what it waits for
        self._slots = self._slots or [_Slot(self._plugins) for _ in range(self._jobs)]
        following = deque(_Given(place) for place in range(len(calls)))
        pace = _Pace()
        while True:
            self._hand_out(following, pace.depth, calls, limit)
            futures = [future for slot in self._slots for future in slot.given]
            if not futures:
                return
            # Not for ever: a worker that left with code 0 ends no future.
            wait(futures, timeout=1.0, return_when=FIRST_COMPLETED)
            for slot in self._slots:
                for one, result in slot.collect(following):
                    pace.note(monotonic() - one.given)
                    yield one.place, result
            pace.adapt()

    def _hand_out(
        self, following: deque[_Given], depth: int, calls: Sequence[Call], limit: float | None
    ) -> None:
        """Give every worker up to `depth` calls; everybody the first before anybody the second."""
        for _ in range(depth):
            for slot in self._slots:
                if following and len(slot.given) < depth:
                    slot.give(following.popleft(), calls, limit)


class _Slot:
    """One worker process, made anew whenever it is lost: what a dying process leaves in its pipe is
    never read.
    """

    def __init__(self, plugins: list[Plugin]) -> None:
        self._plugins = plugins
        self._futile = 0
        self.given: dict[Future[Any], _Given] = {}
        self._start()

    def _start(self) -> None:
        from pebble import ProcessPool

        # Not forked: a fork inherits the parent's memory, and in it the truth.
        context = WorkerContext()
        # Each process that the pool starts tells of its birth here: a second one means that the
        # first is dead, which pebble does not notice where it exited with code 0.
        self._births, telling = context.Pipe(duplex=False)
        self._born = 0
        arguments = (self._plugins, telling)
        self._pool = ProcessPool(1, initializer=initialise, initargs=arguments, context=context)

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
            lost = lost or _loses_the_worker(error)
            if error is None:
                self._futile = 0
            if _is_to_be_made_again(one, error):
                again.appendleft(one)
            else:
                ended.append((one, future.result() if error is None else _end_of(error)))
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
            said = "what they say stands above, if anything"
            raise InputError(f"worker processes die as soon as they start; {said}")
        self.given.clear()
        self.stop()
        self._births.close()
        self._start()


def _exit_code(error: BaseException | None) -> int | None:
    """How the worker process left, where pebble says that this ended the call."""
    return getattr(error, "exitcode", None)


def _loses_the_worker(error: BaseException | None) -> bool:
    """Whether the worker of a call with this end is gone: it died, or was killed at its limit."""
    return _exit_code(error) is not None or isinstance(error, BrokenExecutor | FutureTimeoutError)


def _is_to_be_made_again(one: _Given, error: BaseException | None) -> bool:
    """Whether the end of a call says nothing about the call; counts the deaths that it has met."""
    code = _exit_code(error)
    # A pool that broke had not begun the call, or not told what came of it.
    again = isinstance(error, BrokenExecutor) or (code in _OUTSIDE and one.deaths < RETRIES)
    if again:
        one.deaths += code is not None
    return again


def _end_of(error: BaseException) -> BaseException:
    """What a call that failed gives in place of a result."""
    if isinstance(error, FutureTimeoutError):
        return TimeoutError(str(error))  # before Python 3.11 the two are different classes
    code = _exit_code(error)
    return error if code is None else DeathError(_says(code))


def _says(code: int) -> str:
    """How a worker process ended, in words."""
    said = how_it_ended("the worker process", code)
    return f"{said} (out of memory?)" if code == -9 else said
