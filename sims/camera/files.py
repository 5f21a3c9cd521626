"""What stands beside a film made here, `NAME.camera.toml`: the camera, and the ball and the
vertical it falls along.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sims.base import InputError
from sims.camera.camera import Camera
from sims.user_toml import fault, finite, known, numbers, read_toml, table

_CAMERA = {"azimuth": 1, "distance": 1, "height": 1, "field_of_view": 1, "target": 3, "size": 2}
"""Entries of [camera], with how many numbers each has."""

_BALL = {"radius": 1, "x": 1, "y": 1}
"""Entries of [ball]."""


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
    # All of it is stated: a camera that is half a default would give wrong metres without a word.
    camera = _values(path, "camera", meta, _CAMERA)
    ball = _values(path, "ball", meta, _BALL)
    if ball["radius"] <= 0:
        raise fault(path, "ball.radius", "more than 0 m", ball["radius"])
    # Pixels are counted; TOML gives every number as it was written.
    camera["size"] = tuple(int(n) for n in camera["size"])
    try:
        return Filmed(Camera(**camera), **ball)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _values(
    path: Path, section: str, meta: Mapping[str, Any], counts: Mapping[str, int]
) -> dict[str, Any]:
    """The entries of a section, every one of them: a number, or as many as are counted."""
    given = table(path, section, meta.get(section))
    known(f"entry in [{section}] of {path}", given, counts)
    values: dict[str, Any] = {}
    for name, count in counts.items():
        where, value = f"{section}.{name}", given.get(name)
        if count == 1:
            values[name] = finite(path, where, value)
        else:
            row = numbers(path, where, value, count)
            values[name] = tuple(finite(path, where, entry) for entry in row)
    return values
