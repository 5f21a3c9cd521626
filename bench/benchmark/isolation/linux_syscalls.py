"""Restrict a process by Linux system calls that the standard library does not provide.

Sources: man-pages landlock(7), namespaces(7), user_namespaces(7), mount_setattr(2), prctl(2),
https://man7.org/linux/man-pages. The filter of system calls is in `isolation.seccomp_filter`.
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

IS_LINUX = sys.platform.startswith("linux")
"""True if this system is Linux, which these restrictions need."""

CLONE_NEWUSER = 0x10000000
"""CLONE_NEWUSER: new user namespace, with capabilities inside it only."""
CLONE_NEWNS = 0x00020000
"""CLONE_NEWNS: new mount namespace."""
CLONE_NEWIPC = 0x08000000
"""CLONE_NEWIPC: new IPC namespace, without the shared memory of other processes."""
CLONE_NEWNET = 0x40000000
"""CLONE_NEWNET: new network namespace, without network devices."""
CLONE_NEWPID = 0x20000000
"""CLONE_NEWPID: new process namespace for children, who all end when the first of them ends."""

PR_SET_PDEATHSIG = 1
"""Option of prctl: the signal that a process gets when its parent ends."""
_PR_SET_DUMPABLE = 4
"""Option of prctl: whether other processes of the user may read this process's memory."""
_PR_SET_NO_NEW_PRIVS = 38
"""Option of prctl: programs that this process starts get no further privileges."""

_LANDLOCK_CREATE = 444
"""Number of the system call landlock_create_ruleset."""
_LANDLOCK_ADD_RULE = 445
"""Number of the system call landlock_add_rule."""
_LANDLOCK_RESTRICT = 446
"""Number of the system call landlock_restrict_self."""
_LANDLOCK_RULE_PATH_BENEATH = 1
"""Type of a Landlock rule on a file, or on a folder and its content."""
_LANDLOCK_READ = 1 << 0 | 1 << 2 | 1 << 3
"""Landlock rights to execute (as a library is), to read a file, and to read a folder."""
_LANDLOCK_ALL = ((1, (1 << 13) - 1), (2, 1 << 13), (3, 1 << 14), (5, 1 << 15))
"""Landlock rights on files, by the version of Landlock that introduced them."""
_LANDLOCK_OF_A_FILE = 1 << 0 | 1 << 1 | 1 << 2 | 1 << 14 | 1 << 15
"""Landlock rights that a rule for a file, not for a folder, may contain."""
_LANDLOCK_TCP = 0b11
"""Landlock rights to bind and to connect TCP sockets, since version 4."""
_LANDLOCK_SCOPE = 0b11
"""Landlock restrictions of abstract sockets and signals, since version 6."""


@cache
def load_libc() -> Any:
    """Return the C library."""
    return ctypes.CDLL(None, use_errno=True)


def check_result(result: int) -> int:
    """Return the result of a call if it succeeded.

    Raises:
        OSError: the call failed.
    """
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return result


def call_system(number: int, *arguments: Any) -> int:
    """Make a system call by its number.

    Args:
        number: number of the system call.
        arguments: arguments of the system call.

    Raises:
        OSError: the call failed.
    """
    return check_result(load_libc().syscall(ctypes.c_long(number), *arguments))


def prctl(option: int, value: Any = 0, further: Any = 0) -> None:
    """Change an attribute of this process; the man-page of prctl lists the options.

    Args:
        option: number of the option.
        value: first argument of the option, an integer.
        further: second argument of the option, such as a pointer; 0 for none.

    Raises:
        OSError: the call failed.
    """
    unsigned = ctypes.c_ulong
    check_result(
        load_libc().prctl(option, unsigned(value), further or unsigned(0), unsigned(0), unsigned(0))
    )


def unshare(flags: int) -> None:
    """Move this process into new namespaces.

    Args:
        flags: kinds of the namespaces, as bits such as `CLONE_NEWNET`.

    Raises:
        OSError: the kernel does not permit it.
    """
    if not IS_LINUX:
        raise OSError("namespaces need Linux")
    check_result(load_libc().unshare(ctypes.c_int(flags)))


def map_identity(user: int, group: int) -> None:
    """Map the current uid and gid into the new user namespace, so that file owners stay the same.

    Args:
        user: effective user id outside.
        group: effective group id outside.
    """
    # Without this, an unprivileged process may not map its group (user_namespaces(7)).
    Path("/proc/self/setgroups").write_text("deny", encoding="ascii")
    Path("/proc/self/uid_map").write_text(f"{user} {user} 1", encoding="ascii")
    Path("/proc/self/gid_map").write_text(f"{group} {group} 1", encoding="ascii")


_MS_PRIVATE = 1 << 18 | 1 << 14
"""MS_PRIVATE and MS_REC: mounts in this namespace are not visible in others."""
_MS_CAREFUL = 0b1110
"""MS_NOSUID, MS_NODEV and MS_NOEXEC."""


_MOUNT_SETATTR = 442
"""Number of the system call mount_setattr."""
_AT_FDCWD = -100
"""AT_FDCWD: relative paths begin at the current folder."""
_AT_RECURSIVE = 0x8000
"""AT_RECURSIVE: mount_setattr changes all mounts below the given one too."""
_READ_ONLY = 0b0011
"""MOUNT_ATTR_RDONLY and NOSUID."""


def mount_filesystem(kind: str, mount_point: str, options: str = "") -> None:
    """Mount a virtual file system, such as tmpfs or proc, in this mount namespace.

    Args:
        kind: type of the file system.
        mount_point: mount point.
        options: options of the file system.

    Raises:
        OSError: the kernel does not permit it.
    """
    _call_mount(kind, mount_point, _MS_CAREFUL, options)


def make_mounts_private() -> None:
    """Make all mounts of this namespace private, so that changes are not visible in others.

    Raises:
        OSError: the kernel does not permit it.
    """
    _call_mount("none", "/", _MS_PRIVATE, "")


def make_mounts_read_only() -> None:
    """Make all mounts of this namespace read-only, including access times of files.

    Raises:
        OSError: the kernel is older than 5.12, or does not permit it.
    """
    # Attributes to set and to clear, propagation, and user namespace (`struct mount_attr`).
    attributes = struct.pack("<QQQQ", _READ_ONLY, 0, 0, 0)
    size = ctypes.c_size_t(len(attributes))
    current_folder = ctypes.c_int(_AT_FDCWD)
    call_system(
        _MOUNT_SETATTR, current_folder, b"/", ctypes.c_uint(_AT_RECURSIVE), attributes, size
    )


def _call_mount(kind: str, mount_point: str, flags: int, options: str) -> None:
    """Mount a file system by the system call mount(2).

    Args:
        kind: type of the file system, which also serves as its source.
        mount_point: path at which it is mounted.
        flags: flags of mount(2).
        options: options of the file system.

    Raises:
        OSError: the kernel refuses.
    """
    filesystem = kind.encode()
    flags_argument = ctypes.c_ulong(flags)
    check_result(
        load_libc().mount(
            filesystem,
            os.fsencode(mount_point),
            filesystem,
            flags_argument,
            options.encode() or None,
        )
    )


def set_parent_death_signal() -> None:
    """Have this process killed when its parent ends for any reason."""
    if IS_LINUX:
        prctl(PR_SET_PDEATHSIG, 9)


def set_not_dumpable() -> None:
    """Prevent other processes of this user from reading this one's memory, files or environment."""
    if IS_LINUX:
        prctl(_PR_SET_DUMPABLE, 0)


@contextmanager
def not_dumpable() -> Iterator[None]:
    """Protect the memory of this process within the block; see `set_not_dumpable`."""
    set_not_dumpable()
    try:
        yield
    finally:
        if IS_LINUX:
            prctl(_PR_SET_DUMPABLE, 1)


def set_no_new_privileges() -> None:
    """Prevent this process and its children from gaining privileges."""
    prctl(_PR_SET_NO_NEW_PRIVS, 1)


def get_landlock_version() -> int:
    """Return the version of Landlock in the kernel; 0 for none."""
    if not IS_LINUX:
        return 0
    try:
        return call_system(_LANDLOCK_CREATE, None, ctypes.c_size_t(0), ctypes.c_uint32(1))
    except OSError:
        return 0


def restrict_file_access(readable: Iterable[str], writable: Iterable[str]) -> None:
    """Restrict this process and its children to some files and folders, by Landlock.

    Landlock is a part of Linux with which a process gives up rights for ever. A set of rules is
    created, a rule for each path is added, and the set is applied. Newer versions of Landlock also
    block TCP connections, signals and abstract sockets to processes outside.

    Args:
        readable: readable files and folders; missing ones are ignored.
        writable: readable and writable files and folders; missing ones are ignored.

    Raises:
        OSError: the kernel has no Landlock.
    """
    version = get_landlock_version()
    if not version:
        raise OSError("the kernel has no Landlock")
    # Bits of all rights that this version knows; they are forbidden unless a rule permits them.
    all_rights = sum(rights for min_version, rights in _LANDLOCK_ALL if min_version <= version)
    # The C structure landlock_ruleset_attr. Versions 4 and 6 extended it, and the kernel accepts
    # the shorter ones.
    fields = [all_rights]
    if version >= 4:
        fields.append(_LANDLOCK_TCP)
    if version >= 6:
        fields.append(_LANDLOCK_SCOPE)
    attributes = struct.pack(f"<{len(fields)}Q", *fields)
    size = ctypes.c_size_t(len(attributes))
    rules = call_system(_LANDLOCK_CREATE, attributes, size, ctypes.c_uint32(0))
    try:
        for path in readable:
            _add_landlock_rule(rules, path, _LANDLOCK_READ & all_rights)
        for path in writable:
            _add_landlock_rule(rules, path, all_rights)
        set_no_new_privileges()
        call_system(_LANDLOCK_RESTRICT, ctypes.c_int(rules), ctypes.c_uint32(0))
    finally:
        os.close(rules)


def _add_landlock_rule(rules: int, path: str, rights: int) -> None:
    """Add a Landlock rule that gives a process `rights` on a file, or on a folder and its content.

    A path that does not exist or cannot be opened is skipped: it then remains forbidden.

    Args:
        rules: file descriptor of the Landlock rule set.
        path: file or folder.
        rights: bits of the Landlock access rights; those that only apply to folders are removed
            for a file, because the kernel would refuse the rule.
    """
    try:
        descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except OSError:
        return
    try:
        if not os.path.isdir(path):
            rights &= _LANDLOCK_OF_A_FILE
        attributes = struct.pack("<Qi", rights, descriptor)
        call_system(
            _LANDLOCK_ADD_RULE,
            ctypes.c_int(rules),
            ctypes.c_int(_LANDLOCK_RULE_PATH_BENEATH),
            attributes,
            ctypes.c_uint32(0),
        )
    finally:
        os.close(descriptor)
