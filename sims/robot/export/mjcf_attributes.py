"""MJCF attributes of model elements, and the fields of the compiled model that store them.

With this map a number of the compiled model can be written to a file, or set in a spec.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np

Kind = Literal["joint", "body", "frame", "actuator", "pair", "option", "compiler"]
"""Kinds of model elements.

Kind ``frame`` is a body without its inertial: the position of its frame, and its gravity
compensation.
"""

Fields = dict[str, Any]
"""Fields of a compiled model by name, arrays (1, ...) for one batch element."""

Values = tuple[float, ...]


class ModelElement(NamedTuple):
    """An element of a model file.

    Attributes:
        kind: kind of the element.
        id: number in the compiled model.
    """

    kind: Kind
    id: int


@dataclass
class AttributeStatement:
    """Attribute values that a file should specify for one element.

    Attributes:
        element: the element.
        values: values by MJCF attribute, in MuJoCo's units (angles in rad).
        insisted: whether related attributes must be written as well, since the values alone had no
            effect.
    """

    element: ModelElement
    values: dict[str, Values] = field(default_factory=dict)
    insisted: bool = False


class MjcfAttribute(NamedTuple):
    """An MJCF attribute.

    Attributes:
        name: name in the file.
        spec: name in an MjSpec.
        read: reads its values from the model fields and the addresses of an element.
    """

    name: str
    spec: str
    read: Callable[[Fields, Any], Any]


def _make_reader(name: str, address: str = "id") -> Callable[[Fields, Any], Any]:
    return lambda fields, field_address: fields[name][0, getattr(field_address, address)]


class FieldAddress(NamedTuple):
    """Addresses of an element in the fields of a compiled model.

    Attributes:
        id: number of the element.
        velocity: address of a joint's velocity (dof).
        position: address of a joint's position.
        control: address of an actuator's control.
    """

    id: int
    velocity: int = 0
    position: int = 0
    control: int = 0


def _make_polynomial_reader(
    first: str, higher_orders: str, address: str = "id"
) -> Callable[[Fields, Any], list[float]]:
    """Return a reader of a polynomial attribute: its linear coefficient, then the others.

    MuJoCo stores the linear coefficient in the field `first` and the others in the field
    `higher_orders`. `address` names the attribute of `field_address` with the row in these fields.
    """

    def read(fields: Fields, field_address: Any) -> list[float]:
        """Return the coefficients of the element at `field_address`, lowest order first."""
        row = getattr(field_address, address)
        return [fields[first][0, row], *fields[higher_orders][0, row]]

    return read


ATTRIBUTES_BY_KIND: Mapping[Kind, tuple[MjcfAttribute, ...]] = {
    "joint": (
        MjcfAttribute(
            "damping",
            "damping",
            _make_polynomial_reader("dof_damping", "dof_dampingpoly", "velocity"),
        ),
        MjcfAttribute("frictionloss", "frictionloss", _make_reader("dof_frictionloss", "velocity")),
        MjcfAttribute("solreffriction", "solref_friction", _make_reader("dof_solref", "velocity")),
        MjcfAttribute("solimpfriction", "solimp_friction", _make_reader("dof_solimp", "velocity")),
        MjcfAttribute(
            "stiffness", "stiffness", _make_polynomial_reader("jnt_stiffness", "jnt_stiffnesspoly")
        ),
        MjcfAttribute("springref", "springref", _make_reader("qpos_spring", "position")),
        MjcfAttribute("armature", "armature", _make_reader("dof_armature", "velocity")),
        MjcfAttribute("axis", "axis", _make_reader("jnt_axis")),
        MjcfAttribute("ref", "ref", _make_reader("qpos0", "position")),
    ),
    "body": (
        MjcfAttribute("pos", "ipos", _make_reader("body_ipos")),
        MjcfAttribute("quat", "iquat", _make_reader("body_iquat")),
        MjcfAttribute("mass", "mass", _make_reader("body_mass")),
        MjcfAttribute("diaginertia", "inertia", _make_reader("body_inertia")),
    ),
    "frame": (
        MjcfAttribute("pos", "pos", _make_reader("body_pos")),
        MjcfAttribute("gravcomp", "gravcomp", _make_reader("body_gravcomp")),
    ),
    "actuator": (
        MjcfAttribute("dyntype", "dyntype", _make_reader("actuator_dyntype")),
        MjcfAttribute("dynprm", "dynprm", _make_reader("actuator_dynprm")),
        MjcfAttribute("gaintype", "gaintype", _make_reader("actuator_gaintype")),
        MjcfAttribute("gainprm", "gainprm", _make_reader("actuator_gainprm")),
        MjcfAttribute("biastype", "biastype", _make_reader("actuator_biastype")),
        MjcfAttribute("biasprm", "biasprm", _make_reader("actuator_biasprm")),
        MjcfAttribute(
            "ctrllimited", "ctrllimited", _make_reader("actuator_ctrllimited", "control")
        ),
        MjcfAttribute("ctrlrange", "ctrlrange", _make_reader("actuator_ctrlrange", "control")),
        MjcfAttribute("forcelimited", "forcelimited", _make_reader("actuator_forcelimited")),
        MjcfAttribute("forcerange", "forcerange", _make_reader("actuator_forcerange")),
        MjcfAttribute("delay", "delay", _make_reader("actuator_delay")),
        MjcfAttribute("nsample", "nsample", lambda f, where: f["actuator_history"][0, where.id, 0]),
        MjcfAttribute("interp", "interp", lambda f, where: f["actuator_history"][0, where.id, 1]),
    ),
    "pair": (
        MjcfAttribute("friction", "friction", _make_reader("pair_friction")),
        MjcfAttribute("solref", "solref", _make_reader("pair_solref")),
    ),
    "option": (
        MjcfAttribute("timestep", "timestep", lambda f, _: f["opt.timestep"][0]),
        MjcfAttribute("integrator", "integrator", lambda f, _: f["opt.integrator"][0]),
        MjcfAttribute("gravity", "gravity", lambda f, _: f["opt.gravity"][0]),
    ),
    "compiler": (),
}
"""MJCF attributes by kind of element; those of an inertial belong to its body."""

_NAMES = (
    *("dof_damping", "dof_dampingpoly", "dof_frictionloss", "dof_solref", "dof_solimp"),
    *("jnt_stiffness", "jnt_stiffnesspoly", "qpos_spring", "dof_armature"),
    *("jnt_axis", "qpos0", "body_pos"),
    *("body_ipos", "body_iquat", "body_mass", "body_inertia", "body_gravcomp"),
    *("actuator_dyntype", "actuator_dynprm", "actuator_gaintype", "actuator_gainprm"),
    *("actuator_biastype", "actuator_biasprm", "actuator_ctrllimited", "actuator_ctrlrange"),
    *("actuator_forcelimited", "actuator_forcerange", "actuator_delay", "actuator_history"),
    *("pair_friction", "pair_solref"),
)

FLAG_ATTRIBUTES = frozenset({"ctrllimited", "forcelimited"})
ANGLE_ATTRIBUTES = frozenset({"ref", "springref"})
"""Attributes of a hinge in the unit of the file's angles."""
INTEGER_ATTRIBUTES = frozenset({"nsample", "interp"})
ENUM_ATTRIBUTES: Mapping[str, str] = {
    "dyntype": "mjtDyn",
    "gaintype": "mjtGain",
    "biastype": "mjtBias",
    "integrator": "mjtIntegrator",
}
"""Attributes whose values are words, and the MuJoCo enumerations of these words."""


def copy_model_fields(model: Any) -> Fields:
    """Copy the fields of a compiled model that store attributes."""
    fields = {name: np.array(getattr(model, name))[None] for name in _NAMES}
    for name in ("timestep", "integrator", "gravity"):
        fields[f"opt.{name}"] = np.array(getattr(model.opt, name))[None]
    return fields


def get_field_address(model: Any, element: ModelElement) -> FieldAddress:
    """Return the addresses of an element in the fields of a compiled model."""
    i = element.id
    if element.kind == "joint":
        return FieldAddress(i, int(model.jnt_dofadr[i]), int(model.jnt_qposadr[i]))
    if element.kind == "actuator":
        return FieldAddress(i, control=int(model.actuator_ctrladr[i]))
    return FieldAddress(i)


def list_elements(model: Any) -> list[ModelElement]:
    """List the elements of a model whose attributes can be written.

    They are joints with one coordinate, bodies, actuators with one control, pairs of geoms, and the
    options.
    """
    import mujoco

    scalar_types = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    elements = [
        ModelElement("joint", i)
        for i in range(model.njnt)
        if int(model.jnt_type[i]) in scalar_types
    ]
    elements += [ModelElement("body", i) for i in range(1, model.nbody)]
    elements += [ModelElement("frame", i) for i in range(1, model.nbody)]
    scalar_actuators = [
        i for i in range(len(model.actuator_ctrlnum)) if int(model.actuator_ctrlnum[i]) == 1
    ]
    elements += [ModelElement("actuator", i) for i in scalar_actuators]
    elements += [ModelElement("pair", i) for i in range(model.npair)]
    return [*elements, ModelElement("option", 0)]


def find_missing_statements(
    model: Any, target_values: Fields, tolerance: float
) -> list[AttributeStatement]:
    """Find the attributes to write so that a compiled model gets the wanted fields.

    Args:
        model: compiled model of the present file.
        target_values: wanted fields.
        tolerance: relative difference that is ignored.

    Returns:
        One statement for each element with differences.
    """
    return find_differing_statements(model, copy_model_fields(model), target_values, tolerance)


def find_differing_statements(
    model: Any, present_values: Fields, target_values: Fields, tolerance: float
) -> list[AttributeStatement]:
    """Find the attributes in which two sets of model fields differ.

    The result is what has to be written into a model file so that it compiles to the wanted
    fields.

    Args:
        model: compiled model with the elements.
        present_values: present fields.
        target_values: wanted fields.
        tolerance: relative difference that is ignored.

    Returns:
        One statement with the wanted values for each element with differences.
    """
    statements = []
    for element in list_elements(model):
        field_address = get_field_address(model, element)
        values = {}
        for attribute in ATTRIBUTES_BY_KIND[element.kind]:
            present_value, target_value = (
                attribute.read(present_values, field_address),
                attribute.read(target_values, field_address),
            )
            if not _is_equal(present_value, target_value, tolerance):
                values[attribute.name] = tuple(float(v) for v in np.atleast_1d(target_value))
        if element.kind == "body" and values:
            # An inertial must be written with all its attributes.
            values = list_all_attributes(model, element, target_values)
        if values:
            statements.append(AttributeStatement(element, values))
    return statements


def list_all_attributes(
    model: Any, element: ModelElement, target_values: Fields
) -> dict[str, Values]:
    """Read the wanted values of all attributes of an element.

    Args:
        model: compiled model with the element.
        element: the element.
        target_values: wanted fields.
    """
    field_address = get_field_address(model, element)
    return {
        attribute.name: tuple(
            float(v) for v in np.atleast_1d(attribute.read(target_values, field_address))
        )
        for attribute in ATTRIBUTES_BY_KIND[element.kind]
    }


def _is_equal(first: Any, second: Any, tolerance: float) -> bool:
    """Return whether two arrays are equal to within `tolerance` times the largest entry."""
    first, second = np.asarray(first, dtype=float), np.asarray(second, dtype=float)
    if first.shape != second.shape:
        return False
    scale = np.maximum(np.abs(first), np.abs(second)).max(initial=0.0)
    return bool((np.abs(first - second) <= tolerance * scale).all())


def get_enum_word(name: str, value: float) -> str:
    """Return the MJCF word for a value of an enumeration.

    Args:
        name: name of the attribute.
        value: number of the enumeration.
    """
    import mujoco

    if name == "interp":
        return ("zoh", "linear", "cubic")[int(value)]
    choice = getattr(mujoco, ENUM_ATTRIBUTES[name])(int(value))
    text = str(choice.name).partition("_")[2].lower()
    return {"rk4": "RK4", "euler": "Euler"}.get(text, text)
