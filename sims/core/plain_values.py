"""Convert values to plain Python values, which can be written as TOML or JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import PurePath
from typing import Any


def to_toml_value(value: Any) -> Any:
    """Copy a value as plain dicts, lists and numbers, as TOML gives them."""
    # The command line imports this module, and starts faster without NumPy.
    import numpy as np

    if isinstance(value, Mapping):
        return {str(key): to_toml_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_toml_value(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def to_json_value(value: Any) -> Any:
    """Convert a value to JSON types: paths to text, tuples to lists, NaN and infinity to None."""
    if isinstance(value, Mapping):
        return {str(key): to_json_value(item) for key, item in value.items()}
    if isinstance(value, tuple | list | set | frozenset):
        return [to_json_value(item) for item in value]
    if isinstance(value, PurePath):
        return str(value)
    # NumPy numbers and arrays have this method.
    if hasattr(value, "tolist"):
        return to_json_value(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    # Text from files or system calls may contain lone surrogates, which cannot be encoded.
    return value.encode("utf-8", "replace").decode() if isinstance(value, str) else value
