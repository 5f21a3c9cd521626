"""Write causes into a URDF, as far as its elements can express them, each with a comment.

URDF specifies linear damping and dry friction of a joint, and the inertial of a link. A body that
MuJoCo fused from several links on fixed joints is changed in each of them:

* (1) Mass and inertia tensor of each link are multiplied by 1 + c; the mass, tensor and centre of
  mass of the body follow.
* (2) Each centre of mass is moved by R' c, with the link's axes R in the body frame; the body's
  centre of mass moves by c.
* (3) A joint's zero moves by c if its origin is turned by -c about the axis, or moved by -c along
  it.
* (4) The origin of a body's joint moves by R' c p, with the position p of the body in the frame of
  the body that carries it, and the axes R of the joint's parent link in that frame.
* (5) A payload is added to the first link of its body by the parallel axis theorem.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from sims.core.simulator import Array
from sims.robot.export.apply_causes import COULOMB
from sims.robot.export.mjcf_attributes import UnstatableCauseError
from sims.robot.export.mjcf_writer import format_heading
from sims.robot.export.xml_editing import (
    NotEditableError,
    XmlElement,
    XmlText,
    format_number,
    format_numbers,
)
from sims.robot.fitted_causes import CauseCoefficients, FittedCause, expand_families
from sims.robot.inertia_tensors import compute_point_inertias
from sims.robot.model_field_effects import add_to_file_value, compute_factor, get_write_order
from sims.robot.robot_model import RobotModel

_TENSOR_ATTRIBUTES = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_NO_INERTIAL = "a link of the body states no inertial"
"""Reason why a change of mass or inertia cannot be written."""
_SOFT_FRICTION_URDF_NOTE = (
    "friction.coulomb: a URDF cannot state that dry friction is stiff, and MuJoCo reads it in its "
    "soft form; extended.xml has the stiff form"
)


def render_urdf(
    robot: RobotModel, causes: CauseCoefficients, recording: str, notes: list[str]
) -> str | None:
    """Render the URDF with the causes that it can express, and add notes about all others.

    The result is None if its text cannot be edited.

    Args:
        robot: the robot as read from its URDF.
        causes: coefficients of all causes.
        recording: title of the recording, for comments.
        notes: notes for the user, extended in place.
    """
    try:
        writer = UrdfWriter(robot, recording)
    except NotEditableError as unfit:
        notes.append(f"no URDF is written: {unfit}")
        return None
    urdf_notes = []
    fitted_causes = expand_families(robot, causes)
    # Some causes, such as a payload, must follow others.
    for cause in sorted(fitted_causes, key=lambda entry: get_write_order(entry.effect)):
        try:
            writer.write(cause)
        except UnstatableCauseError as reason:
            urdf_notes.append(f"{cause.format(recording)}: not in the URDF: {reason}")
            continue
        if cause.effect == COULOMB and robot.friction_form == "stiff":
            urdf_notes.append(_SOFT_FRICTION_URDF_NOTE)
    urdf_notes = list(dict.fromkeys(urdf_notes))  # without repetitions
    notes += urdf_notes
    return writer.to_text(urdf_notes)


class UrdfWriter:
    """Writer of causes into the text of a URDF.

    Raises:
        NotEditableError: the file is not XML in UTF-8.
    """

    def __init__(self, robot: RobotModel, recording: str) -> None:
        """Parse the URDF of the robot, and index its links and joints by name.

        Args:
            robot: robot as read from its model file.
            recording: title of the recording to which the causes were fitted.
        """
        self.robot, self.recording = robot, recording
        self.markup = XmlText(robot.path.read_bytes(), robot.path)
        top = self.markup.root.children
        self.links = {tag.get_attribute("name"): tag for tag in top if tag.name == "link"}
        self.joints = {tag.get_attribute("name"): tag for tag in top if tag.name == "joint"}

    def write(self, cause: FittedCause) -> None:
        """Write a cause into the elements of the URDF, by the writer of its effect.

        Args:
            cause: Effect at a place with its fitted numbers.

        Raises:
            UnstatableCauseError: A URDF cannot express it.
        """
        writers_by_effect: Mapping[str, Callable[[FittedCause], None]] = {
            "drag.linear": lambda cause: self._write_dynamics(cause, "damping"),
            "friction.coulomb": lambda cause: self._write_dynamics(cause, "friction"),
            "mass.scale": self._write_mass,
            "inertia.scale": self._write_inertia_tensor,
            "mass.offset": self._write_centre_of_mass,
            "joint.zero": self._write_joint_zero,
            "joint.axis": self._write_joint_axis,
            "link.length": self._write_link_length,
            "payload": self._write_payload,
        }
        if cause.effect not in writers_by_effect:
            raise UnstatableCauseError("a URDF cannot state it")
        writers_by_effect[cause.effect](cause)

    def to_text(self, lines: list[str]) -> str:
        """Return the file with all changes.

        Args:
            lines: lines for the comment at the top of the file.
        """
        comment = format_heading(self.robot.path, self.recording, lines)
        # A comment without an element, as the first content of the root.
        self.markup.root.within.insert(0, ([comment], ""))
        return self.markup.to_text().decode()

    def _write_dynamics(self, cause: FittedCause, attribute: str) -> None:
        """Add a cause to the damping or the friction in the dynamics element of its joint.

        A missing element is added.

        Args:
            cause: effect at a place with its fitted numbers.
            attribute: ``damping`` or ``friction``.
        """
        joint = self._find_joint(cause)
        dynamics = _get_or_add_child(joint, "dynamics")
        file_value = float(dynamics.get_attribute(attribute) or 0.0)
        total = float(add_to_file_value(file_value, cause.coefficients[0]))  # at least zero
        self._add_comment(dynamics, cause)
        dynamics.new[attribute] = format_number(total)

    def _add_comment(self, tag: XmlElement, cause: FittedCause) -> None:
        tag.before.append(cause.format(self.recording))

    def _find_joint(self, cause: FittedCause) -> XmlElement:
        """Return the joint at which a cause acts.

        Raises:
            UnstatableCauseError: The file has no joint of this name.
        """
        if cause.place not in self.joints:
            raise UnstatableCauseError("the file has no joint of this name")
        return self.joints[cause.place]

    def _find_inertials(self, cause: FittedCause) -> list[tuple[str, XmlElement]]:
        """Return the links of a body that have a mass, by name, with their inertials.

        A body consists of a link and those that are fused to it by fixed joints. A link without
        mass and shapes, such as a mere frame, is left out.

        Args:
            cause: effect on the body.

        Returns:
            Pairs of the name of a link, and its element ``<inertial>``.

        Raises:
            UnstatableCauseError: the mass of a link follows from its shapes, or no link has a mass.
        """
        body = self.robot.body(cause.place)
        inertials = []
        for name in (body.name, *body.aliases):
            link = self.links.get(name)
            inertial = _find_child(link, "inertial") if link else None
            if inertial is not None:
                # An inertial of zero, such as that of a mere frame, adds nothing to the body.
                inertials += [(name, inertial)] if _has_mass(inertial) else []
            elif link is None or _find_child(link, "collision"):
                # The mass of this link follows from its shapes, or the file does not have the link.
                # So the mass of the whole body is not stated.
                raise UnstatableCauseError(_NO_INERTIAL)
        if not inertials:
            raise UnstatableCauseError(_NO_INERTIAL)
        return inertials

    def _write_mass(self, cause: FittedCause) -> None:
        """Scale mass and inertia tensor of each link in the body by 1 + c."""
        self._scale_inertials(cause, {"mass": ("value",), "inertia": _TENSOR_ATTRIBUTES})

    def _write_inertia_tensor(self, cause: FittedCause) -> None:
        """Scale the inertia tensor of the body's only link by 1 + c; its mass stays.

        Args:
            cause: effect on a body, with the coefficient c.

        Raises:
            UnstatableCauseError: the body consists of several links, whose distances contribute to
                its tensor and cannot be scaled; or its mass is not stated.
        """
        if len(self._find_inertials(cause)) > 1:
            raise UnstatableCauseError("the body is not one link with an inertial")
        self._scale_inertials(cause, {"inertia": _TENSOR_ATTRIBUTES})

    def _scale_inertials(
        self, cause: FittedCause, attributes: Mapping[str, tuple[str, ...]]
    ) -> None:
        """Multiply stated attributes of the inertials of a body's links by 1 + c.

        Args:
            cause: effect on the body, with the coefficient c.
            attributes: names of the attributes by child element of an inertial, such as the value
                of the mass; those that are not stated stay so.
        """
        factor = float(compute_factor(cause.coefficients[0]))  # 1 + c, more than zero
        for _, inertial in self._find_inertials(cause):
            self._add_comment(inertial, cause)
            for name, keys in attributes.items():
                child = _find_child(inertial, name)
                if child is None:
                    continue
                for key in keys:
                    value = child.get_attribute(key)
                    if value is not None:
                        child.new[key] = format_number(float(value) * factor)

    def _write_centre_of_mass(self, cause: FittedCause) -> None:
        """Move the centre of mass of each link in the body by the same vector.

        A body may consist of several links that are fused by fixed joints. In the frame of a link,
        whose axes in the frame of the body are R, the vector c is R' c (2).

        Args:
            cause: effect on a body with the coefficients c in m, in the frame of the body.
        """
        inertials = self._find_inertials(cause)
        body = self.robot.body(cause.place).name
        for name, inertial in inertials:
            self._add_comment(inertial, cause)
            displacement = self._get_link_axes(name, body).T @ cause.coefficients  # (2)
            _set_vector(inertial, "origin", "xyz", _read_origin(inertial, "xyz") + displacement)

    def _write_joint_zero(self, cause: FittedCause) -> None:
        """Move the zero of a joint by c (rad or m).

        URDF has no attribute for it. The zero moves by c if the origin of the joint is turned by -c
        about its axis, or moved by -c along it if the joint is prismatic (3).

        Args:
            cause: effect at a joint with the coefficient c.
        """
        joint = self._find_joint(cause)
        (c,) = cause.coefficients
        self._add_comment(joint, cause)
        # The axis is stated in the frame of the joint, and the origin in that of the parent link.
        # The columns of `axes` are the axes of the joint's frame in the parent link.
        axis = _get_joint_axis(joint)
        axes = _compute_rotation(_read_origin(joint, "rpy"))
        if joint.get_attribute("type") == "prismatic":
            _set_vector(joint, "origin", "xyz", _read_origin(joint, "xyz") - axes @ axis * c)
        else:
            rotated_frame = Rotation.from_matrix(axes) * Rotation.from_rotvec(-c * axis)
            _set_vector(joint, "origin", "rpy", rotated_frame.as_euler("xyz"))

    def _write_joint_axis(self, cause: FittedCause) -> None:
        """Rotate the axis of a joint by a rotation vector in radians, in the joint's frame."""
        joint = self._find_joint(cause)
        self._add_comment(joint, cause)
        rotation = Rotation.from_rotvec(cause.coefficients)
        _set_vector(joint, "axis", "xyz", rotation.apply(_get_joint_axis(joint)))

    def _write_link_length(self, cause: FittedCause) -> None:
        """Lengthen a link by the share c: move the joint that carries the body.

        With the position p of the body in the frame of its parent body, the joint's origin moves by
        c p. In the frame of the joint's parent link, whose axes in the parent body are R, this is
        R' c p (4).

        Args:
            cause: effect on a body with the coefficient c.

        Raises:
            UnstatableCauseError: no joint of the file carries the body.
        """
        body, model = self.robot.body(cause.place), self.robot.compiled
        # A link of a URDF has at most one parent joint.
        joints = [tag for tag in self.joints.values() if _get_link_name(tag, "child") == body.name]
        if not joints:
            raise UnstatableCauseError("the file has no joint that carries the link")
        joint, (c,) = joints[0], cause.coefficients
        parent_body = model.body(int(model.body_parentid[body.id])).name
        axes = self._get_link_axes(_get_link_name(joint, "parent"), parent_body)
        displacement = axes.T @ model.body_pos[body.id] * c  # (4)
        self._add_comment(joint, cause)
        _set_vector(joint, "origin", "xyz", _read_origin(joint, "xyz") + displacement)

    def _write_payload(self, cause: FittedCause) -> None:
        """Add a payload, a point mass, to the first link of a body.

        1. Read mass, centre of mass and inertia tensor of the link. The tensor is about the centre
           of mass, in the axes of the inertial.
        2. Compute the common centre of mass. Turn the tensor to the axes of the link, increase it
           by the parallel axis theorem to that about the common centre (5), and turn it back.
        3. Write the new numbers.

        Args:
            cause: effect on a body; its coefficients are the mass of the payload in kg, and its
                offset x, y, z from the body's centre of mass in m.

        Raises:
            UnstatableCauseError: the file does not state mass and inertia of the link.
        """
        # 1. Numbers of the link.
        body = self.robot.body(cause.place)
        link = self.links.get(body.name)
        inertial = _find_child(link, "inertial") if link else None
        if inertial is None:
            raise UnstatableCauseError("the link states no inertial")
        mass_tag, tensor_tag = _find_child(inertial, "mass"), _find_child(inertial, "inertia")
        if mass_tag is None or tensor_tag is None:
            raise UnstatableCauseError("the link's inertial lacks a mass or an inertia")
        mass = float(mass_tag.get_attribute("value") or 0.0)
        added_mass, *offset = cause.coefficients
        payload_position = self.robot.compiled.body_ipos[body.id] + offset
        centre = _read_origin(inertial, "xyz")
        axes = _compute_rotation(_read_origin(inertial, "rpy"))
        # The attributes are in the order of the upper triangle.
        values = [float(tensor_tag.get_attribute(key) or 0.0) for key in _TENSOR_ATTRIBUTES]
        tensor = np.zeros((3, 3))
        tensor[np.triu_indices(3)] = values
        tensor += np.triu(tensor, 1).T  # makes it symmetric
        # 2. Link and payload.
        common_centre = (mass * centre + added_mass * payload_position) / (mass + added_mass)
        tensor = axes @ tensor @ axes.T
        arms = np.stack([centre - common_centre, payload_position - common_centre])
        tensor += np.einsum("n,nij->ij", [mass, added_mass], compute_point_inertias(arms))  # (5)
        tensor = axes.T @ tensor @ axes
        # 3. New numbers.
        self._add_comment(inertial, cause)
        mass_tag.new["value"] = format_number(mass + added_mass)
        for key, value in zip(_TENSOR_ATTRIBUTES, tensor[np.triu_indices(3)].tolist(), strict=True):
            tensor_tag.new[key] = format_number(value)
        _set_vector(inertial, "origin", "xyz", common_centre)

    def _get_link_axes(self, link: str, body: str) -> Array:
        """Return the axes (3, 3) of a link in the frame of the body into which it is fused.

        The rotations of the fixed joints between them are multiplied.

        Args:
            link: name of the link.
            body: name of the body, which is that of its first link.
        """
        axes = np.eye(3)
        while link != body:
            # The joint that carries the link.
            (joint,) = [tag for tag in self.joints.values() if _get_link_name(tag, "child") == link]
            axes = _compute_rotation(_read_origin(joint, "rpy")) @ axes
            link = _get_link_name(joint, "parent")
        return axes


def _read_origin(tag: XmlElement, attribute: str) -> Array:
    """Return the position ``xyz`` or the angles ``rpy`` of an element's origin.

    Args:
        tag: element with an origin.
        attribute: ``xyz`` (m) or ``rpy`` (rad).
    """
    origin = _find_child(tag, "origin")
    return _parse_vector(origin.get_attribute(attribute) if origin else None)


def _get_joint_axis(joint: XmlElement) -> Array:
    """Return the unit vector of a joint's axis; URDF's default is x."""
    axis = _find_child(joint, "axis")
    vector = _parse_vector((axis.get_attribute("xyz") if axis else None) or "1 0 0")
    result: Array = vector / np.linalg.norm(vector)
    return result


def _set_vector(tag: XmlElement, name: str, attribute: str, vector: Array) -> None:
    """Set a vector of a child element, which is added if there is none.

    Args:
        tag: parent element.
        name: name of the child element.
        attribute: name of its attribute.
        vector: the numbers.
    """
    _get_or_add_child(tag, name).new[attribute] = format_numbers(tuple(vector.tolist()))


def _get_or_add_child(tag: XmlElement, name: str) -> XmlElement:
    """Return the child element with a name, which is added if there is none.

    Args:
        tag: parent element.
        name: name of the child element.
    """
    child = _find_child(tag, name)
    if child is None:
        child = XmlElement(name, {}, tag.inside)
        tag.inserted.append(child)
    return child


def _find_child(tag: XmlElement, name: str) -> XmlElement | None:
    return next((c for c in (*tag.children, *tag.inserted) if c.name == name), None)


def _get_link_name(joint: XmlElement, end: str) -> str:
    """Return the link at one end of a joint."""
    link_tag = _find_child(joint, end)
    return (link_tag.get_attribute("link") or "") if link_tag else ""


def _has_mass(inertial: XmlElement) -> bool:
    """Return whether an inertial specifies a nonzero mass or moment of inertia.

    Args:
        inertial: Element ``<inertial>`` of a link.
    """
    stated_values = (
        (_find_child(inertial, "mass"), ("value",)),
        (_find_child(inertial, "inertia"), _TENSOR_ATTRIBUTES),
    )
    return any(
        float(tag.get_attribute(key) or 0.0) for tag, keys in stated_values if tag for key in keys
    )


def _parse_vector(text: str | None) -> Array:
    """Parse a vector (3,); zeros for a missing text."""
    return np.array([float(number) for number in text.split()]) if text else np.zeros(3)


def _compute_rotation(rpy: Array) -> Array:
    """Return the axes (3, 3) rotated about fixed x, y and z in turn, as URDF defines ``rpy``."""
    axes: Array = Rotation.from_euler("xyz", rpy).as_matrix()
    return axes
