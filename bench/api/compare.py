"""Python API: `simgap.compare` and `simgap.sweep`, with results as tables and figures."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

from bench.api.comparison_options import (
    ComparisonOptions,
    StudyOptions,
    apply_changes,
    get_tuner_label,
)
from bench.api.comparison_result import ComparisonResult
from bench.benchmark.problem.experiment_config import (
    Experiment,
    list_experiment_names,
    load_experiment,
)
from bench.benchmark.problem.missing_requirements import leave_out_missing_problems
from bench.benchmark.problem.robot_experiment import (
    complete_robot_experiment,
    make_robot_experiment,
)
from bench.benchmark.runner.comparison_resources import check_comparison_size
from bench.benchmark.runner.dask_cluster import ClusterPool
from bench.benchmark.runner.plugin_inspection import load_plugins_for_experiment
from bench.core.option_dataclasses import with_options
from bench.diagnosis_benchmark.diagnosers import language_model
from bench.figures.figure_settings import pdf_figures
from bench.studies import study_kinds
from sims.core.argument_checks import Expected
from sims.core.simulator import InputError

if TYPE_CHECKING:
    from bench.benchmark.runner.study_base import Study
    from bench.benchmark.storage.run_status import StudyOutcome

_EXPERIMENT_OPTIONS = ("targets", "budget", "training_budget", "timeout", "memory")
"""Options that change the key of the same name in an experiment."""
DEFAULTS = ComparisonOptions()


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
            study_kinds.report_jointly(studies[0].folder.parent, _discard_line)
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

    Returns:
        The experiment with all changes; it may still sweep over values or name others.

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
    # An option that was not given is None, and changes nothing.
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

    There are several if the experiment sweeps over values or names other experiments.

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
    return study_kinds.begin_studies(experiment, files, folder, jobs, options.salt)


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
