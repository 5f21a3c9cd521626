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
        """Return the floating joints of a robot.

        These are free joints (three translations and a quaternion) and ball joints (a quaternion).

        Returns:
            The joints with their columns in `qpos` and `qvel`.
        """
        joints = tuple(joint for joint in robot.joints if not joint.has_one_coordinate)
        positions = [
            j.position + k
            for j in joints
            for k in range(len(_list_translation_axes(j) + QUATERNION_ENTRIES))
        ]
        velocities = [
            j.velocity + k
            for j in joints
            for k in range(len(_list_translation_axes(j) + ANGULAR_VELOCITY_AXES))
        ]
        return cls(
            robot.compiled, joints, np.array(positions, np.intp), np.array(velocities, np.intp)
        )

    def __bool__(self) -> bool:
        return bool(self.joints)

    def names(self) -> tuple[list[str], list[str]]:
        """Return the names of positions and velocities, such as ``q.base.qw``, ``qd.base.wx``."""
        names = list(self.units())
        return (
            [name for name in names if name.startswith("q.")],
            [name for name in names if name.startswith("qd.")],
        )

    def units(self) -> dict[str, str]:
        """Return the units of positions and velocities by name.

        Positions are in m and velocities in m/s along the world's axes; quaternions have the unit
        1, and angular velocities rad/s.
        """
        units: dict[str, str] = {}
        for joint in self.joints:
            axes = _list_translation_axes(joint)
            units |= {f"q.{joint.name}.{axis}": "m" for axis in axes}
            units |= {f"q.{joint.name}.{axis}": "1" for axis in QUATERNION_ENTRIES}
            units |= {f"qd.{joint.name}.{axis}": "m/s" for axis in axes}
            units |= {f"qd.{joint.name}.{axis}": "rad/s" for axis in ANGULAR_VELOCITY_AXES}
        return units

    def states(self) -> dict[str, float]:
        """Return initial states by name: poses from the model file, and velocities of zero."""
        positions, velocities = self.names()
        poses = self.model.qpos0[self.positions].tolist()
        return dict(zip(positions, poses, strict=True)) | dict.fromkeys(velocities, 0.0)

    def get_initial_state(self, states: Mapping[str, float]) -> FloatingState:
        """Return the initial state of a run, (P,) and (F,), from known states by name.

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
            quaternion /= length
        return FloatingState(pose, rate)

    def displace(self, pose: Array, number: int, displacement: float) -> Array:
        """Displace poses along one degree of freedom, by eq. (1): add to a position, or rotate.

        The pose becomes position + d_p and q exp(d_r / 2) (1), with the orientation q as a
        quaternion.

        Args:
            pose: (n, P) poses.
            number: index of the degree of freedom, below F.
            displacement: displacement in m or rad.

        Returns:
            The displaced poses (n, P).
        """
        displacements = np.zeros((len(pose), self.velocities.size))
        displacements[:, number] = displacement
        return self.displaced(pose, displacements)

    def displaced(self, pose: Array, displacements: Array) -> Array:
        """Displace poses (n, P) by small displacements (n, F) by eq. (1), in m and rad.

        Positions move along the axes of the world; rotations are about the axes of the body.

        The pose becomes position + d_p and q exp(d_r / 2) (1), with the orientation q as a
        quaternion.
        """
        import mujoco

        displaced_poses = pose.copy()
        positions, velocities = self.model.qpos0.copy(), np.zeros(self.model.nv)
        for displaced_pose, displacement in zip(displaced_poses, displacements, strict=True):
            positions[self.positions] = displaced_pose
            velocities[self.velocities] = displacement
            mujoco.mj_integratePos(self.model, positions, velocities, 1.0)
            displaced_pose[:] = positions[self.positions]
        return displaced_poses

    def compute_displacement(self, pose: Array, reference: Array) -> Array:
        """Compute the displacements (n, F) from reference poses (n, P) to poses (n, P).

        A displacement has the difference of positions, and the rotation vector of q_reference^-1 q.
        F and P are the numbers of velocities and of pose numbers of all floating joints.
        """
        import mujoco

        displacements = np.empty((len(pose), self.velocities.size))
        before, after = self.model.qpos0.copy(), self.model.qpos0.copy()
        velocities = np.zeros(self.model.nv)
        for displacement, reached, start in zip(displacements, pose, reference, strict=True):
            before[self.positions], after[self.positions] = start, reached
            mujoco.mj_differentiatePos(self.model, velocities, 1.0, before, after)
            displacement[:] = velocities[self.velocities]
        return displacements


def _list_translation_axes(joint: Joint) -> tuple[str, ...]:
    """Return the axes of translation of a floating joint."""
    return POSITION_AXES if joint.kind == "free" else ()
