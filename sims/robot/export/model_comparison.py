"""Save MuJoCo models with full precision, and compare compiled models field by field."""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

EXACT_DIGITS = 17
"""Number of significant digits with which every float64 number is read back exactly."""

_TEXTS = ("name", "path", "text", "signature", "tex_data", "nbuffer")
"""Parts of the names of model fields that do not influence the motion."""


def format_spec(spec: Any, folder: Path) -> str:
    """Format a spec as MJCF with full precision and absolute asset folders.

    Angles and other values keep the notation in which the model file states them.

    Args:
        spec: a compiled mujoco.MjSpec; it must not be used afterwards.
        folder: folder to which the paths of its assets are relative.

    Returns:
        The MJCF text.

    Raises:
        RuntimeError: this MuJoCo library has no function that sets the number of digits.
    """
    spec.meshdir = str(folder / spec.meshdir)
    spec.texturedir = str(folder / spec.texturedir)
    spec.compiler.savecompiled = False
    spec.compiler.savecanonical = False
    library = _load_library()
    try:
        digits = library._mjPRIVATE__get_xml_precision()
        library._mjPRIVATE__set_xml_precision(EXACT_DIGITS)
    except AttributeError:
        raise RuntimeError("this MuJoCo writes models with six digits only") from None
    try:
        return str(spec.to_xml())
    finally:
        library._mjPRIVATE__set_xml_precision(digits)


@cache
def _load_library() -> Any:
    """Load MuJoCo's shared library; its Python module does not expose the number of digits."""
    import mujoco

    folder = Path(mujoco.__file__).parent
    names = ("libmujoco*.so*", "libmujoco*.dylib", "mujoco.dll")
    (path, *_) = [found for name in names for found in sorted(folder.glob(name))]
    return ctypes.CDLL(str(path))


def find_first_difference(one: Any, other: Any, tolerance: float) -> str | None:
    """Find the first field in which two compiled models differ.

    It compares all numeric fields and options. Names and other texts are ignored.

    Args:
        one: a mujoco.MjModel.
        other: another mujoco.MjModel.
        tolerance: difference that counts as rounding, relative to the largest value of a field.

    Returns:
        The name of the field with both values, or None if the models are equal.
    """
    for prefix, this, that in (("", one, other), ("opt.", one.opt, other.opt)):
        for name in sorted(dir(this)):
            if name.startswith("_") or any(part in name for part in _TEXTS):
                continue
            mine, others = getattr(this, name), getattr(that, name)
            if isinstance(mine, np.ndarray | int | float) and _fields_differ(
                mine, others, tolerance
            ):
                return f"{prefix}{name}: {_format_difference(mine, others)}"
    return None


def _fields_differ(one: Any, other: Any, tolerance: float) -> bool:
    """Return whether two fields of compiled models differ in shape or in value.

    Floating-point numbers may differ by `tolerance` times the largest entry of both arrays;
    infinities of equal sign are equal. All other types must be identical.
    """
    one, other = np.asarray(one), np.asarray(other)
    if one.shape != other.shape:
        return True
    if one.dtype.kind != "f":
        return bool((one != other).any())
    scale = max(float(np.abs(one).max(initial=0.0)), float(np.abs(other).max(initial=0.0)))
    near = np.abs(one - other) <= tolerance * scale
    return not bool((near | (one == other)).all())


def _format_difference(one: Any, other: Any) -> str:
    """Format the largest difference of two fields as "value and value", or both shapes."""
    one, other = np.asarray(one), np.asarray(other)
    if one.shape != other.shape:
        return f"{one.shape} and {other.shape}"
    at = np.argmax(np.abs(one.astype(float) - other.astype(float)))
    return f"{one.flat[at]!r} and {other.flat[at]!r}"
