"""States of effects that go on beside a robot's motion, of all lanes at once.

A state's rate r(w) is taken for linear in it over a step h, so that what is stiff is stepped
exactly,

    w(t + h) = w + h phi(h dr/dw) r(w),  phi(z) = (e^z - 1) / z                             (1)

(the exponential Rosenbrock-Euler method: M. Hochbruck, A. Ostermann, Acta Numerica 19 (2010), eq.
2.23), with the velocity in the middle of the step. What acts over a step is asked half of it later.
"""

from __future__ import annotations

import numpy as np

from sims.base import Array
from sims.robot.moment import RobotMoment
from sims.system import Hidden, Moment, State

NUDGE = 1e-6
"""Of a state, by which its rate is differentiated."""


def advanced(effect: Hidden, c: Array, moment: Moment, state: State, step: float) -> State:
    """Its state after so many seconds at this velocity."""
    _, rate = effect.act(c, moment, state)
    _, nudged = effect.act(c, moment, State(state.x, state.v + NUDGE))
    z = step * (nudged - rate) / NUDGE
    near = np.abs(z) < 1e-6
    phi = np.where(near, 1.0 + 0.5 * z, np.expm1(z) / np.where(near, 1.0, z))
    v = state.v + step * phi * rate  # (1)
    return State(state.x + 0.5 * step * (state.v + v), v)


def along(effect: Hidden, c: Array, moment: RobotMoment, step: float) -> State:
    """Its states (S + 1, 1) at the beginnings of steps and at the end of a motion that is known.

    Args:
        effect: at its place.
        c: (K, 1, 1) its coefficients.
        moment: the middle of each step, (S,) lanes.
        step: seconds.
    """
    steps = len(moment.x)
    state = effect.begin(c, moment.only(0))
    own = np.repeat(c, steps, axis=1)
    zero = np.zeros((steps, 1))

    def rate(w: float, x: float) -> Array:
        return effect.act(own, moment, State(zero + x, zero + w))[1]

    none, whole, half = rate(0.0, 0.0), rate(1.0, 0.0), rate(0.5, 1.0)
    if np.allclose(half, 0.5 * (none + whole), rtol=1e-9, atol=0.0):
        return _linear(state, step * none, step * (whole - none))
    states = [state]
    for k in range(steps):
        states.append(advanced(effect, c, moment.only(k), states[-1], step))
    return State(np.concatenate([s.x for s in states]), np.concatenate([s.v for s in states]))


def _linear(state: State, grown: Array, z: Array) -> State:
    """The same of what is linear in its state all the way: of (1) h r(0) and h dr/dw, (S, 1)."""
    near = np.abs(z) < 1e-6
    added = grown * np.where(near, 1.0 + 0.5 * z, np.expm1(z) / np.where(near, 1.0, z))
    w = float(state.v[0, 0])
    gone = [w]
    for kept, more in zip(np.exp(z[:, 0]).tolist(), added[:, 0].tolist(), strict=True):
        w = kept * w + more
        gone.append(w)
    v = np.array(gone)[:, None]
    return State(np.zeros_like(v) + state.x, v)
