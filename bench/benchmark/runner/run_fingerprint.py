"""Fingerprint of an experiment and ids of its runs: hashes of everything that determines a run.

* `compute_fingerprint` hashes what must not change while a study is running.
* `RunIds` makes the id of each run. ``cma_es/wide-017/0/3f9ac2d15b`` consists of tuner, target,
  seed and a hash, which covers the tuner's options, the simulator with its settings, the target's
  scenario and observation, budget, limits, code and package versions.
* The other functions hash one thing each: source folders, classes, effects, plugin files, the
  recording and the versions of packages. The name of a file of trained weights contains these
  hashes too.

If something that determines a run were missing here, one run or one set of weights could be
mistaken for another. Therefore whole source folders are hashed, and a class whose source cannot be
found is refused.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import linecache
import platform
import sys
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, entry_points, version
from pathlib import Path
from typing import Any

from bench import __version__
from bench.benchmark.problem.experiment_config import Experiment, TunerEntry, list_effect_names
from bench.benchmark.problem.experiment_recording import find_recording
from bench.benchmark.problem.robot_experiment import get_simulator_class
from bench.benchmark.problem.targets import BlindedTarget
from bench.core.plugin_registries import PartUnavailableError, diagnosers, tuners
from sims import effects
from sims.core.registry import Registry
from sims.core.simulator import InputError

PROJECT_ROOT = Path(__file__).resolve().parents[3]
"""Root folder of this project's packages."""
COMPARISON_SOURCE_FOLDERS = (
    "methods",
    "sims",
    "bench/core",
    "bench/benchmark/problem",
    "bench/benchmark/runner",
    "bench/benchmark/isolation",
)
"""Source folders that determine runs: tuners, simulators, and the code that drives and scores."""
BOUNCE_SHOT_SOURCE_FOLDERS = (
    *COMPARISON_SOURCE_FOLDERS,
    "bench/bounce_shot",
    "bench/diagnosis",
    "bench/logs",
)
"""Source folders that determine bounce shots: also drops, films and explanations."""
EXPLAIN_SOURCE_FOLDERS = (
    *COMPARISON_SOURCE_FOLDERS,
    "bench/misspecification",
    "bench/diagnosis",
    "bench/logs",
)
"""Source folders that determine extended simulators and the runs in them."""
DIAGNOSIS_SOURCE_FOLDERS = (
    "sims",
    "bench/benchmark/problem",
    "bench/benchmark/runner",
    "bench/benchmark/isolation",
    "bench/diagnosis",
    "bench/logs",
    "bench/diagnosis_benchmark/case_generation",
    "bench/diagnosis_benchmark/diagnosers",
)
"""Source folders that determine the answers of diagnosers."""
NUMERICAL_PACKAGES = (
    "av",
    "botorch",
    "cma",
    "llvmlite",
    "mujoco",
    "nlopt",
    "numba",
    "numpy",
    "opencv-python-headless",
    "pybullet",
    "sbi",
    "scikit-learn",
    "scikit-optimize",
    "scipy",
    "torch",
)
"""Numerical packages; another version of one may give other results."""
IRRELEVANT_KEYS = {
    "title": "descriptive text",
    "says": "descriptive text",
    "tags": "descriptive text",
    "identifiable": "descriptive text",
    "suite": "descriptive text",
    "problem_hashes": "an experiment that is run names no other experiments",
    "negligible_error": "used in the ranking, after all runs",
    "identifiability": "computed separately from the runs",
    "recording": "path of the file; its content is hashed",
    "model": "path of the file; its content is hashed",
    "calibration": "its result is in the settings of the tuned simulator",
    "shot": "uses the tuned model, after the runs",
    "diagnosis": "comparison of diagnosers, which tunes nothing",
    "sweep": "an experiment that is run has single values",
    "experiments": "an experiment that is run names no other experiments",
    "nuisance": "affects randomised entries only, and is hashed with them",
}
"""Keys of an experiment that change neither runs nor trained weights, each with the reason."""
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
_PLUGIN_MODULE_PREFIX = "simgap_plugin_"
"""Prefix of the module names of plugin files (`bench.core.plugin_registries`)."""
_ENTRY_POINT_GROUPS = ("simgap.tuners", "simgap.simulators", "simgap.effects", "simgap.diagnosers")
"""Entry-point groups by which installed plugins register."""


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

    A comparison of diagnosers has no simulator of its own. This covers classes that a notebook
    defines, which are in no plugin file.
    """
    sources = []
    if not experiment.diagnosis:
        sources.append(hash_class_source(get_simulator_class(experiment)))
    # The parts that are compared: tuners or diagnosers.
    for registry, name in list_compared_parts(experiment):
        try:
            sources.append(hash_class_source(registry.get(name)))
        # A skipped part has no runs yet; its hash changes when it becomes available.
        except PartUnavailableError:
            sources.append("skipped")
    return sources


def list_compared_parts(experiment: Experiment) -> list[tuple[Registry[Any], str]]:
    """List the tuners or diagnosers that an experiment compares: registry and registered name."""
    names = [(tuners, entry.tuner) for entry in experiment.tuners]
    return [*names, *((diagnosers, name) for name in experiment.diagnosis.get("diagnosers", ()))]


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


def compute_digest(*parts: Any, length: int = 10) -> str:
    """Return a short hexadecimal hash of plain values; arrays are given as bytes.

    Args:
        parts: values to hash.
        length: number of hexadecimal digits.
    """
    text = json.dumps(parts, sort_keys=True, default=_convert_for_json)
    return hashlib.sha256(text.encode()).hexdigest()[:length]


def _convert_for_json(value: Any) -> Any:
    if isinstance(value, bytes):
        return hashlib.sha256(value).hexdigest()
    return dict(value) if isinstance(value, Mapping) else str(value)


def select_relevant_keys(experiment: Experiment, irrelevant: Iterable[str]) -> dict[str, Any]:
    """Return the fields of an experiment's configuration that affect a result, to be hashed.

    Irrelevant fields are listed instead of the relevant ones, so that a new field of `Experiment`
    counts as relevant until it is listed with a reason.

    Args:
        experiment: configuration of the experiment.
        irrelevant: names of the fields that are left out.
    """
    document = experiment.document() | {"name": experiment.name}
    return {name: value for name, value in document.items() if name not in irrelevant}


@cache
def hash_source_folders(which: tuple[str, ...] = ()) -> str:
    """Hash the version and every file of some source folders.

    The hash changes with any line of code, so that results of different code are never mixed.

    Args:
        which: Folders relative to the project; `COMPARISON_SOURCE_FOLDERS` if empty.
    """
    return compute_digest(
        __version__,
        [
            _read_source_files(PROJECT_ROOT / source_folder, PROJECT_ROOT)
            for source_folder in which or COMPARISON_SOURCE_FOLDERS
        ],
    )


def _read_source_files(folder: Path, root: Path) -> list[tuple[str, bytes]]:
    """Return relative path and content of each file in a folder, without compiled Python files."""
    files = [
        file
        for file in sorted(folder.rglob("*"))
        if file.is_file() and "__pycache__" not in file.parts
    ]
    return [(file.relative_to(root).as_posix(), file.read_bytes()) for file in files]


@cache
def hash_package_versions() -> str:
    """Hash the versions of Python and of the numerical packages."""
    packages = [_format_package_version(name) for name in NUMERICAL_PACKAGES]
    return compute_digest(platform.python_version(), packages)


def _format_package_version(name: str) -> str:
    """Return name and version of an installed package, or a note that it is absent."""
    try:
        return f"{name} {version(name)}"
    except PackageNotFoundError:
        return f"{name} absent"


def hash_plugin_files(plugins: Sequence[str]) -> str:
    """Hash the names and contents of plugin files."""
    return compute_digest([[Path(p).name, Path(p).read_bytes()] for p in plugins])


def hash_recording(experiment: Experiment) -> str:
    """Hash the two files of the recording; empty if the experiment has none."""
    if experiment.recording is None:
        return ""
    table = find_recording(experiment.recording.path)
    return hashlib.sha256(table.read_bytes() + table.with_suffix(".toml").read_bytes()).hexdigest()


def hash_effect_sources(*settings: Mapping[str, Any]) -> list[str]:
    """Hash the sources of effects named in simulator settings; the simulator class lacks them."""
    return [hash_class_source(effects.get_effect(name)) for name in list_effect_names(*settings)]


def hash_class_source(kind: type) -> str:
    """Hash the source of a class and of its base classes.

    A class of this project's source folders is represented by its name, because
    `hash_source_folders` hashes their content. A class of a plugin file is represented by the file,
    one of an installed plugin by its whole package, and one of a notebook cell or a script by its
    own text. A class that is made at run time has the attribute ``source_digest``, a text that
    changes with everything that determines the class. Its attribute ``made_of`` may list further
    classes that it uses.

    Args:
        kind: Simulator, tuner, effect or diagnoser class.

    Raises:
        InputError: the source of a class cannot be found.
    """
    return compute_digest(
        [(_get_class_name(part), _represent_class(part)) for part in _list_source_classes(kind)]
    )


def _get_class_name(kind: type) -> str:
    """Return the full name of a class; the changing module name of a plugin file is replaced."""
    plugin = kind.__module__.startswith(_PLUGIN_MODULE_PREFIX)
    return f"{'plugin' if plugin else kind.__module__}.{kind.__qualname__}"


def _list_source_classes(kind: type) -> list[type]:
    """Return a class, its bases, and the classes that it lists in ``made_of``, recursively.

    Their sources together determine the behaviour of the class, so all of them are hashed.

    Args:
        kind: Class whose behaviour is hashed.

    Returns:
        Classes without repetition and without those of the standard library.
    """
    classes: list[type] = []
    waiting = [kind]
    while waiting:
        # `__mro__` has the class itself and all its bases.
        for part in waiting.pop().__mro__:
            # Classes of the standard library, such as `ABC`, are determined by the version of
            # Python. A class that a metaclass made may name a module there, but is not defined in
            # it.
            if part in classes or (_is_standard_library(part) and _is_defined_in_module(part)):
                continue
            classes.append(part)
            waiting += vars(part).get("made_of", ())
    return classes


def _is_standard_library(kind: type) -> bool:
    top = _get_top_level_package(kind)
    return top in sys.stdlib_module_names and top != "__main__"


def _get_top_level_package(kind: type) -> str:
    return kind.__module__.partition(".")[0]


def _is_defined_in_module(kind: type) -> bool:
    """Return whether the module that a class names contains this class under its name.

    Only then is the module's source the source of the class. Counterexamples are classes that a
    function makes from one source with different values, and a class that ``type(...)`` makes from
    an abstract class, which names `abc` as its module.
    """
    attribute: Any = sys.modules.get(kind.__module__)
    for name in kind.__qualname__.split("."):
        attribute = getattr(attribute, name, None)
    return attribute is kind


def _represent_class(kind: type) -> Any:
    """Return what represents a class in a hash.

    * A class that is made at run time: its attribute ``source_digest``.
    * A class of a notebook or of the main script: its source.
    * A class of this project's source folders: "", because `hash_source_folders` covers it.
    * Any other class: the content of the plugin file or package that defines it.

    Raises:
        InputError: the source of the class cannot be found.
    """
    # The digest is not inherited, because a subclass behaves differently.
    if (source_digest := vars(kind).get("source_digest")) is not None:
        return source_digest
    if not _is_defined_in_module(kind):
        raise _make_source_error(kind)
    if kind.__module__ == "__main__":
        return _read_class_source(kind)
    file = getattr(sys.modules[kind.__module__], "__file__", None)
    if file is None:
        raise _make_source_error(kind)
    path = Path(file).resolve()
    if any(
        path.is_relative_to(PROJECT_ROOT / source_folder)
        for source_folder in COMPARISON_SOURCE_FOLDERS
    ):
        return ""
    return _read_package_contents(kind, path)


def _read_class_source(kind: type) -> str:
    """Return the source of a class of a notebook cell or of the main script.

    Args:
        kind: Class whose source determines results and is therefore hashed.

    Returns:
        Text of the class, or of the whole notebook cell that defines it.

    Raises:
        InputError: the source cannot be found.
    """
    try:
        return inspect.getsource(kind)
    except (OSError, TypeError):
        pass
    # A notebook has no file to search for classes, but functions refer to the text of their cell.
    for function in filter(inspect.isfunction, vars(kind).values()):
        if cell := linecache.getlines(function.__code__.co_filename):
            return "".join(cell)
    raise _make_source_error(kind)


def _read_package_contents(kind: type, path: Path) -> Any:
    """Return the contents of an installed plugin's package, or else of the file with the class.

    Args:
        kind: class to be hashed.
        path: file that defines the class.

    Returns:
        For a package, a list of (relative path, content) for each of its folders; for a file, its
        name and content.
    """
    package = _get_top_level_package(kind)
    # A module without a package has no `__path__`.
    folders = getattr(sys.modules.get(package), "__path__", None)
    if folders and package in _list_plugin_packages():
        return [_read_source_files(Path(folder), Path(folder)) for folder in folders]
    return path.name, path.read_bytes()


@cache
def _list_plugin_packages() -> frozenset[str]:
    """Return the top-level packages of installed plugins, including this project's own."""
    entries = [entry for group in _ENTRY_POINT_GROUPS for entry in entry_points(group=group)]
    return frozenset(entry.module.partition(".")[0] for entry in entries)


def _make_source_error(kind: type) -> InputError:
    """Make the error for a class whose source code cannot be found, so that it cannot be hashed."""
    return InputError(
        f"class {kind.__qualname__} of {kind.__module__}: expected a class of a module, a plugin "
        "file or a notebook's cell, found one whose source cannot be determined; define it there "
        "under its own name, or give it a text source_digest that changes with its content"
    )
