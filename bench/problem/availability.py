"""What an experiment needs and this machine lacks: a data set, packages, tuners."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from bench.datasets import catalogue as datasets
from bench.datasets.catalogue import DataSet
from bench.problem.experiment import Experiment
from bench.problem.robots import missing
from bench.registry import SkippedError, simulators, tuners
from sims.engines import NAMES, missing_packages


@dataclass(frozen=True)
class Availability:
    """What is missing for an experiment.

    Attributes:
        data_set: that a command of the project downloads.
        skipped: why the experiment cannot run here; empty where it can, or where it only lacks the
            data set.
        tuners: reason by label of each tuner that is left out, as it cannot run here.
    """

    data_set: DataSet | None
    skipped: str
    tuners: Mapping[str, str]


def availability(experiment: Experiment) -> Availability:
    """Find what is missing for an experiment, without loading simulators or tuners that are
    here.
    """
    data_set = _missing_data_set(experiment)
    skipped = "" if data_set else missing(experiment)
    return Availability(
        data_set, skipped or _missing_engine(experiment), dict(_missing_tuners(experiment))
    )


def _missing_data_set(experiment: Experiment) -> DataSet | None:
    """The data set that an experiment needs and that is not here."""
    wanted = [("robot", experiment.model)] if experiment.model else []
    if experiment.recording:
        wanted.append(("recording", experiment.recording.path))
    for kind, path in wanted:
        found = datasets.providing(kind, path)
        if found and datasets.find(kind, path) is None:
            return found
    return None


def _missing_engine(experiment: Experiment) -> str:
    """Why an engine of an experiment, that of the tuned simulator or of the world which makes the
    targets, cannot be used here; empty where all can.
    """
    settings = [experiment.settings, experiment.world]
    engines = [str(each["engine"]) for each in settings if "engine" in each]
    if "engine" not in experiment.settings:
        engines.append(_default_engine(experiment))
    packages = sorted(
        {package for name in engines if name in NAMES for package in missing_packages(name)}
    )
    if not packages:
        return ""
    return f"needs {', '.join(packages)}, not installed (pip install {' '.join(packages)})"


def _default_engine(experiment: Experiment) -> str:
    """The engine of an experiment that names none."""
    if experiment.model:
        return "mujoco"
    if not experiment.simulator or experiment.simulator not in simulators.names():
        return ""
    try:
        return str(getattr(simulators.get(experiment.simulator), "default_engine", ""))
    except SkippedError:
        return ""


def _missing_tuners(experiment: Experiment) -> Mapping[str, str]:
    """Reason by label of each tuner of an experiment that cannot run here."""
    reasons = {}
    for entry in experiment.tuners:
        try:
            tuners.get(entry.tuner)
        except SkippedError as error:
            reasons[entry.label] = error.reason
    return reasons
