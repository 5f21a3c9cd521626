"""Registered parts of one kind, by name: the project's own, installed plugins' and those added
while the program runs.

Installed parts come through an entry-point group and are imported only when asked for. What cannot
be imported is listed as skipped, with the reason. Files and notebooks add theirs with `register`.
"""

from __future__ import annotations

import importlib.util
import inspect
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import MappingProxyType
from typing import Any, Generic, TypeVar

from sims.base import InputError, unknown

T = TypeVar("T")

_NAME = re.compile(r"[A-Za-z0-9][\w.+-]{0,60}$")
"""What tables, file names and command lines can hold."""


class SkippedError(InputError):
    """A registered part cannot be used here.

    Attributes:
        reason: why, without the part's name; the message has both.
    """

    def __init__(self, kind: str, name: str, reason: str) -> None:
        super().__init__(f"{kind} {name} cannot be used here: {reason}")
        self.reason = str(InputError(reason))
        self._given = kind, name, reason

    def __reduce__(self) -> tuple[type[SkippedError], tuple[str, str, str]]:
        # Worker processes hand errors over pickled, which calls the class with the message alone.
        return SkippedError, self._given


@dataclass(frozen=True)
class Added(Generic[T]):
    """A part that no installed package brings, and the file that it stands in; None for a class
    from Python.
    """

    part: type[T]
    path: Path | None


class Registry(Generic[T]):
    """The registered parts of one kind.

    Args:
        kind: what a message calls one of them, e.g. ``tuner``.
        group: the entry-point group of installed ones.
        base: the class they are derived from.
    """

    def __init__(self, kind: str, group: str, base: type[T]) -> None:
        self.kind, self.group, self.base = kind, group, base
        self._added: dict[str, Added[T]] = {}
        self._announced: dict[str, Added[T]] = {}
        self._imported: dict[str, Any] = {}

    @cached_property
    def _entries(self) -> Mapping[str, EntryPoint]:
        return {entry.name: entry for entry in entry_points(group=self.group)}

    def names(self) -> list[str]:
        """All registered names, sorted."""
        return sorted({*self._entries, *self._announced, *self._added})

    def get(self, name: str) -> type[T]:
        """The class registered as `name`.

        Raises:
            InputError: no such name.
            SkippedError: it cannot be imported or lacks a package.
        """
        if name in self._added:
            part: Any = self._added[name].part
        elif name in self._announced:
            part = self._announced[name].part
        elif name in self._entries:
            part = self._installed(name)
        else:
            error = unknown(self.kind, name, self.names())
            raise InputError(f"{error}; one of your own needs its file: --plugin FILE.py")
        # Looked for each time: a package may be installed while a notebook is open.
        requires = getattr(part, "requires", ())
        missing = [package for package in requires if importlib.util.find_spec(package) is None]
        if missing:
            packages = ", ".join(missing)
            remedy = f"pip install {' '.join(missing)}"
            raise SkippedError(self.kind, name, f"needs {packages}, not installed ({remedy})")
        result: type[T] = part
        return result

    def _installed(self, name: str) -> Any:
        """What the entry point `name` leads to, imported once."""
        if name not in self._imported:
            try:
                part = self._entries[name].load()
            except Exception as error:  # a plugin may fail in any way while it is imported
                reason = f"{type(error).__name__}: {error}"
                raise SkippedError(self.kind, name, reason) from error
            if not self.accepts(part):
                reason = f"expected a {self.base.__name__}, found {part!r:.80}"
                raise SkippedError(self.kind, name, reason)
            self._imported[name] = part
        return self._imported[name]

    def describe(self, name: str) -> str:
        """One line for a list: what it is, or why it is skipped."""
        try:
            part = self.get(name)
        except SkippedError as error:
            return f"skipped: {error.reason}"
        says = getattr(part, "says", "") or (inspect.getdoc(part) or "").split("\n\n")[0]
        return " ".join(says.split())

    def accepts(self, part: object) -> bool:
        """Whether this is a class of this registry's kind."""
        return inspect.isclass(part) and issubclass(part, self.base)

    def register(self, part: type[T], path: Path | None = None) -> type[T]:
        """Add a class; returns it, so that this serves as a decorator.

        Registering a class again changes nothing. A class of the same qualified name takes the
        place of one that was registered from Python: a notebook's cell was run again.

        Args:
            part: the class; registered under its `name`.
            path: the plugin file that it stands in, if it does in one.

        Raises:
            InputError: it is of another kind, its name is taken or none that tables, files and
                command lines can hold.
        """
        where = f"plugin {path}: " if path else ""
        if not self.accepts(part) or inspect.isabstract(part):
            wanted = f"a complete subclass of {self.base.__name__}"
            raise InputError(f"{where}{self.kind}: expected {wanted}, found {part!r:.80}")
        name = _name_of(part, where)
        if self._holds(name, part):
            return part
        # What was known of the file's part is known better now.
        if name in self._announced and self._announced[name].path == path:
            del self._announced[name]
        if name in self.names() and not self._may_replace(name, part, path):
            raise InputError(f"{where}{self.kind} '{name}' exists already; give it another name")
        self._added[name] = Added(part, path)
        return part

    def announce(self, part: type[T], path: Path | None) -> None:
        """Let a name stand for a class whose code is not loaded into this process.

        Args:
            part: what is known of it, as a class.
            path: its plugin file; None where an installed package has it, whose place it takes.

        Raises:
            InputError: its name is taken or cannot be used.
        """
        where = f"plugin {path}: " if path else ""
        name = _name_of(part, where)
        other = self._announced.get(name) or self._added.get(name)
        taken = other is not None and other.path != path
        if taken or (path is not None and name in self._entries):
            raise InputError(f"{where}{self.kind} '{name}' exists already; give it another name")
        self._announced[name] = Added(part, path)

    def entry(self, name: str) -> str | None:
        """The ``module:class`` of an installed part; None where no package has one of that name."""
        return self._entries[name].value if name in self._entries else None

    def place(self, name: str) -> Path | None:
        """The plugin file of a part that came from one, loaded or only announced."""
        added = self._added.get(name) or self._announced.get(name)
        return added.path if added else None

    def _holds(self, name: str, part: type[T]) -> bool:
        """Whether the name stands for this very class."""
        if name in self._added:
            return self._added[name].part is part
        return name in self._entries and self._entries[name].value == ":".join(_qualified(part))

    def _may_replace(self, name: str, part: type[T], path: Path | None) -> bool:
        """Whether what stands under the name is an earlier state of the class."""
        old = self._added.get(name)
        # Not so with files: two of one name in two folders give their classes one qualified name.
        from_python = old is not None and old.path is None and path is None
        return old is not None and from_python and _qualified(old.part) == _qualified(part)

    def paths(self) -> set[Path]:
        """The plugin files of all parts that came from one."""
        return {added.path for added in self._added.values() if added.path is not None}

    def snapshot(self) -> Mapping[str, Added[T]]:
        """What has been added beside the installed parts, by name; for `restore`."""
        return MappingProxyType(dict(self._added))

    def restore(self, snapshot: Mapping[str, Added[T]]) -> None:
        """Forget what has been added since the snapshot, and take back what has been lost."""
        self._added = dict(snapshot)
        self._announced = {}


def _qualified(part: type) -> tuple[str, str]:
    return part.__module__, part.__qualname__


def _name_of(part: type, where: str) -> str:
    """The name under which a class registers, its declaration checked.

    Raises:
        InputError: it has none, or one that cannot be used; `where` begins the message.
    """
    name = getattr(part, "name", None)
    if not (isinstance(name, str) and _NAME.match(name)):
        raise InputError(
            f"{where}class {part.__name__}: expected name = 'plain_name', found {name!r:.80}"
        )
    requires = getattr(part, "requires", ())
    if not (isinstance(requires, tuple | list) and all(isinstance(r, str) for r in requires)):
        raise InputError(f"{where}class {part.__name__}: expected requires = ('package', ...)")
    return name
