"""Ranking of the candidate causes: their order, their status, and which of them are shown."""

from __future__ import annotations

from typing import NamedTuple

from bench.diagnosis.report.effect_and_unit_text import ALL_PLACES, split_effect_name
from bench.diagnosis.report.report_data import DiagnosisReportData
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


def has_placed_causes(report: DiagnosisReportData) -> bool:
    """Return whether any candidate acts at a place."""
    return any("@" in candidate.effect for candidate in report.verdict.candidates)


def get_candidate_status(report: DiagnosisReportData, effect: str) -> str:
    """Return the status of an effect: found, found but indistinguishable, or not needed.

    Args:
        report: Report data.
        effect: Name of the effect, with its place on a robot: ``drag.linear@elbow``.
    """
    for cause in report.verdict.causes:
        if effect in (cause.effect, *cause.alternatives):
            return "found, but not distinguishable" if cause.alternatives else "found"
    return "not needed"


def rank_candidates(report: DiagnosisReportData) -> list[RankedCandidate]:
    """List all candidates as entries, the highest score first.

    If effects act at places, such as joints, an effect would appear once for each of them. So it is
    one entry: its best place, with the others in `elsewhere`. Each diagnosed cause has its own
    entry.

    Args:
        report: Data of the report.
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
    """Select the candidates to show, the highest score first; diagnosed causes are included.

    At most `MAX_SHOWN_CANDIDATES` are shown, unless there are more causes: candidates that are not
    needed are left out, those with the lowest scores first.
    """
    ordered_candidates = [entry.best for entry in rank_candidates(report)]
    # A diagnosed cause is shown even with a low score.
    unneeded_candidates = [
        c for c in ordered_candidates if get_candidate_status(report, c.effect) == "not needed"
    ]
    hidden_candidates = unneeded_candidates[
        max(0, MAX_SHOWN_CANDIDATES - len(ordered_candidates) + len(unneeded_candidates)) :
    ]
    return [c for c in ordered_candidates if c not in hidden_candidates]
