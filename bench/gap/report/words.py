"""Text of numbers, units and effect names, for the summary, the figures and the page."""

from __future__ import annotations

import re
from collections.abc import Sequence

# All text functions of explain's pages are imported from this module, including the shared ones.
from bench.pages.text import RAISED
from bench.pages.text import clean as clean
from bench.pages.text import estimate as estimate
from bench.pages.text import joined as joined
from bench.pages.text import number as number
from bench.pages.text import percent as percent
from bench.pages.text import probability as probability
from sims import effects
from sims.base import InputError
from sims.extended import Number

END = {"low": "lower", "high": "upper"}
"""Words for the ends of a range."""
FAMILY = "*"
"""Place of a family: all places of one kind."""
_AT = {
    "joint": ("at", "joints"),
    "actuator": ("at", "actuators"),
    "body": ("of", "bodies"),
    "channel": ("in", "channels"),
    "level": ("of", "levels"),
}
"""Preposition before a place of each kind, and the plural of the kind."""
NUMERICS = {
    "numerics.step": "too long a time step",
    "numerics.integrator": "an integrator that does not follow the motion",
}
"""Names of a too coarse time step or integrator as causes; they are errors of the model file, not
effects.
"""
_WRONG = re.compile(r"an? (wrong|misplaced) ")
"""Pattern of nouns that name a wrong value, not a missing effect."""


def noun(effect: str) -> str:
    """Format an effect as a noun, such as ``linear drag``.

    Effects joined by + become ``a and b``. Unknown effects keep their name.
    """
    return joined([_noun(part.strip()) for part in effect.split("+")])


def _noun(name: str) -> str:
    """Format one effect as a noun with its place, or by its name and description without a noun."""
    base, place = parted(name)
    if base in NUMERICS:
        return NUMERICS[base]
    try:
        effect = effects.get(base)
    except InputError:
        # A verdict may name an effect of a plugin that is not loaded.
        return clean(name, 60)
    if effect.noun:
        what = clean(effect.noun, 60)
        return what + (at(kind_of(name), [place], wrong=is_wrong(name)) if place else "")
    clause = re.split(r"[,:;]", effect.says, maxsplit=1)[0]
    return clean(f"{name} ({clause})", 60)


def parted(effect: str) -> tuple[str, str]:
    """Split an effect into its registered name and its place, which is ``*`` for a family."""
    base, _, place = effect.partition("@")
    return base, place


def kind_of(effect: str) -> str:
    """Return the kind of an effect's places, such as ``joint`` or ``body``; empty if unknown."""
    try:
        kind: str = getattr(effects.get(parted(effect)[0]), "at", "")
    except InputError:
        return ""
    return kind if kind in _AT else ""


def is_wrong(effect: str) -> bool:
    """Return whether the effect corrects a wrong value instead of adding a missing effect."""
    base, _ = parted(effect)
    if base in NUMERICS:
        return True
    try:
        said = effects.get(base).noun
    except InputError:
        said = ""
    return bool(_WRONG.match(said))


def at(kind: str, places: Sequence[str], last: str = "or", wrong: bool = False) -> str:
    """Format places: `` at joint elbow``, `` at every joint``, `` at any of the joints a, b or c``.

    Args:
        kind: Kind of the places.
        places: Names of the places.
        last: Conjunction before the last name.
        wrong: Whether the effect is a wrong value of the place: `` of joint elbow``.
    """
    before, several = _AT.get(kind, ("at", "places"))
    before = "of" if wrong else before
    names = [clean(place, 40) for place in places]
    if names == [FAMILY]:
        return f" {before} every {kind}" if kind else " everywhere"
    if len(names) < 3:
        return f" {before} {kind} {joined(names, last)}".replace("  ", " ")
    each = "any" if last == "or" else "each"
    return f" {before} {each} of the {several} {joined(names, last)}"


def name_of(effect: str) -> str:
    """Format an effect as a noun without its article, for lists."""
    return re.sub(r"^an? ", "", noun(effect))


def sentence(text: object) -> str:
    """Format text as a sentence, with a capital first letter and a final period."""
    plain = clean(text)
    if not plain:
        return plain
    # A name with digits or underscores stays unchanged.
    word = plain.split()[0].rstrip(",:;.").isalpha()
    first = plain[0].upper() if word else plain[0]
    stop = "" if plain[-1] in ".!?…" else "."
    return first + plain[1:] + stop


def pretty(unit: str) -> str:
    """Format a unit for print, such as ``kg·m²``; empty for a pure number."""
    power = r"(?:\^|\*\*)(-?\d+)"
    raised = re.sub(power, lambda match: match[1].translate(RAISED), clean(unit, 60))
    return "" if raised == "1" else raised.replace("*", "·")


def labelled(name: str, unit: str, most: int = 30) -> str:
    """Format a label with its unit: ``q [rad]``, or ``q`` for a pure number.

    Args:
        name: Text of the label.
        unit: Unit.
        most: Maximum number of characters of the text.
    """
    return f"{clean(name, most)} [{pretty(unit)}]" if pretty(unit) else clean(name, most)


def with_unit(text: str, unit: str) -> str:
    """Append a unit to a number."""
    return f"{text} {pretty(unit)}" if pretty(unit) else text


def estimated(fitted: Number) -> str:
    """Format a fitted number with its interval and unit, or the bound that it is at.

    The resulting value in the model file, and a value outside the usual range, are added.
    """
    text = with_unit(estimate(fitted.value, fitted.low, fitted.high), fitted.unit)
    if fitted.at_bound is not None:
        text = at_bound(fitted.value, fitted.unit, fitted.at_bound)
    return text + in_file(fitted) + beyond_usual(fitted)


def in_file(fitted: Number) -> str:
    """Format the change in the model file: ``, in the model file 0.2 → 0.15 N·m``; else empty."""
    if fitted.stated is None or fitted.total is None:
        return ""
    total = with_unit(number(fitted.total), fitted.total_unit or fitted.unit)
    return f", in the model file {number(fitted.stated)} → {total}"


def beyond_usual(fitted: Number) -> str:
    """Format the usual range of a value outside it: ``, beyond the usual range of 0 to 0.6 N``."""
    if fitted.usual_range is None:
        return ""
    low, high = map(number, fitted.usual_range)
    return f", beyond the usual range of {with_unit(f'{low} to {high}', fitted.unit)}"


def at_bound(value: float, unit: str, bound: str) -> str:
    """Format a value at a bound: ``4 s (upper bound of its range)``."""
    return f"{with_unit(number(value), unit)} ({END[bound]} bound of its range)"
