"""Finds tuners, simulators and effects: the project's own, installed plugins' and those of
`--plugin FILE`.

All come in the same way, through the entry-point groups `simgap.tuners` and `simgap.simulators`,
and are imported only when asked for. What cannot be imported is listed as skipped, with the reason.
"""

from __future__ import annotations

import importlib.util
import inspect
import re
import sys
from collections.abc import Iterable
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, TypeVar

from methods.base import Tuner
from sims import effects
from sims.base import InputError, Simulator, unknown
from sims.extended import load as load_extended
from sims.system import Effect

T = TypeVar("T", bound="Tuner | Simulator")


class SkippedError(InputError):
    """A registered part cannot be used here; the message says why."""


class Registry(Generic[T]):
    """The registered parts of one kind, by name."""

    def __init__(self, kind: str, group: str, base: type[T]) -> None:
        self.kind, self.group, self.base = kind, group, base
        self._from_files: dict[str, type[T]] = {}

    @lru_cache(maxsize=1)  # noqa: B019 - the two registries live as long as the process
    def _entries(self) -> dict[str, EntryPoint]:
        return {entry.name: entry for entry in entry_points(group=self.group)}

    def names(self) -> list[str]:
        """All registered names, sorted."""
        return sorted({*self._entries(), *self._from_files})

    def get(self, name: str) -> type[T]:
        """The class registered as `name`.

        Raises:
            InputError: no such name.
            SkippedError: it cannot be imported or lacks a package.
        """
        if name in self._from_files:
            found: Any = self._from_files[name]
        elif name in self._entries():
            try:
                found = self._entries()[name].load()
            except Exception as error:
                raise SkippedError(f"{type(error).__name__}: {error}") from error
        else:
            raise unknown(self.kind, name, self.names())
        if not (inspect.isclass(found) and issubclass(found, self.base)):
            raise SkippedError(f"{name} is not a {self.base.__name__}: {found!r}")
        missing = [
            package for package in found.requires if importlib.util.find_spec(package) is None
        ]
        if missing:
            raise SkippedError(
                f"needs {', '.join(missing)}, not installed (pip install {' '.join(missing)})"
            )
        result: type[T] = found
        return result

    def describe(self, name: str) -> str:
        """One line for a list: what it is, or why it is skipped."""
        try:
            found = self.get(name)
        except SkippedError as reason:
            return f"skipped: {reason}"
        says = getattr(found, "says", "") or (inspect.getdoc(found) or "").split("\n\n")[0]
        return " ".join(says.split())

    def add(self, found: type[T], path: Path) -> None:
        """Register a class of the plugin file `path`.

        Raises:
            InputError: the name is taken.
        """
        if found.name in self.names():
            raise InputError(
                f"plugin {path}: {self.kind} '{found.name}' exists already; give it another name"
            )
        self._from_files[found.name] = found


tuners: Registry[Tuner] = Registry("tuner", "simgap.tuners", Tuner)
simulators: Registry[Simulator] = Registry("simulator", "simgap.simulators", Simulator)  # type: ignore[type-abstract]

_loaded: set[Path] = set()


def load_plugins(paths: Iterable[str | Path]) -> None:
    """Register every tuner, simulator and effect that is defined in the files, once.

    A file ending in .toml is an extended simulator as `simgap explain` writes it, loaded after what
    it may extend.

    Raises:
        InputError: a file is missing, does not run, or defines none of them.
    """
    for path in sorted((Path(p).resolve() for p in paths), key=lambda p: p.suffix == ".toml"):
        if path in _loaded:
            continue
        if path.suffix == ".toml":
            simulators.add(load_extended(path, simulators.get), path)
            _loaded.add(path)
            continue
        module = _run(path)
        found = [
            c
            for c in vars(module).values()
            if inspect.isclass(c) and c.__module__ == module.__name__
        ]
        parts = [
            c
            for c in found
            if issubclass(c, (Tuner, Simulator, Effect)) and not inspect.isabstract(c)
        ]
        if not parts:
            raise InputError(
                f"plugin {path}: defines neither a Tuner nor a Simulator nor an Effect"
            )
        for part in parts:
            _named(part, path)
            if issubclass(part, Tuner):
                tuners.add(part, path)
            elif issubclass(part, Simulator):
                simulators.add(part, path)
            else:
                effects.register(part)
        _loaded.add(path)


_NAME = re.compile(r"[A-Za-z0-9][\w.+-]{0,60}$")


def _named(part: type, path: Path) -> None:
    """Refuse a name that tables, files and command lines could not hold."""
    name = getattr(part, "name", None)
    if not (isinstance(name, str) and _NAME.match(name)):
        raise InputError(
            f"plugin {path}: class {part.__name__}: expected name = 'plain_name', found {name!r:.80}"
        )
    requires = getattr(part, "requires", ())
    if not (isinstance(requires, tuple | list) and all(isinstance(r, str) for r in requires)):
        raise InputError(
            f"plugin {path}: class {part.__name__}: expected requires = ('package', ...)"
        )


def _run(path: Path) -> ModuleType:
    if not path.is_file():
        raise InputError(f"plugin {path}: no such file")
    spec = importlib.util.spec_from_file_location(f"simgap_plugin_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise InputError(f"plugin {path}: expected a Python file ending in .py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    except SyntaxError as error:
        raise InputError(f"plugin {path}, line {error.lineno}: {error.msg}") from error
    except (Exception, SystemExit) as error:
        raise InputError(f"plugin {path}: {type(error).__name__}: {error}") from error
    return module
