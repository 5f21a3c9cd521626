"""A robot rendered where nobody sees a window: in a process of its own, which may fail as it likes.

A missing or broken GL raises, prints or ends the process that asks it; which one is asked is fixed
when MuJoCo is first imported. So a child is asked, its output is kept from the terminal, and where
it brings no picture there is none.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.figures.view import View
from sims.base import Array

Image = NDArray[np.uint8]
DOTS = 900
"""Of the longer side of a picture."""
SECONDS = 60.0
"""A picture that takes longer is not waited for."""
FAR = 4.0
"""Distance of the camera in sizes of what it shows: nothing reaches behind it."""
_START = (
    "import sys; sys.path[:] = {path!r}; "
    "from bench.figures.offscreen import main; main(sys.argv[1])"
)
_failed: set[str] = set()
"""Kinds of GL that have brought no picture in this process: each is asked once."""


def backends() -> tuple[str, ...]:
    """Kinds of GL to ask, by MuJoCo's names; none where the user has switched it off."""
    chosen = os.environ.get("MUJOCO_GL", "").lower()
    if chosen in ("disable", "disabled", "off", "false", "0"):
        return ()
    # Elsewhere MuJoCo's own choice needs no window.
    usual = ("egl", "osmesa") if sys.platform.startswith("linux") else ("",)
    return (chosen, *usual) if chosen in ("egl", "osmesa") else usual


def rendered(model: Any, positions: Array, view: View) -> Image | None:
    """(H, W, 3) the robot in grey on white; None where this machine cannot draw it.

    Args:
        model: mujoco.MjModel.
        positions: (nq,) of its joints.
        view: what to show.
    """
    for backend in backends():
        if backend in _failed:
            continue
        image = _asked(backend, model, positions, view)
        if image is not None:
            return image
        _failed.add(backend)
    return None


def _asked(backend: str, model: Any, positions: Array, view: View) -> Image | None:
    """The picture by one kind of GL; None if it fails."""
    import mujoco

    environment = dict(os.environ)
    # Another kind of GL of the user's would be asked instead.
    environment.pop("PYOPENGL_PLATFORM", None)
    if backend:
        environment["MUJOCO_GL"] = backend
    with TemporaryDirectory(prefix="simgap-picture-") as name:
        folder = Path(name)
        mujoco.mj_saveModel(model, str(folder / "model.mjb"), None)
        shown = (view.azimuth, view.elevation, view.width, view.height)
        np.savez(folder / "view.npz", qpos=positions, centre=view.centre, shown=shown)
        try:
            done = subprocess.run(
                [sys.executable, "-c", _START.format(path=sys.path), str(folder)],
                env=environment,
                capture_output=True,
                stdin=subprocess.DEVNULL,
                timeout=SECONDS,
                check=False,
            )
            image: Image = np.load(folder / "image.npy")
        except (OSError, ValueError, subprocess.TimeoutExpired):
            return None
    return image if done.returncode == 0 else None


def main(folder: str) -> None:
    """Draw what `_asked` has put into a folder; any fault ends the process."""
    import mujoco

    place = Path(folder)
    model = mujoco.MjModel.from_binary_path(str(place / "model.mjb"))
    asked = np.load(place / "view.npz")
    azimuth, elevation, width, height = asked["shown"].tolist()
    view = View(azimuth, elevation, asked["centre"], width, height)
    data = mujoco.MjData(model)
    data.qpos[:] = asked["qpos"]
    mujoco.mj_forward(model, data)
    np.save(place / "image.npy", _drawn(mujoco, model, data, view))


def _drawn(mujoco: Any, model: Any, data: Any, view: View) -> Image:
    """The robot in grey; what is behind it is white."""
    scale = DOTS / max(view.width, view.height)
    rows, columns = (max(2, round(scale * size)) for size in (view.height, view.width))
    whole = model.vis.global_
    whole.offwidth, whole.offheight = columns, rows
    # Without perspective this is the height of what is shown.
    whole.orthographic, whole.fovy = 1, view.height
    size = float(np.hypot(view.width, view.height))
    model.stat.extent = size
    model.vis.map.znear, model.vis.map.zfar = 0.01, 3 * FAR
    # Shadows and mirrors say nothing about a place.
    model.light_castshadow[:] = 0
    model.mat_reflectance[:] = 0
    _without_ground(mujoco, model)

    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    camera.azimuth, camera.elevation = view.azimuth, view.elevation
    camera.lookat[:], camera.distance = view.centre, FAR * size
    with mujoco.Renderer(model, rows, columns) as renderer:
        renderer.update_scene(data, camera)
        colours = renderer.render().astype(np.float64)
        renderer.enable_segmentation_rendering()
        renderer.update_scene(data, camera)
        shape = renderer.render()[:, :, 0] >= 0
    return greyed(colours, shape)


def greyed(colours: Array, shape: NDArray[np.bool_]) -> Image:
    """(H, W, 3) light greys where there is a shape, white elsewhere: marks stand out on them."""
    # Luma of ITU-R BT.601.
    luma = colours @ (0.299, 0.587, 0.114)
    seen = luma[shape]
    low, high = np.quantile(seen, [0.02, 0.98]) if seen.size else (0.0, 1.0)
    # Whatever a robot's own colours: from a middle grey to a light one.
    share = np.clip((luma - low) / max(high - low, 1.0), 0.0, 1.0)
    grey = np.where(shape, 120 + 112 * share, 255)
    return np.repeat(grey.round().astype(np.uint8)[:, :, None], 3, axis=2)


def _without_ground(mujoco: Any, model: Any) -> None:
    """Leave out floors, which fill the picture."""
    endless = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))
    for g in range(model.ngeom):
        if int(model.geom_type[g]) in endless:
            model.geom_matid[g] = -1
            model.geom_rgba[g, 3] = 0.0
