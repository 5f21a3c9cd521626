"""Render a robot without a window, in a separate process that may fail.

A missing or broken OpenGL raises an exception, prints, or ends its process; and its kind is fixed
when MuJoCo is first imported. Therefore a child process renders, its output is hidden from the
terminal, and if it fails there is no image.
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

from bench.figures.camera_view import Projection
from sims.core.simulator import Array

Image = NDArray[np.uint8]
MAX_IMAGE_PIXELS = 900
"""Size of the longer side of an image, in pixels."""
RENDER_TIMEOUT_SECONDS = 60.0
"""Time limit for rendering an image, in seconds."""
CAMERA_DISTANCE_FACTOR = 4.0
"""Ratio of the camera's distance to the size of the scene; no part reaches behind it."""
_START = (
    "import sys; sys.path[:] = {path!r}; "
    "from bench.figures.offscreen_rendering import render_requested; render_requested(sys.argv[1])"
)
_failed: set[str] = set()
"""OpenGL backends that failed in this process; each is tried only once."""
LUMA_QUANTILES = (0.02, 0.98)
"""Quantiles of the robot's brightness that are stretched to the ends of the range."""


def list_gl_backends() -> tuple[str, ...]:
    """List the OpenGL backends to try, by MuJoCo's names.

    One that the user has chosen (``MUJOCO_GL``) comes first; the list is empty if the user has
    disabled OpenGL.
    """
    chosen_backend = os.environ.get("MUJOCO_GL", "").lower()
    if chosen_backend in ("disable", "disabled", "off", "false", "0"):
        return ()
    # On other platforms MuJoCo's default, the empty name, needs no window.
    usual_backends = ("egl", "osmesa") if sys.platform.startswith("linux") else ("",)
    if chosen_backend in ("egl", "osmesa"):
        return (chosen_backend, *usual_backends)
    return usual_backends


def render_robot(model: Any, positions: Array, view: Projection) -> Image | None:
    """Render the robot in grey on white, with the first OpenGL backend that works.

    A backend that fails is not tried again in this process.

    Args:
        model: mujoco.MjModel.
        positions: (nq,) positions of its joints.
        view: Camera view.

    Returns:
        (H, W, 3) image; None if this machine cannot render it.
    """
    for backend in list_gl_backends():
        if backend in _failed:
            continue
        image = _render_in_child(backend, model, positions, view)
        if image is not None:
            return image
        _failed.add(backend)
    return None


def _render_in_child(backend: str, model: Any, positions: Array, view: Projection) -> Image | None:
    """Render a robot in a child process with one OpenGL backend; return None if that fails.

    A missing graphics driver may crash a process, so it must not be this one.

    Args:
        backend: value of ``MUJOCO_GL``; empty for MuJoCo's own choice.
        model: compiled model.
        positions: (nq,) pose, MuJoCo's qpos.
        view: camera.
    """
    import mujoco

    environment = dict(os.environ)
    # This variable of the user would select another backend.
    environment.pop("PYOPENGL_PLATFORM", None)
    if backend:
        environment["MUJOCO_GL"] = backend
    with TemporaryDirectory(prefix="simgap-picture-") as name:
        folder = Path(name)
        mujoco.mj_saveModel(model, str(folder / "model.mjb"), None)
        view_numbers = (view.azimuth, view.elevation, view.width, view.height)
        np.savez(folder / "view.npz", qpos=positions, centre=view.centre, shown=view_numbers)
        try:
            process = subprocess.run(
                [sys.executable, "-c", _START.format(path=sys.path), str(folder)],
                env=environment,
                capture_output=True,
                stdin=subprocess.DEVNULL,
                timeout=RENDER_TIMEOUT_SECONDS,
                check=False,
            )
            image: Image = np.load(folder / "image.npy")
        except (OSError, ValueError, subprocess.TimeoutExpired):
            return None
    return image if process.returncode == 0 else None


def render_requested(folder: str) -> None:
    """Render the request that `_render_in_child` stored in a folder; any error ends the process.

    Args:
        folder: Folder with the model (`model.mjb`) and the view (`view.npz`); the image is written
            there.
    """
    import mujoco

    folder_path = Path(folder)
    model = mujoco.MjModel.from_binary_path(str(folder_path / "model.mjb"))
    request = np.load(folder_path / "view.npz")
    azimuth, elevation, width, height = request["shown"].tolist()
    view = Projection(azimuth, elevation, request["centre"], width, height)
    data = mujoco.MjData(model)
    data.qpos[:] = request["qpos"]
    mujoco.mj_forward(model, data)
    np.save(folder_path / "image.npy", _render_image(mujoco, model, data, view))


def _render_image(mujoco: Any, model: Any, data: Any, view: Projection) -> Image:
    """Render the robot by MuJoCo in grey on a white background, in parallel projection.

    Args:
        mujoco: the module.
        model: compiled model.
        data: its state at the pose.
        view: camera.

    Returns:
        (H, W, 3) grey image, whose longer side has `MAX_IMAGE_PIXELS` pixels.
    """
    scale = MAX_IMAGE_PIXELS / max(view.width, view.height)  # Pixels per metre.
    pixel_height, pixel_width = (max(2, round(scale * side)) for side in (view.height, view.width))
    global_options = model.vis.global_
    global_options.offwidth, global_options.offheight = pixel_width, pixel_height
    # In an orthographic projection, fovy is the visible height.
    global_options.orthographic, global_options.fovy = 1, view.height
    # Diagonal of the view in metres.
    diagonal = float(np.hypot(view.width, view.height))
    model.stat.extent = diagonal
    # Nearest and farthest visible distance, in extents of the model.
    model.vis.map.znear, model.vis.map.zfar = 0.01, 3 * CAMERA_DISTANCE_FACTOR
    # Shadows and reflections give no information about places.
    model.light_castshadow[:] = 0
    model.mat_reflectance[:] = 0
    _hide_floors(mujoco, model)

    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    camera.azimuth, camera.elevation = view.azimuth, view.elevation
    camera.lookat[:], camera.distance = view.centre, CAMERA_DISTANCE_FACTOR * diagonal
    with mujoco.Renderer(model, pixel_height, pixel_width) as renderer:
        renderer.update_scene(data, camera)
        colours = renderer.render().astype(np.float64)
        # The segmentation has the number of the object in each pixel, and -1 for none.
        renderer.enable_segmentation_rendering()
        renderer.update_scene(data, camera)
        is_robot = renderer.render()[:, :, 0] >= 0
    return convert_to_grey(colours, is_robot)


def convert_to_grey(colours: Array, is_robot: NDArray[np.bool_]) -> Image:
    """Convert an image to light greys on white, so that marks are clearly visible.

    The robot's own range of brightness is mapped to greys from 120 to 232; outside of it the image
    is white.

    Args:
        colours: (H, W, 3) colours from 0 to 255.
        is_robot: (H, W) mask of the robot.

    Returns:
        (H, W, 3) grey image.
    """
    # Luma of ITU-R BT.601.
    luma = colours @ (0.299, 0.587, 0.114)
    robot_luma = luma[is_robot]
    low, high = np.quantile(robot_luma, LUMA_QUANTILES) if robot_luma.size else (0.0, 1.0)
    share = np.clip((luma - low) / max(high - low, 1.0), 0.0, 1.0)
    grey = np.where(is_robot, 120 + 112 * share, 255)
    return np.repeat(grey.round().astype(np.uint8)[:, :, None], 3, axis=2)


def _hide_floors(mujoco: Any, model: Any) -> None:
    """Hide floors, which would fill the image.

    Args:
        mujoco: the module.
        model: compiled model, changed in place.
    """
    floor_types = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))
    for geom in range(model.ngeom):
        if int(model.geom_type[geom]) in floor_types:
            model.geom_matid[geom] = -1
            model.geom_rgba[geom, 3] = 0.0
