"""An instant of a robot, as effects see it: whole, or one joint alone."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from sims.base import Array
from sims.system import Kind, Moment, System


class OneJoint(System):
    """One joint of a robot, as a system of one coordinate."""

    name = "joint"
    says = "one joint of a robot"
    kind: ClassVar[Kind] = "rotary"
    parameters = ()
    channels = ()
    coordinates = ("q",)
    rates = ("qd",)
    states: ClassVar[dict[str, float]] = {}
    sensed = ()

    def mass(self, theta: Array, constants: Any) -> Array:
        """Not known of one joint alone."""
        raise NotImplementedError

    def weight(self, moment: Moment) -> Array:
        """Not known of one joint alone."""
        raise NotImplementedError

    def observe(self, x: Array, v: Array, a: Array, constants: Any) -> dict[str, Array]:
        """Nothing by itself."""
        raise NotImplementedError


class Slide(OneJoint):
    """The same of a joint that slides."""

    kind: ClassVar[Kind] = "linear"


@dataclass
class JointMoment(Moment):
    """One instant of one joint.

    Attributes:
        carried: (L, 1) what its transmission carries, with its sign.
    """

    carried: Array = field(default_factory=lambda: np.zeros((0, 1)))

    @property
    def load(self) -> Array:
        """(L, 1) what the transmission carries, whichever way."""
        return np.abs(self.carried)


@dataclass
class RobotMoment(Moment):
    """One instant of every lane of a robot.

    Attributes:
        carried: (L, D) what each joint's transmission carries: the drive from one side, and gravity
            and what comes of the motion of the other bodies from the other.
        alone: (D,) each joint as a system of its own.
        drives: by coordinate, the inputs of its actuators.
    """

    carried: Array = field(default_factory=lambda: np.zeros((0, 0)))
    alone: tuple[System, ...] = ()
    drives: dict[int, tuple[str, ...]] = field(default_factory=dict)

    def of_joint(self, joint: int) -> JointMoment:
        """The instant as one joint sees it."""
        one = slice(joint, joint + 1)
        inputs = {
            name: self.inputs[name] for name in self.drives.get(joint, ()) if name in self.inputs
        }
        return JointMoment(
            self.alone[joint],
            self.theta,
            self.constants,
            self.t,
            self.x[:, one],
            self.v[:, one],
            inputs,
            self.carried[:, one],
        )
