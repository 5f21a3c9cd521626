"""Simplify a robot's model: remove elements that do not influence its motion.

The batch elements of a simulation copy the whole model, for every candidate that adds joints to it.
Meshes, textures and geoms that cannot collide take most of the memory and of the compile time. They
do not influence the motion once the masses that follow from them are known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from sims.core.freed_memory import release_free_memory
from sims.robot.mujoco_messages import capture_mujoco_warnings
from sims.robot.parsing.collision_filters import find_colliding_geoms
from sims.robot.parsing.collision_hulls import (
    MIN_FACES,
    TESTED_VERSION_PREFIX,
    CollisionShapes,
    Hull,
    add_hull,
    add_memory_reserve,
    has_equal_contacts,
    has_large_enough_buffers,
    read_hull,
)
from sims.robot.robot_model import RobotModel, cache_per_robot

SHAPE_SENSORS = frozenset(
    f"mjSENS_{name}"
    for name in ("RANGEFINDER", "GEOMDIST", "GEOMNORMAL", "GEOMFROMTO", "TACTILE", "PLUGIN")
)
"""Sensor types that measure shapes which need not collide."""
IGNORED_FIELD_PREFIXES = (
    "geom_", "mesh_", "mat_", "tex_", "skin_", "hfield_", "bvh_", "oct_", "vis", "stat",
    "dof_length", "body_margin",
)  # fmt: skip
"""Prefixes of model fields that do not influence the motion.

They are shapes (colliding ones are compared by `GEOM_FIELDS`), lengths that decide which bodies
sleep, and margins that bound the search for contacts.
"""
GEOM_FIELDS = (
    "geom_type", "geom_bodyid", "geom_condim", "geom_priority", "geom_sameframe", "geom_solmix",
    "geom_solref", "geom_solimp", "geom_size", "geom_aabb", "geom_rbound", "geom_pos", "geom_quat",
    "geom_friction", "geom_margin", "geom_gap", "geom_fluid",
)  # fmt: skip
"""Fields on which contacts of a geom depend, in addition to its mesh and its contact partners."""


DEFAULT_JOINT_RANGE = (-1.0, 1.0)
"""Range in rad or m of joints without a range, from which compared poses are drawn."""


@cache_per_robot
def strip_assets(robot: RobotModel) -> RobotModel:
    """Remove the elements of a robot's model that do not influence its motion.

    Masses and inertias are those of the whole compiled model. Geoms that can collide stay, with the
    convex hulls of their meshes.

    Args:
        robot: robot as read from its model file.

    Returns:
        The robot with a smaller spec, whose motion is bitwise equal; the robot itself if that is
        impossible.
    """
    import mujoco

    model = robot.compiled
    if _needs_shapes(model):
        return robot
    try:
        stripped = _strip_model(robot)
    # Any compiler error concerns the smaller model only, since the whole model has compiled.
    except (ValueError, RuntimeError):
        stripped = robot
    # MuJoCo caches all meshes that it has read, for specs that may use them again.
    mujoco.mj_clearCache(mujoco.mj_getCache())
    release_free_memory()
    return stripped


def _strip_model(robot: RobotModel) -> RobotModel:
    """Remove the elements of a robot's model that do not influence its motion, if it stays equal.

    1. State the masses of bodies, delete visual shapes and geoms that cannot collide, and replace
       colliding meshes by their convex hulls.
    2. Let compiled models copy the data of the hulls from the whole model. The spec gets extra
       meshes that reserve memory for them.
    3. Compare the smaller model with the whole one: fields that matter, and contacts in random
       poses. If anything differs, return the robot itself.

    Args:
        robot: robot as read from its model file.

    Returns:
        The robot with the smaller spec; the robot itself if any of the compared numbers differs.

    Raises:
        ValueError: MuJoCo rejects the smaller model.
    """
    # 1. Smaller model.
    model = robot.compiled
    spec = robot.spec.copy()
    with capture_mujoco_warnings():
        spec.compile()  # Compilation assigns numbers to the elements.
    _write_inertials(spec, model)
    hull_by_mesh, geom_numbers = _reduce_geoms(spec, model)
    spec.discard_visual()
    spec.compiler.discardvisual = False
    used_height_fields = {geom.hfieldname for geom in spec.geoms}
    unused_height_fields = [h for h in spec.hfields if h.name not in used_height_fields]
    for asset in [*spec.skins, *unused_height_fields]:
        spec.delete(asset)
    # 2. Data of hulls.
    stripped = replace(robot, spec=spec)
    if hull_by_mesh:
        add_memory_reserve(spec, stripped.compile(spec), model, hull_by_mesh)
        hull_geoms = {
            geom.name: geom_numbers[geom.name]
            for geom in spec.geoms
            if geom.meshname in hull_by_mesh
        }
        stripped = replace(stripped, shapes=CollisionShapes.read(model, hull_by_mesh, hull_geoms))
    # 3. Comparison.
    is_equal = _has_equal_motion(model, stripped.compiled, geom_numbers)
    if is_equal and hull_by_mesh:
        is_equal = has_large_enough_buffers(stripped.compiled, model)
        is_equal = is_equal and has_equal_contacts(
            robot.compiled,
            stripped.compiled,
            geom_numbers,
            {
                joint.position: joint.range or DEFAULT_JOINT_RANGE
                for joint in robot.joints
                if joint.has_one_coordinate
            },
        )
    return stripped if is_equal else robot


@cache_per_robot
def strip_shapes(robot: RobotModel) -> RobotModel:
    """Remove all geoms that no other element refers to, so that nothing collides any more.

    The result tells whether elements that are added to it compile. Compiling it takes a
    millisecond, and fails for the same reasons as compiling the whole model.

    Args:
        robot: robot as read from its model file.

    Returns:
        The robot without contacts; the robot itself if MuJoCo cannot compile it without shapes, or
        if it then has other coordinates.
    """
    spec = strip_assets(robot).spec.copy()
    # Geoms that cannot collide count as visual.
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    try:
        spec.discard_visual()
        stripped_robot = replace(robot, spec=spec)
        has_equal_coordinates = stripped_robot.compiled.nq == robot.compiled.nq
    except ValueError:  # MuJoCo's compiler needs the shapes.
        return robot
    return stripped_robot if has_equal_coordinates else robot


def _needs_shapes(model: Any) -> bool:
    """Return whether anything depends on geoms other than contacts of convex hulls.

    Only otherwise may meshes be replaced by their hulls, and geoms that cannot collide be removed.
    Examples are rangefinders, signed distance fields, fluid forces and sleeping bodies.

    Args:
        model: Compiled model of MuJoCo.
    """
    import mujoco

    sensor_types = {mujoco.mjtSensor(int(kind)).name for kind in model.sensor_type}
    has_sdf_geom = int(mujoco.mjtGeom.mjGEOM_SDF) in model.geom_type
    has_sleep = model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP
    has_fluid_forces = model.geom_fluid.any()
    return bool(
        sensor_types & SHAPE_SENSORS
        or model.nflex
        or model.nplugin
        or has_sdf_geom
        or has_fluid_forces
        or has_sleep
    )


def _write_inertials(spec: Any, model: Any) -> None:
    """Write the masses and inertias of the compiled model into a spec.

    The masses then do not depend on geoms, which can be removed without changing the motion.

    Args:
        spec: the model as an `MjSpec`, changed in place.
        model: the model, compiled from it.
    """
    import mujoco

    # Settings of the compiler that would change stated masses: computing them from geoms, repairing
    # or bounding them, and scaling them to a total mass.
    for compiler in (spec.compiler, *(body.compiler for body in spec.bodies)):
        compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
        compiler.balanceinertia = False
        compiler.boundmass = compiler.boundinertia = 0.0
        compiler.settotalmass = -1.0
    for body in spec.bodies:
        body_id = body.id
        # Body 0 is the world.
        body.explicitinertial = bool(body_id and model.body_mass[body_id] > 0)
        if not body.explicitinertial:
            continue
        body.mass, body.inertia = float(model.body_mass[body_id]), model.body_inertia[body_id]
        body.ipos, body.iquat = model.body_ipos[body_id], model.body_iquat[body_id]
        # Other forms of a tensor and of an orientation would take precedence.
        body.fullinertia = np.full(6, np.nan)
        body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT


def _reduce_geoms(spec: Any, model: Any) -> tuple[dict[str, Hull], dict[str, int]]:
    """Make geoms that cannot collide visual, and reduce the meshes of the others to convex hulls.

    A geom with a mesh is one of these cases:

    * The compiler has fitted a primitive, such as a box, to the mesh: the geom becomes it.
    * It collides with a large mesh: the mesh becomes its convex hull. Only in the tested version
      of MuJoCo, because contacts depend on the order of the hull's vertices.
    * Otherwise it stays as it is.

    Args:
        spec: the model as an `MjSpec`, changed in place.
        model: the model, compiled from it.

    Returns:
        The hulls by the names of their meshes, and the numbers of all geoms in the compiled model
        by their names; unnamed ones get a name.
    """
    import mujoco

    collision_mask = find_colliding_geoms(model)
    is_tested_version = mujoco.__version__.startswith(TESTED_VERSION_PREFIX)
    hull_by_mesh: dict[str, Hull] = {}
    geom_numbers: dict[str, int] = {}
    # The numbers are collected first, since a spec loses them when it is edited.
    for geom, geom_id in [(geom, geom.id) for geom in spec.geoms]:
        geom.name = geom.name or f"simgap.geom{geom_id}"
        geom_numbers[geom.name] = geom_id
        if not collision_mask[geom_id]:
            geom.contype = geom.conaffinity = 0
        if not geom.meshname:
            continue
        mesh = int(model.geom_dataid[geom_id])
        kind = mujoco.mjtGeom(int(model.geom_type[geom_id]))
        if kind != mujoco.mjtGeom.mjGEOM_MESH:
            # The compiler has fitted a primitive.
            geom.type, geom.size, geom.meshname = kind, model.geom_size[geom_id], ""
        elif is_tested_version and collision_mask[geom_id] and model.mesh_facenum[mesh] > MIN_FACES:
            hull = hull_by_mesh.get(geom.meshname) or read_hull(model, mesh)
            if hull is None:
                continue
            hull_by_mesh[geom.meshname] = hull
        else:
            continue  # The geom stays as it is.
        # The compiler may have moved the frame of the mesh, so the compiled pose is stated.
        geom.set_frame(geom.parent.add_frame())
        geom.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
        geom.pos, geom.quat = model.geom_pos[geom_id], model.geom_quat[geom_id]
    for mesh in [mesh for mesh in spec.meshes if mesh.name in hull_by_mesh]:
        name = mesh.name
        spec.delete(mesh)
        add_hull(spec, name, hull_by_mesh[name])
    return hull_by_mesh, geom_numbers


def _has_equal_motion(model: Any, reduced_model: Any, numbers: Mapping[str, int]) -> bool:
    """Return whether two models of one robot have equal fields, except for non-colliding shapes.

    Equal fields guarantee an equal motion, without a simulation. Fields of integers are mostly
    addresses, which may differ, so only fields of floating-point numbers are compared.

    Args:
        model: whole model.
        reduced_model: model with some of its geoms.
        numbers: numbers of the whole model's geoms, by geom name.
    """
    fields = {
        name: getattr(model, name)
        for name in dir(model)
        if not name.startswith(("_", *IGNORED_FIELD_PREFIXES))
    }
    for name, values in fields.items():
        has_floats = isinstance(values, np.ndarray) and values.dtype.kind == "f"
        if has_floats and not np.array_equal(values, getattr(reduced_model, name), equal_nan=True):
            return False
    if model.stat.meaninertia != reduced_model.stat.meaninertia:
        return False
    # Geoms have other numbers in the reduced model, so those of the whole model are reordered.
    geom_numbers = [numbers[reduced_model.geom(i).name] for i in range(reduced_model.ngeom)]
    return all(
        np.array_equal(getattr(model, field)[geom_numbers], getattr(reduced_model, field))
        for field in GEOM_FIELDS
    )
