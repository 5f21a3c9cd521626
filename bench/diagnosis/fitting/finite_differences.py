"""Step sizes of finite differences for the unknowns of a model."""

from __future__ import annotations

import numpy as np

from bench.diagnosis.evaluation.noise_model import Mask, NoiseModel
from bench.diagnosis.evaluation.run_evaluator import Indices
from bench.diagnosis.fitting.fit_state import FitStart
from sims.core.simulator import Array

TARGET_RESPONSE_SIGMAS = 0.1
"""Target RMS change of the observations by a finite-difference step, in units of the noise."""
INITIAL_PARAMETER_STEP = 1e-4
"""Initial finite-difference step of a parameter, as a share of its range."""
INITIAL_STATE_STEP = 1e-5
"""Initial finite-difference step of an initial state, SI units."""
MAX_STEP = 1e-2
"""Maximum finite-difference step: a share of the range of a parameter; SI units for a state."""
MIN_STEP_RATIO = 1e-5
"""Minimum finite-difference step, as a share of the maximum; smaller steps suffer from rounding."""
MAX_RESPONSE = 1e30
"""Maximum magnitude of a usable derivative; its square is still finite.

Larger values come from an unstable motion, which says nothing about motions near the data.
"""


def is_finite_response(changes: Array) -> Mask:
    """Return a mask of usable changes: not NaN, and of a magnitude below `MAX_RESPONSE`."""
    # Two comparisons avoid the modulus, which would copy one of the largest arrays.
    is_finite: Mask = (changes > -MAX_RESPONSE) & (changes < MAX_RESPONSE)
    return is_finite


def build_displaced_inputs(
    start: FitStart, free: Indices, steps: Array, state_indices: Indices
) -> tuple[Array, Array]:
    """Build the inputs of a finite-difference Jacobian.

    The first entry is not displaced. Each further entry has one unknown displaced by its step; an
    initial state is displaced in all runs at once.

    Args:
        start: point of the derivatives.
        free: (q,) indices of the fitted parameters.
        steps: (q + s,) displacements.
        state_indices: (n,) indices of the initial states to displace.

    Returns:
        Parameters (1 + q + n, P) and initial states (1 + q + n, R, s).
    """
    q, count = free.size, state_indices.size
    theta = np.tile(start.theta, (1 + q + count, 1))
    states = np.tile(start.initial_states, (1 + q + count, 1, 1))
    for j, place in enumerate(free):
        theta[1 + j, place] += steps[j]
    # An initial state influences only its own run, so one batch element per run gives all
    # derivatives.
    for j, place in enumerate(state_indices):
        states[1 + q + j, :, place] += steps[q + place]
    return theta, states


def compute_difference_steps(jacobian: Array, noise: NoiseModel, widths: Array) -> Array:
    """Return steps (q + s,) that change the observations by `TARGET_RESPONSE_SIGMAS` of the noise.

    Args:
        jacobian: (R, T, C, q + s) derivatives from earlier finite differences.
        noise: noise of each channel.
        widths: (q,) widths of the parameter ranges.
    """
    squares = np.square(jacobian / noise.sigma[:, None])
    responses = np.sqrt(np.mean(squares, axis=(0, 1, 2)))
    states = np.full(len(responses) - len(widths), MAX_STEP)
    largest = np.concatenate([MAX_STEP * widths, states])
    # An unknown without any response gets the maximum step.
    with np.errstate(divide="ignore"):
        target_steps = TARGET_RESPONSE_SIGMAS / np.where(responses > 0, responses, 1e-300)
    # Below the minimum step rounding dominates, above the maximum step curvature.
    steps: Array = np.clip(target_steps, MIN_STEP_RATIO * largest, largest)
    return steps
