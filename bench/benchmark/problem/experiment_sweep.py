"""Expand an experiment file that sweeps over lists of values."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from itertools import product
from math import prod
from pathlib import Path
from typing import Any

from sims.core.simulator import InputError
from sims.core.toml_validation import make_error

_INVALID_CHARACTERS = re.compile(r"[^\w.+-]+")
"""Characters that are not valid in folder names and in command lines without quotes."""
MAX_EXPERIMENTS = 10_000
"""Maximum number of experiments of one file.

Each one has its own folder, and all are checked before the first run.
"""


def expand_documents(
    path: Path, document: Mapping[str, Any], swept: Mapping[str, Sequence[Any]]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Iterate over all combinations of the values; those of the last key change fastest.

    Args:
        path: experiment file, for messages.
        document: tables of the experiment without a sweep.
        swept: values by key; a key within a table is joined by dots.

    Yields:
        The label, as ``budget=10,noise.x=0.1``, and the tables with these values inserted.

    Raises:
        InputError: a key has no values, two values have the same label, or there are too many
            combinations.
    """
    count = prod(len(values) for values in swept.values())
    if count > MAX_EXPERIMENTS:
        raise InputError(
            f"{path}: sweep: expected at most {MAX_EXPERIMENTS:,} experiments, "
            f"found {count:.3g} combinations; sweep over fewer values, or divide the file"
        )
    for key, values in swept.items():
        _check_sweep_values(path, f"sweep.{key}", values)
    for values in product(*swept.values()):
        # A copy is needed, because tables within the document are changed.
        changed = deepcopy(dict(document))
        parts = []
        for key, value in zip(swept, values, strict=True):
            _insert_value(path, changed, key, value)
            parts.append(f"{key}={_format_swept_value(path, key, value)}")
        yield ",".join(parts), changed


def _check_sweep_values(path: Path, key: str, values: Sequence[Any]) -> None:
    """Raise an error for a key of a sweep that has no values, or the same value twice.

    `key` is the key in the file, for the message.
    """
    if not values:
        raise make_error(path, key, "at least one value", values)
    texts = [_format_swept_value(path, key, value) for value in values]
    for text in texts:
        if texts.count(text) > 1:  # two experiments would share one folder
            raise InputError(f"{path}: {key}: {text} is given twice")


def _format_swept_value(path: Path, key: str, value: Any) -> str:
    """Return a swept value as text, for the name of its experiment and thus for its folder.

    Characters that do not fit into a folder name become hyphens.

    Raises:
        InputError: the value is a table.
    """
    if isinstance(value, dict):
        raise make_error(path, key, "strings, numbers, booleans or lists of them", value)
    if isinstance(value, list | tuple):
        return "_".join(_format_swept_value(path, key, item) for item in value)
    if isinstance(value, bool):  # as TOML writes it
        return str(value).lower()
    return _INVALID_CHARACTERS.sub("-", str(value))


def _insert_value(path: Path, document: dict[str, Any], key: str, value: Any) -> None:
    """Insert a value at the position that a key such as ``noise.q`` names; tables are created.

    Names that contain dots themselves are recognised if the table has them already.
    """
    table, remaining_key = document, key
    while (name := _get_first_key(table, remaining_key)) != remaining_key:
        table, remaining_key = table.setdefault(name, {}), remaining_key[len(name) + 1 :]
        if not isinstance(table, dict):
            raise InputError(f"{path}: sweep.{key}: {name} is not a table, so it has no entries")
    table[remaining_key] = value


def _get_first_key(table: Mapping[str, Any], key: str) -> str:
    """Return the part of a key that names an entry of the table; effect names can contain dots."""
    matching_names = [name for name in table if key == name or key.startswith(f"{name}.")]
    # A part that is not in the table is a new table, or a key that later checks refuse.
    return max(matching_names, key=len, default=key.partition(".")[0])
