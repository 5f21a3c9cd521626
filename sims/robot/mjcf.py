"""What an MJCF says, made fit to load: what lies in absent files is left out where masses are
stated.
"""

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
"""Vertices that stand for an absent mesh until nothing names it any more."""
SIDES = ("file", "fileright", "fileleft", "fileup", "filedown", "filefront", "fileback")
"""Attributes of a texture that name files."""
COUNTS = ("count", "cellcount")
"""Attributes whose numbers multiply what there is."""
MOST = 1e5
"""Of what is counted."""
SIZES = {"width": 2e4, "height": 2e4, "nrow": 1e4, "ncol": 1e4, "nkey": 1e5, "nuserdata": 1e6}
"""Attributes that ask for memory, and the most that they may ask for."""


@dataclass
class Absent:
    """What a model names and is not there.

    Attributes:
        meshes: by name of the asset, its file.
        fields: height fields likewise.
        pictures: files of textures and skins.
    """

    meshes: dict[str, str] = field(default_factory=dict)
    fields: dict[str, str] = field(default_factory=dict)
    pictures: list[str] = field(default_factory=list)

    def leave_out(self, spec: Any, left: Left) -> None:
        """Take out of a spec what has an absent file.

        Raises:
            InputError: the mass of a body that moves would follow from an absent mesh.
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
    """Read the files that an MJCF names, and put stand-ins where they are absent.

    Raises:
        InputError: something is too large.
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
    """Refuse counts and sizes that would fill the memory."""
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
    except ValueError:  # MuJoCo says what it expects
        return 0.0


def _model(files: Files, element: Element) -> None:
    """Read a model that is attached, which MuJoCo opens itself."""
    name = element.get("file") or ""
    path = files.path.parent / name.replace("\\", "/")
    if not exists(path):
        raise files.fault(element, f"the attached model {cut(name)} is absent")
    if path.resolve() in files.included:
        raise files.fault(element, f"{cut(name)} holds itself")
    _measured(files, tree(files, path), 1.0)
    # It is opened before the spec knows its folder.
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
    """Let an asset load without its file, where it can."""
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
        return  # MuJoCo says what it lacks
    element.attrib.clear()
    element.attrib.update(kept)
