"""How a run ended."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Status:
    """How a run ended: a row of status.csv."""

    run: str
    tuner: str
    simulator: str
    target: str
    seed: int
    status: str
    reason: str
    simulations: int
    seconds: float


STATUS_COLUMNS = [
    "run",
    "tuner",
    "simulator",
    "target",
    "seed",
    "status",
    "reason",
    "simulations",
    "seconds",
]
