"""Change an editable MuJoCo model (mujoco.MjSpec) to wanted numbers, and format it as MJCF.

The numbers are fields of the compiled model, which follow from attributes of the spec
(`mjcf_attributes`).
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from sims.core.simulator import Array
from sims.robot.export.mjcf_attributes import (
    ANGLE_ATTRIBUTES,
    ATTRIBUTES_BY_KIND,
    ENUM_ATTRIBUTES,
    FLAG_ATTRIBUTES,
    INTEGER_ATTRIBUTES,
    AttributeStatement,
    Fields,
    Kind,
    ModelElement,
    find_missing_statements,
)
from sims.robot.robot_model import RobotModel

MAX_CORRECTION_ROUNDS = 4
"""Maximum number of rounds that restore values which another change has modified."""
ROUNDING_TOLERANCE = 1e-13
"""Relative difference between compiled numbers that counts as rounding."""
EXACT_DIGITS = 17
"""Number of significant digits with which every float64 number is read back exactly."""


def compile_changed_spec(robot: RobotModel, target_values: Fields) -> tuple[Any, Any]:
    """Change a copy of the robot's editable model until it compiles to the wanted fields.

    The compiler derives fields (numbers of the compiled model) from attributes of the file, so a
    change may also modify values that should stay. So in each of at most `MAX_CORRECTION_ROUNDS`
    rounds:

    1. Find the attributes whose fields differ from the wanted ones; without any, return the model.
    2. Set them, and compile the model.

    Args:
        robot: model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        target_values: wanted fields of the compiled model.

    Returns:
        The changed mujoco.MjSpec, and the compiled model.

    Raises:
        RuntimeError: fields still differ after the last round; this is a program error.
    """
    spec, model = robot.spec.copy(), robot.compiled
    elements = _index_spec_elements(spec)
    tolerance = 0.0  # Later rounds ignore rounding by the compiler.
    for _ in range(MAX_CORRECTION_ROUNDS):
        # 1. Differences.
        statements = find_missing_statements(model, target_values, tolerance)
        if not statements:
            return spec, model
        # 2. Changes. The kind "body" means the mass and inertia of a body.
        for statement in statements:
            set_attributes(elements[statement.element], statement)
        if any(statement.element.kind == "body" for statement in statements):
            _keep_masses(spec, target_values)
        model, tolerance = spec.compile(), ROUNDING_TOLERANCE
    missing_statements = find_missing_statements(model, target_values, tolerance)
    if missing_statements:
        raise RuntimeError(f"{robot.path}: the model does not take {missing_statements[0]}")
    return spec, model


def _keep_masses(spec: Any, target_values: Fields) -> None:
    """Change compiler settings so that MuJoCo uses the masses and inertias of bodies as specified.

    By default settings of a file, it may compute them from shapes, or scale them to a total mass.

    Args:
        spec: the model as an `MjSpec`, changed in place.
        target_values: target fields of the compiled model.
    """
    import mujoco

    if spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
        spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    if spec.compiler.settotalmass > 0:
        spec.compiler.settotalmass = float(target_values["body_mass"].sum())


def _index_spec_elements(spec: Any) -> dict[ModelElement, Any]:
    """Return the elements of an editable model (`mujoco.MjSpec`) by kind and compiled number.

    A body is there twice: as ``body`` for its inertial, and as ``frame`` for its pose. The options
    of the model are the element ``option`` with the number 0.

    Args:
        spec: editable model; it is compiled here.

    Returns:
        Elements of the spec, whose attributes can be set, by kind and number.
    """
    # Elements have numbers only after compilation.
    spec.compile()
    elements_by_kind: dict[Kind, Any] = {
        "joint": spec.joints,
        "body": spec.bodies,
        "frame": spec.bodies,
        "actuator": spec.actuators,
        "geom": spec.geoms,
        "pair": spec.pairs,
    }
    elements = {
        ModelElement(kind, element.id): element
        for kind, of_kind in elements_by_kind.items()
        for element in of_kind
    }
    return elements | {ModelElement("option", 0): spec.option}


def set_attributes(element: Any, statement: AttributeStatement) -> None:
    """Set attributes of an element of an editable MuJoCo model.

    Values from the compiled model are converted to the form that the editable model expects:
    enumerations, flags, integers, degrees. Other attributes that would take precedence over the new
    values are reset.

    Args:
        element: element of a `mujoco.MjSpec`; it is changed in place.
        statement: attributes with their values in the units of the compiled model.
    """
    import mujoco

    # 1. Values.
    kind = statement.element.kind
    spec_names = {attribute.name: attribute.spec for attribute in ATTRIBUTES_BY_KIND[kind]}
    for name, values in statement.values.items():
        if name in ENUM_ATTRIBUTES:
            value: Any = getattr(mujoco, ENUM_ATTRIBUTES[name])(int(values[0]))
        elif name in FLAG_ATTRIBUTES:
            limit_states = mujoco.mjtLimited
            value = limit_states.mjLIMITED_TRUE if values[0] else limit_states.mjLIMITED_FALSE
        elif name in INTEGER_ATTRIBUTES:
            value = int(values[0])
        elif kind == "frame" and name == "pos":
            value = _convert_to_inner_frame(element, values)
        else:
            value = _convert_to_attribute(element, name, spec_names[name], values)
        setattr(element, spec_names[name], value)
    # 2. Attributes that would take precedence: a full tensor, or another form of the orientation of
    # an inertial, and `springdamper` of a joint.
    if kind == "body":
        element.explicitinertial = True
        element.fullinertia = np.full(6, np.nan)
        element.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    if kind == "joint" and {"damping", "stiffness"} & set(statement.values):
        element.springdamper = (0.0, 0.0)


def _convert_to_inner_frame(body: Any, position: Sequence[float]) -> Array:
    """Convert the position of a body from its parent body's frame to the innermost frame around it.

    MuJoCo replaces bodies that it fuses into their parents by elements ``<frame>``, which may be
    nested. The position of a body in the editable model is relative to the innermost of them, but
    in the compiled model to the parent. First the pose of the innermost frame in the parent is
    composed, from the inside to the outside.

    Args:
        body: body of the editable model; without frames the position stays as it is.
        position: x, y, z in m.
    """
    # Importing scipy.spatial takes 0.1 s, and most model files have no fused bodies.
    from scipy.spatial.transform import Rotation

    # Pose of the innermost frame in the frame reached so far, at last in the parent body.
    rotation, origin = Rotation.identity(), np.zeros(3)
    frame = body.frame
    while frame is not None:
        w, *xyz = frame.quat  # SciPy expects the real part last
        outer = Rotation.from_quat([*xyz, w])
        rotation, origin = outer * rotation, frame.pos + outer.apply(origin)
        frame = frame.frame
    result: Array = rotation.inv().apply(np.asarray(position) - origin)
    return result


def _convert_to_attribute(element: Any, name: str, attribute: str, values: Sequence[float]) -> Any:
    """Convert values to the form of a spec attribute: a number, or an array padded with zeros.

    Angles of a hinge are converted to degrees if the spec's compiler uses degrees.

    Args:
        element: element of the spec.
        name: name of the attribute in an MJCF.
        attribute: its name in the spec.
        values: its numbers, angles in rad.
    """
    import mujoco

    if name in ANGLE_ATTRIBUTES and element.type == mujoco.mjtJoint.mjJNT_HINGE:
        return float(np.rad2deg(values[0])) if element.compiler.degree else values[0]
    shape = np.shape(getattr(element, attribute))
    if not shape:
        return values[0]
    # A spec may have more or fewer numbers than the compiled model.
    padded = np.zeros(shape)
    padded[: len(values)] = values[: len(padded)]
    return padded


def format_spec(spec: Any, folder: Path) -> str:
    """Format an editable MuJoCo model as MJCF with full precision and absolute asset folders.

    MuJoCo writes six digits by default, which would change the motion. Angles and other values keep
    the notation of the model file.

    Args:
        spec: compiled `mujoco.MjSpec`; it must not be used afterwards.
        folder: folder to which the paths of its assets are relative.

    Returns:
        The MJCF text.

    Raises:
        RuntimeError: this MuJoCo library has no function that sets the number of digits.
    """
    spec.meshdir = str(folder / spec.meshdir)
    spec.texturedir = str(folder / spec.texturedir)
    spec.compiler.savecompiled = False
    spec.compiler.savecanonical = False
    # The number of digits is a setting of MuJoCo's library, which is restored afterwards.
    library = _load_library()
    try:
        digits = library._mjPRIVATE__get_xml_precision()
        library._mjPRIVATE__set_xml_precision(EXACT_DIGITS)
    except AttributeError:
        raise RuntimeError("this MuJoCo writes models with six digits only") from None
    try:
        return str(spec.to_xml())
    finally:
        library._mjPRIVATE__set_xml_precision(digits)


@cache
def _load_library() -> Any:
    """Load MuJoCo's shared library; its Python module does not expose the number of digits."""
    import mujoco

    folder = Path(mujoco.__file__).parent
    patterns = ("libmujoco*.so*", "libmujoco*.dylib", "mujoco.dll")  # Linux, macOS, Windows
    path, *_ = [path for pattern in patterns for path in sorted(folder.glob(pattern))]
    return ctypes.CDLL(str(path))
