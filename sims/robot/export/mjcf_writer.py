"""Write attributes, comments and added elements into the text of an MJCF.

`MjcfEditor` finds the attributes that are needed, and `MjcfWriter` writes them. The elements that
causes add are written first (`render_with_added_elements`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sims.robot.coupled_drives import find_preceding_joint, get_coupling_address
from sims.robot.export.apply_causes import ModifiedModel
from sims.robot.export.mjcf_attributes import (
    ANGLE_ATTRIBUTES,
    ENUM_ATTRIBUTES,
    FLAG_ATTRIBUTES,
    INTEGER_ATTRIBUTES,
    AttributeStatement,
    Fields,
    ModelElement,
    Values,
    copy_model_fields,
    find_missing_statements,
    get_enum_word,
    list_all_attributes,
)
from sims.robot.export.mjcf_document import MjcfDocument, compile_mjcf
from sims.robot.export.model_comparison import EQUAL_NUMBERS_TOLERANCE, find_first_difference
from sims.robot.export.spec_editing import MAX_CORRECTION_ROUNDS, ROUNDING_TOLERANCE
from sims.robot.export.xml_editing import (
    NotEditableError,
    XmlElement,
    format_element,
    format_number,
    format_numbers,
)
from sims.robot.robot_model import COUPLING_TENDON_SUFFIX, RobotModel

SHORTCUT_ATTRIBUTES = ("kp", "kv", "ki", "dampratio", "timeconst", "inheritrange")
"""Attributes of MuJoCo's actuator shortcuts that ``general`` does not have."""

KEPT_VALUE_NOTE = "unchanged: without this line another change would alter it"
"""Comment at an element that is written although no cause changes it."""

_LIST_ATTRIBUTES = {"damping", "stiffness", "dynprm", "gainprm", "biasprm"}

_ORIENTATION_ATTRIBUTES = ("axisangle", "euler", "xyaxes", "zaxis", "fullinertia")
"""Attributes that are alternatives to ``quat`` and ``diaginertia``."""

_INPUT_BY_SHORTCUT = {"position": "pos", "velocity": "vel"}
"""Values of the attribute ``input`` (MuJoCo 4.0 and later) that replace an actuator shortcut."""

_GAIN_ATTRIBUTES = {"gainprm", "biasprm"}


class MjcfEditor:
    """Editor of an MJCF text: it writes attributes until the text compiles to the wanted model."""

    def __init__(
        self, robot: RobotModel, applied: ModifiedModel, recording: str, text: bytes
    ) -> None:
        """Compile the document before its attributes change, as a reference for what must change.

        Args:
            robot: robot with the text.
            applied: model that the text should compile to.
            recording: title of the recording.
            text: text of the model file.
        """
        self.robot, self.applied, self.recording, self.text = robot, applied, recording, text
        self.folder = robot.path.resolve().parent
        self.original = compile_mjcf(self._parse_document().to_text())

    def _parse_document(self) -> MjcfDocument:
        """Parse the text, with asset folders that are valid from anywhere."""
        document = MjcfDocument(self.text, self.robot.path)
        document.make_paths_absolute(self.folder)
        return document

    def to_text(self) -> str:
        """Return the text with all wanted attributes, checked by compiling it.

        MuJoCo derives its numbers from attributes in many ways, so a change may have no effect, or
        change other numbers too. So in each of at most `MAX_CORRECTION_ROUNDS` rounds:

        1. Find the attributes whose numbers in the compiled text differ from the wanted ones, and
           add them to those that are to be written.
        2. Write all of them into the original text, and compile it.

        Raises:
            NotEditableError: the edited text does not compile to the wanted model.
        """
        # An element with comments needs a statement even if its numbers are in the text already.
        statements = {element: AttributeStatement(element) for element in self.applied.comments}
        model = self.original
        for _ in range(MAX_CORRECTION_ROUNDS):
            # 1. Differences.
            for statement in find_missing_statements(
                model, self.applied.target_values, ROUNDING_TOLERANCE
            ):
                element_statement = statements.setdefault(
                    statement.element, AttributeStatement(statement.element)
                )
                # Attributes that were written without effect, or that another change has altered
                # (in a round after the first), need their related attributes: the statement is
                # insisted on, so that `write` also writes these.
                had_no_effect = bool(element_statement.values)
                is_later_round = model is not self.original
                element_statement.insisted = had_no_effect or is_later_round
                element_statement.values |= statement.values
            # 2. New text.
            text = self._render_document(list(statements.values()))
            model = compile_mjcf(text)
            if not find_missing_statements(model, self.applied.target_values, ROUNDING_TOLERANCE):
                break
        difference = find_first_difference(model, self.applied.model, EQUAL_NUMBERS_TOLERANCE)
        if difference:
            raise NotEditableError(f"its attributes do not state everything ({difference})")
        return text

    def _render_document(self, statements: Sequence[AttributeStatement]) -> str:
        """Return the text of the document with the statements, their comments and a heading.

        The comments of an element name the causes that change it. An element without a cause has a
        statement because another change would alter it, and its comment says so.

        Args:
            statements: attribute values to write, by element.
        """
        document = self._parse_document()
        writer = MjcfWriter(document, self.original, self.applied.target_values)
        for statement in statements:
            writer.write(statement, self.applied.comments.get(statement.element, [KEPT_VALUE_NOTE]))
        heading = format_heading(self.robot.path, self.recording, self.applied.notes)
        # A comment without an element, as the first content of the root.
        document.root.within.insert(0, ([heading], ""))
        return document.to_text()


def format_heading(path: Path, recording: str, notes: Iterable[str]) -> str:
    """Format the comment at the top of a written file: its origin, and notes.

    Args:
        path: model file from which it was made.
        recording: title of the recording to which its causes were fitted; empty if none.
        notes: a line for each note.
    """
    origin = f", with the causes found in {recording}" if recording else ""
    return "\n     ".join([f"{path.name}{origin}; written by simgap", *notes])


class MjcfWriter:
    """Writer of given attribute statements into a parsed document, once, without compiling it.

    Attributes:
        degrees: whether the document specifies angles in degrees.
    """

    def __init__(self, document: MjcfDocument, model: Any, target_values: Fields) -> None:
        """Map the elements of the document to the model, and read the unit of its angles.

        MJCF uses degrees unless a compiler element states radians; the last one takes
        precedence.

        Args:
            document: the MJCF.
            model: model that the document compiles to.
            target_values: fields of the model that it should compile to.
        """
        self.document, self.model, self.wanted = document, model, target_values
        # Elements of the text by their kind and number in the compiled model.
        self.tags = document.map_to_compiled_ids(model)
        self.degrees = True
        for compiler in document.find_elements("compiler"):
            self.degrees = compiler.attributes.get("angle", "degree") == "degree"

    def write(self, statement: AttributeStatement, comments: Sequence[str]) -> None:
        """Write the attributes of one element into the document, and comments before the element.

        How depends on the kind of the element: options and inertials may have to be created, and
        actuators may need another element name. The kind ``body`` means the inertial of a body, and
        ``frame`` its position.

        Args:
            statement: element with the attributes that change; without any, only comments are
                written.
            comments: reasons for the change.

        Raises:
            NotEditableError: a geom or pair is not found in the text.
        """
        element = statement.element
        if element.kind == "option":
            self._write_option(statement, comments)
        elif element.kind == "frame":
            body = self.tags[ModelElement("body", element.id)]
            _add_comments(body, comments)
            body.new |= format_attributes(statement.values)
        elif element.kind == "body":
            # Without changed values there are only comments.
            if statement.values:
                self._keep_masses()
            self._write_inertial(self.tags[element], statement, comments)
        elif element.kind in ("pair", "geom"):
            if element not in self.tags:
                raise NotEditableError("a changed geom has no name in its text")
            _add_comments(self.tags[element], comments)
            self.tags[element].new |= format_attributes(statement.values)
        else:
            tag = self.tags[element]
            _add_comments(tag, comments)
            if element.kind == "actuator":
                tag.new |= self._format_actuator(tag, statement)
            else:
                tag.new |= self._format_joint(tag, statement)

    def _write_option(self, statement: AttributeStatement, comments: Sequence[str]) -> None:
        """Write global options, such as gravity, into the last option element or a new one.

        The last element takes precedence over earlier ones.

        Args:
            statement: values of the options.
            comments: comments to write before the element. They are left out if there is neither an
                option element nor a value.
        """
        options, values = self.document.find_elements("option"), format_attributes(statement.values)
        if options:
            _add_comments(options[-1], comments)
            options[-1].new |= values
        elif values:
            self.document.root.insert_within(format_element("option", values), comments)

    def _keep_masses(self) -> None:
        """Change compiler settings so that MuJoCo uses inertials as specified.

        Two settings of a file would override them: one computes masses from geoms, the other scales
        all masses to a total.
        """
        for compiler in self.document.find_elements("compiler"):
            if compiler.get_attribute("inertiafromgeom") == "true":
                compiler.new["inertiafromgeom"] = "auto"
            if float(compiler.get_attribute("settotalmass") or -1) > 0:
                # The total with the changed masses.
                compiler.new["settotalmass"] = format_number(float(self.wanted["body_mass"].sum()))

    def _write_inertial(
        self, body: XmlElement, statement: AttributeStatement, comments: Sequence[str]
    ) -> None:
        """Write mass, centre of mass and inertia into the (perhaps new) inertial of a body.

        Only attributes whose value changes are written, or all of them if the statement insists on
        it, since the changed ones alone had no effect. Other forms of the inertial's orientation
        are removed, because new principal moments come with their own quaternion.

        Args:
            body: element of the body.
            statement: all attributes of the inertial; none if there are only comments.
            comments: comments to write before the inertial, or without one before the body.
        """
        values = format_attributes(statement.values)
        inertials = [child for child in self.document.children(body) if child.name == "inertial"]
        if not inertials and not values:
            _add_comments(body, comments)
        elif not inertials:
            body.insert_within(format_element("inertial", values), comments)
        else:
            inertial = inertials[0]
            _add_comments(inertial, comments)
            values_before = self._list_attributes_before(statement.element)
            changed_names = {
                name
                for name, target in statement.values.items()
                if statement.insisted or target != values_before[name]
            }
            if "diaginertia" in changed_names:  # principal moments
                changed_names |= {"quat"}
                inertial.removed |= set(_ORIENTATION_ATTRIBUTES)
            inertial.new |= {name: values[name] for name in values if name in changed_names}

    def _list_attributes_before(self, element: ModelElement) -> Mapping[str, Values]:
        return list_all_attributes(self.model, element, copy_model_fields(self.model))

    def _format_joint(self, tag: XmlElement, statement: AttributeStatement) -> dict[str, str]:
        """Return the attributes of a joint as text, with hinge angles in the document's unit.

        The attribute springdamper would override stiffness and damping, so it is set to
        zero with them.

        Args:
            tag: element of the joint; without a type it is a hinge.
            statement: attribute values to write, with angles in rad.

        Returns:
            Texts by attribute.
        """
        values = format_attributes(statement.values)
        is_in_degrees = self.degrees and tag.get_attribute("type") in (None, "hinge")
        if is_in_degrees:
            for name in ANGLE_ATTRIBUTES & set(statement.values):
                values[name] = format_number(float(np.rad2deg(statement.values[name][0])))
        if {"damping", "stiffness"} & set(values) and tag.get_attribute("springdamper"):
            values["springdamper"] = "0 0"
        return values

    def _format_actuator(self, tag: XmlElement, statement: AttributeStatement) -> dict[str, str]:
        """Return the attributes of an actuator as text; rename its element if it must be renamed.

        Element names such as ``position`` or ``motor`` are shortcuts for a general actuator:

        * If the shortcut can state the wanted values, it is kept, with its gains.
        * Otherwise the element becomes ``general`` with all the attributes that the shortcut
          implied.

        Args:
            tag: element of the actuator in the text; its name may be changed.
            statement: attribute values to write.

        Returns:
            Texts by attribute.
        """
        changed = statement.values
        target_attributes = list_all_attributes(self.model, statement.element, self.wanted)
        # A statement that is insisted on is written completely, as if nothing was stated.
        before = {} if statement.insisted else self._list_attributes_before(statement.element)
        # 1. The shortcut is kept, with its own attributes for the gains.
        gains = _format_shortcut(tag.name, target_attributes, changed, before)
        if gains is not None:
            if "kv" in gains:
                tag.removed.add("dampratio")  # an alternative to kv
            others = {k: v for k, v in changed.items() if k not in _GAIN_ATTRIBUTES}
            return format_attributes(others) | gains
        # 2. The element becomes ``general``, or is already.
        if tag.name != "general":
            tag.renamed = "general"
            tag.removed |= set(SHORTCUT_ATTRIBUTES)
            changed = {
                k: v for k, v in target_attributes.items() if k in changed or _is_needed(k, v)
            }
            # Since MuJoCo 4, an attribute states what the control of a servo is.
            if tag.name in _INPUT_BY_SHORTCUT and hasattr(self.model, "actuator_ctrlspec"):
                tag.new["input"] = _INPUT_BY_SHORTCUT[tag.name]
        return format_attributes(changed)


def _is_needed(name: str, values: tuple[float, ...]) -> bool:
    """Return whether ``general`` must specify an attribute that a shortcut implies."""
    if name in ("dyntype", "gaintype", "biastype", "gainprm", "biasprm"):
        return True
    return name in ("dynprm", "ctrllimited", "ctrlrange") and any(values)


def _format_shortcut(
    name: str,
    target_attributes: Mapping[str, Values],
    changed: Mapping[str, Values],
    before: Mapping[str, Values],
) -> dict[str, str] | None:
    """Return the gains of an actuator shortcut as attributes; None if it cannot express the values.

    MuJoCo stores force = gain u + offset + stiffness l + damping l' with the control u and the
    actuator's position l. The cases are:

    * A type or a filter changes: no shortcut can express it.
    * No gain changes: no attributes are needed.
    * ``position`` has force = kp (u - l) - kv l', so offset = 0 and stiffness = -gain.
    * ``velocity`` has force = kv (u - l'), so offset = stiffness = 0 and damping = -gain.
    * Otherwise, and for other shortcuts, the values cannot be expressed.

    Args:
        name: name of the shortcut, such as ``position``.
        target_attributes: all attribute values that the actuator should have.
        changed: attribute values to write.
        before: attribute values of the document; empty if all must be written.

    Returns:
        The attributes kp and kv that change; None if the shortcut cannot express the values.
    """
    if set(changed) & {"dyntype", "dynprm", "gaintype", "biastype"}:
        return None
    if not set(changed) & _GAIN_ATTRIBUTES:
        return {}
    gain = target_attributes["gainprm"][0]
    offset, stiffness, damping = target_attributes["biasprm"][:3]
    if name == "position" and offset == 0 and stiffness == -gain:
        # Only the gain that differs is written.
        gains = {}
        if not before or gain != before["gainprm"][0]:
            gains["kp"] = format_number(gain)
        if not before or damping != before["biasprm"][2]:
            gains["kv"] = format_number(-damping)
        return gains
    if name == "velocity" and offset == stiffness == 0 and damping == -gain:
        return {"kv": format_number(gain)}
    return None


def format_attributes(values: Mapping[str, Values]) -> dict[str, str]:
    """Format values as text of attributes."""
    return {name: _format_values(name, value) for name, value in values.items()}


def _format_values(name: str, values: tuple[float, ...]) -> str:
    """Format the numbers of an attribute for MJCF, as its kind demands.

    An enumeration becomes a word, a flag ``true`` or ``false``, a count an integer; all others are
    a number or a list of numbers.

    Args:
        name: name of the attribute.
        values: its numbers, as in the compiled model.
    """
    # ``interp``, a kind of interpolation, is a word in a file but a plain integer in a spec.
    if name in ENUM_ATTRIBUTES or name == "interp":
        return get_enum_word(name, values[0])
    if name in FLAG_ATTRIBUTES:
        return "true" if values[0] else "false"
    if name in INTEGER_ATTRIBUTES:
        return str(int(values[0]))
    if name in _LIST_ATTRIBUTES:
        # Trailing zeros are omitted, since numbers missing in a list are zero.
        last_nonzero = max((i for i, value in enumerate(values) if value), default=0)
        return format_numbers(values[: last_nonzero + 1])
    return format_numbers(values)


def _add_comments(tag: XmlElement, comments: Sequence[str]) -> None:
    tag.before += [text for text in comments if text not in tag.before]


def render_with_added_elements(robot: RobotModel, model: Any) -> bytes:
    """Return the text of the model file with the elements that causes add, and a fixed base.

    1. For a base that a recording fixes, remove free joints and keyframes.
    2. Add tendons of coupled drives.
    3. Add pairs of geoms with contact parameters of their own.
    4. Add joints in series (second joints of flexible or slack drives).

    Other numbers are written afterwards. Without any of these elements, the text is unchanged.

    Args:
        robot: robot with the added elements.
        model: compiled model with the causes.

    Raises:
        NotEditableError: the text does not contain a required joint, actuator or geom.
    """
    text = robot.path.read_bytes()
    has_fixed_base = robot.engine_table.get("fix_base", False)
    if not robot.series and not robot.coupled and not has_fixed_base and not robot.spec.pairs:
        return text
    document = MjcfDocument(text, robot.path)
    # 1. As by `parsing.floating_bases.fix_bases`. An element with an empty text is left out.
    if has_fixed_base:
        for tag in document.walk():
            is_free = tag.name == "joint" and tag.attributes.get("type") == "free"
            if tag.name in ("freejoint", "keyframe") or is_free:
                tag.text = b""
    # 2. Tendons.
    if robot.coupled:
        _write_couplings(document, robot, model)
    # 3. Pairs.
    _add_pairs(document, robot)
    # 4. Joints in series, each after the joint of its drive.
    tags = {tag.attributes.get("name"): tag for tag in document.walk() if tag.name == "joint"}
    for series_joint in (joint for joint in robot.spec.joints if joint.name in robot.series):
        # Its name is that of the drive's joint and an ending.
        drive_joint, _, _ = series_joint.name.rpartition("_")
        joint_tag = tags.get(drive_joint)
        if joint_tag is None:
            raise NotEditableError(f"no joint of its text is in series with {series_joint.name}")
        joint_tag.after.append(_render_series_joint(series_joint))
    return document.to_text().encode()


def _write_couplings(document: MjcfDocument, robot: RobotModel, model: Any) -> None:
    """Write the couplings of drives: a fixed tendon for each, which the joint's actuators drive.

    The length of the tendon is q + c q_first, with the position q of the drive's joint, that of the
    preceding joint q_first, and the coefficient c.

    Args:
        document: the MJCF, changed in place.
        robot: robot with the couplings.
        model: compiled model with the causes, which has the coefficients of the couplings.

    Raises:
        NotEditableError: the text lacks a joint or an actuator of the compiled model.
    """
    # Elements of the actuators, in the order of their numbers.
    tags = [child for tag in document.find_elements("actuator") for child in document.children(tag)]
    if len(tags) != len(robot.actuators):
        raise NotEditableError("the compiled model has other actuators")
    joint_names = {tag.attributes.get("name") for tag in document.walk() if tag.name == "joint"}
    for name in robot.coupled:
        first = find_preceding_joint(robot, name)
        assert first is not None  # only joints with a preceding one can be coupled
        if not {name, first.name} <= joint_names:
            raise NotEditableError(f"no joint of its text is called {name} or {first.name}")
        c = format_number(float(model.wrap_prm[get_coupling_address(robot, name)]))
        joints = f'<joint joint="{name}" coef="1"/><joint joint="{first.name}" coef="{c}"/>'
        tendon = f'<fixed name="{name}{COUPLING_TENDON_SUFFIX}">{joints}</fixed>'
        document.root.insert_within(f"<tendon>{tendon}</tendon>")
        # The actuators of the joint get the tendon as their target.
        for actuator in (a for a in robot.actuators if a.joint == name):
            tags[actuator.id].removed |= {"joint", "jointinparent"}
            tags[actuator.id].new["tendon"] = f"{name}{COUPLING_TENDON_SUFFIX}"


def _add_pairs(document: MjcfDocument, robot: RobotModel) -> None:
    """Write the elements `<pair>` of a robot that the text lacks.

    A pair states the parameters of one contact; it refers to its geoms by their names.

    Args:
        document: the MJCF, changed in place.
        robot: the robot with its pairs.

    Raises:
        NotEditableError: a geom has no name in the text.
    """
    existing_pairs = document.find_pairs()
    names = {tag.attributes.get("name") for tag in document.walk() if tag.name == "geom"}
    for pair in robot.spec.pairs:
        geoms = frozenset((pair.geomname1, pair.geomname2))
        if geoms in existing_pairs:
            continue
        if not geoms <= names:
            raise NotEditableError(f"a geom of the contact {pair.name} has no name in its text")
        attributes = {"name": pair.name, "geom1": pair.geomname1, "geom2": pair.geomname2}
        attributes["condim"] = str(pair.condim)
        for name in ("friction", "solref", "solimp"):
            attributes[name] = format_numbers(tuple(getattr(pair, name)))
        attributes |= {name: format_number(getattr(pair, name)) for name in ("margin", "gap")}
        pair_text = format_element("pair", attributes)
        document.root.insert_within(f"<contact>{pair_text}</contact>")


def _render_series_joint(second: Any) -> str:
    """Render a joint that is added in series with another one as an MJCF element.

    All attributes are stated, so that the file's default classes have no influence on it. A limited
    range represents backlash.

    Args:
        second: joint of the `mujoco.MjSpec`.
    """
    kind = "slide" if str(second.type).endswith("SLIDE") else "hinge"
    is_limited = str(second.limited).endswith("TRUE")
    attributes = {
        "name": second.name,
        "type": kind,
        "axis": format_numbers(tuple(second.axis)),
        "pos": format_numbers(tuple(second.pos)),
        "limited": "true" if is_limited else "false",
        "actuatorfrclimited": "false",
    }
    if is_limited:
        attributes["range"] = format_numbers(tuple(second.range))
        attributes["solreflimit"] = format_numbers(tuple(second.solref_limit))
        attributes["solimplimit"] = format_numbers(tuple(second.solimp_limit))
    attributes |= dict.fromkeys(("damping", "frictionloss", "armature", "stiffness"), "0")
    return format_element("joint", attributes)
