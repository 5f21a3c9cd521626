"""Checks of a user's TOML file: each fault is one line that names file, entry, expected and found.

Every check takes the source that its message begins with (the file's path, or what a person calls
the thing), where in it the value stands (``noise.x``), and the value; it returns the value as the
program uses it.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import is_dataclass
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints, is_typeddict

from sims.base import InputError, unknown
from sims.files import require_file
from sims.limits import LARGEST, LINE, MOST, cut

if sys.version_info >= (3, 11):
    import tomllib as tomllib  # others have it from here
else:
    import tomli as tomllib

Source = Path | str
Pair = tuple[float, float]
"""The lower and the upper end of a range."""

_LONGEST = 40
"""Characters of a user's value that a message quotes."""

_WORDS: Mapping[type, str] = {
    str: "text",
    int: "a whole number",
    float: "a number",
    dict: "a table",
    list: "a list",
    bool: "a bool",
}
"""What a message calls a value of each type."""

_WIDER: Mapping[type, tuple[type, ...]] = {float: (int, float), list: (list, tuple)}
"""Types that pass for another: a TOML number may have no point, a list from Python may be fixed."""


def toml_text(text: str) -> str:
    """Return a text as a string of TOML."""
    return json.dumps(text, ensure_ascii=False)


def toml_key(name: str) -> str:
    """Return a name as a key of TOML: in quotation marks if it has other characters than letters
    and digits of ASCII, ``_`` and ``-``.
    """
    bare = name.replace("_", "").replace("-", "")
    return name if bare.isascii() and bare.isalnum() else toml_text(name)


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        InputError: the file is missing, unreadable or not TOML.
    """
    require_file(path)
    try:
        # Editors on Windows begin a file with a byte order mark.
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        what = f"{error.reason} at byte {error.start}"
        raise InputError(f"{path}: expected UTF-8 text ({what})") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    try:
        return tomllib.loads(text)
    except ValueError as error:  # bad TOML, or a date or number that cannot be
        raise InputError(f"{path}: not valid TOML: {error}") from None
    except RecursionError:  # a file may be nothing but brackets
        raise InputError(f"{path}: not valid TOML: nested too deeply") from None


def shown(value: object) -> str:
    """A value from a user's file as a message quotes it: short."""
    return cut(repr(value), _LONGEST)


def fault(source: Source, where: str, wanted: str, value: object) -> InputError:
    """The error for a value that is not what is wanted; `where` may be empty."""
    place = f"{cut(where, LINE)}: " if where else ""  # a whole file has no place in itself
    return InputError(f"{source}: {place}expected {wanted}, found {shown(value)}")


def known(kind: str, given: Iterable[str], allowed: Iterable[str]) -> None:
    """Refuse names that are not among the allowed ones.

    Args:
        kind: what a message calls one of them, and where, e.g. ``entry of [noise] in mine.toml``.
        given: what the user wrote.
        allowed: what there is.
    """
    names = list(allowed)
    for name in given:
        if name not in names:
            raise unknown(kind, name, names or ["none"])


def checked(source: Source, where: str, value: Any, wanted: type, words: str = "") -> Any:
    """`value`, if it is of this type; any number will do where a float is wanted.

    Raises:
        InputError: it is not; `words` stand for what was expected, in place of the usual ones.
    """
    kinds = _WIDER.get(wanted, (wanted,))
    # Python counts true and false among the whole numbers.
    mistaken = isinstance(value, bool) and wanted is not bool
    if mistaken or not isinstance(value, kinds):
        raise fault(source, where, words or _WORDS[wanted], value)
    size: Any = value
    if wanted is int and not -MOST <= size <= MOST:  # TOML's whole numbers have no end
        raise fault(source, where, f"{words or _WORDS[int]} within ±{MOST:.0e}", value)
    return value


def table(source: Source, where: str, value: Any, words: str = "") -> dict[str, Any]:
    """`value` as a table."""
    return dict(checked(source, where, value, dict, words))


def text(source: Source, where: str, value: Any, words: str = "", most: int = LINE) -> str:
    """`value` as text of at most so many characters."""
    read = str(checked(source, where, value, str, words))
    if len(read) > most:
        raise fault(source, where, f"at most {most} characters, not {len(read)}", value)
    return read


def names(
    source: Source, where: str, value: Any, words: str = "a list of names"
) -> tuple[str, ...]:
    """`value` as a list of texts."""
    if not isinstance(value, list | tuple) or not all(isinstance(name, str) for name in value):
        raise fault(source, where, words, value)
    return tuple(value)


def number(source: Source, where: str, value: Any, words: str = "") -> float:
    """`value` as a number, which may be infinite or none (TOML writes inf and nan)."""
    try:
        return float(checked(source, where, value, float, words))
    except OverflowError:  # TOML's whole numbers have no end
        raise fault(source, where, words or _WORDS[float], value) from None


def finite(source: Source, where: str, value: Any, words: str = "") -> float:
    """`value` as a number that is finite, and of a size that can be meant."""
    result = number(source, where, value, words)
    if not math.isfinite(result):
        raise fault(source, where, words or _WORDS[float], value)
    if abs(result) > LARGEST:
        raise fault(source, where, f"{words or _WORDS[float]} within ±{LARGEST:g}", value)
    return result


def numbers(
    source: Source, where: str, value: Any, count: int, words: str = ""
) -> tuple[float, ...]:
    """`value` as a list of so many numbers."""
    if not isinstance(value, list | tuple) or len(value) != count:
        raise fault(source, where, words or f"{count} numbers", value)
    return tuple(finite(source, where, entry) for entry in value)


def ends(source: Source, where: str, value: Any) -> Pair:
    """`value` as two numbers, in whatever order."""
    low, high = numbers(source, where, value, 2, "[low, high]")
    return low, high


def pair(source: Source, where: str, value: Any) -> Pair:
    """`value` as two numbers that increase."""
    low, high = ends(source, where, value)
    if not low < high:
        raise fault(source, where, "low < high", value)
    return low, high


def as_declared(source: Source, where: str, value: Any, declared: Any) -> Any:
    """`value` as a type annotation asks for it, whatever is in it checked likewise.

    Args:
        source: what messages begin with.
        where: in it the value stands.
        value: from the file.
        declared: text, numbers, bools, pairs of numbers, tuples of one type, mappings from names, a
            dataclass or TypedDict of all these; `None` in a union is what a file leaves out.

    Raises:
        InputError: it is not.
    """
    origin, inner = get_origin(declared), get_args(declared)
    if declared is Any:
        return value  # whoever uses it checks it, as a simulator its settings
    if origin in (Union, UnionType):
        return as_declared(source, where, value, _chosen(value, inner))
    if declared == Pair:  # before other tuples: those may be of any length
        return pair(source, where, value)
    if origin is tuple:
        items = checked(source, where, value, list)
        return tuple(as_declared(source, where, item, inner[0]) for item in items)
    if origin is not None:
        return _mapping(source, where, value, inner[1])
    if isinstance(declared, type) and is_dataclass(declared):
        return declared(**entries(source, where, value, hints_of(declared)))
    if is_typeddict(declared):
        return entries(source, where, value, hints_of(declared))
    if declared is float:
        return number(source, where, value)
    return checked(source, where, value, declared)


def _mapping(source: Source, where: str, value: Any, declared: Any) -> dict[str, Any]:
    """A table whose entries have any names and are all of one type."""
    result = {}
    for key, item in table(source, where, value).items():
        result[key] = as_declared(source, f"{where}.{key}", item, declared)
    return result


def entries(
    source: Source, where: str, value: Any, hints: Mapping[str, Any], kind: str = ""
) -> dict[str, Any]:
    """`value` as a table whose entries are the names of `hints`, each as its hint asks for it.

    Args:
        source: what messages begin with.
        where: in it the table stands; empty for the whole of it.
        value: from the file.
        hints: type annotations by name.
        kind: what a message calls an entry of the table, and where.
    """
    given = table(source, where, value)
    # Names first: the type of a key that does not exist would be a riddle.
    known(kind or f"entry of [{where}] in {source}", given, hints)
    result = {}
    for key, item in given.items():
        place = f"{where}.{key}" if where else key
        read = as_declared(source, place, item, hints[key])
        # A whole number stays one: names of runs and of trained weights hash what is written.
        result[key] = item if hints[key] is float else read
    return result


@cache
def hints_of(kind: type) -> dict[str, Any]:
    """The fields of a dataclass or TypedDict with their types."""
    return get_type_hints(kind)


def _chosen(value: Any, among: Sequence[Any]) -> Any:
    """Which type of a union the value is checked against: a list against a pair, else the first."""
    # TOML has no null: what may be None is left out.
    kinds = [kind for kind in among if kind is not NoneType]
    lists = [kind for kind in kinds if get_origin(kind) is tuple]
    return lists[0] if lists and isinstance(value, list | tuple) else kinds[0]
