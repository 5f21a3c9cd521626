"""Study in a result folder: what comparisons, bounce shots and comparisons of diagnosers share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from bench.benchmark.storage.result_folder import read_configuration, read_salt, reveal_salt
from bench.benchmark.storage.run_status import (
    MISSING_STATUS,
    RunEnd,
    StudyOutcome,
    StudyProgress,
)

if TYPE_CHECKING:
    from bench.benchmark.runner.experiment_runner import ProgressFactory
    from bench.benchmark.runner.study_creation import PreparedStudy
    from bench.benchmark.runner.worker_pools import Pool

PrintLine = Callable[[str], None]


class Study(ABC):
    """A study in its result folder.

    ``Kind(folder)`` opens a study for status and report, without disturbing a process that runs it.
    `begin` and `resume` give a study that can be run.

    Attributes:
        folder: result folder.
        configuration: configuration of the study.
        plugins: plugin files that it needs.
    """

    counted: ClassVar[str] = "runs finished"
    """Words for the runs that its status counts."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.configuration = read_configuration(folder)
        self.plugins = self.configuration.plugins

    @classmethod
    @abstractmethod
    def begin(cls, new: PreparedStudy) -> Study:
        """Check and plan a study in a new folder.

        Args:
            new: folder, experiment, plugins and salt, from `prepare_study`.

        Raises:
            InputError: the experiment has an error.
        """

    @classmethod
    @abstractmethod
    def resume(cls, folder: Path, plugins: Sequence[str] = ()) -> Study:
        """Open an interrupted study to complete it.

        Args:
            folder: result folder.
            plugins: additional plugin files; the study's own are loaded in any case.

        Raises:
            InputError: the folder is damaged, or something relevant has changed since.
        """

    @abstractmethod
    def run(
        self, jobs: int = 2, progress: ProgressFactory | None = None, pool: Pool | None = None
    ) -> StudyOutcome:
        """Run the runs of the plan that are not yet stored in the folder.

        Args:
            jobs: number of worker processes; 0 to run everything in this process.
            progress: called for every step.
            pool: pool to use instead, for example of a cluster.

        Returns:
            How far the study came, also if it was interrupted.

        Raises:
            InputError: workers cannot be started; finished runs are stored.
        """

    @abstractmethod
    def list_run_ends(self) -> Sequence[RunEnd]:
        """Return how every planned run ended, in the order of the plan."""

    @property
    def is_unfinished(self) -> bool:
        """True if results remain to be written, although every run may have ended."""
        return False

    @abstractmethod
    def report(self, print_line: PrintLine) -> int:
        """Write tables and figures, print the results, and return the number of failures."""

    def close(self) -> None:
        """Release the folder without running what is missing."""

    def status(self) -> StudyProgress:
        """Return what the folder contains, and what is missing."""
        name, hashes = self.configuration.experiment.name, self.configuration.fingerprint
        ends = tuple(self.list_run_ends())
        return StudyProgress(name, self.counted, hashes, ends, self.is_unfinished)

    @property
    def salt(self) -> str:
        """Salt of the study, also while it is secret."""
        experiment = self.configuration.experiment
        return read_salt(self.folder, experiment) or experiment.salt

    def reveal_salt(self) -> None:
        """Write a secret salt to the configuration, since the study is complete."""
        reveal_salt(self.folder, read_salt(self.folder, self.configuration.experiment))
        self.configuration = read_configuration(self.folder)

    def finish(self, run_missing: Callable[[], None]) -> StudyOutcome:
        """Run what is missing, and return how far the study came, also if it was interrupted.

        Args:
            run_missing: runs and stores everything that is missing.
        """
        from bench.benchmark.runner.worker_pools import PoolLostError

        try:
            run_missing()
        except KeyboardInterrupt:
            return self.count_finished(interrupted=True)
        except PoolLostError as error:
            return self.count_finished(stopped=str(error))
        return self.count_finished()

    def count_finished(self, **why: Any) -> StudyOutcome:
        """Return how far the study came; reveal its salt if it is complete.

        Args:
            why: reason for which it ended early, a field of `StudyOutcome`.
        """
        ends = self.list_run_ends()
        missing = sum(end.status == MISSING_STATUS for end in ends)
        if not missing and not why:
            self.reveal_salt()
        return StudyOutcome(len(ends) - missing, len(ends), **why)
