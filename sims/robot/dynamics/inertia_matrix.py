"""The joint-space inertia matrix of a robot in the reference pose of its model file."""

from __future__ import annotations

from typing import Any

import numpy as np

from sims.core.simulator import Array


def inertia_matrix(model: Any) -> Array:
    """Return the inertia matrix (nv, nv) of a MuJoCo model in its reference pose `qpos0`."""
    import mujoco

    data, matrix = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, matrix)
    return matrix
