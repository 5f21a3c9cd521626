"""What Linux can take away from a process, by its system calls; nothing of this is in the standard
library.

Sources: man-pages landlock(7), namespaces(7), user_namespaces(7), mount_setattr(2), prctl(2),
https://man7.org/linux/man-pages. The filter of system calls is `bench.sealing.calls`.
"""

from __future__ import annotations

import ctypes
import os
import struct
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

LINUX = sys.platform.startswith("linux")
"""Whether any of this is there at all."""

NEW_USER = 0x10000000
"""CLONE_NEWUSER: root of nothing but what belongs to it."""
NEW_MOUNTS = 0x00020000
"""CLONE_NEWNS: folders of its own."""
NEW_IPC = 0x08000000
"""CLONE_NEWIPC: none of the others' shared memory by name."""
NEW_NETWORK = 0x40000000
"""CLONE_NEWNET: no network device."""
NEW_PROCESSES = 0x20000000
"""CLONE_NEWPID: children see none but themselves, and die with the first of them."""

PR_SET_PDEATHSIG = 1
"""The signal that a process gets when its parent ends."""
_PR_SET_DUMPABLE = 4
_PR_SET_NO_NEW_PRIVS = 38

_LANDLOCK_CREATE = 444
_LANDLOCK_ADD_RULE = 445
_LANDLOCK_RESTRICT = 446
_LANDLOCK_READ = 1 << 0 | 1 << 2 | 1 << 3
"""Execute (as a library is), read a file, read a folder."""
_LANDLOCK_ALL = ((1, (1 << 13) - 1), (2, 1 << 13), (3, 1 << 14), (5, 1 << 15))
"""Rights on files by the version that brought them."""
_LANDLOCK_OF_A_FILE = 1 << 0 | 1 << 1 | 1 << 2 | 1 << 14 | 1 << 15
"""Those that a rule about a file, and no folder, may name."""
_LANDLOCK_TCP = 0b11
"""To bind and to connect, since version 4."""
_LANDLOCK_SCOPE = 0b11
"""Abstract sockets and signals, since version 6."""


@cache
def libc() -> Any:
    """The C library."""
    return ctypes.CDLL(None, use_errno=True)


def checked(result: int) -> int:
    """The result of a call.

    Raises:
        OSError: it failed.
    """
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return result


def call(number: int, *arguments: Any) -> int:
    """Make a system call by its number.

    Raises:
        OSError: it failed.
    """
    return checked(libc().syscall(ctypes.c_long(number), *arguments))


def prctl(option: int, value: Any = 0, further: Any = 0) -> None:
    """Change what the kernel does with this process.

    Raises:
        OSError: it does not.
    """
    unsigned = ctypes.c_ulong
    checked(libc().prctl(option, unsigned(value), further or unsigned(0), unsigned(0), unsigned(0)))


def unshare(flags: int) -> None:
    """Leave the namespaces of these flags for new ones.

    Raises:
        OSError: the kernel does not let this process.
    """
    if not LINUX:
        raise OSError("namespaces need Linux")
    checked(libc().unshare(ctypes.c_int(flags)))


def keep_identity(user: int, group: int) -> None:
    """In a new user namespace: be who one was, so that files belong to whom they did."""
    # Without this a process without rights may not map its group (user_namespaces(7)).
    Path("/proc/self/setgroups").write_text("deny", encoding="ascii")
    Path("/proc/self/uid_map").write_text(f"{user} {user} 1", encoding="ascii")
    Path("/proc/self/gid_map").write_text(f"{group} {group} 1", encoding="ascii")


_MS_PRIVATE = 1 << 18 | 1 << 14
"""MS_PRIVATE and MS_REC: what is mounted here stays here."""
_MS_CAREFUL = 0b1110
"""MS_NOSUID, MS_NODEV and MS_NOEXEC."""


_MOUNT_SETATTR = 442
_AT_RECURSIVE = 0x8000
_READ_ONLY = 0b0011
"""MOUNT_ATTR_RDONLY and NOSUID."""


def mount(kind: str, place: str, options: str = "") -> None:
    """Mount a file system without files of its own, such as tmpfs or proc, in this namespace.

    Raises:
        OSError: the kernel does not let this process.
    """
    _mount(kind, place, _MS_CAREFUL, options)


def private_mounts() -> None:
    """Let nothing that is mounted in this namespace be seen outside.

    Raises:
        OSError: the kernel does not let this process.
    """
    _mount("none", "/", _MS_PRIVATE, "")


def read_only_mounts() -> None:
    """Let nothing be changed on what is mounted in this namespace, not even when a file was read.

    Raises:
        OSError: the kernel is older than 5.12 or does not let this process.
    """
    attributes = struct.pack("<QQQQ", _READ_ONLY, 0, 0, 0)
    size = ctypes.c_size_t(len(attributes))
    here = ctypes.c_int(-100)
    call(_MOUNT_SETATTR, here, b"/", ctypes.c_uint(_AT_RECURSIVE), attributes, size)


def _mount(kind: str, place: str, flags: int, options: str) -> None:
    text = kind.encode()
    held = ctypes.c_ulong(flags)
    checked(libc().mount(text, os.fsencode(place), text, held, options.encode() or None))


def die_with_parent() -> None:
    """Be killed when the process that started this one ends, however it does."""
    if LINUX:
        prctl(PR_SET_PDEATHSIG, 9)


def hide_memory() -> None:
    """Let no other process of this user read this one's memory, files or environment."""
    if LINUX:
        prctl(_PR_SET_DUMPABLE, 0)


@contextmanager
def memory_hidden() -> Iterator[None]:
    """Within the block this process is as after `hide_memory`."""
    hide_memory()
    try:
        yield
    finally:
        if LINUX:
            prctl(_PR_SET_DUMPABLE, 1)


def no_new_rights() -> None:
    """Let nothing that this process starts have more rights than it."""
    prctl(_PR_SET_NO_NEW_PRIVS, 1)


def landlock_version() -> int:
    """The version of Landlock that the kernel has; 0 for none."""
    if not LINUX:
        return 0
    try:
        return call(_LANDLOCK_CREATE, None, ctypes.c_size_t(0), ctypes.c_uint32(1))
    except OSError:
        return 0


def landlock(readable: Iterable[str], writable: Iterable[str]) -> None:
    """Let this process and what it starts reach these files and folders and no other; no network
    by TCP, no signal and no abstract socket beyond them either, where the kernel can refuse those.

    Args:
        readable: files and folders; those that are not there are left out.
        writable: likewise, to be read and written.

    Raises:
        OSError: the kernel has no Landlock.
    """
    version = landlock_version()
    if not version:
        raise OSError("the kernel has no Landlock")
    everything = sum(rights for since, rights in _LANDLOCK_ALL if since <= version)
    network = _LANDLOCK_TCP if version >= 4 else 0
    scope = _LANDLOCK_SCOPE if version >= 6 else 0
    # Each version lengthened the structure, and the kernel takes the shorter ones.
    fields = (everything, network, scope)[: 1 + (version >= 4) + (version >= 6)]
    attributes = struct.pack(f"<{len(fields)}Q", *fields)
    size = ctypes.c_size_t(len(attributes))
    rules = call(_LANDLOCK_CREATE, attributes, size, ctypes.c_uint32(0))
    try:
        for path in readable:
            _allow(rules, path, _LANDLOCK_READ & everything)
        for path in writable:
            _allow(rules, path, everything)
        no_new_rights()
        call(_LANDLOCK_RESTRICT, ctypes.c_int(rules), ctypes.c_uint32(0))
    finally:
        os.close(rules)


def _allow(rules: int, path: str, rights: int) -> None:
    try:
        place = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except OSError:
        return
    try:
        if not os.path.isdir(path):
            rights &= _LANDLOCK_OF_A_FILE
        attributes = struct.pack("<Qi", rights, place)
        call(
            _LANDLOCK_ADD_RULE, ctypes.c_int(rules), ctypes.c_int(1), attributes, ctypes.c_uint32(0)
        )
    finally:
        os.close(place)
