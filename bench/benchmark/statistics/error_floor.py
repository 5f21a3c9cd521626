"""Smallest error that results distinguish."""

ERROR_FLOOR = 1e-9
"""Errors below this value count as equal to it; they are smaller than rounding in observations."""
