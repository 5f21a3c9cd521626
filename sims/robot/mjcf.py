"""Prepare an MJCF for loading: omit elements with missing files where masses are specified."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any
from xml.etree.ElementTree import Element

from sims.limits import cut
from sims.robot.meshes import exists
from sims.robot.shapes import Left
from sims.robot.xmlfile import MESH, Files, children, tree

TETRAHEDRON = "0 0 0 1 0 0 0 1 0 0 0 1"
"""Vertices of a placeholder for a missing mesh; the mesh is removed after loading."""
SIDES = ("file", "fileright", "fileleft", "fileup", "filedown", "filefront", "fileback")
"""Attributes of a texture that name files."""
COUNTS = ("count", "cellcount")
"""Attributes with counts that multiply the number of elements."""
MOST = 1e5
"""Maximum total number of elements that counts may generate."""
SIZES = {"width": 2e4, "height": 2e4, "nrow": 1e4, "ncol": 1e4, "nkey": 1e5, "nuserdata": 1e6}
"""Attributes that request memory, and their maximum values."""


@dataclass
class Absent:
    """Missing files that a model refers to.

    Attributes:
        meshes: missing mesh files by name of the asset.
        fields: missing height field files by name of the asset.
        pictures: missing files of textures and skins.
    """

    meshes: dict[str, str] = field(default_factory=dict)
    fields: dict[str, str] = field(default_factory=dict)
    pictures: list[str] = field(default_factory=list)

    def leave_out(self, spec: Any, left: Left) -> None:
        """Remove elements with missing files from a spec.

        Args:
            spec: the mujoco.MjSpec; it is changed in place.
            left: record of omitted shapes.

        Raises:
            InputError: the mass of a moving body depends on a missing mesh.
        """
        why = "is absent"
        for geom in list(spec.geoms):
            file = self.meshes.get(geom.meshname) or self.fields.get(geom.hfieldname)
            if file:
                left.leave_out(spec, geom, file, why)
        for assets, names in ((spec.meshes, self.meshes), (spec.hfields, self.fields)):
            for asset in [asset for asset in assets if asset.name in names]:
                spec.delete(asset)
        if self.pictures:
            left.seen.setdefault(why, []).extend(self.pictures)


def found(files: Files, root: Element) -> Absent:
    """Read the files that an MJCF refers to, and insert placeholders for missing ones.

    Args:
        files: reader of the model file.
        root: root element of the MJCF; it is changed in place.

    Returns:
        The missing files.

    Raises:
        InputError: a count, a size or a file is too large, or an attached model is missing.
    """
    _measured(files, root, 1.0)
    absent = Absent()
    settings = {key: value for e in children(root, "compiler") for key, value in e.items()}
    everywhere = settings.get("assetdir", "")
    meshes = settings.get("meshdir", everywhere)
    pictures = settings.get("texturedir", everywhere)
    strip = settings.get("strippath") == "true"
    for element in root.iter("flexcomp"):
        file = element.get("file")
        if file and _read(files, meshes, file, strip):
            element.set("file", str((files.path.parent / meshes / file).resolve()))
    for asset in children(root, "asset"):
        for element in list(asset):
            if element.tag == "model":
                _model(files, element)
                continue
            folder = pictures if element.tag == "texture" else meshes
            missing = [name for name in _named(element) if not _read(files, folder, name, strip)]
            if missing:
                _stand_in(absent, asset, element, missing[0])
    return absent


def _measured(files: Files, element: Element, times: float) -> None:
    """Reject counts and sizes that would exhaust the memory."""
    for key, value in element.items():
        numbers = [_size(word) for word in value.split()] if key in (*COUNTS, *SIZES) else []
        most = SIZES.get(key, MOST)
        if key in COUNTS:
            times *= math.prod(max(number, 1.0) for number in numbers)
        if max([times, *numbers]) > most or (key.startswith("nuser_") and _size(value) > MOST):
            raise files.fault(element, f'{key}="{cut(value)}" is too much: at most {most:g} in all')
    for child in element:
        _measured(files, child, times)


def _size(word: str) -> float:
    try:
        return abs(float(word))
    except ValueError:  # MuJoCo itself reports what it expects.
        return 0.0


def _model(files: Files, element: Element) -> None:
    """Read an attached model, which MuJoCo opens itself."""
    name = element.get("file") or ""
    path = files.path.parent / name.replace("\\", "/")
    if not exists(path):
        raise files.fault(element, f"the attached model {cut(name)} is absent")
    if path.resolve() in files.included:
        raise files.fault(element, f"{cut(name)} holds itself")
    _measured(files, tree(files, path), 1.0)
    # MuJoCo opens the attached model before the spec knows its folder, so the path must be
    # absolute.
    element.set("file", str(path.resolve()))


def _named(element: Element) -> Iterator[str]:
    keys = SIDES if element.tag == "texture" else ("file",)
    return (element.attrib[key] for key in keys if element.get(key))


def _read(files: Files, folder: str, name: str, strip: bool) -> bool:
    plain = name.replace("\\", "/")
    path = files.path.parent / folder / (PurePosixPath(plain).name if strip else plain)
    if not exists(path):
        return False
    files.content(path, MESH)
    return True


def _stand_in(absent: Absent, asset: Element, element: Element, file: str) -> None:
    """Replace an asset with a missing file by a placeholder that loads, if possible."""
    name = element.get("name") or PurePosixPath(file.replace("\\", "/")).stem
    if element.tag == "mesh":
        absent.meshes[name] = file
        kept = {"name": name, "vertex": TETRAHEDRON}
    elif element.tag == "hfield":
        absent.fields[name] = file
        kept = {"name": name, "nrow": "2", "ncol": "2", "size": "1 1 1 1"}
    elif element.tag == "texture":
        absent.pictures.append(file)
        kept = {"name": name, "type": element.get("type", "cube"), "builtin": "flat"}
        kept |= {"width": "1", "height": "1"}
    elif element.tag == "skin":
        absent.pictures.append(file)
        asset.remove(element)
        return
    else:
        return  # MuJoCo itself reports what is missing.
    element.attrib.clear()
    element.attrib.update(kept)
