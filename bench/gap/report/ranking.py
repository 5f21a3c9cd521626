"""Order of the candidates; an effect at several places forms one entry."""

from __future__ import annotations

from typing import NamedTuple

from bench.gap.report.places import has_places
from bench.gap.report.story import Story
from bench.gap.report.words import FAMILY, at, clean, kind_of, name_of, parted
from bench.gap.verdict import Candidate

MOST_CANDIDATES = 12
"""Maximum number of candidates that a figure shows."""
MUCH = 1.3
"""Minimum ratio of a family's score to that of its best place for the family to represent the
effect.
"""


class Entry(NamedTuple):
    """Candidate that represents its effect, and the other places of that effect, best first."""

    best: Candidate
    elsewhere: tuple[Candidate, ...] = ()


def standing(story: Story, effect: str) -> str:
    """Return the status of an effect: found, found but indistinguishable, or not needed.

    Args:
        story: Report data.
        effect: Name of the effect.
    """
    for cause in story.verdict.causes:
        if effect in (cause.effect, *cause.alternatives):
            return "found, but cannot be told apart" if cause.alternatives else "found"
    return "not needed"


def entries(story: Story) -> list[Entry]:
    """List all candidates as entries, the highest score first.

    Without places each candidate is an entry. Otherwise each effect and each cause is one entry.
    """
    ordered = sorted(story.verdict.candidates, key=lambda c: c.score, reverse=True)
    if not has_places(story):
        return [Entry(candidate) for candidate in ordered]
    causes = {cause.effect for cause in story.verdict.causes}
    groups: dict[str, list[Candidate]] = {}
    for candidate in ordered:
        groups.setdefault(parted(candidate.effect)[0], []).append(candidate)
    found = []
    for group in groups.values():
        # A diagnosed cause represents its effect even if another place has a higher score.
        heads = [c for c in group if c.effect in causes] or [_head(group)]
        rest = tuple(c for c in group if c not in heads)
        found += [Entry(heads[0], rest), *(Entry(head) for head in heads[1:])]
    return sorted(found, key=lambda entry: entry.best.score, reverse=True)


def _head(group: list[Candidate]) -> Candidate:
    """Return the best place, unless the family explains much more; it explains at least as much."""
    one = next((c for c in group if parted(c.effect)[1] != FAMILY), group[0])
    return one if group[0].score < MUCH * max(one.score, 1.0) else group[0]


def ranked(story: Story) -> list[Candidate]:
    """Select the candidates to show, the highest score first; diagnosed causes are included."""
    ordered = [entry.best for entry in entries(story)]
    # A diagnosed cause is shown even with a low score.
    others = [c for c in ordered if standing(story, c.effect) == "not needed"]
    beyond = others[max(0, MOST_CANDIDATES - len(ordered) + len(others)) :]
    return [c for c in ordered if c not in beyond]


LONGEST_PLACE = 64
"""Maximum number of characters of a place's name in a list."""


def short_name(effect: str) -> str:
    """Format an effect for a list: without its article, and without the kind of its place."""
    base, place = parted(effect)
    if not place:
        return name_of(effect)
    where = (
        at(kind_of(effect), [place]) if place == FAMILY else f" at {clean(place, LONGEST_PLACE)}"
    )
    return name_of(base) + where
