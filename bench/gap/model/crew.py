"""Independent pieces of work on all cores, in processes that inherit what they work on.

A piece is the same whoever does it: what is cut into pieces, and how, never depends on the number
of workers, so that the answer is the same to the last bit with one and with many. Workers are
forked when there has been enough to do that they pay. They know the world as it was then, get small
messages, and end with the crew, with their parent (by a signal of the kernel's, and by the end of
their pipe), and not by Ctrl-C, which is the parent's to answer.
"""

from __future__ import annotations

import contextlib
import gc
import io
import mmap
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from multiprocessing import connection
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar

import numpy as np

from bench.gap.model.watch import Watch
from bench.sealing.kernel import PR_SET_PDEATHSIG, prctl
from sims.base import Array

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.process import BaseProcess

PAYS = 0.4
"""Seconds of work that could have been shared after which workers are started."""
LOOK = 0.05
"""Seconds between two looks at whether the search has to end."""

Result = TypeVar("Result")
Task = Callable[..., Result]
"""A function of a module: the world comes first, then what a message brings."""


class Place(Protocol):
    """What is worked on: a world."""

    simulations: int
    watch: Watch
    crew: Crew


class _Worker(NamedTuple):
    process: BaseProcess
    pipe: Connection


class _Answer(NamedTuple):
    """What a worker sends back: a result or what went wrong and where, and what it takes to account
    for.
    """

    result: Any
    error: Exception | None
    trace: str
    simulations: int
    left: bool


class _ThereError(Exception):
    """Where in a worker an error was raised, as its cause."""

    def __str__(self) -> str:
        return f"in a worker:\n{self.args[0]}"


class Crew:
    """Works with up to so many processes.

    Args:
        jobs: how many; 1 is this process alone.
    """

    def __init__(self, jobs: int = 1) -> None:
        self._jobs = jobs
        self._spent = 0.0
        # Worlds that are not done with; and those that the workers know, by their numbers there.
        self._worlds: list[Place] = []
        self._known: list[Place] = []
        self._team: list[_Worker] = []
        self._ending: mmap.mmap | None = None

    def map(
        self, world: Place, task: Task[Result], items: Sequence[tuple[Any, ...]]
    ) -> list[Result]:
        """What a task makes of each item, in their order; arguments as those of `each`."""
        results = dict(self.each(world, task, items))
        return [results[number] for number in range(len(items))]

    def each(
        self, world: Place, task: Task[Result], items: Sequence[tuple[Any, ...]]
    ) -> Iterator[tuple[int, Result]]:
        """What a task makes of each item, by the item's number, in the order in which they come.

        Args:
            world: the task's first argument; workers know it as it was when they were started.
            task: a function of a module.
            items: its further arguments.
        """
        several = self._jobs > 1 and len(items) > 1
        if several and self._spent >= PAYS:
            self._ready(world)
        if several and self._team:
            yield from self._shared(world, task, items)
            return
        for number, item in enumerate(items):
            begun = time.perf_counter()
            result = task(world, *item)
            if several:
                self._spent += time.perf_counter() - begun
            yield number, result

    def join(self, world: Place) -> None:
        """Know of a world that there will be work on, so that workers know it from their start."""
        self._worlds.append(world)

    def forget(self, world: Place) -> None:
        """Start new workers before the next work on a world, since it has changed."""
        self._known = [known for known in self._known if known is not world]

    def close(self) -> None:
        """End all workers, whatever they are at, and do without."""
        for worker in list(self._team):
            worker.process.kill()
        for worker in list(self._team):
            self._lose(worker.pipe)
        self._jobs = 1

    def _ready(self, world: Place) -> None:
        """Have workers that know a world: those that do not are followed by others."""
        if _among(self._known, world):
            return
        for worker in list(self._team):
            self._lose(worker.pipe)
        if not _among(self._worlds, world):
            self.join(world)
        self._known = list(self._worlds)
        # Asked now, as threads come and go.
        if can_fork():
            self._start()

    def _start(self) -> None:
        if self._ending is None:
            self._ending = mmap.mmap(-1, 1)
        context = multiprocessing.get_context("fork")
        # What there is stays shared memory: a worker that collects garbage would write to it.
        gc.freeze()
        for _ in range(self._jobs):
            mine, theirs = context.Pipe()
            # Ends of other pipes that a worker held would keep those workers alive.
            others = [mine, *(worker.pipe for worker in self._team)]
            told = (self._known, theirs, others, self._ending, os.getpid())
            process = context.Process(target=_work, args=told, daemon=True, name="explain")
            process.start()
            theirs.close()
            self._team.append(_Worker(process, mine))
        gc.unfreeze()

    def _shared(
        self,
        world: Place,
        task: Task[Result],
        items: Sequence[tuple[Any, ...]],
    ) -> Iterator[tuple[int, Result]]:
        errors: dict[int, tuple[Exception, str]] = {}
        waiting = list(range(len(items)))[::-1]
        busy: dict[Connection, int] = {}
        free = [worker.pipe for worker in self._team]
        place = next(i for i, known in enumerate(self._known) if known is world)
        while waiting or busy:
            while free and waiting:
                pipe = free.pop()
                number = waiting.pop()
                if _sent(pipe, (place, task, items[number])):
                    busy[pipe] = number
                else:
                    self._lose(pipe)
                    waiting.append(number)
            # All are gone: what is left is done here.
            if not busy:
                yield from ((number, task(world, *items[number])) for number in waiting)
                break
            for pipe in self._heard(list(busy), world):
                number = busy.pop(pipe)
                answer = _received(pipe)
                if answer is None:
                    # A worker that died, for want of memory perhaps: its work is done again.
                    self._lose(pipe)
                    waiting.append(number)
                    continue
                free.append(pipe)
                world.simulations += answer.simulations
                world.watch.left_off(answer.left)
                if answer.error is not None:
                    errors[number] = answer.error, answer.trace
                else:
                    yield number, answer.result
        # The first in order, whichever came first.
        for number in sorted(errors):
            error, trace = errors[number]
            raise error from _ThereError(trace)

    def _heard(self, pipes: list[Connection], world: Place) -> list[Any]:
        """Pipes on which something has come; workers are told meanwhile if the search must end."""
        while True:
            ready = connection.wait(pipes, LOOK)
            if self._ending is not None and world.watch.over():
                self._ending[0] = 1
            if ready:
                return ready

    def _lose(self, pipe: Connection) -> None:
        """Do without a worker."""
        for worker in list(self._team):
            if worker.pipe is pipe:
                self._team.remove(worker)
                worker.process.kill()
                worker.process.join()
                pipe.close()


def _among(worlds: Sequence[Place], world: Place) -> bool:
    """Whether it is one of them, and not only like it."""
    return any(one is world for one in worlds)


def cores() -> int:
    """How many this process may use."""
    # On some systems nobody can say which they are.
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def can_fork() -> bool:
    """Whether workers can inherit what there is: on Linux, without other threads, whose locks would
    stay locked for ever, and in a process that may have children.
    """
    alone = threading.active_count() == 1
    return sys.platform == "linux" and alone and not multiprocessing.current_process().daemon


class _Pickler(pickle.Pickler):
    """Keeps the order of arrays in memory: sums depend on it, to the last bit."""

    def reducer_override(self, thing: Any) -> Any:
        if type(thing) is not np.ndarray or thing.ndim < 2 or thing.flags.c_contiguous:
            return NotImplemented
        order = np.argsort([-abs(stride) for stride in thing.strides], kind="stable")
        return _turned, (np.ascontiguousarray(thing.transpose(order)), np.argsort(order))


def _turned(values: Array, order: Array) -> Array:
    """An array with its axes in another order, as it was before it was sent."""
    return values.transpose(order)


def packed(message: Any) -> bytes:
    """A message for a pipe."""
    buffer = io.BytesIO()
    _Pickler(buffer, protocol=pickle.HIGHEST_PROTOCOL).dump(message)
    return buffer.getvalue()


def _sent(pipe: Connection, message: Any) -> bool:
    try:
        pipe.send_bytes(packed(message))
    except OSError:
        return False
    return True


def _received(pipe: Connection) -> _Answer | None:
    """What a worker says; None if it is gone."""
    try:
        answer: _Answer = pickle.loads(pipe.recv_bytes())
    except (EOFError, OSError):
        return None
    return answer


def _work(
    worlds: Sequence[Place],
    pipe: Connection,
    others: list[Connection],
    ending: mmap.mmap,
    parent: int,
) -> None:
    """What a worker does until its pipe ends."""
    # A terminal's Ctrl-C reaches every process of the group; the parent alone answers it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(OSError):
        prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    # It may have ended before the kernel was asked.
    if os.getppid() != parent:
        return
    for other in others:
        other.close()
    for world in worlds:
        world.crew = Crew()
    while True:
        try:
            place, task, item = pickle.loads(pipe.recv_bytes())
        except (EOFError, OSError):
            return
        world, deadline = worlds[place], worlds[place].watch.deadline
        world.watch = Watch(stop=lambda: ending[0] != 0)
        world.watch.deadline = deadline
        before = world.simulations
        result, error, trace = None, None, ""
        try:
            result = task(world, *item)
        except Exception as raised:
            error, trace = raised, traceback.format_exc()
        count = world.simulations - before
        if not _sent(pipe, _Answer(result, error, trace, count, world.watch.left())):
            return
