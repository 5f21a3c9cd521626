"""Largest plausible numbers, counts and text lengths.

Larger values are mistakes, and would cause an overflow or an endless computation later.
"""

from __future__ import annotations

from typing import Any

import numpy as np

MAX_NUMBER = 1e15
"""Maximum magnitude of any number, SI units: its powers and products remain finite."""
MAX_INTEGER = 10**18
"""Maximum magnitude of an integer: it fits into 64 bits, and products of several into a float."""
MAX_SAMPLING_RATE_HZ = 1e12
"""Maximum sampling rate, Hz."""
MAX_TIMESTAMP_SECONDS = 1e11
"""Maximum time stamp in seconds: 3,000 years after the zero of any clock."""
MIN_RUN_SECONDS = 1e-9
"""Minimum length of a recorded run, s."""
MAX_NAME_LENGTH = 120
"""Maximum number of characters of a name or label, which is used in file names."""
MAX_TITLE_LENGTH = 300
"""Maximum number of characters of a title."""
MAX_DESCRIPTION_LENGTH = 5000
"""Maximum number of characters of a description."""
MAX_MESSAGE_LENGTH = 4000
"""Maximum number of characters of a message, because it may quote a large part of a user's file."""
MAX_QUOTED_NAME_LENGTH = 60
"""Maximum number of characters of a name that a message quotes."""


def truncate_text(text: str, max_length: int = MAX_QUOTED_NAME_LENGTH) -> str:
    """Truncate a text for a message.

    Args:
        text: Text.
        max_length: Maximum number of characters.
    """
    return text if len(text) <= max_length else f"{text[:max_length]}…"


def is_plausible_number(value: Any) -> bool:
    """Return whether a value is a number of plausible size; booleans and NaN are not."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
        return False
    size: Any = value
    return bool(-MAX_NUMBER <= size <= MAX_NUMBER)  # an integer may be too large for a float


# Plausible ranges of constants of mechanical systems, from dust to ships, SI units.
MASS_RANGE = (1e-9, 1e9)
LENGTH_RANGE = (1e-9, 1e6)
INERTIA_RANGE = (1e-12, 1e12)
GRAVITY_RANGE = (0.0, 1000.0)
"""Plausible range of gravitational acceleration, m/s^2; the Sun's is 274."""
ANGLE_RANGE = (-1e3, 1e3)
"""Plausible range of an angle, rad."""
RATIO_RANGE = (0.0, 1e3)
VOLTAGE_RANGE = (1e-3, 1e6)
GAIN_RANGE = (-1e9, 1e9)
"""Plausible range of a controller's gain, in any unit."""
IMAGE_SIZE_RANGE = (16.0, 4096.0)
"""Plausible range of width and height of a picture, pixels."""
