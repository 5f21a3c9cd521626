"""MJCF attributes of model elements, and the fields of a compiled model with their values.

With this map a number of the compiled model can be written to a file, or set in a spec.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any, Literal, NamedTuple

import numpy as np

from sims.robot.integrator_settings import OPTION_EFFECTS

Kind = Literal["joint", "body", "frame", "actuator", "pair", "geom", "option", "compiler"]
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


def _get_element_values(model: Any, element: ModelElement, name: str, values: Any) -> Any:
    """Return the values of an element in a field of a compiled model.

    The beginning of the field's name tells what its rows are: velocities, positions, controls, or
    otherwise the elements themselves. An option has no rows.

    Args:
        model: compiled model.
        element: joint with one coordinate, body, actuator, pair, geom, or the options.
        name: name of the field.
        values: values of the field.
    """
    if name.startswith("opt."):
        return values
    # Fields with the address of an element's first row, by the beginning of the name of a field.
    address_fields = {
        "dof_": "jnt_dofadr",
        "qpos": "jnt_qposadr",
        "actuator_ctrl": "actuator_ctrladr",
    }
    for beginning, address_field in address_fields.items():
        if name.startswith(beginning):
            return values[getattr(model, address_field)[element.id]]
    return values[element.id]


class MjcfAttribute(NamedTuple):
    """An MJCF attribute, and where a compiled model stores its values.

    Attributes:
        name: name in the file.
        fields: names of the fields of the model with its values, one after another.
        spec: name in an MjSpec.
        column: column of its only value in the row of the element; None for all columns.
    """

    name: str
    fields: tuple[str, ...]
    spec: str
    column: int | None = None

    def read(self, fields: Fields, model: Any, element: ModelElement) -> Values:
        """Return the values of the attribute of an element, as numbers.

        Args:
            fields: fields from which they are read, by name.
            model: compiled model, which tells the row of the element in each field.
            element: the element.
        """
        # Fields have one batch element, 0.
        parts = [
            np.ravel(_get_element_values(model, element, name, fields[name][0]))
            for name in self.fields
        ]
        values = tuple(np.concatenate(parts).astype(float).tolist())
        return values if self.column is None else (values[self.column],)


def _make_attributes(fields: Mapping[str, str], **spec_names: str) -> tuple[MjcfAttribute, ...]:
    """Make the attributes of a kind of elements.

    Args:
        fields: names of the fields, separated by blanks, by name of the attribute.
        spec_names: names in an MjSpec of the attributes that have another name there.
    """
    return tuple(
        MjcfAttribute(name, tuple(field_names.split()), spec_names.get(name, name))
        for name, field_names in fields.items()
    )


_ACTUATOR_ATTRIBUTES = (
    *("dyntype", "dynprm", "gaintype", "gainprm", "biastype", "biasprm"),
    *("ctrllimited", "ctrlrange", "forcelimited", "forcerange", "delay"),
)
ATTRIBUTES_BY_KIND: Mapping[Kind, tuple[MjcfAttribute, ...]] = {
    "joint": _make_attributes(
        {
            # Polynomials: the linear coefficient, and those of higher order.
            "damping": "dof_damping dof_dampingpoly",
            "frictionloss": "dof_frictionloss",
            "solreffriction": "dof_solref",
            "solimpfriction": "dof_solimp",
            "stiffness": "jnt_stiffness jnt_stiffnesspoly",
            "springref": "qpos_spring",
            "armature": "dof_armature",
            "axis": "jnt_axis",
            "ref": "qpos0",
        },
        solreffriction="solref_friction",
        solimpfriction="solimp_friction",
    ),
    "body": _make_attributes(
        {
            "pos": "body_ipos",
            "quat": "body_iquat",
            "mass": "body_mass",
            "diaginertia": "body_inertia",
        },
        pos="ipos",
        quat="iquat",
        diaginertia="inertia",
    ),
    "frame": _make_attributes({"pos": "body_pos", "gravcomp": "body_gravcomp"}),
    "actuator": (
        *_make_attributes({name: f"actuator_{name}" for name in _ACTUATOR_ATTRIBUTES}),
        MjcfAttribute("nsample", ("actuator_history",), "nsample", 0),
        MjcfAttribute("interp", ("actuator_history",), "interp", 1),
    ),
    "pair": _make_attributes({"friction": "pair_friction", "solref": "pair_solref"}),
    "geom": _make_attributes({"size": "geom_size"}),
    "option": _make_attributes(
        {name: f"opt.{name}" for name in (*OPTION_EFFECTS.values(), "gravity")}
    ),
    "compiler": (),
}
"""MJCF attributes by kind of element; those of an inertial belong to its body."""

_FIELD_NAMES = {
    name
    for attributes in ATTRIBUTES_BY_KIND.values()
    for attribute in attributes
    for name in attribute.fields
} | {"geom_rbound", "geom_aabb", "bvh_aabb"}
"""Names of the fields that store attributes, or follow from the sizes of geoms."""

FLAG_ATTRIBUTES = frozenset({"ctrllimited", "forcelimited"})
ANGLE_ATTRIBUTES = frozenset({"ref", "springref"})
"""Attributes of a hinge in the unit of the file's angles."""
INTEGER_ATTRIBUTES = frozenset({"nsample", "interp", "noslip_iterations", "iterations"})
ENUM_ATTRIBUTES: Mapping[str, str] = {
    "dyntype": "mjtDyn",
    "gaintype": "mjtGain",
    "biastype": "mjtBias",
    "integrator": "mjtIntegrator",
    "cone": "mjtCone",
    "solver": "mjtSolver",
}
"""Attributes whose values are words, and the MuJoCo enumerations of these words."""


def copy_model_fields(model: Any) -> Fields:
    """Copy the fields of a compiled model that store attributes."""
    return {name: np.array(attrgetter(name)(model))[None] for name in _FIELD_NAMES}


def list_elements(model: Any) -> list[ModelElement]:
    """List the elements of a model whose attributes can be written.

    They are joints with one coordinate, bodies, actuators with one control, pairs of geoms, round
    geoms, and the options.

    Args:
        model: compiled model.
    """
    import mujoco

    scalar_types = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    elements = [
        ModelElement("joint", i)
        for i in range(model.njnt)
        if int(model.jnt_type[i]) in scalar_types
    ]
    # Inertials and positions of the bodies. Body 0 is the world.
    elements += [ModelElement("body", i) for i in range(1, model.nbody)]
    elements += [ModelElement("frame", i) for i in range(1, model.nbody)]
    scalar_actuators = [
        i for i in range(len(model.actuator_ctrlnum)) if int(model.actuator_ctrlnum[i]) == 1
    ]
    elements += [ModelElement("actuator", i) for i in scalar_actuators]
    elements += [ModelElement("pair", i) for i in range(model.npair)]
    # The sizes of other geoms come from meshes, or have no limits.
    round_kinds = ("SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER")
    types = {int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")) for kind in round_kinds}
    elements += [
        ModelElement("geom", i) for i in range(model.ngeom) if int(model.geom_type[i]) in types
    ]
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
    """Find the attributes of a model file in which two sets of model fields differ.

    These have to be written into the file so that it compiles to the wanted fields. An inertial
    (mass, centre of mass and inertia of a body) is complete if any of its values differs.

    Args:
        model: compiled model with the elements.
        present_values: fields of the present model.
        target_values: fields that the model should have.
        tolerance: relative difference that is ignored.

    Returns:
        One statement with the wanted values for each element with differences.
    """
    statements = []
    for element in list_elements(model):
        values = {}
        for attribute in ATTRIBUTES_BY_KIND[element.kind]:
            present_value = attribute.read(present_values, model, element)
            target_value = attribute.read(target_values, model, element)
            if not _is_equal(present_value, target_value, tolerance):
                values[attribute.name] = target_value
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

    Returns:
        Values by name of the MJCF attribute.
    """
    return {
        attribute.name: attribute.read(target_values, model, element)
        for attribute in ATTRIBUTES_BY_KIND[element.kind]
    }


def _is_equal(first: Values, second: Values, tolerance: float) -> bool:
    """Return whether two lists of values are equal to within a relative tolerance.

    Args:
        first: values of an attribute.
        second: as many other values.
        tolerance: largest difference, relative to the largest absolute value of both.
    """
    scale = np.maximum(np.abs(first), np.abs(second)).max(initial=0.0)
    return bool((np.abs(np.subtract(first, second)) <= tolerance * scale).all())


def get_enum_word(name: str, value: float) -> str:
    """Return the MJCF word for a value of an enumeration, such as ``affine`` for mjBIAS_AFFINE.

    Args:
        name: name of the attribute, such as ``biastype``.
        value: number of the enumeration.
    """
    import mujoco

    if name == "interp":
        return ("zoh", "linear", "cubic")[int(value)]
    choice = getattr(mujoco, ENUM_ATTRIBUTES[name])(int(value))
    _, _, word = str(choice.name).partition("_")
    # Most words are in small letters in a file.
    return {"rk4": "RK4", "euler": "Euler"}.get(word.lower(), word.lower())


class UnstatableCauseError(Exception):
    """A model file cannot state a cause; the message states the reason as a clause."""
