"""Pool of forked worker processes that share the independent tasks of one search.

The result of a task does not depend on the process that runs it. The split into tasks does not
depend on the number of workers either, so the results are bit-identical with one worker and with
many. Workers are forked only after enough work has been done to justify their cost. They inherit
the run evaluators as they were then and receive small messages. They end with the pool, or with
their parent (by a kernel signal and by the end of their pipe). They ignore Ctrl-C, which only the
parent handles.
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

from bench.benchmark.isolation.linux_syscalls import PR_SET_PDEATHSIG, prctl
from bench.diagnosis.evaluation.search_control import SearchControl
from sims.core.simulator import Array

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.process import BaseProcess


PARALLEL_THRESHOLD_SECONDS = 0.4
"""Seconds of work in parallelisable tasks after which workers are started."""
POLL_INTERVAL_SECONDS = 0.05
"""Interval in seconds at which the pool checks whether the search must end."""

Result = TypeVar("Result")
Task = Callable[..., Result]
"""Module-level function of a run evaluator and of arguments that come from the message."""


class SharedState(Protocol):
    """Shared state that tasks work on, such as a run evaluator."""

    simulation_count: int
    search_control: SearchControl
    worker_pool: ForkedWorkerPool


class _Worker(NamedTuple):
    """Worker process, and the pipe to it."""

    process: BaseProcess
    pipe: Connection


class _Answer(NamedTuple):
    """Reply of a worker.

    Attributes:
        result: result of the task; None after an error.
        error: error that the task raised, if any.
        trace: traceback of the error as text.
        simulation_count: number of simulations that the task made.
        has_abandoned_fits: whether the task stopped a fit early.
    """

    result: Any
    error: Exception | None
    trace: str
    simulation_count: int
    has_abandoned_fits: bool


class _WorkerTracebackError(Exception):
    """Traceback of an error inside a worker, attached as the cause of the error."""

    def __str__(self) -> str:
        return f"in a worker:\n{self.args[0]}"


class ForkedWorkerPool:
    """Pool of up to a given number of worker processes."""

    def __init__(self, jobs: int = 1) -> None:
        """Create a pool without workers; they are forked when enough work was done to justify them.

        `_task_seconds` is the time, in seconds, that tasks took in this process; workers start when
        it reaches `PARALLEL_THRESHOLD_SECONDS`.

        Args:
            jobs: maximum number of processes; 1 means only this process.
        """
        self._jobs = jobs
        self._task_seconds = 0.0
        # Run evaluators that workers inherit when they start, and those that they have now.
        self._registered_evaluators: list[SharedState] = []
        self._inherited_evaluators: list[SharedState] = []
        self._workers: list[_Worker] = []
        self._stop_flag: mmap.mmap | None = None

    def map(
        self, evaluator: SharedState, task: Task[Result], items: Sequence[tuple[Any, ...]]
    ) -> list[Result]:
        """Run a task on each item, and return the results in the order of the items.

        Args:
            evaluator: first argument of the task.
            task: a module-level function.
            items: further arguments of each call.

        Returns:
            One result per item.
        """
        results = dict(self.map_unordered(evaluator, task, items))
        return [results[number] for number in range(len(items))]

    def map_unordered(
        self, evaluator: SharedState, task: Task[Result], items: Sequence[tuple[Any, ...]]
    ) -> Iterator[tuple[int, Result]]:
        """Run a task on each item, and yield item numbers and results as they arrive.

        Items are distributed to workers once enough work was done to justify the cost of forking
        them. Until then, and with one job, they are processed in this process.

        Args:
            evaluator: first argument of the task; workers have it as it was when they were started.
            task: a module-level function.
            items: further arguments of each call.

        Yields:
            The number of an item and its result.
        """
        is_parallel = self._jobs > 1 and len(items) > 1
        if is_parallel and self._task_seconds >= PARALLEL_THRESHOLD_SECONDS:
            self._ensure_workers(evaluator)
        if is_parallel and self._workers:
            yield from self._distribute(evaluator, task, items)
            return
        for number, item in enumerate(items):
            start_time = time.perf_counter()
            result = task(evaluator, *item)
            # Only work that workers could share justifies their cost.
            if is_parallel:
                self._task_seconds += time.perf_counter() - start_time
            yield number, result

    def register(self, evaluator: SharedState) -> None:
        """Register a run evaluator, so that workers inherit it when they start."""
        self._registered_evaluators.append(evaluator)

    def forget(self, evaluator: SharedState) -> None:
        """Start new workers before the next work on a changed run evaluator."""
        self._inherited_evaluators = [
            inherited for inherited in self._inherited_evaluators if inherited is not evaluator
        ]

    def close(self) -> None:
        """Kill all workers, and continue without them."""
        for worker in list(self._workers):
            worker.process.kill()
        for worker in list(self._workers):
            self._kill_worker(worker.pipe)
        self._jobs = 1

    def _ensure_workers(self, evaluator: SharedState) -> None:
        """Ensure that the workers have inherited a run evaluator; otherwise replace them.

        A worker has the data that existed when it was forked, so it does not know later ones. Where
        a process cannot fork, there are no workers afterwards.
        """
        if _contains_object(self._inherited_evaluators, evaluator):
            return
        for worker in list(self._workers):
            self._kill_worker(worker.pipe)
        if not _contains_object(self._registered_evaluators, evaluator):
            self.register(evaluator)
        self._inherited_evaluators = list(self._registered_evaluators)
        # Checked at this moment, because threads may start and end.
        if can_fork():
            self._fork_workers()

    def _fork_workers(self) -> None:
        """Fork `jobs` workers, each with its own pipe to this process.

        A forked worker inherits the run evaluators of `register` without a copy, so that a task
        refers to its evaluator by an index. The main function of a worker is `_run_worker`.
        """
        # One byte of memory that all workers share: a value other than zero asks them to stop.
        if self._stop_flag is None:
            self._stop_flag = mmap.mmap(-1, 1)
        context = multiprocessing.get_context("fork")
        # Frozen objects are ignored by the garbage collection of a worker, which would write to
        # their memory pages, so that these could no longer be shared.
        gc.freeze()
        for _ in range(self._jobs):
            parent_end, worker_end = context.Pipe()
            # The worker closes the ends of other pipes that it inherits. Otherwise these pipes
            # would stay open when the parent ends, and their workers would not end.
            other_pipes = [parent_end, *(worker.pipe for worker in self._workers)]
            worker_arguments = (
                self._inherited_evaluators,
                worker_end,
                other_pipes,
                self._stop_flag,
                os.getpid(),
            )
            process = context.Process(
                target=_run_worker, args=worker_arguments, daemon=True, name="explain"
            )
            process.start()
            worker_end.close()
            self._workers.append(_Worker(process, parent_end))
        gc.unfreeze()

    def _distribute(
        self,
        evaluator: SharedState,
        task: Task[Result],
        items: Sequence[tuple[Any, ...]],
    ) -> Iterator[tuple[int, Result]]:
        """Distribute the items of a task among the workers, and yield each result as it arrives.

        1. Send an item to each idle worker.
        2. Without any worker, process the remaining items in this process.
        3. Receive replies. If a worker has died, its item is processed again.
        4. Raise the first error of a task, after all other items are finished.

        Args:
            evaluator: first argument of the task, which the workers have inherited.
            task: a module-level function.
            items: further arguments of each call.

        Yields:
            The number of an item and its result, in any order.
        """
        # Error and traceback by item number.
        errors: dict[int, tuple[Exception, str]] = {}
        # Numbers of the items in descending order, because `pop` takes the last one.
        unprocessed = list(range(len(items)))[::-1]
        # Pipes of working workers with the number of their item, and pipes of idle workers.
        busy: dict[Connection, int] = {}
        idle = [worker.pipe for worker in self._workers]
        # Workers know the run evaluator by its index.
        evaluator_index = next(
            i for i, inherited in enumerate(self._inherited_evaluators) if inherited is evaluator
        )
        while unprocessed or busy:
            # 1. Requests.
            while idle and unprocessed:
                pipe = idle.pop()
                item_index = unprocessed.pop()
                if _send(pipe, (evaluator_index, task, items[item_index])):
                    busy[pipe] = item_index
                else:
                    # The worker is gone, so another one gets its item.
                    self._kill_worker(pipe)
                    unprocessed.append(item_index)
            # 2. No workers.
            # All workers are gone, so the remaining items are processed here.
            if not busy:
                yield from (
                    (item_index, task(evaluator, *items[item_index])) for item_index in unprocessed
                )
                break
            # 3. Replies.
            for pipe in self._wait_for_replies(list(busy), evaluator):
                item_index = busy.pop(pipe)
                reply = _receive(pipe)
                if reply is None:
                    # The worker died, perhaps for lack of memory, so its item is processed again.
                    self._kill_worker(pipe)
                    unprocessed.append(item_index)
                    continue
                idle.append(pipe)
                evaluator.simulation_count += reply.simulation_count
                evaluator.search_control.record_abandoned_fit(reply.has_abandoned_fits)
                if reply.error is not None:
                    errors[item_index] = reply.error, reply.trace
                else:
                    yield item_index, reply.result
        # 4. Errors.
        # Raise the error of the first item in order, whichever error arrived first.
        for item_index in sorted(errors):
            error, trace = errors[item_index]
            raise error from _WorkerTracebackError(trace)

    def _wait_for_replies(self, pipes: list[Connection], evaluator: SharedState) -> list[Any]:
        """Wait for replies and return their pipes; tell workers to stop if the search must end.

        Args:
            pipes: pipes to the workers that have a task.
            evaluator: the state on which the tasks work; its search control says when the search
                must end.
        """
        while True:
            ready_pipes = connection.wait(pipes, POLL_INTERVAL_SECONDS)
            if self._stop_flag is not None and evaluator.search_control.should_stop():
                self._stop_flag[0] = 1
            if ready_pipes:
                return ready_pipes

    def _kill_worker(self, pipe: Connection) -> None:
        """Kill the worker at the other end of a pipe, and remove it from the pool."""
        for worker in list(self._workers):
            if worker.pipe is pipe:
                self._workers.remove(worker)
                worker.process.kill()
                worker.process.join()
                pipe.close()


def _contains_object(evaluators: Sequence[SharedState], evaluator: SharedState) -> bool:
    """Return whether a run evaluator is one of the given objects (by identity, not equality)."""
    return any(other is evaluator for other in evaluators)


def can_fork() -> bool:
    """Return whether workers can be forked from this process.

    This requires Linux, no other threads (their locks would stay locked in the child), and a
    process that may have children.
    """
    has_single_thread = threading.active_count() == 1
    return (
        sys.platform == "linux"
        and has_single_thread
        and not multiprocessing.current_process().daemon
    )


class _Pickler(pickle.Pickler):
    """Pickler that keeps the memory order of arrays, because sums depend on it in the last bit."""

    def reducer_override(self, value: Any) -> Any:
        """Pickle an array that is not C-contiguous together with the order of its axes in memory.

        Pickle itself would not keep every memory order. All other objects are pickled as usual,
        which `NotImplemented` requests. Otherwise the result is a function that restores the array,
        and its arguments.
        """
        if type(value) is not np.ndarray or value.ndim < 2 or value.flags.c_contiguous:
            return NotImplemented
        # The axis with the largest stride (distance of neighbours in bytes) is the outermost one in
        # memory. With the axes in this order, the array is contiguous. The second `argsort` is the
        # inverse permutation, which restores the order.
        order = np.argsort([-abs(stride) for stride in value.strides], kind="stable")
        return _restore_axes, (np.ascontiguousarray(value.transpose(order)), np.argsort(order))


def _restore_axes(values: Array, order: Array) -> Array:
    """Restore the order of axes that an array had before it was sent.

    Args:
        values: the array, with its axes sorted by memory order.
        order: for each original axis, its place in `values`.
    """
    return values.transpose(order)


def serialise_message(message: Any) -> bytes:
    """Serialise a message for a pipe."""
    buffer = io.BytesIO()
    _Pickler(buffer, protocol=pickle.HIGHEST_PROTOCOL).dump(message)
    return buffer.getvalue()


def _send(pipe: Connection, message: Any) -> bool:
    """Send a message through the pipe; return False if the process at the other end is gone."""
    try:
        pipe.send_bytes(serialise_message(message))
    except OSError:
        return False
    return True


def _receive(pipe: Connection) -> _Answer | None:
    """Return the reply of a worker, or None if the worker is gone."""
    try:
        reply: _Answer = pickle.loads(pipe.recv_bytes())
    except (EOFError, OSError):
        return None
    return reply


def _run_worker(
    evaluators: Sequence[SharedState],
    pipe: Connection,
    other_pipes: list[Connection],
    stop_flag: mmap.mmap,
    parent: int,
) -> None:
    """Process the requests of the parent until the pipe ends; main loop of a worker.

    1. Make sure that the worker ends with its parent, and that only the parent handles Ctrl-C.
    2. Receive a request: the index of a run evaluator, a task (a function) and its arguments.
    3. Run the task, with the deadline of the search. It ends early if the parent sets `stop_flag`.
    4. Send the result or the error, and the number of simulations.

    Args:
        evaluators: objects that the worker inherits; a request names one by its index.
        pipe: connection to the parent.
        other_pipes: inherited ends of other pipes, which the worker closes.
        stop_flag: one shared byte; a value other than zero asks all workers to stop.
        parent: process id of the parent.
    """
    # 1. Signals.
    # Ctrl-C of a terminal reaches every process of the group; only the parent handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(OSError):
        prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    # The parent may have ended before the kernel signal was requested.
    if os.getppid() != parent:
        return
    for other_pipe in other_pipes:
        other_pipe.close()
    # A worker has no workers of its own: tasks within a task run in this process.
    for evaluator in evaluators:
        evaluator.worker_pool = ForkedWorkerPool()
    # 2. Requests.
    while True:
        try:
            evaluator_index, task, item = pickle.loads(pipe.recv_bytes())
        except (EOFError, OSError):
            return
        evaluator = evaluators[evaluator_index]
        # 3. Task. A new search control for each task, so that an earlier stop does not count. It
        # stops at the stop flag, which the parent sets, or at the deadline.
        deadline = evaluator.search_control.deadline
        evaluator.search_control = SearchControl(stop=lambda: stop_flag[0] != 0)
        evaluator.search_control.deadline = deadline
        count_before = evaluator.simulation_count
        result, error, trace = None, None, ""
        try:
            result = task(evaluator, *item)
        except Exception as raised:
            error, trace = raised, traceback.format_exc()
        # 4. Answer.
        count = evaluator.simulation_count - count_before
        if not _send(
            pipe,
            _Answer(result, error, trace, count, evaluator.search_control.has_abandoned_fits()),
        ):
            return
