"""Read an MJCF or URDF model file into a `Robot`, with safe repairs that are listed in notes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from sims.base import InputError
from sims.limits import LARGEST, cut
from sims.memory import release_free_memory
from sims.robot import added, contacts, mjcf, names, urdf
from sims.robot.mends import Mends
from sims.robot.model import Format, Robot
from sims.robot.quiet import one_line, quiet
from sims.robot.shapes import Left
from sims.robot.words import listed
from sims.robot.xmlfile import Files, include, tree, written

FORMATS: Mapping[str, Format] = {"mujoco": "mjcf", "robot": "urdf"}
"""Formats of model files, by the name of the root element."""
UNDRIVEN = "no actuators: nothing drives it unless a recording's [actuators.NAME] adds some"
NUMBERS = (
    "body_mass", "body_inertia", "body_pos", "body_ipos", "jnt_pos", "jnt_axis",
    "jnt_stiffness", "dof_damping", "dof_armature", "dof_frictionloss",
)  # fmt: skip
"""Fields of the compiled model that are checked for values beyond the allowed range."""


def read(
    path: str | Path,
    *,
    actuators: Mapping[str, Any] | None = None,
    engine: Mapping[str, Any] | None = None,
) -> Robot:
    """Read the robot of a model file, without printing or writing anything.

    Args:
        path: path of an MJCF or a URDF; the content determines the format.
        actuators: actuators to add, by name: tables as in a recording's ``[actuators.NAME]``.
        engine: ``timestep`` (s) and ``integrator`` that replace those of the file.

    Returns:
        The robot, with a note for everything that was repaired or omitted.

    Raises:
        InputError: the file cannot be read, or MuJoCo rejects it; one line with file and cause.
    """
    path = Path(path)
    files = Files(path)
    try:
        root = tree(files, path)
        kind = FORMATS.get(root.tag)
        if kind is None:
            raise InputError(f"{path}: expected <mujoco> or <robot>, found <{cut(root.tag)}>")
        include(files, root)
        with quiet() as warnings:
            return _robot(files, root, kind, actuators or {}, engine or {}, warnings)
    except RecursionError:
        raise InputError(f"{path}: elements too deep within each other") from None


def _robot(
    files: Files,
    root: Element,
    kind: Format,
    actuators: Mapping[str, Any],
    engine: Mapping[str, Any],
    warnings: list[str],
) -> Robot:
    source, notes = str(files.path), names.renamed(root)
    mends = Mends(files, Left(source))
    if kind == "urdf":
        notes += urdf.mended(files, root)
        spec = _parsed(files, root)
        urdf.stiffen_mimics(spec)
    else:
        absent = mjcf.found(files, root)
        spec = _parsed(files, root)
        absent.leave_out(spec, mends.left)
    rated = added.add_actuators(spec, actuators, source)
    added.set_engine(spec, engine, source)
    notes += names.given(spec)
    above = {body.name: body.parent.name for body in spec.bodies if body.parent is not None}
    spec, model = mends.compiled(spec)
    _check(files, model)
    further = contacts.without(spec, model) if kind == "urdf" else []
    if further:
        spec, model = mends.compiled(spec)
    aliases = _fused(above, {model.body(i).name for i in range(model.nbody)})
    said = [f"MuJoCo says: {warning}" for warning in dict.fromkeys(warnings)]
    if model.nu == 0:
        said.insert(0, UNDRIVEN)
    settings = json.dumps([actuators, engine], sort_keys=True, default=str)
    files.add(settings.encode())
    robot = Robot(
        path=files.path,
        format=kind,
        spec=spec,
        notes=(*notes, *mends.notes, *further, *_said_of(aliases), *said),
        aliases=aliases,
        digest=files.hashed.hexdigest(),
        rated=rated,
        actuator_tables=actuators,
        engine_table=engine,
        speeds=urdf.speeds(root) if kind == "urdf" else {},
    )
    # The model is stored here, so that it is not compiled again.
    robot.__dict__["compiled"] = model
    if model.nmesh:
        release_free_memory()
    return robot


def _check(files: Files, model: Any) -> None:
    if model.njnt == 0:
        raise InputError(f"{files.path}: it has no joint that moves")
    step = float(model.opt.timestep)
    if not added.SHORTEST <= step <= added.LONGEST:
        span = f"{added.SHORTEST:g} to {added.LONGEST:g} s"
        raise InputError(f"{files.path}: option timestep: expected {span}, found {step:g}")
    for field in NUMBERS:
        values = np.asarray(getattr(model, field), dtype=float)
        faults = np.argwhere(~(np.abs(values) <= LARGEST))
        if len(faults):
            (row, *_), (kind, what) = faults[0], field.split("_", 1)
            joint = model.dof_jntid[row] if kind == "dof" else row
            name = (model.body(row) if kind == "body" else model.joint(joint)).name
            raise InputError(
                f"{files.path}: {what} of {cut(name)}: expected numbers within ±{LARGEST:g}, "
                f"found {values[tuple(faults[0])]:g}"
            )


def _parsed(files: Files, root: Element) -> Any:
    """Parse the repaired file into a mujoco.MjSpec."""
    import mujoco

    text, files.given = written(root)
    try:
        spec = mujoco.MjSpec.from_string(text)
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise files.refused(one_line(error)) from None
    spec.modelfiledir = str(files.path.parent.resolve())
    return spec


def _fused(parents: Mapping[str, str], compiled: set[str]) -> dict[str, str]:
    """Map the bodies that MuJoCo fused into others to the bodies that contain them."""
    aliases = {}
    for name in parents:
        into = name
        while into not in compiled:
            into = parents[into]
        if into != name:
            aliases[name] = into
    return aliases


def _said_of(aliases: Mapping[str, str]) -> list[str]:
    groups: dict[str, list[str]] = {}
    for alias, name in aliases.items():
        groups.setdefault(name, []).append(alias)
    said = [f"{listed(names)} of {into}" for into, names in groups.items()]
    whole = listed(said, between="; ")
    return [f"links on fixed joints are part of what carries them: {whole}"] if said else []
