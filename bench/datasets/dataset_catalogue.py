"""Catalogue of the data sets in datasets.toml, and their folders on this machine."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path, PurePosixPath

from sims.core.simulator import make_unknown_name_error
from sims.core.toml_validation import tomllib

FOLDER_VARIABLES = {"recording": "SIMGAP_DATA", "robot": "SIMGAP_ROBOTS"}
"""Environment variables with the folder of data sets, by kind of data set."""


@dataclass(frozen=True)
class SourceFile:
    """File of a data set in its public repository.

    Attributes:
        path: path in the repository.
        bytes: size.
        sha256: SHA-256, hexadecimal.
        write_as: file name in the data set's folder, if it differs from that in the repository.
    """

    path: str
    bytes: int
    sha256: str
    write_as: str = ""

    @property
    def name(self) -> str:
        """File name in the data set's folder, for files that are written without conversion."""
        return self.write_as or PurePosixPath(self.path).name


@dataclass(frozen=True)
class DataSet:
    """Public data set.

    Attributes:
        name: name of the data set, and of its folder.
        title: one line on its content.
        kind: "recording" or "robot".
        licence: SPDX identifier of the licence under which its authors published it.
        repository: address of its GitHub repository.
        commit: commit of the repository, 40 hexadecimal digits.
        cite: authors and paper.
        provides: names of the files that commands read from its folder.
        files: files to download.
        conversion: key of `dataset_download.CONVERSIONS`; empty if the files are used
            without conversion.
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
        """Number of bytes to download."""
        return sum(file.bytes for file in self.files)

    @property
    def size(self) -> str:
        """Size of the download as text, for example ``1.0 MB``."""
        kilobytes = self.bytes / 1e3
        return f"{kilobytes / 1e3:.1f} MB" if kilobytes >= 1e3 else f"{kilobytes:.0f} kB"

    @property
    def base_url(self) -> str:
        """Base address of its files."""
        owner_and_name = self.repository.removeprefix("https://github.com/")
        return f"https://raw.githubusercontent.com/{owner_and_name}/{self.commit}"

    @property
    def command(self) -> str:
        """Command that downloads the data set."""
        return f"simgap download {self.name}"

    @property
    def advice(self) -> str:
        """Text of a message when the data set is needed and missing."""
        return f"needs the data set {self.name} ({self.size}, {self.licence}): run `{self.command}`"

    def folder(self) -> Path | None:
        """Return the folder of the data set on this machine, or None if it is not there.

        A folder is only accepted if it contains all files that commands read (`provides`).
        """
        for parent in list_search_folders(self.kind):
            if all((parent / self.name / file).is_file() for file in self.provides):
                return parent / self.name
        return None


def get_user_folder() -> Path:
    """Return the folder of this user's data sets.

    It is simgap/ in $XDG_DATA_HOME, or else in ~/.local/share.
    """
    base = os.environ.get("XDG_DATA_HOME")
    return (Path(base) if base else Path.home() / ".local" / "share") / "simgap"


def list_search_folders(kind: str) -> Iterator[Path]:
    """Yield the folders in which data sets of a kind are searched, in this order.

    They are the one in the environment variable, if it is set, and the user's.
    """
    stated_folder = os.environ.get(FOLDER_VARIABLES[kind])
    if stated_folder:
        yield Path(stated_folder)
    yield get_user_folder()


def find(kind: str, path: str) -> Path | None:
    """Find a file of a data set in the folders of this machine.

    Args:
        kind: kind of data set, "recording" or "robot".
        path: path of the file, with the name of the data set as its folder.

    Returns:
        The first file found; None if there is none, or the path cannot be that of a file.
    """
    for folder in list_search_folders(kind):
        try:
            if (folder / path).is_file():
                return folder / path
        except (OSError, ValueError):  # a name that no file can have
            return None
    return None


def names() -> list[str]:
    """List the names of all data sets."""
    return list(_read_catalogue())


def get(name: str) -> DataSet:
    """Return the data set of a name.

    Raises:
        InputError: no data set has this name; the message lists the known names.
    """
    if name not in _read_catalogue():
        raise make_unknown_name_error("data set", name, names())
    return _read_catalogue()[name]


def find_providing_data_set(kind: str, path: str) -> DataSet | None:
    """Return the data set that provides a file of an experiment, or None.

    Args:
        kind: kind of data set, "recording" or "robot".
        path: path of the file, with the name of the data set as its folder.
    """
    name, _, file = path.replace("\\", "/").rpartition("/")
    data_set = _read_catalogue().get(name)
    if data_set is None or data_set.kind != kind or file not in data_set.provides:
        return None
    return data_set


@cache
def _read_catalogue() -> dict[str, DataSet]:
    """Read datasets.toml, and return its data sets by name."""
    text = resources.files(__package__).joinpath("datasets.toml").read_text(encoding="utf-8")
    return {name: _make_data_set(name, table) for name, table in tomllib.loads(text).items()}


def _make_data_set(name: str, table: dict[str, object]) -> DataSet:
    """Make a data set from its table in datasets.toml.

    Args:
        name: name of the table and of the data set.
        table: its entries, named as the attributes of `DataSet`, with ``files`` as a list of
            tables.
    """
    other_entries: dict[str, object] = dict(table)
    files = other_entries.pop("files")
    provides = other_entries.pop("provides")
    assert isinstance(files, list)
    assert isinstance(provides, list)
    return DataSet(
        name=name,
        files=tuple(SourceFile(**file) for file in files),
        provides=tuple(provides),
        **other_entries,  # type: ignore[arg-type]  # keys of the package's own file
    )
