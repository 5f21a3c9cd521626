"""Ranges for domain randomisation of the numbers of a robot's model file.

For each number that a diagnosed cause changes, or that was freed, the range is the 95 % interval of
its resulting value in the model file.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from bench.diagnosis.verdict import Verdict
from bench.pages.text_format import joined
from sims.core.user_messages import append_unit
from sims.extended_simulator import ExtendedSimulator, FittedValue
from sims.robot.fitted_causes import collect_causes

if TYPE_CHECKING:
    from sims.robot.fitted_causes import FittedCause
    from sims.robot.model_field_effects import ModelField
    from sims.robot.robot_model import RobotModel


NO_MODEL = "no ranges are written: {system} has no model file whose numbers could be randomised"
NOTHING_FOUND = (
    "no ranges are written: the verdict is {verdict}, and neither a named cause nor a free number "
    "has a finite interval"
)
NO_FIELD = (
    "no code for Isaac Lab and MuJoCo Playground is written: no field of the model has the "
    "numbers of ranges.toml; set them in your environment"
)


@dataclass(frozen=True)
class RandomizationRange:
    """Range of one number of a robot.

    Attributes:
        cause: Effect and place, such as ``friction.coulomb@elbow``.
        coefficient: Coefficient of the effect, such as ``coefficient`` or ``x``.
        is_free: Whether the user freed the number; otherwise it belongs to a diagnosed cause.
        kind: joint, actuator, body, channel or world.
        name: Name of the joint, actuator, body or channel; empty for the world.
        fields: Elements of the compiled model that contain the number, the main one first; empty if
            the model has no such number, so that all values are those of the coefficient.
        unit: Unit of nominal, value, low and high.
        nominal: Value in the model file; None if the file has none.
        value: Value with the effect.
        low, high: 95 % interval of the value with the effect, with all others at their estimates.
        operation: ``abs``, ``add`` or ``scale``.
        minimum, maximum: Limits of the uniform distribution to draw from, for the operation.
    """

    cause: str
    coefficient: str
    is_free: bool
    kind: str
    name: str
    fields: tuple[ModelField, ...]
    unit: str
    nominal: float | None
    value: float
    low: float
    high: float
    operation: str
    minimum: float
    maximum: float

    @property
    def effect(self) -> str:
        """Name of the effect, without its place."""
        return self.cause.partition("@")[0]

    @property
    def field(self) -> str:
        """Name of the main field of the compiled model; empty if there is none."""
        return self.fields[0].name if self.fields else ""

    def document(self) -> dict[str, Any]:
        """Return the range as in ranges.toml and in the command's JSON; TOML has no null."""
        document: dict[str, Any] = {
            "cause": self.cause,
            "coefficient": self.coefficient,
            "source": "free number" if self.is_free else "cause",
            "kind": self.kind,
            "name": self.name,
            "field": self.field,
        }
        if self.fields:
            document |= {"address": list(self.fields[0].address), "sign": self.fields[0].sign}
        document |= {"unit": self.unit}
        if self.nominal is not None:
            document["nominal"] = self.nominal
        document |= {key: getattr(self, key) for key in ("value", "low", "high", "operation")}
        return document | {"minimum": self.minimum, "maximum": self.maximum}


class RandomizationRanges(NamedTuple):
    """Ranges of a robot's numbers, and reasons for those that are left out.

    Attributes:
        ranges: Ranges in the order of the causes.
        left_out: Omitted ranges with the reason, one line each.
    """

    ranges: tuple[RandomizationRange, ...]
    left_out: tuple[str, ...]


class _Entry(NamedTuple):
    """Coefficient of an effect at one place."""

    cause: FittedCause
    is_free: bool
    coefficient: str


def list_randomization_ranges(answer: Verdict, extended: ExtendedSimulator) -> RandomizationRanges:
    """Return the ranges of the fitted numbers of diagnosed causes and of free numbers.

    Numbers of the solver are left out. So are ambiguous causes and numbers without an interval,
    with the reason.

    Args:
        answer: Verdict. A cause with alternatives is ambiguous, and is left out.
        extended: Extended simulator with the fitted numbers.
    """
    kind: Any = extended.kind
    if kind is None or not kind.has_model:
        return RandomizationRanges((), (NO_MODEL.format(system=f"system {extended.system}"),))
    # This import is needed for robots only.
    from sims.robot.fitted_causes import expand_families

    # 1. Effects that may have ranges.
    unambiguous_effects = {cause.effect for cause in answer.causes if not cause.alternatives}
    left_out = [
        f"{cause.effect} is not in the ranges: these data cannot distinguish it from "
        f"{joined(cause.alternatives, 'or')}"
        for cause in answer.causes
        if cause.alternatives
    ]
    freed_effects = {effect.name for effect in kind.system.freed_effects}
    causes_by_name = {
        name: numbers
        for name, numbers in collect_causes(extended).items()
        if not name.startswith("numerics.")
    }
    # A cause at several places (a family) is divided into causes at one place each.
    causes = [
        (name, cause)
        for name, numbers in causes_by_name.items()
        for cause in expand_families(kind.robot, {name: numbers})
    ]
    # 2. Ranges.
    ranges = []
    totals = _Totals(kind, [cause for _, cause in causes])
    for cause_index, (name, cause) in enumerate(causes):
        is_free = name in freed_effects
        if not is_free and name not in unambiguous_effects:
            continue
        for coefficient, fitted in cause.numbers.items():
            entry = _Entry(cause, is_free, coefficient)
            reason = _find_missing_range_reason(fitted, entry)
            if not reason:
                ranges.append(_convert_to_range(kind.robot, totals, cause_index, entry))
            # A coefficient of a cause that was never fitted needs no reason.
            elif is_free or fitted.value or fitted.at_bound:
                left_out.append(reason)
    # 3. Notes.
    if ranges and not any(number_range.fields for number_range in ranges):
        left_out.append(NO_FIELD)
    if not ranges:
        left_out.append(NOTHING_FOUND.format(verdict=answer.verdict))
    return RandomizationRanges(tuple(ranges), tuple(left_out))


def _find_missing_range_reason(number: FittedValue, entry: _Entry) -> str:
    """Return in words why a number has no range for randomisation; empty if it has one.

    Args:
        number: fitted value of the coefficient.
        entry: the coefficient and its cause.
    """
    from sims.robot.fitted_causes import is_gravity_compensated

    name = entry.cause.name
    if len(entry.cause.numbers) > 1:
        name = f"{name} ({entry.coefficient})"
    value_text = append_unit(f"{number.value:.3g}", number.unit)
    if number.at_bound is not None:
        end = {"low": "lower", "high": "upper"}[number.at_bound]
        reason = f"its value, {value_text}, is at the {end} bound of its range"
    elif number.low is None or number.high is None:
        reason = f"its value, {value_text}, has no finite interval"
    elif is_gravity_compensated(entry.cause.effect, entry.cause.numbers):
        reason = 'gravity is compensated; extended.xml states this with gravcomp="1"'
    else:
        return ""
    return f"{name} is not in the ranges: {reason}"


class _Totals:
    """Numbers of the model file with all effects applied, for changes of one coefficient."""

    def __init__(self, kind: Any, causes: list[FittedCause]) -> None:
        """Store the robot, and the fitted coefficients of each cause by name."""
        self.robot: RobotModel = kind.robot
        self.effects = [kind.system.effect(cause.name) for cause in causes]
        self.values = [
            {c.name: _get_value(cause.numbers, c.name) for c in effect.coefficients}
            for effect, cause in zip(self.effects, causes, strict=True)
        ]

    def compute_total(
        self, cause_index: int, coefficient: str, value: float
    ) -> tuple[float | None, float, str]:
        """Compute a number of the model file for a given value of one coefficient.

        All other coefficients have their fitted values. The ends of the interval of a coefficient
        are converted to those of the number in this way.

        Args:
            cause_index: Index of the cause.
            coefficient: Coefficient of the cause that is changed.
            value: Value of the coefficient.

        Returns:
            The number as the file states it, the number with all effects applied, and its unit. If
            the file has no such number, they are None, the value of the coefficient, and its unit.
        """
        from sims.robot.export.model_file_totals import compute_file_totals

        values = [dict(coefficients) for coefficients in self.values]
        values[cause_index][coefficient] = value
        fitted = [
            (effect, list(coefficients.values()))
            for effect, coefficients in zip(self.effects, values, strict=True)
        ]
        effect = self.effects[cause_index]
        index = [c.name for c in effect.coefficients].index(coefficient)
        number_total = compute_file_totals(self.robot, fitted)[cause_index][index]
        if number_total is not None:
            return number_total.stated, number_total.total, number_total.unit
        return None, value, effect.coefficients[index].units[0] or "1"


def _get_value(numbers: Mapping[str, FittedValue], coefficient: str) -> float:
    """Return the fitted value of a coefficient; 0 if it was not fitted.

    Args:
        numbers: fitted coefficients of an effect, by name.
        coefficient: name of the coefficient.
    """
    return numbers[coefficient].value if coefficient in numbers else 0.0


def _convert_to_range(
    robot: RobotModel, totals: _Totals, cause_index: int, entry: _Entry
) -> RandomizationRange:
    """Convert the interval of a fitted coefficient to a range of the number in the model file.

    Its operation says whether a simulator sets the random value (``abs``), adds it (``add``) or
    multiplies by it (``scale``); minimum and maximum are for this operation.

    Args:
        robot: model of the robot.
        totals: numbers of the model file with all effects applied.
        cause_index: index of the cause in `totals`.
        entry: the coefficient and its cause.
    """
    from sims.robot.model_field_effects import model_fields, operation_of

    cause, fitted = entry.cause, entry.cause.numbers[entry.coefficient]
    assert fitted.low is not None
    assert fitted.high is not None
    effect = totals.effects[cause_index]
    # Elements of the compiled MuJoCo model (`mjModel`) that each coefficient of the effect changes,
    # if there are any.
    fields = model_fields(robot, cause.effect, cause.place)
    names = [c.name for c in effect.coefficients]
    own_fields = tuple(fields[names.index(entry.coefficient)]) if fields else ()
    nominal, value, unit = totals.compute_total(cause_index, entry.coefficient, fitted.value)
    # Ends of the interval as numbers of the file, whose order may be reversed.
    _, first_end, _ = totals.compute_total(cause_index, entry.coefficient, fitted.low)
    _, second_end, _ = totals.compute_total(cause_index, entry.coefficient, fitted.high)
    low, high = sorted((first_end, second_end))
    operation = operation_of(cause.effect)
    minimum, maximum = low, high
    if operation == "add" and nominal is not None:
        minimum, maximum = low - nominal, high - nominal
    elif operation == "scale" and nominal:
        minimum, maximum = sorted((low / nominal, high / nominal))
    return RandomizationRange(
        cause=cause.name,
        coefficient=entry.coefficient,
        is_free=entry.is_free,
        kind=effect.at,
        name=cause.place,
        fields=own_fields,
        unit=unit,
        nominal=nominal,
        value=value,
        low=low,
        high=high,
        operation=operation,
        minimum=minimum,
        maximum=maximum,
    )


def describe_ranges(
    ranges: RandomizationRanges,
) -> Iterator[tuple[RandomizationRange, str]]:
    """Yield each range with a line of text, such as ``dof_damping of joint elbow: ...``.

    The text has the value in the model file if there is one, the value with the effect and its
    range, the unit, and the cause.

    Args:
        ranges: ranges of the numbers of a robot.
    """
    for number_range in ranges.ranges:
        place_text = "the world"
        if number_range.name:
            place_text = f"{number_range.kind} {number_range.name}"
        quantity = number_range.field or f"effect {number_range.effect}"
        # An effect with a single coefficient calls it "coefficient", which says nothing.
        if number_range.coefficient != "coefficient":
            quantity += f" ({number_range.coefficient})"
        value_in_file = ""
        if number_range.nominal is not None:
            value_in_file = f"{number_range.nominal:.4g} in the model file, "
        unit = "" if number_range.unit == "1" else f" {number_range.unit}"
        yield (
            number_range,
            f"{quantity} of {place_text}: {value_in_file}{number_range.value:.4g} "
            f"({number_range.low:.4g} to {number_range.high:.4g}){unit} with {number_range.cause}",
        )


def list_heading(extended: ExtendedSimulator, framework: str, left_out: Iterable[str]) -> list[str]:
    """List the comments at the beginning of a file: its origin, and ranges that are left out.

    Args:
        extended: Extended simulator with the numbers.
        framework: Name of the framework.
        left_out: Reasons for ranges that are left out.
    """
    model = extended.robot.path.name if extended.robot is not None else extended.system
    return [
        f"Domain randomisation for {framework}, written by simgap explain --ranges: robot "
        f"{model}, recording {extended.title}.",
        "Each range is the 95 % interval of a number of the model file with the causes found. "
        "It states how well this recording determines the number, not how robots of one type "
        "differ.",
        *(f"Left out: {line}." for line in left_out),
    ]
