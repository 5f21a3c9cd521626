"""Largest plausible numbers, counts and text lengths.

Larger values are mistakes, and would cause an overflow or an endless computation later.
"""

from __future__ import annotations

from typing import Any

import numpy as np

LARGEST = 1e15
"""Maximum magnitude of any number, SI units: its powers and products remain finite."""
MOST = 10**18
"""Maximum magnitude of an integer: it fits into 64 bits, and products of several into a float."""
FASTEST = 1e12
"""Maximum sampling rate, Hz."""
LATEST = 1e11
"""Maximum time stamp in seconds: 3,000 years after the zero of any clock."""
BRIEFEST = 1e-9
"""Minimum length of a recorded run, s."""
NAME = 120
"""Maximum number of characters of a name or label, which is used in file names."""
LINE = 300
"""Maximum number of characters of a title."""
WORDS = 5000
"""Maximum number of characters of a description."""
MESSAGE = 4000
"""Maximum number of characters of a message, because it may quote a large part of a user's file."""
QUOTED = 60
"""Maximum number of characters of a name that a message quotes."""


def cut(text: str, most: int = QUOTED) -> str:
    """Truncate a text for a message.

    Args:
        text: Text.
        most: Maximum number of characters.
    """
    return text if len(text) <= most else f"{text[:most]}…"


def is_number(value: Any) -> bool:
    """Return whether a value is a number of plausible size; booleans and NaN are not."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
        return False
    size: Any = value
    return bool(-LARGEST <= size <= LARGEST)  # an integer may be too large for a float


# Plausible ranges of constants of mechanical systems, from dust to ships, SI units.
MASS = (1e-9, 1e9)
LENGTH = (1e-9, 1e6)
INERTIA = (1e-12, 1e12)
GRAVITY = (0.0, 1000.0)
"""Plausible range of gravitational acceleration, m/s^2; the Sun's is 274."""
TURN = (-1e3, 1e3)
"""Plausible range of an angle, rad."""
RATIO = (0.0, 1e3)
VOLTAGE = (1e-3, 1e6)
GAIN = (-1e9, 1e9)
"""Plausible range of a controller's gain, in any unit."""
PIXELS = (16.0, 4096.0)
"""Plausible range of width and height of a picture, pixels."""
