"""Code of domain randomisation for Isaac Lab, by `simgap explain --ranges`.

The terms are functions of `isaaclab.envs.mdp` (source/isaaclab/isaaclab/envs/mdp/events.py of
isaac-sim/IsaacLab): `randomize_joint_parameters`, `randomize_actuator_gains`,
`randomize_rigid_body_mass`, `randomize_rigid_body_com`, `randomize_rigid_body_inertia` (since Isaac
Lab 3) and `randomize_physics_scene_gravity`. Isaac Lab defines stiffness and damping of a drive at
its joint. The gains of a servo are therefore multiplied by the square of its gear, and the damping
of the joint is added.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from bench.diagnosis.randomization_ranges import (
    RandomizationRange,
    RandomizationRanges,
    describe_ranges,
    list_heading,
)
from bench.pages.python_code import identifiers, literal, number, render_code
from sims.extended_simulator import ExtendedSimulator

RangesByEffect: TypeAlias = dict[str, dict[str, list[RandomizationRange]]]
"""Ranges by effect, then by joint, body or actuator."""
_TEMPLATE = Path(__file__).with_name("ranges_isaac_lab.py.jinja")
FRICTION_NOTE = (
    "On PhysX this term draws static, dynamic and viscous friction of the joint from one range; "
    "set the viscous friction of the joint again if you use it."
)
DAMPING_NOTE = (
    "Damping of the drive at the joint: what the model file states as damping of the joint, plus "
    "the damping of its servos."
)
AXES = "xyz"
STIFFNESS_COLUMN, DAMPING_COLUMN = 1, 2
"""Columns of MuJoCo's `actuator_biasprm` with the negative gains of a servo."""


class Term(NamedTuple):
    """Event term: its name, function and parameters as code, and comments before it."""

    name: str
    function: str
    params: Mapping[str, str]
    comments: Sequence[str]


def render_isaac_lab_code(
    ranges: RandomizationRanges, extended: ExtendedSimulator, robot: Any
) -> str:
    """Return a Python file with a configuration class of event terms for Isaac Lab.

    An event term is a call of an Isaac Lab function that randomises numbers of the robot.

    Args:
        ranges: Ranges to write.
        extended: Extended simulator with the numbers.
        robot: Robot with its compiled model.
    """
    sentences = dict(describe_ranges(ranges))
    terms, missing = _build_terms(ranges, sentences, robot)
    return render_code(
        _TEMPLATE,
        heading=list_heading(extended, "Isaac Lab", ranges.left_out),
        terms=list(zip(identifiers(term.name for term in terms), terms, strict=True)),
        missing=[f"- {sentences[number_range]}" for number_range in missing],
    )


def _build_terms(
    ranges: RandomizationRanges, sentences: Mapping[RandomizationRange, str], robot: Any
) -> tuple[list[Term], list[RandomizationRange]]:
    """Build the Isaac Lab event terms, and list the ranges for which Isaac Lab has no term.

    A term is a call of a randomisation function for one joint or body. The effects are handled one
    after another; ranges that remain in `by_effect` have no term.

    1. Friction and armature of joints.
    2. Stiffness and damping of drives.
    3. Mass, centre of mass and inertia of bodies.
    4. Gravity.

    Args:
        ranges: ranges to write.
        sentences: comment for each range.
        robot: model of the robot.

    Returns:
        The terms, and the ranges without a term.
    """
    # Ranges by effect, then by the name of their joint, body or actuator.
    by_effect: RangesByEffect = {}
    for number_range in ranges.ranges:
        by_effect.setdefault(number_range.effect, {}).setdefault(number_range.name, []).append(
            number_range
        )
    terms: list[Term] = []
    # 1. Joints.
    terms += _make_joint_terms(by_effect, sentences)
    # 2. Drives.
    terms += _make_gain_terms(by_effect, sentences, robot)
    # 3. Bodies.
    terms += _make_body_terms(by_effect, sentences)
    # 4. Gravity.
    terms += _make_gravity_term(by_effect, sentences, robot)
    # Each of these has removed its ranges; the others have no term.
    without_term = [
        number_range
        for ranges_by_place in by_effect.values()
        for ranges_at_place in ranges_by_place.values()
        for number_range in ranges_at_place
    ]
    return terms, without_term


def _make_joint_terms(
    by_effect: RangesByEffect,
    sentences: Mapping[RandomizationRange, str],
) -> Iterator[Term]:
    """Yield the terms that randomise dry friction and armature of each joint.

    Args:
        by_effect: ranges by effect and by joint; those that are used are removed.
        sentences: comment for each range.
    """
    for effect, key, further_notes in (
        ("friction.coulomb", "friction_distribution_params", [FRICTION_NOTE]),
        ("inertia.armature", "armature_distribution_params", []),
    ):
        # These effects have one coefficient, and so one range at each joint.
        for joint, (number_range,) in by_effect.pop(effect, {}).items():
            yield _build_joint_term(
                number_range.field,
                joint,
                "randomize_joint_parameters",
                key,
                _get_ends(number_range),
                [sentences[number_range], *further_notes],
            )


def _make_body_terms(
    by_effect: RangesByEffect,
    sentences: Mapping[RandomizationRange, str],
) -> Iterator[Term]:
    """Yield the terms that randomise mass, centre of mass and inertia of each body.

    Args:
        by_effect: ranges by effect and by body; those that are used are removed.
        sentences: comment for each range.
    """
    # The effect on the mass has one coefficient, and so one range for each body.
    for name, (number_range,) in by_effect.pop("mass.scale", {}).items():
        params = {
            "mass_distribution_params": _format_pair(*_get_ends(number_range)),
            "operation": '"abs"',
        }
        if name in by_effect.get("inertia.scale", {}):
            # The range of the inertia already includes the scaling by the mass.
            params["recompute_inertia"] = "False"
        yield _build_body_term(
            "body_mass", name, "randomize_rigid_body_mass", params, [sentences[number_range]]
        )
    # The centre of mass has a range for each coordinate.
    for name, offsets in by_effect.pop("mass.offset", {}).items():
        pairs = [
            f'"{offset.coefficient}": {_format_pair(offset.minimum, offset.maximum)}'
            for offset in offsets
        ]
        params = {"com_range": "{" + ", ".join(pairs) + "}"}
        notes = [sentences[number_range] for number_range in offsets]
        yield _build_body_term("body_ipos", name, "randomize_rigid_body_com", params, notes)
    # The inertia has one range for each body: a factor, while the range of a mass is a value in kg.
    for name, (number_range,) in by_effect.pop("inertia.scale", {}).items():
        params = {
            "inertia_distribution_params": _format_pair(number_range.minimum, number_range.maximum),
            "operation": '"scale"',
            "diagonal_only": "False",
        }
        notes = [sentences[number_range], "This term exists since Isaac Lab 3."]
        function = "randomize_rigid_body_inertia"
        yield _build_body_term("body_inertia", name, function, params, notes)


def _make_gain_terms(
    by_effect: RangesByEffect,
    sentences: Mapping[RandomizationRange, str],
    robot: Any,
) -> Iterator[Term]:
    """Yield the terms that randomise stiffness and damping of the actuators at each joint.

    Isaac Lab defines the gains of a drive at its joint, so gains of all actuators of a joint are
    converted by their gear and added. It has one damping for each joint, so that of actuators and
    of the joint itself is added. A gain without a range has the value of the model file.

    Args:
        by_effect: ranges by effect and by place; those that are used are removed.
        sentences: comment for each range.
        robot: model of the robot.
    """
    stiffness = by_effect.pop("actuator.stiffness", {})
    damping = by_effect.pop("actuator.damping", {})
    passive_damping = by_effect.pop("drag.linear", {})
    function = "randomize_actuator_gains"
    # Stiffness. The interval of the joint is the sum of those of its actuators.
    for joint, actuators in _group_by_joint(robot, stiffness).items():
        gains = [
            _convert_gain_to_joint(robot, stiffness, name, STIFFNESS_COLUMN) for name in actuators
        ]
        ranges = [number_range for name in actuators for number_range in stiffness.get(name, ())]
        notes = [sentences[number_range] for number_range in ranges]
        key = "stiffness_distribution_params"
        yield _build_joint_term("stiffness", joint, function, key, _sum_ranges(gains), notes)
    # Damping.
    for joint in dict.fromkeys([*passive_damping, *_group_by_joint(robot, damping)]):
        actuators = [actuator.name for actuator in robot.actuators if actuator.joint == joint]
        gains = [_convert_gain_to_joint(robot, damping, name, DAMPING_COLUMN) for name in actuators]
        # Damping of the joint itself.
        joint_ranges = passive_damping.get(joint, [])
        if joint_ranges:
            gains.append(_get_ends(joint_ranges[0]))
        else:
            damping_in_file = float(robot.compiled.dof_damping[robot.joint(joint).velocity])
            gains.append((damping_in_file, damping_in_file))
        ranges = [number_range for name in actuators for number_range in damping.get(name, ())]
        notes = [sentences[number_range] for number_range in (*joint_ranges, *ranges)]
        key = "damping_distribution_params"
        yield _build_joint_term(
            "damping", joint, function, key, _sum_ranges(gains), [*notes, DAMPING_NOTE]
        )


def _group_by_joint(robot: Any, ranges: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return all actuators of each joint at which one of the given actuators acts.

    Args:
        robot: model of the robot.
        ranges: anything by the name of an actuator; only the names count.
    """
    # An actuator may drive no joint but a site or a tendon.
    joints = dict.fromkeys(robot.actuator(name).joint for name in ranges)
    return {
        joint: [actuator.name for actuator in robot.actuators if actuator.joint == joint]
        for joint in joints
        if joint
    }


def _convert_gain_to_joint(
    robot: Any, ranges: Mapping[str, Sequence[RandomizationRange]], name: str, bias_column: int
) -> tuple[float, float]:
    """Return the interval of an actuator's gain at its joint: multiplied by the gear ratio squared.

    The gear converts the joint's motion to that of the actuator, and its force back.

    Args:
        robot: model of the robot.
        ranges: ranges by the name of the actuator; without one, the interval is the gain of the
            file.
        name: name of the actuator.
        bias_column: `STIFFNESS_COLUMN` or `DAMPING_COLUMN`.
    """
    actuator_id = robot.actuator(name).id
    squared_gear = float(robot.compiled.actuator_gear[actuator_id, 0]) ** 2
    if name in ranges:
        low, high = _get_ends(ranges[name][0])
        return squared_gear * low, squared_gear * high
    # MuJoCo stores the negative gain.
    gain_in_file = -squared_gear * float(robot.compiled.actuator_biasprm[actuator_id, bias_column])
    return gain_in_file, gain_in_file


def _make_gravity_term(
    by_effect: RangesByEffect,
    sentences: Mapping[RandomizationRange, str],
    robot: Any,
) -> Iterator[Term]:
    """Yield the term that randomises the gravity vector, if its size or direction has a range.

    Isaac Lab draws each component of the vector from its own interval. A range of the size scales
    all components; a range of the tilt gives a component its own interval instead. Components
    without a range keep the value of the model file.

    Args:
        by_effect: ranges by effect and by place; those of gravity are removed.
        sentences: comment for each range.
        robot: model of the robot.
    """
    scale, tilt = (
        list(chain.from_iterable(by_effect.pop(effect, {}).values()))
        for effect in ("gravity.scale", "gravity.tilt")
    )
    if not scale and not tilt:
        return
    gravity_in_file = np.asarray(robot.compiled.opt.gravity, dtype=float)
    low, high = gravity_in_file.copy(), gravity_in_file.copy()
    for number_range in scale:
        ends = number_range.minimum * gravity_in_file, number_range.maximum * gravity_in_file
        # A negative component has its ends in the other order.
        low, high = np.minimum(*ends), np.maximum(*ends)
    for number_range in tilt:
        axis = AXES.index(number_range.coefficient)
        low[axis], high[axis] = number_range.low, number_range.high
    vectors = [f"[{', '.join(number(value) for value in end)}]" for end in (low, high)]
    params = {
        "gravity_distribution_params": f"({', '.join(vectors)})",
        "operation": '"abs"',
    }
    notes = [sentences[number_range] for number_range in (*scale, *tilt)]
    yield Term("gravity", "randomize_physics_scene_gravity", params, notes)


def _build_joint_term(
    prefix: str,
    joint: str,
    function: str,
    key: str,
    ends: tuple[float, float],
    notes: Sequence[str],
) -> Term:
    """Build an Isaac Lab event term that sets a parameter of a joint to a uniform random value.

    Args:
        prefix: First part of the name of the term.
        joint: Name of the joint.
        function: Isaac Lab function that sets the parameter.
        key: Name of the function's argument for the range.
        ends: Minimum and maximum of the range.
        notes: Comments above the term.
    """
    params = {
        "asset_cfg": _format_asset("joint_names", joint),
        key: _format_pair(*ends),
        "operation": '"abs"',
        "distribution": '"uniform"',
    }
    return Term(f"{prefix}_{joint}", function, params, notes)


def _build_body_term(
    prefix: str, body: str, function: str, params: Mapping[str, str], notes: Sequence[str]
) -> Term:
    """Build an Isaac Lab event term that calls a function for one body of the robot.

    Args:
        prefix: first part of the name of the term.
        body: name of the body.
        function: Isaac Lab function to call.
        params: Python code of each further argument, by its name.
        notes: comments above the term.
    """
    return Term(
        f"{prefix}_{body}",
        function,
        {"asset_cfg": _format_asset("body_names", body), **params},
        notes,
    )


def _format_asset(key: str, name: str) -> str:
    """Format the asset with one joint or body; Isaac Lab reads names as regular expressions.

    Args:
        key: kind of the name in Isaac Lab, such as ``joint_names``.
        name: name of the joint or body.
    """
    return f'SceneEntityCfg("robot", {key}=[{literal(re.escape(name))}])'


def _get_ends(number_range: RandomizationRange) -> tuple[float, float]:
    return number_range.low, number_range.high


def _sum_ranges(parts: Sequence[tuple[float, float]]) -> tuple[float, float]:
    return sum(low for low, _ in parts), sum(high for _, high in parts)


def _format_pair(low: float, high: float) -> str:
    """Format the ends of a range as a Python tuple.

    Args:
        low: lower end.
        high: upper end.
    """
    return f"({number(low)}, {number(high)})"
