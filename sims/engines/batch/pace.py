"""How long a lane's steps may be, from how fast its own motion changes.

The forces are asked, at the lane's initial state and at rest at zero, at some instants of its run,
how they answer to a small change of position and of velocity. Of x'' = -w^2 x - c x' the
fourth-order method with step h turns by w h less its error of phase,

    (w h)^5 / 120 + ...                                                    (1)

(the first term of the exponential's series that it lacks: E. Hairer, S. P. Norsett, G. Wanner,
Solving Ordinary Differential Equations I, 1993, section II.1). An oscillation may turn by `TURN`
radians in a step, which keeps that error near 2e-7 of the phase; a decay may go through `DECAY` of
its time, c h.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sims.base import Array
from sims.engines.batch.field import Field
from sims.system import Lanes

TURN = 0.07
"""Radians by which an oscillation may turn in a step: (1) is then 2e-7 of the phase."""
DECAY = 0.5
"""Time constants of a decay that a step may last."""
DIVISIONS = 64
"""Parts of a step at most."""
INSTANTS = 6
"""Instants of a run at which the forces are asked, evenly over its steps."""
NUDGE = 1e-5
"""Change of position (m or rad) and of velocity (m/s or rad/s) over which slopes are taken."""


def divisions(lanes: Lanes, field: Field, spans: Array, turn: float = TURN) -> Array:
    """(L, 1) into how many parts steps of `spans` (L, 1) seconds must be divided; what cannot be
    told is one.

    An oscillation then turns by `turn` radians in each at most, and decay is held to a share in
    proportion.
    """
    parts = np.maximum(np.ceil(lanes.system.fastest * spans / turn), 1.0)
    for inputs in _instants(lanes):
        field.feel(inputs)
        for x, v in ((lanes.x, lanes.v), (0.0 * lanes.x, 0.0 * lanes.v)):
            turning, decaying = _rates(field, x, v)
            turned = np.sqrt(turning) * spans  # w h, radians
            decayed = decaying * spans * (TURN / DECAY)  # c h, in radians that count as much
            needed = np.maximum(turned, decayed) / turn
            # `fmax` and not `maximum`: what overflows tells nothing, and one part will do.
            parts = np.fmax(parts, np.ceil(needed))
    return np.minimum(parts, DIVISIONS)


def _instants(lanes: Lanes) -> Iterator[dict[str, Array]]:
    """Inputs of each lane at some of its own steps; waiting does not count, since it depends on the
    others.
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
    """(L, 1) largest change of acceleration with position, 1/s^2, and with velocity, 1/s."""
    t = np.zeros_like(field.mass)
    base = field.force(t, x, v)
    turning = np.zeros_like(t)
    decaying = np.zeros_like(t)
    for d in range(x.shape[1]):
        nudge = np.zeros_like(x)
        nudge[:, d] = NUDGE
        moved = field.force(t, x + nudge, v) - base
        # Beside rest and not across it: what jumps there decays no faster for it.
        sped = field.force(t, x, v + nudge + nudge) - field.force(t, x, v + nudge)
        for change, largest in ((moved[:, d : d + 1], turning), (sped[:, d : d + 1], decaying)):
            slope = np.abs(change / (NUDGE * field.mass))
            np.fmax(largest, slope, out=largest)
    return turning, decaying
