"""Reload written model files, and compare their numbers and motion with the intended model."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from sims.base import Array
from sims.memory import release_free_memory
from sims.robot.causes import one_by_one
from sims.robot.changes import apply
from sims.robot.inertia import LEAST
from sims.robot.model import Robot
from sims.robot.precise import unlike
from sims.robot.quiet import quiet
from sims.robot.writing import SAME, Causes, Written

NEAR = 1e-9
"""Tolerance between the positions of two motions, in rad or m (absolute) and relative."""

SECONDS = 1.0
"""Duration of the compared motion, in seconds."""

MOST = 2000
"""Maximum number of steps of the compared motion."""

_OF_URDF = ("body_mass", "body_ipos", "dof_damping", "dof_frictionloss")
"""Model fields that a URDF specifies, in addition to the inertia tensors."""


def check(robot: Robot, causes: Causes, done: Written) -> None:
    """Reload each written file from a temporary folder, and compare it with the intended model.

    Args:
        robot: robot as read from its model file.
        causes: causes that were written.
        done: the written files.

    Raises:
        RuntimeError: a number or the motion differs; names the field. This is a program error.
    """
    with tempfile.TemporaryDirectory() as folder:
        if done.xml is not None:
            path = Path(folder) / "extended.xml"
            path.write_bytes(done.xml.encode())
            _check_mjcf(done, path)
            release_free_memory()
        if done.urdf is not None:
            path = Path(folder) / "extended.urdf"
            path.write_bytes(done.urdf.encode())
            _check_urdf(robot, causes, path)


def _check_mjcf(done: Written, path: Path) -> None:
    """Compare a written MJCF with the intended model."""
    import mujoco

    with quiet():
        model = mujoco.MjModel.from_xml_path(str(path))
    _compare(model, done.applied.model, path.name)


def _check_urdf(robot: Robot, causes: Causes, path: Path) -> None:
    """Compare a written URDF with the model file with the causes that a URDF can contain."""
    from sims.robot.reading import read
    from sims.robot.urdf_out import UrdfWriter

    writer = UrdfWriter(robot, "")
    held = {c.name: c.numbers for c in one_by_one(robot, causes) if writer.write(c) is None}
    wanted = apply(read(robot.path), held).model
    release_free_memory()
    found = read(path).compiled
    for name in _OF_URDF:
        one, other = getattr(found, name), getattr(wanted, name)
        if one.shape != other.shape or not np.allclose(one, other, rtol=SAME, atol=SAME):
            raise RuntimeError(f"extended.urdf is not as it was meant: {name}")
    # The axes of two equal moments are arbitrary, so whole tensors are compared.
    one, other = _tensors(found), _tensors(wanted)
    if not np.allclose(one, other, rtol=SAME, atol=max(NEAR * np.abs(other).max(), LEAST)):
        raise RuntimeError("extended.urdf is not as it was meant: body_inertia")
    for model in (wanted, found):
        # A URDF does not specify the stiffness of friction, and colliding shapes may be meshes
        # elsewhere.
        _without_contacts(model)
        for name in ("dof_solref", "dof_solimp", "body_inertia", "body_iquat"):
            getattr(model, name)[:] = getattr(found, name)
    _compare_motion(found, wanted, "extended.urdf")


def _tensors(model: Any) -> Array:
    """Compute inertia tensors (N, 3, 3) about the centres of mass, in the axes of the bodies."""
    import mujoco

    turns = np.zeros((model.nbody, 9))
    for turn, quat in zip(turns, model.body_iquat, strict=True):
        mujoco.mju_quat2Mat(turn, quat)
    axes = turns.reshape(-1, 3, 3)
    result: Array = np.einsum("nij,nj,nkj->nik", axes, model.body_inertia, axes)
    return result


def _without_contacts(model: Any) -> None:
    import mujoco

    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)


def _compare(found: Any, wanted: Any, name: str) -> None:
    differs = unlike(found, wanted, SAME)
    if differs:
        raise RuntimeError(f"{name} is not as it was meant: {differs}")
    _compare_motion(found, wanted, name)


def _compare_motion(found: Any, wanted: Any, name: str) -> None:
    one, other = moved(found), moved(wanted)
    if not np.allclose(one, other, rtol=NEAR, atol=NEAR, equal_nan=True):
        error = float(np.nanmax(np.abs(one - other)))
        raise RuntimeError(f"{name} does not move as it was meant: qpos differs by {error:.2g}")


def moved(model: Any) -> Array:
    """Simulate a test motion (S, nq) from a displaced pose with nonzero controls."""
    import mujoco
    from mujoco import rollout

    data = mujoco.MjData(model)
    # All coordinates get different values, so that swapped coordinates are detected.
    mujoco.mj_integratePos(model, data.qpos, 0.1 + 0.05 * np.sin(np.arange(model.nv)), 1.0)
    low, high = model.actuator_ctrlrange.T
    middle, half = (low + high) / 2.0, (high - low) / 2.0
    limited = model.actuator_ctrllimited.astype(bool)
    signs = 0.5 * np.cos(np.arange(model.nu))
    control = np.where(limited, middle + half * signs, signs)
    steps = min(int(SECONDS / model.opt.timestep), MOST)
    state = np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    controls = np.tile(control, (1, steps, 1))
    made, _ = rollout.rollout(model, data, state, controls)
    result: Array = made[0, :, 1 : 1 + model.nq]
    return result
