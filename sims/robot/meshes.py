"""Where meshes and pictures lie that a model file names, and which of them are absent."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from sims.limits import cut
from sims.robot.xmlfile import MESH, Files

ENDINGS = (".stl", ".obj", ".msh")
"""Of meshes that MuJoCo reads."""
UPWARDS = 6
"""Folders above the file in which a package is looked for."""


@dataclass
class Meshes:
    """The files that a URDF names.

    Attributes:
        files: what has been read.
        folder: where MuJoCo is told to look for meshes, relative to the model file or absolute.
        left: by what was left out and why, the links that had it.
    """

    files: Files
    folder: str = ""
    left: dict[tuple[str, str], list[str]] = field(default_factory=dict)
    found: dict[str, str] = field(default_factory=dict)

    def find(self, name: str) -> tuple[str | None, str]:
        """A mesh's path, relative to the model file's folder where it can be, else None and why
        not.
        """
        if Path(name).suffix.lower() not in ENDINGS:
            return None, f"is of a format that MuJoCo does not read ({Path(name).suffix or 'none'})"
        if name not in self.found:
            path = self._existing(name)
            if path is None:
                return None, "is absent"
            self.files.content(path, MESH)
            self.found[name] = os.path.relpath(path, self.files.path.parent)
        return self.found[name], ""

    def _existing(self, name: str) -> Path | None:
        for path in self._candidates(name):
            try:
                if path.is_file():
                    return path
            except (OSError, ValueError):  # a name that no file can have
                return None
        return None

    def _candidates(self, name: str) -> list[Path]:
        """Where it may lie, nearest first."""
        here = self.files.path.parent
        scheme, separator, rest = name.partition("://")
        if not separator:
            plain = name.replace("\\", "/")
            return [here / self.folder / plain, here / plain, here / self.folder / Path(plain).name]
        if scheme == "file":
            return [Path(rest)]
        if scheme not in ("package", "model"):
            return []
        inside = PurePosixPath(rest)
        package, within = inside.parts[:1], Path(*inside.parts[1:])
        candidates = []
        above = here.resolve()
        for folder in [above, *above.parents][: UPWARDS + 1]:
            candidates += [folder / rest, folder / within]
            if folder.name in package:
                candidates.insert(0, folder / within)
        return candidates

    def leave_out(self, name: str, why: str, where: str) -> None:
        """Note that a link does without it."""
        self.left.setdefault((name, why), []).append(where)

    @property
    def notes(self) -> list[str]:
        """One line for each reason why shapes were left out."""
        reasons: dict[str, list[str]] = {}
        for (name, why), links in self.left.items():
            reasons.setdefault(why, []).append(f"{cut(name)} ({', '.join(map(cut, links[:3]))})")
        lines = []
        for why, shapes in reasons.items():
            more = f" and {len(shapes) - 3} more" if len(shapes) > 3 else ""
            listed = ", ".join(shapes[:3]) + more
            lines.append(
                f"collision shapes left out, with their contacts, whose mesh {why}: {listed}"
            )
        return lines
