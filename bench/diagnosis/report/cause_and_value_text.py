"""Text of effects, causes and fitted values, for the summary, the figures and the page.

Effects and their places become nouns, causes become clauses, and fitted values have their unit and
their interval or bound. The pages of `explain` import all text functions from this module,
including the shared ones of `bench.pages.text_format`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from bench.diagnosis.verdict import Cause
from bench.pages.text_format import append_unit as append_unit
from bench.pages.text_format import format_estimate as format_estimate
from bench.pages.text_format import format_number as format_number
from bench.pages.text_format import format_p_value as format_p_value
from bench.pages.text_format import format_percent as format_percent
from bench.pages.text_format import format_unit as format_unit
from bench.pages.text_format import joined as joined
from bench.pages.text_format import sanitise as sanitise
from sims import effects
from sims.core.simulator import InputError
from sims.extended_simulator import FittedValue
from sims.robot.fitted_causes import GRAVITY_COMPENSATED

QUANTITY_LABELS: Mapping[str, str] = {"q": "position", "qd": "velocity", "tau": "torque"}
"""Quantities of a joint, by the first part of a channel's name; a sensor has its own row."""
ALL_PLACES = "*"
"""Place of a family: all places of one kind."""
_PLACE_WORDS = {
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
_WRONG_VALUE_NOUN = re.compile(r"an? (wrong|misplaced) ")
"""Pattern of nouns that name a wrong value, not a missing effect."""
DIFFERENCE_EFFECTS = frozenset(
    {"drag.linear", "drag.quadratic", "friction.coulomb", "spring.linear"}
)
"""Effects whose coefficient is a difference from the value in the model file."""
_SHARE_ERROR = "the {} {{place}} is {{percent}} {{larger}} than the model file states"
_DIFFERENCE_ERROR = "the {} {{place}} is {{size}} {{larger}} than the model file states"
"""Clauses on a value with a relative error, and with an absolute one; see `MODEL_FILE_ERRORS`."""
MODEL_FILE_ERRORS = {
    "mass.scale": _SHARE_ERROR.format("mass"),
    "inertia.scale": _SHARE_ERROR.format("inertia"),
    "actuator.stiffness": _SHARE_ERROR.format("stiffness"),
    "actuator.damping": _SHARE_ERROR.format("damping"),
    "inertia.armature": _DIFFERENCE_ERROR.format("armature"),
    "mass.offset": "the centre of mass {place} is {distance} from where the model file has it",
    "joint.zero": "the zero {place}, for commands and readings, is {size} from that of the model "
    "file",
    "joint.axis": "the axis {place} is tilted by {angle} from the model file",
    "link.length": "the distance {place} from its parent is {percent} {larger} than the model file "
    "states",
    "geom.radius": _SHARE_ERROR.format("radius"),
    "contact.friction": _DIFFERENCE_ERROR.format("friction coefficient"),
    "contact.softness": _SHARE_ERROR.format("time constant"),
    "contact.damping": _SHARE_ERROR.format("damping ratio"),
}
"""Clause on how wrong a value of the model file is, by effect.

Its fields are the place; the first coefficient in per cent or with its unit; the length of all
coefficients as a vector, with their unit or as an angle; and ``larger`` or ``smaller``.
"""
_STEP_ERROR_TEXTS = {
    "numerics.step": "the time step of the model file is too long",
    "numerics.integrator": "the integrator of the model file does not reproduce the recording",
    "numerics.cone": "the model file has another friction cone",
    "numerics.impratio": "the model file has another impedance ratio of friction",
    "numerics.noslip": "the model file has another number of iterations without slip",
    "numerics.solver": "the model file has another constraint solver",
    "numerics.iterations": "the model file has another number of iterations of the solver",
}
"""Description of wrong numerical settings of the model file; the cause names the correction."""
END_WORDS = {"low": "lower", "high": "upper"}
"""Adjectives of the bounds of a range."""
MAX_NAMED_MEMBERS = 6
"""Maximum number of members of a set that a sentence names; the remaining ones are counted."""
MAX_PLACE_CHARACTERS = 64
"""Maximum number of characters of a place's name in a list."""


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
    return kind if kind in _PLACE_WORDS else ""


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
    return bool(
        _WRONG_VALUE_NOUN.match((registered.noun_at_place if place else "") or registered.noun)
    )


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
    preposition, plural = _PLACE_WORDS.get(kind, ("at", "places"))
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


def shorten_effect_name(effect: str) -> str:
    """Format an effect for a list: without its article, and without the kind of its place.

    Args:
        effect: Name such as ``friction.coulomb@elbow``.

    Returns:
        Text such as "Coulomb friction at elbow".
    """
    effect_name, place = split_effect_name(effect)
    if not place:
        return format_effect_name(effect)
    place_text = (
        format_places(get_place_kind(effect), [place])
        if place == ALL_PLACES
        else f" at {sanitise(place, MAX_PLACE_CHARACTERS)}"
    )
    return format_effect_name(effect_name) + place_text


def format_effect_set(names: Sequence[str], conjunction: str = "or") -> str:
    """Format a set of effects.

    For example ``Coulomb friction at any of the joints a, b or c``, or ``linear drag or Coulomb
    friction at joint elbow``. Effects that differ only by their place form one part. Of more than
    `MAX_NAMED_MEMBERS` parts, the last ones are counted: ``one of 5 others``. If a part contains
    the conjunction itself, a comma precedes each conjunction between parts.

    Args:
        names: Names of the effects.
        conjunction: ``or`` if one of them is meant, ``and`` for all.
    """
    if not any("@" in name for name in names):
        return joined([format_effect(name) for name in names], conjunction)
    parts = _group_effects(names, conjunction)
    if len(parts) > MAX_NAMED_MEMBERS:
        # The last text counts the remaining parts.
        first_parts, other_parts = parts[: MAX_NAMED_MEMBERS - 1], parts[MAX_NAMED_MEMBERS - 1 :]
        parts = [*first_parts, f"one of {len(other_parts)} others"]
    is_nested = len(parts) > 1 and any(f" {conjunction} " in part for part in parts)
    return f", {conjunction} ".join(parts) if is_nested else joined(parts, conjunction)


def _group_effects(names: Sequence[str], conjunction: str) -> list[str]:
    """Group effects that share a name or a place, and format one text for each group.

    First the places of one effect are collected: ``drag at joints a and b``. Effects that then
    stand alone at the same place share a text: ``drag or friction at joint a``.

    Args:
        names: names of effects, with places such as ``drag.linear@elbow``.
        conjunction: ``and`` or ``or`` between nouns, and between places.
    """
    by_effect: dict[str, list[str]] = {}
    for name in names:
        base, _ = split_effect_name(name)
        by_effect.setdefault(base, []).append(name)
    by_place: dict[str, list[str]] = {}
    for group in by_effect.values():
        # An effect at all places (a family) comes last, after the single places.
        group.sort(key=lambda name: name.endswith(f"@{ALL_PLACES}"))
        first_name = group[0]
        _, place = split_effect_name(first_name)
        if len(group) == 1 and place not in ("", ALL_PLACES):
            # The effect has one place only: it shares a text with other such effects at this place.
            key = f"{get_place_kind(first_name)} {place}"
        else:
            # Several places, none or all: the effect has a text of its own.
            key = first_name
        by_place.setdefault(key, []).extend(group)
    return [_format_effect_group(group, conjunction) for group in by_place.values()]


def _format_effect_group(group: Sequence[str], conjunction: str) -> str:
    """Format effects of one name at several places, or several effects at one place.

    For example ``drag at joint a or b``. A family (all places, ``@*``) among single places comes
    last: ``drag at joint a or at every joint``.

    Args:
        group: names of the effects with their places, such as ``drag.linear@elbow``.
        conjunction: ``and`` or ``or`` between nouns, and between places.
    """
    if len(group) == 1:
        return format_effect(group[0])
    bases, places = zip(*map(split_effect_name, group), strict=True)
    effect_bases = dict.fromkeys(bases)
    nouns = [format_effect(base) for base in effect_bases]
    # A wrong value is one "of" a place; a missing effect is "at" a place.
    is_parameter = all(is_parameter_error(base) for base in effect_bases)
    kind = get_place_kind(group[0])
    named_places = [place for place in dict.fromkeys(places) if place != ALL_PLACES]
    text = joined(nouns, conjunction) + format_places(kind, named_places, conjunction, is_parameter)
    if ALL_PLACES in places:
        text += f" {conjunction}{format_places(kind, [ALL_PLACES], conjunction, is_parameter)}"
    return text


def describe_effect(causes: Sequence[Cause], name: str) -> str:
    """Return the description of an effect as a sentence; for a cause, the one in the verdict.

    It is empty for an effect that is not registered: one of a plugin that is not loaded, or a
    numerical setting such as the time step.

    Args:
        causes: Causes of the verdict.
        name: Name of the effect, with its place if it has one.
    """
    for cause in causes:
        if cause.effect == name:
            return format_sentence(strip_place(sanitise(cause.says, 400)))
    base, place = split_effect_name(name)
    try:
        effect = effects.get_effect(base)
    except InputError:
        return ""
    return format_sentence((effect.says_at_place if place else "") or effect.says)


def strip_place(description: str) -> str:
    """Remove the place in brackets from a description, because its noun names the place already."""
    return re.sub(r" \(at [^()]*\)$", "", description)


def format_causes(causes: Sequence[Cause]) -> str:
    """Format the causes; those with alternatives come last.

    For example ``wind, and linear drag or Coulomb friction``: wind is certain, and one of the other
    two, which the data cannot distinguish, is a cause.

    Args:
        causes: Causes of the verdict.
    """
    certain_names = [format_effect(cause.effect) for cause in causes if not cause.alternatives]
    parts = [joined(certain_names)] if certain_names else []
    parts += [format_effect_set([c.effect, *c.alternatives]) for c in causes if c.alternatives]
    return ", and ".join(parts)


def format_missing_causes(causes: Sequence[Cause], with_alternatives: bool = True) -> str:
    """Format what a simulation lacks and has wrong; causes with alternatives come last.

    For example ``lacks wind, and linear drag or Coulomb friction``. A missing effect is what a
    simulation "lacks", and a wrong value of the model file is what it "has". If a cause and its
    alternatives are of both kinds, the text is ``either lacks ... or has ...``.

    Args:
        causes: Causes.
        with_alternatives: Whether to name the alternatives of each cause.
    """
    if not with_alternatives:
        causes = [replace(cause, alternatives=()) for cause in causes]
    # Parts of the sentence by their verb.
    lacks, has, either = [], [], []
    # Causes without alternatives share one list with "and"; each other cause has a list with "or".
    certain = [cause.effect for cause in causes if not cause.alternatives]
    if missing_names := [name for name in certain if not is_parameter_error(name)]:
        lacks.append(joined([format_effect(name) for name in missing_names]))
    if wrong_names := [name for name in certain if is_parameter_error(name)]:
        has.append(joined([format_effect(name) for name in wrong_names]))
    for cause in causes:
        if not cause.alternatives:
            continue
        names = [cause.effect, *cause.alternatives]
        missing = format_effect_set([name for name in names if not is_parameter_error(name)])
        wrong = format_effect_set([name for name in names if is_parameter_error(name)])
        if wrong and missing:
            either.append(f"either lacks {missing} or has {wrong}")
        elif wrong:
            has.append(wrong)
        else:
            lacks.append(missing)
    parts = [
        f"{verb} {', and '.join(texts)}"
        for verb, texts in (("lacks", lacks), ("has", has))
        if texts
    ]
    return ", and ".join([*parts, *either])


def names_parameter_error(causes: Sequence[Cause]) -> bool:
    """Return whether a cause, or an alternative of one, is a wrong value of the model file."""
    return any(
        is_parameter_error(name) for cause in causes for name in (cause.effect, *cause.alternatives)
    )


def format_number_error(cause: Cause) -> str:
    """Format how wrong the model file is, as a clause; empty for causes that are no such error.

    There are three cases:

    1. A robot that compensates for gravity: the description of the cause.
    2. A numerical setting such as the time step: what is wrong, and the correction.
    3. A value at a place, by its effect: for example ``the mass of body forearm is 12 % larger
       than the model file states``.

    Args:
        cause: cause of the verdict, with its description and its fitted coefficients.
    """
    base, place = split_effect_name(cause.effect)
    if cause.says == GRAVITY_COMPENSATED:
        return sanitise(cause.says)
    if base in _STEP_ERROR_TEXTS:
        return f"{_STEP_ERROR_TEXTS[base]}: {sanitise(cause.says).rstrip('.')}"
    coefficients = list(cause.coefficients.values())
    if base not in MODEL_FILE_ERRORS or place in ("", ALL_PLACES) or not coefficients:
        return ""
    # The texts of scalar errors use the first coefficient, those of vectors the norm of all.
    first = coefficients[0]
    # Length of a displacement, or angle of a rotation vector in rad.
    norm = float(np.linalg.norm([coefficient.value for coefficient in coefficients]))
    return MODEL_FILE_ERRORS[base].format(
        place=format_places(get_place_kind(cause.effect), [place], is_parameter=True).strip(),
        percent=format_percent(abs(first.value)),
        size=append_unit(format_number(abs(first.value), 2), first.unit),
        distance=append_unit(format_number(norm, 2), first.unit),
        angle=f"{format_number(float(np.rad2deg(norm)), 2)}°",
        larger="larger" if first.value > 0 else "smaller",
    )


def is_overstated(cause: Cause) -> bool:
    """Return whether the model file has too much friction, damping or stiffness."""
    values = [n.value for n in cause.coefficients.values()]
    base, place = split_effect_name(cause.effect)
    return bool(place) and base in DIFFERENCE_EFFECTS and bool(values) and max(values) < 0


def format_cause_with_values(cause: Cause) -> str:
    """Format a cause with its registered name, those of its alternatives, and its values.

    For example ``drag.linear or friction.coulomb: coefficient 2.2×10⁻⁴ (2.0×10⁻⁴ to 2.4×10⁻⁴)
    N·s/m``.

    Args:
        cause: Cause with its coefficients.
    """
    effect_names = joined([cause.effect, *cause.alternatives], "or")
    numbers = [
        f"{name} {format_fitted_value(number)}" for name, number in cause.coefficients.items()
    ]
    return f"{effect_names}: {joined(numbers)}"


def format_values(cause: Cause) -> str:
    """Format the values of the coefficients of a cause in one line.

    If the cause is one effect at all joints or bodies (a family), each coefficient is followed by
    the joint or body at which it acts.

    Args:
        cause: Cause with its coefficients; those of a family are named ``COEFFICIENT@PLACE``.
    """
    texts = []
    for name, text in list_values(cause):
        coefficient, place = split_effect_name(name)
        # The default name "coefficient" says nothing if the place identifies the coefficient.
        prefix = "" if place and coefficient == "coefficient" else f"{coefficient} "
        texts.append(f"{prefix}{text}" + (f" at {place}" if place else ""))
    return joined(texts)


def list_values(cause: Cause) -> list[tuple[str, str]]:
    """List the coefficients of a cause as pairs of its name and its value with interval and unit.

    The list is empty for an option of the simulator that is a word, such as an integrator. A
    corrected time step was chosen and not estimated, so it has no interval.

    Args:
        cause: Cause with its coefficients by name.
    """
    if cause.effect in ("numerics.integrator", "numerics.cone", "numerics.solver"):
        return []
    if cause.effect == "numerics.step":
        steps = cause.coefficients.values()
        return [("time step", append_unit(format_number(step.value), step.unit)) for step in steps]
    return [
        (sanitise(name, 60), format_fitted_value(fitted))
        for name, fitted in cause.coefficients.items()
    ]


def format_coefficient_label(cause: Cause, effect: str, place: str) -> str:
    """Format the coefficient of a cause at a place for a label, such as ``: +12 %``.

    The text is empty if the cause has several coefficients there. A relative change of a value of
    the model file is given in percent, others with their unit.

    Args:
        cause: Cause with its coefficients.
        effect: Name of the effect, with its place.
        place: Place of the label, such as a joint.
    """
    at_place = []
    for name, fitted_value in cause.coefficients.items():
        _, coefficient_place = split_effect_name(name)
        if coefficient_place in ("", place):
            at_place.append(fitted_value)
    if len(at_place) != 1:
        return ""
    (fitted,) = at_place
    base, _ = split_effect_name(effect)
    if base in MODEL_FILE_ERRORS and fitted.unit == "1":
        sign = "+" if fitted.value > 0 else ""
        return f": {sign}{format_percent(fitted.value)}"
    return f": {append_unit(format_number(fitted.value, 2), fitted.unit)}"


def format_fitted_value(fitted: FittedValue) -> str:
    """Format a fitted number with its interval and unit, or the bound that it is at.

    If the number corrects one of the model file, the resulting number is added. If the value is
    outside its plausible range, this range is added.

    Args:
        fitted: Value with its interval and unit.
    """
    text = append_unit(format_estimate(fitted.value, fitted.low, fitted.high), fitted.unit)
    if fitted.at_bound is not None:
        text = format_value_at_bound(fitted.value, fitted.unit, fitted.at_bound)
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


def format_value_at_bound(value: float, unit: str, bound: str) -> str:
    """Format a value at a bound: ``4 s (upper bound of its range)``."""
    return f"{append_unit(format_number(value), unit)} ({END_WORDS[bound]} bound of its range)"


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
