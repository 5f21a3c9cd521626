"""Select parts of a batch, and join the trajectories of parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sims.core.engine import IntegrationBatch, Trajectories
from sims.engines.ground_contact import Indices


def slice_batch(lanes: IntegrationBatch, i: Indices) -> IntegrationBatch:
    """Return the part of a batch with the elements i (n,)."""
    if i.size == len(lanes.x) and (i[1:] > i[:-1]).all():
        return lanes
    if lanes.steps.strides[0] == 0:  # steps shared by all elements stay shared
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


def join_trajectories(
    parts: list[tuple[Indices, Trajectories]], lanes: IntegrationBatch
) -> Trajectories:
    """Join the trajectories of parts of a batch, in the order of the batch.

    Args:
        parts: indices (n,) of the elements of each part, with their trajectories.
        lanes: whole batch.

    Returns:
        The trajectories of the whole batch.
    """
    first, motion = parts[0]
    if len(parts) == 1 and (first == np.arange(len(lanes.x))).all():
        return motion
    count, dim = lanes.x.shape
    records = lanes.steps.shape[1] // lanes.steps_per_sample + 1
    whole = np.empty((3, count, records, dim))
    for i, motion in parts:
        whole[:, i] = motion.x, motion.v, motion.a
    return Trajectories(*whole)
