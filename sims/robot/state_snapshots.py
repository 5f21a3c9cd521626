"""Snapshots of the state of a robot, or of one of its joints, as effects receive them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from sims.core.simulator import Array
from sims.core.system import StateSnapshot, System, SystemKind


class SingleJointSystem(System):
    """One joint of a robot, as a system of one coordinate."""

    name = "joint"
    says = "one joint of a robot"
    kind: ClassVar[SystemKind] = "rotary"
    coordinates = ("q",)
    rates = ("qd",)


class SingleSlideSystem(SingleJointSystem):
    """One slide joint of a robot, as a system of one coordinate."""

    kind: ClassVar[SystemKind] = "linear"


@dataclass
class JointSnapshot(StateSnapshot):
    """State of one joint at one time, for L batch elements.

    Attributes:
        carried: (2, L, 1) forces on both sides of its transmission: the drive, and the load.
        goal: (L, 1) set point of its position servo; NaN without a servo.
        stiffness: (L, 1) force of the servo per unit of its error.
        gear: set point of the servo per unit of the joint's position.
        shared: (L, 1) absolute forces of all drives of the robot; None if the drive has its own
            supply.
    """

    carried: Array = field(default_factory=lambda: np.zeros((2, 0, 1)))
    goal: Array = field(default_factory=lambda: np.zeros((0, 1)))
    stiffness: Array = field(default_factory=lambda: np.zeros((0, 1)))
    gear: float = 1.0
    shared: Array | None = None

    @property
    def drawn(self) -> Array:
        """Load of the power supply, see `StateSnapshot`."""
        return super().drawn if self.shared is None else self.shared

    @property
    def load(self) -> Array:
        """Absolute load of the transmission, (L, 1)."""
        load: Array = np.abs(self.carried[0] + self.carried[1])
        return load

    @property
    def sides(self) -> tuple[Array, Array]:
        """Forces on both sides of the transmission, see `StateSnapshot`."""
        return self.carried[0], self.carried[1]

    @property
    def error(self) -> Array:
        """Error of the position servo, see `StateSnapshot`."""
        return self.goal - self.gear * self.x

    def aimed(self, shift: Array) -> Array:
        """Return the additional drive force for a shifted set point, see `StateSnapshot`.

        It does not include force limits of the actuator.
        """
        return self.stiffness * shift


@dataclass
class RobotSnapshot(StateSnapshot):
    """State of a robot at one time, for all batch elements.

    Attributes:
        carried: (2, L, D) forces on both sides of each joint's transmission: the drive; and the
            load by gravity and the motion of the other bodies.
        alone: (D,) each joint as a separate system.
        drives: inputs of the actuators of each coordinate.
        servos: input that is the set point of the position servo, by coordinate.
        stiffness: (L, D) forces of position servos per unit of their errors; zero without a servo.
    """

    carried: Array = field(default_factory=lambda: np.zeros((2, 0, 0)))
    alone: tuple[System, ...] = ()
    drives: dict[int, tuple[str, ...]] = field(default_factory=dict)
    servos: dict[int, str] = field(default_factory=dict)
    stiffness: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def select_element(self, batch_index: int) -> RobotSnapshot:
        """Return the state of one batch element, as a batch of one.

        Args:
            batch_index: index of the batch element.
        """
        selected = slice(batch_index, batch_index + 1)
        return replace(
            self,
            theta=self.theta[selected],
            t=self.t[selected],
            x=self.x[selected],
            v=self.v[selected],
            inputs={name: u[selected] for name, u in self.inputs.items()},
            carried=self.carried[:, selected],
            stiffness=self.stiffness[selected],
        )

    def get_joint_snapshot(self, joint: int) -> JointSnapshot:
        """Return the state of one joint in the form of a system with one coordinate.

        Effects are written for such systems. The snapshot has only the inputs of the joint's
        actuators. Without a position servo whose input is known, its set point is NaN and its
        stiffness zero.

        Args:
            joint: index of the joint's coordinate.
        """
        joint_slice = slice(joint, joint + 1)  # keeps the axis of the joints
        # Inputs by name: those of the actuators that drive the joint.
        inputs = {
            name: self.inputs[name] for name in self.drives.get(joint, ()) if name in self.inputs
        }
        # Name of the input that is the set point of the joint's position servo, if there is one.
        servo = self.servos.get(joint)
        has_servo = servo is not None and servo in self.inputs and self.stiffness.size
        return JointSnapshot(
            system=self.alone[joint],
            theta=self.theta,
            constants=self.constants,
            t=self.t,
            x=self.x[:, joint_slice],
            v=self.v[:, joint_slice],
            inputs=inputs,
            carried=self.carried[:, :, joint_slice],
            goal=self.inputs[servo] if has_servo and servo else np.full_like(self.t, np.nan),
            stiffness=self.stiffness[:, joint_slice] if has_servo else np.zeros_like(self.t),
            gear=self.system.gear(joint),
        )
