"""Checks of the tables of a user's TOML file: each fault is one line that names file, key, expected
and found.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sims.base import InputError, unknown


def pair(path: Path, where: str, value: Any) -> tuple[float, float]:
    """`value` as an increasing pair of numbers."""
    if len(value) != 2:
        raise InputError(f"{path}: {where}: expected [low, high], found {value!r}")
    low, high = (float(checked(path, where, v, (int, float))) for v in value)
    if not low < high:
        raise InputError(f"{path}: {where}: expected low < high, found {value!r}")
    return low, high


def table_of(
    path: Path, where: str, value: Any, types: Mapping[str, type | tuple[type, ...]]
) -> dict[str, Any]:
    """`value` as a table whose entries are among `types`, and of these types."""
    for key, found in checked(path, where, value, dict).items():
        if key not in types:
            raise unknown(f"entry of [{where}] in {path}", key, list(types))
        checked(path, f"{where}.{key}", found, types[key])
    return dict(value)


def checked(path: Path, where: str, value: Any, types: type | tuple[type, ...]) -> Any:
    """`value`, if it is of one of these types.

    Raises:
        InputError: it is not.
    """
    kinds = types if isinstance(types, tuple) else (types,)
    if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
        wanted = {
            str: "text",
            int: "a whole number",
            float: "a number",
            dict: "a table",
            list: "a list",
            bool: "a bool",
        }
        raise InputError(f"{path}: {where}: expected {wanted[kinds[-1]]}, found {value!r}")
    return value
