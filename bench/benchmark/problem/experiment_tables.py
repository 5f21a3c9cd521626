"""Parse the tables of an experiment file: tuners, sweeps, named effects, and a suite's version.

A suite is an experiment file that names its problems with their hashes. A hash covers everything in
the problem's file that determines its results, and the model and the recording in its folder.
Words, and the numbers that the suite states for all its problems, are not hashed.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, field
from importlib import resources
from itertools import product
from math import prod
from pathlib import Path
from typing import Any

from sims import effects
from sims.core.simulator import InputError
from sims.core.toml_validation import check_entries, get_type_hints_of, make_error, read_toml


@dataclass(frozen=True)
class TunerEntry:
    """One tuner of a comparison: registered name, options, seeds and budget.

    Seeds and budget are given where they differ from those of the experiment. If `randomised`, the
    tuner trains with domain randomisation over the experiment's ``[nuisance]``.
    """

    label: str
    tuner: str
    options: Mapping[str, Any] = field(default_factory=dict)
    seeds: int | None = None
    budget: int | None = None
    randomised: bool = False

    def to_table(self) -> dict[str, Any]:
        """Return the entry as the table ``[tuners.LABEL]``."""
        table = {key: value for key, value in asdict(self).items() if value is not None}
        del table["label"]
        if not self.randomised:
            del table["randomised"]
        return table


def parse_entries(path: Path, value: Any) -> tuple[TunerEntry, ...]:
    """Parse the tuner entries of an experiment file, in the order of the file.

    Args:
        path: experiment file.
        value: value of the key ``tuners``: a table of tables by label, or a list of registered
            names and of tables that name their tuner.

    Raises:
        InputError: the value is not valid.
    """
    if isinstance(value, dict):
        tables = value.items()
        return tuple(
            _parse_tuner_table(path, f"tuners.{label}", label, table) for label, table in tables
        )
    if not isinstance(value, list):
        raise make_error(path, "tuners", "a list of names or a table for each tuner", value)
    entries: list[TunerEntry] = []
    for index, item in enumerate(value):
        entry = _parse_list_item(path, f"tuners[{index}]", item)
        # Tables and figures distinguish tuners by label; TOML keys cannot occur twice, list items
        # can.
        if entry.label in [listed_entry.label for listed_entry in entries]:
            problem = f"{entry.label} is listed twice; give one of them a label"
            raise InputError(f"{path}: tuners: {problem}")
        entries.append(entry)
    return tuple(entries)


def _parse_list_item(path: Path, key: str, item: Any) -> TunerEntry:
    """Parse one element of a list of tuners: a name, or a table with the key ``tuner``.

    The label, under which results are listed, is the key ``label``, or else the name of the tuner.

    Args:
        path: path of the experiment file, for messages.
        key: key of the list.
        item: the element.
    """
    if isinstance(item, str):
        return TunerEntry(item, item)
    if not isinstance(item, dict):
        raise make_error(path, key, "a name or a table", item)
    table = dict(item)  # a copy, so that the parsed document is not changed
    label = table.pop("label", table.get("tuner"))
    if not isinstance(label, str):
        raise make_error(path, key, 'a table with tuner = "NAME"', item)
    return _parse_tuner_table(path, key, label, table)


def _parse_tuner_table(path: Path, entry_key: str, label: str, value: Any) -> TunerEntry:
    """Parse the table of one tuner; a table without the key ``tuner`` uses its label as the name.

    Args:
        path: path of the experiment file, for messages.
        entry_key: key of the table in the file, for messages.
        label: label under which results are listed.
        value: the table.
    """
    # The keys of the table are the fields of `TunerEntry`, except for the label.
    hints = {key: hint for key, hint in get_type_hints_of(TunerEntry).items() if key != "label"}
    table = check_entries(path, entry_key, value, hints)
    for key in ("seeds", "budget"):
        if table.get(key, 1) < 1:
            raise make_error(path, f"{entry_key}.{key}", "at least 1", table[key])
    return TunerEntry(label, table.pop("tuner", label), **table)


_INVALID_CHARACTERS = re.compile(r"[^\w.+-]+")
"""Characters that are not valid in folder names and in command lines without quotes."""
MAX_EXPERIMENTS = 10_000
"""Maximum number of experiments of one file.

Each one has its own folder, and all are checked before the first run.
"""


def expand_documents(
    path: Path, document: Mapping[str, Any], swept: Mapping[str, Sequence[Any]]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Expand a sweep: yield the tables of an experiment for each combination of the swept values.

    The values of the last key change fastest.

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

    Args:
        path: path of the experiment file, for messages.
        key: key of the sweep.
        value: the value.

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

    Args:
        path: path of the experiment file, for messages.
        document: content of the file, changed in place.
        key: key with dots.
        value: the value.
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


_OWN_PACKAGE = "package://bench/"
"""Prefix of model files that come with the project."""


def compute_problem_hash(path: Path, ignored_keys: frozenset[str]) -> str:
    """Compute the hash of a problem of a suite.

    Args:
        path: experiment file of the problem.
        ignored_keys: keys of the file that do not belong to the problem.

    Returns:
        First 16 hexadecimal digits of the SHA-256.
    """
    tables = read_toml(path)
    definition = {key: value for key, value in tables.items() if key not in ignored_keys}
    # Line ends depend on the settings of a version-control system.
    files = [f.read_bytes().replace(b"\r\n", b"\n") for f in _list_referenced_files(path, tables)]
    return compute_hash(definition, *files)


def compute_hash(tables: Mapping[str, Any], *contents: bytes) -> str:
    """Compute the hash of tables and of the contents of files.

    Returns:
        First 16 hexadecimal digits of the SHA-256.
    """
    text = json.dumps(tables, sort_keys=True, default=list)
    return hashlib.sha256(b"".join([text.encode(), *contents])).hexdigest()[:16]


def _list_referenced_files(path: Path, tables: Mapping[str, Any]) -> Iterator[Path]:
    """Yield the model file and the recording, if they come with the project or the problem.

    Args:
        path: path of the problem's file.
        tables: its content.
    """
    model = str(tables.get("model", ""))
    if model.startswith(_OWN_PACKAGE):
        yield Path(str(resources.files("bench").joinpath(model.removeprefix(_OWN_PACKAGE))))
    elif model and (path.parent / model).is_file():
        yield path.parent / model
    recording = str(tables.get("recording", {}).get("path", ""))
    if recording and (path.parent / recording).is_file():
        yield path.parent / recording
        # The description of a recording is next to its table.
        yield (path.parent / recording).with_suffix(".toml")


def check_problem_hash(
    suite: str, expected: Mapping[str, str], name: str, computed_hash: str
) -> None:
    """Raise an error if a problem is not the one that belongs to a suite's version.

    Args:
        suite: name and version of the suite.
        expected: hash of each problem by its name, as the file of the suite states them.
        name: name of the problem.
        computed_hash: hash of the problem's present files.

    Raises:
        InputError: the hash is another one, or the suite states none.
    """
    if expected.get(name) != computed_hash:
        raise InputError(
            f"suite {suite}: problem {name} has the hash {computed_hash}, expected "
            f"{expected.get(name, 'one in [problem_hashes]')}; a changed problem needs a new "
            'version: raise the number in suite = "..." and write the new hash'
        )


def list_effect_names(*settings: Mapping[str, Any]) -> list[str]:
    """Return the sorted names of registered effects in ``effects`` and ``fixed`` of settings."""
    return sorted(find_named_effects(*settings) & set(effects.list_names()))


def find_named_effects(*settings: Mapping[str, Any]) -> set[str]:
    """Return all effect names in settings, also those that a plugin may define later.

    Args:
        settings: Settings of simulators: ``effects`` are names of effects whose coefficients are
            tuned, ``fixed`` has fixed coefficients by name of the effect.
    """
    names: set[str] = set()
    for table in settings:
        for key in ("effects", "fixed"):
            value = table.get(key, ())
            # Values of a wrong type are reported by the simulator.
            if isinstance(value, Mapping | Sequence) and not isinstance(value, str):
                # `viscous@elbow` is the effect `viscous` at one joint of a robot.
                names.update(name.partition("@")[0] for name in value if isinstance(name, str))
    return names
