"""What an MJCF says, made fit to load: what lies in absent files is left out where masses are
stated.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from sims.base import InputError
from sims.limits import cut
from sims.robot.words import listed
from sims.robot.xmlfile import MESH, Files, children

TETRAHEDRON = "0 0 0 1 0 0 0 1 0 0 0 1"
"""Vertices that stand for an absent mesh until nothing names it any more."""
SIDES = ("file", "fileright", "fileleft", "fileup", "filedown", "filefront", "fileback")
"""Attributes of a texture that name files."""


@dataclass
class Absent:
    """What a model names and is not there.

    Attributes:
        files: what has been read.
        meshes: by name of the asset, its file.
        fields: height fields likewise.
        pictures: files of textures and skins.
    """

    files: Files
    meshes: dict[str, str] = field(default_factory=dict)
    fields: dict[str, str] = field(default_factory=dict)
    pictures: list[str] = field(default_factory=list)

    def leave_out(self, spec: Any) -> list[str]:
        """Take out of a spec what has an absent file; one line for each kind of thing.

        Raises:
            InputError: the mass of a body that moves would follow from an absent mesh.
        """
        seen: list[str] = []
        touching: list[str] = []
        for geom in [geom for geom in spec.geoms if self._of(geom)]:
            file, body = self._of(geom), geom.parent
            if _weighs(spec, geom, body):
                raise InputError(
                    f"{self.files.path}: mesh {cut(file)} is absent, and the mass of body "
                    f"{cut(body.name)} would follow from it; put it there, or state the body's "
                    "<inertial>"
                )
            (touching if geom.contype or geom.conaffinity else seen).append(file)
            spec.delete(geom)
        for asset in [*spec.meshes, *spec.hfields]:
            if asset.name in (self.meshes if asset in spec.meshes else self.fields):
                spec.delete(asset)
        notes = []
        if touching:
            notes.append(f"left out with their contacts, absent files: {listed(unique(touching))}")
        if seen or self.pictures:
            notes.append(
                f"left out, only seen, absent files: {listed(unique(seen + self.pictures))}"
            )
        return notes

    def _of(self, geom: Any) -> str:
        """The absent file of a geom, else nothing."""
        return self.meshes.get(geom.meshname) or self.fields.get(geom.hfieldname) or ""


def unique(names: list[str]) -> list[str]:
    """Each once, in order."""
    return list(dict.fromkeys(names))


def _weighs(spec: Any, geom: Any, body: Any) -> bool:
    """Whether the mass of a body that moves would follow from a geom."""
    import mujoco

    low, high = spec.compiler.inertiagrouprange
    rule, always = spec.compiler.inertiafromgeom, mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    never = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    if rule == never or (rule != always and body.explicitinertial):
        return False
    if geom.mass == 0 or (not np.isfinite(geom.mass) and geom.density == 0):
        return False
    return bool(low <= geom.group <= high) and _moves(body)


def _moves(body: Any) -> bool:
    while body is not None:
        if list(body.joints):
            return True
        body = body.parent
    return False


def found(files: Files, root: Element) -> Absent:
    """Read the files that an MJCF names, and put stand-ins where they are absent."""
    absent = Absent(files)
    settings = {key: value for e in children(root, "compiler") for key, value in e.items()}
    everywhere = settings.get("assetdir", "")
    meshes = settings.get("meshdir", everywhere)
    pictures = settings.get("texturedir", everywhere)
    strip = settings.get("strippath") == "true"
    for asset in children(root, "asset"):
        for element in list(asset):
            folder = pictures if element.tag == "texture" else meshes
            missing = [name for name in _named(element) if not _read(files, folder, name, strip)]
            if missing:
                _stand_in(absent, asset, element, missing[0])
    return absent


def _named(element: Element) -> Iterator[str]:
    keys = SIDES if element.tag == "texture" else ("file",)
    return (element.attrib[key] for key in keys if element.get(key))


def _read(files: Files, folder: str, name: str, strip: bool) -> bool:
    plain = name.replace("\\", "/")
    path = files.path.parent / folder / (Path(plain).name if strip else plain)
    try:
        there = path.is_file()
    except (OSError, ValueError):  # a name that no file can have
        there = False
    if there:
        files.content(path, MESH)
    return there


def _stand_in(absent: Absent, asset: Element, element: Element, file: str) -> None:
    """Let an asset load without its file, where it can."""
    name = element.get("name") or Path(file.replace("\\", "/")).stem
    if element.tag == "mesh":
        absent.meshes[name] = file
        kept = {"name": name, "vertex": TETRAHEDRON}
    elif element.tag == "hfield":
        absent.fields[name] = file
        kept = {"name": name, "nrow": "2", "ncol": "2", "size": element.get("size", "1 1 1 1")}
    elif element.tag == "texture":
        absent.pictures.append(file)
        kept = {"name": name, "type": element.get("type", "cube"), "builtin": "flat"}
        kept |= {"width": "1", "height": "6" if kept["type"] != "2d" else "1"}
    elif element.tag == "skin":
        absent.pictures.append(file)
        asset.remove(element)
        return
    else:
        return  # MuJoCo says what it lacks
    element.attrib.clear()
    element.attrib.update(kept)
