"""Numbers, units and names as a person reads them, in the account, the figures and the page."""

from __future__ import annotations

import re
from collections.abc import Sequence

# A page of explain takes all its words from here, those that every page shares too.
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
"""What an end of a range is called."""
FAMILY = "*"
"""The place of a family: all of one kind."""
_AT = {
    "joint": ("at", "joints"),
    "actuator": ("at", "actuators"),
    "body": ("of", "bodies"),
    "channel": ("in", "channels"),
    "level": ("of", "levels"),
}
"""How a sentence leads to a place of each kind, and how it calls several."""
NUMERICS = {
    "numerics.step": "too long a time step",
    "numerics.integrator": "an integrator that does not follow the motion",
}
"""How a robot is stepped, where that is the cause: no effects, and wrong in the model file."""
_WRONG = re.compile(r"an? (wrong|misplaced) ")
"""Beginnings of the nouns of what a simulation has wrong, and does not lack."""


def noun(effect: str) -> str:
    """An effect as a noun, e.g. ``linear drag``; effects joined by + as ``a and b``; unknown ones
    keep their name.
    """
    return joined([_noun(part.strip()) for part in effect.split("+")])


def _noun(name: str) -> str:
    """The effect's own noun, with its place; for one without, its name and the first clause of what
    it says.
    """
    base, place = parted(name)
    if base in NUMERICS:
        return NUMERICS[base]
    try:
        effect = effects.get(base)
    except InputError:
        # a verdict may name an effect of a plugin that is not loaded here
        return clean(name, 60)
    if effect.noun:
        what = clean(effect.noun, 60)
        return what + (at(kind_of(name), [place], wrong=is_wrong(name)) if place else "")
    clause = re.split(r"[,:;]", effect.says, maxsplit=1)[0]
    return clean(f"{name} ({clause})", 60)


def parted(effect: str) -> tuple[str, str]:
    """An effect's registered name and its place, ``*`` of a family; empty where it has none."""
    base, _, place = effect.partition("@")
    return base, place


def kind_of(effect: str) -> str:
    """Of what kind an effect's places are: ``joint``, ``actuator``, ``body``, ``channel``; empty
    where that is not known.
    """
    try:
        kind: str = getattr(effects.get(parted(effect)[0]), "at", "")
    except InputError:
        return ""
    return kind if kind in _AT else ""


def is_wrong(effect: str) -> bool:
    """Whether it is a number that is wrong, and nothing that is lacking."""
    base, _ = parted(effect)
    if base in NUMERICS:
        return True
    try:
        said = effects.get(base).noun
    except InputError:
        said = ""
    return bool(_WRONG.match(said))


def at(kind: str, places: Sequence[str], last: str = "or", wrong: bool = False) -> str:
    """`` at joint elbow``, `` at every joint``, `` at any of the joints a, b or c``; `` of joint
    elbow`` where a number of it is wrong.
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
    """An effect's noun without its article, for lists."""
    return re.sub(r"^an? ", "", noun(effect))


def sentence(text: object) -> str:
    """With a capital at its beginning and a stop at its end."""
    plain = clean(text)
    if not plain:
        return plain
    # A name with digits or underscores stays as it is.
    word = plain.split()[0].rstrip(",:;.").isalpha()
    first = plain[0].upper() if word else plain[0]
    stop = "" if plain[-1] in ".!?…" else "."
    return first + plain[1:] + stop


def pretty(unit: str) -> str:
    """A unit as printed, ``kg·m²``; empty for a pure number."""
    power = r"(?:\^|\*\*)(-?\d+)"
    raised = re.sub(power, lambda match: match[1].translate(RAISED), clean(unit, 60))
    return "" if raised == "1" else raised.replace("*", "·")


def labelled(name: str, unit: str, most: int = 30) -> str:
    """``q [rad]``, ``q`` for a pure number."""
    return f"{clean(name, most)} [{pretty(unit)}]" if pretty(unit) else clean(name, most)


def with_unit(text: str, unit: str) -> str:
    """A number and its unit."""
    return f"{text} {pretty(unit)}" if pretty(unit) else text


def estimated(fitted: Number) -> str:
    """A fitted number with its interval and its unit, or which bound it lies at; what becomes of
    the number of the model file; and whether it is outside the usual range.
    """
    text = with_unit(estimate(fitted.value, fitted.low, fitted.high), fitted.unit)
    if fitted.at_bound is not None:
        text = at_bound(fitted.value, fitted.unit, fitted.at_bound)
    return text + in_file(fitted) + beyond_usual(fitted)


def in_file(fitted: Number) -> str:
    """``, in the model file 0.2 → 0.15 N·m``; empty where the file states no such number."""
    if fitted.stated is None or fitted.total is None:
        return ""
    total = with_unit(number(fitted.total), fitted.total_unit or fitted.unit)
    return f", in the model file {number(fitted.stated)} → {total}"


def beyond_usual(fitted: Number) -> str:
    """``, beyond the usual range of -0.3 to 0.6 N·m·s/rad``; empty for a usual number."""
    if fitted.usual_range is None:
        return ""
    low, high = map(number, fitted.usual_range)
    return f", beyond the usual range of {with_unit(f'{low} to {high}', fitted.unit)}"


def at_bound(value: float, unit: str, bound: str) -> str:
    """``4 s (upper bound of its range)``."""
    return f"{with_unit(number(value), unit)} ({END[bound]} bound of its range)"
