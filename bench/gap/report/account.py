"""The account of an explanation in plain sentences: for the terminal, and what the page and the
figures say too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import isclose, isfinite
from textwrap import wrap
from typing import Any

import numpy as np

from bench.gap.report.story import Place, Side, Story, Tuned
from bench.gap.report.words import (
    clean,
    estimate,
    joined,
    noun,
    number,
    percent,
    pretty,
    probability,
    sentence,
    with_unit,
)
from sims.base import Array

WIDTH = 100
ESTIMATED = 1.2
"""An estimated noise is known to this over the root of the number of samples, as a share of it (see
`floor`).
"""
ONE_SIDED = 1.645
PERFECT = "with a perfect model the sensor's noise would leave"
MOVED = 0.05
"""Share by which a parameter moves that is called out where its interval is not known."""


def account(story: Story) -> list[str]:
    """The lines that a terminal shows: the verdict in a sentence, the gain, where, what moved, what
    remains.
    """
    lines = [clean(story.title, WIDTH), ""]
    for text in (headline(story), *following(story)):
        lines += wrap(text, WIDTH)
    for text in details(story):
        lines += ["", *wrap(text, WIDTH, subsequent_indent="  ")]
    return lines


def details(story: Story) -> Iterator[str]:
    """Paragraphs below the headline, a sentence or a few each."""
    told = story.verdict["verdict"] in ("named", "partial")
    for cause in story.verdict["causes"]:
        name = f"{sentence(noun(cause['effect']))[:-1]} ({clean(cause['effect'], 60)}): "
        yield name + ("" if told else f"{clean(cause['says']).rstrip('.')}; ") + coefficients(cause)
    if story.why:
        yield "Why: " + " ".join(sentence(text) for text in story.why[:2])
    if story.verdict["verdict"] != "adequate" and (
        places := [text for kind in ("run", "channel", "phase") if (text := largest(story, kind))]
    ):
        yield (
            "Where the gap is largest, RMS in units of the noise (1 is the noise floor): "
            + "; ".join(places)
            + "."
        )
    if moved := [text for p in story.parameters if (text := moves(story, p))]:
        yield "Parameters: " + " ".join(moved)
    if story.remains:
        yield "What remains: " + " ".join(sentence(text) for text in story.remains)
    if story.verdict["verdict"] != "ambiguous" and (proposed := experiment(story)):
        yield f"Next experiment: {proposed}"
    yield effort(story)


def headline(story: Story) -> str:
    """What is wrong with the simulator, in one sentence."""
    verdict, causes = story.verdict["verdict"], story.verdict["causes"]
    if verdict == "adequate":
        return "Nothing is missing from the simulation that these data can show."
    if verdict == "unidentifiable":
        return f"These data cannot fix {joined(unfixed(story))}: what the simulation lacks cannot be told from them."
    if verdict == "unknown" or not causes:
        count = len(story.verdict["candidates"])
        return f"Something is missing from the simulation, and none of the {count} known causes explains it."
    if verdict == "ambiguous":
        return f"The simulation lacks {_sets(causes)}: these data cannot tell which."
    if verdict == "partial":
        return f"The simulation lacks {_sets(causes)}, and something else that no known cause explains."
    names = [noun(cause["effect"]) for cause in causes]
    says = f": {clean(causes[0]['says']).rstrip('.')}" if len(causes) == 1 else ""
    return f"The simulation lacks {joined(names)}{says}."


def _sets(causes: Sequence[Mapping[str, Any]]) -> str:
    """The causes, those that have alternatives last: ``wind, and linear drag or Coulomb friction``."""
    known = [noun(cause["effect"]) for cause in causes if not cause["alternatives"]]
    open_sets = [
        joined([noun(n) for n in (cause["effect"], *cause["alternatives"])], "or")
        for cause in causes
        if cause["alternatives"]
    ]
    return ", and ".join([*([joined(known)] if known else []), *open_sets])


def unfixed(story: Story) -> list[str]:
    """Parameters that the recording cannot fix: those named so, else without interval, else not
    touched, else all.
    """
    unbounded = [p.name for p in story.parameters if p.touched and not np.isfinite(p.before).all()]
    untouched = [p.name for p in story.parameters if not p.touched]
    names = list(story.vague) or unbounded or untouched or [p.name for p in story.parameters]
    return [clean(name, 60) for name in names] or ["the simulation's parameters"]


def following(story: Story) -> Iterator[str]:
    """The sentences that follow the headline at once: the gain, and what the verdict owes."""
    verdict = story.verdict["verdict"]
    if verdict == "adequate":
        yield looked_for(story)
        yield hiding(story)
    yield gain(story)
    if verdict == "partial" or (verdict == "named" and len(story.verdict["causes"]) > 1):
        told = [
            f"{noun(cause['effect'])}: {clean(cause['says']).rstrip('.')}"
            for cause in story.verdict["causes"]
        ]
        yield sentence("; ".join(told))
    if verdict == "ambiguous":
        yield "To tell them apart: " + (experiment(story) or "no experiment is proposed.")


def gain(story: Story) -> str:
    """The held-out error before and after against the floor; that it was not measured where no run
    is held out.
    """
    found = story.verdict["heldout"]
    if found is None:
        return _fitted_gain(story)
    base, extended, floor = (
        _error(story, found[k]) for k in ("rmse_base", "rmse_extended", "noise_floor")
    )
    if not story.verdict["causes"]:
        return f"On held-out runs the tuned simulation errs by {base} (RMSE); {PERFECT} {floor}."
    closed = (
        f"{_closer(story)} {percent(found['gap_closed'])} of the gap{interval(found)}"
        if closes(found)
        else ""
    )
    errors = f"the error on held-out runs (RMSE) is {base} before and {extended} after; {PERFECT} {floor}."
    return f"{closed}: {errors}" if closed else errors[0].upper() + errors[1:]


def closes(found: Mapping[str, Any] | None) -> bool:
    """Whether a share of the gap is known."""
    return found is not None and found["gap_closed"] is not None and isfinite(found["gap_closed"])


def interval(found: Mapping[str, Any]) -> str:
    """`` (85 to 94 %)``, the 95 % interval of the share closed; empty where there is none."""
    low, high = found["low"], found["high"]
    if low is None or high is None:
        return ""
    return f" ({percent(low).removesuffix(' %')} to {percent(high)})"


def _closer(story: Story) -> str:
    causes = story.verdict["causes"]
    if story.verdict["verdict"] == "unknown":
        names = joined([noun(cause["effect"]) for cause in causes])
        return f"The best of them, {names}, {'closes' if len(causes) == 1 else 'close'} only"
    if len(causes) > 1:
        return "Together they close"
    if story.verdict["verdict"] == "partial":
        return sentence(f"{noun(causes[0]['effect'])} closes").rstrip(".")
    return "Either closes" if story.verdict["verdict"] == "ambiguous" else "It closes"


def _fitted_gain(story: Story) -> str:
    before, after = (rms(story, story.fitting, which) for which in ("before", "after"))
    said = f"the tuned simulation's error is {number(before)} times the noise"
    if story.verdict["causes"]:
        said += f" before and {number(after)} times after"
    return (
        f"No run is held out, so the gain is not measured independently; on the fitted runs {said}."
    )


def heldout_unit(story: Story) -> str:
    """The unit of the held-out errors: stated, or that of the channels whose noise together makes
    the floor.
    """
    found = story.verdict["heldout"] or {}
    if "unit" in found:
        return str(found["unit"])
    units = list(dict.fromkeys(c.unit for c in story.channels))
    for unit in units:
        together = float(np.sqrt(np.mean([c.sigma**2 for c in story.channels if c.unit == unit])))
        if isclose(together, found.get("noise_floor") or 0.0, rel_tol=0.02):
            return unit
    return units[0] if len(units) == 1 else "1"


def _error(story: Story, value: float | None) -> str:
    return with_unit(number(value), heldout_unit(story))


def looked_for(story: Story) -> str:
    """What was looked for, and how close the best candidate comes."""
    candidates = story.verdict["candidates"]
    if not candidates:
        return "No candidate causes were at hand."
    best = candidates[0]
    return (
        f"{len(candidates)} possible causes were looked for and none stands out from chance; the most promising "
        f"is {noun(best['effect'])} ({probability(best['p_value'])})."
    )


def hiding(story: Story) -> str:
    """How large a gap the noise could hide, channel by channel."""
    parts = [
        f"{with_unit(number(size, 2), c.unit)} in {clean(c.name, 30)} ({number(size / c.sigma, 2)} of its noise)"
        for c, size in zip(story.channels, hidden(story).tolist(), strict=True)
        if isfinite(size)
    ]
    return f"A gap of up to {joined(parts)} RMS could still hide in the noise." if parts else ""


def hidden(story: Story) -> Array:
    """(C,) RMS in the channel's unit of the largest gap that a channel's noise could hide, at 95 %.

    The mean square of the residual, less that of the noise, plus what the former is uncertain by:
    fewer samples count where the noise remembers, and a noise that is estimated is itself
    uncertain.
    """
    sizes = []
    for c, channel in enumerate(story.channels):
        rows = [
            row
            for side in sides(story)
            for row in (side.observed - side.before)[:, :, c] / channel.sigma
        ]
        seen = np.concatenate([row[np.isfinite(row)] for row in rows])
        if seen.size < 2:
            sizes.append(np.nan)
            continue
        square = float(np.mean(seen**2))
        pairs = np.concatenate([row[1:] * row[:-1] for row in rows])
        phi = (
            float(np.clip(np.nanmean(pairs) / square, 0.0, 0.98))
            if np.isfinite(pairs).any() and square
            else 0.0
        )
        counted = seen.size * (1.0 - phi**2) / (1.0 + phi**2)
        doubt = 0.0 if channel.stated else 2.0 * ESTIMATED / seen.size**0.5
        excess = max(0.0, square - 1.0) + ONE_SIDED * float(
            np.hypot(square * (2.0 / counted) ** 0.5, doubt)
        )
        sizes.append(channel.sigma * excess**0.5)
    return np.array(sizes)


def sides(story: Story) -> list[Side]:
    """Fitted and held-out runs, as far as there are any."""
    return [
        side for side in (story.fitting, story.held_out) if side is not None and len(side.names)
    ]


def rms(story: Story, side: Side, which: str) -> float:
    """RMS of a side's residual over all channels in units of the noise; ``which`` is before or
    after.
    """
    left = (side.observed - getattr(side, which)) / np.array([c.sigma for c in story.channels])
    return float(np.sqrt(np.nanmean(left**2))) if np.isfinite(left).any() else float("nan")


def coefficients(cause: Mapping[str, Any]) -> str:
    """A cause's coefficients with intervals, how unlikely it is by chance, and what would do as
    well.
    """
    parts = [
        f"{clean(name, 60)} {with_unit(estimate(c['value'], c['low'], c['high']), c['unit'])}"
        for name, c in cause["coefficients"].items()
    ]
    others = (
        f"; {joined([noun(n) for n in cause['alternatives']], 'or')} instead would do as well"
        if cause["alternatives"]
        else ""
    )
    return f"{joined(parts)}; {probability(cause['p_value'])}{others}."


def largest(story: Story, kind: str) -> str:
    """The run, channel or phase with the largest gap, where there is a choice."""
    there = [place for place in story.places if place.kind == kind and isfinite(place.before)]
    if len(there) < 2:
        return ""
    place: Place = max(there, key=lambda p: p.before)
    after = f" before, {number(place.after, 2)} after" if story.verdict["causes"] else ""
    return f"{kind} {clean(place.label, 60)} ({number(place.before, 2)}{after})"


def moves(story: Story, p: Tuned) -> str:
    """How far a parameter moves once the cause is in: what the base model had bent to absorb of the
    gap.
    """
    unit, name = f" {pretty(p.unit)}" if pretty(p.unit) else "", clean(p.name, 60)
    if not p.touched:
        return f"{name} is not touched by these data and stays at its nominal {number(p.before[0])}{unit}."
    if not story.verdict["causes"]:
        return f"{name} = {estimate(*p.before)}{unit}."
    change = (
        f"{name} {estimate(*p.before)}{unit} before, {estimate(*p.after)}{unit} after ({shift(p)})"
    )
    return change + (": it had absorbed part of the gap." if absorbed(p) else ".")


def shift(p: Tuned) -> str:
    """The move of a parameter as a signed percentage, or a number where it began at zero."""
    move = p.after[0] - p.before[0]
    if not p.before[0] or abs(move / p.before[0]) > 10:
        return ("+" if move > 0 else "") + with_unit(number(move, 2), p.unit)
    return ("+" if move > 0 else "") + percent(move / abs(p.before[0]))


def absorbed(p: Tuned) -> bool:
    """Whether a parameter moves out of the interval that the base model gives, or that the extended
    one does.
    """
    inside = [
        low <= value <= high
        for value, (_, low, high) in ((p.after[0], p.before), (p.before[0], p.after))
    ]
    if not np.isfinite([*p.before, *p.after]).all():
        return abs(p.after[0] - p.before[0]) > MOVED * abs(p.before[0])
    return not all(inside)


def experiment(story: Story) -> str:
    """What to do next, in words; empty where nothing is proposed."""
    proposed = story.verdict["next_experiment"]
    return sentence(proposed.get("says", "")) if proposed else ""


def effort(story: Story) -> str:
    """What was simulated."""
    v = story.verdict
    return (
        f"{v['simulations']:,} simulations of system {clean(v['system'], 60)} on engine {clean(v['engine'], 60)}, "
        f"{number(v['seconds'], 2)} s."
    )
