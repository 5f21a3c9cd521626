"""The report's section on what the recording can fix at all, before any verdict."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from bench.gap.identify import Number
from bench.gap.report.story import Story
from bench.gap.report.words import joined, number
from bench.pages.elements import code, paragraph, safe, table

MOST = 12
"""Causes of one kind that are named."""
_HEADS = ("number", "can it be fixed", "95 % interval", "of its range", "mixed up with")


def fixable(story: Story) -> Iterator[str]:
    """What can be said of each free number and of each cause; nothing where that is not known."""
    numbers = story.fixable
    if not numbers:
        return
    yield paragraph(safe(counted(numbers)))
    free = [one for one in numbers if one.free]
    if free:
        yield table(_HEADS, [_row(one) for one in free])
    causes = [one for one in numbers if not one.free]
    hidden = [one.name for one in causes if one.word == "not identifiable"]
    if hidden:
        yield paragraph(f"Not to be seen here, whether it acts or not: {_named(hidden)}.")
    weak = [one.name for one in causes if one.word == "weak"]
    if weak:
        yield paragraph(f"Only roughly: {_named(weak)}.")
    alike = list(_alike(causes))
    if alike:
        told = "; ".join(f"{_named(names)}" for names in alike[:MOST])
        more = f"; and {len(alike) - MOST} more sets" if len(alike) > MOST else ""
        yield paragraph(f"Hardly to be told from each other, by their first effects: {told}{more}.")


def counted(numbers: Sequence[Number]) -> str:
    """One sentence."""
    causes = [one for one in numbers if not one.free]
    sure, weak = (sum(one.word == word for one in causes) for word in ("identifiable", "weak"))
    return (
        f"Of {len(causes)} causes, each by itself, this recording can fix {sure} well, {weak} "
        f"roughly and {len(causes) - sure - weak} not at all."
    )


def _row(one: Number) -> list[str]:
    half = f"±{number(one.half)} {one.unit}".rstrip() if np.isfinite(one.half) else "–"
    span = f"{number(one.low)} to {number(one.high)}"
    mixed = joined([f"{name} ({corr:.2f})" for name, corr in one.mixed]) if one.mixed else "–"
    return [code(safe(one.name, 60)), one.word, safe(half), safe(span), safe(mixed)]


def _named(names: Sequence[str]) -> str:
    """Names as they are registered, the first ones, and how many more."""
    each = list(dict.fromkeys(names))
    said = ", ".join(code(safe(name, 60)) for name in each[:MOST])
    more = len(each) - MOST
    return f"{said} and {more} more" if more > 0 else said


def _alike(causes: Sequence[Number]) -> Iterator[list[str]]:
    """Sets of causes that are mixed up, each cause in one set."""
    names = {one.name for one in causes if one.word != "not identifiable"}
    by_effect = {one.name.partition(" ")[0]: one for one in causes}
    told: set[str] = set()
    for one in causes:
        own = one.name.partition(" ")[0]
        if one.name not in names or own in told:
            continue
        others = [other for other, _ in one.mixed if other in by_effect and other not in told]
        if others:
            told |= {own, *others}
            yield [own, *others]
