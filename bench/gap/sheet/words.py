"""Text of a data sheet's rows, on the page and in print."""

from __future__ import annotations

import re

from bench.gap.report.words import joined, number, percent, probability, with_unit
from bench.gap.sheet.quantity import Quantity
from bench.gap.sheet.subject import PARTS

UNLIKELY = 0.05
"""P-value above which a cause is on the sheet only because the search ended before it was judged.
"""


def title(row: Quantity, is_driven: bool) -> str:
    """Return the title of the part of the table that a row belongs to.

    Args:
        row: Row of the sheet.
        is_driven: Whether a drive acts on the joint or system.
    """
    if row.part == "system":
        return "Motor" if is_driven else "System"
    return PARTS[row.part]


def another(row: Quantity) -> str:
    """Format half the prediction interval for a run or log that is not yet recorded."""
    return "" if row.another is None else f"± {number(row.another, 2)}"


def called(row: Quantity) -> str:
    """Return the name of the row in words."""
    if row.part == "system":
        return row.name.replace("_", " ")
    # The sheet shows the value itself, not its difference from the model file.
    return row.says if row.stated is None else re.sub("^(wrong|misplaced) ", "", row.says)


def short(row: Quantity) -> str:
    """Return the name of the row without the joint or actuator that the whole sheet describes."""
    effect, _, rest = row.name.partition("@")
    if not rest:
        return row.name
    place, _, coefficient = rest.partition(" ")
    channel = place.partition(".")[0] if row.part == "channel" else ""
    return " ".join(part for part in (effect, coefficient, channel) if part)


def evidence(row: Quantity, short: bool = False) -> str:
    """Format the evidence for a number on the sheet.

    Args:
        row: Row of the sheet.
        short: Whether to use the short form for print.
    """
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
    """Format the smallest value of an absent effect that these data would have revealed."""
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
    """Format confounded parameters, and causes that the effect might replace."""
    said = list(row.reach.mixed) if row.reach else []
    if row.instead:
        said.append(f"may be there instead of {joined(row.instead, 'or')}")
    return ", ".join(said)
