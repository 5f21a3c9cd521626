"""Seccomp filter of the system calls of a tuner's process.

Sources: man-pages seccomp(2), capset(2), https://man7.org/linux/man-pages; the numbers of system
calls: the kernel's ``arch/x86/entry/syscalls/syscall_64.tbl`` and
``include/uapi/asm-generic/unistd.h``.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
import sys
from collections.abc import Mapping, Sequence

from bench.benchmark.isolation.linux_syscalls import (
    IS_LINUX,
    PR_SET_PDEATHSIG,
    call_system,
    prctl,
    set_no_new_privileges,
)

_PR_SET_SECCOMP = 22

_NUMBERS: Mapping[str, Mapping[str, int]] = {
    "x86_64": {
        "fork": 57, "vfork": 58, "clone": 56, "clone3": 435, "execve": 59, "execveat": 322,
        "ptrace": 101, "process_vm_readv": 310, "process_vm_writev": 311, "unshare": 272,
        "setns": 308, "mount": 165, "umount2": 166, "bpf": 321, "perf_event_open": 298,
        "add_key": 248, "request_key": 249, "keyctl": 250, "userfaultfd": 323, "kcmp": 312,
        "io_uring_setup": 425, "pidfd_open": 434, "pidfd_getfd": 438, "shmget": 29, "semget": 64,
        "msgget": 68, "mq_open": 240, "capset": 126, "socket": 41, "socketpair": 53, "bind": 49,
        "connect": 42, "kill": 62, "tkill": 200, "tgkill": 234, "rt_sigqueueinfo": 129,
        "rt_tgsigqueueinfo": 297, "pidfd_send_signal": 424, "prctl": 157, "prlimit64": 302,
        "setpriority": 141, "ioprio_set": 251, "fcntl": 72, "flock": 73, "inotify_init": 253,
        "inotify_init1": 294, "fanotify_init": 300, "chmod": 90, "fchmod": 91, "fchmodat": 268,
        "fchmodat2": 452, "chown": 92, "fchown": 93, "lchown": 94, "fchownat": 260, "utime": 132,
        "utimes": 235, "futimesat": 261, "utimensat": 280, "setxattr": 188, "lsetxattr": 189,
        "fsetxattr": 190, "removexattr": 197, "lremovexattr": 198, "fremovexattr": 199,
        "setxattrat": 463, "removexattrat": 466, "file_setattr": 469, "truncate": 76,
        "cachestat": 451, "memfd_create": 319, "memfd_secret": 447, "mmap": 9,
    },
    "aarch64": {
        "clone": 220, "clone3": 435, "execve": 221, "execveat": 281, "ptrace": 117,
        "process_vm_readv": 270, "process_vm_writev": 271, "unshare": 97, "setns": 268,
        "mount": 40, "umount2": 39, "bpf": 280, "perf_event_open": 241, "add_key": 217,
        "request_key": 218, "keyctl": 219, "userfaultfd": 282, "kcmp": 272,
        "io_uring_setup": 425, "pidfd_open": 434, "pidfd_getfd": 438, "shmget": 194,
        "semget": 190, "msgget": 186, "mq_open": 180, "capset": 91, "socket": 198,
        "socketpair": 199, "bind": 200, "connect": 203, "kill": 129, "tkill": 130, "tgkill": 131,
        "rt_sigqueueinfo": 138, "rt_tgsigqueueinfo": 240, "pidfd_send_signal": 424, "prctl": 167,
        "prlimit64": 261, "setpriority": 140, "ioprio_set": 30, "fcntl": 25, "flock": 32,
        "inotify_init1": 26, "fanotify_init": 262, "fchmod": 52, "fchmodat": 53, "fchmodat2": 452,
        "fchown": 55, "fchownat": 54, "utimensat": 88, "setxattr": 5, "lsetxattr": 6,
        "fsetxattr": 7, "removexattr": 14, "lremovexattr": 15, "fremovexattr": 16,
        "setxattrat": 463, "removexattrat": 466, "file_setattr": 469, "truncate": 45,
        "cachestat": 451, "memfd_create": 279, "memfd_secret": 447, "mmap": 222,
    },
}  # fmt: skip
"""Numbers of the system calls that are blocked or filtered by argument, by machine.

Times, permissions and locks of read-only files, and sockets by name, could pass information from
one run to another. Landlock does not restrict any of them.
"""
_ARCHITECTURES = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
"""AUDIT_ARCH of each machine; calls with the numbers of another architecture are blocked."""
_OPTIONAL_SYSCALLS = ("clone3", "io_uring_setup")
"""Calls that libraries try first, and replace if the kernel reports that they do not exist."""
_UNLIMITED_MEMORY_SYSCALLS = ("memfd_create", "memfd_secret")
"""Calls that allocate memory which is not counted by a process's memory limit."""
_ARGUMENT_FILTERED_SYSCALLS = (
    "clone", "socketpair", "capset", "kill", "tgkill", "prctl", "prlimit64", "fcntl", "flock",
    "mmap",
)  # fmt: skip
"""Calls that are allowed depending on their arguments, or that only the harness uses."""


def drop_capabilities() -> None:
    """Give up all capabilities of a superuser, including those in a namespace."""
    version_3 = struct.pack("<Ii", 0x20080522, 0)
    call_system(_NUMBERS[platform.machine()]["capset"], version_3, bytes(24))


_LOAD, _AND, _EQUAL, _AT_LEAST, _ANY_BIT, _RETURN = 0x20, 0x54, 0x15, 0x35, 0x45, 0x06
"""BPF instructions: load a word, AND, jump if equal, if at least, if a bit is set; return."""
_ALLOW, _KILL, _FAIL = 0x7FFF0000, 0x80000000, 0x00050000
"""Return values of a filter: allow, kill the process, fail the call.

The last one is combined with an error number; with 0 the call does nothing and succeeds.
"""
_EPERM, _ENOMEM, _ENOSYS = _FAIL | 1, _FAIL | 12, _FAIL | 38
"""Return values for the errors EPERM, ENOMEM and ENOSYS."""
_THREAD = 0x00010000
"""CLONE_THREAD: the new task is a thread of this process."""
_STREAMS = tuple(1 | flags for flags in (0, 0x800, 0x80000, 0x80800))
"""SOCK_STREAM with its flags; a pair of sockets of another type can be given names."""
_LOCKS = (6, 7, 37, 38)
"""F_SETLK, F_SETLKW and their forms for open file descriptions (fcntl commands).

They succeed without any effect. A real lock on a file that others read would pass information to
them, and a process that is alone needs no lock.
"""
_BLOCKED_FCNTL_COMMANDS = (8, 10, 15, 1024, 1026, 1036, 1038)
"""Fcntl commands that send signals or information to other processes.

F_SETOWN, F_SETSIG, F_SETOWN_EX, F_SETLEASE, F_NOTIFY and write hints of a file.
"""
_FCNTL_RULES = {**dict.fromkeys(_LOCKS, _FAIL), **dict.fromkeys(_BLOCKED_FCNTL_COMMANDS, _EPERM)}
"""Return values of the filter by fcntl command."""
_SHARED_ANONYMOUS_MAP = 0x21
"""MAP_SHARED and MAP_ANONYMOUS: memory that is not counted by a process's memory limit."""
_X32 = 0x40000000
"""First call number of the x32 interface, which is not used."""


def is_filter_supported() -> bool:
    """Return whether `install_syscall_filter` supports this machine."""
    return IS_LINUX and platform.machine() in _ARCHITECTURES and sys.byteorder == "little"


def install_syscall_filter(limited: bool = False) -> None:
    """Install a filter that blocks new processes, signals to others, and the network.

    Threads stay allowed.

    Args:
        limited: True if the process has a memory limit; calls that allocate uncounted memory are
            then blocked too.

    Raises:
        OSError: the kernel has no system call filters, or this machine is not supported.
    """
    if not is_filter_supported():
        raise OSError(f"no filter for {platform.machine()}")
    machine = platform.machine()
    program = _build_filter(_ARCHITECTURES[machine], _NUMBERS[machine], os.getpid(), limited)
    lines = ctypes.create_string_buffer(b"".join(struct.pack("<HBBI", *line) for line in program))
    header = struct.pack("<HxxxxxxQ", len(program), ctypes.addressof(lines))
    set_no_new_privileges()
    prctl(_PR_SET_SECCOMP, 2, ctypes.create_string_buffer(header))


BpfInstruction = tuple[int, int, int, int]
"""BPF instruction: opcode, lines to skip if true, lines to skip if false, operand."""


def _build_filter(
    architecture: int, numbers: Mapping[str, int], own: int, limited: bool
) -> Sequence[BpfInstruction]:
    """Build the filter program.

    The data have the call number at offset 0, the architecture at 4, and the arguments from 16 on.

    Args:
        architecture: AUDIT_ARCH of the machine.
        numbers: numbers of its system calls.
        own: process id of this process.
        limited: True if the process has a memory limit.
    """
    lines: list[BpfInstruction] = [
        (_LOAD, 0, 0, 4),
        (_EQUAL, 1, 0, architecture),
        (_RETURN, 0, 0, _KILL),
        (_LOAD, 0, 0, 0),
        (_AT_LEAST, 0, 1, _X32),
        (_RETURN, 0, 0, _ENOSYS),
    ]
    for name, number in numbers.items():
        if name not in _ARGUMENT_FILTERED_SYSCALLS and (
            limited or name not in _UNLIMITED_MEMORY_SYSCALLS
        ):
            verdict = (
                _ENOSYS if name in (*_OPTIONAL_SYSCALLS, *_UNLIMITED_MEMORY_SYSCALLS) else _EPERM
            )
            lines += [(_EQUAL, 0, 1, number), (_RETURN, 0, 0, verdict)]
    lines += [
        # The first argument of clone has a flag for threads, which are allowed.
        (_EQUAL, 0, 4, numbers["clone"]),
        (_LOAD, 0, 0, 16),
        (_ANY_BIT, 1, 0, _THREAD),
        (_RETURN, 0, 0, _EPERM),
        (_RETURN, 0, 0, _ALLOW),
        *_build_argument_rule(numbers["kill"], 0, {own: _ALLOW}, _EPERM),
        *_build_argument_rule(numbers["tgkill"], 0, {own: _ALLOW}, _EPERM),
        *_build_argument_rule(numbers["prlimit64"], 0, {0: _ALLOW, own: _ALLOW}, _EPERM),
        *_build_argument_rule(numbers["prctl"], 0, {PR_SET_PDEATHSIG: _EPERM}, _ALLOW),
        *_build_argument_rule(numbers["socketpair"], 1, dict.fromkeys(_STREAMS, _ALLOW), _EPERM),
        *_build_argument_rule(numbers["fcntl"], 1, _FCNTL_RULES, _ALLOW),
        (_EQUAL, 0, 1, numbers["flock"]),
        (_RETURN, 0, 0, _FAIL),
    ]
    if limited:
        lines += [
            (_EQUAL, 0, 5, numbers["mmap"]),
            (_LOAD, 0, 0, 16 + 8 * 3),
            (_AND, 0, 0, _SHARED_ANONYMOUS_MAP),
            (_EQUAL, 0, 1, _SHARED_ANONYMOUS_MAP),
            (_RETURN, 0, 0, _ENOMEM),
            (_RETURN, 0, 0, _ALLOW),
        ]
    return [*lines, (_RETURN, 0, 0, _ALLOW)]


def _build_argument_rule(
    number: int, argument: int, verdicts: Mapping[int, int], otherwise: int
) -> list[BpfInstruction]:
    """Build the rule for a call that depends on the lower half of one of its arguments.

    Args:
        number: number of the call.
        argument: index of the argument, from 0.
        verdicts: return value of the filter by argument value.
        otherwise: return value for other argument values.
    """
    cases: list[BpfInstruction] = []
    for value, verdict in verdicts.items():
        cases += [(_EQUAL, 0, 1, value), (_RETURN, 0, 0, verdict)]
    load = (_LOAD, 0, 0, 16 + 8 * argument)
    return [(_EQUAL, 0, len(cases) + 2, number), load, *cases, (_RETURN, 0, 0, otherwise)]
