"""Omit shapes whose mesh is missing, unless the mass of a moving body depends on them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sims.core.simulator import InputError
from sims.core.value_limits import truncate_text
from sims.robot.note_text import format_name_list


@dataclass
class OmittedShapes:
    """Shapes and textures that were omitted from a spec.

    Attributes:
        source: beginning of error messages.
        touching: files or names of omitted shapes that could have touched others, by reason.
        seen: files or names of omitted elements that are only visual, by reason.
    """

    source: str
    touching: dict[str, list[str]] = field(default_factory=dict)
    seen: dict[str, list[str]] = field(default_factory=dict)

    def leave_out(self, spec: Any, geom: Any, label: str, reason: str) -> None:
        """Remove a geom from a spec and record it.

        Args:
            spec: the mujoco.MjSpec.
            geom: geom to remove.
            label: file or name of the shape, for messages.
            reason: why the shape or texture cannot be read.

        Raises:
            InputError: the mass of a moving body depends on the geom.
        """
        body = geom.parent
        if determines_mass(spec, geom, body):
            raise InputError(
                f"{self.source}: mesh {truncate_text(label)} {reason}, and the mass of body "
                f"{truncate_text(body.name)} would follow from it; "
                "repair the mesh, or state the body's <inertial>"
            )
        group = self.touching if geom.contype or geom.conaffinity else self.seen
        group.setdefault(reason, []).append(label)
        spec.delete(geom)

    @property
    def notes(self) -> list[str]:
        """Notes, one for each reason."""
        notes = [
            f"shapes left out, and their contacts, since their file {reason}: "
            f"{format_name_list(labels)}"
            for reason, labels in self.touching.items()
        ]
        for reason, labels in self.seen.items():
            notes.append(
                f"visual elements left out, since the file {reason}: {format_name_list(labels)}"
            )
        return notes


def determines_mass(spec: Any, geom: Any, body: Any) -> bool:
    """Return whether the mass of a moving body is computed from a geom.

    Such a geom must not be removed, because the body would lose its mass.

    Args:
        spec: the mujoco.MjSpec.
        geom: geom of the body.
        body: body of the spec.
    """
    import mujoco

    low, high = spec.compiler.inertiagrouprange
    rule, always_rule = (
        spec.compiler.inertiafromgeom,
        mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE,
    )
    never_rule = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    if rule == never_rule or (rule != always_rule and body.explicitinertial):
        return False
    if geom.mass == 0 or (not np.isfinite(geom.mass) and geom.density == 0):
        return False
    return bool(low <= geom.group <= high) and is_moving_body(body)


def is_moving_body(body: Any) -> bool:
    """Return whether a body of a spec moves, by its own joints or those of its ancestors."""
    while body is not None and body.name != "world":
        if body.joints:
            return True
        body = body.parent
    return False


def remove_mesh(spec: Any, name: str, reason: str, omitted: OmittedShapes) -> bool:
    """Remove a mesh that MuJoCo rejects, and the geoms that use it.

    The robot then moves as before, without this shape in contacts or pictures.

    Args:
        spec: the mujoco.MjSpec.
        name: name of the mesh.
        reason: why the shape or texture cannot be read.
        omitted: record of omitted shapes.

    Returns:
        Whether the spec contains this mesh.
    """
    meshes = [mesh for mesh in spec.meshes if mesh.name == name]
    for geom in [geom for geom in spec.geoms if geom.meshname == name]:
        omitted.leave_out(spec, geom, name, reason)
    for mesh in meshes:
        spec.delete(mesh)
    return bool(meshes)


def remove_texture(spec: Any, name: str, reason: str, omitted: OmittedShapes) -> bool:
    """Replace a texture that MuJoCo rejects by a single colour.

    A texture has no influence on the motion.

    Args:
        spec: the mujoco.MjSpec.
        name: name of the texture.
        reason: why the shape or texture cannot be read.
        omitted: record of omitted shapes.

    Returns:
        Whether the spec contains this texture.
    """
    import mujoco

    for texture in [texture for texture in spec.textures if texture.name == name]:
        omitted.seen.setdefault(reason, []).append(texture.file or name)
        texture.file, texture.cubefiles = "", []
        texture.builtin = mujoco.mjtBuiltin.mjBUILTIN_FLAT
        texture.width = texture.height = 1
        return True
    return False
