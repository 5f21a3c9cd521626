"""Find what experiments need and this machine lacks: data sets, model files, packages, tuners."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from bench.benchmark.problem.experiment_config import (
    Experiment,
    expand_sweep,
    list_experiment_names,
    load_experiment,
)
from bench.benchmark.problem.experiment_recording import find_recording
from bench.benchmark.problem.robot_experiment import find_model
from bench.core.plugin_registries import PartUnavailableError, simulators, tuners
from bench.datasets import public_datasets as datasets
from bench.datasets.public_datasets import DataSet
from sims.core.simulator import InputError
from sims.engines.engine_lookup import ENGINE_MODULES, missing_packages


@dataclass(frozen=True)
class Availability:
    """Missing requirements of an experiment.

    Attributes:
        data_set: missing data set that a command of the project downloads; None if none is missing.
        skipped: why the experiment cannot run here; empty if it can run, or if only the data set is
            missing.
        tuners: reason by label of each tuner that cannot run here and is left out.
    """

    data_set: DataSet | None
    skipped: str
    tuners: Mapping[str, str]


def availability(experiment: Experiment) -> Availability:
    """Find what is missing for an experiment, or for all experiments that it names.

    These can be a data set, a model file or a recording, a simulator, an engine, or packages of the
    tuners. A data set that is not yet downloaded may contain the missing files, so it is reported
    alone.
    """
    if experiment.experiments:
        return _combine_availability(experiment)
    data_set = _find_missing_data_set(experiment)
    # The first reason is reported; an empty one means that nothing of the kind is missing.
    reason = ""
    if data_set is None:
        reason = explain_missing_model_file(experiment) or _explain_missing_recording(experiment)
    reason = reason or _explain_missing_simulator(experiment) or _explain_missing_engine(experiment)
    return Availability(data_set, reason, _explain_missing_tuners(experiment))


def leave_out_missing_problems(suite: Experiment) -> tuple[Experiment, dict[str, str]]:
    """Leave out the problems of a suite that cannot run on this machine.

    Args:
        suite: experiment; one that is not a suite is returned unchanged.

    Returns:
        The suite without these problems, and the reason for each of them by name.

    Raises:
        InputError: no problem can run on this machine.
    """
    if not (suite.suite and suite.experiments):
        return suite, {}
    available_files, reasons = [], {}
    for file in suite.experiments:
        # The file of a problem may sweep over values, and then stands for several problems.
        for problem in expand_sweep(suite.chosen(experiments=(file,))):
            missing = availability(problem)
            if missing.data_set:
                reasons[problem.name] = missing.data_set.advice
            elif missing.skipped:
                reasons[problem.name] = missing.skipped
            elif file not in available_files:
                available_files.append(file)
    if not available_files:
        missing_text = "; ".join(f"{name} {reason}" for name, reason in reasons.items())
        raise InputError(f"{suite.suite}: no problem can run here: {missing_text}")
    return suite.chosen(experiments=tuple(available_files)), reasons


def list_dependent_experiments(data_set: DataSet) -> list[str]:
    """Return the names of the project's experiments that need a data set."""
    names = []
    for name in list_experiment_names():
        experiment = load_experiment(name)
        paths = [("robot", experiment.model)]
        if experiment.recording:
            paths.append(("recording", experiment.recording.path))
        if data_set in [datasets.find_providing_data_set(*path) for path in paths]:
            names.append(name)
    return names


def _combine_availability(experiment: Experiment) -> Availability:
    """Combine what is missing for the experiments that this one names.

    Only the first missing data set is reported; the others follow when it has been downloaded.
    A suite, a versioned set of problems, leaves out the problems that cannot run, see
    `leave_out_missing_problems`: something is missing for it only if no problem can run.

    Args:
        experiment: Experiment or suite that names other experiments.

    Returns:
        The first missing data set, the reasons of all experiments that cannot run, in one text, and
        the reasons of tuners that cannot run.
    """
    missing_by_name = {part.name: availability(part) for part in expand_sweep(experiment)}
    runnable = {
        name: missing
        for name, missing in missing_by_name.items()
        if not (missing.data_set or missing.skipped)
    }
    if experiment.suite and runnable:
        missing_by_name = runnable
    data_sets = [missing.data_set for missing in missing_by_name.values() if missing.data_set]
    skipped = [
        f"{name} {missing.skipped}" for name, missing in missing_by_name.items() if missing.skipped
    ]
    missing_tuners = {
        label: reason
        for missing in missing_by_name.values()
        for label, reason in missing.tuners.items()
    }
    return Availability(next(iter(data_sets), None), "; ".join(skipped), missing_tuners)


def _find_missing_data_set(experiment: Experiment) -> DataSet | None:
    """Return the data set that an experiment needs and that is missing here.

    Args:
        experiment: Experiment that may name a model file and a recording.

    Returns:
        The first data set of the catalogue that has a missing file; None if all files exist.
    """
    required_files = [("robot", experiment.model)] if experiment.model else []
    if experiment.recording:
        required_files.append(("recording", experiment.recording.path))
    for kind, path in required_files:
        data_set = datasets.find_providing_data_set(kind, path)
        if data_set and datasets.find(kind, path) is None:
            return data_set
    return None


def explain_missing_model_file(experiment: Experiment) -> str:
    """Return why an experiment's model file is missing; empty if it exists or is not needed."""
    if not experiment.model:
        return ""
    try:
        find_model(experiment.model, experiment.name)
    except PartUnavailableError as error:
        return error.reason
    return ""


def _explain_missing_recording(experiment: Experiment) -> str:
    """Return why the recording of an experiment cannot be read here; empty if it can."""
    if not experiment.recording:
        return ""
    try:
        find_recording(experiment.recording.path)
    except InputError as error:
        return str(error)
    return ""


def _explain_missing_simulator(experiment: Experiment) -> str:
    """Return why the experiment's registered simulator cannot be used here.

    The text is empty if it can be used, or if the simulator is not a registered one: a robot's
    model file is checked elsewhere, and an unknown name is an error of the file.
    """
    if experiment.model or experiment.simulator not in simulators.names():
        return ""
    try:
        simulators.get(experiment.simulator)
    except PartUnavailableError as error:
        return error.reason
    return ""


def _explain_missing_engine(experiment: Experiment) -> str:
    """Return why an engine of an experiment cannot be used here; empty if all can.

    The engines are those of the tuned simulator and of the simulator that makes the targets.
    """
    settings = [experiment.settings, *([experiment.world] if experiment.world else [])]
    engines = [str(each.get("engine") or _get_default_engine(experiment)) for each in settings]
    packages = sorted(
        {
            package
            for name in engines
            if name in ENGINE_MODULES
            for package in missing_packages(name)
        }
    )
    if not packages:
        return ""
    return f"needs {', '.join(packages)}, not installed (pip install {' '.join(packages)})"


def _get_default_engine(experiment: Experiment) -> str:
    """Return the engine that an experiment uses if it names none.

    It is empty if the simulator is not known, or has no engine.
    """
    if experiment.model:
        return "mujoco"
    if experiment.simulator not in simulators.names():
        return ""
    return str(getattr(simulators.get(experiment.simulator), "default_engine", ""))


def _explain_missing_tuners(experiment: Experiment) -> Mapping[str, str]:
    """Return the reason by label for each tuner of an experiment that cannot run here."""
    reasons = {}
    for entry in experiment.tuners:
        try:
            tuners.get(entry.tuner)
        except PartUnavailableError as error:
            reasons[entry.label] = error.reason
    return reasons
