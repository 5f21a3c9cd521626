"""Numbers, units and names as a person reads them, in the account, the figures and the page."""

from __future__ import annotations

import re
from collections.abc import Sequence
from math import floor, isfinite, log10

from sims import effects
from sims.base import InputError
from sims.extended import Number

_RAISED = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
"""Digits and the sign as they stand in a power."""
_SMALL = 1e-3
"""Magnitude below which numbers are written with a power of ten."""
_LARGE = 1e5
"""Magnitude from which on numbers are written with a power of ten."""
_FEW = log10(3.55)
"""Mantissa of an interval below which it is written with two digits (Particle Data Group's rule).
"""
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
_LEAST = 1e-12
"""Probabilities below this are all the same."""


def clean(text: object, most: int = 400) -> str:
    """Text from a file or plugin on one line: what a terminal would obey is spelled out, what is
    too long cut.
    """
    plain = "".join(_harmless(c) for c in str(text)).strip()
    return plain if len(plain) <= most else plain[: most - 1] + "…"


def _harmless(character: str) -> str:
    if character.isprintable():
        return character
    # A line break or tab is a space; an escape sequence or a change of direction is spelled out.
    return " " if character.isspace() else ascii(character)[1:-1]


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


def joined(parts: Sequence[str], last: str = "and") -> str:
    """``a``, ``a and b``, ``a, b and c``."""
    if len(parts) < 2:
        return "".join(parts)
    front = ", ".join(parts[:-1])
    return f"{front} {last} {parts[-1]}"


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
    raised = re.sub(power, lambda match: match[1].translate(_RAISED), clean(unit, 60))
    return "" if raised == "1" else raised.replace("*", "·")


def labelled(name: str, unit: str, most: int = 30) -> str:
    """``q [rad]``, ``q`` for a pure number."""
    return f"{clean(name, most)} [{pretty(unit)}]" if pretty(unit) else clean(name, most)


def with_unit(text: str, unit: str) -> str:
    """A number and its unit."""
    return f"{text} {pretty(unit)}" if pretty(unit) else text


def number(value: float | None, digits: int = 3) -> str:
    """With so many significant digits; a dash where there is none."""
    if value is None or not isfinite(value):
        return "–"
    if value == 0:
        return "0"
    # Rounded first: 0.0009996 is 0.001, which needs no power of ten.
    rounded = float(f"{value:.{digits - 1}e}")
    exponent = _exponent(abs(rounded))
    decimals = max(0, digits - 1 - floor(log10(abs(rounded))) + exponent)
    text = f"{rounded / 10.0**exponent:.{decimals}f}"
    # Zeros before the decimal point are digits, those behind it are none.
    if "." in text:
        text = text.rstrip("0").rstrip(".")
    return _signed(text) + _power(exponent)


def estimate(value: float, low: float | None, high: float | None) -> str:
    """``0.00333 (0.00330 to 0.00336)``: one digit of the interval's half width, two where it begins
    with 1 to 3.
    """
    if low is None or high is None or not (isfinite(low) and isfinite(high)) or high <= low:
        return f"{number(value)} (no interval)"
    # One power of ten for all three, or they could not be compared at a glance.
    exponent = _exponent(max(abs(value), abs(low), abs(high)))
    half = log10((high - low) / 2) - exponent
    decimals = min(max(0, (half % 1 < _FEW) - floor(half)), 9)
    texts = []
    for x in (value, low, high):
        digits = f"{x / 10.0**exponent:.{decimals}f}"
        texts.append(_signed(digits) + _power(exponent))
    middle, left, right = texts
    return f"{middle} ({left} to {right})"


def estimated(fitted: Number) -> str:
    """A fitted number with its interval and its unit."""
    return with_unit(estimate(fitted.value, fitted.low, fitted.high), fitted.unit)


def percent(share: float | None) -> str:
    """A share as ``90 %``; below 10 % and close to 100 % with one decimal."""
    if share is None or not isfinite(share):
        return "–"
    size = abs(100 * share)
    # 99.6 % is not all, and 0.4 % is not nothing.
    decimals = 1 if 0 < size < 9.95 or 99 < size < 99.95 else 0
    return _signed(f"{100 * share:.{decimals}f}") + " %"


def probability(p: float | None) -> str:
    """``p = 0.03``."""
    if p is None or not isfinite(p):
        return "p unknown"
    # Of a tail so far out the number itself means nothing.
    return f"p < {number(_LEAST, 1)}" if p < _LEAST else f"p = {number(p, 2)}"


def _exponent(size: float) -> int:
    """The power of ten that a number is written with; 0 for none."""
    return 0 if size == 0 or _SMALL <= size < _LARGE else floor(log10(size))


def _power(exponent: int) -> str:
    return f"×10{str(exponent).translate(_RAISED)}" if exponent else ""


def _signed(text: str) -> str:
    """With a true minus sign, and none before a zero."""
    zero = not text.strip("-0.")
    return text.lstrip("-") if zero else text.replace("-", "−")
