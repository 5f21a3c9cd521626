"""How a run ended."""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass(frozen=True)
class Status:
    """How a run ended: a row of status.csv.

    Attributes:
        run: its id.
        tuner: the label of its entry.
        simulator: registered name.
        target: name.
        seed: of the tuner.
        status: done, converged, timeout, crashed, diverged or skipped.
        reason: why, in words; the traceback of a crash.
        simulations: used on the target.
        seconds: wall-clock time.
        trusted: whether the tuner ran inside the harness.
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


STATUS_COLUMNS = [field.name for field in fields(Status)]
"""Of status.csv."""

FAILED = ("crashed", "timeout", "diverged")
"""Ends of a run that was made and delivered nothing one could trust."""
FAILURES = (*FAILED, "skipped")
"""And of one that was never made: the tables show what is missing."""
STATUSES = ("done", "converged", *FAILURES)
"""All words by which a run ends."""
