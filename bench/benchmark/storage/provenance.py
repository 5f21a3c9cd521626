"""Provenance of results: versions, machine, and the settings of an explanation."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import shlex
import sys
from collections.abc import Iterable, Mapping
from datetime import datetime, timezone
from importlib.metadata import Distribution, distributions
from pathlib import Path
from typing import Any

from bench import __version__
from sims.core.files import write_atomically

ENVIRONMENT_FILE = "environment.json"
_METADATA_FIELD = re.compile("(Name|Version): ")
"""Lines of a package's metadata with its name and version."""


def describe_machine() -> dict[str, Any]:
    """Describe Python and the machine."""
    return {
        "python": sys.version,
        "platform": platform.platform(),
        "machine": platform.machine(),
        "processors": os.cpu_count(),
    }


def list_package_versions() -> dict[str, str]:
    """List the version of every installed package, by name."""
    return dict(sorted(_name_and_version(distribution) for distribution in distributions()))


def _name_and_version(distribution: Distribution) -> tuple[str, str]:
    """Read name and version of a package from the head of its metadata.

    Only the part before the first empty line is read, because parsing all of it takes 20 times as
    long. If name or version is not found there, the slow way is used.
    """
    text = distribution.read_text("METADATA") or distribution.read_text("PKG-INFO") or ""
    lines = text.partition("\n\n")[0].splitlines()
    head = dict(line.split(": ", 1) for line in lines if _METADATA_FIELD.match(line))
    if {"Name", "Version"} <= head.keys():
        return head["Name"], head["Version"]
    return distribution.metadata["Name"], distribution.version


def get_utc_time() -> str:
    """Return the present time in UTC."""
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


def format_explain_command(recordings: Iterable[object], settings: Mapping[str, Any]) -> list[str]:
    """Return the words of the command that explains recordings.

    Args:
        recordings: Paths of their tables.
        settings: Options of `simgap explain` by name; unset options are left out.
    """
    words = ["simgap", "explain", *map(str, recordings)]
    for name, value in settings.items():
        if value is True:
            words.append(f"--{name}")
        elif isinstance(value, (list, tuple)):
            # An option that can be given several times.
            words += [word for argument in value for word in (f"--{name}", str(argument))]
        elif value not in (None, False, ""):
            words += [f"--{name}", str(value)]
    return words


def read_explain_command(folder: Path) -> str:
    """Read the command that repeats an explanation from the record in its folder.

    Args:
        folder: Folder of an explanation, with the record of its settings and recordings.

    Returns:
        Command line for a shell.
    """
    environment = read_environment(folder)
    # The descriptions of recordings (.toml) are listed too, but are not arguments of the command.
    tables = [
        recording["file"]
        for recording in environment.get("recordings", [])
        if not recording["file"].endswith(".toml")
    ]
    words = format_explain_command(tables or ["RECORDING.csv"], environment.get("settings", {}))
    return shlex.join(words)


def write_explanation_environment(
    folder: Path, started: str, settings: Mapping[str, Any], recordings: Iterable[Path]
) -> Path:
    """Write the provenance of an explanation to its folder: data, options, machine and packages.

    With it, a result can be reproduced, and doubted if something has changed.

    Args:
        folder: Folder of the explanation.
        started: Time of the start, UTC.
        settings: Options of `simgap explain` by name.
        recordings: Paths of the tables; their descriptions are included if they exist.

    Returns:
        Path of environment.json.
    """
    environment = {
        "simgap": __version__,
        "command": "explain",
        "settings": {key: value for key, value in settings.items() if value not in (None, [], "")},
        "recordings": [
            {"file": path.name, "sha256": compute_sha256(path)}
            for table in recordings
            # Without duplicates, since a "table" may itself be a .toml file.
            for path in dict.fromkeys([table, table.with_suffix(".toml")])
            if path.is_file()
        ],
        "started": started,
        **describe_machine(),
        "packages": list_package_versions(),
    }
    path = folder / ENVIRONMENT_FILE
    write_atomically(path, json.dumps(environment, indent=1, default=str) + "\n")
    return path


def read_environment(folder: Path) -> dict[str, Any]:
    """Read environment.json; return an empty dict if there is none, as for old explanations."""
    try:
        environment = json.loads((folder / ENVIRONMENT_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return environment if isinstance(environment, dict) else {}


def compute_sha256(path: Path) -> str:
    """Compute the SHA-256 hash of a file."""
    with path.open("rb") as file:
        digest = hashlib.sha256()
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
