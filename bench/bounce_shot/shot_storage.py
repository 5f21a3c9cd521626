"""Store the outcome of each shot in a JSON file, and read and check the files."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bench.benchmark.storage.cell_validation import (
    CellError,
    check_cells,
    parse_json_column,
    select_declared_columns,
)
from bench.benchmark.storage.table_schemas import (
    SHOT_COLUMNS,
    SHOT_MODEL_COLUMNS,
    Columns,
    ColumnSpec,
)
from bench.bounce_shot.shot_config import ShotConfig
from bench.bounce_shot.shot_execution import ShotResult, execute_shot
from bench.bounce_shot.shot_planner import TunedModel
from bench.bounce_shot.shot_sampling import ShotSetup
from sims.core.files import write_atomically
from sims.core.json_documents import to_json_value
from sims.core.simulator import InputError


def _build_shot_row(setup: ShotSetup, model: TunedModel, result: ShotResult) -> dict[str, Any]:
    """Build the row of shots.csv for one method and shot.

    Lengths are in m. ``off`` is the signed distance along x from the hoop's centre, ``margin`` the
    distance to the rim of the hoop, positive inside it, and ``planned_margin`` the one that the
    model predicted. The last line of a traceback, which states the error, becomes the ``reason``.

    Args:
        setup: setup of the shot: its ball, drop, incline and hoop.
        model: tuned model with the plan.
        result: result of the executed shot.
    """
    effect_texts = [
        f"{name} {', '.join(f'{value:.4g}' for value in values)}"
        for name, values in model.effects.items()
    ]
    reason_lines = model.reason.strip().splitlines()
    return {
        "shot": setup.name,
        "ball": setup.name.rpartition("-")[0],  # the name is KIND-NUMBER
        "method": model.method,
        "hit": result.is_hit,
        "off": result.miss_distance,
        "margin": setup.scene.hoop_radius - abs(result.miss_distance),
        "planned_margin": model.margin,
        "prediction_error": result.prediction_error,
        "drop_height": model.height,
        "restitution": model.restitution,
        "true_restitution": setup.ball.restitution,
        "effects": "; ".join(effect_texts),
        "simulations": model.simulations,
        "seconds": model.seconds,
        "status": model.status,
        "reason": reason_lines[-1] if reason_lines else "",
    }


SHOTS_FOLDER = "shots"
"""Name of the folder of finished shots, in the folder of a study."""
_DAMAGE_ADVICE = "damaged; delete it, and resume to repeat it"
_COEFFICIENT = ColumnSpec("effects", float)
"""Declaration of a coefficient of an effect."""
_NULLABLE_NUMBERS = ("height", "margin", "restitution", "seconds")
"""Numbers of a model that may be missing."""


def get_shot_path(folder: Path, setup: ShotSetup) -> Path:
    """Return the file of a shot; it exists once the shot has been executed.

    Args:
        folder: result folder of the study.
        setup: setup of the shot: its ball, drop, incline and hoop.
    """
    return folder / SHOTS_FOLDER / f"{setup.name}.json"


def list_missing_shots(folder: Path, setups: Sequence[ShotSetup]) -> list[ShotSetup]:
    """List the shots that have not been executed.

    Args:
        folder: result folder of the study.
        setups: all shots.
    """
    return [setup for setup in setups if not get_shot_path(folder, setup).exists()]


def store_shot(
    folder: Path,
    setup: ShotSetup,
    settings: ShotConfig,
    models: Sequence[TunedModel],
    visible_share: float,
) -> None:
    """Execute a shot with the model of every method, and store the result atomically.

    Args:
        folder: result folder of the study.
        setup: ball, scene and release error.
        settings: the [shot] table of the study.
        models: models as returned by `bench.bounce_shot.drop_tuning.tune_and_plan`.
        visible_share: fraction of the drop's sample times at which its recording has a height.
    """
    rows = []
    for model in models:
        row = _build_shot_row(setup, model, execute_shot(setup, settings, model))
        rows.append({**row, "seen": visible_share})
    document = to_json_value({"models": [asdict(model) for model in models], "rows": rows})
    write_atomically(
        get_shot_path(folder, setup), json.dumps(document, indent=1, allow_nan=False) + "\n"
    )


def read_shot(folder: Path, setup: ShotSetup) -> dict[str, Any] | None:
    """Read the stored result of a shot; return None if the shot has not been executed.

    Args:
        folder: result folder of the study.
        setup: setup of the shot: its ball, drop, incline and hoop.

    Returns:
        ``models``, the tuned model of each method as a dictionary, and ``rows``, the row of
        shots.csv of each method, in the same order.

    Raises:
        InputError: the file is damaged.
    """
    path = get_shot_path(folder, setup)
    if not path.exists():
        return None
    try:
        document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        _validate_document(document, "models", SHOT_MODEL_COLUMNS)
        _validate_document(document, "rows", tuple(c for c in SHOT_COLUMNS if c.required))
    except CellError as error:
        raise InputError(f"{path}, {error.says}; {_DAMAGE_ADVICE}") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise InputError(f"{path}: {_DAMAGE_ADVICE}") from None
    methods = [model["method"] for model in document["models"]]
    shot_names = {row["shot"] for row in document["rows"]}
    if shot_names != {setup.name} or [row["method"] for row in document["rows"]] != methods:
        message = f"expected a row of {setup.name} for each model, found others"
        raise InputError(f"{path}: {message}; {_DAMAGE_ADVICE}")
    for model in document["models"]:
        # JSON has no NaN, so missing numbers are stored as null.
        model.update({name: math.nan for name in _NULLABLE_NUMBERS if model[name] is None})
    return document


def check_shots(folder: Path, setups: Sequence[ShotSetup]) -> None:
    """Validate the stored results of shots.

    Args:
        folder: result folder of the study.
        setups: the shots.

    Raises:
        InputError: a file is damaged.
    """
    for setup in setups:
        read_shot(folder, setup)


def _validate_document(document: dict[str, Any], name: str, columns: Columns) -> None:
    """Validate the models or the rows of a shot.

    Both are lists of tables with declared entries. A model also has the coefficients of its
    effects, by the name of the effect.

    Args:
        document: stored document of the shot.
        name: its part, ``models`` or ``rows``.
        columns: declarations of the entries.

    Raises:
        CellError: a value does not match its declaration; the message states part and number.
        KeyError: the part is missing.
        TypeError: the part is not a list of tables.
    """
    tables = document[name]
    try:
        for row, table in enumerate(tables):
            select_declared_columns(list(table), columns, row)
            if name == "models":
                for coefficients in table["effects"].values():
                    _validate_coefficients(coefficients, row)
        for column in columns:
            check_cells(column, parse_json_column(column, [table[column.name] for table in tables]))
    except CellError as error:
        # Tables are numbered from 1 in messages.
        error.says = f"{name}, {(error.row or 0) + 1}: {error.says}"
        raise


def _validate_coefficients(coefficients: list[Any], row: int) -> None:
    """Validate the coefficients of an effect; an error states the model's index `row`."""
    try:
        check_cells(_COEFFICIENT, parse_json_column(_COEFFICIENT, coefficients))
    except CellError as error:
        error.row = row
        raise
