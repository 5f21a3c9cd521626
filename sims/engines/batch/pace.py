"""Step-size selection of the batch engine, from stiffness and damping of the motion.

At the initial state, and at rest at zero, the change of the forces with a small change of position
and of velocity is computed for some steps of the run. For x'' = -w^2 x - c x', the fourth-order
method with step h advances the phase by w h with an error of

    (w h)^5 / 120 + ...                                                    (1)

(the first omitted term of the exponential's series: E. Hairer, S. P. Norsett, G. Wanner, Solving
Ordinary Differential Equations I, 1993, section II.1). The phase may advance by `TURN` radians per
step, which keeps that error near 2e-7 of the phase; a decay may have c h up to `DECAY`.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sims.base import Array
from sims.engines.batch.field import Field
from sims.system import Lanes

TURN = 0.07
"""Maximum phase of an oscillation per step, in radians: error (1) is then 2e-7 of the phase."""
DECAY = 0.5
"""Maximum step size in time constants of a decay."""
DIVISIONS = 64
"""Maximum number of parts into which a step is divided."""
INSTANTS = 6
"""Number of times in a run at which the forces are evaluated, evenly distributed over its steps."""
NUDGE = 1e-5
"""Finite difference of position (m or rad) and of velocity (m/s or rad/s) for slopes."""


def divisions(lanes: Lanes, field: Field, spans: Array, turn: float = TURN) -> Array:
    """Return the number of parts (L, 1) into which the steps must be divided.

    An oscillation then advances by at most `turn` radians in each part, and a decay by at most a
    proportional share. If no number can be computed, it is one.

    Args:
        lanes: batch to integrate.
        field: forces on the batch.
        spans: (L, 1) step sizes in seconds.
        turn: maximum phase per step in radians.
    """
    parts = np.maximum(np.ceil(lanes.system.fastest * spans / turn), 1.0)
    for inputs in _instants(lanes):
        field.feel(inputs)
        for x, v in ((lanes.x, lanes.v), (0.0 * lanes.x, 0.0 * lanes.v)):
            turning, decaying = _rates(field, x, v)
            turned = np.sqrt(turning) * spans  # w h, radians
            decayed = decaying * spans * (TURN / DECAY)  # c h, scaled
            needed = np.maximum(turned, decayed) / turn
            # `fmax` instead of `maximum` ignores NaN from overflow; one part is then sufficient.
            parts = np.fmax(parts, np.ceil(needed))
    return np.minimum(parts, DIVISIONS)


def _instants(lanes: Lanes) -> Iterator[dict[str, Array]]:
    """Yield the inputs of each element at some of its steps.

    Steps of zero length do not count, since they depend on the other elements.
    """
    if not lanes.inputs or not lanes.steps.size:
        yield {name: np.zeros((len(lanes.x), 1)) for name in lanes.inputs}
        return
    steps = lanes.steps[:1] if lanes.steps.strides[0] == 0 else lanes.steps
    done = np.cumsum(steps > 0, axis=1)
    lane = np.arange(len(lanes.x))
    for share in np.linspace(0.0, 1.0, INSTANTS):
        at = (done >= np.ceil(share * done[:, -1:])).argmax(axis=1)
        yield {name: values[lane, at][:, None] for name, values in lanes.inputs.items()}


def _rates(field: Field, x: Array, v: Array) -> tuple[Array, Array]:
    """Return the largest slopes of the acceleration with position and with velocity.

    Args:
        field: forces on the batch.
        x: (L, D) positions.
        v: (L, D) velocities.

    Returns:
        Slopes (L, 1) with position in 1/s^2, and with velocity in 1/s.
    """
    t = np.zeros_like(field.mass)
    base = field.force(t, x, v)
    turning = np.zeros_like(t)
    decaying = np.zeros_like(t)
    for d in range(x.shape[1]):
        nudge = np.zeros_like(x)
        nudge[:, d] = NUDGE
        moved = field.force(t, x + nudge, v) - base
        # Both velocities are on one side of rest: a discontinuity at rest is not a faster decay.
        sped = field.force(t, x, v + nudge + nudge) - field.force(t, x, v + nudge)
        for change, largest in ((moved[:, d : d + 1], turning), (sped[:, d : d + 1], decaying)):
            slope = np.abs(change / (NUDGE * field.mass))
            np.fmax(largest, slope, out=largest)
    return turning, decaying
