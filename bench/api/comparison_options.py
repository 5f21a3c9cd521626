"""Options of `simgap compare` and `simgap.sweep`, and the experiment that they change."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

from bench.core.option_dataclasses import option
from methods.tuner import Tuner
from sims.core.argument_checks import Count, Expected, Files, Name, Names, Natural, Seconds
from sims.core.simulator import InputError, make_unknown_name_error

if TYPE_CHECKING:
    from bench.benchmark.problem.experiment_config import Experiment

Tuners: TypeAlias = Annotated[
    Sequence[Name | type[Tuner]],
    Expected("names of tuners or subclasses of Tuner, as ['cma_es', 'random']"),
]
"""The tuners to compare."""
RecordingFile: TypeAlias = Annotated[
    str | Path, Expected("the path of NAME.csv, which results are traced to")
]
"""A recording that must be a file."""


@dataclass(frozen=True, kw_only=True)
class StudyOptions:
    """Options of a comparison or of a sweep of comparisons.

    Attributes:
        jobs: Number of worker processes; 0 runs everything in this process without isolation, for
            print, breakpoints and classes of a notebook.
        trust: Run the tuners without isolation: faster, but they could read the true parameters,
            and the results are marked.
        salt: Text from which the targets are drawn, secret until the end; `public` draws the
            published targets (default: a new one).
        out: New or empty folder; a sweep writes one in it for each experiment (default: a new one
            below results/).
        plugins: Plugin file with further tuners, simulators, effects or diagnosers.
        progress: Function that is called with a title and a number of steps; it returns the
            function that is called after each step.
        force: Start even if this machine has too little memory, disk or time, or if the data are
            implausible.
        pdf: Write every figure as PDF too (default: PNG only).
    """

    jobs: Natural = 2
    trust: bool = False
    salt: str | None = option(None, "TEXT", flags=("--salt", "--secret"))
    out: str | Path | None = option(None, "DIR")
    plugins: Files = option((), flags=("--plugin",))
    progress: Callable[[str, int], Callable[[], None]] | None = None
    force: bool = False
    pdf: bool = False


@dataclass(frozen=True, kw_only=True)
class ComparisonOptions(StudyOptions):
    """Options of a comparison.

    Attributes:
        model: Model file of a robot to tune instead of an experiment, MJCF or URDF.
        recording: Recording of that robot to tune it to (default: simulated targets).
        free: Numbers of the model file to tune, as damping@* or mass@forearm.
        tuners: Tuners to run, by label or registered name, or in Python as classes; for a
            comparison of diagnosers their names (default: all of the experiment).
        targets: Number of targets in each range; for diagnosers, number of cases drawn at random.
        seeds: Number of seeds for each tuner that uses random numbers.
        budget: Number of simulations on one target.
        training_budget: Number of simulations that a learned tuner may train on.
        timeout: Time limit of a run in seconds.
        memory: Memory limit of a run in MiB; 0 is no limit.
        isolation: `run` starts a new process for every run of a tuner, `tuner` one for all runs
            with the same seed (default: run).
        cluster: Address of a Dask scheduler to run on.
        model_command: Command of a language model to compare with other diagnosers; it reads a
            prompt, prints JSON as in verdict.json, and runs without isolation.
    """

    model: str | Path | None = None
    recording: RecordingFile | None = option(None, "FILE.csv")
    free: Names = ()
    tuners: Tuners | None = option(None, flags=("--tuners", "--diagnosers"))
    targets: Count | None = None
    seeds: Count | None = None
    budget: Count | None = None
    training_budget: Count | None = None
    timeout: Seconds | None = None
    memory: Natural | None = option(None, "MIB")
    isolation: Name | None = option(None, "ISOLATION", choices=("run", "tuner"))
    cluster: str | None = option(None, "ADDRESS")
    model_command: str | None = option(None, "COMMAND", flags=("--model-command", "--command"))


def apply_changes(
    experiment: Experiment,
    labels: Sequence[str] | None,
    seeds: int | None,
    changes: Mapping[str, float | None],
) -> Experiment:
    """Apply changes to an experiment; None leaves a field unchanged.

    Args:
        experiment: configuration of the experiment.
        labels: tuners or diagnosers to compare, by label of the experiment or registered name.
        seeds: number of seeds of each tuner; unused for diagnosers, which have none.
        changes: numbers of the experiment by name.

    Raises:
        InputError: A tuner or diagnoser does not exist.
    """
    from bench.core.plugin_registries import tuners as registered

    if experiment.diagnosis:
        return _choose_diagnosers(experiment, labels, changes)
    experiment = experiment.chosen(**changes)
    if seeds:
        experiment = experiment.with_seeds(seeds)
    if labels is None:
        return experiment
    known_labels = {*registered.names(), *(entry.label for entry in experiment.tuners)}
    for label in labels:
        if label not in known_labels:
            raise make_unknown_name_error("tuner", label, sorted(known_labels))
    return experiment.with_tuners(labels)


def _choose_diagnosers(
    experiment: Experiment, labels: Sequence[str] | None, changes: Mapping[str, float | None]
) -> Experiment:
    """Apply changes to a comparison of diagnosers, whose targets are benchmark cases.

    Args:
        experiment: configuration of the comparison.
        labels: diagnosers to compare; None for all.
        changes: numbers of the experiment by name; ``targets`` is the number of cases.
    """
    from bench.core.plugin_registries import diagnosers

    sample = changes.get("targets")
    table = dict(experiment.diagnosis)
    if sample is not None:
        table["sample"] = sample
    if labels is not None:
        for label in labels:
            if label not in diagnosers.names():
                raise make_unknown_name_error("diagnoser", label, diagnosers.names())
        table["diagnosers"] = list(labels)
    other_changes = {name: value for name, value in changes.items() if name != "targets"}
    return experiment.chosen(diagnosis=table, **other_changes)


def get_tuner_label(tuner: str | type[Tuner]) -> str:
    """Return the name under which a tuner runs; a class is registered under its name first.

    Raises:
        InputError: it is neither a name nor a subclass of Tuner.
    """
    from bench.core.plugin_registries import tuners as registered

    if isinstance(tuner, str):
        return tuner
    if not (inspect.isclass(tuner) and issubclass(tuner, Tuner)):
        raise InputError(f"tuners: expected names and subclasses of Tuner, found {tuner!r:.80}")
    return registered.register(tuner).name
