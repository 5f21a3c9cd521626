"""Subject of a data sheet: a joint of a robot with its actuators and sensors, or a system."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from sims import effects as library
from sims.core.effect import ALL_PLACES, Effect
from sims.core.simulator import InputError, make_unknown_name_error
from sims.extended_simulator import FittedValue
from sims.recording.recording import Recording
from sims.system_simulator import SystemSimulator

PLACE_KIND_TITLES = {"joint": "Joint", "actuator": "Actuator", "channel": "Sensor"}
"""Titles of the kinds of places that belong to a joint, in the order of the sheet."""
RELATIVE_VALUE_UNITS = {
    "actuator.stiffness": "{force}/{length}",
    "actuator.damping": "{force}*s/{length}",
}
"""Units of numbers of the model file, for effects that are relative changes of these numbers."""


class ModelFileValue(NamedTuple):
    """Value that a model file specifies for a number.

    Attributes:
        value: Value in the model file.
        unit: Unit of the value.
        is_relative: Whether the effect is a relative change of the value, not a difference from it.
    """

    value: float
    unit: str
    is_relative: bool

    def compute_total(self, number: FittedValue) -> FittedValue:
        """Return the value of the model file with an effect's coefficient applied.

        For example, a mass of 2 kg in the file with the coefficient 0.1 of ``mass.scale`` is 2.2
        kg; the interval is transformed likewise.

        Args:
            number: Fitted coefficient with its 95 % interval.
        """
        low, high = number.low, number.high
        if low is None or high is None:
            return FittedValue(self._add_correction(number.value), self.unit, None, None)
        return FittedValue(
            self._add_correction(number.value),
            self.unit,
            self._add_correction(low),
            self._add_correction(high),
        )

    def compute_half_width(self, coefficient_half_width: float) -> float:
        """Convert half an interval of the coefficient to half an interval of the total."""
        return coefficient_half_width * self.value if self.is_relative else coefficient_half_width

    def _add_correction(self, c: float) -> float:
        return self.value * (1.0 + c) if self.is_relative else self.value + c


@dataclass(frozen=True)
class SheetSubject:
    """Joint or system that a data sheet describes.

    Attributes:
        kind: Simulator class of the system.
        joint: Joint of a robot; empty for a system with a single place.
        places: Names of the joint, its actuators and its channels.
    """

    kind: type[SystemSimulator]
    joint: str
    places: frozenset[str]

    @property
    def actuators(self) -> tuple[str, ...]:
        """Names of the actuators that drive the joint."""
        return tuple(
            effect_place.name
            for effect_place in self._get_effect_places().get("actuator", ())
            if self._is_on_joint(effect_place)
        )

    @property
    def is_prismatic(self) -> bool:
        """Return whether the joint is prismatic, not rotary."""
        if not self.joint:
            return self.kind.system.kind != "rotary"
        return bool(self._get_joint_place().kind == "slide")

    def is_driven(self, recording: Recording) -> bool:
        """Return whether a drive acts on the joint or system.

        A joint is driven by an actuator of the robot's file, or by its recorded force; a system by
        any input. An input that is always zero does not count.

        Args:
            recording: Recorded runs with their inputs.
        """
        active_inputs = {
            name for run in recording.runs for name, signal in run.inputs.items() if signal.any()
        }
        if not self.joint:
            return bool(active_inputs)
        return bool(self.actuators) or f"force.{self.joint}" in active_inputs

    def acts_here(self, effect: Effect | type[Effect]) -> bool:
        """Return whether an effect acts here and at one place only."""
        if effect.at not in PLACE_KIND_TITLES or effect.place == ALL_PLACES:
            return False
        return effect.place in self.places if self.joint else True

    def list_effects(self) -> Iterator[type[Effect]]:
        """Yield every registered effect that can act here."""
        for effect in library.list_effects_for(self.kind.system).values():
            if self.acts_here(effect):
                yield effect

    def localise_effect(
        self, name: str, coefficients: Mapping[str, FittedValue]
    ) -> Iterator[tuple[str, str, FittedValue]]:
        """Yield the coefficients that a fitted effect has at this joint or system.

        The name of an effect on a robot has the form ``EFFECT@PLACE``, where a place is a joint, an
        actuator or a channel. There are two cases:

        1. An effect at one place yields its coefficients if the place belongs to this subject.
        2. An effect at all places of a kind (a family) has a coefficient ``NAME@PLACE`` for each
           place, or one for all. It yields those of the places of this subject.

        Args:
            name: Name of the effect, possibly of a family.
            coefficients: Fitted coefficients by name.

        Yields:
            Name of the effect at this place, name of the coefficient, and its value.
        """
        effect_name, _, place = name.partition("@")
        # 1. One place.
        if place != ALL_PLACES:
            if self.acts_here(library.find_effect(name, self.kind.system)):
                for key, fitted_value in coefficients.items():
                    yield name, key, fitted_value
            return
        # 2. A family.
        local_places = [effect.place for effect in self.list_effects() if effect.of == effect_name]
        for key, fitted_value in coefficients.items():
            coefficient, _, named_place = key.partition("@")
            # A coefficient for all places, such as a delay, has the same value here.
            places = [named_place] if named_place else local_places
            for coefficient_place in places:
                if coefficient_place in self.places:
                    yield f"{effect_name}@{coefficient_place}", coefficient, fitted_value

    def get_model_file_value(self, effect: str) -> ModelFileValue | None:
        """Return the value in the model file that an effect changes; None if there is none."""
        base, _, place = effect.partition("@")
        for kind in ("joint", "actuator"):
            for effect_place in self._get_effect_places().get(kind, ()):
                if effect_place.name == place and base in effect_place.stated:
                    return self._get_file_value(base, effect_place)
        return None

    def _get_file_value(self, base: str, effect_place: Any) -> ModelFileValue:
        """Return the model file's value of the number that an effect changes here.

        A number that an effect changes by a share of its value has its own unit; others have the
        unit of the effect's coefficient.

        Args:
            base: name of the effect without its place.
            effect_place: the joint or actuator; its `stated` has the values of the file by effect.
        """
        length, force = ("m", "N") if effect_place.kind == "slide" else ("rad", "N*m")
        is_relative = base in RELATIVE_VALUE_UNITS
        if is_relative:
            unit = RELATIVE_VALUE_UNITS[base]
        else:
            effect = library.find_effect(f"{base}@{effect_place.name}", self.kind.system)
            unit = effect.coefficients[0].units[0] or "1"
        # A servo has a negative bias, but its gain is positive.
        value = abs(effect_place.stated[base])
        return ModelFileValue(value, unit.format(force=force, length=length), is_relative)

    def _get_effect_places(self) -> Mapping[str, Any]:
        effect_places: Mapping[str, Any] = getattr(self.kind.system, "places", {})
        return effect_places

    def _is_on_joint(self, effect_place: Any) -> bool:
        return bool(effect_place.coordinate == self._get_joint_place().coordinate)

    def _get_joint_place(self) -> Any:
        (joint,) = (
            place for place in self._get_effect_places()["joint"] if place.name == self.joint
        )
        return joint


def make_subject(kind: type[SystemSimulator], joint: str | None) -> SheetSubject:
    """Make the subject of a data sheet: a system, or a joint of a robot.

    An effect belongs to a joint if its place is the joint, one of its actuators or one of its
    channels. A system that is not a robot is described as a whole.

    Args:
        kind: Simulator class of the system.
        joint: Joint of a robot; None for the only joint.

    Raises:
        InputError: The joint does not exist, or there are several and none is given.
    """
    if not kind.has_model:
        if joint is not None:
            raise InputError(f"--joint: expected none, as {kind.name} is no robot; found {joint}")
        return SheetSubject(kind, "", frozenset())
    effect_places: Mapping[str, Any] = vars(kind.system)["places"]
    joints = [effect_place.name for effect_place in effect_places["joint"]]
    if joint is None and len(joints) > 1:
        raise InputError(f"robot {kind.name}: expected --joint, one of {', '.join(joints)}")
    joint = joints[0] if joint is None else joint
    if joint not in joints:
        raise make_unknown_name_error(f"joint of robot {kind.name}", joint, joints)
    # A subject finds the actuators of its joint, but needs them among its places. So a first
    # subject without places is made to find them.
    actuators = SheetSubject(kind, joint, frozenset()).actuators
    channels = {f"{quantity}.{joint}" for quantity in ("q", "qd", "tau")}
    return SheetSubject(kind, joint, frozenset({joint, *actuators, *channels}))
