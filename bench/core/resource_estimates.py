"""Estimate the resources that work needs, and compare them with those of the machine.

Estimates are low on purpose: only work that is not feasible is refused, not work that takes long.
The user can skip the check (``--force``, ``force=True``).
"""

from __future__ import annotations

import math
import os
import shutil
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from sims.core.simulator import InputError, Simulator
from sims.recording.recording import Recording
from sims.system_simulator import SystemSimulator

FORCE_HINT = "or insist with --force (force=True in Python)"
"""End of messages about checks that the user can skip."""
MAX_STEPS_PER_SIMULATION = 1e9
"""Maximum number of steps of one simulation; the fastest engine takes hours for them."""
_DAY_SECONDS = 86400.0
MAX_TOTAL_SECONDS = 30 * _DAY_SECONDS
"""Maximum duration of work in seconds."""
MIN_STEP_SECONDS = 1e-7
"""Minimum duration of a time step in seconds."""
MIN_SIMULATION_SECONDS = 1e-6
"""Minimum duration of a simulation in seconds."""
BYTES_PER_STEP = 32
"""Memory of a step of a running simulation in bytes: its length, its end, and applied inputs."""
BYTES_PER_NUMBER = 8
"""Size of a number in bytes."""
_CONTAINER_LIMIT_FILE = Path("/sys/fs/cgroup/memory.max")
"""File in which Linux states the memory limit of a container."""


@dataclass(frozen=True)
class MachineResources:
    """Resources of a machine; infinite if the system does not state them.

    Attributes:
        memory: memory in bytes.
        disk: free disk space in bytes.
    """

    memory: float = math.inf
    disk: float = math.inf


@dataclass(frozen=True)
class ResourceNeed:
    """Minimum resources that work needs.

    Attributes:
        work: what the work consists of, for example ``2 runs x budget 100``.
        change: what to change to need less.
        memory: memory in bytes.
        disk: disk space in bytes.
        steps: number of time steps in one simulation.
        seconds: duration in seconds.
    """

    work: str
    change: str
    memory: float = 0.0
    disk: float = 0.0
    steps: float = 0.0
    seconds: float = 0.0

    def find_excess(self, machine: MachineResources) -> str:
        """Describe the first need that exceeds the machine; empty if none does.

        The needs are memory, disk, time steps of one simulation, and total time.
        """
        for required, available, unit in (
            (self.memory, machine.memory, "of memory"),
            (self.disk, machine.disk, "of free disk"),
        ):
            if required > available:
                return f"{format_bytes(required)} {unit}, where there are {format_bytes(available)}"
        if self.steps > MAX_STEPS_PER_SIMULATION:
            return (
                f"{self.steps:.3g} steps in one simulation, "
                f"where {MAX_STEPS_PER_SIMULATION:g} take hours"
            )
        if self.seconds > MAX_TOTAL_SECONDS:
            days = MAX_TOTAL_SECONDS / _DAY_SECONDS
            return f"{self.seconds / _DAY_SECONDS:.3g} days, where {days:g} are allowed"
        return ""


def check_feasible(
    subject: str, need: ResourceNeed, machine: MachineResources, force: bool = False
) -> None:
    """Raise an error for work that is not feasible on this machine.

    Args:
        subject: beginning of the message.
        need: resources that the work needs.
        machine: resources of the machine.
        force: True to skip the check.

    Raises:
        InputError: the work needs more than is available.
    """
    if not force and (excess := need.find_excess(machine)):
        raise InputError(f"{subject}: {need.work} would need {excess}; {need.change}, {FORCE_HINT}")


def get_machine_resources(folder: Path | None = None) -> MachineResources:
    """Return the resources of this machine.

    Args:
        folder: folder to write to, which need not exist; None for the current one.
    """
    existing_folder = (folder or Path()).absolute()
    while not existing_folder.is_dir() and existing_folder != existing_folder.parent:
        existing_folder = existing_folder.parent
    try:
        disk = float(shutil.disk_usage(existing_folder).free)
    except OSError:
        disk = math.inf
    return MachineResources(_read_memory_limit(), disk)


def count_available_cores() -> int:
    """Return the number of CPU cores that this process may use."""
    # The CPU affinity is not available on all systems.
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def get_max_step(simulator: Simulator) -> float:
    """Return a simulator's largest time step in seconds; infinite if it does not state one."""
    return simulator.engine.largest_step if isinstance(simulator, SystemSimulator) else math.inf


def _read_memory_limit() -> float:
    """Return the memory in bytes: the machine's, or the limit of a container."""
    limits = [math.inf]
    with suppress(AttributeError, OSError, ValueError):  # a system that does not state it
        limits.append(float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE"))
    with suppress(OSError, ValueError):  # no container, or the limit "max"
        limits.append(float(_CONTAINER_LIMIT_FILE.read_text()))
    return min(limit for limit in limits if limit > 0)


def format_bytes(count: float) -> str:
    """Format a number of bytes with a unit."""
    for unit in ("B", "kB", "MB", "GB", "TB", "PB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} EB"


_BYTES_PER_TABLE_CELL = 8
"""Size of a number in a table, in bytes."""
_CELL_SECONDS = 1e-7
"""Time to write a number, in seconds."""
_RUN_MEMORY = 3000
"""Memory of a run in addition to its samples, in bytes."""
_MIN_SIMULTANEOUS_SIMULATIONS = 10
"""Minimum number of simultaneous simulations for fitting a run."""
_MIN_FIT_SIMULATIONS = 100
"""Minimum number of simulations of a run for fitting it."""
_BYTES_PER_PIXEL = 100
"""Memory per pixel of a rendered image, in bytes."""
_PIXEL_SECONDS = 1e-8
"""Time to render a pixel, in seconds."""


def check_simulation_size(
    runs: int, samples: int, seconds: float, simulator: Simulator, force: bool = False
) -> None:
    """Refuse to simulate a recording for which this machine has too few resources.

    The need for memory, disk and time is estimated from the number of samples and of simulation
    steps, before anything is simulated. Only one run is simulated at a time.

    Args:
        runs: Number of runs.
        samples: Number of samples of each run.
        seconds: Duration of each run.
        simulator: Simulator of the recording.
        force: Whether to skip the check.

    Raises:
        InputError: It needs more than is available; the message is one line.
    """
    columns = 1 + len(simulator.inputs) + len(simulator.channels)
    steps = max(seconds / get_max_step(simulator), samples)
    cells = float(runs) * samples * columns
    need = ResourceNeed(
        f"{runs:.4g} runs of {samples:.4g} samples and {steps:.3g} steps",
        "lower runs, seconds or rate",
        # The samples exist as numbers, and as the text of the table before it is written.
        memory=cells * (BYTES_PER_NUMBER + _BYTES_PER_TABLE_CELL)
        + runs * _RUN_MEMORY
        + steps * BYTES_PER_STEP,
        disk=cells * _BYTES_PER_TABLE_CELL,
        steps=steps,
        seconds=runs * (MIN_SIMULATION_SECONDS + MIN_STEP_SECONDS * steps) + cells * _CELL_SECONDS,
    )
    check_feasible(f"simulate {simulator.name}", need, get_machine_resources(), force)


def check_recording_size(recording: Recording, simulator: Simulator, force: bool = False) -> None:
    """Refuse to fit a recording for which this machine has too few resources.

    A fit simulates each run many times, several of them at once. Its minimum need is estimated as
    if all runs were as long as the longest one.

    Args:
        recording: Recording to explain or score.
        simulator: Simulator to fit.
        force: Whether to skip the check.

    Raises:
        InputError: It needs more than is available; the message is one line.
    """
    seconds = max(float(run.times[-1] - run.times[0]) for run in recording.runs)
    steps = seconds / get_max_step(simulator)
    count = len(recording.runs)
    need = ResourceNeed(
        f"{count} runs of up to {seconds:.4g} s, {steps:.3g} steps,",
        "explain shorter runs",
        memory=count * _MIN_SIMULTANEOUS_SIMULATIONS * steps * BYTES_PER_STEP,
        steps=steps,
        seconds=count * _MIN_FIT_SIMULATIONS * steps * MIN_STEP_SECONDS,
    )
    check_feasible(str(recording.path), need, get_machine_resources(), force)


def check_film_size(recording: Path, frames: int, pixels: int, force: bool = False) -> None:
    """Refuse to render a film for which this machine has too few resources.

    Args:
        recording: Path of the recording to film.
        frames: Number of images.
        pixels: Width and height of each image.
        force: Whether to skip the check.

    Raises:
        InputError: It needs more than is available; the message is one line.
    """
    area = float(pixels) ** 2
    need = ResourceNeed(
        f"{frames} pictures of {pixels:.4g} x {pixels:.4g} pixels",
        "lower the size",
        memory=area * _BYTES_PER_PIXEL,
        seconds=frames * area * _PIXEL_SECONDS,
    )
    check_feasible(str(recording), need, get_machine_resources(), force)
