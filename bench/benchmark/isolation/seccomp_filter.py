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
from collections.abc import Mapping
from typing import NamedTuple

from bench.benchmark.isolation.linux_syscalls import (
    IS_LINUX,
    PR_SET_PDEATHSIG,
    call_system,
    prctl,
    set_no_new_privileges,
)

_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER = 22, 2
"""Option of prctl and its argument: install a filter of system calls."""
_CAPABILITY_VERSION_3 = 0x20080522
"""Number in linux/capability.h of the format in which capset reads sets of capabilities."""

_SYSCALL_NUMBERS: Mapping[str, Mapping[str, int]] = {
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
_ALLOW, _KILL, _FAIL = 0x7FFF0000, 0x80000000, 0x00050000
"""Verdicts of a filter: allow, kill the process, fail the call.

The last one is combined with an error number; with 0 the call does nothing and succeeds.
"""
_EPERM, _ENOMEM, _ENOSYS = _FAIL | 1, _FAIL | 12, _FAIL | 38
"""Verdicts for the errors EPERM, ENOMEM and ENOSYS."""
_DO_NOTHING = _FAIL | 0
"""Verdict for a call that does nothing and succeeds: it fails with the error number 0."""
_CLONE_THREAD = 0x00010000
"""CLONE_THREAD: the new task is a thread of this process."""
_STREAM_SOCKET_TYPES = tuple(1 | flags for flags in (0, 0x800, 0x80000, 0x80800))
"""SOCK_STREAM with its flags; a pair of sockets of another type can be given names."""
_LOCK_COMMANDS = (6, 7, 37, 38)
"""F_SETLK, F_SETLKW and their forms for open file descriptions (fcntl commands).

They succeed without any effect. A real lock on a file that others read would pass information to
them, and a process that is alone needs no lock.
"""
_BLOCKED_FCNTL_COMMANDS = (8, 10, 15, 1024, 1026, 1036, 1038)
"""Fcntl commands that send signals or information to other processes.

F_SETOWN, F_SETSIG, F_SETOWN_EX, F_SETLEASE, F_NOTIFY and write hints of a file.
"""
_SHARED_ANONYMOUS_MAP = 0x21
"""MAP_SHARED and MAP_ANONYMOUS: memory that is not counted by a process's memory limit."""


class ArgumentRule(NamedTuple):
    """Verdict on a call that depends on the lower half of one of its arguments.

    Attributes:
        argument: index of the argument, from 0.
        verdicts: verdict by value of the argument.
        otherwise: verdict for other values.
        mask: bits of the argument that are compared.
    """

    argument: int
    verdicts: Mapping[int, int]
    otherwise: int
    mask: int = 0xFFFFFFFF


def list_rules(process: int, has_memory_limit: bool) -> dict[str, int | ArgumentRule]:
    """Return the verdict or the rule for each system call that is not allowed in general.

    These are the calls in `_SYSCALL_NUMBERS`; all others are allowed. They fail with EPERM (not
    permitted) unless another verdict is stated. Calls that are harmless with some arguments have a
    rule that depends on an argument; for example, a process may send signals to itself only.

    Args:
        process: process id of the process that is restricted.
        has_memory_limit: True if calls that allocate uncounted memory are blocked too.

    Returns:
        Verdict, such as `_ALLOW`, `_EPERM` or `_DO_NOTHING` (succeed without effect), or the rule
        that gives it, by name of the call.
    """
    # The first argument of these calls is the process that gets the signal.
    only_itself = ArgumentRule(0, {process: _ALLOW}, _EPERM)
    rules: dict[str, int | ArgumentRule] = {
        # The default, which entries below replace. The names for x86_64 include those of all
        # supported machines.
        **dict.fromkeys(_SYSCALL_NUMBERS["x86_64"], _EPERM),
        # Libraries try these first, and use other calls if the kernel reports that they are absent.
        **dict.fromkeys(("clone3", "io_uring_setup"), _ENOSYS),
        "clone": ArgumentRule(0, {_CLONE_THREAD: _ALLOW}, _EPERM, mask=_CLONE_THREAD),
        "kill": only_itself,
        "tgkill": only_itself,
        # Process 0 means the calling process.
        "prlimit64": ArgumentRule(0, {0: _ALLOW, process: _ALLOW}, _EPERM),
        "prctl": ArgumentRule(0, {PR_SET_PDEATHSIG: _EPERM}, _ALLOW),
        "socketpair": ArgumentRule(1, dict.fromkeys(_STREAM_SOCKET_TYPES, _ALLOW), _EPERM),
        "fcntl": ArgumentRule(
            1,
            {
                **dict.fromkeys(_LOCK_COMMANDS, _DO_NOTHING),
                **dict.fromkeys(_BLOCKED_FCNTL_COMMANDS, _EPERM),
            },
            _ALLOW,
        ),
        "flock": _DO_NOTHING,
        "capset": _ALLOW,  # capabilities can only be given up
        **dict.fromkeys(("memfd_create", "memfd_secret", "mmap"), _ALLOW),
    }  # fmt: skip
    # Shared anonymous memory is not counted by the limit.
    if has_memory_limit:
        shared = {_SHARED_ANONYMOUS_MAP: _ENOMEM}
        rules |= {
            **dict.fromkeys(("memfd_create", "memfd_secret"), _ENOSYS),
            "mmap": ArgumentRule(3, shared, _ALLOW, mask=_SHARED_ANONYMOUS_MAP),
        }
    return rules


_LOAD, _AND, _EQUAL, _AT_LEAST, _RETURN = 0x20, 0x54, 0x15, 0x35, 0x06
"""BPF instructions: load a word, AND, jump if equal, jump if at least, return."""
_FIRST_X32_CALL = 0x40000000
"""First call number of the x32 interface, which is not used."""
_NUMBER_OFFSET, _ARCHITECTURE_OFFSET, _ARGUMENTS_OFFSET = 0, 4, 16
"""Positions of call number, architecture and arguments in the data of a filter, in bytes."""


class BpfInstruction(NamedTuple):
    """Instruction of a filter, with the numbers of instructions that a jump skips."""

    opcode: int
    operand: int
    skip_if_true: int = 0
    skip_if_false: int = 0


def _emit_conditional(
    opcode: int, operand: int, body: list[BpfInstruction]
) -> list[BpfInstruction]:
    """Return instructions that execute the body if a comparison with the operand holds.

    Args:
        opcode: BPF code of the comparison, such as equality.
        operand: constant with which the loaded word is compared.
        body: instructions to execute if the comparison holds.
    """
    return [BpfInstruction(opcode, operand, skip_if_false=len(body)), *body]


def _emit_rule(rule: int | ArgumentRule) -> list[BpfInstruction]:
    """Return the instructions of the filter program that decide about one system call.

    `rule` is the verdict itself, or a rule that depends on one argument of the call: it is loaded,
    masked and compared with each known value.
    """
    if isinstance(rule, int):
        return [BpfInstruction(_RETURN, rule)]
    return [
        BpfInstruction(_LOAD, _ARGUMENTS_OFFSET + 8 * rule.argument),
        BpfInstruction(_AND, rule.mask),
        *(
            instruction
            for value, verdict in rule.verdicts.items()
            for instruction in _emit_conditional(_EQUAL, value, _emit_rule(verdict))
        ),
        BpfInstruction(_RETURN, rule.otherwise),
    ]


def build_filter(machine: str, rules: Mapping[str, int | ArgumentRule]) -> list[BpfInstruction]:
    """Build the filter program, in BPF instructions that the kernel executes for each system call.

    A call of another architecture kills the process. The number of the call is compared with each
    known number; calls without a rule are allowed.

    Args:
        machine: machine, as of `platform.machine`.
        rules: verdict or rule by name of the call, from `list_rules`.

    Returns:
        Instructions in the order in which they are executed.
    """
    program = [BpfInstruction(_LOAD, _ARCHITECTURE_OFFSET)]
    # The right architecture skips the next instruction, which kills the process.
    program += [BpfInstruction(_EQUAL, _ARCHITECTURES[machine], skip_if_true=1), *_emit_rule(_KILL)]
    program += [
        BpfInstruction(_LOAD, _NUMBER_OFFSET),
        *_emit_conditional(_AT_LEAST, _FIRST_X32_CALL, _emit_rule(_ENOSYS)),
    ]
    for name, number in _SYSCALL_NUMBERS[machine].items():
        program += _emit_conditional(_EQUAL, number, _emit_rule(rules[name]))
    return [*program, *_emit_rule(_ALLOW)]


def install_syscall_filter(has_memory_limit: bool = False) -> None:
    """Install a seccomp filter that blocks new processes, signals to others, and the network.

    Threads stay allowed. All capabilities of a superuser are given up before. The filter cannot be
    removed again.

    Args:
        has_memory_limit: True if the process has a memory limit; calls that allocate uncounted
            memory are then blocked too.

    Raises:
        OSError: the kernel has no system call filters, or this machine is not supported.
    """
    machine = platform.machine()
    if not IS_LINUX or machine not in _ARCHITECTURES or sys.byteorder != "little":
        raise OSError(f"no filter for {machine}")
    # An empty set of capabilities (capset(2)) of this process, which has the number 0. A set is 24
    # bytes: effective, permitted and inheritable capabilities, each of 64 bits.
    capability_header = struct.pack("<Ii", _CAPABILITY_VERSION_3, 0)
    call_system(_SYSCALL_NUMBERS[machine]["capset"], capability_header, bytes(24))
    program = build_filter(machine, list_rules(os.getpid(), has_memory_limit))
    # Instructions are (code, operand, jump if true, jump if false), in C the operand is last.
    packed = b"".join(
        struct.pack("<HBBI", code, if_true, if_false, operand)
        for code, operand, if_true, if_false in program
    )
    buffer = ctypes.create_string_buffer(packed)
    # The C structure sock_fprog: number of instructions, padding, address of the first one.
    header = struct.pack("<HxxxxxxQ", len(program), ctypes.addressof(buffer))
    set_no_new_privileges()
    prctl(_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, ctypes.create_string_buffer(header))
