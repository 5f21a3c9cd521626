"""How a servo of unknown gains follows its command, as a first guess of them.

A joint whose drive pulls it towards the command u by a spring and a damper moves as

    q'' = w^2 (u - q) - 2 d w q'                                                                 (1)

with w the natural frequency and d the share of critical damping. Commands are held over a sample,
so (1) is exact from sample to sample (C. Van Loan, IEEE Trans. Autom. Control 23(3), 395, 1978); w
and d are those of a grid that leave least of the position after an offset.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from sims.base import Array

FREQUENCIES = np.geomspace(2.0, 200.0, 33)
"""rad/s."""
DAMPINGS = np.geomspace(0.3, 6.0, 14)
LIKE = 0.8
"""Share of a position's variance that (1) explains at least."""
MOST = 4000
"""Samples that are looked at."""
MOVES = 20
"""Samples of a log, at least."""


class Following(NamedTuple):
    """Natural frequency in rad/s, and share of critical damping."""

    frequency: float
    damping: float


def following(runs: Sequence[tuple[Array, Array, Array]]) -> Following | None:
    """How a position follows its command; None where it does not, or hardly moves.

    Args:
        runs: (T,) times in s, about even, (T,) commands, each held to the next sample, and (T,)
            positions in the same unit.
    """
    clean = [_seen(*run) for run in runs]
    moving = [(t, u, q) for t, u, q in clean if t.size >= MOVES and np.std(u) > 0 and np.std(q) > 0]
    if not moving:
        return None
    # Loaded here alone: it is much.
    from scipy.signal import cont2discrete, lfilter

    step = float(np.median([np.median(np.diff(t)) for t, _, _ in moving]))
    whole = sum(float(np.var(q)) * q.size for _, _, q in moving)
    best, least = None, (1.0 - LIKE) * whole
    for frequency, damping in product(FREQUENCIES.tolist(), DAMPINGS.tolist()):
        system = [frequency**2], [1.0, 2.0 * damping * frequency, frequency**2]
        over, under, _ = cont2discrete(system, step)
        left = 0.0
        for _, u, q in moving:
            left += float(np.var(q - lfilter(np.ravel(over), under, u - u[0]))) * q.size
        if left < least:
            best, least = Following(frequency, damping), left
    return best


def _seen(times: Array, command: Array, position: Array) -> tuple[Array, Array, Array]:
    """The samples that there are, the first ones of a long run."""
    seen = np.isfinite(position) & np.isfinite(command)
    return times[seen][:MOST], command[seen][:MOST], position[seen][:MOST]
