"""The packages that films need; they are an extra, and are imported where they are used."""

from __future__ import annotations

import importlib
import importlib.util
from functools import cache
from typing import Any

from sims.base import InputError

NEEDED = ("av", "cv2")
"""PyAV reads and writes video files, OpenCV measures pictures."""


def require(instead: str = "") -> None:
    """See that films can be made and read, without importing anything.

    Args:
        instead: what else a user can do, for the message.

    Raises:
        InputError: a package is missing.
    """
    if not all(map(importlib.util.find_spec, NEEDED)):
        raise InputError(f'films need PyAV and OpenCV: pip install -e ".[vision]"{instead}')


@cache
def imported(name: str) -> Any:
    """One of the packages.

    Raises:
        InputError: it is missing.
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        require()
        raise
