"""Ranges as event terms of Isaac Lab.

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
from typing import Any, NamedTuple

import numpy as np

from bench.diagnosis.randomization.code_text import (
    identifiers,
    list_heading,
    literal,
    number,
    render_code,
)
from bench.diagnosis.randomization.ranges import RandomizationRange, RandomizationRanges, texts
from sims.extended_simulator import ExtendedSimulator

FRICTION_NOTE = (
    "On PhysX this term draws static, dynamic and viscous friction of the joint from one range; "
    "set the viscous friction of the joint again if you use it."
)
DAMPING_NOTE = (
    "Damping of the drive at the joint: what the model file states as damping of the joint, plus "
    "the damping of its servos."
)
AXES = "xyz"


class Term(NamedTuple):
    """Event term: its name, function and parameters as code, and comments before it."""

    name: str
    function: str
    params: Mapping[str, str]
    comments: Sequence[str]


def render_isaac_lab_code(
    ranges: RandomizationRanges, extended: ExtendedSimulator, robot: Any
) -> str:
    """Return a Python file with a configclass of event terms.

    Args:
        ranges: Ranges to write.
        extended: Extended simulator with the numbers.
        robot: Robot with its compiled model.
    """
    sentences = dict(texts(ranges))
    terms, missing = _build_terms(ranges, sentences, robot)
    return render_code(
        "ranges_isaac_lab.py",
        heading=list_heading(extended, "Isaac Lab", ranges.left_out),
        terms=list(zip(identifiers(term.name for term in terms), terms, strict=True)),
        missing=[f"- {sentences[entry]}" for entry in missing],
    )


def _build_terms(
    ranges: RandomizationRanges, sentences: Mapping[RandomizationRange, str], robot: Any
) -> tuple[list[Term], list[RandomizationRange]]:
    """Build the Isaac Lab event terms, and list the ranges for which Isaac Lab has no term.

    `sentences` has the comment for each range.
    """
    by_effect: dict[str, dict[str, list[RandomizationRange]]] = {}
    for entry in ranges.ranges:
        by_effect.setdefault(entry.effect, {}).setdefault(entry.name, []).append(entry)
    terms: list[Term] = []
    for effect, function, key in (
        ("friction.coulomb", "randomize_joint_parameters", "friction_distribution_params"),
        ("inertia.armature", "randomize_joint_parameters", "armature_distribution_params"),
    ):
        for name, (entry,) in by_effect.pop(effect, {}).items():
            notes = [FRICTION_NOTE] if effect == "friction.coulomb" else []
            terms.append(
                _build_joint_term(
                    entry.field, name, function, key, _get_ends(entry), [sentences[entry], *notes]
                )
            )
    terms += _make_gain_terms(by_effect, sentences, robot)
    for name, (entry,) in by_effect.pop("mass.scale", {}).items():
        params = {"mass_distribution_params": _format_pair(*_get_ends(entry)), "operation": '"abs"'}
        if name in by_effect.get("inertia.scale", {}):
            # The range of the inertia already includes the scaling by the mass.
            params["recompute_inertia"] = "False"
        terms.append(
            _build_body_term(
                "body_mass", name, "randomize_rigid_body_mass", params, [sentences[entry]]
            )
        )
    for name, offsets in by_effect.pop("mass.offset", {}).items():
        pairs = [
            f'"{entry.coefficient}": {_format_pair(entry.minimum, entry.maximum)}'
            for entry in offsets
        ]
        params = {"com_range": "{" + ", ".join(pairs) + "}"}
        notes = [sentences[entry] for entry in offsets]
        terms.append(_build_body_term("body_ipos", name, "randomize_rigid_body_com", params, notes))
    for name, (entry,) in by_effect.pop("inertia.scale", {}).items():
        params = {
            "inertia_distribution_params": _format_pair(entry.minimum, entry.maximum),
            "operation": '"scale"',
            "diagonal_only": "False",
        }
        notes = [sentences[entry], "This term exists since Isaac Lab 3."]
        function = "randomize_rigid_body_inertia"
        terms.append(_build_body_term("body_inertia", name, function, params, notes))
    terms += _make_gravity_term(by_effect, sentences, robot)
    return terms, [
        entry
        for ranges_by_place in by_effect.values()
        for by_place in ranges_by_place.values()
        for entry in by_place
    ]


def _make_gain_terms(
    by_effect: dict[str, dict[str, list[RandomizationRange]]],
    sentences: Mapping[RandomizationRange, str],
    robot: Any,
) -> Iterator[Term]:
    """Yield the terms that randomise stiffness and damping of the actuators at each joint.

    Isaac Lab has one damping for each joint, so that of actuators and of the joint itself is added.
    """
    stiffness = by_effect.pop("actuator.stiffness", {})
    damping = by_effect.pop("actuator.damping", {})
    passive = by_effect.pop("drag.linear", {})
    function = "randomize_actuator_gains"
    for joint, actuators in _group_by_joint(robot, stiffness).items():
        ends = _sum_ranges(
            [_convert_gain_to_joint(robot, stiffness, name, 1) for name in actuators]
        )
        notes = [sentences[entry] for name in actuators for entry in stiffness.get(name, ())]
        key = "stiffness_distribution_params"
        yield _build_joint_term("stiffness", joint, function, key, ends, notes)
    for joint in dict.fromkeys([*passive, *_group_by_joint(robot, damping)]):
        names = [actuator.name for actuator in robot.actuators if actuator.joint == joint]
        parts = [_convert_gain_to_joint(robot, damping, name, 2) for name in names]
        damping_in_file = float(robot.compiled.dof_damping[robot.joint(joint).velocity])
        damping_ranges = passive.get(joint)
        parts.append(
            _get_ends(damping_ranges[0]) if damping_ranges else (damping_in_file, damping_in_file)
        )
        joint_ranges = [
            *(damping_ranges or ()),
            *(entry for name in names for entry in damping.get(name, ())),
        ]
        notes = [*(sentences[entry] for entry in joint_ranges), DAMPING_NOTE]
        key = "damping_distribution_params"
        yield _build_joint_term("damping", joint, function, key, _sum_ranges(parts), notes)


def _group_by_joint(robot: Any, ranges: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return all actuators of each joint at which one of the given actuators acts."""
    joints = dict.fromkeys(robot.actuator(name).joint for name in ranges)
    return {
        j: [actuator.name for actuator in robot.actuators if actuator.joint == j]
        for j in joints
        if j
    }


def _convert_gain_to_joint(
    robot: Any, ranges: Mapping[str, Sequence[RandomizationRange]], name: str, term: int
) -> tuple[float, float]:
    """Return the interval of an actuator's gain, converted to its joint."""
    actuator_id = robot.actuator(name).id
    share = float(robot.compiled.actuator_gear[actuator_id, 0]) ** 2
    if name in ranges:
        low, high = _get_ends(ranges[name][0])
        return share * low, share * high
    gain_in_file = -share * float(robot.compiled.actuator_biasprm[actuator_id, term])
    return gain_in_file, gain_in_file


def _make_gravity_term(
    by_effect: dict[str, dict[str, list[RandomizationRange]]],
    sentences: Mapping[RandomizationRange, str],
    robot: Any,
) -> Iterator[Term]:
    """Yield the term that randomises the gravity vector, if its size or direction has a range."""
    scale = [entry for ranges in by_effect.pop("gravity.scale", {}).values() for entry in ranges]
    tilt = [entry for ranges in by_effect.pop("gravity.tilt", {}).values() for entry in ranges]
    if not scale and not tilt:
        return
    gravity_in_file = np.asarray(robot.compiled.opt.gravity, dtype=float)
    low, high = gravity_in_file.copy(), gravity_in_file.copy()
    for entry in scale:
        ends = np.stack([entry.minimum * gravity_in_file, entry.maximum * gravity_in_file])
        low, high = ends.min(axis=0), ends.max(axis=0)
    for entry in tilt:
        axis = AXES.index(entry.coefficient)
        low[axis], high[axis] = entry.low, entry.high
    vectors = [f"[{', '.join(number(value) for value in end)}]" for end in (low, high)]
    params = {
        "gravity_distribution_params": f"({', '.join(vectors)})",
        "operation": '"abs"',
    }
    notes = [sentences[entry] for entry in (*scale, *tilt)]
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
    """Build an Isaac Lab event term that calls `function` with `params` for one body of the robot.

    `params` has the code of each further argument; `notes` become comments above the term.
    """
    return Term(
        f"{prefix}_{body}",
        function,
        {"asset_cfg": _format_asset("body_names", body), **params},
        notes,
    )


def _format_asset(key: str, name: str) -> str:
    """Format the asset with one joint or body; Isaac Lab reads names as regular expressions."""
    return f'SceneEntityCfg("robot", {key}=[{literal(re.escape(name))}])'


def _get_ends(entry: RandomizationRange) -> tuple[float, float]:
    return entry.low, entry.high


def _sum_ranges(parts: Sequence[tuple[float, float]]) -> tuple[float, float]:
    return sum(low for low, _ in parts), sum(high for _, high in parts)


def _format_pair(low: float, high: float) -> str:
    return f"({number(low)}, {number(high)})"
