"""Prepare an MJCF for loading: omit elements with missing files where masses are specified."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any
from xml.etree.ElementTree import Element

from sims.core.files import is_existing_file
from sims.core.plain_values import truncate_text
from sims.robot.parsing.mesh_files import OmittedShapes
from sims.robot.parsing.xml_files import MAX_ASSET_BYTES, ModelFileReader, find_children, parse_tree

PLACEHOLDER_MESH_VERTICES = "0 0 0 1 0 0 0 1 0 0 0 1"
"""Vertices of a placeholder for a missing mesh; the mesh is removed after loading."""
TEXTURE_FILE_ATTRIBUTES = (
    "file",
    "fileright",
    "fileleft",
    "fileup",
    "filedown",
    "filefront",
    "fileback",
)
"""Attributes of a texture that name files."""
COUNT_ATTRIBUTES = ("count", "cellcount")
"""Attributes with counts that multiply the number of elements."""
MAX_COUNT = 1e5
"""Maximum total number of elements that counts may generate."""
MAX_SIZE_ATTRIBUTES = {
    "width": 2e4,
    "height": 2e4,
    "nrow": 1e4,
    "ncol": 1e4,
    "nkey": 1e5,
    "nuserdata": 1e6,
}
"""Attributes that request memory, and their maximum values."""


@dataclass
class MissingFiles:
    """Missing files that a model refers to.

    Attributes:
        meshes: missing mesh files by name of the asset.
        fields: missing height field files by name of the asset.
        pictures: missing files of textures and skins.
    """

    meshes: dict[str, str] = field(default_factory=dict)
    fields: dict[str, str] = field(default_factory=dict)
    pictures: list[str] = field(default_factory=list)

    def remove_from_spec(self, spec: Any, omitted: OmittedShapes) -> None:
        """Remove the elements whose files are missing from a model.

        MuJoCo would refuse a model with missing files, so it was loaded with placeholders for them.
        These are removed here, before compilation, with all geoms (shapes) that use them.

        Args:
            spec: editable model (`mujoco.MjSpec`); it is changed in place.
            omitted: record of omitted shapes.

        Raises:
            InputError: the mass of a moving body depends on a missing mesh.
        """
        reason = "is absent"
        for geom in list(spec.geoms):
            file = self.meshes.get(geom.meshname) or self.fields.get(geom.hfieldname)
            if file:
                omitted.leave_out(spec, geom, file, reason)
        for assets, names in ((spec.meshes, self.meshes), (spec.hfields, self.fields)):
            for asset in [asset for asset in assets if asset.name in names]:
                spec.delete(asset)
        if self.pictures:
            omitted.seen.setdefault(reason, []).extend(self.pictures)


def load_referenced_files(files: ModelFileReader, root: Element) -> MissingFiles:
    """Read the files that an MJCF refers to, and insert placeholders for missing ones.

    Reading adds the files to the digest of the model, so that a changed mesh is another model. A
    missing file is not an error yet: a robot can be simulated without a visual mesh. The folders of
    the files are those of the element ``<compiler>``; later settings replace earlier ones.

    Args:
        files: reader of the model file.
        root: root element of the MJCF; it is changed in place.

    Returns:
        The missing files.

    Raises:
        InputError: a count, a size or a file is too large, or an attached model is missing.
    """
    _check_sizes(files, root, 1.0)
    missing_files = MissingFiles()
    settings = {key: value for e in find_children(root, "compiler") for key, value in e.items()}
    asset_folder = settings.get("assetdir", "")
    mesh_folder = settings.get("meshdir", asset_folder)
    texture_folder = settings.get("texturedir", asset_folder)
    strip = settings.get("strippath") == "true"
    for element in root.iter("flexcomp"):
        file = element.get("file")
        if file and _read_asset(files, mesh_folder, file, strip):
            element.set("file", str((files.path.parent / mesh_folder / file).resolve()))
    for asset in find_children(root, "asset"):
        for element in list(asset):
            if element.tag == "model":
                _read_attached_model(files, element)
                continue
            folder = texture_folder if element.tag == "texture" else mesh_folder
            missing = [
                name
                for name in _iterate_asset_files(element)
                if not _read_asset(files, folder, name, strip)
            ]
            if missing:
                _insert_placeholder(missing_files, asset, element, missing[0])
    return missing_files


def _check_sizes(files: ModelFileReader, element: Element, factor: float) -> None:
    """Reject counts and sizes in a model file that would exhaust the memory.

    A short file may ask for many elements: for a grid of 1000 x 1000, or for a copy of copies.

    Args:
        files: reader of the model file, which makes the errors.
        element: element to check, with all its children.
        factor: number of copies of the element, the product of all counts above it; 1 for the root.
    """
    for key, value in element.items():
        size_numbers = (
            [_parse_size(number_text) for number_text in value.split()]
            if key in (*COUNT_ATTRIBUTES, *MAX_SIZE_ATTRIBUTES)
            else []
        )
        max_value = MAX_SIZE_ATTRIBUTES.get(key, MAX_COUNT)
        if key in COUNT_ATTRIBUTES:
            factor *= math.prod(max(number, 1.0) for number in size_numbers)
        if max([factor, *size_numbers]) > max_value or (
            key.startswith("nuser_") and _parse_size(value) > MAX_COUNT
        ):
            raise files.make_error(
                element, f'{key}="{truncate_text(value)}" is too much: at most {max_value:g} in all'
            )
    for child in element:
        _check_sizes(files, child, factor)


def _parse_size(text: str) -> float:
    """Return the magnitude of a number in an attribute; zero if the text is not a number."""
    try:
        return abs(float(text))
    except ValueError:  # MuJoCo itself reports what it expects.
        return 0.0


def _read_attached_model(files: ModelFileReader, element: Element) -> None:
    """Check an attached model, another model file that MuJoCo opens itself.

    Its content becomes part of the digest, and its sizes are checked like those of the main file.

    Args:
        files: reader of the files of the model.
        element: element that attaches the model; its path becomes absolute.

    Raises:
        InputError: the model is missing, or includes itself.
    """
    name = element.get("file") or ""
    path = files.path.parent / name.replace("\\", "/")
    if not is_existing_file(path):
        raise files.make_error(element, f"the attached model {truncate_text(name)} is absent")
    if path.resolve() in files.included:
        raise files.make_error(element, f"{truncate_text(name)} includes itself")
    _check_sizes(files, parse_tree(files, path), 1.0)
    # MuJoCo opens the attached model before the spec knows its folder, so the path must be
    # absolute.
    element.set("file", str(path.resolve()))


def _iterate_asset_files(element: Element) -> Iterator[str]:
    """Return the names of the files that an asset refers to; a texture may have six."""
    keys = TEXTURE_FILE_ATTRIBUTES if element.tag == "texture" else ("file",)
    return (element.attrib[key] for key in keys if element.get(key))


def _read_asset(files: ModelFileReader, folder: str, name: str, strip: bool) -> bool:
    """Return whether an asset file exists, and read it into the digest of the model.

    Args:
        files: reader of the model file.
        folder: folder of the assets, relative to the model file.
        name: name as in the model file; it may have the backslashes of Windows.
        strip: whether folders in the name are ignored (attribute strippath).
    """
    file_name = name.replace("\\", "/")
    path = files.path.parent / folder / (PurePosixPath(file_name).name if strip else file_name)
    if not is_existing_file(path):
        return False
    files.read_content(path, MAX_ASSET_BYTES)
    return True


def _insert_placeholder(
    missing_files: MissingFiles, asset: Element, element: Element, file: str
) -> None:
    """Replace an asset with a missing file by a placeholder that MuJoCo loads.

    A mesh becomes a tetrahedron, a height field a flat square, and a texture a single colour. A
    skin, which is only visual, is removed. Other assets are left unchanged, so that MuJoCo reports
    the missing file.

    Args:
        missing_files: missing files found so far; the asset is added.
        asset: section of the model with the element.
        element: element that names the file; changed in place.
        file: name of the missing file.
    """
    name = element.get("name") or PurePosixPath(file.replace("\\", "/")).stem
    if element.tag == "mesh":
        missing_files.meshes[name] = file
        attributes = {"name": name, "vertex": PLACEHOLDER_MESH_VERTICES}
    elif element.tag == "hfield":
        missing_files.fields[name] = file
        attributes = {"name": name, "nrow": "2", "ncol": "2", "size": "1 1 1 1"}
    elif element.tag == "texture":
        missing_files.pictures.append(file)
        attributes = {"name": name, "type": element.get("type", "cube"), "builtin": "flat"}
        attributes |= {"width": "1", "height": "1"}
    elif element.tag == "skin":
        missing_files.pictures.append(file)
        asset.remove(element)
        return
    else:
        return
    element.attrib.clear()
    element.attrib.update(attributes)
