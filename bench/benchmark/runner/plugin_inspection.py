"""Inspect plugins in an isolated process, and refuse classes that other processes cannot load.

The code of a plugin with tuners or diagnosers never runs in a process that has true parameters.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

from bench.benchmark.isolation.isolation_layers import AccessPolicy
from bench.benchmark.isolation.message_channel import MessageChannel, MessageKind, to_printable
from bench.benchmark.isolation.process_errors import RunEndedError, with_isolation
from bench.benchmark.problem.experiment_config import (
    Experiment,
    TunerEntry,
    find_named_effects,
    list_effect_names,
)
from bench.benchmark.runner.retry_after_kill import retry_if_killed
from bench.benchmark.runner.run_fingerprint import (
    compute_digest,
    hash_class_source,
    list_compared_parts,
)
from bench.benchmark.runner.tuner_process_start import (
    get_fork_server,
    make_tuner_spec,
    start_isolated_tuner,
)
from bench.core.diagnoser import Answer, Diagnoser, DiagnosisCase
from bench.core.plugin_registries import (
    REGISTRIES,
    diagnosers,
    effects,
    load_plugins,
    simulators,
    tuners,
)
from methods.tuner import Tuner
from sims.core.registry import PartUnavailableError, Registry
from sims.core.simulator import InputError
from sims.extended_simulator import read_extended

_INSPECTION_TIMEOUT_SECONDS = 120.0
"""Timeout for loading a plugin, in seconds."""
_MAX_ANSWER_BYTES = 1 << 20
"""Maximum size of the description of a plugin, in bytes."""
_PROJECT_PACKAGES = ("methods.", "bench.")
"""Packages of the project's own tuners and diagnosers, which are trusted."""
_ISOLATED_REGISTRIES: dict[str, Registry[Any]] = {"tuner": tuners, "diagnoser": diagnosers}
"""Registries of parts that are compared.

Their code never runs in a process with true parameters.
"""


@dataclass(frozen=True)
class Plugin:
    """A plugin file and its description.

    Attributes:
        path: path of the file; empty for an installed plugin.
        runs_in_process: whether its code runs in the harness's processes.
        parts: descriptions of its tuners and diagnosers if it is not loaded.
    """

    path: str
    runs_in_process: bool = True
    parts: tuple[dict[str, Any], ...] = ()


class TunerStub(Tuner):
    """Stub of a tuner whose code is not in this process, with its description."""


class DiagnoserStub(Diagnoser):
    """Stub of a diagnoser whose code is not in this process, with its description."""

    def diagnose(self, case: DiagnosisCase) -> Answer:
        """Raise an error, because a stub cannot diagnose."""
        raise NotImplementedError


def _make_stub(description: dict[str, Any]) -> Any:
    """Make the stub of a tuner or diagnoser: a class with its properties, but without its code.

    Args:
        description: properties of the class, from `_validate_part`: ``says`` is the first
            paragraph of its docstring, ``trains_as`` the tuner whose random stream it trains with,
            ``source`` a hash of its source.

    Returns:
        Subclass of `TunerStub` or `DiagnoserStub`.
    """
    base = TunerStub if description["kind"] == "tuner" else DiagnoserStub
    fields: dict[str, Any] = {
        "name": str(description["name"]),
        # Code of the plugin wrote both flags, so they may have any value: only a true bool counts.
        "stochastic": description["stochastic"] is not False,
        "learned": description["learned"] is True,
        "trains_as": str(description["trains_as"]),
        "module": str(description["module"]),
        "source_digest": str(description["source"]),
        "__doc__": str(description["says"]),
        "__module__": __name__,
    }
    return type(fields["name"], (base,), fields)


def register_plugins(plugins: Iterable[Plugin]) -> None:
    """Register plugins in this process: load their code, or make stubs of their descriptions.

    A stub is a class with the properties of a tuner or diagnoser, but without its code. Plugins
    whose code runs in this process have no descriptions (`parts`), so that no stub is made of them.

    Raises:
        InputError: a plugin has an error.
    """
    plugins = list(plugins)
    load_plugins(plugin.path for plugin in plugins if plugin.runs_in_process)
    for plugin in plugins:
        path = Path(plugin.path) if plugin.path else None
        for description in plugin.parts:
            _ISOLATED_REGISTRIES[description["kind"]].announce(_make_stub(description), path)


_known_plugins: dict[str, Plugin] = {}
"""Plugin files that this process has loaded or inspected, by path."""


def load_plugins_for_experiment(paths: Sequence[str], experiment: Experiment) -> None:
    """Load plugin files before an experiment runs, or only register descriptions of their tuners.

    This process has the true parameters, so code of a tuner must not run in it. A file with a
    simulator or an effect that is needed is loaded. Other files are inspected in an isolated
    process, and their tuners are registered as stubs. If tuners are trusted, all files are loaded.

    Args:
        paths: plugin files.
        experiment: configuration, which states the simulator, the effects and whether tuners are
            trusted.

    Raises:
        InputError: a file cannot be used.
    """
    described_plugins = [Plugin(path) for path in paths]
    if not experiment.trusted:
        # `settings` are those of the tuned simulator, `world` those of the true system.
        required_names = {experiment.simulator} | find_named_effects(
            experiment.settings, experiment.world
        )
        # An extended simulator (a .toml file) needs the system and the effects that it names.
        described_plugins = inspect_plugins(paths, required_names | _list_extended_names(paths))
        _check_no_shared_file(described_plugins, experiment)
    register_plugins(described_plugins)
    _known_plugins.update({plugin.path: plugin for plugin in described_plugins})
    if not experiment.trusted:
        announce_installed(list_compared_parts(experiment))


def check_classes_importable(experiment: Experiment, workers: bool = True) -> None:
    """Raise an error for classes that exist in this process only, if other processes need them.

    A worker is a new interpreter, so that no tuner finds the true parameters in its memory. It
    loads plugin files and installed packages, but does not import the script or notebook that calls
    simgap, and so does not have classes that are defined there. The process of a tuner is a new
    interpreter, too.

    Args:
        experiment: configuration of the experiment.
        workers: True if worker processes simulate; otherwise only tuners have processes.

    Raises:
        InputError: the simulator, a tuner, a diagnoser or an effect is such a class.
    """
    used_parts = list_compared_parts(experiment)
    if workers:
        effect_names = list_effect_names(experiment.settings, experiment.world)
        # The simulator of a robot is made from its model file, so it needs no registered class.
        simulated = [] if experiment.model else [(simulators, experiment.simulator)]
        used_parts = [*simulated, *used_parts, *((effects, name) for name in effect_names)]
    for registry, name in used_parts:
        # The snapshot has the classes that were added in this process; a class without a plugin
        # file was defined by the script or notebook.
        registered = registry.snapshot().get(name)
        if registered is not None and registered.path is None:
            raise make_unreachable_error(registry.kind, name, registered.part)


def make_unreachable_error(kind: str, name: str, part: type) -> InputError:
    """Make the error for a class that worker processes cannot load, and say how to solve it.

    A class of a module file can be passed as a plugin. A class of the main script, a notebook or an
    interactive session must be moved to a file first.

    Args:
        kind: kind of the class, such as ``tuner``.
        name: name under which it is registered.
        part: the class.
    """
    file = getattr(sys.modules.get(part.__module__), "__file__", None)
    is_main = part.__module__ == "__main__"
    path = str(Path(file).resolve()) if file else "this session"
    source = f"the script {path}" if file and is_main else path
    must_move = is_main or not file
    plugin = f"{name}.py" if must_move else path
    move = f"put it into a file of its own, say {plugin}, and " if must_move else ""
    name_argument = f"tuners=[{name!r}], " if kind in ("tuner", "diagnoser") else ""
    return InputError(
        f"{kind} {name}: class {part.__qualname__} is defined in {source}, which "
        f"worker processes do not import; {move}pass {name_argument}plugins=[{plugin!r}], or pass "
        "jobs=0, which runs everything in this process"
    )


def _list_extended_names(paths: Iterable[str]) -> set[str]:
    """Return the names of the systems and effects of extended simulators.

    An extended simulator is a file that names a system and the effects to add to it. An effect at
    one joint of a robot is written ``EFFECT@JOINT``, of which only the effect is returned.

    Args:
        paths: plugin files; those of extended simulators end in .toml.

    Raises:
        InputError: a file cannot be read.
    """
    names = set()
    for path in paths:
        if path.endswith(".toml"):
            extended = read_extended(Path(path))
            names |= {extended.system, *(name.partition("@")[0] for name in extended.effects)}
    return names


def _check_no_shared_file(plugins: Iterable[Plugin], experiment: Experiment) -> None:
    """Raise an error if a file with a simulator or effect in use also has a tuner in use.

    Such a file is loaded into this process, which has the true parameters; its tuner could read
    them.

    Args:
        plugins: inspected plugin files; `runs_in_process` is True if the simulator or effect is
            needed.
        experiment: configuration with the tuners.

    Raises:
        InputError: there is such a file.
    """
    labels = {entry.tuner: entry.label for entry in experiment.tuners}
    for plugin in plugins:
        for part in plugin.parts:
            if plugin.runs_in_process and part["kind"] == "tuner" and part["name"] in labels:
                raise _make_untrusted_code_error(labels[part["name"]], plugin.path)


def _make_untrusted_code_error(label: str, file: object) -> InputError:
    """Make the error for a tuner whose code has been loaded into this process.

    Such a tuner could read the true parameters, so its results would prove nothing.

    Args:
        label: label of the tuner.
        file: path of the file with its code.
    """
    return InputError(
        f"tuner {label}: the code of {file} runs in this process, which has the true "
        "parameters: a simulator or effect in it is used here, or it was imported directly; put "
        "the tuner into a separate file, or use --trust"
    )


def describe_plugins(paths: Sequence[str], experiment: Experiment) -> list[Plugin]:
    """Return what other processes need to know of plugin files and of installed tuners.

    If tuners are trusted, other processes load all files. Otherwise the result has descriptions of
    their tuners or diagnosers from the inspection, so that workers do not load this code either. A
    file that was not inspected yet is inspected now.

    Args:
        paths: plugin files.
        experiment: configuration, which names the tuners and says whether they are trusted.

    Raises:
        InputError: a file cannot be used.
    """
    if experiment.trusted:
        return [Plugin(path) for path in paths]
    missing = [path for path in paths if path not in _known_plugins]
    if missing:
        load_plugins_for_experiment(missing, experiment)
    packages = [
        _packages[registry.kind, name]
        for registry, name in list_compared_parts(experiment)
        if (registry.kind, name) in _packages
    ]
    return [_known_plugins[path] for path in paths] + packages


_packages: dict[tuple[str, str], Plugin] = {}
"""Descriptions of tuners and diagnosers of installed packages, by kind and name."""


def announce_installed(parts: Iterable[tuple[Registry[Any], str]]) -> None:
    """Inspect tuners and diagnosers of other packages before they are imported in this process.

    Their code must not run here, so a stub with the properties found is registered in their place.
    Those that are already registered here, belong to this project or cannot be used are left alone.

    Args:
        parts: registry and registered name of each tuner or diagnoser.
    """
    for registry, name in parts:
        if is_external_part(name, registry):
            with suppress(PartUnavailableError):
                plugin = inspect_installed_part(name, registry.kind)
                _packages[registry.kind, name] = plugin
                register_plugins([plugin])


def must_build_isolated(entry: TunerEntry) -> bool:
    """Return whether an entry's tuner must be built in an isolated process only.

    This is so for tuners of plugins, which are stubs in this process. Such a tuner is built in an
    isolated process once as a test, so that wrong options are reported before the runs begin.

    Raises:
        InputError: the tuner cannot be built, or its code is already in this process.
        PartUnavailableError: the tuner cannot be used here.
    """
    announce_installed([(tuners, entry.tuner)])
    tuner_class, plugin_file = tuners.get(entry.tuner), tuners.place(entry.tuner)
    if not issubclass(tuner_class, TunerStub):
        if plugin_file is not None:
            raise _make_untrusted_code_error(entry.label, plugin_file)
        return False
    try:
        retry_if_killed(lambda: _try_to_build(entry))
        return True
    except RunEndedError as ended:
        # The last line of a traceback has the error: its class and its message.
        message = "".join(str(ended).strip().splitlines()[-1:])
        error_name, _, explanation = message.partition(": ")
        # Options that a tuner refuses raise these errors, whose message alone is clear.
        message = explanation if error_name in ("TypeError", "ValueError") else message
        raise InputError(f"tuner {entry.label}: {message}") from None


def _try_to_build(entry: TunerEntry) -> None:
    with start_isolated_tuner(make_tuner_spec(entry), 0, "run"):
        return


def inspect_plugins(paths: Sequence[str], needed: Iterable[str]) -> list[Plugin]:
    """Inspect plugin files in an isolated process, and decide which of them to load here.

    The parts of a file are the tuners, diagnosers, simulators and effects that it defines. A file
    is loaded if it defines a simulator or effect that is needed. Its names must not be in
    use, which is checked before its code runs.

    Args:
        paths: plugin files.
        needed: names of the simulators and effects that this process needs.

    Returns:
        One plugin for each file: whether to load it, and the descriptions of its tuners and
        diagnosers.

    Raises:
        InputError: a file cannot be used.
    """
    needed_names = set(needed)
    plugins = []
    paths_by_name: dict[tuple[str, str], str] = {}
    for path in paths:
        # An extended simulator is data and contains no code.
        if path.endswith(".toml"):
            plugins.append(Plugin(path))
            continue
        parts = _ask_isolated_process({"file": path, "kind": "", "name": ""}, path)
        # Tuners and diagnosers, whose code runs in isolated processes only.
        isolated_parts = tuple(part for part in parts if part["kind"] in _ISOLATED_REGISTRIES)
        needed_parts = [
            part for part in parts if part["name"] in needed_names and part not in isolated_parts
        ]
        for part in needed_parts:
            _check_name_free(part["kind"], part["name"], path, paths_by_name)
        plugins.append(Plugin(path, bool(needed_parts), isolated_parts))
    return plugins


def _check_name_free(
    kind: str, name: str, path: str, paths_by_name: dict[tuple[str, str], str]
) -> None:
    """Raise an error if a name in a file's description is already in use.

    This is checked before the file's code is loaded, because the description may be wrong.

    Args:
        kind: kind of the class, such as ``tuner``.
        name: its registered name.
        path: path of the plugin file.
        paths_by_name: file of each described class by kind and name, extended in place.

    Raises:
        InputError: the name is in use.
    """
    for registry in REGISTRIES:
        is_taken = registry.kind == kind and name in registry.names()
        if is_taken and registry.place(name) != Path(path).resolve():
            raise InputError(f"plugin {path}: {kind} '{name}' exists already; give it another name")
    other_path = paths_by_name.setdefault((kind, name), path)
    if other_path != path:
        raise InputError(
            f"plugin {path}: {kind} '{name}' is in {other_path} too; give one another name"
        )


def inspect_installed_part(name: str, kind: str = "tuner") -> Plugin:
    """Inspect a tuner or diagnoser that another package has installed.

    Args:
        name: registered name.
        kind: ``tuner`` or ``diagnoser``.

    Returns:
        A plugin without a file, which is not loaded here, with the one description.

    Raises:
        PartUnavailableError: it cannot be used here.
        InputError: it cannot be inspected.
    """
    descriptions = _ask_isolated_process({"file": "", "kind": kind, "name": name}, name)
    if not descriptions:
        raise InputError(f"plugin {name}: its process did not describe it")
    # The key is set if a package is missing that the tuner or diagnoser needs.
    if "skipped" in descriptions[0]:
        raise PartUnavailableError(kind, name, descriptions[0]["skipped"])
    # The description may state a wrong name or kind. Registered under these, the requested part
    # would have no stub, and its code would run here.
    return Plugin("", False, ({**descriptions[0], "kind": kind, "name": name},))


def is_external_part(name: str, registry: Registry[Any] = tuners) -> bool:
    """Return whether a tuner or diagnoser belongs to another package and is not loaded here.

    Args:
        name: registered name.
        registry: registry of tuners or of diagnosers.
    """
    # The entry point is the address of its class in an installed package, such as `module:Class`.
    entry_point = registry.entry(name)
    is_registered = registry.place(name) is not None or entry_point is None
    return not is_registered and not str(entry_point).startswith(_PROJECT_PACKAGES)


def _ask_isolated_process(question: dict[str, str], label: str) -> list[dict[str, Any]]:
    """Return the descriptions by an isolated process that has loaded the given plugin.

    Args:
        question: what to load: ``file`` is the path of a plugin file; if it is empty, ``kind`` and
            ``name`` are those of an installed tuner or diagnoser.
        label: name of the plugin in error messages.

    Returns:
        Descriptions of the registered classes of the plugin, from `_validate_part`.

    Raises:
        InputError: the file does not exist, or the plugin cannot be loaded.
    """
    file = question["file"]
    if file and not Path(file).is_file():
        raise InputError(f"plugin {file}: no such file")
    try:
        answer = retry_if_killed(lambda: _request_inspection(question, [file] if file else []))
    except RunEndedError as ended:
        message = "takes too long to load" if ended.status == "timeout" else ended.reason
        raise InputError(f"plugin {label}: {message.strip().splitlines()[-1]}") from None
    # The answer is a list of descriptions, or a dictionary with the message of an error.
    if isinstance(answer, dict):
        raise InputError(with_isolation(str(answer.get("fault"))))
    return [_validate_part(part, file) for part in answer]


def _request_inspection(question: dict[str, str], files: list[str]) -> Any:
    """Start an isolated process, ask it one question about a plugin, and return its answer.

    Args:
        question: names a plugin file, or an installed tuner or diagnoser by kind and name; see
            `_ask_isolated_process`.
        files: files that the process may read, in addition to Python and its packages.

    Returns:
        JSON value, not yet validated: code of the plugin may have written it.
    """
    child = get_fork_server().start_process(
        f"{__name__}:serve_inspection", files, modules=[__name__]
    )
    deadline = perf_counter() + _INSPECTION_TIMEOUT_SECONDS
    try:
        child.wait_until_ready()
        child.send(MessageKind.QUESTION, json.dumps(question).encode(), deadline=deadline)
        return child.receive(_MAX_ANSWER_BYTES, deadline).to_document(_MAX_ANSWER_BYTES)
    finally:
        child.end()


def _validate_part(part: Any, file: str) -> dict[str, Any]:
    """Validate the description of one tuner, diagnoser, simulator or effect of a plugin.

    Code of the plugin may have written the description, so nothing in it is trusted: texts are
    shortened and made printable, and the hash of the source includes the content of the file.

    Args:
        part: description from the isolated process, any JSON value.
        file: path of the plugin file; empty for an installed plugin.

    Returns:
        The checked description: ``kind``, ``name``, ``says`` (first paragraph of the docstring),
        ``trains_as``, ``file``, ``module``, ``source`` (a hash), ``stochastic``, ``learned``, and
        ``skipped`` (the reason) if it cannot be used here.

    Raises:
        InputError: it is not the description of a registered class.
    """
    kinds = [registry.kind for registry in REGISTRIES]
    if not isinstance(part, dict) or part.get("kind") not in kinds or "name" not in part:
        raise InputError(f"plugin {file}: its process did not list what it contains")
    keys = ("kind", "name", "trains_as", "says")
    text = {key: to_printable(str(part.get(key, ""))[:500]) for key in keys}
    # The hash contains the file's content, in addition to the plugin's own description.
    hashed = [str(part.get("source", "")), Path(file).read_bytes() if file else b""]
    # A part of a file is found by the file; a module name could pass information to its runs.
    module = "" if file else str(part.get("module", ""))
    origin = {"file": file, "module": module, "source": compute_digest(*hashed)}
    flags = {key: part.get(key) for key in ("stochastic", "learned")}
    skipped = {"skipped": str(part["skipped"])[:500]} if "skipped" in part else {}
    return {**text, **origin, **flags, **skipped}


def serve_inspection(
    channel: MessageChannel, _policy: AccessPolicy, active_layers: list[str]
) -> None:
    """Answer one question about a plugin; runs in the isolated process.

    To answer, it must import the plugin, whose code is not trusted. After the answer it waits until
    the harness ends it. The answer is a list of descriptions, or ``{"fault": message}``.

    Args:
        channel: channel to the harness.
        _policy: access policy; not used.
        active_layers: names of the active isolation layers.
    """
    channel.send_document(MessageKind.READY, active_layers)
    question = channel.receive().to_document()
    try:
        answer: Any = (
            _describe_plugin_file(question["file"])
            if question["file"]
            else [_describe_installed_part(question)]
        )
    except InputError as error:
        answer = {"fault": str(error)}
    channel.send_document(MessageKind.DONE, answer)
    # No further message comes; this waits until the harness ends the process.
    channel.receive()


def _describe_plugin_file(file: str) -> list[dict[str, Any]]:
    """Describe what a plugin file defines; runs in an isolated process, as it loads the file.

    Returns:
        Description of each tuner, diagnoser, simulator and effect, from `_describe_class`.

    Raises:
        InputError: the file cannot be loaded.
    """
    load_plugins([file])
    path = Path(file).resolve()
    return [
        _describe_class(registry.kind, registered.part)
        for registry in REGISTRIES
        for registered in registry.snapshot().values()
        if registered.path == path
    ]


def _describe_installed_part(question: dict[str, str]) -> dict[str, Any]:
    """Describe an installed tuner or diagnoser; runs in an isolated process, as it imports it."""
    kind, name = question["kind"], question["name"]
    try:
        return _describe_class(kind, _ISOLATED_REGISTRIES[kind].get(name))
    except PartUnavailableError as error:
        return {"kind": kind, "name": name, "skipped": error.reason}


def _describe_class(kind: str, part: Any) -> dict[str, Any]:
    """Describe a registered class by plain values, for the harness.

    The harness cannot load the code of a tuner or diagnoser, so it needs its properties and the
    hash of its source from here. Other kinds have a name and a first paragraph only.

    Args:
        kind: kind of the class, such as ``tuner``.
        part: the class.

    Returns:
        Values by name; with ``skipped``, the reason, if the class cannot be used here.
    """
    description = {"kind": kind, "name": part.name, "says": (part.__doc__ or "").split("\n\n")[0]}
    if kind not in _ISOLATED_REGISTRIES:
        return description
    try:
        return {
            **description,
            "module": part.__module__,
            "stochastic": getattr(part, "stochastic", True),
            "learned": part.learned,
            "trains_as": getattr(part, "trains_as", ""),
            "source": hash_class_source(part),
            # `get` raises an error if a package is missing that the class needs, although its file
            # can be imported.
            "name": _ISOLATED_REGISTRIES[kind].get(part.name).name,
        }
    except PartUnavailableError as error:
        return {**description, "skipped": error.reason}
