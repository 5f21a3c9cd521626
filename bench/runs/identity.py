"""Names for runs: a readable id that changes with everything that determines a run, and with
nothing else.

``cma_es/wide-017/0/3f9ac2d15b`` is tuner, target and seed, and a hash of the tuner's options, the
simulator with its settings, the target's scenario and observation, budget, limits, code and package
versions.
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
"""Keys of an experiment that change no run by themselves, each with the reason; all others do."""


def fingerprint(experiment: Experiment, plugins: Sequence[str]) -> dict[str, str]:
    """Hashes of everything that must not change while an experiment is under way, by what a person
    would call it.
    """
    return {
        # A salt is secret until the end, and its commitment stands from the beginning.
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
    """Folders whose code makes its results, where there are more than those of a comparison."""
    if experiment.shot:
        return SHOT_ROOMS
    return EXPLAIN_ROOMS if experiment.calibration else ()


def _classes(experiment: Experiment) -> list[str]:
    """Sources of an experiment's simulator and tuners; a notebook's are in no plugin file."""
    sources = [source(kind_of(experiment))]
    for entry in experiment.tuners:
        try:
            sources.append(source(tuners.get(entry.tuner)))
        # It has no run that could be mixed with another kind; it shows once it can be used.
        except SkippedError:
            sources.append("skipped")
    return sources


def refuse_changes(folder: Path, before: dict[str, str], now: dict[str, str]) -> None:
    """Refuse to mix runs of two configurations.

    Raises:
        InputError: something changed since the folder was begun.
    """
    if not before:
        raise InputError(
            f"{folder}: written by an older simgap, which cannot be resumed; start a new comparison"
        )
    # The first that differs says most: what a person changed comes before what follows from it.
    for what, hashed in now.items():
        if before.get(what) != hashed:
            raise InputError(
                f"{folder}: its {what} changed since it was begun ({before.get(what)} then, "
                f"{hashed} now); runs of two kinds are not mixed: put it back as it was, or start "
                "a new comparison"
            )


def unchanged(folder: Path, held: Configuration, plugins: Sequence[str]) -> list[str]:
    """See that a study can be taken up where it was left; returns all the plugin files it needs.

    Args:
        folder: the study's.
        held: what it was begun with; these plugins are loaded.
        plugins: plugin files beside those; loaded too.

    Raises:
        InputError: something that matters changed since it was begun.
    """
    # The folder's own come first, in their order, as when it was begun.
    given = {str(Path(p).resolve()) for p in plugins}
    everything = held.plugins + sorted(given - set(held.plugins))
    admit(everything, held.experiment)
    refuse_changes(folder, held.fingerprint, fingerprint(held.experiment, everything))
    return everything


class Identities:
    """Ids of an experiment's runs."""

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
        """The id of one run."""
        # Hashed once: a plan may have a million runs.
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
    """Hash of a target's scenarios, observations and start."""
    sides = [target.fitting, target.held_out]
    scenarios = [
        [s.times.tobytes(), s.initial, {k: v.tobytes() for k, v in s.inputs.items()}, s.constants]
        for side in sides
        for s in side.scenarios
    ]
    return digest(scenarios, [side.observed.tobytes() for side in sides], target.start.tobytes())
