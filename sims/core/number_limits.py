"""Largest and smallest plausible numbers in the input of users.

Larger numbers are mistakes, and would cause an overflow or an endless computation later.
"""

from __future__ import annotations

from typing import Any

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

# Ranges of constants of mechanical systems, from dust to ships.
MASS_RANGE = (1e-9, 1e9)
"""Plausible range of a mass, kg."""
LENGTH_RANGE = (1e-9, 1e6)
"""Plausible range of a length, m."""
INERTIA_RANGE = (1e-12, 1e12)
"""Plausible range of a moment of inertia, kg m^2."""
GRAVITY_RANGE = (0.0, 1000.0)
"""Plausible range of gravitational acceleration, m/s^2; the Sun's is 274."""
ANGLE_RANGE = (-1e3, 1e3)
"""Plausible range of an angle, rad."""
RATIO_RANGE = (0.0, 1e3)
"""Plausible range of a ratio of two quantities of one kind."""
VOLTAGE_RANGE = (1e-3, 1e6)
"""Plausible range of a voltage, V."""
GAIN_RANGE = (-1e9, 1e9)
"""Plausible range of a controller's gain, in any unit."""
IMAGE_SIZE_RANGE = (16.0, 4096.0)
"""Plausible range of width and height of a picture, pixels."""


def is_plausible_number(value: Any) -> bool:
    """Return whether a value is a number of plausible size; booleans and NaN are not.

    The limit `MAX_NUMBER` is far below the largest float, so that products of two numbers do not
    overflow.
    """
    # Imported here, because the command line starts faster without NumPy.
    import numpy as np

    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
        return False
    size: Any = value
    return bool(-MAX_NUMBER <= size <= MAX_NUMBER)  # an integer may be too large for a float
