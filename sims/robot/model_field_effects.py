"""Effects that are written into fields of a compiled robot model.

With the coefficient c, and the value that the model file specifies at a joint, an actuator or a
body:

* (1) Added: value + c, at least zero: damping, dry friction, stiffness, armature.
* (2) Scaled: value times 1 + c, with 1 + c at least `MIN_FACTOR`.
* (3) Moved: the centre of mass is moved by c (3 numbers, m) in the body frame.
* (4) Tilted: gravity plus g c_x along x and g c_y along y, with the magnitude g of the file's
  gravity.
* (5) Limited: the file's range restricted to [-c, c]; a limit of zero has no effect.
* (6) Turned: an axis a becomes exp([r]) a with the rotation vector r = c (3 numbers, rad) in the
  body frame (O. Rodrigues, J. Math. Pures Appl. 5, 380, 1840).
* (7) Loaded: a point mass m at p on a body with mass m_0, centre of mass p_0 and inertia tensor I_0
  about it gives mass m_0 + m, centre p_1 = (m_0 p_0 + m p) / (m_0 + m) and tensor
  I_0 + m_0 J(p_0 - p_1) + m J(p - p_1), with J(d) = |d|^2 1 - d d' (parallel axis theorem).
* (8) Rounded: the radius of a geom times 1 + c, with the volumes that bound it: radius r and half
  axes h become r + d and h + d, with the change d of the largest size if it is positive.
* (9) Softened: `solref` (t, z) of a contact becomes (t (1 + c), z), or (t, z (1 + c)) for its
  damping. In the direct form (-k, -b), k is proportional to 1 / (t z)^2 and b to 1 / t.

`dynamics.mujoco_batch` writes these fields, `export.model_file_totals` reads the numbers in them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from sims.core.effect import ActiveEffects, Effect
from sims.core.simulator import Array
from sims.robot.contact_pairs import find_geom, find_pair
from sims.robot.coupled_drives import COUPLING_FIELD, get_coupling_address
from sims.robot.dry_friction import write_friction_form
from sims.robot.dynamics.series_joints import is_series_effect
from sims.robot.inertia_tensors import (
    compute_inertia_tensors,
    compute_point_inertias,
    compute_principal_axes,
)
from sims.robot.places.observable_axes import observable_tilts
from sims.robot.robot_model import RobotModel

MIN_FACTOR = 1e-6
"""Minimum factor of a mass or a gain, so that none becomes zero or negative."""


Fields = Mapping[str, Any]
"""Model fields of L batch elements by name, arrays (L, ...)."""

FieldWriter = Callable[[Fields, RobotModel, str, Array], None]
"""Function that changes fields in place, from robot, place and coefficients (K, L)."""


@dataclass(frozen=True)
class ModelField:
    """An element of a field of mujoco.MjModel that holds a number of the model file.

    Attributes:
        name: name of the field, such as ``dof_damping``; ``opt.gravity`` for a field of the
            options.
        address: index of the element.
        sign: -1 if the field holds the negative of the number, such as the bias of a servo.
    """

    name: str
    address: tuple[int, ...]
    sign: int = 1


Find = Callable[[RobotModel, str], "list[list[ModelField]]"]
"""Function that finds the elements of each coefficient, by robot and place."""

Operation = Literal["abs", "add", "scale"]
"""Operation that applies a random number to a field: replace, add to, or multiply its number."""


@dataclass(frozen=True)
class ModelFieldEffect:
    """An effect that is written into fields of the model.

    Attributes:
        fields: names of the fields, as in ``mujoco.batch.Batch.expand``.
        write: changes the fields, which contain the values of the file or the result of another
            effect.
        changes_derived_constants: whether MuJoCo derives constants from the fields, so that
            ``set_const`` must be called; this requires a model of `compile_batch_model`.
        find: finds the elements that hold the number of each coefficient; None if no element does.
        operation: operation that applies a random number to these elements. A position is shifted;
            a tensor or a vector is scaled, so that it keeps its direction.
    """

    fields: tuple[str, ...]
    write: FieldWriter
    changes_derived_constants: bool = False
    find: Find | None = None
    operation: Operation = "abs"


def add_to_file_value(file_value: Any, c: Any) -> Any:
    """Add a coefficient to a value; the sum is at least zero, or the value if it is negative.

    Args:
        file_value: value in the model file, number or array.
        c: the coefficient, of the same shape.
    """
    return np.maximum(file_value + c, np.minimum(file_value, 0.0))


def compute_factor(c: Any) -> Any:
    """Return the factor 1 + c of a scaled number, at least `MIN_FACTOR`."""
    return np.maximum(1.0 + c, MIN_FACTOR)


def is_control_set_point(robot: RobotModel, number: int, term: int) -> bool:
    """Return whether an actuator's control is a set point of its position or its velocity.

    The actuator's force is gain * control + b_0 + b_1 * position + b_2 * velocity. The control is
    a set point of the quantity whose bias parameter b is the negative gain.

    Args:
        robot: robot with the actuator.
        number: number of the actuator.
        term: index of the quantity in `biasprm`: 1 for the position, 2 for the velocity.
    """
    import mujoco

    model = robot.compiled
    gain, bias = model.actuator_gainprm[number], model.actuator_biasprm[number]
    fixed = int(model.actuator_gaintype[number]) == int(mujoco.mjtGain.mjGAIN_FIXED)
    # With a position gain as well, the set point is that of the position.
    return bool(fixed and gain[0] == -bias[term] and (term == 1 or bias[1] == 0))


def _make_finder(name: str, *index: int) -> Find:
    """Return a function that finds one number of a joint or a body in a field of the model.

    The beginning of the field's name tells what its rows are: ``dof_`` velocities, ``qpos0``
    positions, ``jnt_`` joints, and ``body_`` bodies.

    Args:
        name: name of the field, such as ``dof_damping``.
        index: index of the number within the row; the whole row if empty.
    """

    def find(robot: RobotModel, place: str) -> list[list[ModelField]]:
        """Return the only element of the only coefficient at the joint or body `place`."""
        if name.startswith("body_"):
            return [[ModelField(name, (robot.body(place).id, *index))]]
        joint = robot.joint(place)
        row_by_prefix = {"dof": joint.velocity, "jnt": joint.id, "qpos0": joint.position}
        prefix, _, _ = name.partition("_")
        return [[ModelField(name, (row_by_prefix[prefix], *index))]]

    return find


def _find_mass_centre_fields(robot: RobotModel, place: str) -> list[list[ModelField]]:
    """Return the fields of a body's centre of mass: one for each of the coefficients x, y and z.

    Args:
        robot: model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        place: name of the body.
    """
    body_id = robot.body(place).id
    return [[ModelField("body_ipos", (body_id, axis))] for axis in range(3)]


def _make_servo_gain_finder(term: int) -> Find:
    """Return a function that finds the model fields with the stiffness or the damping of a servo.

    A servo's force is gain * control + b_0 + b_1 * position + b_2 * velocity, so b_1 is the
    negative stiffness, and b_2 the negative damping. If the control is a set point of the position
    or the velocity, the gain is the stiffness or the damping, too.

    Args:
        term: 1 for the stiffness, 2 for the damping.
    """

    def find(robot: RobotModel, place: str) -> list[list[ModelField]]:
        """Return the fields with the same gain of the actuator `place`: gain (if any), and bias."""
        actuator_id = robot.actuator(place).id
        # The bias parameter is the negative gain (-1).
        servo_fields = [ModelField("actuator_biasprm", (actuator_id, term), -1)]
        if is_control_set_point(robot, actuator_id, term):
            servo_fields.insert(0, ModelField("actuator_gainprm", (actuator_id, 0)))
        return [servo_fields]

    return find


def _find_force_range_fields(robot: RobotModel, place: str) -> list[list[ModelField]]:
    """Return both ends of an actuator's force range, which one positive limit determines.

    The upper end is the limit, and the lower end is the negative limit (sign -1).

    Args:
        robot: model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        place: name of the actuator.
    """
    actuator_id = robot.actuator(place).id
    upper_end = ModelField("actuator_forcerange", (actuator_id, 1))
    lower_end = ModelField("actuator_forcerange", (actuator_id, 0), sign=-1)
    return [[upper_end, lower_end]]


def _view_element(fields: Fields, element: ModelField) -> Any:
    """Return an element of a field as a view (L, ...)."""
    return fields[element.name][(slice(None), *element.address)]


def _make_adding_writer(find: Find) -> FieldWriter:
    """Make a function that adds each coefficient to its number in the model, at least zero.

    Args:
        find: finds the model fields with the number of each coefficient, of which the first is
            changed.
    """

    def write(fields: Fields, robot: RobotModel, place: str, c: Array) -> None:
        """Add coefficients c (K, L) to the fields of L batch elements, in place.

        The function `find` gives the fields with the number of each coefficient; the first one is
        changed.

        Args:
            fields: model fields by name.
            robot: robot of the batch.
            place: name of the joint, body or actuator.
            c: coefficients, one row for each.
        """
        for (element, *_), coefficient in zip(find(robot, place), c, strict=True):
            view = _view_element(fields, element)
            view[...] = add_to_file_value(view, coefficient)

    return write


def _make_scaling_writer(find: Find) -> FieldWriter:
    """Make a function that scales a number of the model by 1 + c, in all fields that hold it.

    The factor is at least `MIN_FACTOR`, so that masses stay positive.

    Args:
        find: finds the model fields with the number; the effect has one coefficient.
    """

    def write(fields: Fields, robot: RobotModel, place: str, c: Array) -> None:
        """Scale the fields of L batch elements in place by 1 + c, with the coefficient c (1, L).

        The function `find` gives all fields that hold the number of this coefficient.

        Args:
            fields: model fields by name.
            robot: robot of the batch.
            place: name of the joint, body or actuator.
            c: coefficients, one row for each.
        """
        (elements,) = find(robot, place)
        for element in elements:
            view = _view_element(fields, element)
            # An element may be a vector, such as principal moments, which is scaled as a whole: the
            # factor gets as many axes.
            more_axes = [1] * (view.ndim - 1)
            view *= compute_factor(c[0]).reshape(-1, *more_axes)

    return write


def _make_shifting_writer(find: Find) -> FieldWriter:
    """Make a function that adds each coefficient to its number in the model, without a limit.

    Args:
        find: finds the model fields with the number of each coefficient, of which the first is
            changed.
    """

    def write(fields: Fields, robot: RobotModel, place: str, c: Array) -> None:
        """Add coefficients c (K, L) to the fields of L batch elements, in place.

        The function `find` gives the fields with the number of each coefficient; the first one is
        changed.

        Args:
            fields: model fields by name.
            robot: robot of the batch.
            place: name of the joint, body or actuator.
            c: coefficients, one row for each.
        """
        for (element, *_), coefficient in zip(find(robot, place), c, strict=True):
            _view_element(fields, element)[...] += coefficient

    return write


def _add_friction(fields: Fields, robot: RobotModel, place: str, c: Array) -> None:
    """Add c to the dry friction of a joint; the sum is at least zero.

    Where the friction increases, it also becomes stiff, so that the joint hardly creeps at rest;
    if the robot's `friction_form` is ``soft``, the file's solver parameters remain.

    Args:
        fields: model fields of L batch elements, changed in place.
        robot: robot with the joint.
        place: name of the joint.
        c: (1, L) coefficient in N m or N.
    """
    dof = robot.joint(place).velocity
    friction = fields["dof_frictionloss"]
    friction[:, dof] = add_to_file_value(friction[:, dof], c[0])
    # A reduced friction keeps the solver parameters of the file.
    has_added_friction = c[0] > 0
    write_friction_form(fields, robot, has_added_friction, dof)


def _scale_mass(fields: Fields, robot: RobotModel, place: str, c: Array) -> None:
    """Scale mass and inertia of a body by 1 + c, as if its density changed.

    Args:
        fields: fields of L batch elements, changed in place.
        robot: model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        place: name of the body.
        c: (1, L) coefficient.
    """
    body_id = robot.body(place).id
    fields["body_mass"][:, body_id] *= compute_factor(c[0])
    fields["body_inertia"][:, body_id] *= compute_factor(c[0])[:, None]


def _scale_gravity(fields: Fields, robot: RobotModel, place: str, c: Array) -> None:  # noqa: ARG001
    """Scale the file's gravity by 1 + c; a tilt that another effect has added is not scaled.

    Args:
        fields: fields of L batch elements, changed in place.
        robot: the robot, with the gravity of the file.
        place: unused.
        c: (1, L) coefficient.
    """
    gravity = fields["opt.gravity"]
    gravity += c[0][:, None] * robot.compiled.opt.gravity


def _tilt_gravity(fields: Fields, robot: RobotModel, place: str, c: Array) -> None:  # noqa: ARG001
    """Tilt gravity by adding g c_x along x and g c_y along y, with the magnitude g of gravity.

    Args:
        fields: fields of L batch elements, changed in place.
        robot: the robot, with the gravity of the file.
        place: unused.
        c: (2, L) coefficients c_x and c_y, rad.
    """
    size = float(np.linalg.norm(robot.compiled.opt.gravity))
    fields["opt.gravity"][:, :2] += size * c.T  # (4)


def _set_coupling(fields: Fields, robot: RobotModel, place: str, c: Array) -> None:
    fields["wrap_prm"][:, get_coupling_address(robot, place)] = c[0]


def _turn_axis(fields: Fields, robot: RobotModel, place: str, c: Array) -> None:
    """Turn the axis of a joint by a rotation vector in the frame of its body, where it is not zero.

    The axis a becomes exp([r]) a with the rotation vector r, by Rodrigues' formula. The result is
    normalised, because MuJoCo expects a unit vector.

    Args:
        fields: model fields of L batch elements, changed in place.
        robot: robot with the joint.
        place: name of the joint.
        c: (K, L) the K components of r in rad: all three, or only those that change the motion.
    """
    joint_id = robot.joint(place).id
    # The n batch elements with a rotation; only their axes change.
    tilted_elements = np.flatnonzero(c.any(axis=0))
    axis = fields["jnt_axis"][tilted_elements, joint_id]  # (n, 3)
    rotation_vector = np.zeros(axis.shape)
    components = range(3) if len(c) == 3 else observable_tilts(robot, place)
    rotation_vector[:, list(components)] = c[:, tilted_elements].T
    angle = np.linalg.norm(rotation_vector, axis=1, keepdims=True)
    unit_vector = rotation_vector / angle
    projection = np.sum(unit_vector * axis, axis=1, keepdims=True)
    rotated = (
        np.cos(angle) * axis
        + np.sin(angle) * np.cross(unit_vector, axis)
        + (1.0 - np.cos(angle)) * projection * unit_vector
    )
    length = np.linalg.norm(rotated, axis=1, keepdims=True)
    fields["jnt_axis"][tilted_elements, joint_id] = rotated / length


def _compensate_gravity(fields: Fields, robot: RobotModel, place: str, c: Array) -> None:
    """Add c to the gravity compensation of a body (1 means weightless); the sum is at least zero.

    Args:
        fields: fields of L batch elements, changed in place.
        robot: model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        place: name of the body.
        c: (1, L) coefficient.
    """
    compensation = fields["body_gravcomp"][:, robot.body(place).id]
    compensation[:] = add_to_file_value(compensation, c[0])


def _add_payload(fields: Fields, robot: RobotModel, place: str, c: Array) -> None:
    """Add a point mass to a body, in the batch elements whose payload is not zero.

    A point mass m at p on a body of mass m_0, centre of mass p_0 and tensor I_0 gives

        mass     m_0 + m
        centre   p_1 = (m_0 p_0 + m p) / (m_0 + m)
        tensor   I_0 + m_0 J(p_0 - p_1) + m J(p - p_1),  J(d) = |d|^2 1 - d d'

    MuJoCo stores principal moments and their axes, so the tensor is composed in the body frame,
    changed, and decomposed again into eigenvalues and eigenvectors.

    Args:
        fields: model fields of L batch elements, changed in place.
        robot: robot with the body.
        place: name of the body.
        c: (4, L) mass in kg, and its offset x, y, z in m from the file's centre of mass, in the
            body frame.
    """
    body_id = robot.body(place).id
    # The n batch elements with a payload: its mass (n,), and its place (n, 3) in the body frame.
    loaded = np.flatnonzero(c[0])
    payload = c[0, loaded]
    point = robot.compiled.body_ipos[body_id] + c[1:, loaded].T
    mass, centre = fields["body_mass"][loaded, body_id], fields["body_ipos"][loaded, body_id]
    total = mass + payload
    new_centre = (mass[:, None] * centre + payload[:, None] * point) / total[:, None]
    tensor = compute_inertia_tensors(
        fields["body_iquat"][loaded, body_id], fields["body_inertia"][loaded, body_id]
    )
    tensor += mass[:, None, None] * compute_point_inertias(centre - new_centre)
    tensor += payload[:, None, None] * compute_point_inertias(point - new_centre)
    moments, axes = compute_principal_axes(tensor)
    fields["body_mass"][loaded, body_id] = total
    fields["body_ipos"][loaded, body_id] = new_centre
    fields["body_inertia"][loaded, body_id] = moments
    fields["body_iquat"][loaded, body_id] = axes


def _limit_force(fields: Fields, robot: RobotModel, place: str, c: Array) -> None:
    """Restrict the force range of an actuator to [-c, c], in batch elements with c > 0.

    The result is the intersection with the range of the file. If this is empty, both ends are the
    end of the file's range that is nearer to [-c, c].

    Args:
        fields: model fields of L batch elements, changed in place.
        robot: robot with the actuator.
        place: name of the actuator.
        c: (1, L) limit of the force in N or N m.
    """
    actuator_id = robot.actuator(place).id
    is_limited, ranges = fields["actuator_forcelimited"], fields["actuator_forcerange"]
    has_limit = c[0] > 0
    # Where the model has no limit, its range has no meaning and counts as infinite.
    is_unlimited = has_limit & ~is_limited[:, actuator_id].astype(bool)
    ranges[is_unlimited, actuator_id] = (-np.inf, np.inf)
    new_range = np.stack([-c[0], c[0]], axis=1)[has_limit]
    low, high = ranges[has_limit, actuator_id].T
    # Both ends are moved into the present range, which gives the intersection or the nearer end.
    ranges[has_limit, actuator_id] = np.clip(new_range, low[:, None], high[:, None])
    is_limited[has_limit, actuator_id] = True


def _add_contact_friction(fields: Fields, robot: RobotModel, place: str, c: Array) -> None:
    """Add c to both sliding friction coefficients of a pair of geoms; the sum is at least zero.

    Args:
        fields: fields of L batch elements, changed in place.
        robot: model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        place: name of the pair.
        c: (1, L) coefficient.
    """
    sliding = fields["pair_friction"][:, find_pair(robot, place), :2]
    sliding[:] = add_to_file_value(sliding, c[0][:, None])


def _scale_radius(fields: Fields, robot: RobotModel, place: str, c: Array) -> None:
    """Scale the radius of a geom by 1 + c, without changing mass and inertia of its body.

    The radius of a sphere, capsule or cylinder is scaled, or all half axes of an ellipsoid. If the
    geom grows, the volumes by which MuJoCo searches for contacts grow by the change of its largest
    size; they may be too large, so they do not shrink with it.

    Args:
        fields: fields of L batch elements, changed in place.
        robot: model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        place: name of the geom.
        c: (1, L) coefficient.
    """
    import mujoco

    geom, model = find_geom(robot, place), robot.compiled
    is_ellipsoid = int(model.geom_type[geom]) == int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)
    # A view of the sizes to scale: three half axes, or the radius, the first of three sizes.
    size = fields["geom_size"][:, geom, : 3 if is_ellipsoid else 1]
    growth = np.maximum(compute_factor(c[0]) - 1.0, 0.0) * size.max(axis=1)
    size *= compute_factor(c[0])[:, None]
    # Radius of the bounding sphere, and half axes of the bounding box, whose centre comes first.
    fields["geom_rbound"][:, geom] += growth
    fields["geom_aabb"][:, geom, 3:] += growth[:, None]
    # Volumes of the geom's body in the bounding volume hierarchy; columns are centre and half axes.
    first = int(model.body_bvhadr[model.geom_bodyid[geom]])
    volumes = slice(first, first + int(model.body_bvhnum[model.geom_bodyid[geom]]))
    fields["bvh_aabb"][:, volumes, 3:] += growth[:, None, None]


def _make_solref_writer(index: int) -> FieldWriter:
    """Make a function that scales the time constant t or the damping ratio z of a contact by 1 + c.

    MuJoCo's `solref` is (t, z), or in the direct form the negative stiffness and damping (-k, -b).
    There, k is proportional to 1 / (t z)^2 and b to 1 / t, so a change of t changes both, and a
    change of z only k.

    Args:
        index: 0 for the time constant, 1 for the damping ratio.
    """

    def write(fields: Fields, robot: RobotModel, place: str, c: Array) -> None:
        """Scale a parameter of the pair of geoms `place` by 1 + c, in each of L batch elements.

        MuJoCo's `solref` is a time constant t and a damping ratio z (`index` 0 and 1), or the
        negative stiffness k and damping b, which change with them.

        Args:
            fields: model fields by name.
            robot: robot with the pair.
            place: name of the pair.
            c: (1, L) coefficient.
        """
        solref, factor = fields["pair_solref"][:, find_pair(robot, place)], compute_factor(c[0])
        is_direct = solref[:, 0] <= 0  # stiffness and damping, (L,)
        solref[~is_direct, index] *= factor[~is_direct]
        # A change of t or z changes k by the inverse square of the factor, and one of t also b.
        solref[is_direct, 0] *= factor[is_direct] ** -2
        if index == 0:
            solref[is_direct, 1] /= factor[is_direct]

    return write


CONTACT_FIELDS = frozenset({"pair_friction", "pair_solref"})
"""Model fields of pairs of geoms, which a model without elements `<pair>` lacks."""
_SERVO_FIELDS = ("actuator_gainprm", "actuator_biasprm")


def _make_effect(
    make_writer: Callable[[Find], FieldWriter],
    find: Find,
    *fields: str,
    changes_derived_constants: bool = False,
    operation: Operation = "abs",
) -> ModelFieldEffect:
    """Make an effect whose coefficients all change their elements in the same way.

    Args:
        make_writer: makes the function that changes the elements: it adds, scales or shifts.
        find: finds the elements of each coefficient.
        *fields: names of the fields with these elements.
        changes_derived_constants: as in `ModelFieldEffect`.
        operation: as in `ModelFieldEffect`.
    """
    return ModelFieldEffect(fields, make_writer(find), changes_derived_constants, find, operation)


MODEL_FIELD_EFFECTS: Mapping[str, ModelFieldEffect] = {
    "drag.linear": _make_effect(_make_adding_writer, _make_finder("dof_damping"), "dof_damping"),
    "drag.quadratic": _make_effect(
        _make_adding_writer, _make_finder("dof_dampingpoly", 0), "dof_dampingpoly"
    ),
    "friction.coulomb": ModelFieldEffect(
        ("dof_frictionloss", "dof_solref", "dof_solimp"),
        _add_friction,
        find=_make_finder("dof_frictionloss"),
    ),
    "spring.linear": _make_effect(
        _make_adding_writer, _make_finder("jnt_stiffness"), "jnt_stiffness"
    ),
    # A spring may soften.
    "spring.cubic": _make_effect(
        _make_shifting_writer, _make_finder("jnt_stiffnesspoly", 1), "jnt_stiffnesspoly"
    ),
    "inertia.armature": _make_effect(
        _make_adding_writer,
        _make_finder("dof_armature"),
        "dof_armature",
        changes_derived_constants=True,
    ),
    "mass.scale": ModelFieldEffect(
        ("body_mass", "body_inertia"),
        _scale_mass,
        changes_derived_constants=True,
        find=_make_finder("body_mass"),
    ),
    "mass.offset": _make_effect(
        _make_shifting_writer,
        _find_mass_centre_fields,
        "body_ipos",
        changes_derived_constants=True,
        operation="add",
    ),
    "inertia.scale": _make_effect(
        _make_scaling_writer,
        _make_finder("body_inertia"),
        "body_inertia",
        changes_derived_constants=True,
        operation="scale",
    ),
    "actuator.stiffness": _make_effect(
        _make_scaling_writer, _make_servo_gain_finder(1), *_SERVO_FIELDS
    ),
    "actuator.damping": _make_effect(
        _make_scaling_writer, _make_servo_gain_finder(2), *_SERVO_FIELDS
    ),
    "joint.zero": ModelFieldEffect(("qpos0",), _make_shifting_writer(_make_finder("qpos0"))),
    "joint.axis": ModelFieldEffect(("jnt_axis",), _turn_axis, changes_derived_constants=True),
    "link.length": ModelFieldEffect(
        ("body_pos",),
        _make_scaling_writer(_make_finder("body_pos")),
        changes_derived_constants=True,
    ),
    "gravity.compensation": ModelFieldEffect(
        ("body_gravcomp",), _compensate_gravity, changes_derived_constants=True
    ),
    "payload": ModelFieldEffect(
        ("body_mass", "body_ipos", "body_inertia", "body_iquat"),
        _add_payload,
        changes_derived_constants=True,
    ),
    "gravity.scale": ModelFieldEffect(
        ("opt.gravity",),
        _scale_gravity,
        find=lambda _robot, _place: [[ModelField("opt.gravity", ())]],
        operation="scale",
    ),
    "gravity.tilt": ModelFieldEffect(
        ("opt.gravity",),
        _tilt_gravity,
        find=lambda _robot, _place: [[ModelField("opt.gravity", (axis,))] for axis in (0, 1)],
    ),
    "joint.coupling": ModelFieldEffect((COUPLING_FIELD,), _set_coupling),
    "contact.friction": ModelFieldEffect(("pair_friction",), _add_contact_friction),
    "contact.softness": ModelFieldEffect(("pair_solref",), _make_solref_writer(0)),
    "contact.damping": ModelFieldEffect(("pair_solref",), _make_solref_writer(1)),
    "geom.radius": ModelFieldEffect(
        ("geom_size", "geom_rbound", "geom_aabb", "bvh_aabb"), _scale_radius
    ),
    "actuator.limit": ModelFieldEffect(
        ("actuator_forcelimited", "actuator_forcerange"),
        _limit_force,
        find=_find_force_range_fields,
    ),
}
"""Model-field effects by name.

Each acts at a place of its kind, and those of the world at any place, such as ``""``.
"""


def get_write_order(effect: str) -> int:
    """Return the sort key of an effect in the order in which model fields are written: 0 or 1.

    Two effects come last. A payload does, since errors of a body's own mass and inertia do not
    apply to it. In a URDF, a joint's zero is a turn about the axis, so it follows errors of the
    axis.
    """
    return int(effect in ("joint.zero", "payload"))


def model_fields(robot: RobotModel, effect: str, place: str) -> list[list[ModelField]]:
    """Find the elements of the compiled model that an effect changes, by coefficient.

    Args:
        robot: robot with the compiled model.
        effect: name of the effect, without its place.
        place: joint, actuator or body.

    Returns:
        For each coefficient, the elements that hold its number, the main one first; empty if the
        model has no such number.
    """
    field_effect = MODEL_FIELD_EFFECTS.get(effect)
    return field_effect.find(robot, place) if field_effect and field_effect.find else []


def operation_of(effect: str) -> Operation:
    """Return how a random number is applied to the field of an effect."""
    return MODEL_FIELD_EFFECTS[effect].operation if effect in MODEL_FIELD_EFFECTS else "abs"


def is_model_field_effect(effect: Effect) -> bool:
    """Return whether the engine writes the effect into fields of the MuJoCo model."""
    has_field = (effect.of or effect.name) in MODEL_FIELD_EFFECTS
    return is_series_effect(effect) or (has_field and effect.hook in ("value", "force", "contact"))


def changes_derived_constants(effect: Effect) -> bool:
    """Return whether MuJoCo derives constants from the model fields that the effect changes.

    An example is a mass, from which MuJoCo derives inverse weights of bodies and joints. An effect
    at one place has the name of the registered effect in `of`.
    """
    return is_model_field_effect(effect) and (
        is_series_effect(effect)
        or MODEL_FIELD_EFFECTS[effect.of or effect.name].changes_derived_constants
    )


def select_model_field_effects(acting: ActiveEffects) -> ActiveEffects:
    """Select the effects that are written into fields of the MuJoCo model."""
    return tuple((e, c) for e, c in acting if is_model_field_effect(e))
