"""Where meshes lie that a URDF names, and which of them are absent."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from sims.robot.words import listed
from sims.robot.xmlfile import MESH, Files

ENDINGS = (".stl", ".obj", ".msh")
"""Of meshes that MuJoCo reads."""
UPWARDS = 6
"""Folders above the file in which a package is looked for."""


@dataclass
class Meshes:
    """The meshes that a URDF names.

    Attributes:
        files: what has been read.
        folder: where MuJoCo is told to look for meshes, relative to the model file or absolute.
        left: by the reason why, those that were left out.
        found: by name, the path relative to the model file's folder.
    """

    files: Files
    folder: str = ""
    left: dict[str, list[str]] = field(default_factory=dict)
    found: dict[str, str] = field(default_factory=dict)

    def find(self, name: str) -> tuple[str | None, str]:
        """A mesh's path, relative to the model file's folder, else None and why not."""
        ending = PurePosixPath(name).suffix
        if ending.lower() not in ENDINGS:
            return None, f"is of a format that MuJoCo does not read ({ending or 'none'})"
        if name not in self.found:
            path = next((path for path in self._candidates(name) if exists(path)), None)
            if path is None:
                return None, "is absent"
            self.files.content(path, MESH)
            here = self.files.path.parent.resolve()
            self.found[name] = Path(os.path.relpath(path.resolve(), here)).as_posix()
        return self.found[name], ""

    def _candidates(self, name: str) -> list[Path]:
        """Where it may lie, in the order in which it is looked for."""
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
        for folder in [above, *above.parents][: UPWARDS + 1]:
            # The folder is the package, holds it, or stands for it under another name.
            inside = folder.joinpath(*within)
            candidates += [inside] if folder.name == package else []
            candidates += [folder / rest, inside]
        return candidates

    def leave_out(self, name: str, why: str) -> None:
        """Note that a link does without it."""
        self.left.setdefault(why, []).append(PurePosixPath(name).name)

    @property
    def notes(self) -> list[str]:
        """One line for each reason why shapes were left out."""
        return [
            f"shapes left out, and their contacts, since their mesh {why}: {listed(names)}"
            for why, names in self.left.items()
        ]


def exists(path: Path) -> bool:
    """Whether there is such a file; a name that none can have is no file's."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False
