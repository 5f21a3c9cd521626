"""Shapes of a model whose mesh cannot be had are left out, unless a mass follows from them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sims.base import InputError
from sims.limits import cut
from sims.robot.words import listed


@dataclass
class Left:
    """What was left out of a spec.

    Attributes:
        source: what messages begin with.
        touching: by the reason, files or names of shapes that would have touched others.
        seen: likewise those that are only seen.
    """

    source: str
    touching: dict[str, list[str]] = field(default_factory=dict)
    seen: dict[str, list[str]] = field(default_factory=dict)

    def leave_out(self, spec: Any, geom: Any, label: str, why: str) -> None:
        """Take a geom out of a spec.

        Raises:
            InputError: the mass of a body that moves would follow from it.
        """
        body = geom.parent
        if weighs(spec, geom, body):
            raise InputError(
                f"{self.source}: mesh {cut(label)} {why}, and the mass of body {cut(body.name)} "
                "would follow from it; mend the mesh, or state the body's <inertial>"
            )
        group = self.touching if geom.contype or geom.conaffinity else self.seen
        group.setdefault(why, []).append(label)
        spec.delete(geom)

    @property
    def notes(self) -> list[str]:
        """One line for each reason."""
        notes = [
            f"shapes left out, and their contacts, since their file {why}: {listed(labels)}"
            for why, labels in self.touching.items()
        ]
        for why, labels in self.seen.items():
            notes.append(f"left out, only seen, since the file {why}: {listed(labels)}")
        return notes


def weighs(spec: Any, geom: Any, body: Any) -> bool:
    """Whether the mass of a body that moves would follow from a geom."""
    import mujoco

    low, high = spec.compiler.inertiagrouprange
    rule, always = spec.compiler.inertiafromgeom, mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    never = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    if rule == never or (rule != always and body.explicitinertial):
        return False
    if geom.mass == 0 or (not np.isfinite(geom.mass) and geom.density == 0):
        return False
    return bool(low <= geom.group <= high) and moves(body)


def moves(body: Any) -> bool:
    """Whether joints move a body of a spec, its own or those of what carries it."""
    while body is not None and body.name != "world":
        if body.joints:
            return True
        body = body.parent
    return False


def without_mesh(spec: Any, name: str, why: str, left: Left) -> bool:
    """Leave out a mesh that MuJoCo refuses, and the shapes that have it."""
    meshes = [mesh for mesh in spec.meshes if mesh.name == name]
    for geom in [geom for geom in spec.geoms if geom.meshname == name]:
        left.leave_out(spec, geom, name, why)
    for mesh in meshes:
        spec.delete(mesh)
    return bool(meshes)


def without_picture(spec: Any, name: str, why: str, left: Left) -> bool:
    """Put one colour in the place of a picture that MuJoCo refuses."""
    import mujoco

    for texture in [texture for texture in spec.textures if texture.name == name]:
        left.seen.setdefault(why, []).append(texture.file or name)
        texture.file, texture.cubefiles = "", []
        texture.builtin = mujoco.mjtBuiltin.mjBUILTIN_FLAT
        texture.width = texture.height = 1
        return True
    return False
