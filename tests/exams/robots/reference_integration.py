"""Data classes for a run and its motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Run:
    """A run: time stamps (T,) that begin at 0, commands (T,) by actuator, and the initial state."""

    times: np.ndarray
    commands: dict[str, np.ndarray]
    q: np.ndarray
    v: np.ndarray


@dataclass(frozen=True)
class Motion:
    """Positions, velocities and actuator forces at given times, each (T, N).

    For an elastic joint, the position is that of the encoder.
    """

    times: np.ndarray
    q: np.ndarray
    v: np.ndarray
    force: np.ndarray
