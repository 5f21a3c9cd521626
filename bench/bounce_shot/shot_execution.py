"""Execute a planned shot in the true world, and store its outcome for every method."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

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
from bench.bounce_shot.shot_planner import compute_hoop_crossings
from bench.bounce_shot.shot_sampling import ShotSetup
from bench.bounce_shot.true_world import InclinedGround, simulate_shot
from bench.bounce_shot.tuned_shots import TunedModel, make_planning_model
from sims.core.files import write_atomically
from sims.core.plain_values import to_json_value
from sims.core.simulator import Array, InputError

SAMPLING_RATE_HZ = 240.0
"""Sampling rate of a shot, Hz."""
MAX_SHOT_SECONDS = 3.0
"""Maximum duration of a shot, seconds."""


@dataclass(frozen=True)
class ShotResult:
    """Result of one shot.

    Attributes:
        is_hit: whether the centre passed through the hoop.
        miss_distance: where the centre passed the hoop's plane, m from the hoop's centre along x, >
            0 beyond it; NaN if it did not.
        prediction_error: mean distance in m between the planned and the flown centre at equal
            times, from the release until one of them has passed the hoop's plane.
        times: times, seconds, (T,).
        planned: planned path, (T, 3); NaN if there was no plan.
        flown: flown path, (T, 3).
    """

    is_hit: bool
    miss_distance: float
    prediction_error: float
    times: Array
    planned: Array
    flown: Array


def execute_shot(setup: ShotSetup, settings: ShotConfig, model: TunedModel) -> ShotResult:
    """Execute a planned shot, with the shot's release error.

    Args:
        setup: setup of the shot: its ball, drop, incline and hoop.
        settings: settings of the bounce shot, from the table [shot] of the experiment.
        model: tuned model with the plan.
    """
    times = np.arange(round(MAX_SHOT_SECONDS * SAMPLING_RATE_HZ) + 1) / SAMPLING_RATE_HZ
    # Without a plan, the shot is a miss.
    if not math.isfinite(model.height):
        no_path = np.full((times.size, 3), np.nan)
        return ShotResult(False, float("nan"), float("nan"), times, no_path, no_path)
    planning_model = make_planning_model(model, settings, setup.ball.radius)
    planned_path = planning_model.simulate_flights(setup.scene, np.array([model.height]), times)[0]
    # The true ball, friction and release, which the planner does not know.
    ground = InclinedGround(setup.scene.angle, settings.friction)
    start = (
        setup.release[0],
        0.0,
        setup.scene.compute_contact_height(setup.ball.radius) + model.height + setup.release[1],
    )
    flown_path = simulate_shot(setup.ball, ground, start, times)
    x, y = compute_hoop_crossings(flown_path[None], setup.scene)[0].tolist()
    miss_distance = x - setup.scene.hoop_x
    is_hit = math.hypot(miss_distance, y) < setup.scene.hoop_radius
    # Beyond the hoop's plane, nothing was planned.
    last = min(
        find_descent_index(planned_path, setup.scene.hoop_z),
        find_descent_index(flown_path, setup.scene.hoop_z),
    )
    error = float(np.linalg.norm(planned_path - flown_path, axis=1)[: last + 1].mean())
    return ShotResult(is_hit, miss_distance, error, times, planned_path, flown_path)


def find_descent_index(path: Array, height: float) -> int:
    """Return the index of the sample after which a path descends through a height after its bounce.

    The height is that of the hoop. The path before the bounce is ignored, because the ball falls
    through the same height after its release.

    Args:
        path: positions, (T, 3).
        height: height, m.

    Returns:
        Index of the sample; the last index if the path does not descend through the height.
    """
    heights = path[:, 2]
    # Before its bounce, the ball falls through the same heights.
    has_risen = np.logical_or.accumulate(heights[1:] > heights[:-1])
    down = np.flatnonzero(has_risen & (heights[:-1] > height) & (heights[1:] <= height))
    return int(down[0]) if down.size else len(heights) - 1


def _build_shot_row(setup: ShotSetup, model: TunedModel, result: ShotResult) -> dict[str, Any]:
    """Build the row of shots.csv for one method and shot.

    Lengths are in m. ``off`` is the miss distance, ``margin`` the distance inside the rim of the
    hoop, and ``planned_margin`` the one that the model predicted. Of a traceback only the last line
    is kept as ``reason``.

    Args:
        setup: setup of the shot: its ball, drop, incline and hoop.
        model: tuned model with the plan.
        result: result of the executed shot.
    """
    return {
        "shot": setup.name,
        "ball": setup.name.rpartition("-")[0],
        "method": model.method,
        "hit": result.is_hit,
        "off": result.miss_distance,
        "margin": setup.scene.hoop_radius - abs(result.miss_distance),
        "planned_margin": model.margin,
        "prediction_error": result.prediction_error,
        "drop_height": model.height,
        "restitution": model.restitution,
        "true_restitution": setup.ball.restitution,
        "effects": "; ".join(
            f"{name} {', '.join(f'{v:.4g}' for v in values)}"
            for name, values in model.effects.items()
        ),
        "simulations": model.simulations,
        "seconds": model.seconds,
        "status": model.status,
        "reason": model.reason.strip().splitlines()[-1] if model.reason.strip() else "",
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
        models: models as returned by `bench.bounce_shot.tuned_shots.tune_and_plan`.
        visible_share: fraction of the drop's sample times at which its recording has a height.
    """
    rows = [
        {
            **_build_shot_row(setup, model, execute_shot(setup, settings, model)),
            "seen": visible_share,
        }
        for model in models
    ]
    document = to_json_value({"models": [asdict(model) for model in models], "rows": rows})
    write_atomically(
        get_shot_path(folder, setup), json.dumps(document, indent=1, allow_nan=False) + "\n"
    )


def read_shot(folder: Path, setup: ShotSetup) -> dict[str, Any] | None:
    """Read the stored result of a shot; return None if the shot has not been executed.

    Args:
        folder: result folder of the study.
        setup: setup of the shot: its ball, drop, incline and hoop.

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
    expected = (setup.name, [model["method"] for model in document["models"]])
    names = {row["shot"] for row in document["rows"]}, [row["method"] for row in document["rows"]]
    if names != ({expected[0]}, expected[1]):
        message = f"expected a row of {expected[0]} for each model, found others"
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

    Args:
        document: stored document of the shot.
        name: its part, ``models`` or ``rows``.
        columns: declarations of the values.

    Raises:
        CellError: a value does not match its declaration.
        KeyError: the part is missing.
        TypeError: the part is not a list of tables.
    """
    tables = document[name]
    try:
        for row, table in enumerate(tables):
            select_declared_columns(list(table), columns, row)
            for values in table["effects"].values() if name == "models" else ():
                try:
                    check_cells(_COEFFICIENT, parse_json_column(_COEFFICIENT, values))
                except CellError as error:
                    error.row = row
                    raise
        for column in columns:
            check_cells(column, parse_json_column(column, [table[column.name] for table in tables]))
    except CellError as error:
        error.says = f"{name}, {(error.row or 0) + 1}: {error.says}"
        raise
