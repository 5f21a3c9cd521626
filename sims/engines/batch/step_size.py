"""Step-size selection of the batch engine, from stiffness and damping of the motion.

At the initial state, and at rest at zero, the change of the forces with a small change of position
and of velocity is computed for some steps of the run. For x'' = -w^2 x - c x', the fourth-order
method with step h advances the phase by w h with an error of

    (w h)^5 / 120 + ...                                                    (1)

(the first omitted term of the exponential's series: E. Hairer, S. P. Norsett, G. Wanner, Solving
Ordinary Differential Equations I, 1993, section II.1). The phase may advance by
`MAX_PHASE_PER_STEP` radians per
step, which keeps that error near 2e-7 of the phase; a decay may have c h up to
`MAX_DECAY_PER_STEP`.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sims.core.simulator import Array
from sims.core.system import IntegrationBatch
from sims.engines.batch.force_field import ForceField

MAX_PHASE_PER_STEP = 0.07
"""Maximum phase of an oscillation per step, in radians: error (1) is then 2e-7 of the phase."""
MAX_DECAY_PER_STEP = 0.5
"""Maximum step size in time constants of a decay."""
MAX_STEP_DIVISIONS = 64
"""Maximum number of parts into which a step is divided."""
SAMPLED_INSTANTS = 6
"""Number of times in a run at which the forces are evaluated, evenly distributed over its steps."""
FINITE_DIFFERENCE_STEP = 1e-5
"""Finite difference of position (m or rad) and of velocity (m/s or rad/s) for slopes."""


def choose_step_divisions(
    lanes: IntegrationBatch, field: ForceField, spans: Array, turn: float = MAX_PHASE_PER_STEP
) -> Array:
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
        field.set_inputs(inputs)
        for x, v in ((lanes.x, lanes.v), (0.0 * lanes.x, 0.0 * lanes.v)):
            turning, decaying = _rates(field, x, v)
            turned = np.sqrt(turning) * spans  # w h, radians
            decayed = decaying * spans * (MAX_PHASE_PER_STEP / MAX_DECAY_PER_STEP)  # c h, scaled
            needed = np.maximum(turned, decayed) / turn
            # `fmax` instead of `maximum` ignores NaN from overflow; one part is then sufficient.
            parts = np.fmax(parts, np.ceil(needed))
    return np.minimum(parts, MAX_STEP_DIVISIONS)


def _instants(lanes: IntegrationBatch) -> Iterator[dict[str, Array]]:
    """Yield the inputs of each element at some of its steps.

    Steps of zero length do not count, since they depend on the other elements.
    """
    if not lanes.inputs or not lanes.steps.size:
        yield {name: np.zeros((len(lanes.x), 1)) for name in lanes.inputs}
        return
    steps = lanes.steps[:1] if lanes.steps.strides[0] == 0 else lanes.steps
    done = np.cumsum(steps > 0, axis=1)
    lane = np.arange(len(lanes.x))
    for share in np.linspace(0.0, 1.0, SAMPLED_INSTANTS):
        at = (done >= np.ceil(share * done[:, -1:])).argmax(axis=1)
        yield {name: values[lane, at][:, None] for name, values in lanes.inputs.items()}


def _rates(field: ForceField, x: Array, v: Array) -> tuple[Array, Array]:
    """Return the largest slopes of the acceleration with position and with velocity.

    Args:
        field: forces on the batch.
        x: (L, D) positions.
        v: (L, D) velocities.

    Returns:
        Slopes (L, 1) with position in 1/s^2, and with velocity in 1/s.
    """
    t = np.zeros_like(field.mass)
    base = field.compute_force(t, x, v)
    turning = np.zeros_like(t)
    decaying = np.zeros_like(t)
    for d in range(x.shape[1]):
        nudge = np.zeros_like(x)
        nudge[:, d] = FINITE_DIFFERENCE_STEP
        moved = field.compute_force(t, x + nudge, v) - base
        # Both velocities are on one side of rest: a discontinuity at rest is not a faster decay.
        sped = field.compute_force(t, x, v + nudge + nudge) - field.compute_force(t, x, v + nudge)
        for change, largest in ((moved[:, d : d + 1], turning), (sped[:, d : d + 1], decaying)):
            slope = np.abs(change / (FINITE_DIFFERENCE_STEP * field.mass))
            np.fmax(largest, slope, out=largest)
    return turning, decaying
