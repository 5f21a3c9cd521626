"""Text of causes and their places, and the order in which candidates are shown."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from bench.diagnosis.report.effect_and_unit_text import (
    ALL_PLACES,
    append_unit,
    format_effect,
    format_effect_name,
    format_fitted_value,
    format_number,
    format_percent,
    format_places,
    get_place_kind,
    is_parameter_error,
    joined,
    sanitise,
    split_effect_name,
)
from bench.diagnosis.report.report_data import DiagnosisReportData
from bench.diagnosis.verdict import Candidate, Cause
from bench.figures.robot_figure import PlaceMark
from sims.robot.fitted_causes import GRAVITY_COMPENSATED

MAX_NAMED_MEMBERS = 6
"""Maximum number of members of a set that a sentence names; the remaining ones are counted."""
DIFFERENCE_EFFECTS = frozenset(
    {"drag.linear", "drag.quadratic", "friction.coulomb", "spring.linear"}
)
"""Effects whose coefficient is a difference from the value in the model file."""


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
        parts = [
            *parts[: MAX_NAMED_MEMBERS - 1],
            f"one of {len(parts) - MAX_NAMED_MEMBERS + 1} others",
        ]
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
        base, place = split_effect_name(name)
        by_effect.setdefault(base if place else name, []).append(name)
    by_place: dict[str, list[str]] = {}
    for group in by_effect.values():
        _, place = split_effect_name(group[0])
        is_single_place = len(group) == 1 and place not in ("", ALL_PLACES)
        # A family comes last, after the single places.
        group.sort(key=lambda name: split_effect_name(name)[1] == ALL_PLACES)
        key = f"{get_place_kind(group[0])} {place}" if is_single_place else group[0]
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
    bases = list(dict.fromkeys(split_effect_name(name)[0] for name in group))
    places = list(dict.fromkeys(split_effect_name(name)[1] for name in group))
    nouns = [format_effect(base) for base in bases]
    is_parameter = all(is_parameter_error(base) for base in bases)
    kind = get_place_kind(group[0])
    named_places = [place for place in places if place != ALL_PLACES]
    text = joined(nouns, conjunction) + format_places(kind, named_places, conjunction, is_parameter)
    return (
        text
        if named_places == places
        else f"{text} {conjunction}{format_places(kind, [ALL_PLACES], conjunction, is_parameter)}"
    )


def format_missing_causes(causes: Sequence[Cause], with_alternatives: bool = True) -> str:
    """Format what a simulation lacks and has wrong; causes with alternatives come last.

    For example ``lacks wind, and linear drag or Coulomb friction``. Some causes are missing
    effects, others are wrong values of the model file; if the alternatives of a cause are of both
    kinds, the text is ``either lacks ... or has ...``.

    Args:
        causes: Causes.
        with_alternatives: Whether to name the alternatives of each cause.
    """
    if not with_alternatives:
        causes = [replace(cause, alternatives=()) for cause in causes]
    texts: dict[str, list[str]] = {"lacks": [], "has": [], "either": []}
    certain = [cause.effect for cause in causes if not cause.alternatives]
    # Causes without alternatives share one list; each other cause has its own "or" list.
    for verb, is_wrong in (("lacks", False), ("has", True)):
        if names := [name for name in certain if is_parameter_error(name) == is_wrong]:
            texts[verb].append(joined([format_effect(name) for name in names]))
    for cause in causes:
        names = [cause.effect, *cause.alternatives] if cause.alternatives else []
        wrong = format_effect_set([name for name in names if is_parameter_error(name)])
        missing = format_effect_set([name for name in names if not is_parameter_error(name)])
        if wrong and missing:
            texts["either"].append(f"either lacks {missing} or has {wrong}")
        elif names:
            texts["has" if wrong else "lacks"].append(wrong or missing)
    parts = [f"{verb} {', and '.join(texts[verb])}" for verb in ("lacks", "has") if texts[verb]]
    return ", and ".join([*parts, *texts["either"]])


def names_parameter_error(causes: Sequence[Cause]) -> bool:
    """Return whether a cause, or an alternative of one, is a wrong value of the model file."""
    return any(
        is_parameter_error(name) for cause in causes for name in (cause.effect, *cause.alternatives)
    )


def format_causes(causes: Sequence[Cause]) -> str:
    """Format the causes; those with alternatives come last.

    For example ``wind, and linear drag or Coulomb friction``.
    """
    certain_names = [format_effect(cause.effect) for cause in causes if not cause.alternatives]
    parts = [joined(certain_names)] if certain_names else []
    parts += [format_effect_set([c.effect, *c.alternatives]) for c in causes if c.alternatives]
    return ", and ".join(parts)


def format_number_error(cause: Cause) -> str:
    """Format how wrong a value of the model file is, as a clause; empty for other causes.

    For example ``the mass of body forearm is 12 % larger than the model file states``. A clause
    about the time step, or gravity compensation, is returned too.
    """
    base, place = split_effect_name(cause.effect)
    if cause.says == GRAVITY_COMPENSATED:
        return sanitise(cause.says)
    if base in _STEP_ERROR_TEXTS:
        return f"{_STEP_ERROR_TEXTS[base]}: {sanitise(cause.says).rstrip('.')}"
    values = list(cause.coefficients.values())
    if base not in _MODEL_FILE_ERRORS or not place or place == ALL_PLACES or not values:
        return ""
    first, norm = values[0], float(np.linalg.norm([n.value for n in values]))
    return _MODEL_FILE_ERRORS[base].format(
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


_SHARE = "the {} {{place}} is {{percent}} {{larger}} than the model file states"
_DIFFERENCE = "the {} {{place}} is {{size}} {{larger}} than the model file states"
_MODEL_FILE_ERRORS = {
    "mass.scale": _SHARE.format("mass"),
    "inertia.scale": _SHARE.format("inertia"),
    "actuator.stiffness": _SHARE.format("stiffness"),
    "actuator.damping": _SHARE.format("damping"),
    "inertia.armature": _DIFFERENCE.format("armature"),
    "mass.offset": "the centre of mass {place} is {distance} from where the model file has it",
    "joint.zero": "the zero {place}, for commands and readings, is {size} from that of the model "
    "file",
    "joint.axis": "the axis {place} is tilted by {angle} from the model file",
    "link.length": "the distance {place} from its parent is {percent} {larger} than the model file "
    "states",
    "geom.radius": _SHARE.format("radius"),
    "contact.friction": _DIFFERENCE.format("friction coefficient"),
    "contact.softness": _SHARE.format("time constant"),
    "contact.damping": _SHARE.format("damping ratio"),
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


def list_values(cause: Cause) -> list[tuple[str, str]]:
    """List the coefficients of a cause by name, with their intervals and units.

    The list is empty for a chosen option of the integrator, which is a word and not an estimate.
    """
    # The corrected step was chosen, not estimated, and some options are words.
    if cause.effect in ("numerics.integrator", "numerics.cone", "numerics.solver"):
        return []
    if cause.effect == "numerics.step":
        steps = cause.coefficients.values()
        return [("time step", append_unit(format_number(step.value), step.unit)) for step in steps]
    return [
        (sanitise(name, 60), format_fitted_value(fitted))
        for name, fitted in cause.coefficients.items()
    ]


def format_values(cause: Cause) -> str:
    """Format the coefficients of a cause in one line.

    If the cause is one effect at all joints or bodies (a family), each coefficient is followed by
    the joint or body at which it acts.
    """
    texts = []
    for name, text in list_values(cause):
        coefficient, place = split_effect_name(name)
        # If each member of a family has one coefficient, its place identifies it.
        prefix = "" if place and coefficient == "coefficient" else f"{coefficient} "
        texts.append(f"{prefix}{text}" + (f" at {place}" if place else ""))
    return joined(texts)


def strip_place(description: str) -> str:
    """Remove the place in brackets from a description, because its noun names the place already."""
    return re.sub(r" \(at [^()]*\)$", "", description)


def has_placed_causes(report: DiagnosisReportData) -> bool:
    """Return whether any candidate acts at a place."""
    return any("@" in candidate.effect for candidate in report.verdict.candidates)


def list_place_marks(report: DiagnosisReportData) -> list[PlaceMark]:
    """List the diagnosed places, to be marked on the drawing of the robot.

    Args:
        report: Data of the report.

    Returns:
        One mark per place; alternatives of a cause are marked, too.
    """
    marks: dict[tuple[str, str, str], PlaceMark] = {}
    for cause in report.verdict.causes:
        is_certain = not cause.alternatives
        for name in (cause.effect, *cause.alternatives):
            noun, kind = format_effect_name(split_effect_name(name)[0]), get_place_kind(name)
            for place in _list_places(report, name, cause):
                # The coefficients are those of the cause, not of its alternatives.
                size = _format_coefficient(cause, name, place) if name == cause.effect else ""
                # A family and one of its places give the same mark, which is kept once.
                marks.setdefault(
                    (kind, place, noun), PlaceMark(kind, place, f"{noun}{size}", is_certain)
                )
    return list(marks.values())


def _list_places(report: DiagnosisReportData, effect: str, cause: Cause) -> list[str]:
    """List the places at which an effect acts, for marks on the drawing of the robot.

    An effect at all places (``@*``) has those of its coefficients; if these name none, it has all
    joints, actuators or bodies of the robot.

    Args:
        report: content of the report, with the robot.
        effect: name of the effect, with its place.
        cause: the cause, whose coefficients may be named by places.
    """
    _, place = split_effect_name(effect)
    if place != ALL_PLACES:
        return [place] if place else []
    coefficient_places = [
        split_effect_name(name)[1] for name in cause.coefficients if effect == cause.effect
    ]
    robot = report.robot
    if any(coefficient_places) or robot is None:
        return list(dict.fromkeys(name for name in coefficient_places if name))
    tables = {
        "joint": [joint.name for joint in robot.joints],
        "actuator": [actuator.name for actuator in robot.actuators],
        "body": [body.name for body in robot.bodies],
    }
    return tables.get(get_place_kind(effect), [])


def _format_coefficient(cause: Cause, effect: str, place: str) -> str:
    """Format the coefficient of a cause at a place for a label; empty for several coefficients.

    Args:
        cause: the cause with its coefficients.
        effect: name of the effect, with its place.
        place: place of the label, such as a joint.
    """
    at_place = [
        n for name, n in cause.coefficients.items() if split_effect_name(name)[1] in ("", place)
    ]
    if len(at_place) != 1:
        return ""
    fitted = at_place[0]
    if split_effect_name(effect)[0] in _MODEL_FILE_ERRORS and fitted.unit == "1":
        sign = "+" if fitted.value > 0 else ""
        return f": {sign}{format_percent(fitted.value)}"
    return f": {append_unit(format_number(fitted.value, 2), fitted.unit)}"


MAX_SHOWN_CANDIDATES = 12
"""Maximum number of candidates that a figure shows."""
MIN_FAMILY_SCORE_RATIO = 1.3
"""Minimum ratio of a family's score to that of its best place for the family to represent the
effect.
"""


class RankedCandidate(NamedTuple):
    """Candidate that represents its effect, and the other places of that effect, best first."""

    best: Candidate
    elsewhere: tuple[Candidate, ...] = ()


def get_candidate_status(report: DiagnosisReportData, effect: str) -> str:
    """Return the status of an effect: found, found but indistinguishable, or not needed.

    Args:
        report: Report data.
        effect: Name of the effect, with its place on a robot: ``drag.linear@elbow``.
    """
    for cause in report.verdict.causes:
        if effect in (cause.effect, *cause.alternatives):
            return "found, but not distinguishable" if cause.alternatives else "found"
    return "not needed"


def rank_candidates(report: DiagnosisReportData) -> list[RankedCandidate]:
    """List all candidates as entries, the highest score first.

    If effects act at places, such as joints, an effect would appear once for each of them. So it is
    one entry: its best place, with the others in `elsewhere`. Each diagnosed cause has its own
    entry.

    Args:
        report: Data of the report.
    """
    ordered_candidates = sorted(report.verdict.candidates, key=lambda c: c.score, reverse=True)
    if not has_placed_causes(report):
        return [RankedCandidate(candidate) for candidate in ordered_candidates]
    causes = {cause.effect for cause in report.verdict.causes}
    groups: dict[str, list[Candidate]] = {}
    for candidate in ordered_candidates:
        groups.setdefault(split_effect_name(candidate.effect)[0], []).append(candidate)
    entries = []
    for group in groups.values():
        # A diagnosed cause represents its effect even if another place has a higher score.
        heads = [c for c in group if c.effect in causes] or [_choose_representative(group)]
        other_members = tuple(c for c in group if c not in heads)
        entries += [
            RankedCandidate(heads[0], other_members),
            *(RankedCandidate(head) for head in heads[1:]),
        ]
    return sorted(entries, key=lambda entry: entry.best.score, reverse=True)


def _choose_representative(group: list[Candidate]) -> Candidate:
    """Return the best place, unless the family explains much more; it explains at least as much."""
    best_place = next((c for c in group if split_effect_name(c.effect)[1] != ALL_PLACES), group[0])
    return (
        best_place
        if group[0].score < MIN_FAMILY_SCORE_RATIO * max(best_place.score, 1.0)
        else group[0]
    )


def select_shown_candidates(report: DiagnosisReportData) -> list[Candidate]:
    """Select the candidates to show, the highest score first; diagnosed causes are included.

    At most `MAX_SHOWN_CANDIDATES` are shown, unless there are more causes: candidates that are not
    needed are left out, those with the lowest scores first.
    """
    ordered_candidates = [entry.best for entry in rank_candidates(report)]
    # A diagnosed cause is shown even with a low score.
    unneeded_candidates = [
        c for c in ordered_candidates if get_candidate_status(report, c.effect) == "not needed"
    ]
    hidden_candidates = unneeded_candidates[
        max(0, MAX_SHOWN_CANDIDATES - len(ordered_candidates) + len(unneeded_candidates)) :
    ]
    return [c for c in ordered_candidates if c not in hidden_candidates]


LONGEST_PLACE = 64
"""Maximum number of characters of a place's name in a list."""


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
        else f" at {sanitise(place, LONGEST_PLACE)}"
    )
    return format_effect_name(effect_name) + place_text
