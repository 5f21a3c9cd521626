"""`simgap.compare`: a comparison from Python, and its results as tables and figures."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from bench.problem.experiment import Experiment, load
from bench.registry import load_plugins
from bench.registry import tuners as registered
from bench.store.folder import Stored, configuration, read
from bench.study import begin
from methods.base import Tuner
from sims.base import InputError, unknown

if TYPE_CHECKING:
    import pandas as pd


def compare(
    experiment: str | Path | Experiment,
    *,
    tuners: Sequence[str | type[Tuner]] | None = None,
    targets: int | None = None,
    seeds: int | None = None,
    budget: int | None = None,
    training_budget: int | None = None,
    timeout: float | None = None,
    memory: int | None = None,
    jobs: int = 2,
    out: str | Path | None = None,
    plugins: Sequence[str | Path] = (),
) -> Compared:
    """Run an experiment: tuners x targets x seeds; returns its tables and figures.

    Args:
        experiment: its name, the path of its TOML file, or itself.
        tuners: only these: labels, registered names, and classes, which are registered.
        targets: in each range.
        seeds: of each tuner that uses chance.
        budget: simulations on one target.
        training_budget: simulations that a learned tuner may learn from.
        timeout: seconds that a run may take.
        memory: MiB that a run may take; 0 is no limit.
        jobs: worker processes; 0 runs everything in this process, where prints show and
            breakpoints hold.
        out: folder to write, a new one; below results/ where None.
        plugins: Python files with more tuners, simulators and effects.

    Raises:
        InputError: a fault in what was asked for, in one line.
    """
    files = [str(Path(plugin).resolve()) for plugin in plugins]
    load_plugins(files)
    labels = None if tuners is None else [_label(tuner) for tuner in tuners]
    chosen = choose(
        experiment,
        labels,
        seeds,
        targets=targets,
        budget=budget,
        training_budget=training_budget,
        timeout=timeout,
        memory=memory,
    )
    study = begin(chosen, files, None if out is None else Path(out), jobs)
    study.make(jobs)
    study.finish(lambda _: None)
    return Compared(study.folder)


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


def _label(tuner: str | type[Tuner]) -> str:
    """The name under which a tuner runs; a class is registered."""
    if isinstance(tuner, str):
        return tuner
    if not (inspect.isclass(tuner) and issubclass(tuner, Tuner)):
        raise InputError(f"tuners: expected names and subclasses of Tuner, found {tuner!r:.80}")
    return registered.register(tuner).name


class Compared:
    """A comparison that has been made, read from its folder.

    Attributes:
        folder: where everything lies.

    Raises:
        InputError: the folder is not that of a comparison.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.experiment = configuration(self.folder).experiment

    @cached_property
    def _stored(self) -> Stored:
        return read(self.folder)

    @property
    def table(self) -> pd.DataFrame:
        """Error after N simulations by tuner, range and metric, in long form: table.csv."""
        import pandas as pd

        return pd.read_csv(self.folder / "table.csv")

    @property
    def runs(self) -> pd.DataFrame:
        """A row for each simulation: runs.parquet."""
        return self._stored.runs

    @property
    def statuses(self) -> pd.DataFrame:
        """A row for each run, how it ended and why: status.csv."""
        return self._stored.statuses

    def __repr__(self) -> str:
        runs = len(self.statuses)
        return f"<Compared {self.experiment.name}: {runs} runs in {self.folder}>"
