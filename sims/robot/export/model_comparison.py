"""Compare compiled MuJoCo models field by field."""

from __future__ import annotations

from typing import Any

import numpy as np

_IGNORED_NAME_PARTS = ("name", "path", "text", "signature", "tex_data", "nbuffer")
"""Parts of the names of model fields that do not influence the motion."""

EQUAL_NUMBERS_TOLERANCE = 1e-12
"""Relative difference between numbers of a compiled model that counts as rounding."""


def find_first_difference(first_model: Any, second_model: Any, tolerance: float) -> str | None:
    """Find the first field, in alphabetical order, in which two compiled models differ.

    All numeric fields and options are compared; names and other texts are ignored.

    Args:
        first_model: a mujoco.MjModel.
        second_model: another mujoco.MjModel.
        tolerance: difference that counts as rounding, relative to the largest value of a field.

    Returns:
        The name of the field with both values, or None if the models are equal.
    """
    for prefix, first_struct, second_struct in (
        ("", first_model, second_model),
        ("opt.", first_model.opt, second_model.opt),
    ):
        for name in sorted(dir(first_struct)):
            if name.startswith("_") or any(part in name for part in _IGNORED_NAME_PARTS):
                continue
            first_value, second_value = getattr(first_struct, name), getattr(second_struct, name)
            if isinstance(first_value, np.ndarray | int | float) and _fields_differ(
                first_value, second_value, tolerance
            ):
                return f"{prefix}{name}: {_format_difference(first_value, second_value)}"
    return None


def _fields_differ(first: Any, second: Any, tolerance: float) -> bool:
    """Return whether two fields of compiled models differ in shape or in value.

    Infinities of equal sign are equal. Numbers that are not floating-point must be identical.

    Args:
        first: array or number of one model.
        second: the same field of the other model.
        tolerance: largest difference of floating-point numbers, relative to the largest entry.
    """
    first, second = np.asarray(first), np.asarray(second)
    if first.shape != second.shape:
        return True
    if first.dtype.kind != "f":
        return bool((first != second).any())
    scale = max(float(np.abs(first).max(initial=0.0)), float(np.abs(second).max(initial=0.0)))
    # The difference of two infinities is NaN, and close to nothing; they are compared directly.
    is_close = np.abs(first - second) <= tolerance * scale
    return not bool((is_close | (first == second)).all())


def _format_difference(first: Any, second: Any) -> str:
    """Format the largest difference of two fields as "value and value", or both shapes.

    Args:
        first: array or number of one model.
        second: the same field of the other model.
    """
    first, second = np.asarray(first), np.asarray(second)
    if first.shape != second.shape:
        return f"{first.shape} and {second.shape}"
    index = np.argmax(np.abs(first.astype(float) - second.astype(float)))
    return f"{first.flat[index]!r} and {second.flat[index]!r}"
