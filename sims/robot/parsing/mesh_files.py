"""Find the mesh files of a model, and replace those that are missing."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from sims.core.files import is_existing_file
from sims.core.simulator import InputError
from sims.core.user_messages import truncate_text
from sims.robot.mujoco_messages import format_name_list
from sims.robot.parsing.xml_files import MAX_ASSET_BYTES, ModelFileReader

MESH_SUFFIXES = (".stl", ".obj", ".msh")
"""File name suffixes of mesh formats that MuJoCo reads."""
WATER_DENSITY = 1000.0
"""Density of a sphere that stands for a missing mesh of known mass, kg/m^3 (MuJoCo's default)."""
MAX_PARENT_FOLDERS = 6
"""Maximum number of parent folders of the model file in which a package is searched."""


@dataclass
class MeshLookup:
    """Mesh files that a URDF refers to.

    Attributes:
        files: reader of the model file and its assets.
        folder: mesh folder given to MuJoCo, relative to the model file or absolute.
        omitted: names of omitted meshes, by reason.
        found: paths of the meshes found, relative to the model file's folder, by name in the URDF.
    """

    files: ModelFileReader
    folder: str = ""
    omitted: dict[str, list[str]] = field(default_factory=dict)
    found: dict[str, str] = field(default_factory=dict)

    def find(self, name: str) -> tuple[str | None, str]:
        """Find the file of a mesh of a URDF, and read it into the digest of the model.

        Args:
            name: file name in the URDF, or a URI, which often names a ROS package.

        Returns:
            The path relative to the model file's folder and an empty text, or None and the reason
            why the mesh cannot be used.
        """
        ending = PurePosixPath(name).suffix
        if ending.lower() not in MESH_SUFFIXES:
            return None, f"is of a format that MuJoCo does not read ({ending or 'none'})"
        if name not in self.found:
            path = next(
                (path for path in self._list_candidate_paths(name) if is_existing_file(path)), None
            )
            if path is None:
                return None, "is absent"
            self.files.read_content(path, MAX_ASSET_BYTES)
            model_folder = self.files.path.parent.resolve()
            self.found[name] = Path(os.path.relpath(path.resolve(), model_folder)).as_posix()
        return self.found[name], ""

    def _list_candidate_paths(self, name: str) -> list[Path]:
        """Return the possible paths of a mesh, in the order in which they are tried.

        * A plain name is sought in the mesh folder that the model file states, next to the model
          file, and in the mesh folder without its own folders.
        * ``file://PATH`` is this path.
        * ``package://PACKAGE/PATH`` and ``model://PACKAGE/PATH`` are sought in the model file's
          folder and in those above it, as ROS does.
        * Other schemes are unknown, so there are no paths.

        Args:
            name: file name or URI as in the URDF.
        """
        model_folder = self.files.path.parent
        scheme, separator, uri_path = name.partition("://")
        if not separator:
            file_name = name.replace("\\", "/")
            folder = model_folder / self.folder
            return [
                folder / file_name,
                model_folder / file_name,
                folder / PurePosixPath(file_name).name,
            ]
        if scheme == "file":
            return [Path(uri_path)]
        if scheme not in ("package", "model"):
            return []
        package, *relative_parts = PurePosixPath(uri_path).parts or [""]
        candidates = []
        resolved_folder = model_folder.resolve()
        for folder in [resolved_folder, *resolved_folder.parents][: MAX_PARENT_FOLDERS + 1]:
            path_in_package = folder.joinpath(*relative_parts)
            # The folder is the package, contains it, or is the package under another name.
            if folder.name == package:
                candidates.append(path_in_package)
            candidates += [folder / uri_path, path_in_package]
        return candidates

    def leave_out(self, name: str, reason: str) -> None:
        """Record that a link omits a mesh.

        Args:
            name: file name or URI in the URDF.
            reason: why the mesh cannot be read.
        """
        self.omitted.setdefault(reason, []).append(PurePosixPath(name).name)

    @property
    def notes(self) -> list[str]:
        """One note for each reason why shapes were omitted."""
        return [
            f"shapes left out, and their contacts, since their mesh {reason}: "
            f"{format_name_list(names)}"
            for reason, names in self.omitted.items()
        ]


@dataclass
class OmittedShapes:
    """Shapes and textures that were omitted from a spec.

    Attributes:
        source: beginning of error messages.
        colliding: files or names of omitted shapes that could have touched others, by reason.
        visual: files or names of omitted elements that are only visual, by reason.
        replaced: bodies with a shape of known mass that was replaced by a sphere, by reason.
    """

    source: str
    colliding: dict[str, list[str]] = field(default_factory=dict)
    visual: dict[str, list[str]] = field(default_factory=dict)
    replaced: dict[str, list[str]] = field(default_factory=dict)

    def leave_out(self, spec: Any, geom: Any, label: str, reason: str) -> None:
        """Remove a geom (shape) whose file cannot be used, and record it for a note to the user.

        Shapes that could have touched others are recorded in `colliding`, those that are only
        visual in `visual`. A shape with a stated mass that counts for its body is replaced by a
        sphere with this mass and the density of water about the origin of the shape.

        Args:
            spec: editable model (`mujoco.MjSpec`); it is changed in place.
            geom: geom to remove.
            label: file or name of the shape, for messages.
            reason: why the shape or texture cannot be read.

        Raises:
            InputError: the mass of a moving body depends on the geom.
        """
        body = geom.parent
        if determines_mass(spec, geom, body):
            if np.isfinite(geom.mass):  # NaN is a mass that the file does not state.
                _replace_by_sphere(geom)
                self.replaced.setdefault(reason, []).append(f"{body.name} {geom.mass:g} kg")
                return
            raise InputError(
                f"{self.source}: mesh {truncate_text(label)} {reason}, and the mass of body "
                f"{truncate_text(body.name)} would follow from it; "
                "repair the mesh, or state the body's <inertial>"
            )
        # A geom without contact types touches nothing.
        can_touch = geom.contype or geom.conaffinity
        group = self.colliding if can_touch else self.visual
        group.setdefault(reason, []).append(label)
        spec.delete(geom)

    @property
    def notes(self) -> list[str]:
        """Notes, one for each reason why colliding shapes, or visual elements, are left out."""
        notes = [
            f"shapes left out, and their contacts, since their file {reason}: "
            f"{format_name_list(labels)}"
            for reason, labels in self.colliding.items()
        ]
        for reason, labels in self.visual.items():
            notes.append(
                f"visual elements left out, since the file {reason}: {format_name_list(labels)}"
            )
        for reason, labels in self.replaced.items():
            notes.append(
                f"shapes replaced by spheres of their stated mass, since their file {reason}: "
                f"{format_name_list(labels)}; state <inertial> to place the mass exactly"
            )
        return notes


def _replace_by_sphere(geom: Any) -> None:
    """Replace a mesh by a sphere of the same mass and the density of water, without contacts.

    Args:
        geom: geom of a `mujoco.MjSpec` with a stated mass, changed in place.
    """
    import mujoco

    radius = (3.0 * geom.mass / (4.0 * np.pi * WATER_DENSITY)) ** (1.0 / 3.0)
    geom.type = mujoco.mjtGeom.mjGEOM_SPHERE
    geom.meshname = ""
    geom.size = [radius, 0.0, 0.0]
    geom.contype = geom.conaffinity = 0


def determines_mass(spec: Any, geom: Any, body: Any) -> bool:
    """Return whether the mass of a moving body is computed from a geom (shape).

    Such a geom must not be removed, because the body would lose its mass. It is so if all of these
    hold:

    * MuJoCo's setting ``inertiafromgeom`` demands it: always, or if the file states no mass of the
      body, but not if it is "never".
    * The geom has a mass or a density, and is of a group that counts.
    * The body moves.

    Args:
        spec: the mujoco.MjSpec.
        geom: geom of the body.
        body: body of the spec.
    """
    import mujoco

    rule = spec.compiler.inertiafromgeom
    always = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    never = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    if rule == never or (rule != always and body.explicitinertial):
        return False
    # NaN is a mass that the file does not state; it follows from the density then.
    if geom.mass == 0 or (not np.isfinite(geom.mass) and geom.density == 0):
        return False
    first_group, last_group = spec.compiler.inertiagrouprange
    return bool(first_group <= geom.group <= last_group) and is_moving_body(body)


def is_moving_body(body: Any) -> bool:
    """Return whether a body of a spec moves, by its own joints or those of its ancestors."""
    while body is not None and body.name != "world":
        # The list `body.joints` cannot be read after a failed compilation if it is empty.
        if body.first_joint() is not None:
            return True
        body = body.parent
    return False


def find_assets_of_file(spec: Any, path: str) -> list[Any]:
    """Find the meshes, height fields, skins and textures of a spec that refer to a file.

    A name in the spec must be the end of the path. If there is none, only the last parts are
    compared, since MuJoCo ignores the folders in names with the setting ``strippath``.

    Args:
        spec: the mujoco.MjSpec.
        path: path of the file as in MuJoCo's messages, with the folder of the assets.
    """
    assets = [*spec.meshes, *spec.hfields, *spec.skins, *spec.textures]
    # A texture that is a cube map has several files.
    files = [[asset.file, *getattr(asset, "cubefiles", ())] for asset in assets]

    def select_assets(is_wanted_file: Callable[[str], bool]) -> list[Any]:
        """Return the assets of which any file name fulfils a condition."""
        return [
            asset
            for asset, names in zip(assets, files, strict=True)
            if any(is_wanted_file(name) for name in names if name)
        ]

    return select_assets(lambda name: f"/{path}".endswith(f"/{name}")) or select_assets(
        lambda name: Path(name).name == Path(path).name
    )


def remove_asset(spec: Any, asset: Any, reason: str, omitted: OmittedShapes) -> None:
    """Remove an asset whose file is missing, or which MuJoCo rejects, and the geoms that use it.

    The robot then moves as before, without this shape in contacts or pictures. A texture, which has
    no influence on the motion, is replaced by a single colour, so that its geoms stay.

    Args:
        spec: the mujoco.MjSpec.
        asset: mesh, height field, skin or texture of the spec.
        reason: why it cannot be used.
        omitted: record of omitted shapes.

    Raises:
        InputError: the mass of a moving body depends on a mesh.
    """
    import mujoco

    label = asset.file or asset.name
    if isinstance(asset, mujoco.MjsTexture):
        # A cube map has up to six files in place of one.
        label = next((file for file in (asset.file, *asset.cubefiles) if file), label)
        asset.file, asset.cubefiles = "", []
        asset.builtin = mujoco.mjtBuiltin.mjBUILTIN_FLAT
        asset.width = asset.height = 1
        omitted.visual.setdefault(reason, []).append(label)
        return
    if isinstance(asset, mujoco.MjsSkin):
        # No geom uses a skin, which is only drawn.
        omitted.visual.setdefault(reason, []).append(label)
    else:
        attribute = "meshname" if isinstance(asset, mujoco.MjsMesh) else "hfieldname"
        for geom in [geom for geom in spec.geoms if getattr(geom, attribute) == asset.name]:
            omitted.leave_out(spec, geom, label, reason)
    spec.delete(asset)
