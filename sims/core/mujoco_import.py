"""Environment variable that makes ``import mujoco`` faster: the path of the glfw library."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec
from pathlib import Path


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
    session = os.environ.get("PYGLFW_LIBRARY_VARIANT") or os.environ.get("XDG_SESSION_TYPE", "")
    variant = "wayland" if session.lower() == "wayland" else "x11"
    library = Path(package.origin).parent / variant / "libglfw.so"
    if library.is_file():
        os.environ["PYGLFW_LIBRARY"] = str(library)
