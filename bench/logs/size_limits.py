"""Refuse recordings that are too large to simulate, fit or film; see `core.resource_estimates`."""

from __future__ import annotations

from pathlib import Path

from bench.core.resource_estimates import (
    BYTES_PER_NUMBER,
    BYTES_PER_STEP,
    MIN_SIMULATION_SECONDS,
    MIN_STEP_SECONDS,
    ResourceNeed,
    check_feasible,
    get_machine_resources,
    get_max_step,
)
from sims.core.simulator import Simulator
from sims.recording.recording import Recording

_BYTES_PER_NUMBER = 8
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
    """Refuse a recording that this machine cannot simulate.

    Args:
        runs: Number of runs.
        samples: Number of samples of each run.
        seconds: Duration of each run.
        simulator: Simulator of the recording.
        force: Whether the user insists.

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
        memory=cells * (BYTES_PER_NUMBER + _BYTES_PER_NUMBER)
        + runs * _RUN_MEMORY
        + steps * BYTES_PER_STEP,
        disk=cells * _BYTES_PER_NUMBER,
        steps=steps,
        seconds=runs * (MIN_SIMULATION_SECONDS + MIN_STEP_SECONDS * steps) + cells * _CELL_SECONDS,
    )
    check_feasible(f"simulate {simulator.name}", need, get_machine_resources(), force)


def check_recording_size(recording: Recording, simulator: Simulator, force: bool = False) -> None:
    """Refuse a recording that this machine cannot fit.

    Args:
        recording: Recording to explain or score.
        simulator: Simulator to fit.
        force: Whether the user insists.

    Raises:
        InputError: It needs more than is available; the message is one line.
    """
    longest = max(float(run.times[-1] - run.times[0]) for run in recording.runs)
    steps = longest / get_max_step(simulator)
    count = len(recording.runs)
    need = ResourceNeed(
        f"{count} runs of up to {longest:.4g} s, {steps:.3g} steps,",
        "explain shorter runs",
        memory=count * _MIN_SIMULTANEOUS_SIMULATIONS * steps * BYTES_PER_STEP,
        steps=steps,
        seconds=count * _MIN_FIT_SIMULATIONS * steps * MIN_STEP_SECONDS,
    )
    check_feasible(str(recording.path), need, get_machine_resources(), force)


def check_film_size(recording: Path, frames: int, pixels: int, force: bool = False) -> None:
    """Refuse a film that this machine cannot render.

    Args:
        recording: Path of the recording to film.
        frames: Number of images.
        pixels: Width and height of each image.
        force: Whether the user insists.

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
