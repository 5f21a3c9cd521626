"""Bodies that float (free joints) or turn on balls (ball joints): where a run begins with them, and
small moves of them.

No channel is one of their coordinates, so none of them is estimated: each run begins with what the
recording states of it, else with what the file has. A pose is a position, of a free joint alone,
and a unit quaternion (w, x, y, z); a small move d of it has three numbers for each,

    position + d_p,   q exp(d_r / 2),                                                          (1)

the world's axes for the first, the body's for the second, as MuJoCo has velocities (MuJoCo,
*Computation*, "Floating objects"; J. Solà, arXiv:1711.02508, eqs. (101) and (190)).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sims.base import Array, InputError
from sims.robot.model import Joint, Robot

Places = NDArray[np.intp]
PLACE, TURN = ("x", "y", "z"), ("qw", "qx", "qy", "qz")
MOVES, TURNS = ("x", "y", "z"), ("wx", "wy", "wz")
LEAST = 1e-6
"""Length of a quaternion that is none."""


class Afloat(NamedTuple):
    """Poses (..., P) and velocities (..., F) of all floating joints."""

    pose: Array
    rate: Array


@dataclass(frozen=True, eq=False)
class Floating:
    """The floating joints of a model.

    Attributes:
        joints: free and ball joints.
        positions: (P,) in qpos.
        velocities: (F,) in qvel.
    """

    joints: tuple[Joint, ...]
    positions: Places
    velocities: Places

    @classmethod
    def of(cls, robot: Robot) -> Floating:
        """Those of a robot."""
        joints = tuple(joint for joint in robot.joints if not joint.single)
        positions = [j.position + k for j in joints for k in range(7 if j.kind == "free" else 4)]
        velocities = [j.velocity + k for j in joints for k in range(6 if j.kind == "free" else 3)]
        return cls(joints, np.array(positions, np.intp), np.array(velocities, np.intp))

    def __bool__(self) -> bool:
        return bool(self.joints)

    def names(self) -> tuple[list[str], list[str]]:
        """Of positions and velocities, as recordings state them: ``q.base.qw``, ``qd.base.wx``."""
        positions, velocities = [], []
        for joint in self.joints:
            free = joint.kind == "free"
            positions += [f"q.{joint.name}.{axis}" for axis in (*(PLACE if free else ()), *TURN)]
            velocities += [f"qd.{joint.name}.{axis}" for axis in (*(MOVES if free else ()), *TURNS)]
        return positions, velocities

    def states(self, model: Any) -> dict[str, float]:
        """What the file has, by name."""
        positions, velocities = self.names()
        poses = model.qpos0[self.positions].tolist()
        return dict(zip(positions, poses, strict=True)) | dict.fromkeys(velocities, 0.0)

    def begun(self, states: Mapping[str, float]) -> Afloat:
        """Where a run begins, (P,) and (F,), by what is known of it.

        Raises:
            InputError: a quaternion is zero.
        """
        positions, velocities = self.names()
        pose = np.array([states[name] for name in positions], dtype=float)
        rate = np.array([states[name] for name in velocities], dtype=float)
        for joint, turn in zip(self.joints, self._turns(), strict=True):
            length = float(np.linalg.norm(pose[turn]))
            if length < LEAST:
                given = ", ".join(f"q.{joint.name}.{axis}" for axis in TURN)
                raise InputError(f"initial states {given}: expected a quaternion, found zeros")
            pose[turn] /= length
        return Afloat(pose, rate)

    def moved(self, pose: Array, number: int, by: float) -> Array:
        """Poses (n, P) with one of the F numbers of a small move made, as (1) has it."""
        result = pose.copy()
        for joint, turn, first in zip(self.joints, self._turns(), self._firsts(), strict=True):
            own = number - first
            places = 3 if joint.kind == "free" else 0
            if 0 <= own < places:
                result[:, turn.start - 3 + own] += by
            elif places <= own < places + 3:
                small = np.zeros(4)
                small[0], small[1 + own - places] = np.cos(0.5 * by), np.sin(0.5 * by)
                result[:, turn] = _product(pose[:, turn], small[None])
        return result

    def apart(self, pose: Array, reference: Array) -> Array:
        """(n, F) the moves that lead from reference poses (n, P) to poses."""
        parts = []
        for joint, turn in zip(self.joints, self._turns(), strict=True):
            if joint.kind == "free":
                own = slice(turn.start - 3, turn.start)
                parts.append(pose[:, own] - reference[:, own])
            back = reference[:, turn] * np.array([1.0, -1.0, -1.0, -1.0])
            parts.append(_logarithm(_product(back, pose[:, turn])))
        return np.concatenate(parts, axis=1) if parts else np.zeros((len(pose), 0))

    def _turns(self) -> list[slice]:
        """Where in a pose the quaternions stand."""
        slices, end = [], 0
        for joint in self.joints:
            end += 7 if joint.kind == "free" else 4
            slices.append(slice(end - 4, end))
        return slices

    def _firsts(self) -> list[int]:
        """The first number of each joint's moves."""
        sizes = [6 if joint.kind == "free" else 3 for joint in self.joints]
        return [sum(sizes[:k]) for k in range(len(sizes))]


def _product(one: Array, other: Array) -> Array:
    """(n, 4) Hamilton products."""
    a, u = one[:, :1], one[:, 1:]
    b, v = other[:, :1], other[:, 1:]
    real = a * b - np.sum(u * v, axis=1, keepdims=True)
    return np.concatenate([real, a * v + b * u + np.cross(u, v)], axis=1)


def _logarithm(turn: Array) -> Array:
    """(n, 3) rotation vectors of unit quaternions, the shorter way round."""
    sign = np.where(turn[:, :1] < 0, -1.0, 1.0)
    real, vector = sign * turn[:, :1], sign * turn[:, 1:]
    length = np.linalg.norm(vector, axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(length, real)
    small = length < LEAST
    scale = np.where(small, 2.0, angle / np.where(small, 1.0, length))
    return vector * scale
