"""Version of a benchmark suite: a changed problem needs a new version.

A suite is an experiment file that names its problems with their hashes. A hash covers everything in
the problem's file that determines its results, and the model and the recording in its folder.
Words, and the numbers that the suite states for all its problems, are not hashed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from sims.core.simulator import InputError
from sims.core.toml_validation import read_toml

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
    """Yield the model file and the recording, if they come with the project or the problem."""
    model = str(tables.get("model", ""))
    if model.startswith(_OWN_PACKAGE):
        yield Path(str(resources.files("bench").joinpath(model.removeprefix(_OWN_PACKAGE))))
    elif model and (path.parent / model).is_file():
        yield path.parent / model
    recording = str(tables.get("recording", {}).get("path", ""))
    if recording and (path.parent / recording).is_file():
        yield path.parent / recording
        yield (path.parent / recording).with_suffix(".toml")


def check_problem_hash(
    suite: str, expected: Mapping[str, str], name: str, computed_hash: str
) -> None:
    """Raise an error if a problem is not the one that belongs to a suite's version.

    Args:
        suite: name and version of the suite.
        expected: hashes by name of the suite's problems.
        name: name of the problem.
        computed_hash: its hash.

    Raises:
        InputError: the hash is another one, or the suite states none.
    """
    if expected.get(name) != computed_hash:
        raise InputError(
            f"suite {suite}: problem {name} has the hash {computed_hash}, expected "
            f"{expected.get(name, 'one in [problem_hashes]')}; a changed problem needs a new "
            'version: raise the number in suite = "..." and write the new hash'
        )
