"""Status of a run, and progress of a study: finished, failed and missing runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import NamedTuple


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


MISSING_STATUS = "missing"
"""Status of a run that has not been made yet."""
SUCCESS_STATUSES = ("done", "converged", "made")
"""Statuses of successful runs and shots."""


class StudyOutcome(NamedTuple):
    """Outcome of making a study.

    Attributes:
        finished: Number of finished runs or shots.
        planned: Number of planned runs or shots.
        interrupted: Whether the user stopped it.
        stopped: Any other reason for which it stopped.
        skipped: Reason for which it cannot be made on this machine.
    """

    finished: int
    planned: int
    interrupted: bool = False
    stopped: str = ""
    skipped: str = ""

    @property
    def is_complete(self) -> bool:
        """True if nothing is missing."""
        return self.finished == self.planned


class RunEnd(NamedTuple):
    """Status of one run or shot.

    Attributes:
        name: Its id.
        group: Its tuner, or its kind of ball, by which runs are counted.
        status: Status as in status.csv; `MISSING_STATUS` if there is none.
        reason: Reason as text; the traceback of a crash.
    """

    name: str
    group: str
    status: str
    reason: str = ""


class StudyProgress(NamedTuple):
    """Progress of a study's folder; another process may be working there.

    Attributes:
        name: Name of the experiment.
        what: What is counted, e.g. ``runs finished``.
        hashes: Hashes of what must not change until it is complete, by readable names.
        ends: How every planned run ended, in the order of the plan.
        is_unfinished: Whether results remain to be written, although everything may have ended.
    """

    name: str
    what: str
    hashes: Mapping[str, str]
    ends: tuple[RunEnd, ...]
    is_unfinished: bool = False

    @property
    def finished(self) -> int:
        """Number of runs that have ended."""
        return sum(end.status != MISSING_STATUS for end in self.ends)

    @property
    def is_complete(self) -> bool:
        """True if nothing is missing."""
        return not self.is_unfinished and self.finished == len(self.ends)
