"""Find the mesh files that a URDF refers to, and record the missing ones."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from sims.core.path_checks import is_existing_file
from sims.robot.note_text import format_name_list
from sims.robot.parsing.xml_files import MAX_ASSET_BYTES, ModelFileReader

MESH_SUFFIXES = (".stl", ".obj", ".msh")
"""File name suffixes of mesh formats that MuJoCo reads."""
MAX_PARENT_FOLDERS = 6
"""Maximum number of parent folders of the model file in which a package is searched."""


@dataclass
class MeshLookup:
    """Mesh files that a URDF refers to.

    Attributes:
        files: reader of the model file and its assets.
        folder: mesh folder given to MuJoCo, relative to the model file or absolute.
        left: names of omitted meshes, by reason.
        found: paths of the meshes found, relative to the model file's folder, by name in the URDF.
    """

    files: ModelFileReader
    folder: str = ""
    left: dict[str, list[str]] = field(default_factory=dict)
    found: dict[str, str] = field(default_factory=dict)

    def find(self, name: str) -> tuple[str | None, str]:
        """Find the file of a mesh of a URDF, whose URI often names a ROS package.

        Args:
            name: file name or URI in the URDF.

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
        """Return the possible paths of a mesh, in the order in which they are tried."""
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
            # The folder is the package, contains it, or is the package under another name.
            package_path = folder.joinpath(*relative_parts)
            candidates += [package_path] if folder.name == package else []
            candidates += [folder / uri_path, package_path]
        return candidates

    def leave_out(self, name: str, reason: str) -> None:
        """Record that a link omits a mesh.

        Args:
            name: file name or URI in the URDF.
            reason: why the mesh cannot be read.
        """
        self.left.setdefault(reason, []).append(PurePosixPath(name).name)

    @property
    def notes(self) -> list[str]:
        """One note for each reason why shapes were omitted."""
        return [
            f"shapes left out, and their contacts, since their mesh {reason}: "
            f"{format_name_list(names)}"
            for reason, names in self.left.items()
        ]
