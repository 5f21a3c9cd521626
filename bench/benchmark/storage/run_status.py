"""Final status of a run."""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass(frozen=True)
class RunStatus:
    """Status of a run: a row of status.csv.

    Attributes:
        run: Id of the run.
        tuner: Label of its tuner.
        simulator: Registered name of the simulator.
        target: Name of the target.
        seed: Seed of the tuner.
        status: done, converged, timeout, crashed, diverged or skipped.
        reason: Reason as text; the traceback of a crash.
        simulations: Number of simulations on the target.
        seconds: Wall-clock time.
        trusted: Whether the tuner ran inside the harness.
    """

    run: str
    tuner: str
    simulator: str
    target: str
    seed: int
    status: str
    reason: str
    simulations: int
    seconds: float
    trusted: bool = False


STATUS_COLUMN_NAMES = [field.name for field in fields(RunStatus)]
"""Columns of status.csv."""

FAILED_STATUSES = ("crashed", "timeout", "diverged")
"""Statuses of runs that were made but gave no usable result."""
FAILED_OR_SKIPPED_STATUSES = (*FAILED_STATUSES, "skipped")
"""Statuses of runs that failed or were never made; tables show their number."""
STATUSES = ("done", "converged", *FAILED_OR_SKIPPED_STATUSES)
"""All possible statuses of a run."""
