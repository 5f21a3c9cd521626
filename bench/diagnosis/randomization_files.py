"""Files of `simgap explain --ranges`: TOML, CSV, and code for Isaac Lab and MuJoCo Playground.

The terms are functions of `isaaclab.envs.mdp` (source/isaaclab/isaaclab/envs/mdp/events.py of
isaac-sim/IsaacLab): `randomize_joint_parameters`, `randomize_actuator_gains`,
`randomize_rigid_body_mass`, `randomize_rigid_body_com`, `randomize_rigid_body_inertia` (since Isaac
Lab 3) and `randomize_physics_scene_gravity`. Isaac Lab defines stiffness and damping of a drive at
its joint. The gains of a servo are therefore multiplied by the square of its gear, and the damping
of the joint is added.

Such a function takes the model of MJX and one random key for each environment. It returns the model
with a leading axis in the fields that it sets, and `in_axes` for `jax.vmap`
(mujoco_playground/_src/locomotion/go1/randomize.py of google-deepmind/mujoco_playground). All
numbers are absolute, so that the function can be used with the original model file and with
extended.xml.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.diagnosis.randomization_ranges import (
    RandomizationRange,
    RandomizationRanges,
    describe_ranges,
)
from bench.pages.text_format import format_csv, sanitise
from sims.extended_simulator import ExtendedSimulator

COMMENT_WIDTH = 96
"""Maximum number of characters of a comment line."""


def literal(text: str) -> str:
    """Format text from a file as an ASCII Python literal that cannot end early or become code."""
    has_no_quotes = not {"'", '"'} & set(text)
    return f'"{ascii(text)[1:-1]}"' if has_no_quotes else ascii(text)


def number(value: float) -> str:
    """Format a number as a Python literal with nine digits."""
    return repr(float(f"{value:.9g}"))


def comment(texts: str | Sequence[str], indent: str = "") -> str:
    """Format comments; line breaks and control characters in names are escaped.

    Args:
        texts: Text of a comment, or of several.
        indent: Indentation of the lines.
    """
    begin = f"{indent}# "
    lines: list[str] = []
    for text in [texts] if isinstance(texts, str) else texts:
        sanitised_text = sanitise(text, 2000)
        lines += textwrap.wrap(
            sanitised_text, COMMENT_WIDTH, initial_indent=begin, subsequent_indent=begin,
            break_long_words=False, break_on_hyphens=False,
        )  # fmt: skip
    return "\n".join(lines)


def identifiers(names: Iterable[str]) -> Iterator[str]:
    """Yield an identifier for each name, as valid in Python, that differs from all earlier ones.

    Other characters than letters and digits become underscores; a number is appended to a repeated
    identifier.
    """
    used_identifiers: set[str] = set()
    for name in names:
        base = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_").lower() or "range"
        base = base if base[0].isalpha() else f"n_{base}"
        identifier, count = base, 1
        while identifier in used_identifiers:
            count += 1
            identifier = f"{base}_{count}"
        used_identifiers.add(identifier)
        yield identifier


def list_heading(extended: ExtendedSimulator, framework: str, left_out: Iterable[str]) -> list[str]:
    """List the comments at the beginning of a file: its origin, and ranges that are left out.

    Args:
        extended: Extended simulator with the numbers.
        framework: Name of the framework.
        left_out: Reasons for ranges that are left out.
    """
    model = extended.robot.path.name if extended.robot is not None else extended.system
    return [
        f"Domain randomisation for {framework}, written by simgap explain --ranges: robot "
        f"{model}, recording {extended.title}.",
        "Each range is the 95 % interval of a number of the model file with the causes found. "
        "It states how well this recording determines the number, not how robots of one type "
        "differ.",
        *(f"Left out: {line}." for line in left_out),
    ]


def render_code(name: str, **values: Any) -> str:
    """Render a template of this folder as Python code.

    Args:
        name: File name of the code; the template has the suffix ``.jinja``.
        **values: Values of the template.
    """
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        autoescape=False,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=StrictUndefined,
    )
    environment.filters |= {
        "comment": comment,
        "literal": literal,
        "number": number,
        "variable": lambda field: field.replace(".", "_"),
    }
    source = Path(__file__).with_name(f"{name}.jinja").read_text(encoding="utf-8")
    return environment.from_string(source).render(**values).rstrip() + "\n"


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
    sentences = dict(describe_ranges(ranges))
    terms, missing = _build_terms(ranges, sentences, robot)
    return render_code(
        "ranges_isaac_lab.py",
        heading=list_heading(extended, "Isaac Lab", ranges.left_out),
        terms=list(zip(identifiers(term.name for term in terms), terms, strict=True)),
        missing=[f"- {sentences[number_range]}" for number_range in missing],
    )


def _build_terms(
    ranges: RandomizationRanges, sentences: Mapping[RandomizationRange, str], robot: Any
) -> tuple[list[Term], list[RandomizationRange]]:
    """Build the Isaac Lab event terms, and list the ranges for which Isaac Lab has no term.

    A term is a call of a randomisation function for one joint or body. The effects are handled one
    after another; what remains in `by_effect` has no term.

    Args:
        ranges: ranges to write.
        sentences: comment for each range.
        robot: model of the robot.
    """
    by_effect: dict[str, dict[str, list[RandomizationRange]]] = {}
    for number_range in ranges.ranges:
        by_effect.setdefault(number_range.effect, {}).setdefault(number_range.name, []).append(
            number_range
        )
    terms: list[Term] = []
    for effect, function, key in (
        ("friction.coulomb", "randomize_joint_parameters", "friction_distribution_params"),
        ("inertia.armature", "randomize_joint_parameters", "armature_distribution_params"),
    ):
        for name, (number_range,) in by_effect.pop(effect, {}).items():
            notes = [FRICTION_NOTE] if effect == "friction.coulomb" else []
            terms.append(
                _build_joint_term(
                    number_range.field,
                    name,
                    function,
                    key,
                    _get_ends(number_range),
                    [sentences[number_range], *notes],
                )
            )
    terms += _make_gain_terms(by_effect, sentences, robot)
    for name, (number_range,) in by_effect.pop("mass.scale", {}).items():
        params = {
            "mass_distribution_params": _format_pair(*_get_ends(number_range)),
            "operation": '"abs"',
        }
        if name in by_effect.get("inertia.scale", {}):
            # The range of the inertia already includes the scaling by the mass.
            params["recompute_inertia"] = "False"
        terms.append(
            _build_body_term(
                "body_mass", name, "randomize_rigid_body_mass", params, [sentences[number_range]]
            )
        )
    # The centre of mass has a range for each coordinate.
    for name, offsets in by_effect.pop("mass.offset", {}).items():
        pairs = [
            f'"{offset.coefficient}": {_format_pair(offset.minimum, offset.maximum)}'
            for offset in offsets
        ]
        params = {"com_range": "{" + ", ".join(pairs) + "}"}
        notes = [sentences[number_range] for number_range in offsets]
        terms.append(_build_body_term("body_ipos", name, "randomize_rigid_body_com", params, notes))
    for name, (number_range,) in by_effect.pop("inertia.scale", {}).items():
        params = {
            "inertia_distribution_params": _format_pair(number_range.minimum, number_range.maximum),
            "operation": '"scale"',
            "diagonal_only": "False",
        }
        notes = [sentences[number_range], "This term exists since Isaac Lab 3."]
        function = "randomize_rigid_body_inertia"
        terms.append(_build_body_term("body_inertia", name, function, params, notes))
    terms += _make_gravity_term(by_effect, sentences, robot)
    return terms, [
        number_range
        for ranges_by_place in by_effect.values()
        for by_place in ranges_by_place.values()
        for number_range in by_place
    ]


def _make_gain_terms(
    by_effect: dict[str, dict[str, list[RandomizationRange]]],
    sentences: Mapping[RandomizationRange, str],
    robot: Any,
) -> Iterator[Term]:
    """Yield the terms that randomise stiffness and damping of the actuators at each joint.

    Isaac Lab defines the gains of a drive at its joint, so gains of actuators are converted by
    their gear and added. It has one damping for each joint, so that of actuators and of the joint
    itself is added.

    Args:
        by_effect: ranges by effect and by place; those that are used are removed.
        sentences: comment for each range.
        robot: model of the robot.
    """
    stiffness = by_effect.pop("actuator.stiffness", {})
    damping = by_effect.pop("actuator.damping", {})
    passive = by_effect.pop("drag.linear", {})
    function = "randomize_actuator_gains"
    for joint, actuators in _group_by_joint(robot, stiffness).items():
        ends = _sum_ranges(
            [_convert_gain_to_joint(robot, stiffness, name, 1) for name in actuators]
        )
        notes = [
            sentences[number_range]
            for name in actuators
            for number_range in stiffness.get(name, ())
        ]
        key = "stiffness_distribution_params"
        yield _build_joint_term("stiffness", joint, function, key, ends, notes)
    for joint in dict.fromkeys([*passive, *_group_by_joint(robot, damping)]):
        names = [actuator.name for actuator in robot.actuators if actuator.joint == joint]
        joint_gains = [_convert_gain_to_joint(robot, damping, name, 2) for name in names]
        damping_in_file = float(robot.compiled.dof_damping[robot.joint(joint).velocity])
        damping_ranges = passive.get(joint)
        joint_gains.append(
            _get_ends(damping_ranges[0]) if damping_ranges else (damping_in_file, damping_in_file)
        )
        joint_ranges = [
            *(damping_ranges or ()),
            *(number_range for name in names for number_range in damping.get(name, ())),
        ]
        notes = [*(sentences[number_range] for number_range in joint_ranges), DAMPING_NOTE]
        key = "damping_distribution_params"
        yield _build_joint_term("damping", joint, function, key, _sum_ranges(joint_gains), notes)


def _group_by_joint(robot: Any, ranges: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return all actuators of each joint at which one of the given actuators acts.

    Args:
        robot: model of the robot.
        ranges: anything by the name of an actuator; only the names count.
    """
    joints = dict.fromkeys(robot.actuator(name).joint for name in ranges)
    return {
        j: [actuator.name for actuator in robot.actuators if actuator.joint == j]
        for j in joints
        if j
    }


def _convert_gain_to_joint(
    robot: Any, ranges: Mapping[str, Sequence[RandomizationRange]], name: str, term: int
) -> tuple[float, float]:
    """Return the interval of an actuator's gain at its joint: multiplied by the gear ratio squared.

    The gear converts the joint's motion to that of the actuator, and its force back.

    Args:
        robot: model of the robot.
        ranges: ranges by the name of the actuator; without one, the interval is the gain of the
            file.
        name: name of the actuator.
        term: column of MuJoCo's `actuator_biasprm` with the gain: 1 for stiffness, 2 for damping.
    """
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
    """Yield the term that randomises the gravity vector, if its size or direction has a range.

    Isaac Lab draws each component of the vector from its own interval. Components without a range
    keep the value of the model file.

    Args:
        by_effect: ranges by effect and by place; those of gravity are removed.
        sentences: comment for each range.
        robot: model of the robot.
    """
    scale = [
        number_range
        for ranges in by_effect.pop("gravity.scale", {}).values()
        for number_range in ranges
    ]
    tilt = [
        number_range
        for ranges in by_effect.pop("gravity.tilt", {}).values()
        for number_range in ranges
    ]
    if not scale and not tilt:
        return
    gravity_in_file = np.asarray(robot.compiled.opt.gravity, dtype=float)
    low, high = gravity_in_file.copy(), gravity_in_file.copy()
    for number_range in scale:
        ends = np.stack(
            [number_range.minimum * gravity_in_file, number_range.maximum * gravity_in_file]
        )
        low, high = ends.min(axis=0), ends.max(axis=0)
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
        params: code of each further argument.
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


OBJECTS = {"joint": "mjOBJ_JOINT", "body": "mjOBJ_BODY", "actuator": "mjOBJ_ACTUATOR"}
"""MuJoCo's object types by kind of place."""


def render_mujoco_playground_code(
    ranges: RandomizationRanges, extended: ExtendedSimulator, robot: Any
) -> str:
    """Return a Python file with a function `domain_randomize`.

    Args:
        ranges: Ranges to write.
        extended: Extended simulator with the numbers.
        robot: Robot with its compiled model.
    """
    sentences = dict(describe_ranges(ranges))
    # Setting the mass also scales the inertia, and setting the size of gravity its components, so
    # inertia and components are set afterwards.
    with_fields = sorted((r for r in ranges.ranges if r.fields), key=_is_last)
    fields = dict.fromkeys(
        name for number_range in with_fields for name in _list_fields(number_range)
    )
    places = dict.fromkeys((r.kind, r.name) for r in with_fields if r.kind in OBJECTS)
    return render_code(
        "ranges_mujoco_playground.py",
        heading=list_heading(extended, "MuJoCo Playground", ranges.left_out),
        ranges=with_fields,
        texts=sentences,
        fields=list(fields),
        variables={place: f"{place[0]}_{k}" for k, place in enumerate(places)},
        gravity=robot.compiled.opt.gravity.tolist(),
        robot=robot,
        without_field=[f"- {sentences[r]}" for r in ranges.ranges if not r.fields],
        index=_format_index,
        OBJECTS=OBJECTS,
    )


def _is_last(number_range: RandomizationRange) -> bool:
    return number_range.effect in ("inertia.scale", "gravity.tilt")


def _list_fields(number_range: RandomizationRange) -> list[str]:
    """List the names of the fields that a range sets."""
    names = [field.name for field in number_range.fields]
    return [*names, "body_inertia"] if number_range.effect == "mass.scale" else names


def _format_index(number_range: RandomizationRange, place: str, address: tuple[int, ...]) -> str:
    """Format the index of an element, based on the variable of its joint, body or actuator.

    Args:
        number_range: the range, with the field of the compiled model.
        place: variable with the id of the joint, body or actuator; empty if there is none.
        address: index of the element in the field; its first number is the place.
    """
    if not place:
        return ", ".join(str(k) for k in address)
    first = f"model.jnt_dofadr[{place}]" if number_range.field.startswith("dof_") else place
    return ", ".join([first, *(str(k) for k in address[1:])])


FORMAT_VERSION = 1
"""Format version of ranges.toml."""
COLUMNS = (
    "cause", "coefficient", "source", "kind", "name", "field", "address", "sign", "unit",
    "nominal", "value", "low", "high", "operation", "minimum", "maximum",
)  # fmt: skip
"""Columns of ranges.csv: the keys of a range in ranges.toml."""


def build_range_files(
    ranges: RandomizationRanges, extended: ExtendedSimulator, folder: Path | None = None
) -> Mapping[str, str]:
    """Return the content of each file by its name.

    Without ranges there are no files, and without model fields for the numbers there is no code.

    Args:
        ranges: Ranges to write.
        extended: Extended simulator with the numbers.
        folder: Folder of the files; the path of the model file is relative to it.
    """
    if not ranges.ranges:
        return {}
    import tomli_w

    range_documents = [number_range.document() for number_range in ranges.ranges]
    assert extended.robot is not None
    document: dict[str, Any] = {
        "format": FORMAT_VERSION,
        "model": extended.robot.to_document(folder)["model"],
        "recording": extended.title,
        "left_out": list(ranges.left_out),
        "ranges": range_documents,
    }
    table = [[_format_cell(row.get(column)) for column in COLUMNS] for row in range_documents]
    tables = {"ranges.toml": tomli_w.dumps(document), "ranges.csv": format_csv(COLUMNS, table)}
    if not any(number_range.fields for number_range in ranges.ranges):
        return tables
    robot = getattr(extended.kind, "robot", None)
    return {
        **tables,
        "ranges_isaac_lab.py": render_isaac_lab_code(ranges, extended, robot),
        "ranges_mujoco_playground.py": render_mujoco_playground_code(ranges, extended, robot),
    }


def _format_cell(value: Any) -> object:
    """Format a value as a cell: an address as numbers with spaces, a missing value as empty."""
    if isinstance(value, list):
        return " ".join(str(number) for number in value)
    return "" if value is None else value
