"""`simgap.compare` and `simgap.sweep`: experiments from Python, their results as tables and
figures.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

from bench import study
from bench.diagnosis import columns as diagnosis
from bench.figures import comparison
from bench.figures.formats import pdf_figures
from bench.misspecified.calibration import MODELS
from bench.problem.asked import asked
from bench.problem.experiment import Experiment, load, names
from bench.problem.problem import Problem
from bench.problem.robots import completed
from bench.registry import diagnosers
from bench.registry import tuners as registered
from bench.report import tables
from bench.runs.runner import Progress
from bench.runs.size import check_comparison
from bench.runs.survey import admit
from bench.store.csvs import Csv
from bench.store.folder import Stored, read
from bench.store.reference import find
from bench.store.schema import (
    MISSPECIFIED_RANKING,
    MISSPECIFIED_RANKS,
    MISSPECIFIED_TABLE,
    SHOT_STATUS,
    SHOT_TABLE,
    SHOTS,
)
from methods.base import Tuner
from sims.arguments import (
    Count,
    Expected,
    Files,
    Name,
    Names,
    Natural,
    Seconds,
    check_arguments,
)
from sims.base import InputError, unknown

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from bench.runs.pools import Pool

_OF_SHOTS = {"status": SHOT_STATUS, "shots": SHOTS, "table": SHOT_TABLE}
"""Columns of the tables of a bounce shot."""
_OF_TWO = {
    "table": MISSPECIFIED_TABLE,
    "ranks": MISSPECIFIED_RANKS,
    "ranking": MISSPECIFIED_RANKING,
}
"""Columns of the tables of a study of a missing effect."""
_ROWS = 200
"""Rows of a table that a notebook shows."""


ExperimentSource: TypeAlias = Annotated[
    str | Path | Experiment,
    Expected("the name of an experiment, the path of its TOML file or an Experiment"),
]
"""What is compared."""
Tuners: TypeAlias = Annotated[
    Sequence[Name | type[Tuner]],
    Expected("names of tuners or subclasses of Tuner, as ['cma_es', 'random']"),
]
"""Who is compared."""
RecordingFile: TypeAlias = Annotated[
    str | Path, Expected("the path of NAME.csv, which results are traced to")
]
"""A recording that must be in a file."""


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
    progress: Progress | None = None,
    force: bool = False,
    pdf: bool = False,
) -> Compared:
    """Run an experiment: every tuner on every target with every seed.

    Args:
        experiment: the name of an experiment, the path of its TOML file, or an `Experiment`; None
            for a robot, which `model` and `free` describe.
        model: model file of a robot, MJCF or URDF.
        recording: path of a recording of that robot; without one, targets are simulated.
        free: numbers of the model file to tune, as ``damping@*`` or ``mass@forearm``.
        tuners: labels, registered names or classes of the tuners to run; all of the experiment's
            where None. A class is registered.
        targets: number of targets in each range.
        seeds: number of seeds for each tuner that uses random numbers.
        budget: number of simulations on one target.
        training_budget: number of simulations that a learned tuner may train on.
        timeout: time limit of a run in seconds.
        memory: memory limit of a run in MiB; 0 is no limit.
        jobs: number of worker processes. 0 runs everything in this process: output of ``print``
            appears, breakpoints work, and classes of a script or notebook can be used; tuners are
            trusted then.
        trust: run tuners inside the harness, where they could read the true parameters. This is
            faster, and the results are marked.
        isolation: ``run`` starts a fresh process for every run of a tuner, ``tuner`` one for all
            runs with the same seed; the experiment's own where None.
        salt: text from which targets are drawn. It is secret until the end; ``public`` draws the
            published targets; a fresh one where None.
        out: folder to write, new or empty; a new one below results/ where None.
        plugins: Python files with further tuners, simulators and effects.
        cluster: address of a Dask scheduler to run on.
        progress: called with a title and a number of steps; gives the function that is called after
            each step.
        force: start even if it needs more than this machine has.
        pdf: write every figure as PDF too, in addition to PNG.

    Returns:
        Tables and figures of the results.

    Raises:
        InputError: an argument, the experiment or a plugin cannot be used; nothing has been run
            then.
    """
    if experiment is None and not (model or recording or free):
        raise InputError(
            "compare: expected an experiment, as simgap.compare('ball-drop'), or a robot, as "
            "simgap.compare(model='robot.xml', free=['damping@*']); experiments are "
            f"{', '.join(names())}"
        )
    files = [str(Path(plugin).resolve()) for plugin in plugins]
    chosen = choose(
        given(wanted(experiment, model, recording, free), files, trust or not jobs, isolation),
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
    check_comparison(chosen, folder, jobs, cluster is not None, force)
    pool = _cluster(cluster)
    begun = study.begin(chosen, files, folder, jobs, salt)
    with pdf_figures(pdf):
        return _made(begun, jobs, progress, pool)


@check_arguments
def sweep(
    experiment: ExperimentSource,
    *,
    jobs: Natural = 2,
    trust: bool = False,
    salt: str | None = None,
    out: str | Path | None = None,
    plugins: Files = (),
    progress: Progress | None = None,
    force: bool = False,
    pdf: bool = False,
) -> list[Compared]:
    """Run every experiment that one with a ``[sweep]`` or ``experiments`` stands for, one by one.

    Args:
        experiment: its name, the path of its TOML file, or itself.
        jobs: as in `compare`.
        trust: as in `compare`.
        salt: as in `compare`; one for all that a sweep stands for, so that they meet the same
            targets.
        out: folder in which each gets its own, named as the experiment is.
        plugins: as in `compare`.
        progress: told of every step.
        force: as in `compare`.
        pdf: as in `compare`.

    Returns:
        Their results, in the order of the file's values.

    Raises:
        InputError: a fault in what was asked for, in one line; nothing has been run then.
    """
    files = [str(Path(plugin).resolve()) for plugin in plugins]
    chosen = choose(given(experiment, files, trust or not jobs))
    folder = None if out is None else Path(out)
    check_comparison(chosen, folder, jobs, force=force)
    begun = study.begin_all(chosen, files, folder, jobs, salt)
    with pdf_figures(pdf):
        made = [_made(one, jobs, progress, None) for one in begun]
        if len(begun) > 1:
            study.conclude(begun[0].folder.parent, _unsaid)
    return made


def wanted(
    experiment: str | Path | Experiment | None,
    model: str | Path | None = None,
    recording: str | Path | None = None,
    free: Sequence[str] = (),
) -> str | Path | Experiment:
    """The experiment that is named, or the one that a model file and a recording stand for.

    Raises:
        InputError: neither or both.
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
    return asked(model, recording, free)


def given(
    experiment: str | Path | Experiment,
    plugins: Sequence[str | Path],
    trust: bool,
    isolation: str | None = None,
) -> Experiment:
    """An experiment whose plugins are known to this process; see `compare`.

    Raises:
        InputError: no such experiment, or a plugin cannot be used.
    """
    whole = experiment if isinstance(experiment, Experiment) else load(str(experiment))
    whole = whole.chosen(trusted=whole.trusted or trust, isolation=isolation)
    admit([str(Path(plugin).resolve()) for plugin in plugins], whole)
    # Whatever is left to the robot's usual commands stands in the folder of results.
    return completed(whole)


def _cluster(address: str | None) -> Pool | None:
    if address is None:
        return None
    from bench.runs.cluster import ClusterPool

    return ClusterPool(address)


def _made(begun: study.Study, jobs: int, progress: Progress | None, pool: Pool | None) -> Compared:
    """The study, made and reported."""
    made = begun.make(jobs, progress, pool)
    if made.skipped:
        raise InputError(f"{begun.configuration.experiment.name}: skipped: {made.skipped}")
    begun.finish(_unsaid)
    if made.interrupted:
        # In a notebook the cell ends as the person wished; what was finished is in the folder.
        raise KeyboardInterrupt(f"what was finished is kept in {begun.folder}")
    return Compared(begun.folder)


def _unsaid(_line: str) -> None:
    """What the command prints; from Python the tables are at hand."""


def choose(
    experiment: str | Path | Experiment,
    labels: Sequence[str] | None = None,
    seeds: int | None = None,
    **changes: float | None,
) -> Experiment:
    """An experiment with changes.

    Args:
        experiment: its name, the path of its TOML file, or itself.
        labels: only these tuners, by label or registered name.
        seeds: of each tuner that uses chance.
        changes: other fields; None leaves one as it is.

    Raises:
        InputError: no such experiment or tuner.
    """
    whole = experiment if isinstance(experiment, Experiment) else load(str(experiment))
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
            raise unknown("tuner", label, sorted(known))
    return whole.with_tuners(labels)


def _choose_diagnosers(
    whole: Experiment, labels: Sequence[str] | None, changes: Mapping[str, float | None]
) -> Experiment:
    """A comparison of diagnosers with changes: its targets are questions."""
    sample = changes.get("targets")
    table = dict(whole.diagnosis)
    if sample is not None:
        table["sample"] = sample
    if labels is not None:
        for label in labels:
            if label not in diagnosers.names():
                raise unknown("diagnoser", label, diagnosers.names())
        table["diagnosers"] = list(labels)
    rest = {name: value for name, value in changes.items() if name != "targets"}
    return whole.chosen(diagnosis=table, **rest)


def _label(tuner: str | type[Tuner]) -> str:
    """The name under which a tuner runs; a class is registered."""
    if isinstance(tuner, str):
        return tuner
    if not (inspect.isclass(tuner) and issubclass(tuner, Tuner)):
        raise InputError(f"tuners: expected names and subclasses of Tuner, found {tuner!r:.80}")
    return registered.register(tuner).name


class Compared:
    """A comparison that has been made, read from its folder.

    Args:
        folder: of a comparison of tuners or of diagnosers, a bounce shot or a study of a missing
            effect, finished or not.

    Attributes:
        folder: where everything lies.
        experiment: what was asked for.

    Raises:
        InputError: the folder is not that of a comparison.
    """

    @check_arguments
    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.experiment: Experiment = study.opened(self.folder).configuration.experiment

    @cached_property
    def _stored(self) -> Stored:
        return read(self.folder)

    @cached_property
    def _labels(self) -> comparison.Labels:
        problem = Problem(self.experiment)
        try:
            return comparison.labels_of(problem)
        finally:
            problem.close()

    def _csv(self, name: str) -> pd.DataFrame:
        """A table of a bounce shot or of a study of two comparisons, as it was written."""
        remedy = f"simgap plot {self.folder} writes it again"
        path = self.folder / f"{name}.csv"
        columns = (_OF_SHOTS if self.experiment.shot else _OF_TWO)[name]
        table: pd.DataFrame = Csv(path, columns, remedy).table.to_pandas()
        return table

    @property
    def _in_files(self) -> bool:
        """Whether tables and figures are such as no comparison has."""
        asked = self.experiment
        return bool(asked.shot or asked.calibration or asked.diagnosis)

    @property
    def _what(self) -> str:
        """What such a folder is called."""
        if self.experiment.diagnosis:
            return "a comparison of diagnosers"
        return "a bounce shot" if self.experiment.shot else "a study of two comparisons"

    def _both(self, rows: Callable[[Stored], pd.DataFrame]) -> pd.DataFrame:
        """Rows of both comparisons of a study of two, the simulator's name in front."""
        import pandas as pd

        parts = []
        for model in MODELS:
            part = rows(read(self.folder / model)).copy()
            part.insert(0, "model", model)
            parts.append(part)
        return pd.concat(parts, ignore_index=True)

    @cached_property
    def tables(self) -> dict[str, pd.DataFrame]:
        """The tables by name: table, ert, ranking, pairs, break_even, who_wins; of a bounce shot
        table and shots (docs/results-films.md), of a study of a missing effect table, ranks and
        ranking (docs/misspecified.md), of a comparison of diagnosers table, failures, items and
        the others (docs/diagnosers.md).
        """
        if self.experiment.diagnosis:
            return {name: diagnosis.read_table(self.folder, name) for name in diagnosis.TABLES}
        if self.experiment.shot:
            return {name: self._csv(name) for name in ("table", "shots")}
        if self.experiment.calibration:
            return {name: self._csv(name) for name in _OF_TWO}
        return tables(self._stored)

    @property
    def table(self) -> pd.DataFrame:
        """Error after N simulations by tuner, range and metric, in long form, as table.csv; of
        diagnosers each share with its interval.
        """
        return self.tables["table"]

    @property
    def runs(self) -> pd.DataFrame:
        """A row for each simulation, as runs.parquet; of a bounce shot a row for each shot, of
        diagnosers for each answer.
        """
        if self.experiment.diagnosis:
            return self.tables["items"]
        if self.experiment.calibration:
            return self._both(lambda stored: stored.runs)
        return self.tables["shots"] if self.experiment.shot else self._stored.runs

    @property
    def statuses(self) -> pd.DataFrame:
        """A row for each run or answer, how it ended and why, as status.csv."""
        if self.experiment.diagnosis:
            return self.tables["items"][list(diagnosis.STATUS)]
        if self.experiment.calibration:
            return self._both(lambda stored: stored.statuses)
        return self._csv("status") if self.experiment.shot else self._stored.statuses

    @property
    def figures(self) -> list[str]:
        """Names of the figures that there are; those of a bounce shot, of a study of a missing
        effect and of diagnosers are files in its folder.
        """
        return [] if self._in_files else comparison.names(self._stored)

    def figure(self, name: str = "error", behind: str | Sequence[str] = ()) -> Figure:
        """One of the figures, made anew; a notebook shows it inline.

        Args:
            name: of the figure.
            behind: reference results, or folders of comparisons, in grey behind it, as
                ``ball-drop``; two at most.

        Raises:
            InputError: there is none of that name, or a reference cannot be drawn behind it.
        """
        if self._in_files:
            raise InputError(f"figures of {self._what} are files: {self.folder / 'figures'}")
        asked = [behind] if isinstance(behind, str) else behind
        references = [find(one) for one in asked]
        return comparison.figure(self._stored, self._labels, name, behind=references)

    def summary(self) -> pd.DataFrame:
        """Return the last error of each tuner in the order of the ranking, with its verdict and the
        number of failed runs; for diagnosers what each raises and names.
        """
        table = self.table
        if self.experiment.diagnosis:
            return diagnosis.board(table)
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
