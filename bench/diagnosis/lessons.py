"""What diagnosers' learning cost, in a table of the folder: it is shown apart from what answers
cost.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from sims.files import write

LESSONS = "training.csv"
COLUMNS = ("diagnoser", "system", "simulations", "seconds", "fault")


class Taught(NamedTuple):
    """What one diagnoser's learning of one system cost.

    Attributes:
        diagnoser: its label.
        system: which.
        simulations: that it took.
        seconds: likewise.
        fault: why it failed; empty where it did not.
    """

    diagnoser: str
    system: str
    simulations: int
    seconds: float
    fault: str = ""


def write_lessons(folder: Path, taught: Iterable[Taught]) -> None:
    """Write the table; nothing where nobody learned."""
    rows = [one._asdict() for one in taught]
    if not rows:
        return
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write(folder / LESSONS, text.getvalue())


def read_lessons(folder: Path) -> list[dict[str, str]]:
    """Its rows; none where there is no table."""
    path = folder / LESSONS
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))
