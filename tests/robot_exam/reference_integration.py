"""A run as it is known, and a motion as it was."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Run:
    """What is known of a run: stamps (T,) that begin at 0, commands (T,) by actuator, and where it
    starts.
    """

    times: np.ndarray
    commands: dict[str, np.ndarray]
    q: np.ndarray
    v: np.ndarray


@dataclass(frozen=True)
class Motion:
    """Positions, speeds and actuators' forces at some instants, each (T, N); the encoder's
    positions where a joint is elastic.
    """

    times: np.ndarray
    q: np.ndarray
    v: np.ndarray
    force: np.ndarray
