"""Parts of the lanes, and motions of parts put together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sims.engines.ground import Indices
from sims.system import Lanes, Motion


def take(lanes: Lanes, i: Indices) -> Lanes:
    """Some lanes, i (n,)."""
    if i.size == len(lanes.x) and (i[1:] > i[:-1]).all():
        return lanes
    if lanes.steps.strides[0] == 0:  # shared by all lanes, and shared it stays
        steps = np.broadcast_to(lanes.steps[0], (i.size, lanes.steps.shape[1]))
    else:
        steps = lanes.steps[i]
    return replace(
        lanes,
        theta=lanes.theta[i],
        constants={name: values[i] for name, values in lanes.constants.items()},
        x=lanes.x[i],
        v=lanes.v[i],
        steps=steps,
        inputs={name: values[i] for name, values in lanes.inputs.items()},
        effects=tuple((effect, c[:, i]) for effect, c in lanes.effects),
    )


def joined(parts: list[tuple[Indices, Motion]], lanes: Lanes) -> Motion:
    """Motions of parts of the lanes put together in the lanes' own order."""
    first, motion = parts[0]
    if len(parts) == 1 and (first == np.arange(len(lanes.x))).all():
        return motion
    count, dim = lanes.x.shape
    records = lanes.steps.shape[1] // lanes.every + 1
    whole = np.empty((3, count, records, dim))
    for i, motion in parts:
        whole[:, i] = motion.x, motion.v, motion.a
    return Motion(*whole)
