"""Free and ball joints: their initial states and small displacements.

No channel observes one of their coordinates, so none of them is estimated. Each run begins with the
values that the recording specifies, else with those of the model file. A pose is a position (free
joints only) and a unit quaternion (w, x, y, z). A small displacement d of it has three numbers for
each,

    position + d_p,   q exp(d_r / 2),                                                          (1)

along the world's axes for the position, and along the body's axes for the rotation. This is
MuJoCo's convention for velocities (MuJoCo, *Computation*, "Floating objects"; J. Solà,
arXiv:1711.02508, eqs. (101) and (190)).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sims.core.simulator import Array, InputError
from sims.recording.recorded_poses import (
    POSITION_AXES,
    QUATERNION_ENTRIES,
)
from sims.robot.robot_model import Joint, RobotModel

IndexArray = NDArray[np.intp]
MIN_QUATERNION_NORM = 1e-6
"""Minimum length of a valid quaternion."""
ANGULAR_VELOCITY_AXES = ("wx", "wy", "wz")
"""Axes of angular velocity, those of the body."""


class FloatingState(NamedTuple):
    """Poses (..., P) and velocities (..., F) of all floating joints."""

    pose: Array
    rate: Array


@dataclass(frozen=True, eq=False)
class FloatingJoints:
    """The floating joints of a model.

    Attributes:
        model: compiled model of the robot.
        joints: free and ball joints.
        positions: (P,) addresses in qpos.
        velocities: (F,) addresses in qvel.
    """

    model: Any
    joints: tuple[Joint, ...]
    positions: IndexArray
    velocities: IndexArray

    @classmethod
    def from_robot(cls, robot: RobotModel) -> FloatingJoints:
        """Return the floating joints of a robot, with their addresses in `qpos` and `qvel`.

        A floating joint is a free joint or a ball joint. A free joint has a position and a
        quaternion in `qpos`, 7 numbers, and a velocity and an angular velocity in `qvel`, 6
        numbers. A ball joint has only the quaternion and the angular velocity.
        """
        joints = tuple(joint for joint in robot.joints if not joint.has_one_coordinate)
        positions = [
            joint.position + k
            for joint in joints
            for k in range(len(_list_translation_axes(joint) + QUATERNION_ENTRIES))
        ]
        velocities = [
            joint.velocity + k
            for joint in joints
            for k in range(len(_list_translation_axes(joint) + ANGULAR_VELOCITY_AXES))
        ]
        return cls(
            robot.compiled, joints, np.array(positions, np.intp), np.array(velocities, np.intp)
        )

    def __bool__(self) -> bool:
        return bool(self.joints)

    def names(self) -> tuple[list[str], list[str]]:
        """Return the names of the pose entries (P), and those of the velocities (F).

        Examples are ``q.base.qw`` and ``qd.base.wx``.

        Returns:
            Names in the order of the addresses of all floating joints.
        """
        names = list(self.units())
        return (
            [name for name in names if name.startswith("q.")],
            [name for name in names if name.startswith("qd.")],
        )

    def units(self) -> dict[str, str]:
        """Return the units of positions and velocities by name.

        Positions are in m and velocities in m/s along the world's axes; quaternions have the unit
        1, and angular velocities rad/s.

        Returns:
            Units by name, such as ``q.base.x``: those of all positions and velocities of a joint,
            joint after joint.
        """
        return {
            name: unit
            for joint in self.joints
            for units in list_state_units(joint)
            for name, unit in units.items()
        }

    def states(self) -> dict[str, float]:
        """Return initial states by name: poses from the model file, and velocities of zero."""
        positions, velocities = self.names()
        poses = self.model.qpos0[self.positions].tolist()
        return dict(zip(positions, poses, strict=True)) | dict.fromkeys(velocities, 0.0)

    def get_initial_state(self, states: Mapping[str, float]) -> FloatingState:
        """Return the initial pose (P,) and velocity (F,) of a run, with normalised quaternions.

        The P entries and F velocities are those of all floating joints, in the order of `names`.

        Args:
            states: initial states by name, as in `names`.

        Raises:
            InputError: a quaternion is zero.
        """
        positions, velocities = self.names()
        pose = np.array([states[name] for name in positions], dtype=float)
        rate = np.array([states[name] for name in velocities], dtype=float)
        for joint in self.joints:
            first = positions.index(f"q.{joint.name}.{QUATERNION_ENTRIES[0]}")
            quaternion = pose[first : first + len(QUATERNION_ENTRIES)]
            length = float(np.linalg.norm(quaternion))
            if length < MIN_QUATERNION_NORM:
                state_names = ", ".join(f"q.{joint.name}.{axis}" for axis in QUATERNION_ENTRIES)
                raise InputError(
                    f"initial states {state_names}: expected a quaternion, found zeros"
                )
            # This is a view, so that the quaternion in the pose is normalised.
            quaternion /= length
        return FloatingState(pose, rate)

    def displace_coordinate(self, pose: Array, number: int, displacement: float) -> Array:
        """Displace poses along one degree of freedom: add to a position, or rotate about an axis.

        Args:
            pose: (n, P) n poses, P numbers each.
            number: index of the degree of freedom among the F velocities.
            displacement: displacement in m or rad; see `displace`.

        Returns:
            The displaced poses (n, P).
        """
        displacements = np.zeros((len(pose), self.velocities.size))
        displacements[:, number] = displacement
        return self.displace(pose, displacements)

    def displace(self, pose: Array, displacements: Array) -> Array:
        """Displace poses (n, P) by small displacements (n, F) in m and rad.

        A pose has P numbers, positions and quaternions. A displacement has F numbers, one for each
        velocity: a shift d_p (only of free joints) and a rotation d_r of each body.

        The position p of a body becomes p + d_p, along the axes of the world. Its orientation, the
        quaternion q, becomes q exp(d_r / 2) with the rotation vector d_r in the axes of the body
        (1). Moving for one second with the velocities (d_p, d_r) has this result in MuJoCo.

        Args:
            pose: (n, P) poses.
            displacements: (n, F) displacements in m and rad.

        Returns:
            Displaced poses (n, P).
        """
        import mujoco

        displaced_poses = pose.copy()
        # MuJoCo's function needs the whole vectors; the other joints stay at rest.
        positions, velocities = self.model.qpos0.copy(), np.zeros(self.model.nv)
        for displaced_pose, displacement in zip(displaced_poses, displacements, strict=True):
            positions[self.positions] = displaced_pose
            velocities[self.velocities] = displacement
            mujoco.mj_integratePos(self.model, positions, velocities, 1.0)
            displaced_pose[:] = positions[self.positions]
        return displaced_poses

    def compute_displacement(self, pose: Array, reference: Array) -> Array:
        """Compute the displacements (n, F) from reference poses (n, P) to other poses (n, P).

        A pose has P numbers, positions and quaternions. A displacement has F numbers, one for each
        velocity.

        A displacement has the difference of positions in m, and the rotation vector of
        q_reference^-1 q in rad, so that `displace` moves the reference pose to the other one.

        Args:
            pose: (n, P) poses at the end.
            reference: (n, P) poses at the beginning.

        Returns:
            Displacements (n, F) in m and rad.
        """
        import mujoco

        displacements = np.empty((len(pose), self.velocities.size))
        # MuJoCo's function needs the whole vectors, and returns velocities that lead from the first
        # to the second pose in one second.
        start, end = self.model.qpos0.copy(), self.model.qpos0.copy()
        velocities = np.zeros(self.model.nv)
        for displacement, end_pose, start_pose in zip(displacements, pose, reference, strict=True):
            start[self.positions], end[self.positions] = start_pose, end_pose
            mujoco.mj_differentiatePos(self.model, velocities, 1.0, start, end)
            displacement[:] = velocities[self.velocities]
        return displacements


def list_state_units(joint: Joint) -> tuple[dict[str, str], dict[str, str]]:
    """Return the units of a joint's positions by name, and those of its velocities.

    They are in the order of `qpos` and `qvel`; a joint with one coordinate has one of each.

    Args:
        joint: joint of any kind.

    Returns:
        Units by name of the positions, and by name of the velocities.
    """
    if joint.has_one_coordinate:
        return {f"q.{joint.name}": joint.unit}, {f"qd.{joint.name}": f"{joint.unit}/s"}
    axes = _list_translation_axes(joint)
    positions = {f"q.{joint.name}.{axis}": "m" for axis in axes}
    positions |= {f"q.{joint.name}.{axis}": "1" for axis in QUATERNION_ENTRIES}
    velocities = {f"qd.{joint.name}.{axis}": "m/s" for axis in axes}
    velocities |= {f"qd.{joint.name}.{axis}": "rad/s" for axis in ANGULAR_VELOCITY_AXES}
    return positions, velocities


def _list_translation_axes(joint: Joint) -> tuple[str, ...]:
    """Return the axes of translation of a floating joint."""
    return POSITION_AXES if joint.kind == "free" else ()
