"""Places of a robot that a diagnosis names: marks for its drawing, and their joints."""

from __future__ import annotations

from bench.diagnosis.report.cause_and_value_text import (
    ALL_PLACES,
    QUANTITY_LABELS,
    format_coefficient_label,
    format_effect_name,
    get_place_kind,
    sanitise,
    split_effect_name,
)
from bench.diagnosis.report.report_data import DiagnosisReportData
from bench.diagnosis.verdict import Cause
from bench.figures.robot_figure import PlaceMark


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
            base, _ = split_effect_name(name)
            noun, kind = format_effect_name(base), get_place_kind(name)
            for place in _list_places(report, name, cause):
                # The coefficients are those of the cause, not of its alternatives.
                size = format_coefficient_label(cause, name, place) if name == cause.effect else ""
                mark = PlaceMark(kind, place, f"{noun}{size}", is_certain)
                # An effect at all places and one of its places give the same mark.
                marks.setdefault((kind, place, noun), mark)
    return list(marks.values())


def _list_places(report: DiagnosisReportData, effect: str, cause: Cause) -> list[str]:
    """List the places at which an effect acts, for marks on the drawing of the robot.

    1. An effect at one place has this place, and an effect on the environment has none.
    2. An effect at all places (``@*``) has those that its coefficients name.
    3. If they name none, it has all joints, actuators or bodies of the robot.

    Args:
        report: content of the report, with the robot.
        effect: name of the effect, with its place: the cause, or one of its alternatives.
        cause: the cause, whose coefficients may be named ``COEFFICIENT@PLACE``.
    """
    # 1. One place.
    _, place = split_effect_name(effect)
    if place != ALL_PLACES:
        return [place] if place else []
    # 2. Places of coefficients, which an alternative does not have.
    coefficient_names = cause.coefficients if effect == cause.effect else ()
    places = [place for _, place in map(split_effect_name, coefficient_names) if place]
    robot = report.robot
    if places or robot is None:
        return list(dict.fromkeys(places))
    # 3. All places.
    tables = {
        "joint": [joint.name for joint in robot.joints],
        "actuator": [actuator.name for actuator in robot.actuators],
        "body": [body.name for body in robot.bodies],
    }
    return tables.get(get_place_kind(effect), [])


def find_joint(report: DiagnosisReportData, kind: str, place: str) -> str:
    """Return the joint that a place belongs to; empty if there is none.

    A joint belongs to itself, a channel to the joint it measures, an actuator to the joint it
    drives, and a body to the joint that moves it. A channel of a sensor counts as a joint, because
    it has its own row in the figures.

    Args:
        report: Report data.
        kind: Kind of the place: joint, channel, actuator or body.
        place: Name of the place.
    """
    robot = report.robot
    if kind == "joint":
        return "" if place == ALL_PLACES else sanitise(place, 40)
    if kind == "channel":
        quantity, _, joint = place.partition(".")
        return sanitise(joint if quantity in QUANTITY_LABELS and joint else place, 40)
    if robot is None:
        return ""
    if kind == "actuator":
        return next((sanitise(a.joint or "", 40) for a in robot.actuators if a.name == place), "")
    if kind == "body":
        body_ids = {body.id for body in robot.bodies if body.name == place}
        joints = [j.name for j in robot.joints if int(robot.compiled.jnt_bodyid[j.id]) in body_ids]
        return sanitise(joints[0], 40) if joints else ""
    return ""


def list_marked_joints(report: DiagnosisReportData) -> set[str]:
    """Return the joints of the channels, actuators and bodies in the diagnosis."""
    return {find_joint(report, mark.kind, mark.name) for mark in list_place_marks(report)}
