"""Look up simulation engines by name."""

from __future__ import annotations

import importlib.util
import inspect
import sys
from collections.abc import Mapping
from importlib import import_module
from typing import Any

from sims.core.engine import Engine
from sims.core.simulator import InputError, make_unknown_name_error
from sims.core.system import System

ENGINE_MODULES = {
    "batch": "sims.engines.batch_engine",
    "mujoco": "sims.engines.external.mujoco_engine",
    "pybullet": "sims.engines.external.bullet_engine",
}
"""Module of each engine by name; a module is imported when its engine is first requested."""
HIDDEN_STATE_ENGINES = ("batch",)
"""Engines that can integrate the hidden states of effects."""


def describe_stepping() -> str:
    """Return how forces are computed in this process, for a record of the run.

    If the machine code does not exist yet, it is compiled, once after an installation. Therefore
    call this before starting processes that would each wait for it.

    Returns:
        ``machine code``, or ``none`` if no declared system is in use.
    """
    # Systems are declared by importing this module.
    if "sims.system_simulator" not in sys.modules:
        return "none"
    from sims.engines.compiled import element_stepping

    element_stepping.COMPILED.load()
    return "machine code"


def missing_packages(name: str) -> list[str]:
    """Return the required packages of an engine of `ENGINE_MODULES` that are not installed."""
    required = import_module(ENGINE_MODULES[name]).REQUIRED_PACKAGES
    return [package for package in required if importlib.util.find_spec(package) is None]


def make_engine(name: str, system: type[System], settings: Mapping[str, Any]) -> Engine:
    """Make a new engine for one simulator.

    The module of the engine is imported here, so that a program needs only the packages of the
    engines that it uses.

    Args:
        name: name of the engine in `ENGINE_MODULES`.
        system: system that the engine will integrate.
        settings: the engine's settings by name.

    Returns:
        The engine.

    Raises:
        InputError: the engine or a setting is unknown, a required package is not installed, or the
            engine cannot integrate the system.
    """
    if name not in ENGINE_MODULES:
        raise make_unknown_name_error("engine", name, list(ENGINE_MODULES))
    module = import_module(ENGINE_MODULES[name])
    if missing := missing_packages(name):
        raise InputError(
            f"engine {name} needs {', '.join(missing)}, not installed"
            f" (pip install {' '.join(missing)})"
        )
    # An engine's settings are the keyword-only arguments of its factory, which declares them once.
    parameters = inspect.signature(module.make_engine).parameters
    setting_names = [key for key, p in parameters.items() if p.kind is p.KEYWORD_ONLY]
    for setting in settings:
        if setting not in setting_names:
            raise make_unknown_name_error(f"setting of engine {name}", setting, setting_names)
    engine: Engine = module.make_engine(system, **settings)
    return engine
