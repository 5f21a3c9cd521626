"""Finite differences: how far each unknown of a model is moved, now and in the next step."""

from __future__ import annotations

import numpy as np

from bench.gap.model.noise import Mask, Noise
from bench.gap.model.problem import Start
from bench.gap.model.world import Indices
from sims.base import Array

RESPONSE = 0.1
"""Finite differences move a parameter until the observation changes by this share of its noise,
RMS.
"""
FIRST_STEP = 1e-4
"""The first one, before the response is known, as a share of a parameter's bounds."""
FIRST_STATE_STEP = 1e-5
"""The first one of an initial state, SI units."""
LARGEST_STEP = 1e-2
"""The largest one, as a share of a parameter's bounds; of an initial state, SI units."""
SMALLEST_STEP = 1e-5
"""The smallest one, as a share of the largest: below it rounding is in the quotient."""
ENDLESS = 1e30
"""A change beyond it is none: the motion explodes, and says nothing of one near the data. Its
square is a number still.
"""


def followed(changes: Array) -> Mask:
    """Where a change is one that the simulator can follow; neither NaN nor infinite are."""
    # two masks, where a modulus would be a copy of the largest arrays there are
    near: Mask = (changes > -ENDLESS) & (changes < ENDLESS)
    return near


def displaced(start: Start, free: Indices, steps: Array, unknown: Indices) -> tuple[Array, Array]:
    """Parameters (1 + q + n, P) and initial states (1 + q + n, R, s): as they are, then each
    unknown moved by its step, each of n initial states in all runs at once.
    """
    q, count = free.size, unknown.size
    theta = np.tile(start.theta, (1 + q + count, 1))
    states = np.tile(start.states, (1 + q + count, 1, 1))
    for j, place in enumerate(free):
        theta[1 + j, place] += steps[j]
    # no run's initial state touches another run: one lane has the derivatives of all
    for j, place in enumerate(unknown):
        states[1 + q + j, :, place] += steps[q + place]
    return theta, states


def difference_steps(jacobian: Array, noise: Noise, widths: Array) -> Array:
    """(q + s,) steps of finite differences that move the runs by `RESPONSE` of the noise.

    Args:
        jacobian: (R, T, C, q + s) by an earlier difference.
        noise: of each channel.
        widths: (q,) the ranges of the parameters' bounds.
    """
    squares = np.square(jacobian / noise.sigma[:, None])
    responses = np.sqrt(np.mean(squares, axis=(0, 1, 2)))
    states = np.full(len(responses) - len(widths), LARGEST_STEP)
    largest = np.concatenate([LARGEST_STEP * widths, states])
    # an unknown without any response is moved as far as may be
    with np.errstate(divide="ignore"):
        wanted = RESPONSE / np.where(responses > 0, responses, 1e-300)
    # below the least step rounding would be the difference, above the largest one curvature
    steps: Array = np.clip(wanted, SMALLEST_STEP * largest, largest)
    return steps
