"""Rows of a data sheet: numbers of a joint or actuator that are found, fitted or not shown."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from bench.gap.measure import Z95
from bench.gap.report.words import name_of
from bench.gap.sheet.reach import Reach, Shown
from bench.gap.sheet.subject import Stated, Subject
from bench.gap.verdict import Cause, Verdict
from sims import effects as library
from sims.extended import Extended, Number
from sims.system import FAMILY

State = Literal["found", "fitted", "derived", "not shown"]
STEP = 1e-6
"""Relative step of a parameter for the derivatives of derived quantities."""


@dataclass(frozen=True)
class Quantity:
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
        reach: Detection limit of an effect that is not shown.
        p_value: Probability of a gain like that of the cause if it were absent.
        share: Share of the held-out gap that the cause closes alone; None if not measured.
        instead: Effects that explain the data as well.
        another: Half the 95 % interval for a log, or a run, that is not yet recorded; None if
            unknown.
        strongest: Whether it is the force limit of the drive, at rest.
    """

    name: str
    says: str
    part: str
    state: State
    unit: str
    number: Number | None = None
    stated: float | None = None
    reach: Reach | None = None
    p_value: float | None = None
    share: float | None = None
    instead: tuple[str, ...] = ()
    another: float | None = None
    strongest: bool = False

    def document(self) -> dict[str, Any]:
        """Return the row as TOML data, which has no null."""
        row: dict[str, Any] = {"state": self.state, "says": self.says, "unit": self.unit}
        row["part"] = self.part
        if self.number is not None:
            row |= self.number.table()
        if self.another is not None:
            row["another"] = self.another
        if self.stated is not None:
            row["stated"] = self.stated
        if self.reach is not None:
            row |= _reached(self.reach)
        if self.p_value is not None:
            row["p_value"] = self.p_value
        if self.share is not None:
            row["heldout_gain"] = self.share
        if self.instead:
            row["alternatives"] = list(self.instead)
        return row


def _reached(reach: Reach) -> dict[str, Any]:
    row: dict[str, Any] = {}
    if np.isfinite(reach.size):
        row[{"": "resolved", "above": "none_above", "below": "none_below"}[reach.limit]] = (
            reach.size
        )
        if reach.vague:
            row["vague"] = True
        if reach.leans:
            row["leans_to"] = reach.leaning
    if reach.mixed:
        row["mixed_with"] = list(reach.mixed)
    return row


def quantities(
    subject: Subject, extended: Extended, verdict: Verdict, shown: Shown
) -> tuple[Quantity, ...]:
    """Build the rows of a sheet.

    Args:
        subject: Joint or system.
        extended: Extended simulator.
        verdict: Verdict with the evidence.
        shown: Covariance and detection limits.

    Returns:
        Derived quantities, parameters, causes, then effects that are not shown.
    """
    rows = _Rows(subject, extended, verdict, shown)
    return (*rows.derived(), *rows.parameters(), *rows.causes(), *rows.absent())


@dataclass(frozen=True)
class _Rows:
    subject: Subject
    extended: Extended
    verdict: Verdict
    shown: Shown

    def derived(self) -> Iterator[Quantity]:
        """Yield quantities derived from the system's parameters, by error propagation."""
        parameters = self.extended.parameters
        values = {name: number.value for name, number in parameters.items()}
        known = {**self.extended.constants, **values}
        free = [name for name in self.shown.free if name in values]
        places = [self.shown.free.index(name) for name in free]
        covariance = self.shown.covariance[np.ix_(places, places)]
        for derived in self.subject.kind.system.derived:
            try:
                value = derived.of(known)
            except (KeyError, ZeroDivisionError):
                # A constant that differs between runs has no single value.
                continue
            slopes = []
            for name in free:
                step = STEP * (abs(known[name]) or 1.0)
                slopes.append((derived.of({**known, name: known[name] + step}) - value) / step)
            spread = np.array(slopes)
            half = Z95 * float(np.sqrt(max(spread @ covariance @ spread, 0.0)))
            number = Number(value, derived.unit, value - half, value + half)
            row = Quantity(derived.name, derived.says, "system", "derived", derived.unit, number)
            yield replace(row, strongest=derived.strongest)

    def parameters(self) -> Iterator[Quantity]:
        """Yield the parameters of the system, or the free numbers of the robot's file here."""
        if not self.subject.joint:
            for parameter in self.subject.kind.parameters:
                nominal = Number(parameter.nominal, parameter.unit, None, None)
                # A parameter that is not in the file has its nominal value.
                number = self.extended.parameters.get(parameter.name, nominal)
                says = parameter.says or parameter.name
                row = _row(parameter.name, says, "system", "fitted", number, None)
                yield replace(row, another=self.shown.another.get(parameter.name))
            return
        for name, number in self.extended.parameters.items():
            # The coefficient of an effect with several has its name after a point.
            effect, _, place = name.partition("@")
            there = next(
                (p for p in self.subject.places if place in (p, f"{p}.{_tail(place)}")), ""
            )
            if there:
                row = self._of_effect(f"{effect}@{there}", name, number, "fitted")
                yield self._apart(row, f"{effect}@{there}", name)

    def causes(self) -> Iterator[Quantity]:
        """Yield the diagnosed causes; members of a family that may be zero here are not shown."""
        for name, numbers in self.extended.effects.items():
            own = list(self.subject.own(name, numbers))
            for effect, coefficient, number in own:
                if number.value == 0:
                    # A coefficient of zero means that the effect is absent; its detection limit is
                    # computed.
                    continue
                several = sum(other == effect for other, _, _ in own) > 1
                label = f"{effect} {coefficient}" if several else effect
                row = self._of_effect(effect, label, number, "found", self._cause(name))
                if _is_nothing(number):
                    yield self._nothing(row, effect, number)
                    continue
                place = "" if name.partition("@")[2] != FAMILY else f"@{effect.partition('@')[2]}"
                alone = name if len(numbers) == 1 else f"{name}.{coefficient}{place}"
                yield self._apart(row, effect, alone)

    def _apart(self, row: Quantity, effect: str, parameter: str) -> Quantity:
        """Add the prediction interval from the consistency of the runs."""
        half, stated = self.shown.another.get(parameter), self.subject.stated(effect)
        if half is None or stated is None:
            return replace(row, another=half)
        return replace(row, another=stated.half(half))

    def _nothing(self, row: Quantity, effect: str, number: Number) -> Quantity:
        """Build the row of a cause at other places that is not shown here."""
        reach = _of_number(number, self.subject.stated(effect))
        return Quantity(
            row.name, row.says, row.part, "not shown", row.unit, stated=row.stated, reach=reach
        )

    def absent(self) -> Iterator[Quantity]:
        """Yield the effects that are not in the model, with their detection limits."""
        for (effect, coefficient), reach in self.shown.reaches.items():
            several = len({c for e, c in self.shown.reaches if e == effect}) > 1
            label = f"{effect} {coefficient}" if several else effect
            placed = library.find(effect, self.subject.kind.system)
            c = next(c for c in placed.coefficients if c.name == coefficient)
            unit = c.unit_on(self.subject.kind.system, self.extended.observe) or "1"
            yield self._absent(effect, label, unit, reach)

    def _absent(self, effect: str, label: str, unit: str, reach: Reach) -> Quantity:
        stated = self.subject.stated(effect)
        value = None
        if stated is not None:
            unit, value = stated.unit, stated.value
            reach = replace(reach, size=stated.half(reach.size), leaning=stated.half(reach.leaning))
        instead = tuple(c.effect for c in self.verdict.causes if effect in c.alternatives)
        says = name_of(effect.partition("@")[0])
        part = library.find(effect, self.subject.kind.system).at
        return Quantity(
            label, says, part, "not shown", unit, stated=value, reach=reach, instead=instead
        )

    def _of_effect(
        self, effect: str, label: str, number: Number, state: State, cause: Cause | None = None
    ) -> Quantity:
        placed = library.find(effect, self.subject.kind.system)
        stated = self.subject.stated(effect)
        if stated is not None:
            number = stated.total(number)
        row = _row(label, name_of(effect.partition("@")[0]), placed.at, state, number, stated)
        if cause is None:
            return row
        gains = [c.heldout_gain for c in self.verdict.candidates if c.effect == cause.effect]
        share = next(iter(gains), None)
        return replace(row, p_value=cause.p_value, share=share, instead=cause.alternatives)

    def _cause(self, name: str) -> Cause | None:
        return next((c for c in self.verdict.causes if c.effect == name), None)


def _row(name: str, says: str, part: str, state: State, number: Number, stated: Any) -> Quantity:
    value = None if stated is None else stated.value
    return Quantity(name, says, part, state, number.unit, number, value)


def _tail(place: str) -> str:
    return place.rpartition(".")[2]


def _is_nothing(number: Number) -> bool:
    """Return whether the coefficient of a cause at other places may be zero here."""
    if number.low is None or number.high is None:
        return False
    return number.low <= 0 <= number.high


def _of_number(number: Number, stated: Stated | None) -> Reach:
    low, high = number.low or 0.0, number.high or 0.0
    size = max(abs(low), abs(high))
    return Reach(size if stated is None else stated.half(size))
