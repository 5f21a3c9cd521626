"""How long a lane's steps may be, from how fast its own motion changes.

The forces are asked, at the lane's initial state and at rest at zero, at some instants of its run,
how they answer to a small change of position and of velocity. An oscillation may turn by `TURN`
radians in a step, which keeps the fourth-order method's error of phase near 2e-7 of the phase; a
decay may go through `DECAY` of its time.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sims.base import Array
from sims.engines.batch.field import Field
from sims.system import Lanes

TURN, DECAY = 0.07, 0.5
DIVISIONS = 64  # parts of a step at most
INSTANTS, NUDGE = 6, 1e-5


def divisions(lanes: Lanes, field: Field, spans: Array, turn: float = TURN) -> Array:
    """(L, 1) into how many parts steps of `spans` (L, 1) seconds must be divided; what cannot be
    told is one.

    An oscillation then turns by `turn` radians in each at most, and decay is held to a share in
    proportion.
    """
    parts = np.ones_like(spans)
    for inputs in _instants(lanes):
        field.feel(inputs)
        for x, v in ((lanes.x, lanes.v), (0.0 * lanes.x, 0.0 * lanes.v)):
            turning, decaying = _rates(field, x, v)
            needed = np.maximum(np.sqrt(turning) * spans, decaying * spans * (TURN / DECAY)) / turn
            parts = np.fmax(parts, np.ceil(needed))
    return np.minimum(parts, DIVISIONS)


def _instants(lanes: Lanes) -> Iterator[dict[str, Array]]:
    """Inputs of each lane at some of its own steps; waiting does not count, since it depends on the
    others.
    """
    if not lanes.inputs or not lanes.steps.size:
        yield {name: np.zeros((len(lanes.x), 1)) for name in lanes.inputs}
        return
    shared = lanes.steps.strides[0] == 0
    done = np.cumsum((lanes.steps[:1] if shared else lanes.steps) > 0, axis=1)
    lane = np.arange(len(lanes.x))
    for share in np.linspace(0.0, 1.0, INSTANTS):
        at = (done >= np.ceil(share * done[:, -1:])).argmax(axis=1)
        yield {name: values[lane, at][:, None] for name, values in lanes.inputs.items()}


def _rates(field: Field, x: Array, v: Array) -> tuple[Array, Array]:
    """(L, 1) largest change of acceleration with position, 1/s^2, and with velocity, 1/s."""
    t = np.zeros_like(field.mass)
    base = field.force(t, x, v)
    turning, decaying = np.zeros_like(t), np.zeros_like(t)
    for d in range(x.shape[1]):
        nudge = np.zeros_like(x)
        nudge[:, d] = NUDGE
        for which, largest in (
            (field.force(t, x + nudge, v), turning),
            (field.force(t, x, v + nudge), decaying),
        ):
            np.fmax(
                largest, np.abs((which - base)[:, d : d + 1] / (NUDGE * field.mass)), out=largest
            )
    return turning, decaying
