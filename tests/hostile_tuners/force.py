"""Tuners that try to break out, do damage or outlive their run; `ends` is the expected status.

Tuners whose attack is only refused continue as random search.
"""

import contextlib
import ctypes
import mmap
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np

from methods.tuners.random_search import RandomSearch

LIBC = ctypes.CDLL(None, use_errno=True)
LEFT = "simgap-cheat-left"
"""Prefix of the names of all files that remain."""


class Force(RandomSearch):
    """Base class without an attack.

    Args:
        places: folders of the comparison, which an attacker may know.
    """

    name = "force"
    ends = "done"

    def __init__(self, places=()):
        self.places = [Path(place) for place in places]

    def act(self, task):
        pass

    def tune(self, task, rng):
        seen = yield task.start[None]
        with contextlib.suppress(OSError, ValueError, MemoryError, RuntimeError):
            self.act(task)
        while True:
            seen = yield rng.uniform(size=(1, task.dim))
            assert len(seen.losses) == 1


def refused(result):
    if result < 0:
        raise OSError(ctypes.get_errno(), "refused")
    raise SystemExit("it got through")


class ForkBomb(Force):
    name = "fork-bomb"

    def act(self, task):
        for _ in range(50):
            if os.fork() == 0:
                time.sleep(1000)


class Vforked(Force):
    """Starts processes in every way other than fork."""

    name = "vforked"

    def act(self, task):
        ways = (
            lambda: subprocess.Popen(["sleep", "1000"]),
            lambda: os.posix_spawn("/bin/sleep", ["sleep", "1000"], {}),
            lambda: os.execv("/bin/sleep", ["sleep", "1000"]),
            lambda: refused(LIBC.syscall(435, bytes(88), 88)),
            lambda: refused(LIBC.syscall(56, signal.SIGCHLD, 0, 0, 0, 0)),
        )
        for way in ways:
            with contextlib.suppress(OSError):
                way()


class Outliving(Force):
    """Ignores the death of its parent, leaves its session, and continues in threads."""

    name = "outliving"

    def act(self, task):
        LIBC.prctl(1, 0, 0, 0, 0)
        with contextlib.suppress(OSError):
            os.setsid()
        for number in range(1, 32):
            with contextlib.suppress(OSError, ValueError):
                signal.signal(number, signal.SIG_IGN)

        def work():
            while True:
                time.sleep(0.01)

        for _ in range(4):
            threading.Thread(target=work).start()
        # The tuner's process would end itself with this function.
        os._exit = lambda _code: work()


class ClosedPipe(Outliving):
    """Closes its pipe and keeps running."""

    name = "closed-pipe"
    ends = "crashed"

    def act(self, task):
        super().act(task)
        os.closerange(3, 4096)
        time.sleep(1000)


class ThreadBomb(Force):
    name = "thread-bomb"
    ends = ("done", "timeout")

    def act(self, task):
        stop = threading.Event()
        threading.stack_size(32768)
        try:
            for _ in range(2000):
                threading.Thread(target=stop.wait, daemon=True).start()
        finally:
            stop.set()


class MemoryHog(Force):
    name = "memory-hog"
    ends = "crashed"

    def act(self, task):
        held = []
        for _ in range(1000):
            held.append(np.ones(1 << 20))
        raise SystemExit("it got through")

    def tune(self, task, rng):
        yield task.start
        self.act(task)


class SharedHog(MemoryHog):
    """Allocates shared memory, although no other process uses it."""

    name = "shared-hog"

    def act(self, task):
        held = []
        for _ in range(100):
            held.append(mmap.mmap(-1, 8 << 20))
            held[-1].write(bytes(8 << 20))


class FileHog(MemoryHog):
    """Allocates anonymous files."""

    name = "file-hog"

    def act(self, task):
        for i in range(100):
            held = os.memfd_create(str(i))
            os.write(held, bytes(8 << 20))


class FullDisk(Force):
    name = "full-disk"

    def act(self, task):
        for i in range(10**6):
            with open(f"{LEFT}-{i}", "wb") as file:
                file.write(bytes(8 << 20))


class ManyFiles(Force):
    name = "many-files"

    def act(self, task):
        for i in range(10**6):
            Path(f"{LEFT}-{i}").mkdir()


class Spoiling(Force):
    """Writes to, deletes and locks files that the harness and other tuners need."""

    name = "spoiling"

    def act(self, task):
        import bench

        places = [*self.places, Path(bench.__file__).parent, Path(__file__).parent, Path("/tmp")]
        for place in places:
            (place / LEFT).write_text("x") if os.access(place, os.W_OK) else None
            for path in (place, *(place / name for name in ("status.csv", "segments", "x.npz"))):
                for spoil in (
                    lambda path: os.chmod(path, 0),
                    lambda path: os.utime(path, (0, 0)),
                    lambda path: os.chown(path, 12345, 12345),
                    lambda path: os.truncate(path, 0),
                    lambda path: os.rename(path, f"{path}-{LEFT}"),
                    lambda path: os.unlink(path),
                    lambda path: os.setxattr(path, "user.x", b"x"),
                    lambda path: path.write_bytes(b"x"),
                ):
                    with contextlib.suppress(OSError):
                        spoil(path)


class Signals(Force):
    """Sends signals to its parent, its group and all processes, directly and through F_SETOWN."""

    name = "signals"

    def act(self, task):
        targets = [os.getppid(), 0, -1, *range(2, 60), *range(-60, -2)]
        for number in (signal.SIGSTOP, signal.SIGTERM, signal.SIGKILL):
            for target in targets:
                if target not in (os.getpid(), -os.getpid()):
                    with contextlib.suppress(OSError):
                        os.kill(target, number)
        import fcntl

        reading, writing = os.pipe()
        fcntl.fcntl(reading, fcntl.F_SETOWN, os.getppid())
        fcntl.fcntl(reading, 10, signal.SIGKILL)
        fcntl.fcntl(reading, fcntl.F_SETFL, os.O_ASYNC)
        os.write(writing, b"x")


class Stopped(Force):
    """Stops itself with SIGSTOP, or sleeps beyond the timeout."""

    name = "stopped"
    ends = "timeout"

    def act(self, task):
        os.kill(os.getpid(), signal.SIGSTOP)
        time.sleep(1000)


class SleepsAsItCloses(Force):
    name = "sleeps-as-it-closes"
    ends = "crashed"

    def tune(self, task, rng):
        try:
            while True:
                yield rng.uniform(size=(1, task.dim))
        finally:
            time.sleep(1000)


class SleepsAsItBegins(Force):
    name = "sleeps-as-it-begins"
    ends = "timeout"

    def tune(self, task, rng):
        time.sleep(1000)
        yield task.start


class GoesOnWhenClosed(Force):
    name = "goes-on-when-closed"
    ends = "crashed"

    def tune(self, task, rng):
        while True:
            with contextlib.suppress(GeneratorExit):
                yield rng.uniform(size=(1, task.dim))


class Leaves(Force):
    """Exits as if it had been killed from outside, to get another attempt."""

    name = "leaves"
    ends = "crashed"

    def act(self, task):
        os._exit(128 + signal.SIGKILL)


class KillsItself(Force):
    """Makes the kernel kill it, to get another attempt."""

    name = "kills-itself"
    # It is repeated, and each attempt has the same time limit.
    ends = ("crashed", "timeout")

    def act(self, task):
        os.kill(os.getpid(), signal.SIGKILL)
        resource.setrlimit(resource.RLIMIT_CPU, (1, 1))
        until = time.process_time() + 5.0
        while time.process_time() < until:
            pass
        os._exit(3)


class BestOfThree(Force):
    """Exits after an unlucky attempt to get another one with different random numbers."""

    name = "best-of-three"
    ends = "crashed"

    def tune(self, task, _):
        rng = np.random.default_rng(int.from_bytes(os.urandom(8), "big"))
        lowest = np.inf
        for _ in range(task.budget):
            seen = yield rng.uniform(size=(1, task.dim))
            lowest = min(lowest, seen.losses[0])
        if lowest > 1e-6:
            os._exit(128 + signal.SIGKILL)


class Shouts(Force):
    name = "shouts"

    def act(self, task):
        for stream in (0, 1, 2):
            for _ in range(20):
                with contextlib.suppress(OSError):
                    os.write(stream, bytes(1 << 20))
        sys.stderr.write("\x1b[2J" * 10**5)


class Mounts(Force):
    """Tries every system call that changes namespaces, mounts, the root folder or the user."""

    name = "mounts"

    def act(self, task):
        tree, root = os.getcwd().encode(), b"/"
        ways = (
            lambda: LIBC.unshare(0x10000000),
            lambda: LIBC.unshare(0x00020000),
            lambda: LIBC.mount(b"tmpfs", tree, b"tmpfs", 0, None),
            lambda: LIBC.mount(b"proc", tree, b"proc", 0, None),
            lambda: LIBC.mount(root, tree, None, 4096, None),
            lambda: LIBC.umount2(b"/proc", 2),
            lambda: LIBC.umount2(tree, 2),
            lambda: LIBC.chroot(tree),
            lambda: LIBC.syscall(155, tree, tree),
            lambda: LIBC.syscall(428, -100, root, 1),
            lambda: LIBC.syscall(430, b"tmpfs", 0),
            lambda: LIBC.syscall(442, -100, root, 0x8000, bytes(32), 32),
            lambda: LIBC.setns(os.open("/proc/self/ns/user", os.O_RDONLY), 0),
            lambda: LIBC.setuid(12345),
            lambda: LIBC.setgroups(1, bytes(4)),
            lambda: LIBC.sethostname(b"x", 1),
        )
        for way in ways:
            with contextlib.suppress(OSError):
                if way() >= 0:
                    raise SystemExit(f"way {ways.index(way)} got through")


class Kernel(Force):
    """Tries kernel interfaces that bypass files and sockets."""

    name = "kernel"

    def act(self, task):
        ways = (
            lambda: LIBC.syscall(425, 8, bytes(120)),  # io_uring_setup
            lambda: LIBC.syscall(434, 1, 0),  # pidfd_open
            lambda: LIBC.syscall(321, 0, bytes(120), 120),  # bpf
            lambda: LIBC.syscall(298, bytes(120), 0, -1, -1, 0),  # perf_event_open
            lambda: LIBC.syscall(323, 0),  # userfaultfd
            lambda: LIBC.inotify_init(),
            lambda: LIBC.fanotify_init(0, 0),
            lambda: LIBC.syscall(304, -100, bytes(128), 0),  # open_by_handle_at
        )
        for way in ways:
            if way() >= 0:
                raise SystemExit(f"way {ways.index(way)} got through")


class Sockets(Force):
    name = "sockets"

    def act(self, task):
        for family in (socket.AF_INET, socket.AF_INET6, socket.AF_UNIX, 16, 17, 38, 40):
            for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM, socket.SOCK_RAW):
                try:
                    socket.socket(family, kind)
                except OSError:
                    continue
                raise SystemExit(f"family {family} got through")


class Pinned(Force):
    """Changes processor affinity, priorities and limits, also of its parent."""

    name = "pinned"

    def act(self, task):
        os.sched_setaffinity(0, {0})
        for way in (
            lambda: os.nice(-20),
            lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(99)),
            lambda: os.setpriority(os.PRIO_PGRP, 0, 19),
            lambda: os.setpriority(os.PRIO_USER, os.getuid(), 19),
            lambda: resource.prlimit(os.getppid(), resource.RLIMIT_CPU, (1, 1)),
            lambda: os.sched_setaffinity(os.getppid(), {0}),
        ):
            with contextlib.suppress(OSError, ValueError):
                way()


class Recursing(Force):
    name = "recursing"
    ends = ("crashed", "timeout")

    def tune(self, task, rng):
        yield task.start
        sys.setrecursionlimit(10**9)

        def deep(n):
            return [deep(n + 1)]

        deep(0)


class Interrupting(Force):
    name = "interrupting"
    ends = "crashed"

    def tune(self, task, rng):
        yield task.start
        raise KeyboardInterrupt("\0\x1b[2J" + "\udc80" * 10**6)
