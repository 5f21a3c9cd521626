"""One experiment file for several experiments: lists of values that it sweeps over."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from itertools import product
from math import prod
from pathlib import Path
from typing import Any

from sims.base import InputError
from sims.user_toml import fault

_UNFIT = re.compile(r"[^\w.+-]+")
"""What a folder's name, and a command line without quotes, could not hold."""
MOST = 10_000
"""Experiments of one file; each has a folder of its own, and all are checked before the first."""


def documents(
    path: Path, document: Mapping[str, Any], swept: Mapping[str, Sequence[Any]]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Every combination of the values, the last key's changing fastest.

    Args:
        path: of the file, for messages.
        document: the experiment's tables without a sweep.
        swept: values by key; a key within a table is joined by dots.

    Yields:
        The label, as ``budget=10,noise.x=0.1``, and the tables with these values in their places.

    Raises:
        InputError: a key without values, or values that one label would stand for.
    """
    count = prod(len(values) for values in swept.values())
    if count > MOST:
        raise InputError(
            f"{path}: sweep: expected at most {MOST:,} experiments, found {count:.3g} combinations;"
            " sweep over fewer values, or divide the file"
        )
    for key, values in swept.items():
        _check(path, f"sweep.{key}", values)
    for values in product(*swept.values()):
        # Tables within the document are changed, and every combination begins with the file's.
        changed = deepcopy(dict(document))
        parts = []
        for key, value in zip(swept, values, strict=True):
            _put(path, changed, key, value)
            parts.append(f"{key}={_text(path, key, value)}")
        yield ",".join(parts), changed


def _check(path: Path, where: str, values: Sequence[Any]) -> None:
    if not values:
        raise fault(path, where, "at least one value", values)
    texts = [_text(path, where, value) for value in values]
    for text in texts:
        if texts.count(text) > 1:  # two experiments would share one folder
            raise InputError(f"{path}: {where}: {text} stands twice")


def _text(path: Path, where: str, value: Any) -> str:
    """A value as it stands in a label."""
    if isinstance(value, dict):
        raise fault(path, where, "texts, numbers, bools or lists of them", value)
    if isinstance(value, list | tuple):
        return "_".join(_text(path, where, item) for item in value)
    if isinstance(value, bool):  # as TOML writes it
        return str(value).lower()
    return _UNFIT.sub("-", str(value))


def _put(path: Path, document: dict[str, Any], key: str, value: Any) -> None:
    """Put a value in the place that a key joined by dots names."""
    table, rest = document, key
    while (name := _first(table, rest)) != rest:
        table, rest = table.setdefault(name, {}), rest[len(name) + 1 :]
        if not isinstance(table, dict):
            raise InputError(f"{path}: sweep.{key}: {name} is no table, and has nothing in it")
    table[rest] = value


def _first(table: Mapping[str, Any], key: str) -> str:
    """The part of a key that names an entry of the table; effects have names with dots in them."""
    there = [name for name in table if key == name or key.startswith(f"{name}.")]
    # What is not there is a table to be made, or a key that the checks will refuse.
    return max(there, key=len, default=key.partition(".")[0])
