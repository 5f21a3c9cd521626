"""Reload written model files, and compare their numbers and motion with the intended model."""

from __future__ import annotations

import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from sims.core.freed_memory import release_free_memory
from sims.core.simulator import Array
from sims.robot.export.apply_causes import apply_causes
from sims.robot.export.mjcf_attributes import UnstatableCauseError
from sims.robot.export.model_comparison import EQUAL_NUMBERS_TOLERANCE, find_first_difference
from sims.robot.export.write_model_file import WrittenModelFiles
from sims.robot.fitted_causes import CauseCoefficients, expand_families
from sims.robot.inertia_tensors import MIN_MOMENT, compute_inertia_tensors
from sims.robot.mujoco_messages import capture_mujoco_warnings
from sims.robot.robot_model import RobotModel

MOTION_TOLERANCE = 1e-9
"""Tolerance between the positions of two motions, in rad or m (absolute) and relative."""

COMPARED_SECONDS = 1.0
"""Duration of the compared motion, in seconds."""

MAX_COMPARED_STEPS = 2000
"""Maximum number of steps of the compared motion."""

_URDF_FIELDS = ("body_mass", "body_ipos", "dof_damping", "dof_frictionloss")
"""Model fields that a URDF specifies, in addition to the inertia tensors."""

_UNCOMPARED_FIELDS = (
    *("dof_solref", "dof_solimp", "body_inertia", "body_iquat"),
    *("dof_invweight0", "body_invweight0"),
)
"""Model fields that a URDF does not specify, or that have been compared before.

Inverse weights belong to the reference pose, which is another one if a joint's zero has moved.
"""
MEAN_DISPLACEMENT = 0.1
"""Mean displacement of the joints from the reference pose in the check, rad or m."""
DISPLACEMENT_AMPLITUDE = 0.05
"""Largest difference of a joint's displacement from the mean, rad or m."""


def check_written_files(
    robot: RobotModel, causes: CauseCoefficients, written_files: WrittenModelFiles
) -> None:
    """Reload each written file from a temporary folder, and compare it with the intended model.

    A program error in the writers is detected in this way before the user gets a wrong file.

    Args:
        robot: robot as read from its model file.
        causes: causes that were written.
        written_files: the written files: an MJCF, a URDF, or both.

    Raises:
        RuntimeError: a number or the motion differs; names the field. This is a program error.
    """
    import mujoco

    with tempfile.TemporaryDirectory() as folder:
        if written_files.xml is not None:
            path = Path(folder) / "extended.xml"
            path.write_bytes(written_files.xml.encode())
            with capture_mujoco_warnings():
                model = mujoco.MjModel.from_xml_path(str(path))
            target_model = written_files.applied.model
            difference = find_first_difference(model, target_model, EQUAL_NUMBERS_TOLERANCE)
            if difference:
                raise RuntimeError(f"{path.name} differs from the intended model: {difference}")
            _compare_motion(model, target_model, path.name)
            release_free_memory()
        if written_files.urdf is not None:
            path = Path(folder) / "extended.urdf"
            path.write_bytes(written_files.urdf.encode())
            _check_urdf(robot, causes, path)


def _check_urdf(robot: RobotModel, causes: CauseCoefficients, path: Path) -> None:
    """Check that a written URDF loads as the model with all causes that a URDF can express.

    1. Apply the causes that a URDF can state to the original model.
    2. Load the written URDF.
    3. Compare fields and inertia tensors.
    4. Compare a test motion, without contacts, and with equal friction stiffness, which a URDF
       cannot state.

    Args:
        robot: robot as read from its model file, which is read again.
        causes: coefficients of all causes.
        path: path of the written URDF.

    Raises:
        RuntimeError: fields, inertia tensors or the motion differ.
    """
    import mujoco

    from sims.robot.export.urdf_writer import UrdfWriter
    from sims.robot.parsing.read_model_file import read_robot

    # 1. Original model with the causes. A writer tells which of them a URDF can state.
    writer = UrdfWriter(robot, "")
    urdf_causes = {}
    for cause in expand_families(robot, causes):
        with suppress(UnstatableCauseError):
            writer.write(cause)
            urdf_causes[cause.name] = cause.numbers
    target_model = apply_causes(read_robot(robot.path), urdf_causes).model
    release_free_memory()
    # 2. Written URDF.
    reloaded_model = read_robot(path).compiled
    # 3. Fields. The axes of two equal moments are arbitrary, so whole tensors are compared.
    reloaded_tensors, target_tensors = (
        compute_inertia_tensors(m.body_iquat, m.body_inertia)
        for m in (reloaded_model, target_model)
    )
    tensor_tolerance = max(MOTION_TOLERANCE * np.abs(target_tensors).max(), MIN_MOMENT)
    # Name of the field, values in the written and in the intended model, and tolerance.
    comparisons = [
        (name, getattr(reloaded_model, name), getattr(target_model, name), 0.0)
        for name in _URDF_FIELDS
    ]
    comparisons.append(("body_inertia", reloaded_tensors, target_tensors, tensor_tolerance))
    for name, reloaded_values, target_values, tolerance in comparisons:
        if reloaded_values.shape != target_values.shape or not np.allclose(
            reloaded_values,
            target_values,
            rtol=EQUAL_NUMBERS_TOLERANCE,
            atol=max(tolerance, EQUAL_NUMBERS_TOLERANCE),
        ):
            raise RuntimeError(f"extended.urdf differs from the intended model: {name}")
    # 4. Motion. Colliding shapes may be meshes in other folders. Fields that a URDF cannot state
    # become equal, so that only differences count that it can state.
    for model in (target_model, reloaded_model):
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        for name in _UNCOMPARED_FIELDS:
            getattr(model, name)[:] = getattr(reloaded_model, name)
    _compare_motion(reloaded_model, target_model, "extended.urdf")


def _compare_motion(reloaded_model: Any, target_model: Any, name: str) -> None:
    """Check that two models move alike in a short test simulation from the same pose.

    This detects differences in fields that are not compared, and swapped elements.

    Args:
        reloaded_model: model compiled from the written file.
        target_model: intended model.
        name: name of the file in messages.

    Raises:
        RuntimeError: the positions differ by more than `MOTION_TOLERANCE`.
    """
    # The reference poses may differ, since a URDF states a moved zero of a joint as a turned frame.
    # So one pose is used for both.
    pose = displace_reference_pose(target_model)
    reloaded_motion = simulate_test_motion(reloaded_model, pose)
    target_motion = simulate_test_motion(target_model, pose)
    if not np.allclose(
        reloaded_motion, target_motion, rtol=MOTION_TOLERANCE, atol=MOTION_TOLERANCE, equal_nan=True
    ):
        error = float(np.nanmax(np.abs(reloaded_motion - target_motion)))
        raise RuntimeError(f"{name} does not move as intended: qpos differs by {error:.2g}")


def displace_reference_pose(model: Any) -> Array:
    """Return a pose (nq,) near the reference pose of a compiled model, for a test motion.

    All coordinates have different displacements, so that swapped ones are detected.

    Args:
        model: the mujoco.MjModel.
    """
    import mujoco

    pose: Array = model.qpos0.copy()
    displacements = MEAN_DISPLACEMENT + DISPLACEMENT_AMPLITUDE * np.sin(np.arange(model.nv))
    mujoco.mj_integratePos(model, pose, displacements, 1.0)
    return pose


def simulate_test_motion(model: Any, pose: Array | None = None) -> Array:
    """Simulate a test motion with nonzero controls.

    Each actuator has a constant control within its range, different for each actuator, so that
    swapped actuators change the motion.

    Args:
        model: the mujoco.MjModel.
        pose: initial pose (nq,); that of `displace_reference_pose` by default.

    Returns:
        (S, nq) positions after each of S steps.
    """
    import mujoco
    from mujoco import rollout

    data = mujoco.MjData(model)
    data.qpos[:] = displace_reference_pose(model) if pose is None else pose
    low, high = model.actuator_ctrlrange.T
    middle, half_range = (low + high) / 2.0, (high - low) / 2.0
    is_limited = model.actuator_ctrllimited.astype(bool)
    # Between -0.5 and 0.5: a share of half the range, or the control itself without a range.
    shares = 0.5 * np.cos(np.arange(model.nu))
    control = np.where(is_limited, middle + half_range * shares, shares)
    steps = min(int(COMPARED_SECONDS / model.opt.timestep), MAX_COMPARED_STEPS)
    state = np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    controls = np.tile(control, (1, steps, 1))
    states, _ = rollout.rollout(model, data, state, controls)
    # A full state begins with the time, followed by the positions.
    result: Array = states[0, :, 1 : 1 + model.nq]
    return result
