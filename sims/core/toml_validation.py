"""Read a user's TOML file, and check its values with one-line errors.

An error names file, entry, expected and found value. Each check takes the source with which its
message begins (the path of the file, or a name), the entry in it (``noise.x``), and the value, and
returns the value as the program uses it.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import is_dataclass
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints, is_typeddict

from sims.core.files import require_file
from sims.core.number_limits import MAX_INTEGER, MAX_NUMBER
from sims.core.simulator import InputError, make_unknown_name_error
from sims.core.user_messages import MAX_TITLE_LENGTH, truncate_text

if sys.version_info >= (3, 11):
    import tomllib as tomllib  # re-exported for other modules
else:
    import tomli as tomllib


Source = Path | str
Range = tuple[float, float]
"""Lower and upper end of a range."""

_MAX_QUOTED_CHARACTERS = 40
"""Maximum number of characters of a user's value that a message quotes."""

_TYPE_DESCRIPTIONS: Mapping[type, str] = {
    str: "text",
    int: "a whole number",
    float: "a number",
    dict: "a table",
    list: "a list",
    bool: "a bool",
}
"""Description of each type in messages."""

_ACCEPTED_TYPES: Mapping[type, tuple[type, ...]] = {float: (int, float), list: (list, tuple)}
"""Types accepted instead of another: TOML integers as floats, tuples from Python as lists."""


def toml_text(text: str) -> str:
    """Format a text as a TOML string."""
    return json.dumps(text, ensure_ascii=False)


def toml_key(name: str) -> str:
    """Format a name as a TOML key.

    It is quoted if it contains characters other than ASCII letters, digits, ``_`` and ``-``.
    """
    characters = name.replace("_", "").replace("-", "")
    return name if characters.isascii() and characters.isalnum() else toml_text(name)


def to_toml_value(value: Any) -> Any:
    """Copy a value as plain dicts, lists and numbers, as TOML gives them.

    NumPy numbers become Python numbers, tuples become lists, and keys become text.
    """
    # The command line imports this module, and starts faster without NumPy.
    import numpy as np

    if isinstance(value, Mapping):
        return {str(key): to_toml_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_toml_value(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Raises:
        InputError: The file is missing, unreadable or not TOML.
    """
    require_file(path)
    try:
        # Editors on Windows begin a file with a byte order mark.
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        reason = f"{error.reason} at byte {error.start}"
        raise InputError(f"{path}: expected UTF-8 text ({reason})") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    try:
        return tomllib.loads(text)
    except ValueError as error:  # bad TOML, or an impossible date or number
        raise InputError(f"{path}: not valid TOML: {error}") from None
    except RecursionError:  # for example a file of brackets only
        raise InputError(f"{path}: not valid TOML: nested too deeply") from None


def format_value(value: object) -> str:
    """Format a value of a user's file for a message, truncated."""
    return truncate_text(repr(value), _MAX_QUOTED_CHARACTERS)


def make_error(source: Source, where: str, wanted: str, value: object) -> InputError:
    """Make the error for a value that is not as expected.

    Args:
        source: File or name with which the message begins.
        where: Entry of the value; empty for the whole file.
        wanted: Description of the expected value.
        value: Value that was found.
    """
    entry = f"{truncate_text(where, MAX_TITLE_LENGTH)}: " if where else ""
    return InputError(f"{source}: {entry}expected {wanted}, found {format_value(value)}")


def check_known_names(kind: str, given: Iterable[str], allowed: Iterable[str]) -> None:
    """Check that all names are among the allowed ones.

    Args:
        kind: Kind of the names and their place in messages, e.g. ``entry of [noise] in mine.toml``.
        given: Names that the user wrote.
        allowed: Allowed names.

    Raises:
        InputError: A name is not allowed.
    """
    names = list(allowed)
    for name in given:
        if name not in names:
            raise make_unknown_name_error(kind, name, names or ["none"])


def check_type(source: Source, where: str, value: Any, wanted: type, words: str = "") -> Any:
    """Check the type of a value, and the size of an integer; return the value unchanged.

    Integers are accepted as floats, and tuples as lists.

    Args:
        source: File or name with which the message begins.
        where: Entry of the value.
        value: Value from the file.
        wanted: Expected type.
        words: Description of the expected value; that of the type if empty.

    Raises:
        InputError: The value has another type, or is an integer of implausible size.
    """
    accepted_types = _ACCEPTED_TYPES.get(wanted, (wanted,))
    # In Python, booleans are integers.
    is_wrong_bool = isinstance(value, bool) and wanted is not bool
    if is_wrong_bool or not isinstance(value, accepted_types):
        raise make_error(source, where, words or _TYPE_DESCRIPTIONS[wanted], value)
    size: Any = value
    if wanted is int and not -MAX_INTEGER <= size <= MAX_INTEGER:  # TOML integers are unbounded
        raise make_error(
            source, where, f"{words or _TYPE_DESCRIPTIONS[int]} within ±{MAX_INTEGER:.0e}", value
        )
    return value


def check_table(source: Source, where: str, value: Any, words: str = "") -> dict[str, Any]:
    """Check that `value` is a table.

    Args:
        source: File or name with which the message begins.
        where: Entry of the value.
        value: Value from the file.
        words: Description of the expected value; the default one if empty.

    Raises:
        InputError: The value is not a table.
    """
    return dict(check_type(source, where, value, dict, words))


def get_subtable(source: Source, table: Mapping[str, Any], key: str) -> dict[str, Any]:
    """Return a table within a table of a file; an empty one if it is missing.

    Args:
        source: File or name with which the message begins.
        table: Table of the file.
        key: Key of the table in it.

    Raises:
        InputError: The value is no table.
    """
    return check_table(source, key, table.get(key, {}))


def check_text(
    source: Source, where: str, value: Any, words: str = "", max_length: int = MAX_TITLE_LENGTH
) -> str:
    """Check that `value` is a text of at most `max_length` characters.

    Args:
        source: File or name with which the message begins.
        where: Entry of the value.
        value: Value from the file.
        words: Description of the expected value; the default one if empty.
        max_length: Maximum number of characters.

    Raises:
        InputError: The value is not a text, or is too long.
    """
    text = str(check_type(source, where, value, str, words))
    if len(text) > max_length:
        raise make_error(source, where, f"at most {max_length} characters, not {len(text)}", value)
    return text


def check_name_list(
    source: Source, where: str, value: Any, words: str = "a list of names"
) -> tuple[str, ...]:
    """Check that `value` is a list of texts.

    Args:
        source: File or name with which the message begins.
        where: Entry of the value.
        value: Value from the file.
        words: Description of the expected value.

    Raises:
        InputError: The value is something else.
    """
    if not isinstance(value, list | tuple) or not all(isinstance(name, str) for name in value):
        raise make_error(source, where, words, value)
    return tuple(value)


def check_number(source: Source, where: str, value: Any, words: str = "") -> float:
    """Check that `value` is a number, which may be infinite or NaN (TOML has inf and nan).

    Args:
        source: File or name with which the message begins.
        where: Entry of the value.
        value: Value from the file.
        words: Description of the expected value; the default one if empty.

    Raises:
        InputError: The value is not a number.
    """
    try:
        return float(check_type(source, where, value, float, words))
    except OverflowError:  # TOML integers are unbounded
        raise make_error(source, where, words or _TYPE_DESCRIPTIONS[float], value) from None


def check_finite(source: Source, where: str, value: Any, words: str = "") -> float:
    """Check that `value` is a finite number of plausible size.

    Args:
        source: File or name with which the message begins.
        where: Entry of the value.
        value: Value from the file.
        words: Description of the expected value; the default one if empty.

    Raises:
        InputError: The value is not a finite number, or is too large.
    """
    result = check_number(source, where, value, words)
    if not math.isfinite(result):
        raise make_error(source, where, words or _TYPE_DESCRIPTIONS[float], value)
    if abs(result) > MAX_NUMBER:
        raise make_error(
            source, where, f"{words or _TYPE_DESCRIPTIONS[float]} within ±{MAX_NUMBER:g}", value
        )
    return result


def check_number_list(
    source: Source, where: str, value: Any, count: int, words: str = ""
) -> tuple[float, ...]:
    """Check that `value` is a list of `count` finite numbers.

    Args:
        source: File or name with which the message begins.
        where: Entry of the value.
        value: Value from the file.
        count: Required number of entries.
        words: Description of the expected value; the default one if empty.

    Raises:
        InputError: The value is something else.
    """
    if not isinstance(value, list | tuple) or len(value) != count:
        raise make_error(source, where, words or f"{count} numbers", value)
    return tuple(check_finite(source, where, entry) for entry in value)


def check_number_pair(source: Source, where: str, value: Any) -> Range:
    """Check that `value` is a list of two numbers in any order.

    Args:
        source: File or name with which the message begins.
        where: Entry of the value.
        value: Value from the file.

    Raises:
        InputError: The value is something else.
    """
    low, high = check_number_list(source, where, value, 2, "[low, high]")
    return low, high


def check_range(source: Source, where: str, value: Any) -> Range:
    """Check that `value` is a list of two increasing numbers.

    Args:
        source: File or name with which the message begins.
        where: Entry of the value.
        value: Value from the file.

    Raises:
        InputError: The value is something else.
    """
    low, high = check_number_pair(source, where, value)
    if not low < high:
        raise make_error(source, where, "low < high", value)
    return low, high


def check_annotation(source: Source, where: str, value: Any, declared: Any) -> Any:
    """Check a value, including its content, against a type annotation, and convert it.

    Args:
        source: File or name with which the message begins.
        where: Entry of the value.
        value: Value from the file.
        declared: Annotation: text, number, bool, pair of numbers, tuple of one type, mapping from
            names, or a dataclass or TypedDict of these; `None` in a union means that the entry may
            be missing.

    Raises:
        InputError: The value does not match.
    """
    origin, arguments = get_origin(declared), get_args(declared)
    if declared is Any:
        return value  # checked where it is used, for example settings by a simulator
    if origin in (Union, UnionType):
        return check_annotation(source, where, value, _choose_union_member(value, arguments))
    if declared == Range:  # before other tuples, which may have any length
        return check_range(source, where, value)
    if origin is tuple:  # of any length, with items of one type
        items = check_type(source, where, value, list)
        return tuple(check_annotation(source, where, item, arguments[0]) for item in items)
    if origin is not None:  # a mapping from names
        _, value_type = arguments
        return _check_table(source, where, value, value_type)
    if isinstance(declared, type) and is_dataclass(declared):
        return declared(**check_entries(source, where, value, get_type_hints_of(declared)))
    if is_typeddict(declared):
        return check_entries(source, where, value, get_type_hints_of(declared))
    if declared is float:
        return check_number(source, where, value)
    return check_type(source, where, value, declared)


def _check_table(source: Source, key_path: str, value: Any, declared: Any) -> dict[str, Any]:
    """Check a table with arbitrary names whose entries are all of one type.

    Args:
        source: beginning of error messages: path of the file, or a name.
        key_path: path of the entry in the file, such as ``noise``.
        value: value of the entry.
        declared: annotation of the values in the table.
    """
    result = {}
    for key, item in check_table(source, key_path, value).items():
        result[key] = check_annotation(source, f"{key_path}.{key}", item, declared)
    return result


def check_entries(
    source: Source, where: str, value: Any, hints: Mapping[str, Any]
) -> dict[str, Any]:
    """Check a table whose entries have the names and types of `hints`.

    Args:
        source: File or name with which the message begins.
        where: Entry of the table; empty for the whole file.
        value: Value from the file.
        hints: Type annotations by name.

    Raises:
        InputError: A name is unknown, or an entry has a wrong type.
    """
    table = check_table(source, where, value)
    # Check names first: an error about the type of an unknown key would be confusing.
    check_known_names(f"entry of [{where}] in {source}", table, hints)
    result = {}
    for key, item in table.items():
        place = f"{where}.{key}" if where else key
        checked_item = check_annotation(source, place, item, hints[key])
        # Keep integers, because hashes of runs and trained weights depend on what is written.
        result[key] = item if hints[key] is float else checked_item
    return result


@cache
def get_type_hints_of(kind: type) -> dict[str, Any]:
    """Return the fields of a dataclass or TypedDict with their types."""
    return get_type_hints(kind)


def _choose_union_member(value: Any, members: Sequence[Any]) -> Any:
    """Return the type of a union to check a value against: a tuple for a list, else the first.

    Args:
        value: the value.
        members: types of the union.
    """
    # TOML has no null: entries that may be None are left out.
    kinds = [kind for kind in members if kind is not NoneType]
    lists = [kind for kind in kinds if get_origin(kind) is tuple]
    return lists[0] if lists and isinstance(value, list | tuple) else kinds[0]


def join_nested_names(entries: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """Join the names of nested tables, where the joined names are those of signals.

    TOML reads unquoted dotted names as nested tables: ``[channels.q.elbow]`` is a table ``elbow``
    in a table ``q``. Here it becomes the entry ``q.elbow``.

    Args:
        entries: Entries as read from TOML.
        names: Names that may contain dots.

    Returns:
        The entries by their full names.
    """
    flat_table: dict[str, Any] = {}
    for name, value in entries.items():
        is_nested = isinstance(value, dict) and name not in names
        if is_nested and any(known_name.startswith(f"{name}.") for known_name in names):
            flat_entries = {f"{name}.{key}": entry for key, entry in value.items()}
            flat_table.update(join_nested_names(flat_entries, names))
        else:
            flat_table[name] = value
    return flat_table


def list_nested_names(tables: Mapping[str, Any]) -> list[str]:
    """List the names of channels in the tables of a description, of which some may be nested.

    TOML reads ``[channels.q.base.x]`` as tables within each other.
    """
    names = []
    for name, entry in tables.items():
        nested = (
            isinstance(entry, dict) and entry and all(isinstance(e, dict) for e in entry.values())
        )
        names += [f"{name}.{inner}" for inner in list_nested_names(entry)] if nested else [name]
    return names
