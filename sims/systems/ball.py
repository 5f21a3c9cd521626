"""Ball: a sphere that falls freely and bounces on level ground, declared for every engine."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, Literal

import numpy as np

from sims.core.number_limits import GRAVITY_RANGE, LENGTH_RANGE, MASS_RANGE
from sims.core.simulator import Array, Channel, Constant, Parameter
from sims.core.system import DefaultRecording, StateSnapshot, System, SystemKind
from sims.system_simulator import SystemSimulator


class BallSystem(System):
    """Sphere under gravity alone that rebounds with restitution times its impact speed.

    States are the centre x, y, z [m], with ground contact at z = radius, and its velocity vx, vy,
    vz [m/s]. It does not spin, and the ground does not reduce its tangential speed unless an effect
    does. Forces are per unit mass.
    """

    name = "ball"
    says = "a ball that falls and bounces on level ground"
    kind: ClassVar[SystemKind] = "point"
    parameters = (
        Parameter(
            "restitution",
            "1",
            0.5,
            (0.0, 1.0),
            says="ratio of rebound speed to impact speed (coefficient of restitution)",
        ),
    )
    constants = (
        Constant("mass", "kg", 1.0, positive=True, limits=MASS_RANGE),
        Constant("radius", "m", 0.5, positive=True, limits=LENGTH_RANGE),
        Constant("gravity", "m/s^2", 9.81, "downward", limits=GRAVITY_RANGE),
    )
    channels = (
        Channel("x", "m", says="centre, along the ground"),
        Channel("y", "m", says="centre, along the ground, across x"),
        Channel("z", "m", says="height of the centre above the ground"),
        Channel(
            "accel_z",
            "m/s^2",
            10.0,
            "vertical proper acceleration: 0 in free fall, gravity at rest",
        ),
    )
    coordinates = ("x", "y", "z")
    rates = ("vx", "vy", "vz")
    states: ClassVar[Mapping[str, float]] = MappingProxyType(
        {"x": 0.0, "y": 0.0, "z": 4.5, "vx": 0.0, "vy": 0.0, "vz": 0.0}
    )
    sensed = ("z", "accel_z", "x", "y")
    usual_recording = DefaultRecording(
        observe=("x", "y", "z"),
        initial={"z": (3.0, 5.0), "vx": (-1.0, 1.0), "vy": (-1.0, 1.0)},
    )
    primary = 2
    bounces = True

    def mass(self, theta: Array, constants: Mapping[str, Array]) -> Array:
        """Return one (L, 1): forces are per unit mass.

        Args:
            theta: (L, p) parameters.
            constants: (L, 1) constants by name.
        """
        return np.ones((len(theta), 1))

    def weight(self, moment: StateSnapshot) -> Array:
        """Return the acceleration of gravity (L, D) in m/s^2."""
        return np.concatenate([np.zeros((len(moment.x), 2)), -moment.gravity], axis=1)

    def push(self, moment: StateSnapshot, axis: Literal["x", "y"]) -> Array:
        """Return the force per unit mass of 1 m/s^2 along a horizontal axis, a unit vector (L, D).

        Shapes: L batch elements, D coordinates.

        Args:
            moment: state snapshot.
            axis: horizontal axis of the acceleration.
        """
        unit = np.zeros_like(moment.x)
        unit[:, "xy".index(axis)] = 1.0
        return unit

    def observe(
        self, x: Array, v: Array, a: Array, constants: Mapping[str, Array]
    ) -> dict[str, Array]:
        """Return the position, and the vertical reading of an accelerometer on the ball.

        An accelerometer shows zero in free fall, and gravity at rest.

        Shapes: L batch elements, S steps, D coordinates.

        Args:
            x: (L, S, D) positions.
            v: (L, S, D) velocities.
            a: (L, S, D) accelerations.
            constants: constants by name.
        """
        return {
            "x": x[:, :, 0],
            "y": x[:, :, 1],
            "z": x[:, :, 2],
            "accel_z": a[:, :, 2] + constants["gravity"],
        }

    def floor(self, constants: Mapping[str, Array]) -> Array:
        """Return the ball's radius."""
        return constants["radius"]

    def restitution(self, theta: Array) -> Array:
        """Return the restitution parameter."""
        return theta[:, :1]


class Ball(SystemSimulator):
    """Ball that falls and bounces on level ground."""

    system = BallSystem
    default_engine = "pybullet"
