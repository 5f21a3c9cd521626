"""Comparison of tuners in its result folder: begin, resume, run, show status, and report."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from bench.benchmark.runner.study_base import PrintLine, Study
from bench.benchmark.storage.result_file_consistency import (
    RunsTable,
    check_journal_statuses,
    check_plan,
    check_rows_match_statuses,
    check_runs,
)
from bench.benchmark.storage.result_folder import read_comparison, write_results
from bench.benchmark.storage.run_journal import (
    JOURNAL_FILE,
    JOURNAL_REMEDY,
    PLAN_FILE,
    PLAN_REMEDY,
    SEGMENTS_FOLDER,
    RunJournal,
    read_plan,
    read_statuses,
    write_plan,
)
from bench.benchmark.storage.run_status import (
    MISSING_STATUS,
    RunEnd,
    StudyOutcome,
)
from bench.benchmark.storage.secret_salt import read_salt
from sims.core.files import write_atomically
from sims.core.simulator import InputError

if TYPE_CHECKING:
    from typing_extensions import Self

    from bench.benchmark.runner.experiment_runner import ExperimentRun, ProgressFactory
    from bench.benchmark.runner.study_base import PreparedStudy
    from bench.benchmark.runner.worker_pools import Pool


class Comparison(Study):
    """Comparison of tuners x targets x seeds in a result folder; implements `study.Study`.

    Attributes:
        folder: result folder.
        configuration: configuration of the comparison.
        results: problem, plan and stored runs; None if the comparison is read-only.

    Raises:
        InputError: the folder is not that of a comparison, or it is damaged.
    """

    def __init__(self, folder: Path) -> None:
        """Open a comparison for reading: its configuration is read, but no plan and no runs.

        Args:
            folder: result folder of a comparison, for status and report. Use `begin` or `resume`
                for a comparison that can be run.
        """
        super().__init__(folder)
        self.results: ExperimentRun | None = None

    @classmethod
    def begin(cls, new: PreparedStudy) -> Comparison:
        """Plan a comparison in a new folder, without running it; see `Study.begin`.

        Args:
            new: folder, experiment, plugins and salt, from `prepare_study`.
        """
        from bench.benchmark.runner.experiment_runner import prepare_experiment

        results = prepare_experiment(new.experiment, new.secret)
        # A comparison opens an existing folder.
        comparison = cls(new.create_folder(results.redraws))
        comparison._attach(results)
        return comparison

    @classmethod
    def resume(cls, folder: Path, plugins: Sequence[str] = ()) -> Self:
        """Open an interrupted comparison with its finished runs; see `Study.resume`.

        Args:
            folder: result folder.
            plugins: additional plugin files.
        """
        from bench.benchmark.runner.experiment_runner import prepare_experiment

        comparison = super().resume(folder, plugins)
        experiment = comparison.configuration.experiment
        comparison._attach(prepare_experiment(experiment, read_salt(folder, experiment)))
        return comparison

    def _attach(self, results: ExperimentRun) -> None:
        """Prepare the comparison for running: open its journal, write or check its plan.

        The plan is the list of all run ids; the journal is the file to which each run is appended
        when it ends. A finished comparison has neither file; then its tables are compared with the
        plan.

        Args:
            results: the problem and the planned runs; the journal is added to it.

        Raises:
            InputError: the stored plan or runs do not belong to the configuration.
        """
        from bench.benchmark.runner.trained_weights import get_weights_folder

        self.results = results
        # Tuners must not access true parameters, results of other tuners, or earlier trainings.
        results.hidden_paths = tuple(
            str(path.resolve()) for path in (self.folder, get_weights_folder())
        )
        ids = [planned.request.run for planned in results.plan]
        if not self.is_unfinished:
            finished_ids = [end.name for end in self._list_finished_ends()]
            if finished_ids != ids:
                raise InputError(
                    f"{self.folder / 'status.csv'}: expected the {len(ids)} runs of the plan, "
                    f"found {len(finished_ids)} or others; start a new comparison"
                )
            return
        planned_ids = read_plan(self.folder)
        journal = RunJournal(self.folder)
        try:
            if planned_ids is not None and planned_ids != ids:
                raise InputError(
                    f"{self.folder / SEGMENTS_FOLDER / PLAN_FILE}: its plan is not the one that "
                    "its configuration gives; start a new comparison"
                )
            self._check_stored_rows(journal, ids)
        except InputError:
            journal.close()
            raise
        # A new comparison has no plan yet, nor has one whose process was killed before writing it.
        if planned_ids is None:
            write_plan(self.folder, ids)
        results.run_sink = journal

    def _check_stored_rows(self, journal: RunJournal, ids: list[str]) -> None:
        """Check every stored row before a study is continued: damaged rows would falsify results.

        Args:
            journal: journal of the stored runs.
            ids: ids of the planned runs.

        Raises:
            InputError: a row is damaged, or belongs to another plan.
        """
        experiment, first_row = self.configuration.experiment, 0
        statuses = check_journal_statuses(journal.path, journal.statuses, experiment, ids)
        # The index is the position of the run in the plan.
        statuses.index = list(journal.statuses)
        for indices, rows in journal.iterate_tables():
            # The rows are those of a chunk of runs; `first_row` numbers them in error messages.
            file = RunsTable(journal.path, JOURNAL_REMEDY, rows, first_row)
            runs = file.read_runs(experiment)
            check_runs(runs, file, experiment)
            check_rows_match_statuses(
                runs,
                file,
                statuses.loc[indices].reset_index(drop=True),
                partial(_make_status_error, file),
                "its statuses",
            )
            first_row += len(rows)

    def _list_finished_ends(self) -> list[RunEnd]:
        """List how the runs of a finished comparison ended, in the order of its plan.

        Tuners that were skipped have no run in the plan, so their rows are left out.
        """
        statuses = read_comparison(self.folder, ["run", "tuner", "k"]).statuses
        executed = statuses[statuses["status"] != "skipped"]
        rows = executed[["run", "tuner", "status", "reason"]].to_numpy().tolist()
        return [RunEnd(run, tuner, status, reason) for run, tuner, status, reason in rows]

    def run(
        self, jobs: int = 2, progress: ProgressFactory | None = None, pool: Pool | None = None
    ) -> StudyOutcome:
        """Run what is missing, and write the results; see `Study.run`.

        Missing runs are executed and stored one by one, so that an interruption loses nothing; at
        the end the tables are written and the salt is revealed.

        Args:
            jobs: number of worker processes; 0 for none.
            progress: called for every step.
            pool: pool to use instead of local workers.
        """
        # Modules that the results need are imported before the work. An interrupt during a first
        # import would leave a module half imported, and the results could not be written.
        import pandas as pd  # noqa: F401
        from pyarrow import compute, parquet  # noqa: F401

        from bench.benchmark.runner.experiment_runner import no_progress, run_experiment

        results = self._require_experiment_run()
        journal = results.run_sink
        # Only an unfinished comparison has a journal; nothing is missing in any other.
        if not isinstance(journal, RunJournal):
            return StudyOutcome(len(results.plan), len(results.plan))
        try:
            run_experiment(results, self.plugins, jobs, progress or no_progress, pool)
        finally:
            # If workers cannot be started, the results so far are still written.
            write_results(
                self.folder,
                journal,
                results.build_training_rows(),
                results.build_skipped_rows(),
                self.configuration.experiment.trusted,
            )
            self._write_spectra(results)
            outcome = StudyOutcome(
                len(journal.statuses), len(results.plan), results.interrupted, results.stopped
            )
            if outcome.is_complete:
                self.reveal_salt()
                journal.delete_segments()
            else:
                journal.close()
        return outcome

    def close(self) -> None:
        """Release the folder without running what is missing."""
        if self.results is not None and isinstance(self.results.run_sink, RunJournal):
            self.results.run_sink.close()

    def _require_experiment_run(self) -> ExperimentRun:
        """Return the problem, plan and stored runs, which only a comparison that can be run has.

        Raises:
            InputError: the comparison was opened for reading (`results` is None).
        """
        if self.results is None:
            raise InputError(
                f"{self.folder}: this study is read-only; resume it to run what is missing"
            )
        return self.results

    def _write_spectra(self, results: ExperimentRun) -> None:
        """Write identifiability.csv: how well the data determine the parameters.

        It has one row per target and direction of the parameter space. There is no such file for a
        single parameter.

        Args:
            results: Runs of the experiment with the information spectrum of each target.
        """
        if results.spectra:
            from bench.benchmark.problem.fisher_information import build_identifiability_table

            problem = results.problem
            table = build_identifiability_table(
                problem.experiment, results.spectra, problem.cube.parameters
            )
            write_atomically(self.folder / "identifiability.csv", table.to_csv(index=False))

    def list_run_ends(self) -> list[RunEnd]:
        """List how every run ended, for `simgap status`.

        A finished comparison has one table of statuses. In an unfinished one they are in its
        journal, which is checked against the plan; a planned run that has not ended has no status.
        """
        if not self.is_unfinished:
            return self._list_finished_ends()
        planned_ids, experiment = read_plan(self.folder), self.configuration.experiment
        segments = self.folder / SEGMENTS_FOLDER
        if planned_ids is not None:
            check_plan(planned_ids, experiment, segments / PLAN_FILE, PLAN_REMEDY)
        statuses = read_statuses(self.folder)
        check_journal_statuses(segments / JOURNAL_FILE, statuses, experiment, planned_ids)
        ends = {
            status.run: RunEnd(status.run, status.tuner, status.status, status.reason)
            for status in statuses.values()
        }
        return [
            # The id of a run begins with the label of its tuner.
            ends.get(name) or RunEnd(name, name.partition("/")[0], MISSING_STATUS)
            for name in (ends if planned_ids is None else planned_ids)
        ]

    @property
    def is_unfinished(self) -> bool:
        """True if the comparison is unfinished: its journal is deleted when all is written."""
        return (self.folder / SEGMENTS_FOLDER).exists()

    def report(self, print_line: PrintLine) -> int:
        """Write tables and figures of the stored runs, and print the results.

        Returns:
            Number of failed runs.

        Raises:
            InputError: nothing has been written yet, or the results are damaged.
        """
        from bench.benchmark.comparison_report import write_report

        failed = write_report(self.folder, print_line)
        # Notes for the authors of tuners, if runs were made in this session.
        for line in self.results.notes.lines() if self.results else ():
            print_line(line)
        return failed


def _make_status_error(file: RunsTable, _row: int, problem: str) -> InputError:
    """Make the error for a status of a journal file, which belongs to none of its rows."""
    return file.make_error(None, problem)
