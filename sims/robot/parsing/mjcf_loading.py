"""Prepare an MJCF for loading: read the files that it refers to, and check its sizes."""

from __future__ import annotations

import math
from pathlib import PurePosixPath
from xml.etree.ElementTree import Element

from sims.core.files import is_existing_file
from sims.core.user_messages import truncate_text
from sims.robot.parsing.xml_files import MAX_ASSET_BYTES, ModelFileReader, find_children, parse_tree

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


def read_referenced_files(files: ModelFileReader, root: Element) -> None:
    """Read the files that an MJCF refers to into the model's digest.

    So a model with a changed mesh counts as another model. A missing mesh or texture is not an
    error yet: a robot can be simulated without a visual mesh. The folders of the files are those of
    the elements ``<compiler>``; later settings replace earlier ones.

    Args:
        files: reader of the model file.
        root: root element of the MJCF; paths that MuJoCo would not find, those of flexible bodies
            and attached models, become absolute.

    Raises:
        InputError: a count, a size or a file is too large, or an attached model is missing.
    """
    _check_sizes(files, root, 1.0)
    # Folders of meshes and textures, and whether folders in the names of files are ignored.
    settings = {key: value for e in find_children(root, "compiler") for key, value in e.items()}
    asset_folder = settings.get("assetdir", "")
    mesh_folder = settings.get("meshdir", asset_folder)
    texture_folder = settings.get("texturedir", asset_folder)
    strip = settings.get("strippath") == "true"
    # Flexible bodies.
    for element in root.iter("flexcomp"):
        file = element.get("file")
        if file and _read_asset(files, mesh_folder, file, strip):
            element.set("file", str((files.path.parent / mesh_folder / file).resolve()))
    # Meshes, textures and other assets, and attached models.
    for asset in find_children(root, "asset"):
        for part in asset:
            if part.tag == "model":
                _read_attached_model(files, part)
                continue
            folder = texture_folder if part.tag == "texture" else mesh_folder
            for key in TEXTURE_FILE_ATTRIBUTES if part.tag == "texture" else ("file",):
                if part.get(key):
                    _read_asset(files, folder, part.attrib[key], strip)


def _check_sizes(files: ModelFileReader, element: Element, factor: float) -> None:
    """Reject counts and sizes in a model file that would exhaust the memory.

    A short file may ask for many elements: for a grid of 1000 x 1000, or for a copy of copies.

    Args:
        files: reader of the model file, which makes the errors.
        element: element to check, with all its children.
        factor: number of copies of the element, the product of all counts above it; 1 for the root.

    Raises:
        InputError: a size is too large, or there would be too many copies.
    """
    for key, value in element.items():
        sizes: list[float] = []
        if key in (*COUNT_ATTRIBUTES, *MAX_SIZE_ATTRIBUTES):
            sizes = [_parse_size(number_text) for number_text in value.split()]
        max_value = MAX_SIZE_ATTRIBUTES.get(key, MAX_COUNT)
        # A count of several numbers is that of a grid.
        if key in COUNT_ATTRIBUTES:
            factor *= math.prod(max(number, 1.0) for number in sizes)
        # Attributes such as `nuser_body` request user data for each element of a kind.
        has_much_user_data = key.startswith("nuser_") and _parse_size(value) > MAX_COUNT
        if max([factor, *sizes]) > max_value or has_much_user_data:
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
    """Read and check an attached model, another model file that MuJoCo opens itself.

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
