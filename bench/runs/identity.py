"""Run identifiers that change with everything that determines a run, and with nothing else.

``cma_es/wide-017/0/3f9ac2d15b`` consists of tuner, target, seed and a hash. The hash covers the
tuner's options, the simulator with its settings, the target's scenario and observation, budget,
limits, code and package versions.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bench.problem.experiment import Entry, Experiment
from bench.problem.robots import kind_of
from bench.problem.targets import SealedTarget
from bench.registry import SkippedError, tuners
from bench.runs.sources import (
    EXPLAIN_ROOMS,
    SHOT_ROOMS,
    digest,
    effect_sources,
    plugin_files,
    recording_digest,
    rooms,
    source,
    versions,
    what_matters,
)
from bench.runs.survey import admit
from bench.store.folder import Configuration
from sims.base import InputError

NOT_OF_A_RUN = {
    "title": "words",
    "says": "words",
    "tags": "words",
    "ranges": "which targets there are; each run's id has its own",
    "targets": "how many there are",
    "same_targets_as": "which targets there are; their scenarios and observations are hashed",
    "held_out": "scenarios and observations of the held-out side are hashed with the target",
    "seeds": "how many there are; each run's id has its own",
    "budget": "each run's id has its own, which the tuner's entry may change",
    "training_budget": "matters to learned tuners alone, and is hashed with their entries",
    "negligible_error": "ranks tuners when all runs are made",
    "identifiability": "is found beside the runs, which know nothing of it",
    "recording": "where it lies; what it holds is hashed",
    "model": "where it lies; what it holds is hashed",
    "calibration": "what it comes to is in the settings of what is tuned",
    "shot": "what is done with a tuned model afterwards",
    "diagnosis": "who diagnoses what, where nothing is tuned",
    "salt": "which targets there are; their scenarios and observations are hashed",
    "salt_sha256": "which targets there are; their scenarios and observations are hashed",
    "sweep": "what is run sweeps over nothing; it has values of its own",
    "experiments": "what is run names no others",
    "nuisance": "matters to entries that are randomised alone, and is hashed with them",
    "tuners": "who else runs; each run's id has its own tuner with its options",
}
"""Keys of an experiment that do not change any run by themselves, each with the reason."""


def fingerprint(experiment: Experiment, plugins: Sequence[str]) -> dict[str, str]:
    """Hash everything that must not change while an experiment is running.

    Args:
        experiment: configuration of the experiment.
        plugins: plugin files.

    Returns:
        Hashes by readable name.
    """
    return {
        # The salt is secret until the end, but its commitment exists from the beginning.
        "configuration": digest(experiment.name, experiment.chosen(salt="").document())
        if experiment.salt_sha256
        else digest(experiment.name, experiment.document()),
        "recording": digest(recording_digest(experiment)),
        **({"model file": digest(source(kind_of(experiment)))} if experiment.model else {}),
        "plugins": plugin_files(plugins),
        "code": rooms(_rooms(experiment)),
        "package versions": versions(),
        "simulator and tuners": digest(_classes(experiment)),
    }


def _rooms(experiment: Experiment) -> tuple[str, ...]:
    """Return the source folders that determine the results, if more than those of a comparison."""
    if experiment.shot:
        return SHOT_ROOMS
    return EXPLAIN_ROOMS if experiment.calibration else ()


def _classes(experiment: Experiment) -> list[str]:
    """Hash the sources of simulator and tuners; classes of a notebook are in no plugin file."""
    sources = [source(kind_of(experiment))]
    for entry in experiment.tuners:
        try:
            sources.append(source(tuners.get(entry.tuner)))
        # A skipped tuner has no runs yet; its hash changes when it becomes available.
        except SkippedError:
            sources.append("skipped")
    return sources


def refuse_changes(folder: Path, before: dict[str, str], now: dict[str, str]) -> None:
    """Raise an error if the configuration of a study has changed.

    Args:
        folder: folder of the study.
        before: fingerprint when the study was started.
        now: present fingerprint.

    Raises:
        InputError: something has changed since the study was started.
    """
    if not before:
        raise InputError(
            f"{folder}: written by an older simgap, which cannot be resumed; start a new comparison"
        )
    # The first difference is reported: direct changes are listed before their consequences.
    for what, hashed in now.items():
        if before.get(what) != hashed:
            raise InputError(
                f"{folder}: its {what} changed since it was begun ({before.get(what)} then, "
                f"{hashed} now); runs of two kinds are not mixed: put it back as it was, or start "
                "a new comparison"
            )


def unchanged(folder: Path, held: Configuration, plugins: Sequence[str]) -> list[str]:
    """Check that a study can be resumed, and load its plugins.

    Args:
        folder: folder of the study.
        held: configuration with which the study was started.
        plugins: additional plugin files.

    Returns:
        All plugin files that the study needs.

    Raises:
        InputError: something relevant has changed since the study was started.
    """
    # The study's own plugins come first and in their order, as when it was started.
    given = {str(Path(p).resolve()) for p in plugins}
    everything = held.plugins + sorted(given - set(held.plugins))
    admit(everything, held.experiment)
    refuse_changes(folder, held.fingerprint, fingerprint(held.experiment, everything))
    return everything


class Identities:
    """Identifiers of an experiment's runs."""

    def __init__(self, experiment: Experiment) -> None:
        self._experiment = experiment
        self._world = digest(
            what_matters(experiment, NOT_OF_A_RUN),
            recording_digest(experiment),
            source(kind_of(experiment)),
            effect_sources(experiment.settings, experiment.world),
            rooms(),
            versions(),
        )
        self._entries: dict[str, str] = {}
        self._targets: dict[str, str] = {}

    def run(self, entry: Entry, target: SealedTarget, seed: int, budget: int) -> str:
        """Return the identifier of one run.

        Args:
            entry: entry of the tuner.
            target: target of the run.
            seed: seed of the tuner.
            budget: number of simulations.
        """
        # Hashes are cached, because a plan may have a million runs.
        if entry.label not in self._entries:
            kind = tuners.get(entry.tuner)
            training = self._experiment.training_budget if kind.learned else 0
            over = [dict(self._experiment.nuisance)] if entry.randomised else []
            self._entries[entry.label] = digest(
                entry.tuner, dict(entry.options), training, source(kind), *over
            )
        if target.name not in self._targets:
            self._targets[target.name] = _target(target)
        what = digest(
            self._world, self._entries[entry.label], self._targets[target.name], seed, budget
        )
        return f"{entry.label}/{target.name}/{seed}/{what}"


def _target(target: SealedTarget) -> str:
    """Hash a target's scenarios, observations and start."""
    sides = [target.fitting, target.held_out]
    scenarios = [
        [s.times.tobytes(), s.initial, {k: v.tobytes() for k, v in s.inputs.items()}, s.constants]
        for side in sides
        for s in side.scenarios
    ]
    return digest(scenarios, [side.observed.tobytes() for side in sides], target.start.tobytes())
