"""Pendulum: a rigid body on a hinge, declared once for every engine."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, Literal

import numpy as np

from sims.core.number_limits import GRAVITY_RANGE, LENGTH_RANGE, MASS_RANGE
from sims.core.simulator import Array, Channel, Constant, Parameter
from sims.core.system import DefaultRecording, StateSnapshot, System, SystemKind
from sims.system_simulator import SystemSimulator


class PendulumSystem(System):
    """Rigid body on a horizontal hinge: inertia q'' = u - mass gravity length sin q.

    States are the angle q [rad], 0 when hanging, and its rate qd [rad/s].
    """

    name = "pendulum"
    says = "a rigid body that swings on a hinge"
    kind: ClassVar[SystemKind] = "rotary"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter(
            "inertia",
            "kg*m^2",
            3.3e-3,
            (1e-3, 1e-2),
            (2e-3, 6e-3),
            says="moment of inertia about the hinge",
        ),
    )
    channels: ClassVar[tuple[Channel, ...]] = (
        Channel("q", "rad", 1.0, "angle, 0 when hanging"),
        Channel("qd", "rad/s", 10.0, "rate of the angle"),
    )
    constants: ClassVar[tuple[Constant, ...]] = (
        Constant("mass", "kg", 0.15, positive=True, limits=MASS_RANGE),
        Constant(
            "length",
            "m",
            0.15,
            "from the hinge to the centre of mass",
            positive=True,
            limits=LENGTH_RANGE,
        ),
        Constant("gravity", "m/s^2", 9.81, "downward", limits=GRAVITY_RANGE),
    )
    inputs: ClassVar[tuple[Channel, ...]] = (Channel("u", "N*m", says="torque at the hinge"),)
    coordinates = ("q",)
    rates = ("qd",)
    states: ClassVar[Mapping[str, float]] = MappingProxyType({"q": 0.5, "qd": 0.0})
    sensed: ClassVar[tuple[str, ...]] = ("q", "qd")
    usual_recording = DefaultRecording(initial={"q": (0.5, 1.5)})

    def mass(self, theta: Array, constants: Mapping[str, Array]) -> Array:
        """Return the inertia (L, 1) about the hinge in kg m^2.

        Args:
            theta: (L, p) parameters.
            constants: (L, 1) constants by name.
        """
        return theta[:, :1]

    def weight(self, moment: StateSnapshot) -> Array:
        """Return the torque of gravity (L, 1)."""
        k = moment.constants
        torque: Array = -k["mass"] * k["gravity"] * k["length"] * np.sin(moment.x)
        return torque

    def drive(self, moment: StateSnapshot) -> Array:
        """Return the input torque (L, 1)."""
        return moment.inputs["u"]

    def push(self, moment: StateSnapshot, axis: Literal["x", "y"]) -> Array:
        """Return the torque (L, 1) of 1 m/s^2 of horizontal acceleration.

        The pendulum swings in the plane of x and the vertical; the hinge supports forces along its
        axis, which is y.

        Shapes: L batch elements.

        Args:
            moment: state snapshot, with the angle (0 when hanging) as its position.
            axis: horizontal direction of the acceleration.
        """
        if axis == "y":
            return np.zeros_like(moment.x)
        torque: Array = moment.constants["mass"] * moment.constants["length"] * np.cos(moment.x)
        return torque


class Pendulum(SystemSimulator):
    """Pendulum; see `PendulumSystem`."""

    system = PendulumSystem
    default_engine = "pybullet"
