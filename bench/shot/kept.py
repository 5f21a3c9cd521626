"""Stored result of each shot: a file with the tuned model and the outcome of every method."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bench.shot.deal import Deal
from bench.shot.settings import Settings
from bench.shot.throw import thrown
from bench.store.cells import CellError, columns_of, of_python
from bench.store.cells import check as check_cells
from bench.store.schema import MODEL, Column, Columns
from bench.store.schema import SHOTS as SHOT_COLUMNS
from sims.base import InputError
from sims.files import write

SHOTS = "shots"
"""Name of the folder of finished shots, in the folder of a study."""
_REMEDY = "damaged; delete it, and resume to make it again"
_NUMBERS = ("height", "margin", "restitution", "seconds")
"""Numbers of a model that may be missing."""


def path_of(folder: Path, dealt: Deal) -> Path:
    """Return the file of a shot; it exists once the shot has been executed.

    Args:
        folder: result folder of the study.
        dealt: the shot.
    """
    return folder / SHOTS / f"{dealt.name}.json"


def missing(folder: Path, dealt: Sequence[Deal]) -> list[Deal]:
    """List the shots that have not been executed.

    Args:
        folder: result folder of the study.
        dealt: all shots.
    """
    return [one for one in dealt if not path_of(folder, one).exists()]


def keep(
    folder: Path, dealt: Deal, settings: Settings, models: list[dict[str, Any]], seen: float
) -> None:
    """Execute a shot with the model of every method, and store the result atomically.

    Args:
        folder: result folder of the study.
        dealt: ball, scene and release error.
        settings: the [shot] table of the study.
        models: models as returned by `bench.shot.tune.models`.
        seen: fraction of the drop's sample times at which its recording has a height.
    """
    rows = [{**row, "seen": seen} for row in thrown(dealt, settings, models)]
    document = _plain({"models": models, "rows": rows})
    write(path_of(folder, dealt), json.dumps(document, indent=1, allow_nan=False) + "\n")


def read(folder: Path, dealt: Deal) -> dict[str, Any] | None:
    """Read the stored result of a shot; return None if the shot has not been executed.

    Args:
        folder: result folder of the study.
        dealt: the shot.

    Raises:
        InputError: the file is damaged.
    """
    path = path_of(folder, dealt)
    if not path.exists():
        return None
    try:
        kept: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        _check(kept, "models", MODEL)
        _check(kept, "rows", tuple(c for c in SHOT_COLUMNS if c.required))
    except CellError as error:
        raise InputError(f"{path}, {error.says}; {_REMEDY}") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise InputError(f"{path}: {_REMEDY}") from None
    wanted = (dealt.name, [model["method"] for model in kept["models"]])
    found = {row["shot"] for row in kept["rows"]}, [row["method"] for row in kept["rows"]]
    if found != ({wanted[0]}, wanted[1]):
        says = f"expected a row of {wanted[0]} for each model, found others"
        raise InputError(f"{path}: {says}; {_REMEDY}")
    for model in kept["models"]:
        # JSON has no NaN, so missing numbers are stored as null.
        model.update({name: math.nan for name in _NUMBERS if model[name] is None})
    return kept


def check(folder: Path, dealt: Sequence[Deal]) -> None:
    """Validate the stored results of shots.

    Args:
        folder: result folder of the study.
        dealt: the shots.

    Raises:
        InputError: a file is damaged.
    """
    for one in dealt:
        read(folder, one)


def _check(kept: dict[str, Any], name: str, columns: Columns) -> None:
    """Validate the models or the rows of a shot.

    Raises:
        CellError: a value does not match its declaration.
        KeyError: the part is missing.
        TypeError: the part is not a list of tables.
    """
    tables = kept[name]
    try:
        for row, table in enumerate(tables):
            columns_of(list(table), columns, row)
            if name == "models":
                _check_effects(row, table["effects"])
        for column in columns:
            check_cells(column, of_python(column, [table[column.name] for table in tables]))
    except CellError as error:
        error.says = f"{name}, {(error.row or 0) + 1}: {error.says}"
        raise


def _check_effects(row: int, effects: Any) -> None:
    """Validate the coefficients of a model's effects."""
    coefficient = Column("effects", float)
    for values in effects.values():
        try:
            check_cells(coefficient, of_python(coefficient, values))
        except CellError as error:
            error.row = row
            raise


def _plain(value: Any) -> Any:
    """Convert a value for JSON: numbers that are not finite become null."""
    if isinstance(value, dict):
        return {key: _plain(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
