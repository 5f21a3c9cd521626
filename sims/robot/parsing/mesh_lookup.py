"""Find the mesh files that a URDF refers to, and record the missing ones."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

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
            path = next((path for path in self._list_candidate_paths(name) if is_file(path)), None)
            if path is None:
                return None, "is absent"
            self.files.read_content(path, MAX_ASSET_BYTES)
            here = self.files.path.parent.resolve()
            self.found[name] = Path(os.path.relpath(path.resolve(), here)).as_posix()
        return self.found[name], ""

    def _list_candidate_paths(self, name: str) -> list[Path]:
        """Return the possible paths of a mesh, in the order in which they are tried."""
        here = self.files.path.parent
        scheme, separator, rest = name.partition("://")
        if not separator:
            plain = name.replace("\\", "/")
            folder = here / self.folder
            return [folder / plain, here / plain, folder / PurePosixPath(plain).name]
        if scheme == "file":
            return [Path(rest)]
        if scheme not in ("package", "model"):
            return []
        package, *within = PurePosixPath(rest).parts or [""]
        candidates = []
        above = here.resolve()
        for folder in [above, *above.parents][: MAX_PARENT_FOLDERS + 1]:
            # The folder is the package, contains it, or is the package under another name.
            inside = folder.joinpath(*within)
            candidates += [inside] if folder.name == package else []
            candidates += [folder / rest, inside]
        return candidates

    def leave_out(self, name: str, why: str) -> None:
        """Record that a link omits a mesh.

        Args:
            name: file name or URI in the URDF.
            why: reason.
        """
        self.left.setdefault(why, []).append(PurePosixPath(name).name)

    @property
    def notes(self) -> list[str]:
        """One note for each reason why shapes were omitted."""
        return [
            f"shapes left out, and their contacts, since their mesh {why}: "
            f"{format_name_list(names)}"
            for why, names in self.left.items()
        ]


def is_file(path: Path) -> bool:
    """Return whether the path is an existing file; False for names that the system rejects."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False
