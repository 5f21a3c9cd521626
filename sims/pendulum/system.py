"""The pendulum: a rigid body on a hinge, declared once for every engine."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, Literal

import numpy as np

from sims.base import Array, Channel, Constant, Parameter
from sims.limits import GRAVITY, LENGTH, MASS
from sims.system import Kind, Moment, System, UsualRecording


class PendulumSystem(System):
    """A rigid body on a horizontal hinge: inertia q'' = u - mass gravity length sin q.

    States are the angle q [rad], 0 when hanging, and its rate qd [rad/s].
    """

    name = "pendulum"
    says = "a rigid body that swings on a hinge"
    kind: ClassVar[Kind] = "rotary"
    parameters = (
        Parameter(
            "inertia",
            "kg*m^2",
            3.3e-3,
            (1e-3, 1e-2),
            (2e-3, 6e-3),
            says="moment of inertia about the hinge",
        ),
    )
    channels = (
        Channel("q", "rad", 1.0, "angle, 0 when hanging"),
        Channel("qd", "rad/s", 10.0, "rate of the angle"),
    )
    constants = (
        Constant("mass", "kg", 0.15, positive=True, limits=MASS),
        Constant(
            "length",
            "m",
            0.15,
            "from the hinge to the centre of mass",
            positive=True,
            limits=LENGTH,
        ),
        Constant("gravity", "m/s^2", 9.81, "downward", limits=GRAVITY),
    )
    inputs = (Channel("u", "N*m", says="torque at the hinge"),)
    coordinates = ("q",)
    rates = ("qd",)
    states: ClassVar[Mapping[str, float]] = MappingProxyType({"q": 0.5, "qd": 0.0})
    sensed = ("q", "qd")
    usual_recording = UsualRecording(initial={"q": (0.5, 1.5)})

    def mass(self, theta: Array, constants: Mapping[str, Array]) -> Array:
        """(L, 1) kg m^2 about the hinge."""
        return theta[:, :1]

    def weight(self, moment: Moment) -> Array:
        """Gravity's torque."""
        k = moment.constants
        torque: Array = -k["mass"] * k["gravity"] * k["length"] * np.sin(moment.x)
        return torque

    def drive(self, moment: Moment) -> Array:
        """The input torque."""
        return moment.inputs["u"]

    def push(self, moment: Moment, axis: Literal["x", "y"]) -> Array:
        """It swings in the plane of x and the vertical; what pushes along the hinge's axis is held
        by it.
        """
        if axis == "y":
            return np.zeros_like(moment.x)
        torque: Array = moment.constants["mass"] * moment.constants["length"] * np.cos(moment.x)
        return torque

    def observe(
        self, x: Array, v: Array, a: Array, constants: Mapping[str, Array]
    ) -> dict[str, Array]:
        """Angle and rate."""
        return {"q": x[:, :, 0], "qd": v[:, :, 0]}
