"""Write attributes and comments into an MJCF source document."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

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
    get_enum_word,
    list_all_attributes,
)
from sims.robot.export.mjcf_document import (
    MjcfDocument,
    NotEditableError,
    XmlElement,
    format_element,
    format_number,
    format_numbers,
)

_ORIENTATION_ATTRIBUTES = ("axisangle", "euler", "xyaxes", "zaxis", "fullinertia")
"""Attributes that are alternatives to ``quat`` and ``diaginertia``."""

SHORTCUT_ATTRIBUTES = ("kp", "kv", "ki", "dampratio", "timeconst", "inheritrange")
"""Attributes of MuJoCo's actuator shortcuts that ``general`` does not have."""

_INPUT_BY_SHORTCUT = {"position": "pos", "velocity": "vel"}
"""Values of the attribute ``input`` (MuJoCo 4.0 and later) that replace an actuator shortcut."""

_GAIN_ATTRIBUTES = {"gainprm", "biasprm"}

_LIST_ATTRIBUTES = {"damping", "stiffness", "dynprm", "gainprm", "biasprm"}


class MjcfWriter:
    """Writer of attribute statements into a document.

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
        self.tags = document.map_to_compiled_ids(model)
        self.degrees = True
        for compiler in document.find_elements("compiler"):
            self.degrees = compiler.attributes.get("angle", "degree") == "degree"

    def write(self, statement: AttributeStatement, comments: Sequence[str]) -> None:
        """Write the attributes of one element into the document, and comments before the element.

        How depends on the kind of the element: options and inertials may have to be created, and
        actuators may need another element name.

        Args:
            statement: element with the attributes that change.
            comments: reasons for the change, in sentences.
        """
        element = statement.element
        if element.kind == "option":
            self._write_option(statement, comments)
        elif element.kind == "frame":
            body = self.tags[ModelElement("body", element.id)]
            _add_comments(body, comments)
            body.new |= format_attributes(statement.values)
        elif element.kind == "body":
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
            values = self._format_joint(tag, statement)
            if element.kind == "actuator":
                values = self._format_actuator(tag, statement)
            tag.new |= values

    def _write_option(self, statement: AttributeStatement, comments: Sequence[str]) -> None:
        """Write global options, such as gravity, into the last option element or a new one.

        Args:
            statement: values of the options.
            comments: comments to write before the element.
        """
        options, values = self.document.find_elements("option"), format_attributes(statement.values)
        if options:
            _add_comments(options[-1], comments)
            options[-1].new |= values
            return
        if not values:
            return
        self.document.root.within.append((list(comments), format_element("option", values)))

    def _keep_masses(self) -> None:
        """Change compiler settings so that MuJoCo uses inertials as specified."""
        for compiler in self.document.find_elements("compiler"):
            if compiler.get_attribute("inertiafromgeom") == "true":
                compiler.new["inertiafromgeom"] = "auto"
            if float(compiler.get_attribute("settotalmass") or -1) > 0:
                compiler.new["settotalmass"] = format_number(float(self.wanted["body_mass"].sum()))

    def _write_inertial(
        self, body: XmlElement, statement: AttributeStatement, comments: Sequence[str]
    ) -> None:
        """Write mass, centre of mass and inertia into the (perhaps new) inertial of a body.

        Only attributes whose value changes are written, or all of them if the statement insists on
        it. Other forms of the inertial's orientation are removed, because new principal moments
        come with their own quaternion.
        """
        values = format_attributes(statement.values)
        for child in self.document.children(body):
            if child.name == "inertial":
                _add_comments(child, comments)
                if not values:
                    return
                before = self._list_attributes_before(statement.element)
                changed = {
                    name for name, target in statement.values.items() if target != before[name]
                }
                if statement.insisted:
                    changed = set(values)
                if "diaginertia" in changed:
                    changed |= {"quat"}
                    child.removed |= set(_ORIENTATION_ATTRIBUTES)
                child.new |= {name: values[name] for name in values if name in changed}
                return
        if not values:
            _add_comments(body, comments)
            return
        body.within.append((list(comments), format_element("inertial", values)))

    def _list_attributes_before(self, element: ModelElement) -> Mapping[str, Values]:
        return list_all_attributes(self.model, element, copy_model_fields(self.model))

    def _format_joint(self, tag: XmlElement, statement: AttributeStatement) -> dict[str, str]:
        """Return the attributes of a joint as text, with hinge angles in the document's unit.

        The attribute springdamper would override stiffness and damping, so it is set to
        zero with them.
        """
        values = format_attributes(statement.values)
        hinge = tag.get_attribute("type") in (None, "hinge")
        for name in ANGLE_ATTRIBUTES & set(statement.values) if hinge and self.degrees else ():
            values[name] = format_number(float(np.rad2deg(statement.values[name][0])))
        if {"damping", "stiffness"} & set(values) and tag.get_attribute("springdamper"):
            values["springdamper"] = "0 0"
        return values

    def _format_actuator(self, tag: XmlElement, statement: AttributeStatement) -> dict[str, str]:
        """Return the attributes of an actuator as text; rename its element if it must be renamed.

        Element names such as ``position`` or ``motor`` are shortcuts for a general actuator. If the
        shortcut can state the wanted values, it is kept. Otherwise the element becomes ``general``
        with all the attributes that the shortcut implied.

        Args:
            tag: element of the actuator in the text; its name may be changed.
            statement: attribute values to write.
        """
        changed = statement.values
        before = {} if statement.insisted else self._list_attributes_before(statement.element)
        gains = _format_shortcut(
            tag.name,
            list_all_attributes(self.model, statement.element, self.wanted),
            changed,
            before,
        )
        if gains is not None:
            if "kv" in gains:
                tag.removed.add("dampratio")
            return (
                format_attributes({k: v for k, v in changed.items() if k not in _GAIN_ATTRIBUTES})
                | gains
            )
        if tag.name != "general":
            tag.renamed = "general"
            tag.removed |= set(SHORTCUT_ATTRIBUTES)
            target_attributes = list_all_attributes(self.model, statement.element, self.wanted)
            changed = {
                k: v for k, v in target_attributes.items() if k in changed or _is_needed(k, v)
            }
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

    A position actuator has force = kp (u - l) - kv l', and a velocity actuator kv (u - l'), with
    the control u and the actuator's position l. MuJoCo stores force = gain u + offset
    + stiffness l + damping l', so a position actuator needs offset = 0 and stiffness = -gain.

    Args:
        name: name of the shortcut, such as ``position``.
        target_attributes: all attribute values that the actuator should have.
        changed: attribute values to write.
        before: attribute values of the document; empty if all must be written.

    Returns:
        The attributes; None if the shortcut cannot express the values.
    """
    if set(changed) & {"dyntype", "dynprm", "gaintype", "biastype"}:
        return None
    if not set(changed) & _GAIN_ATTRIBUTES:
        return {}
    gain = target_attributes["gainprm"][0]
    offset, stiffness, damping = target_attributes["biasprm"][:3]
    if name == "position" and offset == 0 and stiffness == -gain:
        gains = {} if before and gain == before["gainprm"][0] else {"kp": format_number(gain)}
        if not before or damping != before["biasprm"][2]:
            gains["kv"] = format_number(-damping)
        return gains
    if name == "velocity" and offset == stiffness == 0 and damping == -gain:
        return {"kv": format_number(gain)}
    return None


def _add_comments(tag: XmlElement, comments: Sequence[str]) -> None:
    tag.before += [text for text in comments if text not in tag.before]


def format_attributes(values: Mapping[str, Values]) -> dict[str, str]:
    """Format values as text of attributes."""
    return {name: _format_values(name, value) for name, value in values.items()}


def _format_values(name: str, values: tuple[float, ...]) -> str:
    """Format the numbers of an attribute for MJCF: word, true or false, integer or list.

    Args:
        name: name of the attribute.
        values: its numbers, as in the compiled model.
    """
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
