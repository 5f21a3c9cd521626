"""What stands beside a film made here, `NAME.camera.toml`: the camera, and the ball and the
vertical it falls along.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sims.base import InputError, unknown
from sims.camera.camera import Camera
from sims.recording.recording import read_toml


@dataclass(frozen=True)
class Filmed:
    """A camera, and what it films: a ball of `radius` [m] on the vertical through x, y [m]."""

    camera: Camera
    radius: float
    x: float = 0.0
    y: float = 0.0


def beside(video: Path) -> Path:
    """Where the description of a film's camera stands."""
    return video.with_suffix(".camera.toml")


def described(filmed: Filmed) -> str:
    """The text of `NAME.camera.toml`."""
    import tomli_w

    camera = {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(filmed.camera).items()}
    return tomli_w.dumps(
        {"camera": camera, "ball": {"radius": filmed.radius, "x": filmed.x, "y": filmed.y}}
    )


def read_filmed(path: Path) -> Filmed:
    """Read `NAME.camera.toml`.

    Raises:
        InputError: anything malformed, in one line.
    """
    meta = read_toml(path)
    camera = _numbers(
        path,
        "camera",
        meta,
        ("azimuth", "distance", "height", "field_of_view"),
        {"target": 3, "size": 2},
    )
    ball = _numbers(path, "ball", meta, ("radius", "x", "y"), {})
    if ball["radius"] <= 0:
        raise InputError(f"{path}: ball.radius: expected more than 0 m, found {ball['radius']:g}")
    camera["size"] = tuple(int(n) for n in camera["size"])
    try:
        return Filmed(Camera(**camera), **ball)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _numbers(
    path: Path, section: str, meta: dict[str, Any], single: tuple[str, ...], rows: dict[str, int]
) -> Any:
    table = meta.get(section)
    if not isinstance(table, dict):
        raise InputError(f"{path}: expected a table [{section}]")
    for name in table:
        if name not in (*single, *rows):
            raise unknown(f"entry in [{section}] of {path}", name, [*single, *rows])
    values: dict[str, Any] = {}
    for name in (*single, *rows):
        found: Any = table.get(name)
        length = rows.get(name, 0)
        cells = found if length and isinstance(found, list) else [found]
        if len(cells) != max(1, length) or not all(
            isinstance(c, int | float) and not isinstance(c, bool) for c in cells
        ):
            raise InputError(
                f"{path}: {section}.{name}: expected {length or 'a'} number{'s' * bool(length)}"
            )
        values[name] = tuple(map(float, cells)) if length else float(cells[0])
    return values
