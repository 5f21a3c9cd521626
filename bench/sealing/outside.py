"""The harness's side of the pipe: starts tuners' processes, drives them, and believes nothing that
they say.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import json
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.sealing import folders, nursery
from bench.sealing.ended import EndedError, KilledError
from bench.sealing.seals import ROOT, readable
from bench.sealing.wire import (
    ASKED_LIMIT,
    TEXT_LIMIT,
    Channel,
    FoulError,
    GoneError,
    Message,
    packed,
)
from methods.base import Array, Ask, Evaluation, Task

_START = (
    "import sys; sys.path[:] = {path!r}; from bench.sealing.nursery import main; main({descriptor})"
)
_PRELOADED = ("numpy.random", "bench.sealing.inside")
_NUMERICAL = ("OPENBLAS_", "MKL_", "OMP_", "NPY_")
"""With which the names of variables begin that tell numerical libraries how to compute."""
_PATIENCE = 60.0
"""Seconds in which a process must have been started, and a tuner built."""
_FAREWELL = 10.0
"""Seconds in which a tuner must have closed what it holds; no more than its run may take."""
_OUTSIDE = (-9, -15)
"""How who was killed from outside ends: SIGKILL (also the kernel's, short of memory), SIGTERM."""


@dataclass(frozen=True)
class Tuned:
    """Which tuner is to be built.

    Attributes:
        name: registered.
        module: that it is in, where it is installed.
        file: the plugin file that it is in; empty where it is installed.
        options: of its entry.
        modules: packages that it needs, to be loaded ahead.
    """

    name: str
    module: str
    file: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    modules: tuple[str, ...] = ()


def moved(tuned: Tuned, places: Mapping[Path, Path]) -> Tuned:
    """The tuner where its file has another place."""
    return replace(tuned, file=str(places[Path(tuned.file)])) if tuned.file else tuned


class Nursery:
    """Starts tuners' processes; see `bench.sealing.nursery`."""

    def __init__(self) -> None:
        self._place: folders.Folder | None = folders.new()
        self._folder = self._place.path
        self._loaded: set[str] = set()
        self._link, theirs = socket.socketpair()
        path = [place for place in sys.path if place not in ("", str(ROOT))] + [str(ROOT)]
        code = _START.format(path=path, descriptor=theirs.fileno())
        nothing = subprocess.DEVNULL
        self._process = subprocess.Popen(
            [sys.executable, "-c", code],
            pass_fds=[theirs.fileno()],
            env=_environment(self._folder),
            cwd=self._folder,
            stdin=nothing,
            stdout=nothing,
            start_new_session=True,
        )
        theirs.close()
        atexit.register(self.close)
        self.load(_PRELOADED)

    def _ask(self, request: dict[str, Any], descriptors: tuple[int, ...] = ()) -> Any:
        try:
            nursery.send(self._link, request, descriptors)
            return nursery.receive(self._link)[0]
        except (EOFError, OSError):
            self.close()
            raise KilledError("the process that starts tuners is gone") from None

    @property
    def alive(self) -> bool:
        """Whether it can start another."""
        return self._process.poll() is None

    def load(self, modules: Iterable[str]) -> None:
        """Load packages ahead; what a plugin is made of is never among them."""
        missing = [name for name in dict.fromkeys(modules) if name not in self._loaded]
        if missing:
            self._ask({"do": "load", "modules": missing})
            self._loaded.update(missing)

    def start(
        self,
        service: str,
        files: Iterable[str] = (),
        memory: int = 0,
        hidden: Iterable[str] = (),
    ) -> Child:
        """Start a process.

        Args:
            service: what it is for, one of `bench.sealing.nursery.SERVICES`.
            files: that it may read beside Python and its packages.
            memory: MiB that it may take; 0 for no limit.
            hidden: folders that it must not reach, beside the working one.

        Raises:
            KilledError: none can be started any more.
        """
        to_child, to_us = os.pipe(), os.pipe()
        request = {
            "do": "start",
            "service": service,
            "folder": self._folder,
            "readable": [*readable((*hidden, str(Path.cwd()))), *files],
            "memory": memory,
        }
        try:
            keeper = self._ask(request, (to_child[0], to_us[1]))["keeper"]
        except KilledError:
            os.close(to_us[0])
            os.close(to_child[1])
            raise
        finally:
            os.close(to_child[0])
            os.close(to_us[1])
        return Child(self, keeper, Channel(to_us[0], to_child[1]))

    def end(self, keeper: int, kill: bool) -> int | None:
        """End a process; how it ended by itself, None where it had to be ended."""
        code: int | None = self._ask({"do": "end", "keeper": keeper, "kill": kill})["exit"]
        return code

    def empty(self) -> None:
        """Delete what is in the tuners' folder, which they share where none has its own."""
        for path in Path(self._folder).iterdir():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)

    def close(self) -> None:
        """End it, and every process that it started."""
        atexit.unregister(self.close)
        self._link.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=5.0)
        self._process.kill()
        self._process.wait()
        if self._place is not None:
            self._place.remove()
            self._place = None
        # Workers that have ended by now may have left theirs.
        folders.sweep()


def _environment(folder: str) -> dict[str, str]:
    """All that a tuner's process is told of this one's."""
    kept = ("PATH", "LANG", "LC_ALL", "LD_LIBRARY_PATH", "CUDA_VISIBLE_DEVICES", "SYSTEMROOT")
    told = {name: os.environ[name] for name in kept if name in os.environ}
    # Without them a library would compute in another way, and sums would end in other digits.
    told |= {name: value for name, value in os.environ.items() if name.startswith(_NUMERICAL)}
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    return {**one, **told, "HOME": folder, "TMPDIR": folder, "PYTHONDONTWRITEBYTECODE": "1"}


class Child:
    """A process that has been started, and the channel to it.

    Attributes:
        channel: to it.
        seals: that hold, once it is ready.
    """

    def __init__(self, nursery_: Nursery, keeper: int, channel: Channel) -> None:
        self._nursery, self._keeper, self.channel = nursery_, keeper, channel
        self._open = True
        self.seals: list[str] = []

    @property
    def alive(self) -> bool:
        """Whether it has not been ended."""
        return self._open

    def ready(self) -> None:
        """Wait until it is.

        Raises:
            KilledError: it never was.
        """
        try:
            self.seals = self.channel.receive(deadline=perf_counter() + _PATIENCE).document()
        except (GoneError, TimeoutError, FoulError):
            raise KilledError(f"a tuner's process did not start ({self.end()})") from None

    def end(self, kill: bool = True) -> int | None:
        """End it; how it ended by itself, None where it had to be ended."""
        if not self._open:
            return None
        self._open = False
        self.channel.close()
        code = self._nursery.end(self._keeper, kill)
        if "disk" not in self.seals:
            self._nursery.empty()
        return code

    def receive(self, limit: int = TEXT_LIMIT, deadline: float = float("inf")) -> Message:
        """The next message of a process that runs a plugin's code.

        Raises:
            EndedError: it failed, took too long or is gone; the process has been ended.
            KilledError: it was killed from outside.
        """
        try:
            message = self.channel.receive(limit, deadline)
        except TimeoutError:
            self.end()
            raise EndedError("timeout", "") from None
        except FoulError as error:
            raise self._foul(str(error)) from None
        except GoneError:
            raise self._gone() from None
        if message.kind == b"D":
            raise EndedError("crashed", message.text())
        return message

    def send(self, kind: bytes, *parts: bytes | Array, deadline: float, **head: int) -> None:
        """Send it a message; raises as `receive`."""
        # An answer before the question would seem to take no time.
        if self.channel.spoken_to:
            raise self._foul("it spoke without having been asked")
        try:
            self.channel.send(kind, *parts, deadline=deadline, **head)
        except TimeoutError:
            self.end()
            raise EndedError("timeout", "") from None
        except GoneError:
            raise self._gone() from None

    def _foul(self, says: str) -> EndedError:
        self.end()
        return EndedError("crashed", f"the tuner's process broke the pipe: {says}")

    def _gone(self) -> EndedError | KilledError:
        code = self.end(kill=False)
        if code in _OUTSIDE:
            return KilledError(f"the tuner's process was killed by signal {-code}")
        return EndedError("crashed", _says(code))


def _says(code: int | None) -> str:
    """How a tuner's process ended, in words."""
    if code is None:
        return "the tuner's process closed its pipe and was ended"
    if code >= 0:
        return f"the tuner's process exited with code {code}"
    import signal

    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    return f"the tuner's process was killed by {name}"


class SealedTuner:
    """A tuner that has been built in its process.

    Args:
        child: started for it.
        tuned: which one.
        state: what it learned, where it learns.
        seconds: that building it may take.

    Raises:
        EndedError: it cannot be built; the process has been ended, or is to be.
    """

    def __init__(
        self,
        child: Child,
        tuned: Tuned,
        state: Mapping[str, NDArray[Any]] | None = None,
        seconds: float = _PATIENCE,
    ) -> None:
        self.child = child
        child.ready()
        deadline = perf_counter() + max(seconds, _PATIENCE)
        wanted = {
            "name": tuned.name,
            "module": tuned.module,
            "file": tuned.file,
            "options": dict(tuned.options),
        }
        child.send(b"B", json.dumps(wanted).encode(), deadline=deadline)
        child.receive(deadline=deadline)
        if state is not None:
            child.send(b"L", *packed(state), deadline=deadline)
            child.receive(deadline=deadline)


@dataclass(frozen=True)
class Sealed:
    """A sealed tuner about to make one run; `tune` as of a tuner here.

    Attributes:
        tuner: in its process.
        stream: the seed of the run's random stream.
        seconds: after which it is ended.
    """

    tuner: SealedTuner
    stream: NDArray[np.uint32]
    seconds: float

    def tune(self, task: Task, _: np.random.Generator) -> SealedSteps:
        """Begin the run; its random numbers are drawn on the other side."""
        return SealedSteps(self.tuner.child, task, self.stream, self.seconds)


class SealedSteps:
    """A tuner's run beyond the pipe: `next`, `send` and `close` as of a generator of
    `methods.base.Steps`.
    """

    def __init__(
        self, child: Child, task: Task, stream: NDArray[np.uint32], seconds: float
    ) -> None:
        self._child, self._task, self._stream = child, task, stream
        self._deadline = perf_counter() + seconds
        self._farewell = min(seconds, _FAREWELL)
        self._pace = _Pace()
        self._waits = False
        self._limit = min(ASKED_LIMIT, 8 * task.dim * (task.budget + 2))

    def __next__(self) -> Array | Ask:
        task = self._task
        parts = packed(
            {
                "start": task.start,
                "observed": task.observed,
                "scale": task.scale,
                "training": task.training,
                "budget": np.array(min(task.budget, 1 << 62)),
                "lengths": np.array(task.lengths, dtype=np.int64),
                "initial": task.scene.initial,
                "inputs": task.scene.inputs,
                "stream": self._stream.astype(np.int64),
            }
        )
        self._child.send(b"T", *parts, deadline=self._deadline)
        return self._asked()

    def send(self, evaluation: Evaluation) -> Array | Ask:
        """Hand an evaluation over; what is asked for next."""
        flags = self._pace.step()
        # Until it asks again: where this fails, its process has been ended.
        self._waits = False
        self._child.send(
            b"E",
            evaluation.proposals.tobytes(),
            evaluation.losses.tobytes(),
            evaluation.observations.tobytes(),
            flags=flags,
            size=len(evaluation.losses),
            deadline=self._deadline,
        )
        return self._asked()

    def _asked(self) -> Array | Ask:
        self._waits = False
        message = self._child.receive(max(self._limit, TEXT_LIMIT), self._deadline)
        if message.kind == b"S":
            raise StopIteration(message.text())
        dim, n = self._task.dim, message.size
        try:
            numbers = message.numbers()
        except FoulError as error:
            numbers, n = np.empty(0), 0
            said = str(error)
        else:
            said = "it asked for nothing"
        recommends = message.flags == 1
        if message.kind != b"A" or not n or numbers.size != (n + recommends) * dim:
            self._child.end()
            raise EndedError("crashed", f"the tuner's process broke the pipe: {said}")
        self._waits = True
        if recommends:
            return Ask(numbers[dim:].reshape(n, dim), numbers[:dim])
        return numbers.reshape(n, dim)

    def close(self) -> None:
        """End the run; the process may serve another.

        Raises:
            EndedError: the tuner failed while it was closed.
        """
        self._pace.release()
        if self._waits:
            self._waits = False
            deadline = perf_counter() + self._farewell
            self._child.send(b"C", deadline=deadline)
            self._child.receive(deadline=deadline)


_QUICK = 5e-4
"""Seconds of an exchange below which it matters where the two sides work."""
_LOOK = 16
"""Exchanges that are measured before that is decided."""
_AGAIN = 1.0
"""Seconds after which it is decided anew: other work may have come to the processor."""


class _Pace:
    """Keeps both sides on one processor where they take turns quickly: waking another one up costs
    more than the work.

    Left to itself the kernel spreads the two, which costs 60 us an exchange; on one processor it
    is 8 us. For slow exchanges nothing is gained, and the kernel knows better.
    """

    def __init__(self) -> None:
        self._count, self._since = 0, perf_counter()
        self._home = None if not hasattr(os, "sched_getaffinity") else os.sched_getaffinity(0)
        self._pinned = False

    def step(self) -> int:
        """Count an exchange; the flags that tell the other side where to work, 0 for as before."""
        self._count += 1
        if self._count % _LOOK:
            return 0
        now = perf_counter()
        mean = (now - self._since) / _LOOK
        self._since = now
        if self._pinned and (mean > _QUICK or now > self._until):
            self.release()
            return 255
        if not self._pinned and mean < _QUICK:
            return self._pin(now)
        return 0

    def _pin(self, now: float) -> int:
        processor = _processor()
        if self._home is None or not 0 <= processor < 254:
            return 0
        os.sched_setaffinity(0, {processor})
        self._pinned, self._until = True, now + _AGAIN
        return processor + 1

    def release(self) -> None:
        """Let this side work anywhere again."""
        if self._pinned and self._home is not None:
            os.sched_setaffinity(0, self._home)
            self._pinned = False


def _processor() -> int:
    """The one that this process is on; -1 where that is not known."""
    try:
        return int(ctypes.CDLL(None).sched_getcpu())
    except (AttributeError, OSError):
        return -1
