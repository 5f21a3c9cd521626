"""Consistency of each parameter between runs, logs or loads: sentences, a table and file rows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from bench.gap.apart import LEVEL, Mover, Spread
from bench.gap.measure import Z95
from bench.gap.report.missing import missing
from bench.gap.report.story import Story
from bench.gap.report.words import clean, estimate, joined, number, probability, sentence, with_unit
from bench.pages.elements import paragraph, safe, table

MOST = 12
"""Maximum number of rows of the table, the least consistent first."""
NAMED = 4
"""Maximum number of parameters that a sentence names."""
_DRAWN = 180.0
HEAD = ("model", "number", "unit", "by", "group", "value", "low", "high")
"""Columns of the file apart.csv."""


def told(story: Story) -> list[str]:
    """Format sentences about the consistency of the parameters.

    They report which parameters differ between groups, which are consistent with the causes only,
    and which drift.

    Args:
        story: Report data.
    """
    before = {(s.number, s.by): s for s in story.apart.before}
    after = story.apart.after
    causes = joined([clean(cause.effect, 60) for cause in story.verdict.causes])
    sentences = []
    mended = [s for s in after if s.agree and _disagreed(before, s)]
    if mended and causes:
        names = joined(list(dict.fromkeys(_named(s) for s in mended))[:NAMED])
        by = _plural(mended[0].by)
        sentences.append(f"without {causes} {names} moved between {by} more than their intervals")
    rival = _clearest([s for s in story.apart.rival if not s.agree])
    for one in rival[:1]:
        moves = f", and {_goes(one)} with {clean(one.by, 40)}" if _moves(one) else ""
        sentences.append(
            f"with {_named(one)} in place of {causes} its value would differ between "
            f"{_plural(one.by)}, {with_unit(_span(one), one.unit)} (chance "
            f"{probability(one.chance)}){moves}: that is how one sees what is missing"
        )
    apart = _clearest([s for s in after if not s.agree])
    for one in apart[:NAMED]:
        sentences.append(_apart(one, [cause.effect for cause in story.verdict.causes]))
    if len(apart) > NAMED:
        sentences.append(f"{len(apart) - NAMED} more numbers do not agree either")
    if after and not apart:
        groups = _plural(after[0].by)
        sentences.append(f"all {groups} agree on every number within its interval")
    return [sentence(text) for text in (*sentences, *_drifts(after))]


def _clearest(apart: Sequence[Spread]) -> list[Spread]:
    """Return each parameter once, preferably with the grouping in which it has a trend."""
    by_number: dict[str, list[Spread]] = {}
    for one in apart:
        by_number.setdefault(one.number, []).append(one)
    return [min(each, key=_rank) for each in by_number.values()]


def _rank(one: Spread) -> tuple[bool, int, float]:
    """Return a sort key: by trend first, then constants, logs and runs, then by p-value."""
    by = {"log": 1, "run": 2}.get(one.by, 0)
    return not (_moves(one) or one.mover is not None), by, one.chance


def _moves(one: Spread) -> bool:
    return one.by != "log" and one.trend is not None and one.trend.chance < LEVEL


def _disagreed(before: dict[tuple[str, str], Spread], one: Spread) -> bool:
    known = before.get((one.number, one.by))
    return known is not None and not known.agree


def _apart(one: Spread, known: Sequence[str]) -> str:
    text = (
        f"{_named(one)} differs between {_plural(one.by)}, {with_unit(_span(one), one.unit)} "
        f"(chance {probability(one.chance)}): of a run not yet recorded it is known to "
        f"±{number(Z95 * one.total)}, not to ±{number(Z95 * one.error)}"
    )
    if one.mover is None:
        return f"{text}; an effect is missing that makes it move"
    way = "grows" if one.mover.trend.slope > 0 else "falls"
    text += f"; it {way} with {_along(one.mover)}"
    kind, name = one.mover.kind, clean(one.mover.name, 40)
    what = missing(one.number, kind, name, one.mover.trend.slope > 0, known)
    return f"{text}: what is missing is {what}"


def _along(mover: Mover) -> str:
    """Format the covariate of a trend and those that are indistinguishable from it."""
    return " or ".join(clean(name, 40) for name in (mover.name, *mover.also[:2]))


def _span(one: Spread) -> str:
    values = [part.value for part in one.parts]
    return f"{number(min(values))} to {number(max(values))}"


def _drifts(after: Sequence[Spread]) -> Iterator[str]:
    """Yield sentences on the parameters that drift over the logs."""
    logs = [s for s in after if s.by == "log" and s.trend is not None]
    if not logs:
        return
    level = LEVEL / len(logs)
    drifting = [s for s in logs if s.trend is not None and s.trend.chance < level and not s.agree]
    for one in drifting[:NAMED]:
        assert one.trend is not None
        size = f"{number(abs(one.trend.slope))} ± {number(Z95 * one.trend.error)}"
        yield f"{_named(one)} {_goes(one)} from log to log by {with_unit(size, one.unit)}"
    if not drifting:
        yield f"over the {len(logs[0].parts)} logs, in the order given, nothing drifts"


def _goes(one: Spread) -> str:
    return "grows" if one.trend is not None and one.trend.slope > 0 else "falls"


def _named(one: Spread) -> str:
    return clean(one.number, 60)


def _plural(by: str) -> str:
    return f"{by}s" if by in ("run", "log") else f"values of {clean(by, 40)}"


def agreement(story: Story) -> Iterator[str]:
    """Yield the section of the page; nothing for a single run."""
    after = sorted(story.apart.after, key=lambda one: one.chance)
    if not after:
        return
    yield paragraph(" ".join(safe(text, 1000) for text in told(story)))
    heads = ("number", "joint fit, 95 %", "for another run, 95 %", "by", "chance", "each apart")
    rows = []
    for one in after[:MOST]:
        rows.append(
            [
                safe(one.number, 60),
                safe(_within(one, one.error)),
                safe(_within(one, one.total)),
                safe(f"{len(one.parts)} {_plural(one.by)}", 60),
                safe(probability(one.chance)),
                _drawn(one),
            ]
        )
    yield table(heads, rows, ["" if one.agree else "worst" for one in after[:MOST]])
    if len(after) > MOST:
        yield paragraph(f"{len(after) - MOST} more numbers agree as well or better: apart.csv.")


def _within(one: Spread, error: float) -> str:
    half = Z95 * error
    return with_unit(estimate(one.value, one.value - half, one.value + half), one.unit)


def _drawn(one: Spread) -> str:
    """Draw the interval of each group one below the other, over a band for the joint fit."""
    ends = [(p.value - Z95 * p.error, p.value + Z95 * p.error) for p in one.parts]
    low, high = min(e[0] for e in ends), max(e[1] for e in ends)
    if not (np.isfinite([low, high]).all() and high > low):
        return ""
    scale = _DRAWN / (high - low)

    def at(value: float) -> float:
        return float(np.clip(10.0 + (value - low) * scale, 0.0, 200.0))

    height = 8 * len(one.parts) + 6
    left, right = (at(one.value + side * Z95 * one.error) for side in (-1, 1))
    width = max(right - left, 1.5)
    shapes = [f'<rect class="joint" x="{left:.1f}" y="0" width="{width:.1f}" height="{height}"/>']
    for row, (part, (begin, end)) in enumerate(zip(one.parts, ends, strict=True)):
        y = 8 * row + 7
        line = f'x1="{at(begin):.1f}" x2="{at(end):.1f}" y1="{y}" y2="{y}"'
        shapes.append(f'<line class="after" {line} stroke-width="1.5"/>')
        shapes.append(f'<circle class="after" cx="{at(part.value):.1f}" cy="{y}" r="2.5"/>')
    label = f"{_named(one)} of {len(one.parts)} {_plural(one.by)}"
    label = f'viewBox="0 0 200 {height}" role="img" aria-label="{safe(label, 120)}"'
    return f'<svg class="each" {label}>{"".join(shapes)}</svg>'


def rows(story: Story) -> list[tuple[object, ...]]:
    """Build the rows of `HEAD`: joint fit and groups of each parameter, with 95 % intervals."""
    found: list[tuple[object, ...]] = []
    models = [("base", story.apart.before)]
    if story.verdict.causes:
        models.append(("extended", story.apart.after))
    for model, spreads in models:
        for one in spreads:
            about = model, one.number, one.unit, one.by
            groups = [("all", one.value, one.error)]
            groups += [(part.group, part.value, part.error) for part in one.parts]
            groups.append(("another", one.value, one.total))
            for group, value, error in groups:
                found.append((*about, group, value, value - Z95 * error, value + Z95 * error))
    return found
