"""Ranking of the candidate causes: order, status, selection for figures, and table of the page."""

from __future__ import annotations

from typing import NamedTuple

from bench.diagnosis.report.cause_and_value_text import (
    ALL_PLACES,
    describe_effect,
    format_effect_name,
    format_effect_set,
    get_place_kind,
    sanitise,
    split_effect_name,
)
from bench.diagnosis.report.diagnosed_places import find_joint
from bench.diagnosis.report.report_data import DiagnosisReportData
from bench.diagnosis.verdict import Candidate
from bench.pages.page_table import Table

MAX_SHOWN_CANDIDATES = 12
"""Maximum number of candidates that a figure shows."""
MIN_FAMILY_SCORE_RATIO = 1.3
"""Minimum ratio of a family's score to that of its best place for the family to represent the
effect.
"""
BEST, ELSEWHERE = "the best of each effect", "the same at other places"
"""Labels of the rows of a robot's candidates, for the filter."""


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
    one entry: the place that represents it, with the others in `elsewhere`. Each diagnosed cause
    has its own entry, and represents its effect even if another place has a higher score.

    Args:
        report: Data of the report.
    """
    ordered_candidates = sorted(report.verdict.candidates, key=lambda c: c.score, reverse=True)
    if not has_placed_causes(report):
        return [RankedCandidate(candidate) for candidate in ordered_candidates]
    causes = {cause.effect for cause in report.verdict.causes}
    # Candidates by the name of their effect without its place, the highest score first in each.
    candidates_by_effect: dict[str, list[Candidate]] = {}
    for candidate in ordered_candidates:
        base, _ = split_effect_name(candidate.effect)
        candidates_by_effect.setdefault(base, []).append(candidate)
    entries = []
    for group in candidates_by_effect.values():
        diagnosed = [candidate for candidate in group if candidate.effect in causes]
        first, *others = diagnosed or [_choose_representative(group)]
        elsewhere = tuple(c for c in group if c not in (first, *others))
        # The first cause has the other places; further causes have entries without any.
        entries += [RankedCandidate(first, elsewhere), *map(RankedCandidate, others)]
    return sorted(entries, key=lambda entry: entry.best.score, reverse=True)


def _choose_representative(group: list[Candidate]) -> Candidate:
    """Return the candidate that represents an effect without a diagnosed cause.

    It is the best single place. But if the effect at all places (the family), which explains at
    least as much, has a much higher score, it is the family.

    Args:
        group: candidates of one effect at several places, the highest score first.
    """
    best = group[0]
    best_place = next((c for c in group if not c.effect.endswith(f"@{ALL_PLACES}")), best)
    is_much_better = best.score >= MIN_FAMILY_SCORE_RATIO * max(best_place.score, 1.0)
    return best if is_much_better else best_place


def select_shown_candidates(report: DiagnosisReportData) -> list[Candidate]:
    """Select the candidates to show, the highest score first; diagnosed causes are included.

    At most `MAX_SHOWN_CANDIDATES` are shown, unless there are more causes: candidates that are not
    needed are left out, those with the lowest scores first.

    Args:
        report: content of the report, with candidates and causes.
    """
    ordered_candidates = [entry.best for entry in rank_candidates(report)]
    unneeded_candidates = [
        c for c in ordered_candidates if get_candidate_status(report, c.effect) == "not needed"
    ]
    # Diagnosed causes and their alternatives are shown even with a low score.
    needed_count = len(ordered_candidates) - len(unneeded_candidates)
    # The remaining rows are for the best of the others.
    hidden_candidates = unneeded_candidates[max(0, MAX_SHOWN_CANDIDATES - needed_count) :]
    return [c for c in ordered_candidates if c not in hidden_candidates]


def build_candidate_table(report: DiagnosisReportData) -> Table:
    """Build a table with one row per candidate, the highest score first.

    The columns include

    * `standing`: the status of the candidate, for example that it is found or not needed;
    * `set`: the candidates that the data cannot distinguish from it;
    * `kind`, `place` and `joint`: where it acts, and the joint to which this place belongs;
    * `shown`: whether the row is visible at first; of an effect that acts at several places, only
      the representative one is;
    * `says`: its description.

    Columns that would be empty are left out.

    Args:
        report: Data of the report.
    """
    sets = _map_indistinguishable_sets(report)
    representatives = {entry.best.effect for entry in rank_candidates(report)}
    rows = []
    for candidate in sorted(report.verdict.candidates, key=lambda candidate: -candidate.score):
        effect = candidate.effect
        base, place = split_effect_name(effect)
        place_kind = get_place_kind(effect)
        # Without a diagnosed cause, the status would be "not needed", which would be wrong.
        status = "not convincing"
        if report.has_extended_model:
            status = get_candidate_status(report, effect)
        rows.append(
            {
                # A place has its own column.
                "candidate": sanitise(format_effect_name(base), 120),
                "effect": sanitise(effect, 120),
                "score": candidate.score,
                "p_value": candidate.p_value,
                "heldout_gain": candidate.heldout_gain,
                "standing": status,
                "set": sets.get(effect, ""),
                "kind": place_kind,
                "place": "all" if place == ALL_PLACES else sanitise(place, 80),
                "joint": find_joint(report, place_kind, place),
                "shown": BEST if effect in representatives else ELSEWHERE,
                "says": describe_effect(report.verdict.causes, effect),
            }
        )
    return Table.from_rows(rows).without(_list_empty_columns(report))


def _list_empty_columns(report: DiagnosisReportData) -> list[str]:
    """List the columns that would be empty."""
    columns = [] if _map_indistinguishable_sets(report) else ["set"]
    return columns + ([] if has_placed_causes(report) else ["kind", "place", "joint", "shown"])


def _map_indistinguishable_sets(report: DiagnosisReportData) -> dict[str, str]:
    """Return, by effect, the set of effects that it is indistinguishable from."""
    sets: dict[str, str] = {}
    for cause in report.verdict.causes:
        if cause.alternatives:
            members = [cause.effect, *cause.alternatives]
            sets |= dict.fromkeys(members, sanitise(format_effect_set(members), 160))
    return sets
