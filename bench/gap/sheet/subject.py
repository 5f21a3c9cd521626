"""What a sheet is of: a joint of a robot with its actuators and sensors, or a system of one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from sims import effects as library
from sims.base import InputError, unknown
from sims.extended import Number
from sims.recording.recording import Recording
from sims.simulated import Simulated
from sims.system import FAMILY, Effect

PARTS = {"joint": "Joint", "actuator": "Actuator", "channel": "Sensor"}
"""Kinds of places that belong to a joint, in the order of the sheet."""
_SHARES = {"actuator.stiffness": "{force}/{length}", "actuator.damping": "{force}*s/{length}"}
"""Units of what a file states where an effect is a share of it."""


class Stated(NamedTuple):
    """What a model file states of a number, and its unit; and whether the effect is a share of it,
    not a difference from it.
    """

    value: float
    unit: str
    share: bool

    def total(self, number: Number) -> Number:
        """What the file says with an effect's coefficient."""
        low, high = number.low, number.high
        if low is None or high is None:
            return Number(self._with(number.value), self.unit, None, None)
        return Number(self._with(number.value), self.unit, self._with(low), self._with(high))

    def half(self, half: float) -> float:
        """Half an interval of the coefficient, as one of the total."""
        return half * self.value if self.share else half

    def _with(self, c: float) -> float:
        return self.value * (1.0 + c) if self.share else self.value + c


@dataclass(frozen=True)
class Subject:
    """What a sheet is of.

    Attributes:
        kind: the simulator of its system.
        joint: of a robot; empty for a system of one place.
        places: names of the joint, its actuators and its channels.
    """

    kind: type[Simulated]
    joint: str
    places: frozenset[str]

    @property
    def actuators(self) -> tuple[str, ...]:
        """Names of those that drive the joint."""
        return tuple(spot.name for spot in self._spots().get("actuator", ()) if self._on(spot))

    @property
    def linear(self) -> bool:
        """Whether it slides, and does not turn."""
        if not self.joint:
            return self.kind.system.kind != "rotary"
        (joint,) = (s for s in self._spots()["joint"] if s.name == self.joint)
        return bool(joint.kind == "slide")

    def is_driven(self, recording: Recording) -> bool:
        """Return whether a drive acts here: an actuator of the robot's file, or an input of the
        recording that is not always zero.
        """
        inputs = {
            name for run in recording.runs for name, signal in run.inputs.items() if signal.any()
        }
        if not self.joint:
            return bool(inputs)
        return bool(self.actuators) or f"force.{self.joint}" in inputs

    def has(self, effect: Effect | type[Effect]) -> bool:
        """Whether an effect acts here, and at no more than one place."""
        if effect.at not in PARTS or effect.place == FAMILY:
            return False
        return effect.place in self.places if self.joint else True

    def effects(self) -> Iterator[type[Effect]]:
        """Every registered effect that can act here."""
        for effect in library.library(self.kind.system).values():
            if self.has(effect):
                yield effect

    def own(self, name: str, numbers: Mapping[str, Number]) -> Iterator[tuple[str, str, Number]]:
        """What an effect found somewhere is here: the name that it has here, and each of its
        coefficients.
        """
        base, _, place = name.partition("@")
        if place != FAMILY:
            if self.has(library.find(name, self.kind.system)):
                yield from ((name, key, number) for key, number in numbers.items())
            return
        there = [one.place for one in self.effects() if one.of == base]
        for key, number in numbers.items():
            coefficient, _, at = key.partition("@")
            # What is late is late everywhere: one number that names no place.
            for one in [at] if at else there:
                if one in self.places:
                    yield f"{base}@{one}", coefficient, number

    def stated(self, effect: str) -> Stated | None:
        """What the model file states of what an effect changes; None where it says nothing."""
        base, _, place = effect.partition("@")
        for kind in ("joint", "actuator"):
            for spot in self._spots().get(kind, ()):
                if spot.name == place and base in spot.stated:
                    return self._stated(base, spot)
        return None

    def _stated(self, base: str, spot: Any) -> Stated:
        length, force = ("m", "N") if spot.kind == "slide" else ("rad", "N*m")
        share = base in _SHARES
        effect = library.find(f"{base}@{spot.name}", self.kind.system)
        unit = _SHARES[base] if share else effect.coefficients[0].units[0] or "1"
        # A servo's bias pulls back: its sign is no part of a gain.
        value = abs(spot.stated[base])
        return Stated(value, unit.format(force=force, length=length), share)

    def _spots(self) -> Mapping[str, Any]:
        spots: Mapping[str, Any] = getattr(self.kind.system, "spots", {})
        return spots

    def _on(self, spot: Any) -> bool:
        (joint,) = (s for s in self._spots()["joint"] if s.name == self.joint)
        return bool(spot.coordinate == joint.coordinate)


def subject_of(kind: type[Simulated], joint: str | None) -> Subject:
    """What a sheet is of.

    Args:
        kind: the simulator of the system.
        joint: of a robot; None where there is one.

    Raises:
        InputError: there is no such joint, or several and none is named.
    """
    if not kind.has_model:
        if joint is not None:
            raise InputError(f"--joint: expected none, as {kind.name} is no robot; found {joint}")
        return Subject(kind, "", frozenset())
    spots: Mapping[str, Any] = vars(kind.system)["spots"]
    joints = [spot.name for spot in spots["joint"]]
    if joint is None and len(joints) > 1:
        raise InputError(f"robot {kind.name}: expected --joint, one of {', '.join(joints)}")
    joint = joints[0] if joint is None else joint
    if joint not in joints:
        raise unknown(f"joint of robot {kind.name}", joint, joints)
    bare = Subject(kind, joint, frozenset())
    channels = {f"{kind_of}.{joint}" for kind_of in ("q", "qd", "tau")}
    return Subject(kind, joint, frozenset({joint, *bare.actuators, *channels}))
