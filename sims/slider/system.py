"""The slider: a mass that a force pushes along a straight level guide."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, Literal

import numpy as np

from sims.base import Array, Channel, Parameter
from sims.system import Effect, Kind, Moment, System, UsualRecording

LOADED = ("friction.load_direction", "friction.load_quadratic")
"""Effects that tell the drive from what it works against."""


class SliderSystem(System):
    """mass x'' = u. States are the position x [m] and its rate v [m/s]."""

    name = "slider"
    says = "a mass that a force pushes along a level guide"
    kind: ClassVar[Kind] = "linear"
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
    usual_recording = UsualRecording(inputs={"u": "steps:2:0.5"})

    @classmethod
    def refuses(cls, effect: type[Effect]) -> str:
        """See `System`; with nothing to work against they would be `friction.load` itself."""
        return "nothing works against its drive" if effect.name in LOADED else ""

    def mass(self, theta: Array, constants: Mapping[str, Array]) -> Array:
        """(L, 1) kg."""
        return theta[:, :1]

    def weight(self, moment: Moment) -> Array:
        """Zero: the guide is level."""
        return np.zeros_like(moment.x)

    def drive(self, moment: Moment) -> Array:
        """The input force."""
        return moment.inputs["u"]

    def push(self, moment: Moment, axis: Literal["x", "y"]) -> Array:
        """The guide runs along x; what pushes across it is held by it."""
        return moment.theta[:, :1] if axis == "x" else np.zeros_like(moment.x)

    def observe(
        self, x: Array, v: Array, a: Array, constants: Mapping[str, Array]
    ) -> dict[str, Array]:
        """Position and rate."""
        return {"x": x[:, :, 0], "v": v[:, :, 0]}
