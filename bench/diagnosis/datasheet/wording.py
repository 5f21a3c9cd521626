"""Text of a data sheet's rows, on the page and in print."""

from __future__ import annotations

import re

from bench.diagnosis.datasheet.sheet_rows import SheetRow
from bench.diagnosis.datasheet.subject import PLACE_KIND_TITLES
from bench.diagnosis.report.wording import (
    append_unit,
    format_number,
    format_p_value,
    format_percent,
    joined,
)

UNJUDGED_P_VALUE = 0.05
"""P-value above which a cause is on the sheet only because the search ended before it was tested.
"""


def title(row: SheetRow, is_driven: bool) -> str:
    """Return the title of the part of the table that a row belongs to.

    Args:
        row: Row of the sheet.
        is_driven: Whether a drive acts on the joint or system.
    """
    if row.part == "system":
        return "Motor" if is_driven else "System"
    return PLACE_KIND_TITLES[row.part]


def format_prediction_interval(row: SheetRow) -> str:
    """Format half the prediction interval for a run or log that is not yet recorded."""
    return (
        ""
        if row.prediction_half_width is None
        else f"± {format_number(row.prediction_half_width, 2)}"
    )


def format_name(row: SheetRow) -> str:
    """Return the name of the row in words."""
    if row.part == "system":
        return row.name.replace("_", " ")
    # The sheet shows the value itself, not its difference from the model file.
    return row.says if row.stated is None else re.sub("^(wrong|misplaced) ", "", row.says)


def format_short_name(row: SheetRow) -> str:
    """Return the name of the row without the joint or actuator that the whole sheet describes."""
    effect, _, placed_name = row.name.partition("@")
    if not placed_name:
        return row.name
    place, _, coefficient = placed_name.partition(" ")
    channel = place.partition(".")[0] if row.part == "channel" else ""
    return " ".join(part for part in (effect, coefficient, channel) if part)


def format_evidence(row: SheetRow, is_short: bool = False) -> str:
    """Format the evidence for a number on the sheet.

    Args:
        row: Row of the sheet.
        is_short: Whether to use the short form for print.
    """
    if row.state == "derived":
        return "computed from the numbers below"
    if row.state == "fitted":
        return (
            "fitted"
            if row.number and row.number.low is not None
            else "not identified by these data"
        )
    is_judged = row.p_value is None or row.p_value <= UNJUDGED_P_VALUE
    unjudged_text = "not tested" if is_short else "the search ended before it was tested"
    parts = [format_p_value(row.p_value) if is_judged else unjudged_text]
    if row.share is not None:
        closed_share = format_percent(row.share)
        parts.append(
            f"{closed_share} held out"
            if is_short
            else f"alone it closes {closed_share} of the held-out gap"
        )
    if row.alternatives:
        parts.append(f"{joined(row.alternatives, 'or')} explains the data equally well")
    return "; ".join(parts)


def format_detection_limit(row: SheetRow) -> str:
    """Format in words how large an absent effect could be without being detected."""
    detection_limit = row.detection_limit
    if detection_limit is None or detection_limit.size == float("inf"):
        return "none: the data do not depend on it"
    size = format_number(detection_limit.size, 2)
    if detection_limit.is_unbounded:
        return append_unit(f"± {size}", row.unit) + ", larger than any plausible value"
    if detection_limit.limit:
        return append_unit(f"none {detection_limit.limit} {size}", row.unit)
    if detection_limit.is_nonzero_if_fitted:
        return (
            append_unit(
                f"{format_number(detection_limit.estimate_if_fitted, 2)} ± {size}", row.unit
            )
            + ", not diagnosed"
        )
    return append_unit(f"0 ± {size}", row.unit)


def format_confounding(row: SheetRow) -> str:
    """Format confounded parameters, and causes that the effect might replace."""
    parts = list(row.detection_limit.confounded_with) if row.detection_limit else []
    if row.alternatives:
        parts.append(f"possible alternative to {joined(row.alternatives, 'or')}")
    return ", ".join(parts)
