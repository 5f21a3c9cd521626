"""What recordings would need that are simulated, explained or filmed; see `bench.sizes`."""

from __future__ import annotations

from pathlib import Path

from bench.sizes import (
    NUMBER,
    SIMULATION,
    STEP,
    STEP_BYTES,
    Need,
    largest_step,
    machine,
    refuse,
)
from sims.base import Simulator
from sims.recording.recording import Recording

_CELL = 8
"""Bytes of a number in a table."""
_CELL_SECONDS = 1e-7
"""Seconds to write a number."""
_RUN_MEMORY = 3000
"""Bytes of a run beside its samples."""
_LANES = 10
"""Simulations that are made at once, at the least, to fit a run."""
_FITTING = 100
"""Simulations of a run that are made to fit it, at the least."""
_PIXEL = 100
"""Bytes of memory for a pixel of a picture that is drawn."""
_PIXEL_SECONDS = 1e-8
"""Seconds to draw a pixel."""


def check_simulated(
    runs: int, samples: int, seconds: float, simulator: Simulator, force: bool = False
) -> None:
    """Refuse a recording whose simulation is hopeless on this machine.

    Args:
        runs: of it.
        samples: of each run.
        seconds: that each lasts.
        simulator: that makes it.
        force: whether the user insists.

    Raises:
        InputError: it needs more than there is, in one line.
    """
    columns = 1 + len(simulator.inputs) + len(simulator.channels)
    steps = max(seconds / largest_step(simulator), samples)
    cells = float(runs) * samples * columns
    need = Need(
        f"{runs:.4g} runs of {samples:.4g} samples and {steps:.3g} steps",
        "lower runs, seconds or rate",
        # As numbers, and as the text of the table before it is written.
        memory=cells * (NUMBER + _CELL) + runs * _RUN_MEMORY + steps * STEP_BYTES,
        disk=cells * _CELL,
        steps=steps,
        seconds=runs * (SIMULATION + STEP * steps) + cells * _CELL_SECONDS,
    )
    refuse(f"simulate {simulator.name}", need, machine(), force)


def check_recording(recording: Recording, simulator: Simulator, force: bool = False) -> None:
    """Refuse a recording that no machine like this one can fit.

    Args:
        recording: what is explained or scored.
        simulator: that would be fitted.
        force: whether the user insists.

    Raises:
        InputError: it needs more than there is, in one line.
    """
    longest = max(float(run.times[-1] - run.times[0]) for run in recording.runs)
    steps = longest / largest_step(simulator)
    count = len(recording.runs)
    need = Need(
        f"{count} runs of up to {longest:.4g} s, {steps:.3g} steps,",
        "explain shorter runs",
        memory=count * _LANES * steps * STEP_BYTES,
        steps=steps,
        seconds=count * _FITTING * steps * STEP,
    )
    refuse(str(recording.path), need, machine(), force)


def check_film(recording: Path, frames: int, pixels: int, force: bool = False) -> None:
    """Refuse a film that is hopeless on this machine.

    Args:
        recording: what is filmed.
        frames: pictures.
        pixels: width and height of each.
        force: whether the user insists.

    Raises:
        InputError: it needs more than there is, in one line.
    """
    area = float(pixels) ** 2
    need = Need(
        f"{frames} pictures of {pixels:.4g} x {pixels:.4g} pixels",
        "lower the size",
        memory=area * _PIXEL,
        seconds=frames * area * _PIXEL_SECONDS,
    )
    refuse(str(recording), need, machine(), force)
