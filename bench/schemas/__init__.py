"""JSON schemas of command output with ``--json`` and of the files that programs read.

Each is one file of JSON Schema, draft 2020-12. The schema of a command has the name of the command.

``error`` is the form of every command's faults; ``verdict``, ``table`` and ``run-status`` are those
of verdict.json, and of a row of table.csv and of status.csv.
"""

from __future__ import annotations

import json
from functools import cache
from importlib import resources
from typing import Any

from sims.core.simulator import make_unknown_name_error

_ENDING = ".schema.json"


def list_schema_names() -> list[str]:
    """Every schema's name, sorted."""
    files = [file.name for file in resources.files(__name__).iterdir()]
    return sorted(name.removesuffix(_ENDING) for name in files if name.endswith(_ENDING))


@cache
def _read(name: str) -> str:
    return resources.files(__name__).joinpath(f"{name}{_ENDING}").read_text(encoding="utf-8")


def load_schema(name: str) -> dict[str, Any]:
    """One of them.

    Raises:
        InputError: there is none of that name.
    """
    if name not in list_schema_names():
        raise make_unknown_name_error("schema", name, list_schema_names())
    found: dict[str, Any] = json.loads(_read(name))
    return found


def find_violations(document: Any, name: str) -> list[str]:
    """List the violations of a schema by a document, one line each, with its place.

    Raises:
        InputError: there is no schema of that name.
    """
    from jsonschema import Draft202012Validator
    from referencing import Registry, Resource

    # Schemas name each other by their files' names.
    known = [
        (f"{schema_name}{_ENDING}", Resource.from_contents(load_schema(schema_name)))
        for schema_name in list_schema_names()
    ]
    validator = Draft202012Validator(load_schema(name), registry=Registry().with_resources(known))
    found = sorted(validator.iter_errors(document), key=lambda error: error.json_path)
    return [f"{error.json_path}: {error.message}" for error in found]
