"""Consistency of each parameter between runs, logs or loads: sentences, a table and file rows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from bench.diagnosis.report.missing_physics import name_missing_physics
from bench.diagnosis.report.report_data import DiagnosisReportData
from bench.diagnosis.report.wording import (
    append_unit,
    format_estimate,
    format_number,
    format_p_value,
    format_sentence,
    joined,
    sanitise,
)
from bench.diagnosis.validation.gain_and_intervals import Z95
from bench.diagnosis.validation.run_consistency import (
    SIGNIFICANCE_LEVEL,
    ParameterConsistency,
    TrendCovariate,
)
from bench.pages.html_elements import make_paragraph, make_table, safe

MAX_TABLE_ROWS = 12
"""Maximum number of rows of the table, the least consistent first."""
MAX_NAMED_PARAMETERS = 4
"""Maximum number of parameters that a sentence names."""
_DRAWN = 180.0
AGREEMENT_COLUMNS = ("model", "number", "unit", "by", "group", "value", "low", "high")
"""Columns of the file apart.csv."""


def format_consistency(story: DiagnosisReportData) -> list[str]:
    """Format sentences about the consistency of the parameters.

    They report which parameters differ between groups, which are consistent with the causes only,
    and which drift.

    Args:
        story: Report data.
    """
    before = {(s.number, s.by): s for s in story.consistency.before}
    after = story.consistency.after
    causes = joined([sanitise(cause.effect, 60) for cause in story.verdict.causes])
    sentences = []
    mended = [s for s in after if s.is_consistent and _disagreed(before, s)]
    if mended and causes:
        names = joined(list(dict.fromkeys(_named(s) for s in mended))[:MAX_NAMED_PARAMETERS])
        by = _plural(mended[0].by)
        sentences.append(f"without {causes} {names} moved between {by} more than their intervals")
    rival = _clearest([s for s in story.consistency.alternative_effect if not s.is_consistent])
    for one in rival[:1]:
        moves = f", and {_goes(one)} with {sanitise(one.by, 40)}" if _moves(one) else ""
        sentences.append(
            f"with {_named(one)} in place of {causes} its value would differ between "
            f"{_plural(one.by)}, {append_unit(_span(one), one.unit)} (chance "
            f"{format_p_value(one.p_value)}){moves}: that is how one sees what is missing"
        )
    apart = _clearest([s for s in after if not s.is_consistent])
    for one in apart[:MAX_NAMED_PARAMETERS]:
        sentences.append(_apart(one, [cause.effect for cause in story.verdict.causes]))
    if len(apart) > MAX_NAMED_PARAMETERS:
        sentences.append(f"{len(apart) - MAX_NAMED_PARAMETERS} more numbers do not agree either")
    if after and not apart:
        groups = _plural(after[0].by)
        sentences.append(f"all {groups} agree on every number within its interval")
    return [format_sentence(text) for text in (*sentences, *_drifts(after))]


def _clearest(apart: Sequence[ParameterConsistency]) -> list[ParameterConsistency]:
    """Return each parameter once, preferably with the grouping in which it has a trend."""
    by_number: dict[str, list[ParameterConsistency]] = {}
    for one in apart:
        by_number.setdefault(one.number, []).append(one)
    return [min(each, key=_rank) for each in by_number.values()]


def _rank(one: ParameterConsistency) -> tuple[bool, int, float]:
    """Return a sort key: by trend first, then constants, logs and runs, then by p-value."""
    by = {"log": 1, "run": 2}.get(one.by, 0)
    return not (_moves(one) or one.trend_covariate is not None), by, one.p_value


def _moves(one: ParameterConsistency) -> bool:
    return one.by != "log" and one.trend is not None and one.trend.p_value < SIGNIFICANCE_LEVEL


def _disagreed(
    before: dict[tuple[str, str], ParameterConsistency], one: ParameterConsistency
) -> bool:
    known = before.get((one.number, one.by))
    return known is not None and not known.is_consistent


def _apart(one: ParameterConsistency, known: Sequence[str]) -> str:
    text = (
        f"{_named(one)} differs between {_plural(one.by)}, {append_unit(_span(one), one.unit)} "
        f"(chance {format_p_value(one.p_value)}): of a run not yet recorded it is known to "
        f"±{format_number(Z95 * one.prediction_sigma)}, not to ±{format_number(Z95 * one.error)}"
    )
    if one.trend_covariate is None:
        return f"{text}; an effect is missing that makes it move"
    way = "grows" if one.trend_covariate.trend.slope > 0 else "falls"
    text += f"; it {way} with {_along(one.trend_covariate)}"
    kind, name = one.trend_covariate.kind, sanitise(one.trend_covariate.name, 40)
    what = name_missing_physics(one.number, kind, name, one.trend_covariate.trend.slope > 0, known)
    return f"{text}: what is missing is {what}"


def _along(mover: TrendCovariate) -> str:
    """Format the covariate of a trend and those that are indistinguishable from it."""
    return " or ".join(
        sanitise(name, 40) for name in (mover.name, *mover.indistinguishable_covariates[:2])
    )


def _span(one: ParameterConsistency) -> str:
    values = [part.value for part in one.group_estimates]
    return f"{format_number(min(values))} to {format_number(max(values))}"


def _drifts(after: Sequence[ParameterConsistency]) -> Iterator[str]:
    """Yield sentences on the parameters that drift over the logs."""
    logs = [s for s in after if s.by == "log" and s.trend is not None]
    if not logs:
        return
    level = SIGNIFICANCE_LEVEL / len(logs)
    drifting = [
        s for s in logs if s.trend is not None and s.trend.p_value < level and not s.is_consistent
    ]
    for one in drifting[:MAX_NAMED_PARAMETERS]:
        assert one.trend is not None
        size = f"{format_number(abs(one.trend.slope))} ± {format_number(Z95 * one.trend.error)}"
        yield f"{_named(one)} {_goes(one)} from log to log by {append_unit(size, one.unit)}"
    if not drifting:
        yield f"over the {len(logs[0].group_estimates)} logs, in the order given, nothing drifts"


def _goes(one: ParameterConsistency) -> str:
    return "grows" if one.trend is not None and one.trend.slope > 0 else "falls"


def _named(one: ParameterConsistency) -> str:
    return sanitise(one.number, 60)


def _plural(by: str) -> str:
    return f"{by}s" if by in ("run", "log") else f"values of {sanitise(by, 40)}"


def render_consistency_section(story: DiagnosisReportData) -> Iterator[str]:
    """Yield the section of the page; nothing for a single run."""
    after = sorted(story.consistency.after, key=lambda one: one.p_value)
    if not after:
        return
    yield make_paragraph(" ".join(safe(text, 1000) for text in format_consistency(story)))
    heads = ("number", "joint fit, 95 %", "for another run, 95 %", "by", "chance", "each apart")
    rows = []
    for one in after[:MAX_TABLE_ROWS]:
        rows.append(
            [
                safe(one.number, 60),
                safe(_within(one, one.error)),
                safe(_within(one, one.prediction_sigma)),
                safe(f"{len(one.group_estimates)} {_plural(one.by)}", 60),
                safe(format_p_value(one.p_value)),
                _drawn(one),
            ]
        )
    yield make_table(
        heads, rows, ["" if one.is_consistent else "worst" for one in after[:MAX_TABLE_ROWS]]
    )
    if len(after) > MAX_TABLE_ROWS:
        yield make_paragraph(
            f"{len(after) - MAX_TABLE_ROWS} more numbers agree as well or better: apart.csv."
        )


def _within(one: ParameterConsistency, error: float) -> str:
    half = Z95 * error
    return append_unit(format_estimate(one.value, one.value - half, one.value + half), one.unit)


def _drawn(one: ParameterConsistency) -> str:
    """Draw the interval of each group one below the other, over a band for the joint fit."""
    ends = [(p.value - Z95 * p.error, p.value + Z95 * p.error) for p in one.group_estimates]
    low, high = min(e[0] for e in ends), max(e[1] for e in ends)
    if not (np.isfinite([low, high]).all() and high > low):
        return ""
    scale = _DRAWN / (high - low)

    def at(value: float) -> float:
        return float(np.clip(10.0 + (value - low) * scale, 0.0, 200.0))

    height = 8 * len(one.group_estimates) + 6
    left, right = (at(one.value + side * Z95 * one.error) for side in (-1, 1))
    width = max(right - left, 1.5)
    shapes = [f'<rect class="joint" x="{left:.1f}" y="0" width="{width:.1f}" height="{height}"/>']
    for row, (part, (begin, end)) in enumerate(zip(one.group_estimates, ends, strict=True)):
        y = 8 * row + 7
        line = f'x1="{at(begin):.1f}" x2="{at(end):.1f}" y1="{y}" y2="{y}"'
        shapes.append(f'<line class="after" {line} stroke-width="1.5"/>')
        shapes.append(f'<circle class="after" cx="{at(part.value):.1f}" cy="{y}" r="2.5"/>')
    label = f"{_named(one)} of {len(one.group_estimates)} {_plural(one.by)}"
    label = f'viewBox="0 0 200 {height}" role="img" aria-label="{safe(label, 120)}"'
    return f'<svg class="each" {label}>{"".join(shapes)}</svg>'


def build_consistency_rows(story: DiagnosisReportData) -> list[tuple[object, ...]]:
    """Build the rows of `AGREEMENT_COLUMNS`: joint fit and groups, with 95 % intervals."""
    found: list[tuple[object, ...]] = []
    models = [("base", story.consistency.before)]
    if story.verdict.causes:
        models.append(("extended", story.consistency.after))
    for model, spreads in models:
        for one in spreads:
            about = model, one.number, one.unit, one.by
            groups = [("all", one.value, one.error)]
            groups += [(part.group, part.value, part.error) for part in one.group_estimates]
            groups.append(("another", one.value, one.prediction_sigma))
            for group, value, error in groups:
                found.append((*about, group, value, value - Z95 * error, value + Z95 * error))
    return found
