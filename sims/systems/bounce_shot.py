"""Ball dropped on an incline, described in the frame of the incline, where it is level ground.

The coordinates are the displacement of the centre from its release: down the slope, across it, and
away from it. In that frame gravity is uniform but tilted, so every engine, force and contact effect
works as for a ball on level ground. The channels transform the motion back: x is horizontal and
points in the direction in which the incline descends, z is up, both from the point of the incline
below the ball. With the incline's angle a, the ball's radius r and the height H through which it
falls,

    gravity = g (sin a, 0, -cos a)                                         (1)
    floor = -H cos a                                                       (2)
    x = along cos a + away sin a                                           (3)
    z = r / cos a + H - along sin a + away cos a                           (4)
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, Literal

import numpy as np

from sims.core.effect import Effect
from sims.core.number_limits import (
    ANGLE_RANGE,
    GRAVITY_RANGE,
    LENGTH_RANGE,
    MASS_RANGE,
    RATIO_RANGE,
)
from sims.core.simulator import Array, Channel, Constant, Parameter
from sims.core.system import StateSnapshot, System, SystemKind
from sims.system_simulator import SystemSimulator

_LEVEL_ONLY = ("force.bias", "force.periodic", "lift.magnus")
"""Effects that act along the last coordinate, which they assume to be vertical."""


class ShotSystem(System):
    """Ball that falls `drop_height` on an incline and bounces towards a hoop.

    At the impact the normal velocity is reversed and multiplied by the restitution. Friction
    reduces the tangential speed as for a sphere without initial spin: by at most friction (1 + e)
    |vn|, and by at most the share k / (1 + k), at which it rolls, with k its moment of inertia over
    mass x radius^2 (2/5: solid; 2/3: a thin shell). This is correct for the first impact, which is
    the relevant one.
    """

    name = "bounce-shot"
    says = "a ball dropped on an incline, from which it bounces towards a hoop"
    kind: ClassVar[SystemKind] = "point"
    parameters = (
        Parameter(
            "restitution",
            "1",
            0.5,
            (0.0, 1.0),
            says="ratio of normal rebound speed to normal impact speed (coefficient of "
            "restitution)",
        ),
    )
    constants = (
        Constant(
            "drop_height",
            "m",
            1.5,
            "fall height of the centre until the ball touches the incline",
            positive=True,
            limits=LENGTH_RANGE,
        ),
        Constant(
            "incline_angle",
            "rad",
            0.35,
            "between the incline and the horizontal, falling towards x",
            limits=ANGLE_RANGE,
        ),
        Constant("mass", "kg", 0.05, positive=True, limits=MASS_RANGE),
        Constant("radius", "m", 0.03, positive=True, limits=LENGTH_RANGE),
        Constant("gravity", "m/s^2", 9.81, "downward", limits=GRAVITY_RANGE),
        Constant(
            "friction",
            "1",
            0.2,
            "of ball and incline; 0 keeps the tangential speed",
            limits=RATIO_RANGE,
        ),
        Constant(
            "inertia_ratio",
            "1",
            0.4,
            "moment of inertia over mass x radius^2; 0.4 for a solid sphere",
            True,
            RATIO_RANGE,
        ),
    )
    channels = (
        Channel("x", "m", says="centre, horizontal distance from the release point"),
        Channel("y", "m", says="centre, across x"),
        Channel(
            "z", "m", says="height of the centre above the point of the incline below the release"
        ),
    )
    coordinates = ("along", "across", "away")
    rates = ("v_along", "v_across", "v_away")
    states: ClassVar[Mapping[str, float]] = MappingProxyType(
        {"along": 0.0, "across": 0.0, "away": 0.0, "v_along": 0.0, "v_across": 0.0, "v_away": 0.0}
    )
    sensed = ("z", "x", "y")
    primary = 2
    bounces = True

    @classmethod
    def refuses(cls, effect: type[Effect]) -> str:
        """Refuse effects along the vertical coordinate, which this frame does not have."""
        tilted = "it acts along the vertical, and the incline is tilted"
        return tilted if effect.name in _LEVEL_ONLY else ""

    def mass(self, theta: Array, constants: Mapping[str, Array]) -> Array:
        """Return one, because force is counted per unit mass.

        Args:
            theta: (L, P) parameters; only their number L counts.
            constants: unused.
        """
        return np.ones((len(theta), 1))

    def weight(self, moment: StateSnapshot) -> Array:
        """Return gravity in the incline's frame (L, 3), m/s^2."""
        angle = moment.constants["incline_angle"]
        zeros = np.zeros_like(angle)
        down: Array = np.concatenate([np.sin(angle), zeros, -np.cos(angle)], axis=1)
        return moment.gravity * down  # (1)

    def push(self, moment: StateSnapshot, axis: Literal["x", "y"]) -> Array:
        """Return a horizontal unit vector of the world in the frame of the incline, (L, 3).

        Shapes: L batch elements.

        Args:
            moment: state of the batch, with the angle of the incline.
            axis: direction of the vector in the world.
        """
        angle = moment.constants["incline_angle"]
        zeros = np.zeros_like(angle)
        if axis == "y":
            return np.concatenate([zeros, zeros + 1.0, zeros], axis=1)
        return np.concatenate([np.cos(angle), zeros, np.sin(angle)], axis=1)

    def observe(
        self, x: Array, v: Array, a: Array, constants: Mapping[str, Array]
    ) -> dict[str, Array]:
        """Return the position of the centre in the world frame by channel.

        The displacement is given down the slope (along), across it, and away from it. With the
        incline's angle a, the radius r and the drop height H, x = along cos a + away sin a (3) and
        z = r / cos a + H - along sin a + away cos a (4).

        Shapes: L batch elements, T samples.

        Args:
            x: (L, T, 3) displacement from the release in the frame of the incline, m.
            v: unused.
            a: unused.
            constants: radius, drop height (m) and incline angle (rad) by name.
        """
        cos = np.cos(constants["incline_angle"])
        sin = np.sin(constants["incline_angle"])
        along, across, away = np.moveaxis(x, 2, 0)
        release_height = constants["radius"] / cos + constants["drop_height"]
        return {
            "x": along * cos + away * sin,  # (3)
            "y": across,
            "z": release_height - along * sin + away * cos,  # (4)
        }

    def floor(self, constants: Mapping[str, Array]) -> Array:
        """Return the displacement along the normal from the release to the impact, m."""
        return -constants["drop_height"] * np.cos(constants["incline_angle"])  # (2)

    def restitution(self, theta: Array) -> Array:
        """Return the parameter `restitution`."""
        return theta[:, :1]

    def friction(self, constants: Mapping[str, Array]) -> Array:
        """Return the constant `friction`."""
        return constants["friction"]

    def grip(self, constants: Mapping[str, Array]) -> Array:
        """Return the maximum tangential impulse share, at which a sphere rolls: k / (1 + k)."""
        return constants["inertia_ratio"] / (1.0 + constants["inertia_ratio"])


class BounceShot(SystemSimulator):
    """A ball dropped on an incline, from which it bounces towards a hoop."""

    system = ShotSystem
