"""Optional packages for films, imported where they are used."""

from __future__ import annotations

import importlib
import importlib.util
from functools import cache
from typing import Any

from sims.core.simulator import InputError

REQUIRED_PACKAGES = ("av", "cv2")
"""Packages for films: PyAV reads and writes video files, OpenCV measures pictures."""


def check_installed(instead: str = "") -> None:
    """Check that the packages for films are installed, without importing them.

    Args:
        instead: Alternative for the user, appended to the message.

    Raises:
        InputError: A package is missing.
    """
    if not all(map(importlib.util.find_spec, REQUIRED_PACKAGES)):
        raise InputError(f'films need PyAV and OpenCV: pip install -e ".[vision]"{instead}')


@cache
def import_package(name: str) -> Any:
    """Import one of the packages for films.

    Raises:
        InputError: The package is missing.
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        check_installed()
        raise
