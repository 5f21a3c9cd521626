"""What work would need, estimated before it begins, against what the machine has.

Estimates are low on purpose: only what is hopeless is refused, never what is merely long. Whoever
knows better insists (``--force``, ``force=True``).
"""

from __future__ import annotations

import math
import os
import shutil
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from sims.base import InputError, Simulator
from sims.simulated import Simulated

INSIST = "or insist with --force (force=True in Python)"
"""How a message ends that a person may overrule."""
MOST_STEPS = 1e9
"""Steps of one simulation: the fastest engine takes hours for them."""
MOST_SECONDS = 30 * 86400.0
"""Seconds of work."""
STEP = 1e-7
"""Seconds that a step takes at the least."""
SIMULATION = 1e-6
"""Seconds that a simulation takes at the least."""
STEP_BYTES = 32
"""Bytes of memory for a step of a simulation under way: its length, its end, and what is felt."""
NUMBER = 8
"""Bytes of a number."""
_CONTROL = Path("/sys/fs/cgroup/memory.max")
"""Where Linux says how much memory a container may use."""


@dataclass(frozen=True)
class Machine:
    """What there is; infinite where the system does not say.

    Attributes:
        memory: bytes.
        disk: free bytes.
        files: free files.
    """

    memory: float = math.inf
    disk: float = math.inf
    files: float = math.inf


@dataclass(frozen=True)
class Need:
    """What work would need at the least.

    Attributes:
        made: what it is made of, e.g. ``2 runs x budget 100``.
        change: what to change to need less.
        memory: bytes at once.
        disk: bytes to be written.
        files: to be written.
        steps: of an engine in one simulation.
        seconds: until it is done.
    """

    made: str
    change: str
    memory: float = 0.0
    disk: float = 0.0
    files: float = 0.0
    steps: float = 0.0
    seconds: float = 0.0

    def beyond(self, machine: Machine) -> str:
        """What is needed and not there, with what there is; empty where there is enough."""
        for wanted, there, unit in (
            (self.memory, machine.memory, "of memory"),
            (self.disk, machine.disk, "of free disk"),
        ):
            if wanted > there:
                return f"{size(wanted)} {unit}, where there are {size(there)}"
        if self.files > machine.files:
            return f"{self.files:.3g} files, where there is room for {machine.files:.3g}"
        if self.steps > MOST_STEPS:
            return f"{self.steps:.3g} steps in one simulation, where {MOST_STEPS:g} take hours"
        if self.seconds > MOST_SECONDS:
            return f"{_long(self.seconds)}, where {_long(MOST_SECONDS)} are the most"
        return ""


def refuse(who: str, need: Need, machine: Machine, force: bool = False) -> None:
    """Refuse work that is hopeless on this machine.

    Args:
        who: what a message begins with.
        need: what it would need.
        machine: what there is.
        force: whether the user insists.

    Raises:
        InputError: more is needed than there is, in one line.
    """
    if not force and (what := need.beyond(machine)):
        raise InputError(f"{who}: {need.made} would need {what}; {need.change}, {INSIST}")


def machine(folder: Path | None = None) -> Machine:
    """What this machine has.

    Args:
        folder: where would be written; the current one where None. It need not exist yet.
    """
    place = (folder or Path()).absolute()
    while not place.is_dir() and place != place.parent:
        place = place.parent
    try:
        disk = float(shutil.disk_usage(place).free)
    except OSError:
        disk = math.inf
    return Machine(_memory(), disk, _files(place))


def largest_step(simulator: Simulator) -> float:
    """Seconds of a simulator's longest step; one that does not say has one a sample."""
    return simulator.engine.largest_step if isinstance(simulator, Simulated) else math.inf


def _memory() -> float:
    """Bytes of memory: the machine's, or what a container may use of it."""
    limits = [math.inf]
    with suppress(AttributeError, OSError, ValueError):  # a system that does not say
        limits.append(float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE"))
    with suppress(OSError, ValueError):  # no container, or one without a limit: "max"
        limits.append(float(_CONTROL.read_text()))
    return min(limit for limit in limits if limit > 0)


def _files(place: Path) -> float:
    try:
        free = os.statvfs(place).f_favail
    except (AttributeError, OSError):
        return math.inf
    # File systems that make room as they go say 0.
    return float(free) or math.inf


def size(count: float) -> str:
    """Bytes as a person reads them."""
    for unit in ("B", "kB", "MB", "GB", "TB", "PB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} EB"


def _long(seconds: float) -> str:
    days = seconds / 86400
    return f"{days:.3g} days" if days < 1000 else f"{days / 365.25:.3g} years"
