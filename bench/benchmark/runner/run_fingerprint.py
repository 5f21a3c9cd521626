"""Fingerprint of an experiment and IDs of its runs, which change with all that determines them.

``cma_es/wide-017/0/3f9ac2d15b`` consists of tuner, target, seed and a hash. The hash covers the
tuner's options, the simulator with its settings, the target's scenario and observation, budget,
limits, code and package versions.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bench.benchmark.problem.experiment import Experiment, TunerEntry
from bench.benchmark.problem.robot_experiment import get_simulator_class
from bench.benchmark.problem.targets import BlindedTarget
from bench.benchmark.runner.code_digest import (
    BOUNCE_SHOT_SOURCE_FOLDERS,
    DIAGNOSIS_SOURCE_FOLDERS,
    EXPLAIN_SOURCE_FOLDERS,
    IRRELEVANT_KEYS,
    compute_digest,
    hash_class_source,
    hash_effect_sources,
    hash_package_versions,
    hash_plugin_files,
    hash_recording,
    hash_source_folders,
    select_relevant_keys,
)
from bench.benchmark.runner.plugin_discovery import (
    list_compared_parts,
    load_plugins_for_experiment,
)
from bench.benchmark.storage.result_folder import FolderConfiguration
from bench.core.plugin_registries import PartUnavailableError, tuners
from sims.core.simulator import InputError

RUN_IRRELEVANT_KEYS = {
    **IRRELEVANT_KEYS,
    "resolution": "rounds observations, which are hashed with the target",
    "ranges": "selects targets; each run's id covers its own target",
    "targets": "number of targets; each run's id covers its own target",
    "same_targets_as": "selects targets; their scenarios and observations are hashed",
    "held_out": "scenarios and observations of the held-out side are hashed with the target",
    "seeds": "number of seeds; each run's id covers its own seed",
    "budget": "each run's id covers its own budget, which the tuner's entry may change",
    "training_budget": "affects learned tuners only, and is hashed with their entries",
    "salt": "selects targets; their scenarios and observations are hashed",
    "salt_sha256": "selects targets; their scenarios and observations are hashed",
    "tuners": "each run's id covers its own tuner with its options",
}
"""Keys of an experiment that do not change any run by themselves, each with the reason."""


def compute_fingerprint(experiment: Experiment, plugins: Sequence[str]) -> dict[str, str]:
    """Hash everything that must not change while an experiment is running.

    The hashes are stored with the study. When it is resumed, they are computed again, and a
    difference is reported by its name.

    Args:
        experiment: configuration of the experiment.
        plugins: paths of the plugin files that it needs.

    Returns:
        Hashes by readable name.
    """
    # The salt is secret until the end, and then revealed in the configuration. It is blanked here,
    # so that this does not change the hash. `salt_sha256`, the commitment to the salt, is part of
    # the configuration from the beginning.
    public = experiment.chosen(salt="") if experiment.salt_sha256 else experiment
    compared_parts = "diagnosers" if experiment.diagnosis else "simulator and tuners"
    model_hash = {}
    if experiment.model:
        model_source = hash_class_source(get_simulator_class(experiment))
        model_hash = {"model file": compute_digest(model_source)}
    return {
        "configuration": compute_digest(experiment.name, public.document()),
        "recording": compute_digest(hash_recording(experiment)),
        **model_hash,
        "plugins": hash_plugin_files(plugins),
        "code": hash_source_folders(_get_source_folders(experiment)),
        "package versions": hash_package_versions(),
        compared_parts: compute_digest(_hash_class_sources(experiment)),
    }


def _get_source_folders(experiment: Experiment) -> tuple[str, ...]:
    """Return the source folders that determine the results of an experiment.

    The result is empty for an ordinary comparison of tuners, whose folders are the default of
    `hash_source_folders`.
    """
    if experiment.shot:
        return BOUNCE_SHOT_SOURCE_FOLDERS
    if experiment.diagnosis:
        return DIAGNOSIS_SOURCE_FOLDERS
    return EXPLAIN_SOURCE_FOLDERS if experiment.calibration else ()


def _hash_class_sources(experiment: Experiment) -> list[str]:
    """Hash the sources of the simulator and the tuners or diagnosers, one hash each.

    This covers classes that a notebook defines, which are in no plugin file.
    """
    sources = []
    if not experiment.diagnosis:
        sources.append(hash_class_source(get_simulator_class(experiment)))
    for registry, name in list_compared_parts(experiment):
        try:
            sources.append(hash_class_source(registry.get(name)))
        # A skipped part has no runs yet; its hash changes when it becomes available.
        except PartUnavailableError:
            sources.append("skipped")
    return sources


def check_unchanged(folder: Path, initial: dict[str, str], present: dict[str, str]) -> None:
    """Raise an error if the configuration of a study has changed.

    Args:
        folder: folder of the study.
        initial: hashes by readable name when the study was started; empty if they are unknown.
        present: present hashes, from `compute_fingerprint`.

    Raises:
        InputError: something has changed since the study was started.
    """
    if not initial:
        raise InputError(
            f"{folder}: written by an older simgap, which cannot be resumed; start a new comparison"
        )
    # The first difference is reported: direct changes are listed before their consequences.
    for hash_name, hashed in present.items():
        if initial.get(hash_name) != hashed:
            raise InputError(
                f"{folder}: its {hash_name} changed since it was started ({initial.get(hash_name)} "
                f"then, {hashed} now); all runs need the same configuration: restore it, or start "
                "a new comparison"
            )


def check_resumable(
    folder: Path, configuration: FolderConfiguration, plugins: Sequence[str]
) -> list[str]:
    """Check that a study can be resumed, and load its plugins.

    Args:
        folder: folder of the study.
        configuration: configuration with which the study was started.
        plugins: additional plugin files.

    Returns:
        All plugin files that the study needs.

    Raises:
        InputError: something relevant has changed since the study was started.
    """
    # The study's own plugins come first and in their order, as when it was started.
    added_paths = {str(Path(p).resolve()) for p in plugins}
    all_plugins = configuration.plugins + sorted(added_paths - set(configuration.plugins))
    load_plugins_for_experiment(all_plugins, configuration.experiment)
    check_unchanged(
        folder,
        configuration.fingerprint,
        compute_fingerprint(configuration.experiment, all_plugins),
    )
    return all_plugins


class RunIds:
    """Identifiers of an experiment's runs."""

    def __init__(self, experiment: Experiment) -> None:
        """Hash what all runs of the experiment share: configuration, simulator and code.

        Tuners and targets are hashed when they are first used. `_entry_digests` and
        `_target_digests` cache these hashes by label of the tuner and by name of the target.
        """
        self._experiment = experiment
        self._common_digest = compute_digest(
            select_relevant_keys(experiment, RUN_IRRELEVANT_KEYS),
            hash_recording(experiment),
            hash_class_source(get_simulator_class(experiment)),
            hash_effect_sources(experiment.settings, experiment.world),
            hash_source_folders(),
            hash_package_versions(),
        )
        self._entry_digests: dict[str, str] = {}
        self._target_digests: dict[str, str] = {}

    def make_run_id(self, entry: TunerEntry, target: BlindedTarget, seed: int, budget: int) -> str:
        """Return the identifier of one run: ``TUNER/TARGET/SEED/HASH``.

        The hash covers all that determines the run, so that an id never stands for two different
        runs.

        Args:
            entry: entry of the tuner.
            target: target of the run.
            seed: seed of the tuner.
            budget: number of simulations.
        """
        # Hashes are cached, because a plan may have a million runs.
        if entry.label not in self._entry_digests:
            tuner_class = tuners.get(entry.tuner)
            training_budget = self._experiment.training_budget if tuner_class.learned else 0
            # The random effects of the training matter only for an entry that trains with them.
            nuisance = [dict(self._experiment.nuisance)] if entry.randomised else []
            self._entry_digests[entry.label] = compute_digest(
                entry.tuner,
                dict(entry.options),
                training_budget,
                hash_class_source(tuner_class),
                *nuisance,
            )
        if target.name not in self._target_digests:
            self._target_digests[target.name] = _hash_target(target)
        digest = compute_digest(
            self._common_digest,
            self._entry_digests[entry.label],
            self._target_digests[target.name],
            seed,
            budget,
        )
        return f"{entry.label}/{target.name}/{seed}/{digest}"


def _hash_target(target: BlindedTarget) -> str:
    """Hash a target's scenarios, observations and start.

    Args:
        target: Target as tuners see it, without its true parameters.

    Returns:
        Digest of scenarios and observations of the fitting and held-out runs, and of the start.
    """
    run_sets = [target.fitting, target.held_out]
    scenarios = [
        [s.times.tobytes(), s.initial, {k: v.tobytes() for k, v in s.inputs.items()}, s.constants]
        for run_set in run_sets
        for s in run_set.scenarios
    ]
    return compute_digest(
        scenarios, [run_set.observed.tobytes() for run_set in run_sets], target.start.tobytes()
    )
