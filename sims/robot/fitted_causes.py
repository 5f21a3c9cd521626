"""Fitted causes of a robot: collect them from a fit, and resolve effect families to places."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sims.core.effect import ALL_PLACES
from sims.core.simulator import Array
from sims.core.user_messages import append_unit
from sims.extended_simulator import ExtendedSimulator, FittedValue

if TYPE_CHECKING:
    from sims.robot.robot_model import RobotModel

_COEFFICIENT_NAMES: Mapping[str, tuple[str, ...]] = {
    "joint.axis": ("x", "y", "z"),
    "mass.offset": ("x", "y", "z"),
    "payload": ("mass", "x", "y", "z"),
    "gravity.tilt": ("x", "y"),
}
"""Names of the coefficients of effects with several coefficients, in their order."""
MAX_COMPENSATED_GRAVITY_SHARE = 0.02
"""Largest remaining share of gravity at which a robot counts as gravity-compensated."""
GRAVITY_COMPENSATED = "gravity is compensated: the real robot or its controller carries its weight"
"""Text for a gravity correction that removes gravity completely."""
CauseCoefficients = Mapping[str, Mapping[str, FittedValue]]
"""Coefficients by ``effect@place``, ``effect@*`` or ``effect``."""


def collect_causes(extended: ExtendedSimulator) -> dict[str, Mapping[str, FittedValue]]:
    """Collect the fitted changes of a robot as coefficients by effect.

    They are numbers of its model file that the user freed for the fit, diagnosed effects, and the
    time step and other options of the integrator if they differ from those of the file.

    Args:
        extended: extended simulator of a robot, with the fitted values.
    """
    kind: Any = extended.kind  # simulator class of the robot
    causes: dict[str, Mapping[str, FittedValue]] = {}
    for effect in kind.system.freed_effects:
        names = [coefficient.name for coefficient in effect.coefficients]
        # A freed number is a parameter with the name of its effect, and of its coefficient if there
        # are several.
        parameters = (
            [effect.name] if len(names) == 1 else [f"{effect.name}.{name}" for name in names]
        )
        causes[effect.name] = {
            name: extended.parameters[parameter]
            for name, parameter in zip(names, parameters, strict=True)
        }
    # Freed numbers, diagnosed effects, and options of the integrator.
    return {**causes, **extended.effects, **_list_numerics_causes(kind)}


def _list_numerics_causes(kind: Any) -> dict[str, Mapping[str, FittedValue]]:
    """Return the options of the model as causes, if they differ from those of the model file.

    The step is in seconds; an option that is a word in the file has its MuJoCo number. They have no
    intervals because they are chosen, not fitted.
    """
    from sims.robot.integrator_settings import list_changed_options

    return {
        effect: {effect.removeprefix("numerics."): make_option_value(effect, *numbers)}
        for effect, numbers in list_changed_options(kind.robot, kind.numerics).items()
    }


def make_option_value(effect: str, stated: float, number: float) -> FittedValue:
    """Return the value of a changed option of the model file, which is chosen and has no interval.

    Args:
        effect: effect that names the option, such as ``numerics.impratio``.
        stated: number in the model file.
        number: number that replaces it.
    """
    unit = "s" if effect == "numerics.step" else "1"
    return FittedValue(float(number), unit, None, None, stated=float(stated), total=float(number))


def is_gravity_compensated(effect: str, numbers: Mapping[str, FittedValue]) -> bool:
    """Return whether a cause is a correction of gravity that removes gravity almost completely.

    The real robot, or its controller, then carries its own weight.

    Args:
        effect: name of the effect, such as ``gravity.scale``.
        numbers: fitted numbers by coefficient. That of ``gravity.scale`` is the relative change
            of gravity, so that -1 removes it.
    """
    return effect == "gravity.scale" and any(
        abs(1.0 + number.value) < MAX_COMPENSATED_GRAVITY_SHARE for number in numbers.values()
    )


@dataclass(frozen=True)
class FittedCause:
    """An effect at one place, with its fitted numbers.

    Attributes:
        effect: name of the effect, without the place.
        place: a joint, an actuator, a body or a channel; empty for an effect of the world.
        numbers: fitted numbers by coefficient; the keys contain no place.
    """

    effect: str
    place: str
    numbers: Mapping[str, FittedValue]

    @property
    def name(self) -> str:
        """Name with place, such as ``friction.coulomb@elbow``."""
        return f"{self.effect}@{self.place}" if self.place else self.effect

    @property
    def coefficients(self) -> Array:
        """Coefficients (K,) in the order of the effect; unspecified ones are zero."""
        axes = _COEFFICIENT_NAMES.get(self.effect)
        if axes is None:
            return np.array([number.value for number in self.numbers.values()])
        zero = FittedValue(0.0, "1", None, None)
        return np.array([self.numbers.get(axis, zero).value for axis in axes])

    def format(self, recording: str) -> str:
        """Format the cause with its numbers, for a comment in a model file.

        An example is ``friction.coulomb@elbow: 0.3 N·m (95 %: 0.28 to 0.32), fitted to log.csv``.

        An option of the solver whose values are words, such as the integrator, is formatted as
        ``numerics.integrator: from Euler to RK4``.

        Args:
            recording: name of the recording for the text; empty to leave it out.
        """
        # Every explanation imports this module, but only one of a robot needs the other.
        from sims.robot.integrator_settings import OPTION_EFFECTS, format_option

        has_several = len(self.numbers) > 1
        origin_text = f", fitted to {recording}" if recording else ""
        if self.effect in OPTION_EFFECTS:
            (estimate,) = self.numbers.values()
            option = OPTION_EFFECTS[self.effect]
            # Numbers in the model file (`stated`) and with the cause (`total`), if they are known.
            # The value of such an estimate is the option's number itself, not a change of it.
            before, after = (
                format_option(option, value if value is not None else estimate.value)
                for value in (estimate.stated, estimate.total)
            )
            if isinstance(after, str):  # The option has words.
                return f"{self.name}: from {before} to {after}{origin_text}"
        numbers = [
            (f"{name} " if has_several else "") + _format_estimate(estimate)
            for name, estimate in self.numbers.items()
        ]
        return f"{self.name}: {', '.join(numbers)}{origin_text}"


def _format_estimate(number: FittedValue) -> str:
    """Format a fitted number as ``-0.05 N·m (95 %: -0.06 to -0.04), from 0.2 to 0.15 N·m``.

    The parts are the fitted change, its confidence interval if it is known, and the number in the
    model file before and after the change if the file has one.

    Args:
        number: fitted change with its interval, and the number of the file before (`stated`) and
            after (`total`).
    """
    text = append_unit(f"{number.value:.4g}", number.unit)
    if number.low is not None and number.high is not None:
        text += f" (95 %: {number.low:.4g} to {number.high:.4g})"
    if number.stated is not None and number.total is not None:
        total = append_unit(f"{number.total:.4g}", number.total_unit or number.unit)
        text += f", from {number.stated:.4g} to {total}"
    return text


def expand_families(
    robot: RobotModel, causes: Mapping[str, Mapping[str, FittedValue]]
) -> list[FittedCause]:
    """Expand effect families to causes at one place each.

    A family is one effect at all places of a kind, such as ``friction.coulomb@*``. A model file
    states numbers for each place, so it needs the members.

    Args:
        robot: robot whose places a family has if its coefficients name no places.
        causes: coefficients by ``effect@place``. Those of a family have keys ``coefficient@PLACE``,
            or keys without a place if they hold for all places.
    """
    fitted_causes = []
    for name, numbers in causes.items():
        effect, _, place = name.partition("@")
        if place == ALL_PLACES:
            fitted_causes += _list_family_causes(robot, effect, numbers)
        else:
            fitted_causes.append(FittedCause(effect, place, dict(numbers)))
    return fitted_causes


def _list_family_causes(
    robot: RobotModel, effect: str, numbers: Mapping[str, FittedValue]
) -> list[FittedCause]:
    """Return the causes of an effect family, one for each place.

    Args:
        robot: robot with the places.
        effect: name of the effect without a place.
        numbers: fitted numbers. One with the key ``coefficient@place`` belongs to that place, one
            with the key ``coefficient`` to all places.
    """
    by_place: dict[str, dict[str, FittedValue]] = {}
    for key, number in numbers.items():
        coefficient, _, place = key.partition("@")
        places = [place] if place else _list_places(robot, effect)
        for member_place in places:
            by_place.setdefault(member_place, {})[coefficient] = number
    return [FittedCause(effect, place, place_numbers) for place, place_numbers in by_place.items()]


def _list_places(robot: RobotModel, effect: str) -> list[str]:
    """List the places of an effect family that has one number for all places.

    These are the actuators for an effect on inputs, and the joints for all others. Sensor effects
    are not divided, since no model file states them; their place is `ALL_PLACES`.

    Args:
        robot: model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        effect: name of the effect without its place.
    """
    if effect.startswith("input."):
        return [actuator.name for actuator in robot.actuators if actuator.motion is not None]
    if effect.startswith("sensor."):
        return [ALL_PLACES]
    return [joint.name for joint in robot.joints]
