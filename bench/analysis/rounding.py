"""Where errors end."""

FLOOR = 1e-9
"""Errors below this count as this: less than rounding in the observation."""
