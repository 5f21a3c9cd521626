"""Comparison of tuners in its result folder: begin, resume, run, show status, and report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.store.folder import (
    configuration,
    read,
    write_results,
)
from bench.store.journal import Journal
from bench.store.planned import check_plan
from bench.store.rows import RunsFile
from bench.store.secret import kept as kept_salt
from bench.store.secret import reveal
from bench.store.segments import (
    FOLDER,
    PLAN,
    PLAN_REMEDY,
    REMEDY,
    kept,
    read_plan,
    write_plan,
)
from bench.store.sound import check_alike, check_kept, check_runs
from bench.store.standing import MISSING, End, Made, Standing
from bench.store.status import STATUS_COLUMNS, Status
from sims.base import InputError
from sims.files import write

if TYPE_CHECKING:
    from bench.problem.experiment import Experiment
    from bench.runs.pools import Pool
    from bench.runs.runner import Progress, Results

Say = Callable[[str], None]


class Comparison:
    """Comparison of tuners x targets x seeds in a result folder; implements `bench.study.Study`.

    Args:
        folder: result folder of a comparison, for status and report. Use `begin` or `resume` for a
            comparison that can be run.

    Attributes:
        folder: result folder.
        configuration: configuration of the comparison.
        results: problem, plan and stored runs; None if the comparison is read-only.

    Raises:
        InputError: the folder is not that of a comparison, or it is damaged.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.configuration = configuration(folder)
        self.plugins = self.configuration.plugins
        self.secret: str | None = None
        self.results: Results | None = None

    @classmethod
    def begin(
        cls,
        experiment: Experiment,
        plugins: Sequence[str] = (),
        folder: Path | None = None,
        jobs: int = 2,
        salt: str | None = None,
    ) -> Comparison:
        """Plan a comparison in a new folder, without running it; see `bench.study.Study.begin`.

        Args:
            experiment: configuration of the comparison.
            plugins: plugin files.
            folder: result folder; None for a default name.
            jobs: number of worker processes.
            salt: salt of the targets; None for the default.
        """
        from bench.runs.begun import begun
        from bench.runs.identity import fingerprint
        from bench.runs.runner import prepare, refuse_unreachable

        new = begun(experiment, folder, jobs, salt)
        results = prepare(new.experiment, new.secret)
        # This comes before the folder is created, so that a user error leaves no files behind.
        if jobs:
            refuse_unreachable(new.experiment)
        hashes = fingerprint(new.experiment, plugins)
        comparison = cls(new.write(plugins, hashes, results.redraws))
        comparison.secret = new.secret
        comparison._attach(results)
        return comparison

    @classmethod
    def resume(cls, folder: Path, plugins: Sequence[str] = ()) -> Comparison:
        """Open an interrupted comparison with its finished runs; see `bench.study.Study.resume`.

        Args:
            folder: result folder.
            plugins: additional plugin files.
        """
        from bench.runs.identity import unchanged
        from bench.runs.runner import prepare

        comparison = cls(folder)
        experiment = comparison.configuration.experiment
        comparison.plugins = unchanged(folder, comparison.configuration, plugins)
        comparison.secret = kept_salt(folder, experiment)
        comparison._attach(prepare(experiment, comparison.secret))
        return comparison

    def _attach(self, results: Results) -> None:
        """Open the journal of the folder, and write or check the plan."""
        from bench.runs.training import folder as trained

        self.results = results
        # Tuners must not access true parameters, results of other tuners, or earlier trainings.
        results.hidden = tuple(str(place.resolve()) for place in (self.folder, trained()))
        ids = [job.order.run for job in results.plan]
        if not (self.folder / FOLDER).exists():
            results.kept.statuses = self._complete(ids)
            return
        planned = read_plan(self.folder)
        journal = Journal(self.folder)
        try:
            if planned is not None and planned != ids:
                raise InputError(
                    f"{self.folder / FOLDER / PLAN}: its plan is not the one that its "
                    "configuration gives; start a new comparison"
                )
            self._check_kept(journal, ids)
        except InputError:
            journal.close()
            raise
        # The process was killed before it wrote the plan, so there are no runs to compare with it.
        if planned is None:
            write_plan(self.folder, ids)
        results.kept = journal

    def _check_kept(self, journal: Journal, ids: list[str]) -> None:
        """Check every stored row, because damaged rows would falsify the results.

        Raises:
            InputError: a row is damaged, or belongs to another plan.
        """
        experiment = self.configuration.experiment
        for path, held, records in journal.files():
            file = RunsFile(path, REMEDY)
            statuses = check_kept(path, held, experiment, ids, REMEDY)
            runs = file.runs(experiment, records)
            check_runs(runs, file, experiment)
            check_alike(runs, file, statuses, partial(_at_file, file), "its statuses")

    def _complete(self, ids: list[str]) -> dict[int, Status]:
        """Return the statuses of a finished comparison by their index in the plan.

        Raises:
            InputError: the folder has other runs than the plan, or is damaged.
        """
        statuses = self._stored()
        if [status.run for status in statuses] != ids:
            raise InputError(
                f"{self.folder / 'status.csv'}: expected the {len(ids)} runs of the plan, found "
                f"{len(statuses)} or others; start a new comparison"
            )
        return dict(enumerate(statuses))

    def _stored(self) -> list[Status]:
        """Return the statuses of a finished comparison in the order of its plan."""
        statuses = read(self.folder, ["run", "tuner", "k"]).statuses
        made = statuses[statuses["status"] != "skipped"]
        rows: list[dict[str, Any]] = [
            {str(name): value for name, value in row.items()}
            for row in made[STATUS_COLUMNS].to_dict("records")
        ]
        return [Status(**row) for row in rows]

    def make(
        self, jobs: int = 2, progress: Progress | None = None, pool: Pool | None = None
    ) -> Made:
        """Run what is missing, and write the results; see `bench.study.Study.make`.

        Args:
            jobs: number of worker processes; 0 for none.
            progress: called for every step.
            pool: pool to use instead of local workers.
        """
        # Modules that the results need are imported before the work. An interrupt during a first
        # import would leave a module half imported, and the results could not be written.
        import pandas as pd  # noqa: F401
        from pyarrow import compute, parquet  # noqa: F401

        from bench.runs.runner import run, silent

        results = self._begun()
        journal = results.kept
        if not isinstance(journal, Journal):  # the comparison was complete before
            return Made(len(results.plan), len(results.plan))
        try:
            run(results, self.plugins, jobs, progress or silent, pool)
        finally:
            # If workers cannot be started, the results so far are still written.
            write_results(
                self.folder,
                journal,
                results.training_rows(),
                results.skipped_rows(),
                self.configuration.experiment.trusted,
            )
            self._write_spectra(results)
            made = Made(
                len(journal.statuses), len(results.plan), results.interrupted, results.stopped
            )
            if made.complete:
                reveal(self.folder, self.secret)
                self.configuration = configuration(self.folder)
                journal.discard()
            else:
                journal.close()
        return made

    def close(self) -> None:
        """Release the folder without running what is missing."""
        if self.results is not None and isinstance(self.results.kept, Journal):
            self.results.kept.close()

    def _begun(self) -> Results:
        if self.results is None:
            raise InputError(f"{self.folder}: opened to be looked at; resume it to make the rest")
        return self.results

    def _write_spectra(self, results: Results) -> None:
        """Write identifiability.csv, one row per target and direction, for several parameters."""
        if results.spectra:
            from bench.analysis.spectra import spectra_table

            problem = results.problem
            table = spectra_table(problem.experiment, results.spectra, problem.cube.parameters)
            write(self.folder / "identifiability.csv", table.to_csv(index=False))

    def status(self) -> Standing:
        """Return what the folder contains and what is missing; another process may be running it.

        Raises:
            InputError: the folder is damaged.
        """
        held = self.configuration
        ends = tuple(self._ends())
        return Standing(
            held.experiment.name, "runs finished", held.fingerprint, ends, self._under_way
        )

    def _ends(self) -> list[End]:
        if not self._under_way:
            return [_end(status.run, status) for status in self._stored()]
        planned, experiment = read_plan(self.folder), self.configuration.experiment
        if planned is not None:
            path = self.folder / FOLDER / PLAN
            check_plan(planned, experiment, path, PLAN_REMEDY)
        made: dict[str, Status] = {}
        for path, held in kept(self.folder):
            check_kept(path, held, experiment, planned, REMEDY)
            made |= {status.run: status for status in held.values()}
        return [_end(name, made.get(name)) for name in (made if planned is None else planned)]

    @property
    def _under_way(self) -> bool:
        """Whether the comparison is unfinished: its journal is deleted when all is written."""
        return (self.folder / FOLDER).exists()

    def finish(self, say: Say) -> int:
        """Write tables and figures of the stored runs, and print the results.

        Args:
            say: callback that prints one line.

        Returns:
            Number of failed runs.

        Raises:
            InputError: nothing has been written yet, or the results are damaged.
        """
        from bench.problem.problem import Problem
        from bench.report import finish

        results = self.results
        problem = results.problem if results else Problem(self.configuration.experiment)
        failed = finish(self.folder, problem, say)
        for line in results.notes.lines() if results else ():
            say(line)
        return failed


def _at_file(file: RunsFile, _row: int, says: str) -> InputError:
    """Make the error for a status of a journal file, which belongs to none of its rows."""
    return file.fault(None, says)


def _end(name: str, status: Status | None) -> End:
    """Return how a planned run ended, or that it is missing; its id begins with the tuner label."""
    tuner = name.partition("/")[0]
    if status is None:
        return End(name, tuner, MISSING)
    return End(name, tuner, str(status.status), str(status.reason))
