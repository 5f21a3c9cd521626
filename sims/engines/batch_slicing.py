"""Select parts of a batch, and join the trajectories of parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sims.core.engine import IntegrationBatch, Trajectories
from sims.core.simulator import Indices


def slice_batch(batch: IntegrationBatch, i: Indices) -> IntegrationBatch:
    """Return the part of a batch with the elements i (n,).

    Engines use it to simulate some elements separately. All elements in their order give the
    batch itself, and steps that all elements share are not copied.
    """
    if i.size == len(batch.x) and (i[1:] > i[:-1]).all():
        return batch
    if batch.steps.strides[0] == 0:  # steps shared by all elements stay shared
        steps = np.broadcast_to(batch.steps[0], (i.size, batch.steps.shape[1]))
    else:
        steps = batch.steps[i]
    return replace(
        batch,
        theta=batch.theta[i],
        constants={name: values[i] for name, values in batch.constants.items()},
        x=batch.x[i],
        v=batch.v[i],
        steps=steps,
        inputs={name: values[i] for name, values in batch.inputs.items()},
        effects=tuple((effect, c[:, i]) for effect, c in batch.effects),
    )


def join_trajectories(
    parts: list[tuple[Indices, Trajectories]], batch: IntegrationBatch
) -> Trajectories:
    """Join the trajectories of parts of a batch, in the order of the batch.

    Args:
        parts: indices (n,) of the elements of each part, with their trajectories.
        batch: whole batch.

    Returns:
        The trajectories of the whole batch.
    """
    first, motion = parts[0]
    if len(parts) == 1 and (first == np.arange(len(batch.x))).all():
        return motion
    count, dim = batch.x.shape
    records = batch.steps.shape[1] // batch.steps_per_sample + 1
    joined_states = np.empty((3, count, records, dim))
    for i, motion in parts:
        joined_states[:, i] = motion.x, motion.v, motion.a
    return Trajectories(*joined_states)
