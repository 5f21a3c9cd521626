"""Registries of tuners, simulators, effects and diagnosers, and loading of plugins.

Parts of the project, of installed plugins and of `--plugin FILE` are registered in the same way
(`registry.Registry`), through the entry-point groups `simgap.tuners`, `simgap.simulators`,
`simgap.effects` and `simgap.diagnosers`.
"""

from __future__ import annotations

import importlib.util
import inspect
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from bench.core.diagnoser import Diagnoser
from methods.tuner import Tuner
from sims.core.registry import PartUnavailableError, Registry
from sims.core.simulator import InputError, Simulator, make_unknown_name_error
from sims.effects import registry as effects
from sims.extended_simulator import load_extended

__all__ = [
    "REGISTRIES",
    "PartUnavailableError",
    "Registry",
    "diagnosers",
    "effects",
    "find_part_kind",
    "load_plugins",
    "simulators",
    "tuners",
]

tuners: Registry[Tuner] = Registry("tuner", "simgap.tuners", Tuner)
simulators: Registry[Simulator] = Registry(
    "simulator",
    "simgap.simulators",
    Simulator,  # type: ignore[type-abstract]
)

diagnosers: Registry[Diagnoser] = Registry(
    "diagnoser",
    "simgap.diagnosers",
    Diagnoser,  # type: ignore[type-abstract]
)

REGISTRIES: tuple[Registry[Any], ...] = (tuners, simulators, effects, diagnosers)
"""Registries of all kinds of parts, in the order in which a plugin's class is tried."""


def find_part_kind(name: str) -> str:
    """Return whether a name is that of a tuner, simulator, effect or diagnoser.

    Raises:
        InputError: nothing is registered under this name.
    """
    for registry in REGISTRIES:
        if name in registry.names():
            return registry.kind
    names = [name for registry in REGISTRIES for name in registry.names()]
    raise make_unknown_name_error("tuner, simulator, effect or diagnoser", name, names)


def make_robot_simulator(
    path: str | Path,
    actuators: Mapping[str, Any] | None = None,
    engine: Mapping[str, Any] | None = None,
    free: Sequence[str] = (),
    description: Path | None = None,
) -> type[Simulator]:
    """Make the simulator of a robot's model file.

    Args:
        path: MJCF or URDF file.
        actuators: actuators that the file lacks, as in a recording's description.
        engine: time step and integrator if they differ from the file's.
        free: numbers of the file to tune, such as ``damping@*``.
        description: file that states all this, for messages; None without one.

    Raises:
        InputError: the file cannot be used, or something requested does not exist in it.
    """
    # These modules are imported here, because most commands do not use robots.
    from sims.robot.parsing.read_model_file import read_robot
    from sims.robot.robot_simulator import make_robot_simulator

    robot = read_robot(Path(path), actuators=actuators, engine=engine, description=description)
    return make_robot_simulator(robot, free)


def load_plugins(paths: str | Path | Iterable[str | Path]) -> None:
    """Register every tuner, simulator, effect and diagnoser that the files define, once.

    A file ending in .toml is an extended simulator as written by `simgap explain`. It is loaded
    after the files that it may extend.

    Raises:
        InputError: a file is missing, does not run, or defines no such part; nothing of this file
            is registered then.
    """
    # Something that is neither a path nor a list is reported below like a wrong entry of a list.
    paths_to_load = (
        [paths] if isinstance(paths, str | Path) or not isinstance(paths, Iterable) else paths
    )
    files = []
    for path in paths_to_load:
        if not isinstance(path, str | Path):
            raise InputError(f"plugins: expected a path or a list of paths, found {path!r:.80}")
        files.append(Path(path).resolve())
    for path in sorted(files, key=lambda file: file.suffix == ".toml"):
        if any(path in registry.paths() for registry in REGISTRIES):
            continue
        snapshots = [registry.snapshot() for registry in REGISTRIES]
        try:
            _load_plugin_file(path)
        except InputError:
            # A partly registered plugin would count as loaded, and its error would not be reported
            # again.
            for registry, snapshot in zip(REGISTRIES, snapshots, strict=True):
                registry.restore(snapshot)
            raise


def _load_plugin_file(path: Path) -> None:
    """Load one plugin file, and register every part that it defines under its name.

    A TOML file is an extended simulator (the result of `simgap explain`); any other file is Python.

    Raises:
        InputError: the file cannot be loaded, or defines no part.
    """
    if path.suffix == ".toml":
        simulators.register(load_extended(path, simulators.get), path)
        return
    parts = _find_plugin_classes(_execute_module(path))
    if not parts:
        raise InputError(
            f"plugin {path}: defines neither a Tuner nor a Simulator nor an Effect nor a Diagnoser"
        )
    for registry, part in parts:
        registry.register(part, path)


def _find_plugin_classes(module: ModuleType) -> list[tuple[Registry[Any], type]]:
    """Return the non-abstract classes that the module defines, each with its registry.

    Args:
        module: Module of a plugin.
    """
    module_classes = [
        value
        for value in vars(module).values()
        # Imported classes belong to other modules.
        if inspect.isclass(value) and value.__module__ == module.__name__
    ]
    return [
        (registry, part)
        for part in module_classes
        if not inspect.isabstract(part)
        for registry in REGISTRIES
        if registry.accepts(part)
    ]


def _make_module_name(path: Path) -> str:
    """Return a module name for a plugin file that no other file has in this process.

    Args:
        path: Python file of the plugin.
    """
    name = f"simgap_plugin_{path.stem}"
    number = 1
    # Two files of the same name in different folders need different modules, because the source of
    # a class is found by its module. A name without a module, or with that of this file, is free.
    while getattr(sys.modules.get(name), "__file__", str(path)) != str(path):
        number += 1
        name = f"simgap_plugin_{path.stem}_{number}"
    return name


def _execute_module(path: Path) -> ModuleType:
    """Execute a plugin file as a module, and return the module.

    Raises:
        InputError: there is no such file, or its code fails; Ctrl-C still interrupts it.
    """
    if not path.is_file():
        raise InputError(f"plugin {path}: no such file")
    spec = importlib.util.spec_from_file_location(_make_module_name(path), path)
    if spec is None or spec.loader is None:
        raise InputError(f"plugin {path}: expected a Python file ending in .py")
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look up their module when they are made.
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    except SyntaxError as error:
        raise InputError(f"plugin {path}, line {error.lineno}: {error.msg}") from error
    except KeyboardInterrupt:
        raise
    # This includes SystemExit and other exceptions that are not an `Exception`.
    except BaseException as error:
        raise InputError(
            f"plugin {path}: {type(error).__name__}: {_format_plugin_error(error)}"
        ) from error
    return module


def _format_plugin_error(error: BaseException) -> str:
    """Return the message of an error; it is made by a plugin's code, which may fail again."""
    try:
        return str(error)
    except Exception:
        return "without a message"
