"""Hidden states of effects, such as the deflection of bristles in a friction model: integration.

The rate r(w) of a state is linearised in w over a step h, so that stiff states are integrated
exactly:

    w(t + h) = w + h phi(h dr/dw) r(w),  phi(z) = (e^z - 1) / z                             (1)

(the exponential Rosenbrock-Euler method: M. Hochbruck, A. Ostermann, Acta Numerica 19 (2010), eq.
2.23), with the velocity at the middle of the step. Forces over a step are evaluated half a step
later.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sims.core.effect import HiddenState, HiddenStateEffect
from sims.core.simulator import Array
from sims.core.system import StateSnapshot
from sims.robot.state_snapshots import RobotSnapshot

MIN_EXPONENT = 1e-6
"""Absolute exponent below which (exp(z) - 1) / z is computed by its series."""


LINEARITY_TOLERANCE = 1e-9
"""Relative deviation from linearity up to which the rate of a hidden state counts as linear."""


STATE_STEP = 1e-6
"""Step of the state variable for the finite-difference derivative of its rate."""


def compute_hidden_state_forces(
    hidden: Sequence[tuple[HiddenStateEffect, Array]],
    snapshots: tuple[RobotSnapshot, RobotSnapshot],
    states: Sequence[HiddenState],
    step: float,
) -> tuple[Array, list[HiddenState]]:
    """Advance hidden states of effects, and compute their forces afterwards.

    A hidden state is a variable that an effect has in addition to the state of the robot, such as
    the deflection of bristles in a friction model. In batch elements in which the first coefficient
    of an effect is not above zero, it exerts no force.

    Shapes: L batch elements, D joints, K coefficients.

    Args:
        hidden: effects with their coefficients (K, L, 1).
        snapshots: snapshots during the interval, with which the states advance; and at its end, at
            which the forces are evaluated.
        states: hidden states of the effects at the beginning.
        step: length of the interval in seconds.

    Returns:
        Total force (L, D) and hidden states at the end of the interval.
    """
    during, end = snapshots
    total = np.zeros_like(end.x)
    later_states = []
    for (effect, c), state in zip(hidden, states, strict=True):
        after = advance_state(effect, c, during, state, step)
        force, _ = effect.act(c, end, after)  # the rate of the state is not needed here
        total = total + np.where(c[0] > 0, force, 0.0)
        later_states.append(after)
    return total, later_states


def advance_state(
    effect: HiddenStateEffect, c: Array, snapshot: StateSnapshot, state: HiddenState, step: float
) -> HiddenState:
    """Advance a hidden state w by one exponential Rosenbrock-Euler step (1).

    With the rate r(w) and the step h, w changes by h phi(z) r, z = h dr/dw and
    phi(z) = (e^z - 1) / z, which is exact if the rate is linear in w. The derivative dr/dw is a
    difference quotient. In `HiddenState`, w is the velocity v; the position x is its integral.

    Shapes: L batch elements, K coefficients.

    Args:
        effect: effect with the hidden state.
        c: (K, L, 1) coefficients of the effect.
        snapshot: state of the system, constant over the step.
        state: hidden state at the beginning of the step, (L, 1).
        step: step length in seconds.

    Returns:
        The hidden state at the end of the step, (L, 1).
    """
    _, rate = effect.act(c, snapshot, state)
    _, perturbed_rate = effect.act(c, snapshot, HiddenState(state.x, state.v + STATE_STEP))
    z = step * (perturbed_rate - rate) / STATE_STEP
    is_small = np.abs(z) < MIN_EXPONENT
    # For small z, the first two terms of the series.
    phi = np.where(is_small, 1.0 + 0.5 * z, np.expm1(z) / np.where(is_small, 1.0, z))
    v = state.v + step * phi * rate  # (1)
    return HiddenState(state.x + 0.5 * step * (state.v + v), v)


def integrate_state(
    effect: HiddenStateEffect, c: Array, snapshots: RobotSnapshot, step: float
) -> HiddenState:
    """Integrate the hidden state of an effect along a known motion.

    The effect does not change the motion. If the rate of the state is a linear function of the
    state at all times, which is tested with three values of it, a fast recursion is used. Otherwise
    the state advances step by step.

    Args:
        effect: effect at its place.
        c: (K, 1, 1) the K coefficients of the effect.
        snapshots: states of the robot at the middle of each of the S steps, stored as S batch
            elements.
        step: step length in seconds.

    Returns:
        Hidden states (S + 1, 1): at the beginning of each step, and at the end of the motion.
    """
    steps = len(snapshots.x)
    state = effect.begin(c, snapshots.select_element(0))
    coefficients = np.repeat(c, steps, axis=1)
    zero = np.zeros((steps, 1))

    def compute_rate(w: float, x: float) -> Array:
        """Return the rate (S, 1) of the state at velocity w and position x, in all steps."""
        _, rate = effect.act(coefficients, snapshots, HiddenState(zero + x, zero + w))
        return rate

    # The rate is linear if that at w = 1/2 is the mean of those at 0 and 1. There the position is
    # another one, on which the rate must not depend.
    rate_at_zero, rate_at_one = compute_rate(0.0, 0.0), compute_rate(1.0, 0.0)
    rate_at_half = compute_rate(0.5, 1.0)
    if np.allclose(
        rate_at_half, 0.5 * (rate_at_zero + rate_at_one), rtol=LINEARITY_TOLERANCE, atol=0.0
    ):
        return _integrate_linear_state(
            state, step * rate_at_zero, step * (rate_at_one - rate_at_zero)
        )
    states = [state]
    for k in range(steps):
        states.append(advance_state(effect, c, snapshots.select_element(k), states[-1], step))
    return HiddenState(np.concatenate([s.x for s in states]), np.concatenate([s.v for s in states]))


def _integrate_linear_state(state: HiddenState, change_at_zero: Array, z: Array) -> HiddenState:
    """Integrate a hidden state w whose rate r(w) = r(0) + w dr/dw is linear in each step.

    The step w + h phi(z) r(w), with phi(z) = (e^z - 1) / z and z = h dr/dw (1), is then the
    recursion w <- e^z w + phi(z) h r(0). In `HiddenState`, w is the velocity v. The position x is
    not integrated, since the rate does not depend on it; it keeps its initial value.

    Args:
        state: initial state, (1, 1).
        change_at_zero: (S, 1) h r(0) of each of S steps of length h.
        z: (S, 1) h dr/dw of each step.

    Returns:
        Hidden states (S + 1, 1).
    """
    is_small = np.abs(z) < MIN_EXPONENT
    changes = change_at_zero * np.where(
        is_small, 1.0 + 0.5 * z, np.expm1(z) / np.where(is_small, 1.0, z)
    )
    w = float(state.v[0, 0])
    values = [w]
    for factor, change in zip(np.exp(z[:, 0]).tolist(), changes[:, 0].tolist(), strict=True):
        w = factor * w + change
        values.append(w)
    v = np.array(values)[:, None]
    return HiddenState(np.zeros_like(v) + state.x, v)
