"""Text of numbers, units and effect names, for the summary, the figures and the page."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from bench.pages.text_format import append_unit as append_unit
from bench.pages.text_format import format_estimate as format_estimate
from bench.pages.text_format import format_number as format_number
from bench.pages.text_format import format_p_value as format_p_value
from bench.pages.text_format import format_percent as format_percent
from bench.pages.text_format import format_unit as format_unit
from bench.pages.text_format import joined as joined
from bench.pages.text_format import sanitise as sanitise
from sims import effects

# All text functions of explain's pages are imported from this module, including the shared ones.
from sims.core.simulator import InputError
from sims.extended_simulator import FittedValue

QUANTITY_LABELS: Mapping[str, str] = {"q": "position", "qd": "velocity", "tau": "torque"}
"""Quantities of a joint, by the first part of a channel's name; a sensor has its own row."""
END = {"low": "lower", "high": "upper"}
"""Words for the ends of a range."""
ALL_PLACES = "*"
"""Place of a family: all places of one kind."""
_AT = {
    "joint": ("at", "joints"),
    "actuator": ("at", "actuators"),
    "body": ("of", "bodies"),
    "channel": ("in", "channels"),
    "contact": ("of", "contacts"),
    "geom": ("of", "geoms"),
    "level": ("of", "levels"),
}
"""Preposition before a place of each kind, and the plural of the kind."""
NUMERICS_NAMES = {
    "numerics.step": "too long a time step",
    "numerics.integrator": "an unsuitable integrator",
    "numerics.cone": "another friction cone",
    "numerics.impratio": "another impedance ratio of friction",
    "numerics.noslip": "another number of iterations without slip",
    "numerics.solver": "another constraint solver",
    "numerics.iterations": "another number of iterations of the solver",
}
"""Names of numerical settings as causes; they are errors of the model file, not effects."""
_WRONG = re.compile(r"an? (wrong|misplaced) ")
"""Pattern of nouns that name a wrong value, not a missing effect."""


def format_effect(effect: str) -> str:
    """Format an effect as a noun, such as ``linear drag``.

    Effects joined by + become ``a and b``. Unknown effects keep their name.
    """
    return joined([_format_effect_as_noun(part.strip()) for part in effect.split("+")])


def _format_effect_as_noun(name: str) -> str:
    """Format one effect as a noun with its place, such as ``Coulomb friction at joint elbow``.

    - A numerical setting has its own noun.
    - An effect that is not registered has its name.
    - An effect without a noun has its name, and the first clause of its description in brackets.

    Args:
        name: Name of an effect, such as ``friction.coulomb@elbow``.
    """
    base, place = split_effect_name(name)
    if base in NUMERICS_NAMES:
        return NUMERICS_NAMES[base]
    try:
        effect = effects.get_effect(base)
    except InputError:
        # A verdict may name an effect of a plugin that is not loaded.
        return sanitise(name, 60)
    if not effect.noun:
        clause, *_ = re.split(r"[,:;]", effect.says, maxsplit=1)
        return sanitise(f"{name} ({clause})", 60)
    if not place:
        return sanitise(effect.noun, 60)
    noun = sanitise(effect.noun_at_place or effect.noun, 60)
    is_parameter = is_parameter_error(name)
    return noun + format_places(get_place_kind(name), [place], is_parameter=is_parameter)


def split_effect_name(effect: str) -> tuple[str, str]:
    """Split an effect into its registered name and its place, which is ``*`` for a family."""
    base, _, place = effect.partition("@")
    return base, place


def get_place_kind(effect: str) -> str:
    """Return the kind of an effect's places, such as ``joint`` or ``body``; empty if unknown."""
    try:
        kind: str = getattr(effects.get_effect(split_effect_name(effect)[0]), "at", "")
    except InputError:
        return ""
    return kind if kind in _AT else ""


def is_parameter_error(effect: str) -> bool:
    """Return whether the effect corrects a wrong value instead of adding a missing effect.

    For example, ``mass.scale`` corrects the mass of the model file, while ``drag.linear`` adds a
    force.

    Args:
        effect: Name of the effect, with its place if it has one.
    """
    base, place = split_effect_name(effect)
    if base in NUMERICS_NAMES:
        return True
    try:
        registered = effects.get_effect(base)
    except InputError:
        return False
    return bool(_WRONG.match((registered.noun_at_place if place else "") or registered.noun))


def format_places(
    kind: str, places: Sequence[str], conjunction: str = "or", is_parameter: bool = False
) -> str:
    """Format places: `` at joint elbow``, `` at every joint``, `` at any of the joints a, b or c``.

    Args:
        kind: Kind of the places, such as ``joint``; empty if unknown.
        places: Names of the places; only `ALL_PLACES` for every one.
        conjunction: Conjunction before the last name.
        is_parameter: Whether the effect is a wrong value of the place: `` of joint elbow``.
    """
    preposition, plural = _AT.get(kind, ("at", "places"))
    preposition = "of" if is_parameter else preposition
    names = [sanitise(place, 40) for place in places]
    if names == [ALL_PLACES]:
        return f" {preposition} every {kind}" if kind else " everywhere"
    if len(names) < 3:
        # An unknown kind leaves two spaces.
        return f" {preposition} {kind} {joined(names, conjunction)}".replace("  ", " ")
    quantifier = "any" if conjunction == "or" else "each"
    return f" {preposition} {quantifier} of the {plural} {joined(names, conjunction)}"


def format_effect_name(effect: str) -> str:
    """Format an effect as a noun without its article, for lists."""
    return re.sub(r"^an? ", "", format_effect(effect))


def format_sentence(text: object) -> str:
    """Format text as a sentence, with a capital first letter and a final period.

    Args:
        text: Text of a file or of this project; control characters are removed.
    """
    sanitised_text = sanitise(text)
    if not sanitised_text:
        return sanitised_text
    # A name with digits or underscores stays unchanged.
    first_word, *_ = sanitised_text.split()
    if first_word.rstrip(",:;.").isalpha():
        sanitised_text = sanitised_text[0].upper() + sanitised_text[1:]
    return sanitised_text if sanitised_text[-1] in ".!?…" else f"{sanitised_text}."


def format_label(name: str, unit: str, max_length: int = 30) -> str:
    """Format a label with its unit: ``q [rad]``, or ``q`` for a pure number.

    Args:
        name: Text of the label.
        unit: Unit.
        max_length: Maximum number of characters of the text.
    """
    label, unit_text = sanitise(name, max_length), format_unit(unit)
    return f"{label} [{unit_text}]" if unit_text else label


def shorten_label(name: object, unit: str = "1", max_length: int = 30) -> str:
    """Format a text from a file, optionally with its unit, short enough for a label.

    Args:
        name: Text of the label.
        unit: Unit; ``1`` for none.
        max_length: Maximum number of characters of the text.
    """
    return format_label(sanitise(name, max_length), sanitise(unit, 12))


def format_fitted_value(fitted: FittedValue) -> str:
    """Format a fitted number with its interval and unit, or the bound that it is at.

    The resulting value in the model file, and a value outside the usual range, are added.
    """
    text = append_unit(format_estimate(fitted.value, fitted.low, fitted.high), fitted.unit)
    if fitted.at_bound is not None:
        text = at_bound(fitted.value, fitted.unit, fitted.at_bound)
    return text + format_file_change(fitted) + format_plausible_range(fitted)


def format_file_change(fitted: FittedValue) -> str:
    """Format the change in the model file: ``, in the model file 0.2 → 0.15 N·m``; else empty."""
    if fitted.stated is None or fitted.total is None:
        return ""
    total = append_unit(format_number(fitted.total), fitted.total_unit or fitted.unit)
    return f", in the model file {format_number(fitted.stated)} → {total}"


def format_plausible_range(fitted: FittedValue) -> str:
    """Format the usual range of a value outside it: ``, beyond the usual range of 0 to 0.6 N``."""
    if fitted.usual_range is None:
        return ""
    low, high = map(format_number, fitted.usual_range)
    return f", beyond the usual range of {append_unit(f'{low} to {high}', fitted.unit)}"


def at_bound(value: float, unit: str, bound: str) -> str:
    """Format a value at a bound: ``4 s (upper bound of its range)``."""
    return f"{append_unit(format_number(value), unit)} ({END[bound]} bound of its range)"
