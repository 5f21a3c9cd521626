"""Read and write `NAME.camera.toml`, which describes the camera and the ball of a rendered film."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sims.core.simulator import InputError
from sims.core.toml_validation import (
    check_finite,
    check_known_names,
    check_number_list,
    check_table,
    make_error,
    read_toml,
)
from sims.vision.pinhole_camera import PinholeCamera

_CAMERA_ENTRY_SIZES = {
    "azimuth": 1,
    "distance": 1,
    "height": 1,
    "field_of_view": 1,
    "target": 3,
    "size": 2,
}
"""Entries of [camera] and how many numbers each has."""

_BALL_ENTRY_SIZES = {"radius": 1, "x": 1, "y": 1}
"""Entries of [ball] and how many numbers each has."""


@dataclass(frozen=True)
class FilmDescription:
    """Camera, and a ball of `radius` [m] on the vertical through x, y [m]."""

    camera: PinholeCamera
    radius: float
    x: float = 0.0
    y: float = 0.0


def get_camera_file_path(video: Path) -> Path:
    """Return the path of the camera description of a film."""
    return video.with_suffix(".camera.toml")


def format_camera_file(filmed: FilmDescription) -> str:
    """Format the text of `NAME.camera.toml`."""
    import tomli_w

    camera = {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(filmed.camera).items()}
    return tomli_w.dumps(
        {"camera": camera, "ball": {"radius": filmed.radius, "x": filmed.x, "y": filmed.y}}
    )


def read_camera_file(path: Path) -> FilmDescription:
    """Read `NAME.camera.toml`.

    Raises:
        InputError: The file is malformed; the message is one line.
    """
    meta = read_toml(path)
    # All entries are required: a partly default camera would give wrong lengths silently.
    camera = _read_section(path, "camera", meta, _CAMERA_ENTRY_SIZES)
    ball = _read_section(path, "ball", meta, _BALL_ENTRY_SIZES)
    if ball["radius"] <= 0:
        raise make_error(path, "ball.radius", "more than 0 m", ball["radius"])
    # Sizes are integers, but may be written as floats in TOML.
    camera["size"] = tuple(int(n) for n in camera["size"])
    try:
        return FilmDescription(PinholeCamera(**camera), **ball)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _read_section(
    path: Path, section: str, meta: Mapping[str, Any], counts: Mapping[str, int]
) -> dict[str, Any]:
    """Read all entries of a section, each a number or a tuple of the required length."""
    table = check_table(path, section, meta.get(section))
    check_known_names(f"entry in [{section}] of {path}", table, counts)
    values: dict[str, Any] = {}
    for name, count in counts.items():
        key, value = f"{section}.{name}", table.get(name)
        if count == 1:
            values[name] = check_finite(path, key, value)
        else:
            row = check_number_list(path, key, value, count)
            values[name] = tuple(check_finite(path, key, entry) for entry in row)
    return values
