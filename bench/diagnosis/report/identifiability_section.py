"""Report section on what the recording can identify, independent of the verdict.

It has a summary sentence, the free parameters, and a matrix of the causes; the full table is
folded.

A diagnosed cause counts as identifiable, whatever its score about the base model, and members of
indistinguishable sets are marked. The section must not contradict the headline.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from bench.diagnosis.identifiability import ParameterIdentifiability
from bench.diagnosis.report.effect_and_unit_text import (
    ALL_PLACES,
    append_unit,
    format_effect,
    format_effect_name,
    format_number,
    get_place_kind,
    joined,
    sanitise,
    split_effect_name,
)
from bench.diagnosis.report.report_data import DiagnosisReportData
from bench.diagnosis.verdict import Cause
from sims.core.plain_values import join_first_names

MAX_NAMED_CAUSES = 6
"""Maximum number of names in a cell or list; the remaining ones are counted."""
_STATUSES = ("found", "set", "identifiable", "weak", "not identifiable")
"""Status of a cause, the most certain first."""
_SIGNS: Mapping[str, str] = {
    "found": "★",
    "set": "☆",
    "identifiable": "●",
    "weak": "◐",
    "not identifiable": "○",
}
"""Sign of each status in a cell of the matrix."""
_LEGEND: Mapping[str, str] = {
    "found": "named by the verdict",
    "set": "explains the data as well as a named cause",
    "identifiable": "can be identified",
    "weak": "weakly identifiable",
    "not identifiable": "not visible in these data",
}
_KINDS = {"joint": "joints", "actuator": "actuators", "body": "bodies", "channel": "channels"}


@dataclass(frozen=True)
class _Row:
    """Cause with its identifiability.

    Attributes:
        number: Identifiability of the coefficient.
        effect: Registered name of the effect.
        status: One of `_STATUSES`.
    """

    number: ParameterIdentifiability
    effect: str
    status: str


class IdentifiabilityRow(NamedTuple):
    """Row of a table: one number, whether it can be identified, and how well."""

    name: str
    status: str
    interval: str
    range: str
    confounded: str


class MatrixCell(NamedTuple):
    """Cell of a matrix of effects by places: its sign and the sign's meaning."""

    sign: str
    label: str
    is_found: bool


class Matrix(NamedTuple):
    """Matrix of effects by places of one kind; each row is an effect with its cells."""

    kind: str
    places: list[str]
    rows: list[MatrixRow]


class MatrixRow(NamedTuple):
    """One effect, and its cell at each place; None where it cannot act."""

    effect: str
    cells: list[MatrixCell | None]


class IdentifiabilitySection(NamedTuple):
    """Content of the section of the report.

    Attributes:
        counts: Sentence on how many causes are identifiable.
        free: Rows of the free parameters.
        legend: Signs of the matrices and their meaning.
        matrices: Matrices of effects that are not identifiable at every place.
        family_headings: Headings of the table of causes without a place.
        families: Each family of effects with the names in each column, and whether they are bold.
        identifiable_heading: Heading of `identifiable_matrices`.
        identifiable_matrices: Matrices of effects that are identifiable at every place.
        all: Rows of all causes.
    """

    counts: str
    free: list[IdentifiabilityRow]
    legend: str
    matrices: list[Matrix]
    family_headings: list[str]
    families: list[tuple[str, list[tuple[str, bool]]]]
    identifiable_heading: str
    identifiable_matrices: list[Matrix]
    all: list[IdentifiabilityRow]


def build_identifiability_section(report: DiagnosisReportData) -> IdentifiabilitySection | None:
    """Build the section on free parameters and causes; None if identifiability is unknown.

    Causes that can act at several places are shown as matrices (effect by place), others as a list.

    Args:
        report: Data of the report, with the identifiability of each number.
    """
    if not report.identifiability:
        return None
    rows = _list_rows(report)
    present_statuses = [status for status in _STATUSES if any(row.status == status for row in rows)]
    unclear_rows, identifiable_rows = _separate_identifiable(
        [row for row in rows if _get_place(row)]
    )
    count = len({split_effect_name(row.effect)[0] for row in identifiable_rows})
    ordered_rows = sorted(rows, key=lambda row: _STATUSES.index(row.status))
    without_place = [row for row in rows if not _get_place(row)]
    columns_without_place = [s for s in _STATUSES if any(row.status == s for row in without_place)]
    return IdentifiabilitySection(
        counts=format_counts(report),
        free=[
            _format_table_row(number, number.word)
            for number in report.identifiability
            if number.free
        ],
        legend="; ".join(f"{_SIGNS[status]} {_LEGEND[status]}" for status in present_statuses),
        matrices=_build_matrices(unclear_rows),
        family_headings=[f"{_SIGNS[status]} {_LEGEND[status]}" for status in columns_without_place],
        families=_build_family_table(without_place, columns_without_place),
        identifiable_heading=(
            f"{count} {'more ' * bool(unclear_rows)}effects that can be identified at every place"
        ),
        identifiable_matrices=_build_matrices(identifiable_rows),
        all=[_format_table_row(row.number, _LEGEND[row.status]) for row in ordered_rows],
    )


def _separate_identifiable(rows: Sequence[_Row]) -> tuple[list[_Row], list[_Row]]:
    """Separate effects that are identifiable at every place from all others.

    The others come first in the report; they need the reader's attention.

    Returns:
        Rows of the other effects, and rows of effects that are identifiable at every place.
    """
    unclear_effects = {split_effect_name(r.effect)[0] for r in rows if r.status != "identifiable"}
    unclear_rows = [row for row in rows if split_effect_name(row.effect)[0] in unclear_effects]
    return unclear_rows, [
        row for row in rows if split_effect_name(row.effect)[0] not in unclear_effects
    ]


def _build_matrices(rows: Sequence[_Row]) -> list[Matrix]:
    """Build a matrix of effects and places for each kind of place, such as joints."""
    kinds = dict.fromkeys(get_place_kind(row.effect) for row in rows)
    return [
        _build_matrix([row for row in rows if get_place_kind(row.effect) == kind], kind)
        for kind in kinds
    ]


def format_counts(report: DiagnosisReportData) -> str:
    """Format how many causes are identifiable, and which were found.

    Args:
        report: Data of the report, with the identifiability of each number.
    """
    rows = _list_rows(report)
    statuses = [str("identifiable" if r.status == "found" else r.number.word) for r in rows]
    # The first two statuses are those of causes that the verdict names.
    counts = {s: statuses.count(s) for s in _STATUSES[2:]}
    sentence = (
        f"Of {len(rows)} causes, each considered alone, this recording can identify "
        f"{counts['identifiable']} well, {counts['weak']} roughly and "
        f"{counts['not identifiable']} not at all."
    )
    named_causes = [
        f"{format_effect(c.effect)} ({sanitise(c.effect, 60)})"
        for c in _list_supported_causes(report)
    ]
    return f"{sentence} Found: {joined(named_causes)}." if named_causes else sentence


def _list_supported_causes(report: DiagnosisReportData) -> list[Cause]:
    """Return the causes that the verdict supports."""
    is_supported = report.verdict.verdict in ("named", "ambiguous", "partial")
    return list(report.verdict.causes) if is_supported else []


def _list_rows(report: DiagnosisReportData) -> list[_Row]:
    """List the causes in the order of the numbers, with those of the verdict marked.

    A cause with alternatives has the status "set", another cause of the verdict "found"; other
    effects have the word of their identifiability, such as "not identifiable".
    """
    status_by_effect: dict[str, str] = {}
    for cause in _list_supported_causes(report):
        for name in (cause.effect, *cause.alternatives):
            status = "set" if cause.alternatives else "found"
            status_by_effect.setdefault(name, status)
            # For a family, members with a coefficient of their own are marked.
            for key in cause.coefficients if name == cause.effect else ():
                if place := split_effect_name(key)[1]:
                    status_by_effect.setdefault(f"{split_effect_name(name)[0]}@{place}", status)
    rows = []
    for number in report.identifiability:
        if not number.free:
            effect = number.name.partition(" ")[0]
            rows.append(_Row(number, effect, status_by_effect.get(effect, number.word)))
    return rows


def _get_place(row: _Row) -> str:
    """Return the place of an effect; empty if it acts at all places."""
    place = split_effect_name(row.effect)[1]
    return "" if place == ALL_PLACES else place


def _build_matrix(rows: Sequence[_Row], kind: str) -> Matrix:
    """Build the matrix of effects by places of one kind.

    Effects that are identifiable at more places come first.

    Args:
        rows: causes at places of this kind.
        kind: kind of the places: ``joint``, ``actuator``, ``body`` or ``channel``.
    """
    places = list(dict.fromkeys(_get_place(row) for row in rows))
    by_effect: dict[str, dict[str, _Row]] = {}
    for row in rows:
        by_place = by_effect.setdefault(split_effect_name(row.effect)[0], {})
        # Of several coefficients at a place, the best one is shown.
        best = by_place.setdefault(_get_place(row), row)
        if _STATUSES.index(row.status) < _STATUSES.index(best.status):
            by_place[_get_place(row)] = row

    def order(effect: str) -> list[int]:
        return sorted(_STATUSES.index(row.status) for row in by_effect[effect].values())

    return Matrix(
        _KINDS.get(kind, "places"),
        places,
        [
            MatrixRow(effect, [_make_cell(by_effect[effect].get(place)) for place in places])
            for effect in sorted(by_effect, key=order)
        ],
    )


def _make_cell(row: _Row | None) -> MatrixCell | None:
    """Return the matrix cell of an effect at a place; None if the effect is not available there.

    The cell is emphasised if the verdict names the effect here, or if the effect explains the data
    as well as a named cause.
    """
    if row is None:
        return None
    interval = _format_half_interval(row.number)
    label = f"{row.effect}: {_LEGEND[row.status]}{', ' * bool(interval)}{interval}"
    return MatrixCell(_SIGNS[row.status], label, row.status in ("found", "set"))


def _build_family_table(
    rows: Sequence[_Row], columns: Sequence[str]
) -> list[tuple[str, list[tuple[str, bool]]]]:
    """Build the table of causes without a place: families of effects by identifiability.

    Args:
        rows: causes without a place.
        columns: status of the causes in each column.

    Returns:
        Each family with the names of its effects in each column, and whether they are bold.
    """
    families: dict[str, dict[str, list[str]]] = {}
    for row in rows:
        by_status = families.setdefault(row.effect.partition(".")[0], {})
        by_status.setdefault(row.status, []).append(row.effect)
    return [
        (
            family,
            [
                (_join_effect_names(by_status.get(column, ())), column in ("found", "set"))
                for column in columns
            ],
        )
        for family, by_status in families.items()
    ]


def _join_effect_names(effects: Sequence[str]) -> str:
    """Join the names of at most `MAX_NAMED_CAUSES` different effects, and count the others."""
    return join_first_names(map(format_effect_name, effects), MAX_NAMED_CAUSES)


def _format_half_interval(number: ParameterIdentifiability) -> str:
    """Format half the 95 % interval with its unit; empty if the data are insensitive."""
    if not np.isfinite(number.half):
        return ""
    return append_unit(f"±{format_number(number.half)}", number.unit)


def _format_table_row(number: ParameterIdentifiability, status: str) -> IdentifiabilityRow:
    """Format the identifiability of a parameter or cause as a table row.

    Args:
        number: identifiability of the coefficient, with its interval and correlations.
        status: whether it can be identified, one of `_STATUSES`.
    """
    mixed = joined([f"{name} ({correlation:.2f})" for name, correlation in number.mixed])
    span = f"{format_number(number.low)} to {format_number(number.high)}"
    return IdentifiabilityRow(
        number.name, status, _format_half_interval(number), span, mixed or "–"
    )
