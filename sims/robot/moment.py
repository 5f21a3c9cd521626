"""An instant of a robot, as effects see it: whole, or one joint alone."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
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
        carried: (2, L, 1) what its transmission carries, the drive's force and what it works
            against.
        goal: (L, 1) set point of its position servo; NaN without one.
        stiffness: (L, 1) what that exerts for each unit of its error.
        gear: by how much it turns for each unit of the joint's position.
        shared: (L, 1) sizes of the forces of all drives of the robot; None where its drive has a
            supply of its own.
    """

    carried: Array = field(default_factory=lambda: np.zeros((2, 0, 1)))
    goal: Array = field(default_factory=lambda: np.zeros((0, 1)))
    stiffness: Array = field(default_factory=lambda: np.zeros((0, 1)))
    gear: float = 1.0
    shared: Array | None = None

    @property
    def drawn(self) -> Array:
        """See `Moment`."""
        return super().drawn if self.shared is None else self.shared

    @property
    def load(self) -> Array:
        """(L, 1) what the transmission carries, whichever way."""
        load: Array = np.abs(self.carried[0] + self.carried[1])
        return load

    @property
    def sides(self) -> tuple[Array, Array]:
        """See `Moment`."""
        return self.carried[0], self.carried[1]

    @property
    def error(self) -> Array:
        """See `Moment`."""
        return self.goal - self.gear * self.x

    def aimed(self, shift: Array) -> Array:
        """See `Moment`; a limit of the actuator's force is not in it."""
        return self.stiffness * shift


@dataclass
class RobotMoment(Moment):
    """One instant of every lane of a robot.

    Attributes:
        carried: (2, L, D) what each joint's transmission carries: the drive from one side, and
            gravity and what comes of the motion of the other bodies from the other.
        alone: (D,) each joint as a system of its own.
        drives: by coordinate, the inputs of its actuators.
        servos: by coordinate, the input that is the set point of its position servo.
        stiffness: (L, D) what position servos exert for each unit of their errors; zero without.
    """

    carried: Array = field(default_factory=lambda: np.zeros((2, 0, 0)))
    alone: tuple[System, ...] = ()
    drives: dict[int, tuple[str, ...]] = field(default_factory=dict)
    servos: dict[int, str] = field(default_factory=dict)
    stiffness: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def only(self, lane: int) -> RobotMoment:
        """One lane alone."""
        own = slice(lane, lane + 1)
        return replace(
            self,
            theta=self.theta[own],
            t=self.t[own],
            x=self.x[own],
            v=self.v[own],
            inputs={name: u[own] for name, u in self.inputs.items()},
            carried=self.carried[:, own],
            stiffness=self.stiffness[own],
        )

    def of_joint(self, joint: int) -> JointMoment:
        """The instant as one joint sees it."""
        one = slice(joint, joint + 1)
        inputs = {
            name: self.inputs[name] for name in self.drives.get(joint, ()) if name in self.inputs
        }
        servo = self.servos.get(joint)
        followed = servo is not None and servo in self.inputs and self.stiffness.size
        return JointMoment(
            self.alone[joint],
            self.theta,
            self.constants,
            self.t,
            self.x[:, one],
            self.v[:, one],
            inputs,
            self.carried[:, :, one],
            self.inputs[servo] if followed and servo else np.full_like(self.t, np.nan),
            self.stiffness[:, one] if followed else np.zeros_like(self.t),
            self.system.gear(joint),
        )
