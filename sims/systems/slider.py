"""Slider: a mass that a force pushes along a straight level guide."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, Literal

import numpy as np

from sims.core.effect import Effect
from sims.core.simulator import Array, Channel, Parameter
from sims.core.system import DefaultRecording, StateSnapshot, System, SystemKind
from sims.system_simulator import SystemSimulator

LOAD_DEPENDENT_EFFECTS = ("friction.load_direction", "friction.load_quadratic")
"""Effects that distinguish drive and load; they are not available, as the slider has no load."""


class SliderSystem(System):
    """Mass on a guide: mass x'' = u.

    States are the position x [m] and its rate v [m/s].
    """

    name = "slider"
    says = "a mass that a force pushes along a level guide"
    kind: ClassVar[SystemKind] = "linear"
    parameters = (Parameter("mass", "kg", 1.0, (0.1, 10.0), (0.5, 2.0), says="mass that moves"),)
    inputs = (Channel("u", "N", says="force along the guide"),)
    channels = (
        Channel("x", "m", says="position along the guide"),
        Channel("v", "m/s", says="its rate"),
    )
    coordinates = ("x",)
    rates = ("v",)
    states: ClassVar[Mapping[str, float]] = MappingProxyType({"x": 0.0, "v": 0.0})
    sensed = ("x", "v")
    usual_recording = DefaultRecording(inputs={"u": "steps:2:0.5"})

    @classmethod
    def refuses(cls, effect: type[Effect]) -> str:
        """Return why the slider, a mass on a level guide, cannot have an effect.

        Gravity is not a load on a level guide. Without a load, the effects of
        `LOAD_DEPENDENT_EFFECTS` would be equivalent to `friction.load`.

        Returns:
            The reason; empty if the slider can have the effect.
        """
        return (
            "it has no load that opposes its drive" if effect.name in LOAD_DEPENDENT_EFFECTS else ""
        )

    def mass(self, theta: Array, constants: Mapping[str, Array]) -> Array:
        """Return the mass (L, 1) in kg.

        Args:
            theta: (L, p) parameters.
            constants: (L, 1) constants by name.
        """
        return theta[:, :1]

    def weight(self, moment: StateSnapshot) -> Array:
        """Return zero, because the guide is level."""
        return np.zeros_like(moment.x)

    def drive(self, moment: StateSnapshot) -> Array:
        """Return the input force (L, 1)."""
        return moment.inputs["u"]

    def push(self, moment: StateSnapshot, axis: Literal["x", "y"]) -> Array:
        """Return the force (L, 1) of 1 m/s^2 of horizontal acceleration.

        The guide runs along x and supports forces across it.

        Shapes: L batch elements.
        """
        return moment.theta[:, :1] if axis == "x" else np.zeros_like(moment.x)


class Slider(SystemSimulator):
    """Slider; see `SliderSystem`."""

    system = SliderSystem
    default_engine = "pybullet"
