"""Tuners that pass their result to the next seed of the same target, each over another channel.

A tuner that receives something reports this when it stops; otherwise it continues as random search.
"""

import contextlib
import ctypes
import fcntl
import hashlib
import mmap
import os
import socket
import struct
import sys
import threading
from pathlib import Path

import numpy as np

from methods.tuners.random_search import RandomSearch

LIBC = ctypes.CDLL(None, use_errno=True)
HELD = []
"""Objects that must stay open so that other processes can find them."""


def checked(result):
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return result


class Between(RandomSearch):
    """Base class without a channel.

    Args:
        salt: separates comparisons that run at the same time.
        places: folders in which it may try to write.
    """

    name = "between"

    def __init__(self, salt="", places=()):
        self.salt, self.places = salt, places

    def tell(self, key, text):
        """Store a text under a key for the next run."""

    def hear(self, key):
        """Return the text that an earlier run stored."""
        return b""

    def tune(self, task, rng):
        hashed = hashlib.sha256(task.observed.tobytes() + self.salt.encode()).hexdigest()
        key = f"simgap-cheat-{self.name}-{hashed[:16]}"
        heard = b""
        with contextlib.suppress(Exception):
            heard = bytes(self.hear(key) or b"")
        best, lowest = task.start, np.inf
        if heard:
            best = np.clip(np.frombuffer(heard.ljust(8 * task.dim, b"\0")[: 8 * task.dim]), 0, 1)
        for used in range(task.budget):
            if heard and used == task.budget - 1:
                return f"received {len(heard)} bytes"
            seen = yield (rng.uniform(size=task.dim) if used else np.nan_to_num(best))[None]
            if seen.losses[0] < lowest:
                best, lowest = seen.proposals[0], seen.losses[0]
                with contextlib.suppress(Exception):
                    self.tell(key, best.tobytes())
        return None


STORED_TEXTS = {}


class Globals(Between):
    name = "globals"

    def tell(self, key, text):
        STORED_TEXTS[key] = text
        sys.modules.setdefault("kept_" + key, key)
        vars(np)[key] = text

    def hear(self, key):
        return STORED_TEXTS.get(key) or vars(np).get(key)


class Environ(Between):
    name = "environ"

    def tell(self, key, text):
        os.environ[key] = text.hex()

    def hear(self, key):
        return bytes.fromhex(os.environ.get(key, ""))


class Files(Between):
    """Uses files in every folder that might be writable."""

    name = "files"

    def paths(self, key):
        usual = (".", "/tmp", "/var/tmp", "/dev/shm", "/run", Path.home(), Path(__file__).parent)
        known = (Path(np.__file__).parent, Path(sys.prefix), *self.places)
        return [Path(folder) / key for folder in (*usual, *known)]

    def tell(self, key, text):
        for path in self.paths(key):
            with contextlib.suppress(OSError):
                path.write_bytes(text)

    def hear(self, key):
        for path in self.paths(key):
            with contextlib.suppress(OSError):
                return path.read_bytes()
        return b""


class SharedMemory(Between):
    name = "shared-memory"

    def tell(self, key, text):
        from multiprocessing import shared_memory

        with contextlib.suppress(FileExistsError):
            HELD.append(shared_memory.SharedMemory(key, create=True, size=4096))
            HELD[-1].buf[: len(text)] = text

    def hear(self, key):
        from multiprocessing import shared_memory

        return bytes(shared_memory.SharedMemory(key).buf[:16])


def number_of(key):
    return int.from_bytes(hashlib.sha256(key.encode()).digest()[:3], "big") + 1


class SystemV(Between):
    name = "system-v"

    def tell(self, key, text):
        LIBC.shmat.restype = ctypes.c_void_p
        held = checked(LIBC.shmget(number_of(key), 4096, 0o1600))
        ctypes.memmove(LIBC.shmat(held, None, 0), text, len(text))

    def hear(self, key):
        LIBC.shmat.restype = ctypes.c_void_p
        return ctypes.string_at(LIBC.shmat(checked(LIBC.shmget(number_of(key), 0, 0)), None, 0), 16)


class SystemVSemaphores(Between):
    name = "system-v-semaphores"

    def tell(self, key, text):
        held = checked(LIBC.semget(number_of(key), len(text), 0o1600))
        for i, byte in enumerate(text):
            LIBC.semctl(held, i, 16, ctypes.c_int(byte))

    def hear(self, key):
        held = checked(LIBC.semget(number_of(key), 0, 0))
        return bytes(LIBC.semctl(held, i, 12) for i in range(16))


class MessageQueue(Between):
    """Uses a POSIX message queue, which outlives its writer."""

    name = "message-queue"

    def opened(self, key, flags):
        LIBC.mq_open.argtypes = [ctypes.c_char_p, ctypes.c_int, ctypes.c_uint, ctypes.c_void_p]
        sizes = (ctypes.c_long * 8)(0, 1, 64)
        place = ctypes.addressof(sizes)
        return checked(LIBC.mq_open(f"/{key}".encode(), flags | os.O_NONBLOCK, 0o600, place))

    def tell(self, key, text):
        LIBC.mq_send(self.opened(key, os.O_CREAT | os.O_RDWR), text, len(text), 0)

    def hear(self, key):
        held = ctypes.create_string_buffer(64)
        queue = self.opened(key, os.O_RDWR)
        size = checked(LIBC.mq_receive(queue, held, 64, None))
        LIBC.mq_send(queue, held.raw[:size], size, 0)
        return held.raw[:size]


class AbstractSocket(Between):
    name = "abstract-socket"

    def tell(self, key, text):
        server = socket.socket(socket.AF_UNIX)
        server.bind("\0" + key)
        server.listen()
        HELD.append(server)

        def serve():
            while True:
                link, _ = server.accept()
                link.sendall(text)
                link.close()

        threading.Thread(target=serve, daemon=True).start()

    def hear(self, key):
        with socket.socket(socket.AF_UNIX) as link:
            link.settimeout(1.0)
            link.connect("\0" + key)
            return link.recv(16)


class Datagrams(Between):
    """Binds a name to one socket of an allowed socket pair, so that other processes can
    send to it.
    """

    name = "datagrams"

    def tell(self, key, text):
        one, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        HELD.extend((one, other))
        one.bind("\0" + key)

    def hear(self, key):
        one, _other = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        one.sendto(b"there it is", "\0" + key)
        return b"somebody has that name"


def library():
    """Return files that every process can read, always in the same order."""
    return sorted(Path(os.__file__).parent.glob("*.py"))[:130]


class Locks(Between):
    """Encodes each bit as a lock on a file."""

    name = "locks"

    def lock(self, file):
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def tell(self, key, text):
        bits = [1, *np.unpackbits(np.frombuffer(text, np.uint8))]
        for path, bit in zip(library(), bits, strict=False):
            if bit:
                HELD.append(path.open("rb"))
                self.lock(HELD[-1])

    def free(self, path):
        with path.open("rb") as file:
            try:
                self.lock(file)
            except OSError:
                return False
        return True

    def hear(self, key):
        bits = [not self.free(path) for path in library()]
        return np.packbits(bits[1:129]).tobytes() if bits[0] else b""


class RecordLocks(Locks):
    """Uses POSIX record locks, taken as a reader and tested as a writer."""

    name = "record-locks"

    def lock(self, file):
        fcntl.lockf(file, fcntl.LOCK_SH | fcntl.LOCK_NB)

    def free(self, path):
        with path.open("rb") as file:
            asked = struct.pack("hhqqi4x", fcntl.F_WRLCK, 0, 0, 0, 0)
            answer = fcntl.fcntl(file, fcntl.F_GETLK, asked)
            return struct.unpack("hhqqi4x", answer)[0] == fcntl.F_UNLCK


class Stamps(Between):
    """Uses the modification time of a file that it owns but may not write."""

    name = "stamps"

    def tell(self, key, text):
        (number,) = struct.unpack("<Q", text[:8])
        os.utime(__file__, ns=(1, number >> 4))

    def hear(self, key):
        found = os.stat(__file__)
        # An access time in 1970 cannot come from a normal read.
        return struct.pack("<Q", found.st_mtime_ns << 4) if found.st_atime < 1.0 else b""


class Rights(Between):
    """Uses the mode of a file that it owns but may not write."""

    name = "rights"

    def tell(self, key, text):
        os.chmod(__file__, os.stat(__file__).st_mode ^ 0o4000)

    def hear(self, key):
        return b"told" if os.stat(__file__).st_mode & 0o4000 else b""


class Attributes(Between):
    name = "attributes"

    def tell(self, key, text):
        os.setxattr(__file__, "user." + key, text)

    def hear(self, key):
        return os.getxattr(__file__, "user." + key)


class Keyring(Between):
    name = "keyring"

    def tell(self, key, text):
        checked(LIBC.syscall(248, b"user", key.encode(), text, len(text), -4))

    def hear(self, key):
        held = ctypes.create_string_buffer(16)
        found = checked(LIBC.syscall(249, b"user", key.encode(), None, 0))
        checked(LIBC.syscall(250, 11, found, held, 16))
        return held.raw


class Niceness(Between):
    """Uses the scheduling priority, which the next process inherits from its process group."""

    name = "niceness"

    def tell(self, key, text):
        os.setpriority(os.PRIO_PGRP, 0, 7)

    def hear(self, key):
        return b"nice" if os.getpriority(os.PRIO_PROCESS, 0) == 7 else b""


class Siblings(Between):
    """Searches /proc for other processes and reads their names."""

    name = "siblings"

    def tell(self, key, text):
        LIBC.prctl(15, text[:15], 0, 0, 0)

    def hear(self, key):
        for path in Path("/proc").glob("[0-9]*/comm"):
            if int(path.parent.name) != os.getpid():
                return path.read_bytes()
        return b""


class MappedFile(Between):
    """Uses a memory-mapped anonymous file, which other processes find in /proc."""

    name = "mapped-file"

    def tell(self, key, text):
        held = os.memfd_create(key)
        os.ftruncate(held, 4096)
        HELD.append(mmap.mmap(held, 4096))
        HELD[-1][: len(text)] = text

    def hear(self, key):
        for path in Path("/proc").glob("[0-9]*/fd/*"):
            if key in os.readlink(path) and int(path.parts[2]) != os.getpid():
                return path.read_bytes()[:16]
        return b""
