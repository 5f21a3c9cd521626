"""Order of the candidates; an effect at several places forms one entry."""

from __future__ import annotations

from typing import NamedTuple

from bench.diagnosis.report.cause_text import has_placed_causes
from bench.diagnosis.report.report_data import DiagnosisReportData
from bench.diagnosis.report.wording import (
    ALL_PLACES,
    format_effect_name,
    format_places,
    get_place_kind,
    sanitise,
    split_effect_name,
)
from bench.diagnosis.verdict import Candidate

MAX_SHOWN_CANDIDATES = 12
"""Maximum number of candidates that a figure shows."""
MIN_FAMILY_SCORE_RATIO = 1.3
"""Minimum ratio of a family's score to that of its best place for the family to represent the
effect.
"""


class RankedCandidate(NamedTuple):
    """Candidate that represents its effect, and the other places of that effect, best first."""

    best: Candidate
    elsewhere: tuple[Candidate, ...] = ()


def get_candidate_status(report: DiagnosisReportData, effect: str) -> str:
    """Return the status of an effect: found, found but indistinguishable, or not needed.

    Args:
        report: Report data.
        effect: Name of the effect.
    """
    for cause in report.verdict.causes:
        if effect in (cause.effect, *cause.alternatives):
            return "found, but not distinguishable" if cause.alternatives else "found"
    return "not needed"


def rank_candidates(report: DiagnosisReportData) -> list[RankedCandidate]:
    """List all candidates as entries, the highest score first.

    Without places each candidate is an entry. Otherwise each effect and each cause is one entry.
    """
    ordered_candidates = sorted(report.verdict.candidates, key=lambda c: c.score, reverse=True)
    if not has_placed_causes(report):
        return [RankedCandidate(candidate) for candidate in ordered_candidates]
    causes = {cause.effect for cause in report.verdict.causes}
    groups: dict[str, list[Candidate]] = {}
    for candidate in ordered_candidates:
        groups.setdefault(split_effect_name(candidate.effect)[0], []).append(candidate)
    entries = []
    for group in groups.values():
        # A diagnosed cause represents its effect even if another place has a higher score.
        heads = [c for c in group if c.effect in causes] or [_choose_representative(group)]
        other_members = tuple(c for c in group if c not in heads)
        entries += [
            RankedCandidate(heads[0], other_members),
            *(RankedCandidate(head) for head in heads[1:]),
        ]
    return sorted(entries, key=lambda entry: entry.best.score, reverse=True)


def _choose_representative(group: list[Candidate]) -> Candidate:
    """Return the best place, unless the family explains much more; it explains at least as much."""
    best_place = next((c for c in group if split_effect_name(c.effect)[1] != ALL_PLACES), group[0])
    return (
        best_place
        if group[0].score < MIN_FAMILY_SCORE_RATIO * max(best_place.score, 1.0)
        else group[0]
    )


def select_shown_candidates(report: DiagnosisReportData) -> list[Candidate]:
    """Select the candidates to show, the highest score first; diagnosed causes are included."""
    ordered_candidates = [entry.best for entry in rank_candidates(report)]
    # A diagnosed cause is shown even with a low score.
    unneeded_candidates = [
        c for c in ordered_candidates if get_candidate_status(report, c.effect) == "not needed"
    ]
    hidden_candidates = unneeded_candidates[
        max(0, MAX_SHOWN_CANDIDATES - len(ordered_candidates) + len(unneeded_candidates)) :
    ]
    return [c for c in ordered_candidates if c not in hidden_candidates]


LONGEST_PLACE = 64
"""Maximum number of characters of a place's name in a list."""


def shorten_effect_name(effect: str) -> str:
    """Format an effect for a list: without its article, and without the kind of its place."""
    base, place = split_effect_name(effect)
    if not place:
        return format_effect_name(effect)
    place_text = (
        format_places(get_place_kind(effect), [place])
        if place == ALL_PLACES
        else f" at {sanitise(place, LONGEST_PLACE)}"
    )
    return format_effect_name(base) + place_text
