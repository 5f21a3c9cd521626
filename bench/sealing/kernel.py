"""What Linux can take away from a process, by its system calls; nothing of this is in the standard
library.

Sources: man-pages landlock(7), namespaces(7), user_namespaces(7), seccomp(2), prctl(2), capset(2),
https://man7.org/linux/man-pages; the numbers of system calls: the kernel's
``arch/x86/entry/syscalls/syscall_64.tbl`` and ``include/uapi/asm-generic/unistd.h``.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
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

_PR_SET_PDEATHSIG = 1
_PR_SET_DUMPABLE = 4
_PR_SET_SECCOMP = 22
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

_NUMBERS: Mapping[str, Mapping[str, int]] = {
    "x86_64": {
        "fork": 57, "vfork": 58, "clone": 56, "clone3": 435, "execve": 59, "execveat": 322,
        "ptrace": 101, "process_vm_readv": 310, "process_vm_writev": 311, "unshare": 272,
        "setns": 308, "mount": 165, "umount2": 166, "bpf": 321, "perf_event_open": 298,
        "add_key": 248, "request_key": 249, "keyctl": 250, "userfaultfd": 323, "kcmp": 312,
        "io_uring_setup": 425, "pidfd_open": 434, "pidfd_getfd": 438, "shmget": 29, "semget": 64,
        "msgget": 68, "socket": 41, "capset": 126,
    },
    "aarch64": {
        "clone": 220, "clone3": 435, "execve": 221, "execveat": 281, "ptrace": 117,
        "process_vm_readv": 270, "process_vm_writev": 271, "unshare": 97, "setns": 268,
        "mount": 40, "umount2": 39, "bpf": 280, "perf_event_open": 241, "add_key": 217,
        "request_key": 218, "keyctl": 219, "userfaultfd": 282, "kcmp": 272,
        "io_uring_setup": 425, "pidfd_open": 434, "pidfd_getfd": 438, "shmget": 194,
        "semget": 190, "msgget": 186, "socket": 198, "capset": 91,
    },
}  # fmt: skip
"""Of the calls that are taken away, by machine."""
_ARCHITECTURES = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
"""AUDIT_ARCH of each machine: a call by another's numbers is none of ours."""
_ABSENT = ("clone3", "io_uring_setup")
"""Calls that libraries try first and do without where the kernel says that it has none."""
_JUDGED = ("clone", "socket", "capset")
"""Calls whose arguments say whether they are allowed, or that are ours alone."""


@cache
def _libc() -> Any:
    return ctypes.CDLL(None, use_errno=True)


def _checked(result: int) -> int:
    """The result of a call.

    Raises:
        OSError: it failed.
    """
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return result


def _call(number: int, *arguments: Any) -> int:
    return _checked(_libc().syscall(ctypes.c_long(number), *arguments))


def _prctl(option: int, value: Any = 0, further: Any = 0) -> None:
    unsigned = ctypes.c_ulong
    _checked(
        _libc().prctl(option, unsigned(value), further or unsigned(0), unsigned(0), unsigned(0))
    )


def unshare(flags: int) -> None:
    """Leave the namespaces of these flags for new ones.

    Raises:
        OSError: the kernel does not let this process.
    """
    if not LINUX:
        raise OSError("namespaces need Linux")
    _checked(_libc().unshare(ctypes.c_int(flags)))


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


def _mount(kind: str, place: str, flags: int, options: str) -> None:
    text = kind.encode()
    held = ctypes.c_ulong(flags)
    _checked(_libc().mount(text, os.fsencode(place), text, held, options.encode() or None))


def die_with_parent() -> None:
    """Be killed when the process that started this one ends, however it does."""
    if LINUX:
        _prctl(_PR_SET_PDEATHSIG, 9)


def hide_memory() -> None:
    """Let no other process of this user read this one's memory, files or environment."""
    if LINUX:
        _prctl(_PR_SET_DUMPABLE, 0)


@contextmanager
def memory_hidden() -> Iterator[None]:
    """Within the block this process is as after `hide_memory`."""
    hide_memory()
    try:
        yield
    finally:
        if LINUX:
            _prctl(_PR_SET_DUMPABLE, 1)


def no_new_rights() -> None:
    """Let nothing that this process starts have more rights than it."""
    _prctl(_PR_SET_NO_NEW_PRIVS, 1)


def drop_capabilities() -> None:
    """Give up every right of a superuser, also of a namespace's own."""
    version_3 = struct.pack("<Ii", 0x20080522, 0)
    _call(_NUMBERS[platform.machine()]["capset"], version_3, bytes(24))


def landlock_version() -> int:
    """The version of Landlock that the kernel has; 0 for none."""
    if not LINUX:
        return 0
    try:
        return _call(_LANDLOCK_CREATE, None, ctypes.c_size_t(0), ctypes.c_uint32(1))
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
    rules = _call(_LANDLOCK_CREATE, attributes, size, ctypes.c_uint32(0))
    try:
        for path in readable:
            _allow(rules, path, _LANDLOCK_READ & everything)
        for path in writable:
            _allow(rules, path, everything)
        no_new_rights()
        _call(_LANDLOCK_RESTRICT, ctypes.c_int(rules), ctypes.c_uint32(0))
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
        _call(
            _LANDLOCK_ADD_RULE, ctypes.c_int(rules), ctypes.c_int(1), attributes, ctypes.c_uint32(0)
        )
    finally:
        os.close(place)


_LOAD, _EQUAL, _AT_LEAST, _ANY_BIT, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
"""Instructions of a filter: load a word, jump where it equals, is at least, has a bit; return."""
_ALLOW, _KILL = 0x7FFF0000, 0x80000000
"""Verdicts of a filter."""
_EPERM, _ENOSYS = 0x00050000 | 1, 0x00050000 | 38
"""The call fails: not permitted; there is no such call."""
_THREAD = 0x00010000
"""CLONE_THREAD: what is made is a thread of this process."""
_UNIX = 1
"""AF_UNIX: sockets within this machine, which libraries make for themselves."""
_X32 = 0x40000000
"""From which on calls are numbered of a kind that nobody uses."""


def can_filter() -> bool:
    """Whether `refuse_processes` knows this machine."""
    return LINUX and platform.machine() in _ARCHITECTURES and sys.byteorder == "little"


def refuse_processes() -> None:
    """Let this process start no other, look into none, and reach no network; threads stay.

    Raises:
        OSError: the kernel does not filter system calls, or this machine's are not known here.
    """
    if not can_filter():
        raise OSError(f"no filter for {platform.machine()}")
    machine = platform.machine()
    program = _program(_ARCHITECTURES[machine], _NUMBERS[machine])
    lines = ctypes.create_string_buffer(b"".join(struct.pack("<HBBI", *line) for line in program))
    header = struct.pack("<HxxxxxxQ", len(program), ctypes.addressof(lines))
    no_new_rights()
    _prctl(_PR_SET_SECCOMP, 2, ctypes.create_string_buffer(header))


Line = tuple[int, int, int, int]
"""Instruction, lines to skip where it holds, where it does not, its number."""


def _program(architecture: int, numbers: Mapping[str, int]) -> Sequence[Line]:
    """The filter: a call's number stands at offset 0, its machine at 4, its arguments from 16."""
    lines: list[Line] = [
        (_LOAD, 0, 0, 4),
        (_EQUAL, 1, 0, architecture),
        (_RETURN, 0, 0, _KILL),
        (_LOAD, 0, 0, 0),
        (_AT_LEAST, 0, 1, _X32),
        (_RETURN, 0, 0, _ENOSYS),
    ]
    for name, number in numbers.items():
        if name not in _JUDGED:
            verdict = _ENOSYS if name in _ABSENT else _EPERM
            lines += [(_EQUAL, 0, 1, number), (_RETURN, 0, 0, verdict)]
    lines += [
        # The first argument of clone says what is made: a thread is allowed.
        (_EQUAL, 0, 4, numbers["clone"]),
        (_LOAD, 0, 0, 16),
        (_ANY_BIT, 1, 0, _THREAD),
        (_RETURN, 0, 0, _EPERM),
        (_RETURN, 0, 0, _ALLOW),
        # That of socket says where to.
        (_EQUAL, 0, 4, numbers["socket"]),
        (_LOAD, 0, 0, 16),
        (_EQUAL, 1, 0, _UNIX),
        (_RETURN, 0, 0, _EPERM),
        (_RETURN, 0, 0, _ALLOW),
        (_RETURN, 0, 0, _ALLOW),
    ]
    return lines
