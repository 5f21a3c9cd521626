"""Training costs of diagnosers, reported in training.csv separately from the costs of answers."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from sims.core.files import write_atomically

TRAINING_COSTS_FILE = "training.csv"
TRAINING_COST_COLUMNS = ("diagnoser", "system", "simulations", "seconds", "fault")


class TrainingCost(NamedTuple):
    """Cost of training one diagnoser for one system.

    Attributes:
        diagnoser: label of the diagnoser.
        system: name of the system.
        simulations: number of simulations used.
        seconds: elapsed time.
        fault: error message if the training failed, otherwise empty.
    """

    diagnoser: str
    system: str
    simulations: int
    seconds: float
    fault: str = ""


def write_training_costs(folder: Path, costs: Iterable[TrainingCost]) -> None:
    """Write training.csv; write no file if no diagnoser was trained.

    Args:
        folder: result folder.
        costs: training costs, one per diagnoser and system.
    """
    rows = [cost._asdict() for cost in costs]
    if not rows:
        return
    text = io.StringIO()
    writer = csv.DictWriter(text, TRAINING_COST_COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(folder / TRAINING_COSTS_FILE, text.getvalue())


def read_training_costs(folder: Path) -> list[dict[str, str]]:
    """Read the rows of training.csv; return an empty list if the file does not exist."""
    path = folder / TRAINING_COSTS_FILE
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))
