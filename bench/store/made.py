"""With what results were made: versions and machine, and of an explanation what was asked."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import sys
from collections.abc import Iterable, Mapping
from datetime import datetime, timezone
from importlib.metadata import Distribution, distributions
from pathlib import Path
from typing import Any

from bench import __version__
from sims.files import write

ENVIRONMENT = "environment.json"


def machine() -> dict[str, Any]:
    """Python and the machine."""
    return {
        "python": sys.version,
        "platform": platform.platform(),
        "machine": platform.machine(),
        "processors": os.cpu_count(),
    }


def packages() -> dict[str, str]:
    """List the version of every installed package, by name."""
    return dict(sorted(_name_and_version(each) for each in distributions()))


def _name_and_version(distribution: Distribution) -> tuple[str, str]:
    """Read both from the head of the metadata: parsing all of it takes 20 times as long."""
    text = distribution.read_text("METADATA") or distribution.read_text("PKG-INFO") or ""
    lines = text.partition("\n\n")[0].splitlines()
    head = dict(line.split(": ", 1) for line in lines if _FIELD.match(line))
    if {"Name", "Version"} <= head.keys():
        return head["Name"], head["Version"]
    return distribution.metadata["Name"], distribution.version


_FIELD = re.compile("(Name|Version): ")


def now() -> str:
    """The time, UTC."""
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


def explaining(recordings: Iterable[object], settings: Mapping[str, Any]) -> list[str]:
    """The words of the command that explains recordings.

    Args:
        recordings: their tables.
        settings: of `simgap explain`, by the names of its options; what is not set is left out.
    """
    words = ["simgap", "explain", *map(str, recordings)]
    for name, value in settings.items():
        if value is True:
            words.append(f"--{name}")
        elif isinstance(value, (list, tuple)):
            # An option that can be given several times.
            words += [word for one in value for word in (f"--{name}", str(one))]
        elif value not in (None, False, ""):
            words += [f"--{name}", str(value)]
    return words


def write_explained(
    folder: Path, started: str, settings: Mapping[str, Any], recordings: Iterable[Path]
) -> Path:
    """Write what an explanation was made with and of.

    Args:
        folder: the explanation's.
        started: time, UTC.
        settings: of `simgap explain`, by the names of its options.
        recordings: the tables; each stands with its description where there is one.
    """
    told = {
        "simgap": __version__,
        "command": "explain",
        "settings": {key: value for key, value in settings.items() if value not in (None, [], "")},
        "recordings": [
            {"file": path.name, "sha256": sha256(path)}
            for table in recordings
            for path in dict.fromkeys([table, table.with_suffix(".toml")])
            if path.is_file()
        ],
        "started": started,
        **machine(),
        "packages": packages(),
    }
    path = folder / ENVIRONMENT
    write(path, json.dumps(told, indent=1, default=str) + "\n")
    return path


def environment(folder: Path) -> dict[str, Any]:
    """What environment.json says; empty where there is none, as beside an older explanation."""
    try:
        told = json.loads((folder / ENVIRONMENT).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return told if isinstance(told, dict) else {}


def sha256(path: Path) -> str:
    """Of a file's content."""
    with path.open("rb") as file:
        digest = hashlib.sha256()
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
