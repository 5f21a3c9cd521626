"""How a data sheet says its numbers, on the page and in print."""

from __future__ import annotations

import re

from bench.gap.report.words import joined, number, percent, probability, with_unit
from bench.gap.sheet.quantity import Quantity
from bench.gap.sheet.subject import PARTS

UNLIKELY = 0.05
"""Chance above which a cause stands only because nobody had the time to judge it."""


def title(row: Quantity, is_driven: bool) -> str:
    """Name the part of the table that a row belongs to."""
    if row.part == "system":
        return "Motor" if is_driven else "System"
    return PARTS[row.part]


def another(row: Quantity) -> str:
    """How well it is known of a run or log not yet recorded."""
    return "" if row.another is None else f"± {number(row.another, 2)}"


def called(row: Quantity) -> str:
    """What a person calls it."""
    if row.part == "system":
        return row.name.replace("_", " ")
    # On a sheet stands the number itself, and not by how much a file is wrong.
    return row.says if row.stated is None else re.sub("^(wrong|misplaced) ", "", row.says)


def short(row: Quantity) -> str:
    """Its name without the joint or actuator that the whole sheet is of."""
    effect, _, rest = row.name.partition("@")
    if not rest:
        return row.name
    place, _, coefficient = rest.partition(" ")
    channel = place.partition(".")[0] if row.part == "channel" else ""
    return " ".join(part for part in (effect, coefficient, channel) if part)


def evidence(row: Quantity, short: bool = False) -> str:
    """Why a number stands on the sheet."""
    if row.state == "derived":
        return "follows from those below"
    if row.state == "fitted":
        return "fitted" if row.number and row.number.low is not None else "not fixed by these data"
    judged = row.p_value is None or row.p_value <= UNLIKELY
    cut = "not judged" if short else "the search ended before it was judged"
    said = [probability(row.p_value) if judged else cut]
    if row.share is not None:
        closed = percent(row.share)
        said.append(
            f"{closed} held out" if short else f"alone it closes {closed} of the held-out gap"
        )
    if row.instead:
        said.append(f"{joined(row.instead, 'or')} would do as well")
    return "; ".join(said)


def reached(row: Quantity) -> str:
    """How small a number these data would have shown."""
    reach = row.reach
    if reach is None or reach.size == float("inf"):
        return "nothing: not touched"
    size = number(reach.size, 2)
    if reach.vague:
        return with_unit(f"nothing plausible, ± {size}", row.unit)
    if reach.limit:
        return with_unit(f"none {reach.limit} {size}", row.unit)
    if reach.leans:
        return with_unit(f"{number(reach.leaning, 2)} ± {size}", row.unit) + ", not named"
    return with_unit(f"0 ± {size}", row.unit)


def beside(row: Quantity) -> str:
    """What it is mixed up with, and what it might stand in place of."""
    said = list(row.reach.mixed) if row.reach else []
    if row.instead:
        said.append(f"may be there instead of {joined(row.instead, 'or')}")
    return ", ".join(said)
