"""Worker processes: start them without user scripts, and execute calls in them with time limits.

Processes share the cores, and sums are reproducible with one thread.

A worker executes one call at a time. If it dies, only this call is lost. In this process no worker
is used, so that prints and breakpoints work.

Every worker is a separate pebble pool with a single process. The workers of one pebble pool share a
channel that is protected by two locks. A worker that is killed while it holds them would block all
workers of its pool; here it blocks only itself.
"""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from concurrent.futures import TimeoutError as FutureTimeoutError
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import resource_tracker, spawn
from multiprocessing.context import SpawnContext, SpawnProcess
from time import monotonic
from typing import TYPE_CHECKING, Any, Protocol

from bench.benchmark.isolation.linux_syscalls import set_not_dumpable
from bench.benchmark.isolation.process_errors import describe_exit
from bench.benchmark.isolation.resource_limits import limit_to_one_thread, set_default_thread_count
from sims.core.simulator import InputError
from sims.engines.engine_lookup import describe_stepping

if TYPE_CHECKING:
    from bench.benchmark.runner.plugin_inspection import Plugin

_EXIT_WAIT_SECONDS = 5.0
"""Time in seconds that a worker has to end before it is left behind."""


class WorkerProcess(SpawnProcess):
    """Spawned process that skips the parent's main module and starts with interrupts blocked.

    A worker does not need the main module, because plugins are loaded from their files. With
    multiprocessing's default, a script without ``if __name__ == "__main__"`` would run again in
    each worker.

    Ctrl-C in a terminal reaches every process of the group. A process that is still importing would
    end with a traceback in the middle of the printed table. Interrupts are therefore blocked until
    the process calls `ignore_interrupts`.
    """

    def start(self) -> None:
        """Start the process."""
        # The resource tracker unblocks interrupts after it has started its own process, so it must
        # be running before they are blocked.
        resource_tracker.ensure_running()
        with _block_interrupts(), _leave_out_main_module():
            super().start()


class WorkerContext(SpawnContext):
    """Spawn context of multiprocessing with `WorkerProcess` as its process class."""

    Process = WorkerProcess


_MAIN_MODULE_KEYS = ("init_main_from_name", "init_main_from_path")
"""Keys of multiprocessing's preparation data that make a child import the main module."""
_preparing = threading.RLock()
"""Lock that protects the replacement of `spawn.get_preparation_data`."""


@contextmanager
def _leave_out_main_module() -> Iterator[None]:
    """Prevent processes that this thread spawns from importing the main module.

    Otherwise a user's script would run again in each of them. multiprocessing has no option for
    this. It sends each new process preparation data, which name the main module; so the function
    that makes these data is replaced within the block, for the calls of this thread.
    """
    with _preparing:
        original, thread = spawn.get_preparation_data, threading.get_ident()

        def without_main(name: str) -> dict[str, Any]:
            """Return multiprocessing's preparation data for a new process, without the main module.

            Other threads get the unchanged data, because they did not ask for this replacement.
            """
            data: dict[str, Any] = original(name)
            if threading.get_ident() == thread:
                for key in _MAIN_MODULE_KEYS:
                    data.pop(key, None)
            return data

        spawn.get_preparation_data = without_main
        try:
            yield
        finally:
            spawn.get_preparation_data = original


@contextmanager
def _block_interrupts() -> Iterator[None]:
    """Block SIGINT in this thread; processes started in the block inherit the mask.

    Ctrl-C is sent to all processes of the terminal's group; workers must finish their runs.
    """
    if not hasattr(signal, "pthread_sigmask"):  # on Windows a new process is in no process group
        yield
        return
    previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)


def ignore_interrupts() -> None:
    """Ignore pending and future interrupts; the parent process handles them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        # Child processes inherit the signal mask, and may need to be interruptible.
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def initialise_worker(plugins: Sequence[Plugin], start_sender: Any) -> None:
    """Initialise a worker process.

    It ignores interrupts, discards its output, ends with its parent, and protects its memory from
    other processes.

    Args:
        plugins: plugins to load or to register.
        start_sender: connection on which the worker reports that it has started.
    """
    # Ctrl-C in a terminal reaches every process of the group; only the parent handles it.
    ignore_interrupts()
    # This comes before everything that may fail: an unreported start would look like a busy worker.
    start_sender.send(os.getpid())
    threading.Thread(target=_end_with_parent, daemon=True, name="end-with-parent").start()
    set_not_dumpable()
    from bench.benchmark.runner.plugin_inspection import register_plugins

    register_plugins(plugins)
    _discard_output()


def _discard_output() -> None:
    """Discard all output: a tuner that prints would disturb the table or fill a disk."""
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    # The file descriptors are replaced, because C libraries do not use `sys.stdout`.
    null_device = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null_device, 1)
    os.dup2(null_device, 2)
    os.close(null_device)


def _end_with_parent() -> None:
    """End this process when its parent ends, even if a run hangs; runs in a thread of its own."""
    from multiprocessing import connection, parent_process

    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        # `sys.exit` would end this thread only.
        os._exit(1)


HARD_LIMIT_GRACE_SECONDS = 30.0
"""Difference between hard and soft time limit in seconds.

A cooperative run ends at the soft limit; the worker is killed at the hard limit.
"""
MAX_RETRIES = 3
"""Maximum number of repetitions of a call whose worker was killed externally.

An external kill gives no information about the call itself.
"""
_EXTERNAL_KILL_EXIT_CODES = (-9, -15, 15)
"""Exit codes of a worker that was killed externally: SIGKILL and SIGTERM.

SIGKILL is also sent by the kernel if memory is exhausted.
"""
_MAX_IMMEDIATE_DEATHS = 10
"""Maximum number of successive workers that die before they do any work."""
_SHORT_CALL_SECONDS = 1.0
"""Calls shorter than this many seconds are queued in advance at the workers."""

Call = tuple[Callable[..., Any], tuple[Any, ...]]


class WorkerDiedError(RuntimeError):
    """The worker process of a call died; the message says how."""


class PoolLostError(RuntimeError):
    """The executor of the calls is lost, and unfinished calls with it; the message names it."""


class Pool(Protocol):
    """Executor of calls: local worker processes, a cluster, or this process."""

    def load_plugins(self, plugins: Sequence[Plugin]) -> None:
        """Register plugins for the workers; must be called before the first call."""
        ...

    def iterate_results(self, calls: Sequence[Call], seconds: float) -> Iterator[tuple[int, Any]]:
        """Iterate over the results of calls in the order in which they end.

        Args:
            calls: functions with their arguments.
            seconds: soft time limit of one call.

        Yields:
            Index of the call, and its result or exception.
        """
        ...

    def __enter__(self) -> Pool: ...

    def __exit__(self, *_: object) -> None: ...


def make_pool(jobs: int) -> Pool:
    """Return a pool of worker processes on this machine, or of this process for 0 workers.

    Raises:
        InputError: `jobs` is negative.
    """
    if jobs < 0:
        raise InputError(f"jobs: expected a number of worker processes from 0 on, found {jobs}")
    return LocalPool(jobs) if jobs else InProcessPool()


class InProcessPool:
    """Executor of calls in this process, one after another, so that prints and breakpoints work.

    There is no isolation. A call that hangs or ends its process stops everything, a class need not
    be in a file, and a tuner could read the true parameters.
    """

    def load_plugins(self, plugins: Sequence[Plugin]) -> None:
        """Do nothing, because the caller has loaded the plugins in this process."""

    def __enter__(self) -> InProcessPool:
        return self

    def __exit__(self, *_: object) -> None:
        """Close the cached problem of this process at the end of the comparison."""
        from bench.benchmark.runner.run_in_worker import close_problem

        # A notebook may redefine a simulator under the same name before the next comparison.
        close_problem()

    def iterate_results(
        self,
        calls: Sequence[Call],
        seconds: float,  # noqa: ARG002 - there is nobody who could end a call past its limit
    ) -> Iterator[tuple[int, Any]]:
        """Iterate over the results of calls, in their order.

        Exceptions are also printed on stderr, for the author of the code.

        Args:
            calls: functions with their arguments.
            seconds: time limit; not used, because a call in this process cannot be ended.

        Yields:
            Index of the call, and its result or exception.
        """
        with limit_to_one_thread():
            for index in range(len(calls)):
                function, arguments = calls[index]
                try:
                    result = function(*arguments)
                except InputError as error:
                    result = error
                except Exception as error:
                    traceback.print_exc()
                    result = error
                except SystemExit as error:
                    traceback.print_exc()
                    result = WorkerDiedError(f"it asked to exit with {error.code!r}")
                yield index, result


@dataclass
class _AssignedCall:
    """Call that waits for a worker or is assigned to one.

    Attributes:
        index: index among all calls.
        deaths: number of workers that were killed externally during the call.
        assigned_at: time of the assignment, as of `monotonic`.
    """

    index: int
    deaths: int = 0
    assigned_at: float = field(default_factory=monotonic)


@dataclass
class _PrefetchPolicy:
    """Number of calls that a worker has at a time.

    If calls are short, a second one is queued, so that a worker does not wait for its next call.

    Attributes:
        depth: number of calls per worker, 1 or 2.
        ended_calls: number of calls that have ended.
        total_seconds: sum of their durations, from assignment to end.
    """

    depth: int = 1
    ended_calls: int = 0
    total_seconds: float = 0.0

    def record_duration(self, seconds: float) -> None:
        """Count a call that took a number of seconds."""
        self.ended_calls += 1
        self.total_seconds += seconds

    def adapt(self) -> None:
        """Choose the number of calls per worker from the mean duration so far."""
        if not self.ended_calls:
            return
        # With two calls queued, the time of a call includes the wait for the one before it.
        mean_seconds = self.total_seconds / self.ended_calls
        self.depth = 2 if mean_seconds < self.depth * _SHORT_CALL_SECONDS else 1


class LocalPool:
    """Worker processes on this machine, each a new interpreter with one numerical thread."""

    def __init__(self, jobs: int) -> None:
        """Set the number of threads of numerical libraries to one.

        Workers start with the first calls. Variables that the user has set are kept.

        Args:
            jobs: number of worker processes.
        """
        # Workers inherit the variables; numerical libraries read them when they are loaded.
        set_default_thread_count()
        self._jobs = jobs
        self._plugins: list[Plugin] = []
        self._slots: list[_WorkerSlot] = []

    def load_plugins(self, plugins: Sequence[Plugin]) -> None:
        """Register plugins for the workers; must be called before the first call."""
        self._plugins = list(plugins)

    def __enter__(self) -> LocalPool:
        return self

    def __exit__(self, *_: object) -> None:
        for slot in self._slots:
            slot.stop()

    def iterate_results(self, calls: Sequence[Call], seconds: float) -> Iterator[tuple[int, Any]]:
        """Execute calls in the workers, and iterate over their results in the order they end.

        Each turn of the loop assigns waiting calls to free workers, waits for results, and returns
        them. A call that exceeds its limit gives a `TimeoutError`. A call whose worker dies gives a
        `WorkerDiedError`; if the worker was killed externally (by the kernel or a user), only after
        `MAX_RETRIES` repetitions.

        Args:
            calls: functions with their arguments.
            seconds: soft time limit of one call.

        Yields:
            Index of the call, and its result or exception.

        Raises:
            InputError: workers die before they do any work.
        """
        limit = None if math.isinf(seconds) else seconds + HARD_LIMIT_GRACE_SECONDS
        if not self._slots:
            # Machine code is compiled here, because a worker cannot report what it waits for.
            describe_stepping()
        self._slots = self._slots or [_WorkerSlot(self._plugins) for _ in range(self._jobs)]
        waiting_calls = deque(_AssignedCall(index) for index in range(len(calls)))
        pace = _PrefetchPolicy()
        while True:
            self._assign_calls(waiting_calls, pace.depth, calls, limit)
            futures = [future for slot in self._slots for future in slot.assigned_calls]
            if not futures:
                return
            # The timeout is needed because a worker that exits with code 0 completes no future.
            wait(futures, timeout=1.0, return_when=FIRST_COMPLETED)
            for slot in self._slots:
                for call, result in slot.collect(waiting_calls):
                    pace.record_duration(monotonic() - call.assigned_at)
                    yield call.index, result
            pace.adapt()

    def _assign_calls(
        self,
        waiting_calls: deque[_AssignedCall],
        depth: int,
        calls: Sequence[Call],
        limit: float | None,
    ) -> None:
        """Assign up to `depth` calls to every worker; all get a first before any gets a second.

        Args:
            waiting_calls: calls that are not assigned, removed in place.
            depth: maximum number of calls that a worker has at a time.
            calls: functions and arguments of all calls.
            limit: time limit of each call in seconds; None for no limit.
        """
        for _ in range(depth):
            for slot in self._slots:
                if waiting_calls and len(slot.assigned_calls) < depth:
                    slot.assign(waiting_calls.popleft(), calls, limit)


class _WorkerSlot:
    """One worker process, replaced whenever it is lost.

    A new process has a new pipe, so that the rest of a dead process's message is never read.
    """

    def __init__(self, plugins: list[Plugin]) -> None:
        """Start the worker process, which loads the plugins first.

        `_failed_restarts` counts consecutive restarts after which no call has ended.
        `assigned_calls` are the calls of this worker that have not ended, by future.
        """
        self._plugins = plugins
        self._failed_restarts = 0
        self.assigned_calls: dict[Future[Any], _AssignedCall] = {}
        self._start_process()

    def _start_process(self) -> None:
        """Start a new process in its own pebble pool.

        `_start_receiver` is the pipe through which processes of this pool report that they have
        started, and `_start_count` counts these reports.
        """
        from pebble import ProcessPool

        # A forked process would inherit the parent's memory with the true parameters.
        context = WorkerContext()
        # Each process that the pool starts reports here. A second report means that the first
        # process is dead, which pebble does not notice if the exit code is 0.
        self._start_receiver, start_sender = context.Pipe(duplex=False)
        self._start_count = 0
        arguments = (self._plugins, start_sender)
        self._pool = ProcessPool(
            1, initializer=initialise_worker, initargs=arguments, context=context
        )

    def stop(self) -> None:
        """End the process, including a running call."""

        # The pool is bound here, because `_replace_process` may replace it while the thread runs.
        def end(pool: Any = self._pool) -> None:
            pool.stop()
            pool.join()

        # This runs in a thread, because pebble would wait forever for the rest of a message whose
        # sender was killed.
        ending = threading.Thread(target=end, daemon=True, name="ending-a-worker")
        ending.start()
        ending.join(timeout=_EXIT_WAIT_SECONDS)

    def assign(self, call: _AssignedCall, calls: Sequence[Call], limit: float | None) -> None:
        """Assign a call to the process; replace a pool that broke in the meantime.

        Args:
            call: call to assign.
            calls: all calls.
            limit: hard time limit in seconds; None for no limit.
        """
        function, arguments = calls[call.index]
        call.assigned_at = monotonic()
        try:
            future = self._pool.schedule(function, args=arguments, timeout=limit)
        except RuntimeError:  # the pool broke between two calls
            self._replace_process()
            future = self._pool.schedule(function, args=arguments, timeout=limit)
        self.assigned_calls[future] = call

    def collect(self, waiting: deque[_AssignedCall]) -> list[tuple[_AssignedCall, Any]]:
        """Return the calls of this worker that have ended, and replace the worker if it is lost.

        A lost worker was killed or has died. Calls that it did not begin, and those that were not
        the cause, are put back to the front of `waiting`. pebble does not notice a worker that ends
        with exit code 0, so that is detected by its replacement.

        Args:
            waiting: calls of all workers that are not assigned, extended in place.

        Returns:
            Each call that has ended, with its result or exception.
        """
        ended_calls: list[tuple[_AssignedCall, Any]] = []
        is_lost = False
        # A worker begins its calls in the order of assignment.
        oldest_call = next(iter(self.assigned_calls.values()), None)
        for future in [future for future in self.assigned_calls if future.done()]:
            call, error = self.assigned_calls.pop(future), future.exception()
            is_lost = is_lost or _loses_the_worker(error)
            # A result shows that this worker works.
            if error is None:
                self._failed_restarts = 0
            if _should_retry(call, error, call is oldest_call):
                waiting.appendleft(call)
            else:
                ended_calls.append(
                    (call, future.result() if error is None else _convert_error(error))
                )
        if not is_lost and self._was_replaced_without_result():
            is_lost = True
            # A worker executes one call at a time; that one is lost with it.
            running = next(future for future in self.assigned_calls if future.running())
            ended_calls.append(
                (self.assigned_calls.pop(running), WorkerDiedError(_describe_worker_exit(0)))
            )
        if is_lost:
            # A call that has ended, even by an error, shows that the worker had started properly.
            self._failed_restarts = 0 if ended_calls else self._failed_restarts
            # `extendleft` reverses the order, so the calls are reversed before.
            waiting.extendleft(reversed(self.assigned_calls.values()))
            self._replace_process()
        return ended_calls

    def _was_replaced_without_result(self) -> bool:
        """Return whether pebble replaced the process although its running call has no result.

        Each process of the pool reports its start, so a second report means a replacement.
        """
        while self._start_receiver.poll():
            self._start_receiver.recv()
            self._start_count += 1
        return self._start_count > 1 and any(future.running() for future in self.assigned_calls)

    def _replace_process(self) -> None:
        """Replace a lost worker process.

        Raises:
            InputError: too many processes died in turn without finishing a call. Without
                this limit, a worker that cannot start would be restarted forever.
        """
        self._failed_restarts += 1
        if self._failed_restarts > _MAX_IMMEDIATE_DEATHS:
            raise InputError(
                "worker processes die as soon as they start; see the messages above, if any"
            )
        self.assigned_calls.clear()
        self.stop()
        self._start_receiver.close()
        self._start_process()


def _get_exit_code(error: BaseException | None) -> int | None:
    """Return the exit code of the worker process if pebble reports that this ended the call."""
    return getattr(error, "exitcode", None)


def _loses_the_worker(error: BaseException | None) -> bool:
    """Return whether the worker of an ended call is gone: it died, or was killed at its limit."""
    return _get_exit_code(error) is not None or isinstance(
        error, BrokenExecutor | FutureTimeoutError
    )


def _should_retry(call: _AssignedCall, error: BaseException | None, may_have_started: bool) -> bool:
    """Return whether to repeat a call whose worker was killed or lost, and count the deaths.

    A pool that broke has not begun the call, or has not reported its result. A worker that was
    killed externally gives no information about the call, which is repeated a few times. Any other
    error is the result of the call.

    Args:
        call: the call, whose number of deaths is increased in place.
        error: error with which it ended; None if it has a result.
        may_have_started: whether the worker may have started the call when the pool broke.
    """
    # None unless the worker died during the call.
    code = _get_exit_code(error)
    is_repeated = isinstance(error, BrokenExecutor) or (
        code in _EXTERNAL_KILL_EXIT_CODES and call.deaths < MAX_RETRIES
    )
    # A pool that broke has no exit code.
    if is_repeated and (code is not None or may_have_started):
        call.deaths += 1
    return is_repeated


def _convert_error(error: BaseException) -> BaseException:
    """Return the exception that replaces the result of a failed call."""
    if isinstance(error, FutureTimeoutError):
        return TimeoutError(str(error))  # two different classes before Python 3.11
    code = _get_exit_code(error)
    return error if code is None else WorkerDiedError(_describe_worker_exit(code))


def _describe_worker_exit(code: int) -> str:
    """Describe how a worker process ended."""
    description = describe_exit("the worker process", code)
    return f"{description} (out of memory?)" if code == -9 else description
