"""Report section on what the recording can identify, independent of the verdict.

It has a summary sentence, the free parameters, and a matrix of the causes; the full table is
folded.

A diagnosed cause counts as identifiable, whatever its score about the base model, and members of
indistinguishable sets are marked. The section must not contradict the headline.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bench.diagnosis.identifiability import ParameterIdentifiability
from bench.diagnosis.report.report_data import DiagnosisReportData
from bench.diagnosis.report.wording import (
    ALL_PLACES,
    format_effect,
    format_effect_name,
    format_number,
    get_place_kind,
    joined,
    sanitise,
    split_effect_name,
)
from bench.diagnosis.verdict import Cause
from bench.pages.html_elements import (
    make_code,
    make_collapsible,
    make_paragraph,
    make_strong,
    make_table,
    safe,
)

MAX_NAMED_CAUSES = 6
"""Maximum number of names in a cell or list; the remaining ones are counted."""
_HEADS = ("number", "can it be fixed", "95 % interval", "of its range", "mixed up with")
_STANDINGS = ("found", "set", "identifiable", "weak", "not identifiable")
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
    "found": "found by the verdict",
    "set": "explains the data as well as what was found",
    "identifiable": "could be determined",
    "weak": "only roughly",
    "not identifiable": "not to be seen, whether it acts or not",
}
_KINDS = {"joint": "joints", "actuator": "actuators", "body": "bodies", "channel": "channels"}


@dataclass(frozen=True)
class _Row:
    """Cause with its identifiability.

    Attributes:
        number: Identifiability of the coefficient.
        effect: Registered name of the effect.
        standing: One of `_STANDINGS`.
    """

    number: ParameterIdentifiability
    effect: str
    standing: str


def render_identifiability_section(story: DiagnosisReportData) -> Iterator[str]:
    """Yield the section on free parameters and causes; nothing if identifiability is unknown."""
    numbers = story.identifiability
    if not numbers:
        return
    rows = _rows(story)
    yield make_paragraph(safe(format_counts(story)))
    free = [one for one in numbers if one.free]
    if free:
        yield make_table(_HEADS, [_cells(one, one.word) for one in free])
    there = [s for s in _STANDINGS if any(row.standing == s for row in rows)]
    yield make_paragraph(safe("; ".join(f"{_SIGNS[s]} {_LEGEND[s]}" for s in there)), "soft")
    placed = [row for row in rows if _place(row)]
    telling, plain = _told_apart(placed)
    yield from _matrices(telling)
    if others := [row for row in rows if not _place(row)]:
        yield _families(others)
    if plain:
        effects = len({split_effect_name(row.effect)[0] for row in plain})
        head = f"{effects} effects {'more ' * bool(telling)}that could be determined at every place"
        yield make_collapsible(head, "\n".join(_matrices(plain)))
    ordered = sorted(rows, key=lambda row: _STANDINGS.index(row.standing))
    every = make_table(_HEADS, [_cells(row.number, _LEGEND[row.standing]) for row in ordered])
    yield make_collapsible(f"All {len(rows)} causes with their intervals", every)


def _told_apart(rows: Sequence[_Row]) -> tuple[list[_Row], list[_Row]]:
    """Separate effects that are identifiable at every place from all others.

    Returns:
        Rows of the other effects, and rows of effects that are identifiable at every place.
    """
    telling = {split_effect_name(r.effect)[0] for r in rows if r.standing != "identifiable"}
    first = [row for row in rows if split_effect_name(row.effect)[0] in telling]
    return first, [row for row in rows if split_effect_name(row.effect)[0] not in telling]


def _matrices(rows: Sequence[_Row]) -> Iterator[str]:
    """Yield a matrix for each kind of place."""
    for kind in dict.fromkeys(get_place_kind(row.effect) for row in rows):
        yield _matrix([row for row in rows if get_place_kind(row.effect) == kind], kind)


def format_counts(story: DiagnosisReportData) -> str:
    """Format how many causes are identifiable, and which were found."""
    rows = _rows(story)
    words = [str("identifiable" if r.standing == "found" else r.number.word) for r in rows]
    counts = {s: words.count(s) for s in _STANDINGS[2:]}
    sentence = (
        f"Of {len(rows)} causes, each by itself, this recording can determine "
        f"{counts['identifiable']} well, {counts['weak']} roughly and "
        f"{counts['not identifiable']} not at all."
    )
    found = [f"{format_effect(c.effect)} ({sanitise(c.effect, 60)})" for c in _causes(story)]
    return f"{sentence} Found: {joined(found)}." if found else sentence


def _causes(story: DiagnosisReportData) -> list[Cause]:
    """Return the causes that the verdict supports."""
    vouched = story.verdict.verdict in ("named", "ambiguous", "partial")
    return list(story.verdict.causes) if vouched else []


def _rows(story: DiagnosisReportData) -> list[_Row]:
    """List the causes in the order of the numbers, with those of the verdict marked."""
    found: dict[str, str] = {}
    for cause in _causes(story):
        for name in (cause.effect, *cause.alternatives):
            standing = "set" if cause.alternatives else "found"
            found.setdefault(name, standing)
            # For a family, members with a coefficient of their own are marked.
            for key in cause.coefficients if name == cause.effect else ():
                if place := split_effect_name(key)[1]:
                    found.setdefault(f"{split_effect_name(name)[0]}@{place}", standing)
    rows = []
    for one in story.identifiability:
        if not one.free:
            effect = one.name.partition(" ")[0]
            rows.append(_Row(one, effect, found.get(effect, one.word)))
    return rows


def _place(row: _Row) -> str:
    place = split_effect_name(row.effect)[1]
    return "" if place == ALL_PLACES else place


def _best(rows: Sequence[_Row]) -> _Row:
    return min(rows, key=lambda row: _STANDINGS.index(row.standing))


def _matrix(rows: Sequence[_Row], kind: str) -> str:
    """Render the matrix of effects by places of one kind."""
    places = list(dict.fromkeys(_place(row) for row in rows))
    by_effect: dict[str, dict[str, list[_Row]]] = {}
    for row in rows:
        by_place = by_effect.setdefault(split_effect_name(row.effect)[0], {})
        by_place.setdefault(_place(row), []).append(row)

    def order(item: tuple[str, dict[str, list[_Row]]]) -> list[int]:
        return sorted(_STANDINGS.index(_best(own).standing) for own in item[1].values())

    body = []
    for effect, by_place in sorted(by_effect.items(), key=order):
        cells = [_sign(by_place[p]) if p in by_place else "" for p in places]
        body.append(
            [f"{safe(format_effect_name(effect), 60)} {make_code(safe(effect, 60))}", *cells]
        )
    heads = [safe(f"{_KINDS.get(kind, 'places')}:"), *(safe(place, 30) for place in places)]
    return f'<div class="matrix">{make_table(heads, body)}</div>'


def _sign(rows: Sequence[_Row]) -> str:
    """Render a cell of the matrix: its sign, and its meaning as text."""
    best = _best(rows)
    said = f"{best.effect}: {_LEGEND[best.standing]}{_interval(best.number, ', ')}"
    label = safe(said, 200)
    sign = f'<span title="{label}" role="img" aria-label="{label}">{_SIGNS[best.standing]}</span>'
    return make_strong(sign) if best.standing in ("found", "set") else sign


def _families(rows: Sequence[_Row]) -> str:
    """Render the table of causes without a place: families of effects by identifiability."""
    columns = [s for s in _STANDINGS if any(row.standing == s for row in rows)]
    families: dict[str, dict[str, list[str]]] = {}
    for row in rows:
        own = families.setdefault(row.effect.partition(".")[0], {})
        own.setdefault(row.standing, []).append(row.effect)
    body = []
    for family, own in families.items():
        cells = []
        for column in columns:
            names = list(dict.fromkeys(own.get(column, ())))
            shown = _names(names)
            cells.append(make_strong(shown) if names and column in ("found", "set") else shown)
        body.append([safe(family, 40), *cells])
    heads = ["family", *(f"{_SIGNS[s]} {_LEGEND[s]}" for s in columns)]
    return make_table(heads, body)


def _names(effects: Sequence[str]) -> str:
    shown = ", ".join(safe(format_effect_name(effect), 60) for effect in effects[:MAX_NAMED_CAUSES])
    more = len(effects) - MAX_NAMED_CAUSES
    return f"{shown} and {more} more" if more > 0 else shown


def _interval(one: ParameterIdentifiability, before: str = "") -> str:
    return (
        f"{before}±{format_number(one.half)} {one.unit}".rstrip() if np.isfinite(one.half) else ""
    )


def _cells(one: ParameterIdentifiability, word: str) -> list[str]:
    """Format a row of a table of parameters."""
    span = f"{format_number(one.low)} to {format_number(one.high)}"
    mixed = joined([f"{name} ({corr:.2f})" for name, corr in one.mixed]) if one.mixed else "–"
    return [make_code(safe(one.name, 60)), safe(word), safe(_interval(one)) or "–", safe(span),
            safe(mixed)]  # fmt: skip
