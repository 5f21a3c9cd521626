"""Rows and content of a data sheet for any output format, and its text."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from bench.diagnosis.datasheet.datasheet_joint import (
    PLACE_KIND_TITLES,
    SheetSubject,
)
from bench.diagnosis.datasheet.detection_limits import (
    DetectionLimit,
    DetectionLimits,
    make_limit_from_interval,
)
from bench.diagnosis.datasheet.drive_diagram import DriveDiagram, compute_drive_diagram
from bench.diagnosis.report.cause_and_value_text import (
    append_unit,
    format_effect_name,
    format_fitted_value,
    format_number,
    format_p_value,
    format_percent,
    joined,
    sanitise,
)
from bench.diagnosis.validation.confidence_intervals import Z95
from bench.diagnosis.verdict import Cause, Verdict
from sims import effects as library
from sims.core.effect import ALL_PLACES
from sims.core.simulator import Array
from sims.extended_simulator import ExtendedSimulator, FittedValue
from sims.recording.recording import Recording

QuantityState = Literal["found", "fitted", "derived", "not shown"]
DERIVATIVE_STEP_SHARE = 1e-6
"""Relative step of a parameter for the derivatives of derived quantities."""


@dataclass(frozen=True)
class SheetRow:
    """Row of the sheet: one number.

    Attributes:
        name: Name of the effect here, with its coefficient if it has several; or of the parameter.
        says: Name in words.
        part: ``joint``, ``actuator``, ``channel``, or ``system`` for a parameter of a system.
        state: ``found`` for a cause, ``fitted`` for a parameter, ``derived`` for a number that
            follows from others, or ``not shown``.
        unit: Unit of the number.
        number: Value with its 95 % interval; None if it is not shown.
        stated: Value in the model file; None if the file has none.
        detection_limit: Detection limit of an effect that is not shown.
        p_value: Probability of a gain like that of the cause if it were absent.
        share: Share of the held-out gap that the cause closes alone; None if not measured.
        alternatives: Effects that explain the data as well.
        prediction_half_width: Half the 95 % interval for a log, or a run, that is not yet recorded;
            None if unknown.
        strongest: Whether it is the force limit of the drive, at rest.
    """

    name: str
    says: str
    part: str
    state: QuantityState
    unit: str
    number: FittedValue | None = None
    stated: float | None = None
    detection_limit: DetectionLimit | None = None
    p_value: float | None = None
    share: float | None = None
    alternatives: tuple[str, ...] = ()
    prediction_half_width: float | None = None
    strongest: bool = False

    def to_document(self) -> dict[str, Any]:
        """Return the row as TOML data, which has no null.

        Keys without a value are left out. `another` is half the 95 % interval of the value in a log
        or run that is not yet recorded, and `stated` the value in the model file.
        """
        row = {
            "state": self.state,
            "says": self.says,
            "unit": self.unit,
            "part": self.part,
            **(self.number.to_table() if self.number else {}),
            "another": self.prediction_half_width,
            "stated": self.stated,
            **(self.detection_limit.to_document() if self.detection_limit else {}),
            "p_value": self.p_value,
            "heldout_gain": self.share,
            "alternatives": list(self.alternatives) or None,
        }
        return {key: value for key, value in row.items() if value is not None}


def build_sheet_rows(
    subject: SheetSubject, extended: ExtendedSimulator, verdict: Verdict, limits: DetectionLimits
) -> tuple[SheetRow, ...]:
    """Build the rows of a sheet.

    Args:
        subject: Joint or system.
        extended: Extended simulator.
        verdict: Verdict with the evidence.
        limits: Covariance and detection limits.

    Returns:
        Derived quantities, parameters, causes, then effects that are not shown.
    """
    rows = _Rows(subject, extended, verdict, limits)
    return (*rows.derived(), *rows.parameters(), *rows.causes(), *rows.absent())


@dataclass(frozen=True)
class _Rows:
    """Builder of the rows of a data sheet, from a verdict and the detection limits."""

    subject: SheetSubject
    extended: ExtendedSimulator
    verdict: Verdict
    detection_limits: DetectionLimits

    def derived(self) -> Iterator[SheetRow]:
        """Yield quantities that follow from the system's parameters, such as a stall torque.

        The 95 % interval of a quantity with the gradient g by the fitted parameters, whose
        covariance is C, extends by 1.96 sqrt(g'C g) to both sides (linear error propagation). The
        gradient is computed by forward differences. A quantity that needs an unknown or a varying
        constant is left out.
        """
        parameters = {
            name: fitted_value.value for name, fitted_value in self.extended.parameters.items()
        }
        values_by_name = {**self.extended.constants, **parameters}
        # Names of the fitted parameters of the system, and their indices in the covariance, which
        # also has the fitted coefficients of effects.
        indices, free = [], []
        for index, name in enumerate(self.detection_limits.free):
            if name in parameters:
                indices.append(index)
                free.append(name)
        covariance = self.detection_limits.covariance[np.ix_(indices, indices)]
        for quantity in self.subject.kind.system.derived:
            try:
                # `of` computes the quantity from parameters and constants by name.
                value = quantity.of(values_by_name)
            except (KeyError, ZeroDivisionError):
                # A constant that differs between runs has no single value, so it is not in
                # `values_by_name`; a constant of zero may divide by zero.
                continue
            gradient: Array = np.zeros(len(free))
            for i, name in enumerate(free):
                step = DERIVATIVE_STEP_SHARE * (abs(values_by_name[name]) or 1.0)
                stepped_values = {**values_by_name, name: values_by_name[name] + step}
                gradient[i] = (quantity.of(stepped_values) - value) / step
            variance = float(gradient @ covariance @ gradient)
            half_width = Z95 * float(np.sqrt(max(variance, 0.0)))
            fitted_value = FittedValue(value, quantity.unit, value - half_width, value + half_width)
            row = SheetRow(
                quantity.name, quantity.says, "system", "derived", quantity.unit, fitted_value
            )
            yield replace(row, strongest=quantity.strongest)

    def parameters(self) -> Iterator[SheetRow]:
        """Yield the parameters of the system, or those of the robot's joint.

        1. A system that is not a robot has all its parameters on the sheet.
        2. The parameters of a robot are numbers of its model file that were fitted. Their names
           have the form ``effect@place``, or ``effect@place.coefficient`` for one of several
           coefficients. Only those at this joint, its actuators and its channels are on the sheet.
        """
        # 1. System.
        if not self.subject.joint:
            for parameter in self.subject.kind.parameters:
                nominal = FittedValue(parameter.nominal, parameter.unit, None, None)
                # A parameter that is not in the file has its nominal value.
                fitted_value = self.extended.parameters.get(parameter.name, nominal)
                description = parameter.says or parameter.name
                row = _make_fitted_row(
                    parameter.name, description, "system", "fitted", fitted_value, None
                )
                yield replace(
                    row,
                    prediction_half_width=self.detection_limits.prediction_half_widths.get(
                        parameter.name
                    ),
                )
            return
        # 2. Joint of a robot.
        for name, fitted_value in self.extended.parameters.items():
            effect_name, _, place = name.partition("@")
            if place not in self.subject.places:
                # The name may have a coefficient at its end. Of an effect with several
                # coefficients, the name of one follows after a point.
                place, _, _ = place.rpartition(".")
            if place in self.subject.places:
                effect = f"{effect_name}@{place}"
                row = self._make_effect_row(effect, name, fitted_value, "fitted")
                yield self._add_prediction_interval(row, effect, name)

    def causes(self) -> Iterator[SheetRow]:
        """Yield the diagnosed causes that act at this joint, with their coefficients.

        A cause at all places of a kind, such as all joints (a family), is resolved to the places of
        this joint. If the interval of its coefficient here contains zero, the row gives a detection
        limit instead of the value.
        """
        for name, coefficients in self.extended.effects.items():
            local_coefficients = list(self.subject.localise_effect(name, coefficients))
            for effect, coefficient, fitted_value in local_coefficients:
                # With a coefficient of zero, the effect is a row of `absent`.
                if fitted_value.value == 0:
                    continue
                has_several = (
                    sum(other_effect == effect for other_effect, _, _ in local_coefficients) > 1
                )
                label = f"{effect} {coefficient}" if has_several else effect
                row = self._make_effect_row(
                    effect, label, fitted_value, "found", self._find_cause(name)
                )
                if _may_be_zero(fitted_value):
                    yield self._make_hidden_row(row, effect, fitted_value)
                    continue
                # Name of the coefficient among the fitted parameters: `EFFECT.COEFFICIENT` for one
                # of several, followed by `@PLACE` in a family.
                parameter = name
                if len(coefficients) > 1:
                    parameter += f".{coefficient}"
                    if name.endswith(f"@{ALL_PLACES}"):
                        _, _, place = effect.partition("@")
                        parameter += f"@{place}"
                yield self._add_prediction_interval(row, effect, parameter)

    def _add_prediction_interval(self, row: SheetRow, effect: str, parameter: str) -> SheetRow:
        """Add to a row the interval of its value for a run that is not yet recorded.

        It is known only if several runs or logs identify the value. For a number of the model file
        it is converted to the unit of that number.

        Args:
            row: the row.
            effect: name of the effect, with its place on a robot: ``drag.linear@elbow``.
            parameter: name of its coefficient, by which the half widths are stored.
        """
        half_width = self.detection_limits.prediction_half_widths.get(parameter)
        file_value = self.subject.get_model_file_value(effect)
        if half_width is None or file_value is None:
            return replace(row, prediction_half_width=half_width)
        return replace(row, prediction_half_width=file_value.compute_half_width(half_width))

    def _make_hidden_row(self, row: SheetRow, effect: str, number: FittedValue) -> SheetRow:
        """Build the row of a cause that may be absent at this joint, although it acts at others.

        The row has a detection limit instead of a value: the larger end of the interval of the
        coefficient, which contains zero.

        Args:
            row: row of the cause.
            effect: name of the effect, with its place on a robot: ``drag.linear@elbow``.
            number: fitted coefficient, whose interval gives the detection limit.
        """
        detection_limit = make_limit_from_interval(
            number, self.subject.get_model_file_value(effect)
        )
        return SheetRow(
            row.name,
            row.says,
            row.part,
            "not shown",
            row.unit,
            stated=row.stated,
            detection_limit=detection_limit,
        )

    def absent(self) -> Iterator[SheetRow]:
        """Yield the effects that are not in the model, with their detection limits.

        The detection limit is the smallest size that the data would have revealed.
        """
        system = self.subject.kind.system
        limits = self.detection_limits.limits
        for (effect, coefficient_name), detection_limit in limits.items():
            has_several = sum(other_effect == effect for other_effect, _ in limits) > 1
            label = f"{effect} {coefficient_name}" if has_several else effect
            coefficient = next(
                coefficient
                for coefficient in library.find_effect(effect, system).coefficients
                if coefficient.name == coefficient_name
            )
            unit = coefficient.unit_on(system, self.extended.observe) or "1"
            yield self._make_absent_effect_row(effect, label, unit, detection_limit)

    def _make_absent_effect_row(
        self, effect: str, label: str, unit: str, detection_limit: DetectionLimit
    ) -> SheetRow:
        """Build the row of an effect that is not in the model, with its detection limit.

        If the effect changes a number of the model file, for example by a share of the mass, the
        limit is converted to the unit of that number. Causes of the verdict that have the effect as
        alternative become the alternatives of the row.

        Args:
            effect: name of the effect, with its place.
            label: name of the row.
            unit: unit of the coefficient.
            detection_limit: limit of the coefficient.
        """
        file_value = self.subject.get_model_file_value(effect)
        # Value in the model file; None if the file has none.
        value = None
        if file_value is not None:
            unit, value = file_value.unit, file_value.value
            detection_limit = replace(
                detection_limit,
                size=file_value.compute_half_width(detection_limit.size),
                estimate_if_fitted=file_value.compute_half_width(
                    detection_limit.estimate_if_fitted
                ),
            )
        alternatives = tuple(c.effect for c in self.verdict.causes if effect in c.alternatives)
        description = format_effect_name(effect.partition("@")[0])
        part = library.find_effect(effect, self.subject.kind.system).at
        return SheetRow(
            label,
            description,
            part,
            "not shown",
            unit,
            stated=value,
            detection_limit=detection_limit,
            alternatives=alternatives,
        )

    def _make_effect_row(
        self,
        effect: str,
        label: str,
        number: FittedValue,
        state: QuantityState,
        cause: Cause | None = None,
    ) -> SheetRow:
        """Build the row of a fitted parameter or a diagnosed cause.

        The row of a cause also has its p-value, its alternatives, and the share of the held-out gap
        that it closes, if the verdict states it.

        Args:
            effect: Effect with its place, as ``name@place``.
            label: Name of the row.
            number: Fitted coefficient of the effect. If the effect changes a number of the model
                file, the row has the resulting total of that number instead.
            state: State of the quantity, such as ``fitted`` or ``found``.
            cause: Cause in the verdict, for its p-value and alternatives; None for a parameter.
        """
        placed_effect = library.find_effect(effect, self.subject.kind.system)
        file_value = self.subject.get_model_file_value(effect)
        if file_value is not None:
            number = file_value.compute_total(number)
        row = _make_fitted_row(
            label,
            format_effect_name(effect.partition("@")[0]),
            placed_effect.at,
            state,
            number,
            file_value,
        )
        if cause is None:
            return row
        share = next(
            (c.heldout_gain for c in self.verdict.candidates if c.effect == cause.effect), None
        )
        return replace(row, p_value=cause.p_value, share=share, alternatives=cause.alternatives)

    def _find_cause(self, name: str) -> Cause | None:
        return next((c for c in self.verdict.causes if c.effect == name), None)


def _make_fitted_row(
    name: str,
    description: str,
    part: str,
    state: QuantityState,
    number: FittedValue,
    file_value: Any,
) -> SheetRow:
    """Build a row with a fitted value and, if there is one, the value of the model file.

    Args:
        name: name of the number on the sheet.
        description: the number in words.
        part: ``joint``, ``actuator``, ``channel`` or ``system``.
        state: whether the number is a cause, a parameter, or derived from others.
        number: fitted value with its interval.
        file_value: value in the model file; None if the file has none.
    """
    nominal = None if file_value is None else file_value.value
    return SheetRow(name, description, part, state, number.unit, number, nominal)


def _may_be_zero(number: FittedValue) -> bool:
    """Return whether zero lies in the 95 % interval of a coefficient; False without an interval."""
    if number.low is None or number.high is None:
        return False
    return number.low <= 0 <= number.high


FORMAT_VERSION = 1
"""Format version of sheet.toml."""

NAMES_IN_TERMINAL = 5
"""Maximum number of effects that the terminal names as not shown by the data."""


MAX_LINE_NAME_LENGTH = 80
"""Maximum number of characters of a name in the text of a sheet."""


@dataclass(frozen=True)
class SheetContent:
    """Content of a data sheet.

    Attributes:
        name: Name on the sheet.
        subject: Joint or system that it describes.
        recording: Logs.
        verdict: Verdict of the diagnosis.
        extended: Extended simulator.
        rows: Numbers of the sheet.
    """

    name: str
    subject: SheetSubject
    recording: Recording
    verdict: Verdict
    extended: ExtendedSimulator
    rows: tuple[SheetRow, ...]

    def document(self) -> dict[str, Any]:
        """Return the content of sheet.toml.

        `quantities` has one table per row; the diagram, or the friction at rest, follows.
        """
        rows_by_name = {row.name: row.to_document() for row in self.rows}
        joint = {"joint": self.subject.joint} if self.subject.joint else {}
        return {
            "format": FORMAT_VERSION,
            "name": self.name,
            "system": self.subject.kind.name,
            **joint,
            "recording": self.recording.title or self.recording.path.stem,
            "runs": [run.name for run in self.recording.training()],
            "verdict": self.verdict.verdict,
            "elsewhere": list(self.elsewhere()),
            "quantities": rows_by_name,
            **self._describe_rest(),
        }

    def _describe_rest(self) -> dict[str, Any]:
        """Return the diagram of a drive; without a drive, the dry friction that holds the joint."""
        if self.diagram is not None:
            return {"diagram": self.diagram.to_document()}
        rest_diagram = self.rest
        return {
            "rest": {
                "unit": rest_diagram.unit,
                "laws": list(rest_diagram.laws),
                "breakaway": rest_diagram.breakaway,
            }
        }

    @cached_property
    def is_driven(self) -> bool:
        """Return whether a drive acts here; without one there is no diagram."""
        return self.subject.is_driven(self.recording)

    @property
    def diagram(self) -> DriveDiagram | None:
        """Diagram of where the joint moves, holds and slips; None without a drive."""
        return self.rest if self.is_driven else None

    def explain_missing_diagram(self) -> str:
        """Return why there is no diagram, and what is known of the joint at rest instead."""
        reason = "the log has no input"
        if self.subject.joint:
            reason = (
                f"joint {self.subject.joint} has no actuator in the model, and no force in the log"
            )
        rest_diagram = self.rest
        if rest_diagram.laws and rest_diagram.breakaway > 0:
            force = append_unit(format_number(rest_diagram.breakaway), rest_diagram.unit)
            friction_text = (
                f"At rest, dry friction holds loads up to {force} ({joined(rest_diagram.laws)})"
            )
        else:
            friction_text = "No friction law was found that holds it at rest"
        return (
            f"There is no drive: {reason}. Therefore this sheet has no drive and back-drive "
            "diagram, and no numbers of a drive; the table shows the other effects on the joint. "
            f"{friction_text}."
        )

    @cached_property
    def rest(self) -> DriveDiagram:
        """Diagram of where the joint moves, holds and slips, also without a drive."""
        force_limits = [row.number.value for row in self.rows if row.strongest and row.number]
        return compute_drive_diagram(self.subject, self.extended, next(iter(force_limits), None))

    def elsewhere(self) -> Iterator[str]:
        """Yield causes of the model that act at other places, or in the world."""
        for name, numbers in self.extended.effects.items():
            if not any(True for _ in self.subject.localise_effect(name, numbers)):
                yield name

    def lines(self) -> list[str]:
        """Format the sheet as text for the terminal: numbers first, then effects not detected.

        At most `NAMES_IN_TERMINAL` of the latter are named.
        """
        lines = [f"{sanitise(self.name, MAX_LINE_NAME_LENGTH)}: {self.verdict.verdict}"]
        lines += [
            f"  {sanitise(row.name, MAX_LINE_NAME_LENGTH)} = {format_fitted_value(row.number)}"
            for row in self.rows
            if row.number is not None
        ]
        absent_names = [row.name for row in self.rows if row.number is None]
        unnamed_count = len(absent_names) - NAMES_IN_TERMINAL
        if unnamed_count > 0:
            absent_names[NAMES_IN_TERMINAL:] = [
                f"{unnamed_count} more (the sheet gives the detection limit of each)"
            ]
        lines.append(
            f"not detected in these data: {sanitise(joined(absent_names), 2000) or 'nothing'}"
        )
        return lines


UNJUDGED_P_VALUE = 0.05
"""P-value above which a cause is on the sheet only because the search ended before it was tested.
"""


def title(row: SheetRow, is_driven: bool) -> str:
    """Return the title of the part of the table that a row belongs to.

    Args:
        row: Row of the sheet.
        is_driven: Whether a drive acts on the joint or system.
    """
    if row.part == "system":
        return "Motor" if is_driven else "System"
    return PLACE_KIND_TITLES[row.part]


def format_prediction_interval(row: SheetRow) -> str:
    """Format half the prediction interval for a run or log that is not yet recorded."""
    return (
        ""
        if row.prediction_half_width is None
        else f"± {format_number(row.prediction_half_width, 2)}"
    )


def format_name(row: SheetRow) -> str:
    """Return the name of the row in words."""
    if row.part == "system":
        return row.name.replace("_", " ")
    # The sheet shows the value itself, not its difference from the model file.
    return row.says if row.stated is None else re.sub("^(wrong|misplaced) ", "", row.says)


def format_short_name(row: SheetRow) -> str:
    """Return the name of the row without the joint or actuator that the whole sheet describes."""
    effect, _, placed_name = row.name.partition("@")
    if not placed_name:
        return row.name
    place, _, coefficient = placed_name.partition(" ")
    channel = place.partition(".")[0] if row.part == "channel" else ""
    return " ".join(part for part in (effect, coefficient, channel) if part)


def format_evidence(row: SheetRow, is_short: bool = False) -> str:
    """Format the evidence for a number on the sheet.

    For a cause, it is the p-value, the share of the held-out gap (the error on runs that were not
    fitted) that the cause closes alone, and the alternatives.

    Args:
        row: Row of the sheet.
        is_short: Whether to use the short form for print.
    """
    if row.state == "derived":
        return "computed from the numbers below"
    if row.state == "fitted":
        has_interval = row.number is not None and row.number.low is not None
        return "fitted" if has_interval else "not identified by these data"
    # Otherwise the row is a diagnosed cause. A p-value above the limit means that the search ended
    # before the cause was tested.
    is_judged = row.p_value is None or row.p_value <= UNJUDGED_P_VALUE
    unjudged_text = "not tested" if is_short else "the search ended before it was tested"
    phrases = [format_p_value(row.p_value) if is_judged else unjudged_text]
    if row.share is not None:
        closed_share = format_percent(row.share)
        phrases.append(
            f"{closed_share} held out"
            if is_short
            else f"alone it closes {closed_share} of the held-out gap"
        )
    if row.alternatives:
        phrases.append(f"{joined(row.alternatives, 'or')} explains the data equally well")
    return "; ".join(phrases)


def format_detection_limit(row: SheetRow) -> str:
    """Format in words how large an absent effect could be without being detected.

    Args:
        row: Row of an effect that is not in the model.

    Returns:
        Text such as "0 ± 0.02 N·m": a coefficient in this range would not have been detected. For a
        backlash or a stop, it is such as "none above 0.1 rad".
    """
    detection_limit = row.detection_limit
    if detection_limit is None or detection_limit.size == float("inf"):
        return "none: the data do not depend on it"
    size = format_number(detection_limit.size, 2)
    if detection_limit.is_unbounded:
        return append_unit(f"± {size}", row.unit) + ", larger than any plausible value"
    if detection_limit.limit:
        return append_unit(f"none {detection_limit.limit} {size}", row.unit)
    if detection_limit.is_nonzero_if_fitted:
        estimate = format_number(detection_limit.estimate_if_fitted, 2)
        return append_unit(f"{estimate} ± {size}", row.unit) + ", not diagnosed"
    return append_unit(f"0 ± {size}", row.unit)


def format_confounding(row: SheetRow) -> str:
    """Format confounded parameters, and causes that the effect might replace."""
    parts = list(row.detection_limit.confounded_with) if row.detection_limit else []
    if row.alternatives:
        parts.append(f"possible alternative to {joined(row.alternatives, 'or')}")
    return ", ".join(parts)
