"""Engines that integrate systems, by name."""

from __future__ import annotations

import importlib.util
import inspect
import sys
from collections.abc import Mapping
from importlib import import_module
from typing import Any

from sims.base import InputError, unknown
from sims.system import Engine, System

NAMES = {
    "batch": "sims.engines.batch",
    "mujoco": "sims.engines.mujoco",
    "pybullet": "sims.engines.bullet",
}
"""Modules of the engines; one is imported when it is asked for, and says what it requires."""
HIDING = ("batch",)
"""Engines that integrate hidden coordinates beside a system's own (`sims.engines.hidden`)."""


def stepping() -> str:
    """How the engine `batch` steps here, for a record: ``machine code``, ``numpy``, or ``none``
    where it is not in use.

    Machine code is made if it is not there, once after an install; so ask before there are
    processes that would each wait for it.
    """
    if NAMES["batch"] not in sys.modules:
        return "none"
    from sims.engines.compiled import machine

    return "numpy" if machine.machine() is None else "machine code"


def missing_packages(name: str) -> list[str]:
    """Packages that an engine of `NAMES` requires and that are not installed."""
    required = import_module(NAMES[name]).REQUIRES
    return [package for package in required if importlib.util.find_spec(package) is None]


def engine_named(name: str, system: type[System], settings: Mapping[str, Any]) -> Engine:
    """A new engine for one simulator; its module's `engine(system, **settings)` makes it.

    Raises:
        InputError: no such engine, a package it needs is missing, a setting it does not have, or it
            cannot carry the system.
    """
    if name not in NAMES:
        raise unknown("engine", name, list(NAMES))
    module = import_module(NAMES[name])
    if missing := missing_packages(name):
        raise InputError(
            f"engine {name} needs {', '.join(missing)}, not installed"
            f" (pip install {' '.join(missing)})"
        )
    # An engine's settings are the keyword arguments of what makes it: they are declared once.
    parameters = inspect.signature(module.engine).parameters
    known = [key for key, p in parameters.items() if p.kind is p.KEYWORD_ONLY]
    for setting in settings:
        if setting not in known:
            raise unknown(f"setting of engine {name}", setting, known)
    engine: Engine = module.engine(system, **settings)
    if reason := engine.refuses(system):
        raise InputError(f"engine {name} cannot carry system {system.name}: {reason}")
    return engine
