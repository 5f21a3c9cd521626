"""Read an MJCF or URDF model file into a `RobotModel`; notes list the safe repairs."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from sims.core.files import require_file
from sims.core.freed_memory import release_free_memory
from sims.core.number_limits import MAX_NUMBER
from sims.core.simulator import InputError
from sims.core.user_messages import truncate_text
from sims.robot.integrator_settings import (
    MAX_TIME_STEP,
    MIN_TIME_STEP,
    apply_engine_settings,
)
from sims.robot.mujoco_messages import (
    capture_mujoco_warnings,
    format_mujoco_error,
    format_name_list,
)
from sims.robot.parsing import (
    added_actuators,
    collision_filters,
    floating_bases,
    mjcf_loading,
    name_repairs,
    urdf_loading,
)
from sims.robot.parsing.compile_repairs import CompileRepairs
from sims.robot.parsing.mesh_files import OmittedShapes
from sims.robot.parsing.xml_files import ModelFileReader, format_tree, parse_tree, resolve_includes
from sims.robot.robot_model import Format, RobotModel

FORMAT_BY_ROOT: Mapping[str, Format] = {"mujoco": "mjcf", "robot": "urdf"}
"""Formats of model files, by the name of the root element."""
NO_ACTUATORS_NOTE = (
    "no actuators: it is passive unless the [actuators.NAME] of a recording add some"
)
CHECKED_MODEL_FIELDS = (
    "body_mass", "body_inertia", "body_pos", "body_ipos", "jnt_pos", "jnt_axis",
    "jnt_stiffness", "dof_damping", "dof_armature", "dof_frictionloss",
)  # fmt: skip
"""Fields of the compiled model that are checked for values beyond the allowed range."""


def read_robot(
    path: str | Path,
    *,
    actuators: Mapping[str, Any] | None = None,
    engine: Mapping[str, Any] | None = None,
    description: Path | None = None,
) -> RobotModel:
    """Read the robot of a model file, without printing or writing anything.

    Args:
        path: path of an MJCF or a URDF; the content determines the format.
        actuators: actuators to add, by name: tables as in a recording's ``[actuators.NAME]``.
        engine: ``timestep`` (s) and ``integrator`` that replace those of the file, whether to
            ``fix_base``, and ``recorded_bases``, the floating joints whose pose is recorded.
        description: file that states the path and these tables, for messages; None without
            one.

    Returns:
        The robot, with a note for everything that was repaired or omitted.

    Raises:
        InputError: the file cannot be read, or MuJoCo rejects it; one line with file and cause.
    """
    path = Path(path)
    require_file(path, f"the model that {description} states" if description else "")
    files = ModelFileReader(path, description)
    try:
        root = parse_tree(files, path)
        kind = FORMAT_BY_ROOT.get(root.tag)
        if kind is None:
            raise InputError(
                f"{path}: expected <mujoco> or <robot>, found <{truncate_text(root.tag)}>"
            )
        resolve_includes(files, root)
        with capture_mujoco_warnings() as warnings:
            return _make_robot(files, root, kind, actuators or {}, engine or {}, warnings)
    except RecursionError:
        raise InputError(f"{path}: elements too deep within each other") from None


def restore_floating_joints(robot: RobotModel) -> RobotModel:
    """Return a robot with the floating joints of its file, in place of slides and hinges.

    The slides and hinges had replaced them, since the pose of the body is recorded. The file is
    read again; settings that are not in the file are kept.

    Args:
        robot: robot whose `recorded_bases` names the replaced joints; without any, it is returned.
    """
    if not robot.recorded_bases:
        return robot
    # Without this entry of the engine table, no joint is replaced.
    engine = {k: entry for k, entry in robot.engine_table.items() if k != "recorded_bases"}
    restored = read_robot(robot.path, actuators=robot.actuator_tables, engine=engine)
    return restored.with_friction_form(robot.friction_form).with_contacts(robot.contacts)


def _make_robot(
    files: ModelFileReader,
    root: Element,
    kind: Format,
    actuators: Mapping[str, Any],
    engine: Mapping[str, Any],
    warnings: list[str],
) -> RobotModel:
    """Repair, complete and compile a parsed model file, and make the robot from it.

    Every repair adds a note. The steps are:

    1. Repair the XML, and let MuJoCo parse it.
    2. Add the actuators and engine settings of the recording, name unnamed elements, and replace
       floating joints whose pose is recorded.
    3. Compile with repairs. For a URDF, exclude contacts of bodies that overlap in the reference
       pose, and compile again.
    4. Collect notes and the digest in the robot.

    Args:
        files: reader of the model file.
        root: root element; it is changed in place.
        kind: format of the file.
        actuators: actuators that the recording adds, by name.
        engine: time step and integrator that the recording sets.
        warnings: list to which MuJoCo's warnings are appended while it compiles.

    Raises:
        InputError: the file cannot be repaired, or the additions are invalid.
    """
    # 1. XML.
    source, notes = str(files.path), name_repairs.rename_invalid_names(root)
    repairs = CompileRepairs(files, OmittedShapes(source))
    if kind == "urdf":
        notes += urdf_loading.repair_urdf(files, root)
        spec = _parse_repaired_file(files, root)
        urdf_loading.stiffen_mimics(spec)
    else:
        mjcf_loading.read_referenced_files(files, root)
        spec = _parse_repaired_file(files, root)
    # 2. Additions.
    tables_source = str(files.description or source)
    rate_controlled = added_actuators.add_actuators(spec, actuators, tables_source)
    notes += apply_engine_settings(spec, engine, tables_source)
    notes += name_repairs.name_unnamed_elements(spec)
    # A base that is fixed has no joint to replace.
    recorded_bases = () if engine.get("fix_base") else engine.get("recorded_bases", ())
    bases, base_notes = floating_bases.separate_floating_joints(spec, recorded_bases, source)
    notes += base_notes
    # Names of the bodies before MuJoCo fuses some of them, with their parents.
    parents = {body.name: body.parent.name for body in spec.bodies if body.parent is not None}
    # 3. Compilation.
    spec, model = repairs.compile(spec)
    _check_model(files, model)
    exclusion_notes = (
        collision_filters.exclude_spurious_contacts(spec, model) if kind == "urdf" else []
    )
    if exclusion_notes:
        spec, model = repairs.compile(spec)
    # 4. Robot.
    aliases = _map_fused_bodies(parents, {model.body(i).name for i in range(model.nbody)})
    warning_notes = [f"MuJoCo warns: {warning}" for warning in dict.fromkeys(warnings)]
    if model.nu == 0:
        warning_notes.insert(0, NO_ACTUATORS_NOTE)
    # The digest identifies the robot, so it includes what the recording adds to the file.
    settings = json.dumps([actuators, engine], sort_keys=True, default=str)
    files.add_to_digest(settings.encode())
    robot = RobotModel(
        path=files.path,
        format=kind,
        spec=spec,
        notes=(
            *notes,
            *repairs.notes,
            *exclusion_notes,
            *_make_alias_note(aliases),
            *warning_notes,
        ),
        aliases=aliases,
        digest=files.digest.hexdigest(),
        rate_controlled_actuators=rate_controlled,
        actuator_tables=actuators,
        engine_table=engine,
        recorded_bases=bases,
        speeds=urdf_loading.read_velocity_limits(root) if kind == "urdf" else {},
    )
    # The model is stored here, so that it is not compiled again.
    robot.__dict__["compiled"] = model
    if model.nmesh:
        release_free_memory()
    return robot


def _check_model(files: ModelFileReader, model: Any) -> None:
    """Check that a compiled model can be simulated.

    It must have a joint, its time step must be in the allowed range, and masses, inertias, places
    and forces of its joints must be finite and not huge. The message names the first wrong value.

    Args:
        files: reader of the model file, whose path messages state.
        model: compiled model.

    Raises:
        InputError: nothing moves, the time step is out of range, or a number is huge or not finite.
    """
    if model.njnt == 0:
        raise InputError(f"{files.path}: it has no movable joint")
    step = float(model.opt.timestep)
    if not MIN_TIME_STEP <= step <= MAX_TIME_STEP:
        span = f"{MIN_TIME_STEP:g} to {MAX_TIME_STEP:g} s"
        raise InputError(f"{files.path}: option timestep: expected {span}, found {step:g}")
    for field in CHECKED_MODEL_FIELDS:
        values = np.asarray(getattr(model, field), dtype=float)
        # The comparison is also false for NaN.
        fault_indices = np.argwhere(~(np.abs(values) <= MAX_NUMBER))
        if len(fault_indices):
            first_fault = tuple(fault_indices[0])
            row, *_ = first_fault
            # MuJoCo's fields begin with "body", "jnt" or "dof", which says what a row belongs to:
            # ``dof_damping`` has a row for each velocity of a joint.
            kind, quantity = field.split("_", 1)
            joint = model.dof_jntid[row] if kind == "dof" else row
            name = (model.body(row) if kind == "body" else model.joint(joint)).name
            raise InputError(
                f"{files.path}: {quantity} of {truncate_text(name)}: "
                f"expected numbers within ±{MAX_NUMBER:g}, found {values[first_fault]:g}"
            )


def _parse_repaired_file(files: ModelFileReader, root: Element) -> Any:
    """Let MuJoCo parse the repaired XML into a mujoco.MjSpec.

    Args:
        files: reader of the files of the model, which finds the lines of errors; it gets the
            elements of each line of the text.
        root: root element of the repaired file.

    Raises:
        InputError: MuJoCo cannot parse it.
    """
    import mujoco

    text, files.given = format_tree(root)
    try:
        spec = mujoco.MjSpec.from_string(text)
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise files.make_mujoco_error(format_mujoco_error(error)) from None
    spec.modelfiledir = str(files.path.parent.resolve())
    return spec


def _map_fused_bodies(parents: Mapping[str, str], compiled: set[str]) -> dict[str, str]:
    """Map the bodies that MuJoCo fused into others to the bodies that contain them.

    MuJoCo fuses a body that is fixed to its parent into the parent, possibly repeatedly. Users
    still refer to it by its name in the file.

    Args:
        parents: parent of each body of the file that may be fused, by name.
        compiled: names of the bodies of the compiled model.

    Returns:
        Name of the containing body by name of the fused one.
    """
    aliases = {}
    for name in parents:
        containing_body = name
        while containing_body not in compiled:
            containing_body = parents[containing_body]
        if containing_body != name:
            aliases[name] = containing_body
    return aliases


def _make_alias_note(aliases: Mapping[str, str]) -> list[str]:
    """Return a note about links that MuJoCo fused into other bodies; an empty list without any.

    The user needs the note, because effects act on the whole body.

    Args:
        aliases: body of which each fused link is a part, by name of the link.
    """
    groups: dict[str, list[str]] = {}
    for alias, name in aliases.items():
        groups.setdefault(name, []).append(alias)
    body_notes = [f"{format_name_list(names)} of {body}" for body, names in groups.items()]
    listing = format_name_list(body_notes, separator="; ")
    if body_notes:
        return [f"links on fixed joints are merged into their parent links: {listing}"]
    return []
