"""Settings that make MuJoCo faster: the path of its glfw library, and steps without a profiler."""

from __future__ import annotations

import ctypes
import os
import sys
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any


def set_glfw_library() -> None:
    """Set the path of the library of glfw, which MuJoCo imports, to the one glfw would choose.

    Otherwise glfw starts an interpreter for each library that it finds, to get its version. That is
    a third of the time of ``import mujoco``, in each process of a command.
    """
    if not sys.platform.startswith("linux") or "PYGLFW_LIBRARY" in os.environ:
        return
    package = find_spec("glfw")
    if package is None or package.origin is None:
        return
    # The package of glfw has one library for Wayland and one for X11; glfw chooses in this way.
    session = os.environ.get("PYGLFW_LIBRARY_VARIANT") or os.environ.get("XDG_SESSION_TYPE", "")
    variant = "wayland" if session.lower() == "wayland" else "x11"
    library = Path(package.origin).parent / variant / "libglfw.so"
    if library.is_file():
        os.environ["PYGLFW_LIBRARY"] = str(library)


@cache
def import_mujoco() -> Any:
    """Import the module ``mujoco`` on first use.

    The import is slow, and most commands never simulate.
    """
    import mujoco

    disable_step_profiler()
    return mujoco


@cache
def disable_step_profiler() -> None:
    """Switch off the profiler of MuJoCo's steps, which reads the clock about 20 times in a step.

    The profiler runs while MuJoCo's C variable `mjcb_time` refers to a clock. Python's
    `mujoco.set_mjcb_time` cannot remove the clock that MuJoCo has by default since version 4, so
    the variable is set through the library. A clock that the user has set stays. Simulations are
    not affected; where the system's clock is slow, such as on virtual machines, steps of small
    robots take half the time.

    Source: MuJoCo documentation, "API reference, globals, mjcb_time".
    """
    import mujoco

    if mujoco.get_mjcb_time() is not None:
        return
    for library in _list_mujoco_libraries(Path(mujoco.__file__).parent):
        try:
            clock = ctypes.c_void_p.in_dll(ctypes.CDLL(str(library)), "mjcb_time")
        except (OSError, ValueError):
            # Without access to the variable, steps are only slower.
            continue
        clock.value = None


def _list_mujoco_libraries(package: Path) -> list[Path]:
    """Return the shared libraries of MuJoCo in the folder of its package."""
    return sorted([*package.glob("libmujoco*"), *package.glob("mujoco.dll")])
