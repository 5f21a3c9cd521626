"""Python API: `simgap.compare` and `simgap.sweep`, with results as tables and figures."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

from bench.api.comparison_options import (
    ComparisonOptions,
    StudyOptions,
    apply_changes,
    get_tuner_label,
)
from bench.benchmark import comparison_charts, comparison_figures
from bench.benchmark.problem.experiment import Experiment, list_experiment_names, load_experiment
from bench.benchmark.problem.missing_requirements import leave_out_missing_problems
from bench.benchmark.problem.robot_experiment import (
    complete_robot_experiment,
    make_robot_experiment,
)
from bench.benchmark.runner.comparison_resources import check_comparison_size
from bench.benchmark.runner.dask_cluster import ClusterPool
from bench.benchmark.runner.plugin_discovery import load_plugins_for_experiment
from bench.benchmark.statistics.comparison_statistics import build_tables
from bench.benchmark.storage.csv_reader import CsvTable
from bench.benchmark.storage.reference_results import find_reference
from bench.benchmark.storage.result_folder import StoredComparison, read_comparison
from bench.benchmark.storage.table_schemas import (
    MISSPECIFICATION_RANK_COLUMNS,
    MISSPECIFICATION_TABLE_COLUMNS,
    RANK_AGREEMENT_COLUMNS,
    SHOT_COLUMNS,
    SHOT_STATUS_COLUMNS,
    SHOT_TABLE_COLUMNS,
)
from bench.core.options import with_options
from bench.diagnosis_benchmark import result_tables as diagnosis
from bench.diagnosis_benchmark.diagnosers import language_model
from bench.figures.figure_settings import pdf_figures
from bench.misspecification.calibration import MODEL_LABELS
from bench.studies import study
from sims.core.argument_checks import Expected, check_arguments
from sims.core.simulator import InputError

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from bench.benchmark.runner.study_base import Study
    from bench.benchmark.storage.run_status import StudyOutcome

_SHOT_TABLE_COLUMNS = {
    "status": SHOT_STATUS_COLUMNS,
    "shots": SHOT_COLUMNS,
    "table": SHOT_TABLE_COLUMNS,
}
"""Columns of the tables of a bounce shot."""
_MISSPECIFICATION_TABLE_COLUMNS = {
    "table": MISSPECIFICATION_TABLE_COLUMNS,
    "ranks": MISSPECIFICATION_RANK_COLUMNS,
    "ranking": RANK_AGREEMENT_COLUMNS,
}
"""Columns of the tables of a study of a missing effect."""
_EXPERIMENT_OPTIONS = ("targets", "budget", "training_budget", "timeout", "memory")
"""Options that change the key of the same name in an experiment."""
DEFAULTS = ComparisonOptions()
_MAX_NOTEBOOK_ROWS = 200
"""Maximum number of table rows that a notebook shows."""


ExperimentSource: TypeAlias = Annotated[
    str | Path | Experiment,
    Expected("the name of an experiment, the path of its TOML file or an Experiment"),
]
"""The experiment to run."""


@with_options(ComparisonOptions)
def compare(
    experiment: ExperimentSource | None = None, options: ComparisonOptions = DEFAULTS
) -> ComparisonResult:
    """Run an experiment: every tuner on every target with every seed.

    Args:
        experiment: Name of an experiment, path of its TOML file, or an `Experiment`; None for a
            robot, which `model` and `free` describe.
        options: Keyword arguments, the attributes of
            `bench.api.comparison_options.ComparisonOptions`.

    Returns:
        Tables and figures of the results.

    Raises:
        InputError: An argument, the experiment or a plugin cannot be used; nothing has been run
            then.
    """
    if experiment is None and not (options.model or options.recording or options.free):
        raise InputError(
            "compare: expected an experiment, as simgap.compare('ball-drop'), or a robot, as "
            "simgap.compare(model='robot.xml', free=['damping@*']); experiments are "
            f"{', '.join(list_experiment_names())}"
        )
    chosen_experiment = build_experiment(experiment, options)
    if chosen_experiment.sweep:
        raise InputError(
            f"experiment {chosen_experiment.name} sweeps over values: use simgap.sweep"
        )
    if chosen_experiment.experiments:
        raise InputError(f"experiment {chosen_experiment.name} names several: use simgap.sweep")
    pool = None if options.cluster is None else ClusterPool(options.cluster)
    (started_study,) = begin_studies(chosen_experiment, options)
    with pdf_figures(options.pdf):
        return _report_study(started_study, started_study.run(options.jobs, options.progress, pool))


@with_options(StudyOptions)
def sweep(experiment: ExperimentSource, options: StudyOptions) -> list[ComparisonResult]:
    """Run one by one the experiments of a ``[sweep]`` or of an ``experiments`` list.

    Args:
        experiment: Name of an experiment, path of its TOML file, or an `Experiment`. Problems of a
            suite that cannot run on this machine are left out, with a warning.
        options: Keyword arguments, the attributes of `bench.api.comparison_options.StudyOptions`;
            all experiments share the salt, so that they have the same targets.

    Returns:
        The results, in the order of the file's values.

    Raises:
        InputError: An argument is invalid; the message is one line, and nothing has been run then.
    """
    shared = ComparisonOptions(**vars(options))
    studies = begin_studies(build_experiment(experiment, shared), shared)
    with pdf_figures(options.pdf):
        results = [
            _report_study(started_study, started_study.run(options.jobs, options.progress))
            for started_study in studies
        ]
        if len(studies) > 1:
            study.report_jointly(studies[0].folder.parent, _discard_line)
    return results


def build_experiment(
    experiment: str | Path | Experiment | None, options: ComparisonOptions
) -> Experiment:
    """Load the experiment that the options describe, with their changes, and its plugins.

    Args:
        experiment: Name of an experiment, path of its TOML file, or an `Experiment`; None to tune
            the robot whose model file the options name.
        options: Options of the comparison. With a command of a language model, this model is
            compared as well.

    Raises:
        InputError: The experiment, a tuner or a plugin does not exist or cannot be used, or the
            options do not name either an experiment or a robot.
    """
    stated_options = [name for name in ("model", "recording", "free") if getattr(options, name)]
    if experiment is None:
        if not stated_options:
            raise InputError(
                "expected an experiment (see `simgap list experiments`), or --resume DIR, or a "
                "robot: --model FILE --free A,B"
            )
        experiment = make_robot_experiment(options.model, options.recording, options.free)
    elif stated_options:
        raise InputError(
            f"experiment {experiment} states what it tunes: leave out "
            f"{', '.join(stated_options)}, or leave out the experiment"
        )
    loaded = experiment if isinstance(experiment, Experiment) else load_experiment(str(experiment))
    # Without worker processes tuners are not isolated, and an isolated process cannot start the
    # user's command of a language model.
    is_trusted = options.trust or not options.jobs or options.model_command is not None
    loaded = loaded.chosen(trusted=loaded.trusted or is_trusted, isolation=options.isolation)
    load_plugins_for_experiment(_list_plugin_files(options), loaded)
    # The robot's default commands are filled in, so that the result folder contains them.
    complete = complete_robot_experiment(loaded)
    labels = None  # all tuners of the experiment
    if options.tuners is not None:
        labels = [get_tuner_label(tuner) for tuner in options.tuners]
    if options.model_command is not None:
        # Workers inherit the environment.
        os.environ[language_model.COMMAND_VARIABLE] = options.model_command
        labels = [*(labels or ()), language_model.LanguageModel.name]
    changes = {name: getattr(options, name) for name in _EXPERIMENT_OPTIONS}
    return apply_changes(complete, labels, options.seeds, changes)


def _list_plugin_files(options: ComparisonOptions) -> list[str]:
    """List the plugin files, with that of the language model if its command is given."""
    files = [str(Path(plugin).resolve()) for plugin in options.plugins]
    return files + ([str(language_model.__file__)] if options.model_command is not None else [])


def _warn_of_missing_problem(name: str, reason: str) -> None:
    """Warn the caller of `sweep` that a problem of its suite is left out.

    Args:
        name: name of the problem.
        reason: why it is left out.
    """
    # The warning names the line of the user's script: its frame is the fifth one, outside of this
    # function, `begin_studies`, `sweep` and the decorator of `sweep`.
    warnings.warn(f"{name} is left out: {reason}", stacklevel=5)


def begin_studies(
    experiment: Experiment,
    options: ComparisonOptions,
    report_missing: Callable[[str, str], None] = _warn_of_missing_problem,
) -> list[Study]:
    """Plan the studies of an experiment in new folders, without running them.

    Args:
        experiment: Experiment, from `build_experiment`.
        options: Options of the comparison.
        report_missing: Called with name and reason for each problem of a suite that cannot run on
            this machine, and is left out.

    Raises:
        InputError: No problem can run here, the studies need more than this machine has, or the
            folder is not free.
    """
    experiment, missing_problems = leave_out_missing_problems(experiment)
    for name, reason in missing_problems.items():
        report_missing(name, reason)
    folder = None if options.out is None else Path(options.out)
    jobs, files = options.jobs, _list_plugin_files(options)
    check_comparison_size(experiment, folder, jobs, options.cluster is not None, options.force)
    return study.begin_studies(experiment, files, folder, jobs, options.salt)


def _report_study(started_study: Study, outcome: StudyOutcome) -> ComparisonResult:
    """Write the tables and figures of a study that has been run, and return its results.

    Args:
        started_study: study in its result folder.
        outcome: how its runs ended.

    Raises:
        InputError: the study cannot be run here.
        KeyboardInterrupt: the user interrupted the runs; finished ones are stored.
    """
    if outcome.skipped:
        raise InputError(
            f"{started_study.configuration.experiment.name}: skipped: {outcome.skipped}"
        )
    started_study.report(_discard_line)
    if outcome.interrupted:
        # A notebook's cell ends as the user requested; finished runs are stored in the folder.
        raise KeyboardInterrupt(f"finished runs are stored in {started_study.folder}")
    return ComparisonResult(started_study.folder)


def _discard_line(_line: str) -> None:
    """Discard a line that the command would print; in Python the tables are available."""


class ComparisonResult:
    """A comparison that has been run, read from its folder.

    Args:
        folder: Folder of a comparison of tuners or of diagnosers, a bounce shot or a study of a
            missing effect, finished or not.

    Attributes:
        folder: Folder with all results.
        experiment: The experiment that was run.

    Raises:
        InputError: The folder is not that of a comparison.
    """

    @check_arguments
    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.experiment: Experiment = study.open_study(self.folder).configuration.experiment

    @cached_property
    def _stored_comparison(self) -> StoredComparison:
        return read_comparison(self.folder)

    @cached_property
    def _axis_labels(self) -> comparison_charts.AxisLabels:
        """Labels of axes in figures: names and units of the parameters and channels."""
        return comparison_charts.make_axis_labels(self.experiment)

    def _read_csv_table(self, name: str) -> pd.DataFrame:
        """Read a table file of a bounce shot or of a study of two comparisons.

        Args:
            name: Name of the table without its suffix, such as "hits".
        """
        remedy = f"write it again with simgap plot {self.folder}"
        path = self.folder / f"{name}.csv"
        columns_by_table = (
            _SHOT_TABLE_COLUMNS if self.experiment.shot else _MISSPECIFICATION_TABLE_COLUMNS
        )
        table: pd.DataFrame = CsvTable(path, columns_by_table[name], remedy).table.to_pandas()
        return table

    @property
    def _in_files(self) -> bool:
        """True if tables and figures are only available as files in the folder."""
        experiment = self.experiment
        return bool(experiment.shot or experiment.calibration or experiment.diagnosis)

    @property
    def _study_kind(self) -> str:
        """Name of this kind of study, for messages."""
        if self.experiment.diagnosis:
            return "a comparison of diagnosers"
        return "a bounce shot" if self.experiment.shot else "a study of two comparisons"

    def _concatenate_comparisons(
        self, rows: Callable[[StoredComparison], pd.DataFrame]
    ) -> pd.DataFrame:
        """Concatenate the tables of a study of a missing effect, which consists of two comparisons.

        They use the simulator before and after its extension; the new first column ``model`` says
        which.

        Args:
            rows: Function that returns the table of one comparison.
        """
        import pandas as pd

        parts = []
        for model in MODEL_LABELS:
            part = rows(read_comparison(self.folder / model)).copy()
            part.insert(0, "model", model)
            parts.append(part)
        return pd.concat(parts, ignore_index=True)

    @cached_property
    def tables(self) -> dict[str, pd.DataFrame]:
        """Tables by name.

        A comparison of tuners has table, ert, ranking, pairs, break_even and who_wins; a bounce
        shot table and shots (docs/results-films.md); a study of a missing effect table, ranks and
        ranking (docs/misspecified.md); a comparison of diagnosers table, failures, items and others
        (docs/diagnosers.md).
        """
        if self.experiment.diagnosis:
            return {
                name: diagnosis.read_table(self.folder, name) for name in diagnosis.TABLE_COLUMNS
            }
        if self.experiment.shot:
            return {name: self._read_csv_table(name) for name in ("table", "shots")}
        if self.experiment.calibration:
            return {name: self._read_csv_table(name) for name in _MISSPECIFICATION_TABLE_COLUMNS}
        return build_tables(self._stored_comparison)

    @property
    def table(self) -> pd.DataFrame:
        """Error after N simulations by tuner, range and metric, in long form, as in table.csv.

        For diagnosers, each share with its interval.
        """
        return self.tables["table"]

    @property
    def runs(self) -> pd.DataFrame:
        """A row for each simulation, as in runs.parquet.

        A bounce shot has a row for each shot, a comparison of diagnosers one for each answer.
        """
        if self.experiment.diagnosis:
            return self.tables["items"]
        if self.experiment.calibration:
            return self._concatenate_comparisons(lambda stored: stored.runs)
        return self.tables["shots"] if self.experiment.shot else self._stored_comparison.runs

    @property
    def statuses(self) -> pd.DataFrame:
        """A row for each run or answer with its status and reason, as in status.csv."""
        if self.experiment.diagnosis:
            return self.tables["items"][list(diagnosis.STATUS_COLUMNS)]
        if self.experiment.calibration:
            return self._concatenate_comparisons(lambda stored: stored.statuses)
        return (
            self._read_csv_table("status")
            if self.experiment.shot
            else self._stored_comparison.statuses
        )

    @property
    def figures(self) -> list[str]:
        """Names of the available figures.

        The figures of a bounce shot, of a study of a missing effect and of diagnosers are files in
        the folder instead.
        """
        return (
            [] if self._in_files else comparison_figures.list_figure_names(self._stored_comparison)
        )

    def figure(self, name: str = "error", behind: str | Sequence[str] = ()) -> Figure:
        """Draw one of the figures; a notebook shows it inline.

        Args:
            name: Name of the figure.
            behind: Reference results, such as ``ball-drop``, or folders of comparisons, which are
                drawn in grey; at most two.

        Raises:
            InputError: There is no such figure, or a reference cannot be drawn in it.
        """
        if self._in_files:
            raise InputError(f"figures of {self._study_kind} are files: {self.folder / 'figures'}")
        names = [behind] if isinstance(behind, str) else behind
        references = [find_reference(reference) for reference in names]
        return comparison_figures.draw_figure(
            self._stored_comparison, self._axis_labels, name, references=references
        )

    def summary(self) -> pd.DataFrame:
        """Return each tuner's last error of the first metric, with its verdict and failed runs.

        The tuners are in the order of their ranking. For diagnosers, the measures of each diagnoser
        are returned.
        """
        table = self.table
        if self.experiment.diagnosis:
            return diagnosis.build_leaderboard(table)
        if self._in_files:
            return table
        import pandas as pd

        last_rows = table[table["simulations"] == table["simulations"].max()]
        rows = last_rows[last_rows["metric"] == last_rows["metric"].iloc[0]]
        # The verdict of the ranking after all simulations, in the order of these rows.
        ranking = self.tables["ranking"]
        last_ranking = ranking[ranking["simulations"] == ranking["simulations"].max()]
        verdicts = last_ranking.set_index(["range", "tuner"])["verdict"]
        ranges_and_tuners = pd.MultiIndex.from_frame(rows[["range", "tuner"]])
        rows = rows.assign(verdict=verdicts.reindex(ranges_and_tuners).to_numpy())
        columns = ["tuner", "range", "verdict", "metric", "median", "mean", "low", "high"]
        best: pd.DataFrame = rows[[*columns, "runs", "failures"]]
        return best.reset_index(drop=True)

    def __repr__(self) -> str:
        """Return one line: the experiment, the number of runs, how many failed, and the folder."""
        failed = int((~self.statuses["status"].isin(("done", "converged"))).sum())
        unit = "answers" if self.experiment.diagnosis else "runs"
        runs = f"{len(self.statuses)} {unit}, {failed} of them failed or skipped"
        return f"<comparison {self.experiment.name}: {runs}; {self.folder}>"

    def _repr_html_(self) -> str:
        """Return the summary as an HTML table, which a notebook shows for this object."""
        html: str = (
            self.summary()
            .head(_MAX_NOTEBOOK_ROWS)
            .to_html(index=False, float_format=lambda value: f"{value:.3g}")
        )
        return html
