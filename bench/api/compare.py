"""Python API: `simgap.compare` and `simgap.sweep`, with results as tables and figures."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

from bench.benchmark.figures import comparison_figures
from bench.benchmark.problem.experiment import Experiment, list_experiment_names, load_experiment
from bench.benchmark.problem.model_file_simulator import complete_robot_experiment
from bench.benchmark.problem.robot_experiment import make_robot_experiment
from bench.benchmark.problem.tuning_problem import TuningProblem
from bench.benchmark.results_report import build_tables
from bench.benchmark.runner.experiment_runner import ProgressFactory
from bench.benchmark.runner.plugin_discovery import load_plugins_for_experiment
from bench.benchmark.runner.resource_checks import check_comparison_size
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
from bench.core.plugin_registries import diagnosers
from bench.core.plugin_registries import tuners as registered
from bench.diagnosis_benchmark import table_columns as diagnosis
from bench.figures.figure_files import pdf_figures
from bench.misspecification.calibration import MODEL_LABELS
from bench.studies import study
from methods.tuner import Tuner
from sims.core.argument_checks import (
    Count,
    Expected,
    Files,
    Name,
    Names,
    Natural,
    Seconds,
    check_arguments,
)
from sims.core.simulator import InputError, make_unknown_name_error

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from bench.benchmark.runner.worker_pools import Pool

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
_ROWS = 200
"""Maximum number of table rows that a notebook shows."""


ExperimentSource: TypeAlias = Annotated[
    str | Path | Experiment,
    Expected("the name of an experiment, the path of its TOML file or an Experiment"),
]
"""The experiment to run."""
Tuners: TypeAlias = Annotated[
    Sequence[Name | type[Tuner]],
    Expected("names of tuners or subclasses of Tuner, as ['cma_es', 'random']"),
]
"""The tuners to compare."""
RecordingFile: TypeAlias = Annotated[
    str | Path, Expected("the path of NAME.csv, which results are traced to")
]
"""A recording that must be a file."""


@check_arguments
def compare(
    experiment: ExperimentSource | None = None,
    *,
    model: str | Path | None = None,
    recording: RecordingFile | None = None,
    free: Names = (),
    tuners: Tuners | None = None,
    targets: Count | None = None,
    seeds: Count | None = None,
    budget: Count | None = None,
    training_budget: Count | None = None,
    timeout: Seconds | None = None,
    memory: Natural | None = None,
    jobs: Natural = 2,
    trust: bool = False,
    isolation: Name | None = None,
    salt: str | None = None,
    out: str | Path | None = None,
    plugins: Files = (),
    cluster: str | None = None,
    progress: ProgressFactory | None = None,
    force: bool = False,
    pdf: bool = False,
) -> ComparisonResult:
    """Run an experiment: every tuner on every target with every seed.

    Args:
        experiment: Name of an experiment, path of its TOML file, or an `Experiment`; None for a
            robot, which `model` and `free` describe.
        model: Model file of a robot, MJCF or URDF.
        recording: Path of a recording of that robot; without one, targets are simulated.
        free: Numbers of the model file to tune, as ``damping@*`` or ``mass@forearm``.
        tuners: Labels, registered names or classes of the tuners to run; None for all tuners of the
            experiment. A class is registered.
        targets: Number of targets in each range.
        seeds: Number of seeds for each tuner that uses random numbers.
        budget: Number of simulations on one target.
        training_budget: Number of simulations that a learned tuner may train on.
        timeout: Time limit of a run in seconds.
        memory: Memory limit of a run in MiB; 0 is no limit.
        jobs: Number of worker processes. 0 runs everything in this process: output of ``print``
            appears, breakpoints work, and classes of a script or notebook can be used; tuners are
            then not isolated.
        trust: Run tuners inside the harness, where they could read the true parameters. This is
            faster, and the results are marked.
        isolation: ``run`` starts a fresh process for every run of a tuner, ``tuner`` one for all
            runs with the same seed; None for the experiment's own choice.
        salt: Text from which targets are drawn. It is secret until the end; ``public`` draws the
            published targets; None for a fresh one.
        out: Folder to write, new or empty; None for a new one below results/.
        plugins: Python files with further tuners, simulators and effects.
        cluster: Address of a Dask scheduler to run on.
        progress: Called with a title and a number of steps; returns the function that is called
            after each step.
        force: Start even if it needs more than this machine has.
        pdf: Write every figure as PDF, too, in addition to PNG.

    Returns:
        Tables and figures of the results.

    Raises:
        InputError: An argument, the experiment or a plugin cannot be used; nothing has been run
            then.
    """
    if experiment is None and not (model or recording or free):
        raise InputError(
            "compare: expected an experiment, as simgap.compare('ball-drop'), or a robot, as "
            "simgap.compare(model='robot.xml', free=['damping@*']); experiments are "
            f"{', '.join(list_experiment_names())}"
        )
    files = [str(Path(plugin).resolve()) for plugin in plugins]
    chosen = apply_changes(
        load_experiment_plugins(
            resolve_experiment(experiment, model, recording, free),
            files,
            trust or not jobs,
            isolation,
        ),
        None if tuners is None else [_label(tuner) for tuner in tuners],
        seeds,
        targets=targets,
        budget=budget,
        training_budget=training_budget,
        timeout=timeout,
        memory=memory,
    )
    if chosen.sweep:
        raise InputError(f"experiment {chosen.name} sweeps over values: use simgap.sweep")
    if chosen.experiments:
        raise InputError(f"experiment {chosen.name} names several: use simgap.sweep")
    folder = None if out is None else Path(out)
    check_comparison_size(chosen, folder, jobs, cluster is not None, force)
    pool = _cluster(cluster)
    begun = study.begin_study(chosen, files, folder, jobs, salt)
    with pdf_figures(pdf):
        return _run_study(begun, jobs, progress, pool)


@check_arguments
def sweep(
    experiment: ExperimentSource,
    *,
    jobs: Natural = 2,
    trust: bool = False,
    salt: str | None = None,
    out: str | Path | None = None,
    plugins: Files = (),
    progress: ProgressFactory | None = None,
    force: bool = False,
    pdf: bool = False,
) -> list[ComparisonResult]:
    """Run one by one the experiments of a ``[sweep]`` or of an ``experiments`` list.

    Args:
        experiment: Name of an experiment, path of its TOML file, or an `Experiment`.
        jobs: As in `compare`.
        trust: As in `compare`.
        salt: As in `compare`; all experiments share it, so that they have the same targets.
        out: Folder in which each experiment gets its own folder, with the experiment's name.
        plugins: As in `compare`.
        progress: As in `compare`.
        force: As in `compare`.
        pdf: As in `compare`.

    Returns:
        The results, in the order of the file's values.

    Raises:
        InputError: An argument is invalid; the message is one line, and nothing has been run then.
    """
    files = [str(Path(plugin).resolve()) for plugin in plugins]
    chosen = apply_changes(load_experiment_plugins(experiment, files, trust or not jobs))
    folder = None if out is None else Path(out)
    check_comparison_size(chosen, folder, jobs, force=force)
    begun = study.begin_studies(chosen, files, folder, jobs, salt)
    with pdf_figures(pdf):
        made = [_run_study(one, jobs, progress, None) for one in begun]
        if len(begun) > 1:
            study.report_jointly(begun[0].folder.parent, _discard_line)
    return made


def resolve_experiment(
    experiment: str | Path | Experiment | None,
    model: str | Path | None = None,
    recording: str | Path | None = None,
    free: Sequence[str] = (),
) -> str | Path | Experiment:
    """Return the named experiment, or the one described by a model file and a recording.

    Args:
        experiment: Name of an experiment, path of its TOML file, or an `Experiment`.
        model: Model file of a robot.
        recording: Recording of that robot.
        free: Numbers of the model file to tune.

    Raises:
        InputError: Neither or both are given.
    """
    parts = {"model": model, "recording": recording, "free": free}
    there = [name for name, value in parts.items() if value]
    if experiment is not None:
        if there:
            raise InputError(
                f"experiment {experiment} says what it tunes: leave out {', '.join(there)}, or "
                "leave out the experiment"
            )
        return experiment
    if not there:
        raise InputError(
            "expected an experiment (see `simgap list experiments`), or --resume DIR, or a robot: "
            "--model FILE --free A,B"
        )
    return make_robot_experiment(model, recording, free)


def load_experiment_plugins(
    experiment: str | Path | Experiment,
    plugins: Sequence[str | Path],
    trust: bool,
    isolation: str | None = None,
) -> Experiment:
    """Load an experiment and its plugins into this process.

    Args:
        experiment: Name of an experiment, path of its TOML file, or an `Experiment`.
        plugins: Python files with further parts.
        trust: Whether to run tuners without isolation.
        isolation: As in `compare`.

    Raises:
        InputError: The experiment does not exist, or a plugin cannot be used.
    """
    whole = experiment if isinstance(experiment, Experiment) else load_experiment(str(experiment))
    whole = whole.chosen(trusted=whole.trusted or trust, isolation=isolation)
    load_plugins_for_experiment([str(Path(plugin).resolve()) for plugin in plugins], whole)
    # The robot's default commands are filled in, so that the result folder contains them.
    return complete_robot_experiment(whole)


def _cluster(address: str | None) -> Pool | None:
    if address is None:
        return None
    from bench.benchmark.runner.dask_cluster import ClusterPool

    return ClusterPool(address)


def _run_study(
    begun: study.Study, jobs: int, progress: ProgressFactory | None, pool: Pool | None
) -> ComparisonResult:
    """Run and report a study."""
    made = begun.run(jobs, progress, pool)
    if made.skipped:
        raise InputError(f"{begun.configuration.experiment.name}: skipped: {made.skipped}")
    begun.report(_discard_line)
    if made.interrupted:
        # A notebook's cell ends as the user requested; finished runs are stored in the folder.
        raise KeyboardInterrupt(f"what was finished is kept in {begun.folder}")
    return ComparisonResult(begun.folder)


def _discard_line(_line: str) -> None:
    """Discard a line that the command would print; in Python the tables are available."""


def apply_changes(
    experiment: str | Path | Experiment,
    labels: Sequence[str] | None = None,
    seeds: int | None = None,
    **changes: float | None,
) -> Experiment:
    """Apply changes to an experiment.

    Args:
        experiment: Name of an experiment, path of its TOML file, or an `Experiment`.
        labels: Labels or registered names of the only tuners to run; None for all.
        seeds: Number of seeds for each tuner that uses random numbers.
        changes: Other fields; None leaves a field unchanged.

    Raises:
        InputError: The experiment or a tuner does not exist.
    """
    whole = experiment if isinstance(experiment, Experiment) else load_experiment(str(experiment))
    if whole.diagnosis:
        return _choose_diagnosers(whole, labels, changes)
    whole = whole.chosen(**changes)
    if seeds:
        whole = whole.with_seeds(seeds)
    if labels is None:
        return whole
    known = {*registered.names(), *(entry.label for entry in whole.tuners)}
    for label in labels:
        if label not in known:
            raise make_unknown_name_error("tuner", label, sorted(known))
    return whole.with_tuners(labels)


def _choose_diagnosers(
    whole: Experiment, labels: Sequence[str] | None, changes: Mapping[str, float | None]
) -> Experiment:
    """Apply changes to a comparison of diagnosers, whose targets are benchmark cases."""
    sample = changes.get("targets")
    table = dict(whole.diagnosis)
    if sample is not None:
        table["sample"] = sample
    if labels is not None:
        for label in labels:
            if label not in diagnosers.names():
                raise make_unknown_name_error("diagnoser", label, diagnosers.names())
        table["diagnosers"] = list(labels)
    rest = {name: value for name, value in changes.items() if name != "targets"}
    return whole.chosen(diagnosis=table, **rest)


def _label(tuner: str | type[Tuner]) -> str:
    """Return the name under which a tuner runs; register a class."""
    if isinstance(tuner, str):
        return tuner
    if not (inspect.isclass(tuner) and issubclass(tuner, Tuner)):
        raise InputError(f"tuners: expected names and subclasses of Tuner, found {tuner!r:.80}")
    return registered.register(tuner).name


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
    def _stored(self) -> StoredComparison:
        return read_comparison(self.folder)

    @cached_property
    def _labels(self) -> comparison_figures.AxisLabels:
        problem = TuningProblem(self.experiment)
        try:
            return comparison_figures.make_axis_labels(problem)
        finally:
            problem.close()

    def _csv(self, name: str) -> pd.DataFrame:
        """Read a table file of a bounce shot or of a study of two comparisons."""
        remedy = f"simgap plot {self.folder} writes it again"
        path = self.folder / f"{name}.csv"
        columns = (
            _SHOT_TABLE_COLUMNS if self.experiment.shot else _MISSPECIFICATION_TABLE_COLUMNS
        )[name]
        table: pd.DataFrame = CsvTable(path, columns, remedy).table.to_pandas()
        return table

    @property
    def _in_files(self) -> bool:
        """True if tables and figures are only available as files in the folder."""
        asked = self.experiment
        return bool(asked.shot or asked.calibration or asked.diagnosis)

    @property
    def _what(self) -> str:
        """Name of this kind of study, for messages."""
        if self.experiment.diagnosis:
            return "a comparison of diagnosers"
        return "a bounce shot" if self.experiment.shot else "a study of two comparisons"

    def _both(self, rows: Callable[[StoredComparison], pd.DataFrame]) -> pd.DataFrame:
        """Concatenate rows of a study's two comparisons, with the simulator's name first."""
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
            return {name: self._csv(name) for name in ("table", "shots")}
        if self.experiment.calibration:
            return {name: self._csv(name) for name in _MISSPECIFICATION_TABLE_COLUMNS}
        return build_tables(self._stored)

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
            return self._both(lambda stored: stored.runs)
        return self.tables["shots"] if self.experiment.shot else self._stored.runs

    @property
    def statuses(self) -> pd.DataFrame:
        """A row for each run or answer with its status and reason, as in status.csv."""
        if self.experiment.diagnosis:
            return self.tables["items"][list(diagnosis.STATUS_COLUMNS)]
        if self.experiment.calibration:
            return self._both(lambda stored: stored.statuses)
        return self._csv("status") if self.experiment.shot else self._stored.statuses

    @property
    def figures(self) -> list[str]:
        """Names of the available figures.

        The figures of a bounce shot, of a study of a missing effect and of diagnosers are files in
        the folder instead.
        """
        return [] if self._in_files else comparison_figures.list_figure_names(self._stored)

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
            raise InputError(f"figures of {self._what} are files: {self.folder / 'figures'}")
        asked = [behind] if isinstance(behind, str) else behind
        references = [find_reference(one) for one in asked]
        return comparison_figures.draw_figure(self._stored, self._labels, name, behind=references)

    def summary(self) -> pd.DataFrame:
        """Return each tuner's last error in ranking order, with verdict and failures.

        For diagnosers, the measures of each diagnoser.
        """
        table = self.table
        if self.experiment.diagnosis:
            return diagnosis.build_leaderboard(table)
        if self._in_files:
            return table
        last = table[table["simulations"] == table["simulations"].max()]
        first = last[last["metric"] == last["metric"].iloc[0]]
        import pandas as pd

        ranking = self.tables["ranking"]
        last = ranking[ranking["simulations"] == ranking["simulations"].max()]
        verdicts = last.set_index(["range", "tuner"])["verdict"]
        places = pd.MultiIndex.from_frame(first[["range", "tuner"]])
        first = first.assign(verdict=verdicts.reindex(places).to_numpy())
        columns = ["tuner", "range", "verdict", "metric", "median", "mean", "low", "high"]
        best: pd.DataFrame = first[[*columns, "runs", "failures"]]
        return best.reset_index(drop=True)

    def __repr__(self) -> str:
        failed = int((~self.statuses["status"].isin(("done", "converged"))).sum())
        what = "answers" if self.experiment.diagnosis else "runs"
        runs = f"{len(self.statuses)} {what}, {failed} of them failed or skipped"
        return f"<comparison {self.experiment.name}: {runs}; {self.folder}>"

    def _repr_html_(self) -> str:
        html: str = (
            self.summary()
            .head(_ROWS)
            .to_html(index=False, float_format=lambda value: f"{value:.3g}")
        )
        return html
