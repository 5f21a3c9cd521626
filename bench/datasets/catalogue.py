"""The data sets of datasets.toml, and where each lies on this machine."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path, PurePosixPath

from sims.base import unknown
from sims.user_toml import tomllib

FOLDER_VARIABLES = {"recording": "SIMGAP_DATA", "robot": "SIMGAP_ROBOTS"}
"""By kind of data set, the environment variable that names the folder of such data sets."""


@dataclass(frozen=True)
class SourceFile:
    """A file of a data set in its public repository.

    Attributes:
        path: in the repository.
        bytes: its size.
        sha256: its digest, hexadecimal.
        write_as: name under which it is written, where it is written under another.
    """

    path: str
    bytes: int
    sha256: str
    write_as: str = ""

    @property
    def name(self) -> str:
        """Name of the file in the data set's folder, where it is written there as it is."""
        return self.write_as or PurePosixPath(self.path).name


@dataclass(frozen=True)
class DataSet:
    """A public data set.

    Attributes:
        name: of the data set, and of its folder.
        title: one line on what it holds.
        kind: "recording" or "robot".
        licence: SPDX identifier of the licence under which its authors published it.
        repository: address of its GitHub repository.
        commit: of the repository, 40 hexadecimal digits.
        cite: authors and paper.
        provides: names of the files that commands read from its folder.
        files: what is fetched.
        conversion: key of `bench.datasets.conversions.CONVERSIONS`; empty where the files are
            used as they are.
    """

    name: str
    title: str
    kind: str
    licence: str
    repository: str
    commit: str
    cite: str
    provides: tuple[str, ...]
    files: tuple[SourceFile, ...]
    conversion: str = ""

    @property
    def bytes(self) -> int:
        """Bytes that are downloaded."""
        return sum(file.bytes for file in self.files)

    @property
    def size(self) -> str:
        """Size of the download in words, e.g. ``1.0 MB``."""
        kilobytes = self.bytes / 1e3
        return f"{kilobytes / 1e3:.1f} MB" if kilobytes >= 1e3 else f"{kilobytes:.0f} kB"

    @property
    def base_url(self) -> str:
        """Address below which its files are served."""
        owner_and_name = self.repository.removeprefix("https://github.com/")
        return f"https://raw.githubusercontent.com/{owner_and_name}/{self.commit}"

    @property
    def command(self) -> str:
        """The command that gets it."""
        return f"simgap download {self.name}"

    @property
    def advice(self) -> str:
        """What a message says where the data set is needed and missing."""
        return f"needs the data set {self.name} ({self.size}, {self.licence}): run `{self.command}`"

    def folder(self) -> Path | None:
        """The folder in which it lies on this machine; None where it does not."""
        for parent in search_folders(self.kind):
            if all((parent / self.name / file).is_file() for file in self.provides):
                return parent / self.name
        return None


def user_folder() -> Path:
    """The folder of this user's data sets: simgap/ in $XDG_DATA_HOME, else in ~/.local/share."""
    base = os.environ.get("XDG_DATA_HOME")
    return (Path(base) if base else Path.home() / ".local" / "share") / "simgap"


def search_folders(kind: str) -> Iterator[Path]:
    """The folders in which data sets of a kind are looked for, in this order: the one that the
    environment names, then the user's.
    """
    given = os.environ.get(FOLDER_VARIABLES[kind])
    if given:
        yield Path(given)
    yield user_folder()


def find(kind: str, path: str) -> Path | None:
    """The file `path` below the first folder of a kind that holds it; None where none does."""
    for folder in search_folders(kind):
        try:
            if (folder / path).is_file():
                return folder / path
        except (OSError, ValueError):  # no file could have such a name
            return None
    return None


def names() -> list[str]:
    """Names of all data sets."""
    return list(_catalogue())


def get(name: str) -> DataSet:
    """The data set of a name.

    Raises:
        InputError: no data set has this name; the message lists the known names.
    """
    if name not in _catalogue():
        raise unknown("data set", name, names())
    return _catalogue()[name]


def providing(kind: str, path: str) -> DataSet | None:
    """The data set of a kind that provides the file `path` of an experiment; None where none
    does.
    """
    folder, _, file = path.replace("\\", "/").rpartition("/")
    found = _catalogue().get(folder)
    return found if found and found.kind == kind and file in found.provides else None


@cache
def _catalogue() -> dict[str, DataSet]:
    text = resources.files(__package__).joinpath("datasets.toml").read_text(encoding="utf-8")
    return {name: _data_set(name, table) for name, table in tomllib.loads(text).items()}


def _data_set(name: str, table: dict[str, object]) -> DataSet:
    given: dict[str, object] = dict(table)
    files = given.pop("files")
    provides = given.pop("provides")
    assert isinstance(files, list)
    assert isinstance(provides, list)
    return DataSet(
        name=name,
        files=tuple(SourceFile(**file) for file in files),
        provides=tuple(provides),
        **given,  # type: ignore[arg-type]  # keys of the package's own file
    )
