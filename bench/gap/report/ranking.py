"""The candidates in their order; those of one effect at several places as one."""

from __future__ import annotations

from typing import NamedTuple

from bench.gap.report.places import has_places
from bench.gap.report.story import Story
from bench.gap.report.words import FAMILY, at, clean, kind_of, name_of, parted
from bench.gap.verdict import Candidate

MOST_CANDIDATES = 12
"""That a figure shows."""
MUCH = 1.3
"""A family that scores so many times the best of its places stands for its effect."""


class Entry(NamedTuple):
    """A candidate that stands for its effect, and the same effect at other places, the best
    first.
    """

    best: Candidate
    elsewhere: tuple[Candidate, ...] = ()


def standing(story: Story, effect: str) -> str:
    """Whether an effect is found, one of a set that cannot be told apart, or neither."""
    for cause in story.verdict.causes:
        if effect in (cause.effect, *cause.alternatives):
            return "found, but cannot be told apart" if cause.alternatives else "found"
    return "not needed"


def entries(story: Story) -> list[Entry]:
    """All candidates, the highest score first: each for itself where none has a place, else an
    entry for each effect and one for each cause.
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
        # What is found stands for its effect, however much another place scores; of several, each.
        heads = [c for c in group if c.effect in causes] or [_head(group)]
        rest = tuple(c for c in group if c not in heads)
        found += [Entry(heads[0], rest), *(Entry(head) for head in heads[1:])]
    return sorted(found, key=lambda entry: entry.best.score, reverse=True)


def _head(group: list[Candidate]) -> Candidate:
    """The best place, unless all places together explain much more: they always explain as much."""
    one = next((c for c in group if parted(c.effect)[1] != FAMILY), group[0])
    return one if group[0].score < MUCH * max(one.score, 1.0) else group[0]


def ranked(story: Story) -> list[Candidate]:
    """The candidates to show, the highest score first; what is found is among them."""
    ordered = [entry.best for entry in entries(story)]
    # What is found stays, however low it scores beside what it made needless.
    others = [c for c in ordered if standing(story, c.effect) == "not needed"]
    beyond = others[max(0, MOST_CANDIDATES - len(ordered) + len(others)) :]
    return [c for c in ordered if c not in beyond]


LONGEST_PLACE = 64
"""Characters of a place's name that a list shows."""


def short_name(effect: str) -> str:
    """Name an effect for a list: without its article, and without the kind of its place."""
    base, place = parted(effect)
    if not place:
        return name_of(effect)
    where = (
        at(kind_of(effect), [place]) if place == FAMILY else f" at {clean(place, LONGEST_PLACE)}"
    )
    return name_of(base) + where
