"""How large a number, a count or a text may be: what is beyond is a slip of the pen, and would
overflow or hang somewhere far from where it was written.
"""

from __future__ import annotations

from typing import Any

import numpy as np

LARGEST = 1e15
"""Size of any number of a world, SI units: its powers and products stay finite."""
MOST = 10**18
"""Size of any whole number: it fits into 64 bits, and products of several into a float."""
FASTEST = 1e12
"""Hz of a sampling."""
LATEST = 1e11
"""Seconds of a stamp: 3,000 years after the zero of any clock."""
BRIEFEST = 1e-9
"""Seconds that a recorded run lasts."""
NAME = 120
"""Characters of a name or label: files are called by it."""
LINE = 300
"""Characters of a title."""
WORDS = 5000
"""Characters of a description."""
MESSAGE = 4000
"""Characters of a message: what a user's file quotes in it may be a megabyte."""
QUOTED = 60
"""Characters of a name that a message quotes."""


def cut(text: str, most: int = QUOTED) -> str:
    """The text as a message quotes it: its beginning where it is long."""
    return text if len(text) <= most else f"{text[:most]}…"


def is_number(value: Any) -> bool:
    """Whether it is a number of a size that can be meant; True is none, nor is NaN."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
        return False
    size: Any = value
    return bool(-LARGEST <= size <= LARGEST)  # which a whole number need not be able to as a float


# What constants of mechanical systems can be, from dust to ships, SI units.
MASS = (1e-9, 1e9)
LENGTH = (1e-9, 1e6)
INERTIA = (1e-12, 1e12)
GRAVITY = (0.0, 1000.0)
"""m/s^2; the Sun's is 274."""
TURN = (-1e3, 1e3)
"""rad, of an angle."""
RATIO = (0.0, 1e3)
VOLTAGE = (1e-3, 1e6)
GAIN = (-1e9, 1e9)
"""Of a controller, in whatever unit."""
PIXELS = (16.0, 4096.0)
"""Width and height of a picture."""
