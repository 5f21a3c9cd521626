"""Tuners' processes as the harness holds them: the nursery that starts them, and each of them with
the channel to it.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

from bench.sealing import folders, nursery
from bench.sealing.ended import EndedError, KilledError, how_it_ended, with_isolation
from bench.sealing.seals import ROOT, readable
from bench.sealing.wire import TEXT_LIMIT, Channel, FoulError, GoneError, Message, printable
from methods.base import Array
from sims.engines.compiled import kept as compiled

_START = (
    "import sys; sys.path[:] = {path!r}; from bench.sealing.nursery import main; main({descriptor})"
)
_PRELOADED = ("numpy.random", "bench.sealing.inside")
_NUMERICAL = ("OPENBLAS_", "MKL_", "OMP_", "NPY_")
"""With which the names of variables begin that tell numerical libraries how to compute."""
PATIENCE = 60.0
"""Seconds in which a process must have been started, and a tuner built."""
_OUTSIDE = (-9, -15)
"""How who was killed from outside ends: SIGKILL (also the kernel's, short of memory), SIGTERM."""


_COURTESY = 1.0
"""Seconds in which a process must have said what it has written."""
_FILES = 1_000_000
"""Largest number of files that is believed."""


class Written(NamedTuple):
    """What a tuner has written to the folder that is thrown away with its process.

    Attributes:
        files: their number.
        names: of the first of them.
    """

    files: int
    names: tuple[str, ...]


NOTHING_WRITTEN = Written(0, ())


def _name(said: object) -> str:
    """The name of a file that can stand in a line."""
    return " ".join(printable(str(said)[:100]).split())


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
    # Compiled steps are loaded from where they are kept, before anything is shut off.
    told["SIMGAP_COMPILED"] = "off" if compiled.is_off() else str(compiled.folder())
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
            self.seals = self.channel.receive(deadline=perf_counter() + PATIENCE).document()
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
            raise self.foul(str(error)) from None
        except GoneError:
            raise self._gone() from None
        if message.kind == b"D":
            raise EndedError("crashed", with_isolation(message.text()))
        return message

    def written(self) -> Written:
        """Return what the tuner has written to its folder since this was last asked.

        Nothing where the process does not answer: what it says of itself is a courtesy.
        """
        if not self._open:
            return NOTHING_WRITTEN
        deadline = perf_counter() + _COURTESY
        try:
            self.send(b"N", deadline=deadline)
            said = self.receive(deadline=deadline).document()
            count = max(0, min(int(said["count"]), _FILES))
            return Written(count, tuple(map(_name, said["names"][:3])) if count else ())
        except (EndedError, KilledError, FoulError):
            return NOTHING_WRITTEN
        except (TypeError, ValueError, LookupError, OverflowError):
            # JSON, but not what was asked for.
            return NOTHING_WRITTEN

    def send(self, kind: bytes, *parts: bytes | Array, deadline: float, **head: int) -> None:
        """Send it a message; raises as `receive`."""
        # An answer before the question would seem to take no time.
        if self.channel.spoken_to:
            raise self.foul("it spoke without having been asked")
        try:
            self.channel.send(kind, *parts, deadline=deadline, **head)
        except TimeoutError:
            self.end()
            raise EndedError("timeout", "") from None
        except GoneError:
            raise self._gone() from None

    def foul(self, says: str) -> EndedError:
        """End it, which said what nobody asked for; the error to raise."""
        self.end()
        return EndedError("crashed", f"the tuner's process broke the pipe: {says}")

    def _gone(self) -> EndedError | KilledError:
        code = self.end(kill=False)
        if code in _OUTSIDE:
            return KilledError(f"the tuner's process was killed by signal {-code}")
        return EndedError("crashed", how_it_ended("the tuner's process", code))
