"""Registry of parts by name: built-in, installed, and added at run time.

Installed parts come from an entry-point group and are imported only when requested. Parts that
cannot be imported are listed as skipped, with the reason. Files and notebooks add parts with
`register`.
"""

from __future__ import annotations

import importlib.util
import inspect
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import MappingProxyType
from typing import Any, Generic, TypeVar

from sims.core.simulator import InputError, make_unknown_name_error

T = TypeVar("T")

_NAME = re.compile(r"[A-Za-z0-9][\w.+-]{0,60}$")
"""Pattern of names that are valid in tables, file names and command lines."""
_OWN_PACKAGES = ("bench", "methods", "sims")
"""Packages of simgap."""


class PartUnavailableError(InputError):
    """Registered part that cannot be used on this machine.

    Attributes:
        reason: Reason without the part's name; the message contains both.
    """

    def __init__(self, kind: str, name: str, reason: str) -> None:
        super().__init__(f"{kind} {name} cannot be used here: {reason}")
        self.reason = str(InputError(reason))
        self._arguments = kind, name, reason

    def __reduce__(self) -> tuple[type[PartUnavailableError], tuple[str, str, str]]:
        # Errors of worker processes are pickled; by default that would call the class with the
        # message only.
        return PartUnavailableError, self._arguments


@dataclass(frozen=True)
class AddedPart(Generic[T]):
    """Part that was added at run time, and its plugin file; None for a class from Python."""

    part: type[T]
    path: Path | None


class Registry(Generic[T]):
    """Registered parts of one kind."""

    def __init__(self, kind: str, group: str, base: type[T]) -> None:
        """Start without parts; installed parts are imported on first request.

        Parts are stored by name: `_added` has the classes registered in this process, `_stubs` the
        placeholders of plugins, and `_imported` the parts of installed packages that were loaded.

        Args:
            kind: Word for such a part in messages, e.g. ``tuner``.
            group: Entry-point group of the installed parts.
            base: Base class of the parts.
        """
        self.kind, self.group, self.base = kind, group, base
        self._added: dict[str, AddedPart[T]] = {}
        # Placeholders of plugin classes whose code is not loaded into this process.
        self._stubs: dict[str, AddedPart[T]] = {}
        self._imported: dict[str, Any] = {}

    @cached_property
    def _entry_points(self) -> Mapping[str, EntryPoint]:
        return {entry.name: entry for entry in entry_points(group=self.group)}

    def names(self) -> list[str]:
        """Return all registered names, sorted."""
        return sorted({*self._entry_points, *self._stubs, *self._added})

    def get(self, name: str) -> type[T]:
        """Return the class registered as `name`.

        The first of these is returned: a class registered in this process; the stub of a plugin,
        which has its declared attributes but no code; the part of an installed package, which is
        imported at its first use.

        Raises:
            InputError: The name is unknown.
            PartUnavailableError: The part cannot be imported, or needs a missing package.
        """
        if name in self._added:
            part: Any = self._added[name].part
        elif name in self._stubs:
            part = self._stubs[name].part
        elif name in self._entry_points:
            part = self._load_entry_point(name)
        else:
            error = make_unknown_name_error(self.kind, name, self.names())
            raise InputError(f"{error}; for one of your own, give its file: --plugin FILE.py")
        # Checked each time, because a package may be installed while a notebook is open.
        requires = getattr(part, "requires", ())
        missing = [package for package in requires if importlib.util.find_spec(package) is None]
        if missing:
            packages = ", ".join(missing)
            remedy = f"pip install {' '.join(missing)}"
            raise PartUnavailableError(
                self.kind, name, f"needs {packages}, not installed ({remedy})"
            )
        result: type[T] = part
        return result

    def _load_entry_point(self, name: str) -> Any:
        """Load the entry point `name`; it is imported once.

        An installed plugin is an entry point of its package.

        Args:
            name: Registered name.

        Returns:
            The class or function behind the entry point.
        """
        if name not in self._imported:
            try:
                loaded_part = self._entry_points[name].load()
            except Exception as error:  # a plugin may fail in any way during import
                self._refuse_stale_installation(name, error)
                reason = f"{type(error).__name__}: {error}"
                raise PartUnavailableError(self.kind, name, reason) from error
            if not self.accepts(loaded_part):
                reason = f"expected a {self.base.__name__}, found {loaded_part!r:.80}"
                raise PartUnavailableError(self.kind, name, reason)
            self._imported[name] = loaded_part
        return self._imported[name]

    def _refuse_stale_installation(self, name: str, error: Exception) -> None:
        """Raise an error if a part of simgap itself is no longer where the installation says.

        Without the part, a search for causes would be silently incomplete.

        Args:
            name: name of the part.
            error: error of its import.

        Raises:
            InputError: the installation names a module or class that has moved.
        """
        module = self._entry_points[name].module
        # A module that fails during its import, as with another version of a library, is removed.
        has_moved = (isinstance(error, AttributeError) and module in sys.modules) or (
            isinstance(error, ModuleNotFoundError) and error.name == module
        )
        if has_moved and module.partition(".")[0] in _OWN_PACKAGES:
            raise InputError(
                f"{self.kind} {name}: expected in {module}, found {error}: the files of simgap are "
                "newer than its installation; install it again (pip install -e . in its folder)"
            ) from error

    def describe(self, name: str) -> str:
        """Return one line for a list: the description, or why the part is skipped."""
        try:
            part = self.get(name)
        except PartUnavailableError as error:
            return f"skipped: {error.reason}"
        description = getattr(part, "says", "") or (inspect.getdoc(part) or "").split("\n\n")[0]
        return " ".join(description.split())

    def accepts(self, part: object) -> bool:
        """Return whether an object is a class of this registry's kind."""
        return inspect.isclass(part) and issubclass(part, self.base)

    def register(self, part: type[T], path: Path | None = None) -> type[T]:
        """Add a class and return it, so that this can be used as a decorator.

        Registering a class again has no effect. A class replaces an earlier one of the same
        qualified name that was registered from Python, as when a notebook's cell is run again.

        Args:
            part: Class to register under its `name`.
            path: Plugin file that contains it; None for a class from Python.

        Raises:
            InputError: The class is of another kind, or its name is taken or not usable in tables,
                files and command lines.
        """
        source = f"plugin {path}: " if path else ""
        if not self.accepts(part) or inspect.isabstract(part):
            expected = f"a complete subclass of {self.base.__name__}"
            raise InputError(f"{source}{self.kind}: expected {expected}, found {part!r:.80}")
        name = _name_of(part, source)
        if self._is_registered(name, part):
            return part
        # The loaded class replaces the stub of the same file.
        if name in self._stubs and self._stubs[name].path == path:
            del self._stubs[name]
        if name in self.names() and not self._may_replace(name, part, path):
            raise InputError(f"{source}{self.kind} '{name}' exists already; give it another name")
        self._added[name] = AddedPart(part, path)
        return part

    def announce(self, part: type[T], path: Path | None) -> None:
        """Register a stub for a class whose code is not loaded into this process.

        The code of a plugin runs in isolation, in another process. The stub stands for its class
        here: it has the name and the declared attributes, but none of the code.

        Args:
            part: Stub class with the known attributes.
            path: Plugin file of the class; None for a class of an installed package, which is
                replaced.

        Raises:
            InputError: The name is taken or not usable.
        """
        source = f"plugin {path}: " if path else ""
        name = _name_of(part, source)
        existing = self._stubs.get(name) or self._added.get(name)
        # A stub may be announced again for the same file. For a class of an installed package
        # (without a path), the stub takes precedence over the entry point of that name.
        is_taken = existing is not None and existing.path != path
        if is_taken or (path is not None and name in self._entry_points):
            raise InputError(f"{source}{self.kind} '{name}' exists already; give it another name")
        self._stubs[name] = AddedPart(part, path)

    def entry(self, name: str) -> str | None:
        """Return the ``module:class`` of an installed part; None if no package has this name."""
        return self._entry_points[name].value if name in self._entry_points else None

    def place(self, name: str) -> Path | None:
        """Return the plugin file of a loaded part or stub; None if it is not from a file."""
        registered = self._added.get(name) or self._stubs.get(name)
        return registered.path if registered else None

    def _is_registered(self, name: str, part: type[T]) -> bool:
        """Return whether this class is registered under the name.

        Args:
            name: name of the part.
            part: the class.
        """
        if name in self._added:
            return self._added[name].part is part
        return name in self._entry_points and self._entry_points[name].value == ":".join(
            _get_qualified_name(part)
        )

    def _may_replace(self, name: str, part: type[T], path: Path | None) -> bool:
        """Return whether the registered class is an earlier version of this class.

        Args:
            name: registered name.
            part: the new class.
            path: its plugin file; None for a class from Python.
        """
        old = self._added.get(name)
        # Only classes from Python: files of the same name in two folders give equal qualified
        # names.
        if old is None or old.path is not None or path is not None:
            return False
        return _get_qualified_name(old.part) == _get_qualified_name(part)

    def paths(self) -> set[Path]:
        """Return the plugin files of all loaded parts."""
        return {
            registered.path for registered in self._added.values() if registered.path is not None
        }

    def snapshot(self) -> Mapping[str, AddedPart[T]]:
        """Return the parts added at run time by name, for `restore`."""
        return MappingProxyType(dict(self._added))

    def restore(self, snapshot: Mapping[str, AddedPart[T]]) -> None:
        """Restore the added parts of a snapshot, and remove later parts and all stubs."""
        self._added = dict(snapshot)
        self._stubs = {}


def _get_qualified_name(part: type) -> tuple[str, str]:
    return part.__module__, part.__qualname__


def _name_of(part: type, source: str) -> str:
    """Check the declaration of a class, and return its name.

    A name is part of commands and files, so it must be plain.

    Args:
        part: Class to register.
        source: Beginning of the message.

    Raises:
        InputError: The class has no name, or one that is not usable.
    """
    name = getattr(part, "name", None)
    if not (isinstance(name, str) and _NAME.match(name)):
        raise InputError(
            f"{source}class {part.__name__}: expected name = 'plain_name', found {name!r:.80}"
        )
    requires = getattr(part, "requires", ())
    if not (isinstance(requires, tuple | list) and all(isinstance(r, str) for r in requires)):
        raise InputError(f"{source}class {part.__name__}: expected requires = ('package', ...)")
    return name
