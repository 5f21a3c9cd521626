"""Report section and terminal text on what the recording can identify, independent of the verdict.

The section has a summary sentence, the free parameters, and a matrix of the causes; the full table
is folded. In it, a diagnosed cause counts as identifiable, whatever its score about the base model,
and members of indistinguishable sets are marked. The section must not contradict the headline.
The terminal text is for a recording that was not diagnosed (`simgap inspect`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from bench.diagnosis.identifiability import IdentifiabilityLevel, ParameterIdentifiability
from bench.diagnosis.report.cause_and_value_text import (
    ALL_PLACES,
    format_effect_name,
    get_place_kind,
    split_effect_name,
)
from bench.diagnosis.report.report_data import DiagnosisReportData
from bench.diagnosis.verdict import Cause
from sims.core.user_messages import format_unit, join_first_names

MAX_NAMED_CAUSES = 6
"""Maximum number of names in a cell or list of the page; the remaining ones are counted."""
MAX_LISTED_CAUSES = 8
"""Maximum number of causes with their own line, and of names in a list, in the terminal."""
_LEVELS: tuple[IdentifiabilityLevel, ...] = ("identifiable", "weak", "not identifiable")
"""Levels of identifiability, the most certain first."""
_LEGEND = {
    "found": "★ named by the verdict",
    "set": "☆ explains the data as well as a named cause",
    "identifiable": "● can be identified",
    "weak": "◐ weakly identifiable",
    "not identifiable": "○ not visible in these data",
}
"""Sign and meaning of each status of a cause, the most certain first."""
_STATUSES = tuple(_LEGEND)


class CauseRow(NamedTuple):
    """Cause with its identifiability.

    Attributes:
        number: Identifiability of the coefficient.
        effect: Name of the effect, with its place if it has one.
        status: One of the keys of `_LEGEND`.
    """

    number: ParameterIdentifiability
    effect: str
    status: str

    @property
    def effect_name(self) -> str:
        """Name of the effect without its place."""
        return split_effect_name(self.effect)[0]

    @property
    def place(self) -> str:
        """Place of the effect; empty for none, and for an effect at every place."""
        _, place = split_effect_name(self.effect)
        return "" if place == ALL_PLACES else place

    @property
    def legend(self) -> str:
        """Sign and meaning of the status."""
        return _LEGEND[self.status]

    @property
    def meaning(self) -> str:
        """Meaning of the status, without its sign."""
        return self.legend.partition(" ")[2]

    @property
    def rank(self) -> int:
        """Index of the status, 0 for the most certain one."""
        return _STATUSES.index(self.status)


def build_identifiability_section(report: DiagnosisReportData) -> dict[str, Any] | None:
    """Build the content of the section; None if identifiability was not computed.

    Args:
        report: content of the report, with the identifiability of each parameter and cause.

    Returns:
        Content by the name that the template uses:

        - ``free``: fitted parameters with their levels, such as "identifiable".
        - ``causes``: possible causes with the meaning of their statuses, the most certain first.
        - ``legend``: signs of all causes.
        - ``counts``: number of causes by level, diagnosed ones being identifiable.
        - ``found``: diagnosed causes.
        - ``matrices``: effects with places (such as joints), by places; those that are not
          identifiable at every place.
        - ``clear_matrices``: the same for effects that are identifiable at every place.
        - ``families``, ``family_headings``: names of the effects without a place, by family and
          status.
    """
    if not report.identifiability:
        return None
    found = _list_supported_causes(report)
    causes = _list_cause_rows(report, found)
    placed = [row for row in causes if row.place]
    effects = {row.effect_name for row in placed}
    unclear_effects = {row.effect_name for row in placed if row.status != "identifiable"}
    ordered = sorted(causes, key=lambda row: row.rank)
    without_place = [row for row in ordered if not row.place]
    statuses = list(dict.fromkeys(row.status for row in without_place))
    return {
        "free": [(number, number.word) for number in report.identifiability if number.free],
        "causes": [(row.number, row.meaning) for row in ordered],
        "legend": list(dict.fromkeys(row.legend for row in ordered)),
        "counts": Counter(
            "identifiable" if row.status == "found" else row.number.word for row in causes
        ),
        "found": found,
        "matrices": _build_matrices(placed, unclear_effects),
        "clear_matrices": _build_matrices(placed, effects - unclear_effects),
        "families": _build_family_table([row for row in causes if not row.place], statuses),
        "family_headings": [_LEGEND[status] for status in statuses],
    }


def _list_supported_causes(report: DiagnosisReportData) -> list[Cause]:
    """List the causes of the verdict; candidates of "unknown" are not supported by data."""
    is_supported = report.verdict.verdict in ("named", "ambiguous", "partial")
    return list(report.verdict.causes) if is_supported else []


def _list_cause_rows(report: DiagnosisReportData, found: Sequence[Cause]) -> list[CauseRow]:
    """List the possible causes in the order of the registry, each with its status.

    There are three kinds of status:

    * ``found``: a diagnosed cause without alternatives.
    * ``set``: a diagnosed cause with alternatives that the data cannot distinguish from it, and
      these alternatives.
    * The identifiability of any other cause, such as ``weak``.

    A diagnosed cause at several places has its status at each of them.

    Args:
        report: data of the report.
        found: diagnosed causes.
    """
    status_by_effect: dict[str, str] = {}
    for cause in found:
        status = "set" if cause.alternatives else "found"
        for name in (cause.effect, *cause.alternatives):
            status_by_effect.setdefault(name, status)
        # A cause at several joints has a coefficient for each, such as coefficient@elbow.
        base, _ = split_effect_name(cause.effect)
        for coefficient in cause.coefficients:
            _, place = split_effect_name(coefficient)
            if place:
                status_by_effect.setdefault(f"{base}@{place}", status)
    rows = []
    for number in report.identifiability:
        if not number.free:
            # The name of a coefficient follows that of its effect.
            effect, _, _ = number.name.partition(" ")
            rows.append(CauseRow(number, effect, status_by_effect.get(effect, number.word)))
    return rows


def _build_matrices(placed: Sequence[CauseRow], effects: set[str]) -> list[dict[str, Any]]:
    """Build a matrix of effects by places for each kind of place.

    Of several coefficients of an effect at a place, the most certain one is shown.

    Args:
        placed: causes at places.
        effects: names of the effects in the matrices, without their places.

    Returns:
        Matrices with the kind of place, the places, and by effect and place the cause; the most
        certain effects come first.
    """
    matrices: dict[str, dict[str, Any]] = {}
    for row in placed:
        kind = get_place_kind(row.effect)
        if row.effect_name in effects:
            matrix = matrices.setdefault(kind, {"kind": kind, "places": {}, "effects": {}})
            # The keys are an ordered set of places; the values mean nothing.
            matrix["places"][row.place] = True
            by_place = matrix["effects"].setdefault(row.effect_name, {})
            known_row = by_place.get(row.place, row)
            # Rank 0 is the most certain status.
            by_place[row.place] = min(known_row, row, key=lambda row: row.rank)

    def list_ranks(effect_rows: tuple[str, dict[str, CauseRow]]) -> list[int]:
        """Return the sort key of an effect: the ranks of its places, the most certain first."""
        _, by_place = effect_rows
        return sorted(row.rank for row in by_place.values())

    for matrix in matrices.values():
        matrix["effects"] = sorted(matrix["effects"].items(), key=list_ranks)
    return list(matrices.values())


def _build_family_table(
    rows: Sequence[CauseRow], statuses: Sequence[str]
) -> dict[str, dict[str, str]]:
    """Join the names of effects in a table with a row for each family, a column for each status.

    The family of ``friction.coulomb`` is ``friction``. A cell names at most `MAX_NAMED_CAUSES`.

    Args:
        rows: causes without a place.
        statuses: their statuses, in the order of the columns.
    """
    names: dict[str, dict[str, list[str]]] = {}
    for row in rows:
        family, _, _ = row.effect.partition(".")
        by_status = names.setdefault(family, {status: [] for status in statuses})
        by_status[row.status].append(format_effect_name(row.effect))
    return {
        family: {
            status: join_first_names(effects, MAX_NAMED_CAUSES)
            for status, effects in by_status.items()
        }
        for family, by_status in names.items()
    }


def format_identifiability(assessments: Sequence[ParameterIdentifiability]) -> list[str]:
    """Format the free parameters and the best identifiable causes as lines for the terminal.

    Args:
        assessments: Identifiability of each free parameter, then of each cause, best first.
    """
    lines = ["what this recording can determine (95 % intervals, white noise assumed):"]
    lines += [f"  {_format_parameter(number)}" for number in assessments if number.free]
    causes = {
        level: [n for n in assessments if not n.free and n.word == level] for level in _LEVELS
    }
    counts = [f"{len(members)} {level}" for level, members in causes.items()]
    lines.append(f"causes, each considered alone, smallest uncertainty first: {', '.join(counts)}")
    # A limit or backlash has no interval (NaN), and follows the causes that have one.
    identifiable = sorted(causes["identifiable"], key=lambda number: bool(np.isnan(number.half)))
    lines += [f"  {_format_parameter(number)}" for number in identifiable[:MAX_LISTED_CAUSES]]
    # The other causes are named only.
    other_causes = {
        "also identifiable": identifiable[MAX_LISTED_CAUSES:],
        "weak": causes["weak"],
        "not identifiable": causes["not identifiable"],
    }
    for level, members in other_causes.items():
        if members:
            names = join_first_names(_count_effects(members), MAX_LISTED_CAUSES)
            lines.append(f"  {level}: {names}")
    if any(len(members) > MAX_LISTED_CAUSES for members in causes.values()):
        lines.append("  all causes with their intervals: the same command with --json")
    return lines


def _format_parameter(number: ParameterIdentifiability) -> str:
    """Format one parameter with its level, interval, range and confounded parameters.

    A limit or backlash has no interval (NaN), and a parameter without influence an infinite one.

    Args:
        number: identifiability of a parameter, or of a coefficient of a cause.
    """
    if np.isfinite(number.half):
        interval_text = f"±{number.half:.2g} {format_unit(number.unit)}".rstrip()
    elif np.isnan(number.half):
        interval_text = "a limit inside the range of the data"
    else:
        interval_text = "no influence"
    confounder_text = join_first_names([f"{name} ({corr:.3f})" for name, corr in number.mixed], 2)
    confounding_note = f"; confounded with {confounder_text}" if confounder_text else ""
    span = f"{number.low:.3g} to {number.high:.3g}"
    return (
        f"{number.word:16s} {number.name}: {interval_text} (plausible range "
        f"{span}){confounding_note}"
    )


def _count_effects(assessments: Sequence[ParameterIdentifiability]) -> list[str]:
    """List the effects of causes once each, with the number of their places if there are several.

    The name of a cause is that of its effect with its place, and of its coefficient after a space:
    ``mass.offset@forearm x``.

    Args:
        assessments: identifiability of the coefficients of causes.
    """
    places: dict[str, set[str]] = {}
    for number in assessments:
        placed_effect, _, _ = number.name.partition(" ")
        effect, _, place = placed_effect.partition("@")
        places.setdefault(effect, set()).add(place)
    return [
        f"{effect} ({len(effect_places)} places)" if len(effect_places) > 1 else effect
        for effect, effect_places in places.items()
    ]
