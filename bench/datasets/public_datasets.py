"""Public data sets of datasets.toml: their folders on this machine, and their download.

A download checks every file against its published hash, converts it to the recording format where
needed, and writes the whole folder or nothing.
"""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path, PurePosixPath

import numpy as np

from bench import __version__
from sims.core.files import Content, atomic_new_folder
from sims.core.simulator import InputError, make_unknown_name_error
from sims.core.toml_validation import tomllib

FOLDER_VARIABLES = {"recording": "SIMGAP_DATA", "robot": "SIMGAP_ROBOTS"}
"""Environment variables with the folder of data sets, by kind of data set."""
_TIMEOUT = 30.0
"""Timeout for a server that sends no data, seconds."""
_READ_BLOCK_BYTES = 1 << 16
"""Number of bytes that are read at a time."""
_PERIOD_MS = 1
"""Sample period of the published file of the free swing, ms."""
_DECIMATION = 5
"""Decimation factor of the free swing: every fifth sample is kept, which gives 200 Hz."""
_SAMPLES_PER_RUN = 1000
"""Number of samples of a run of the free swing: 5 s at 200 Hz."""
_HELD_OUT_FROM = 7
"""Number of the first held-out run of the free swing."""
_DECIMALS = 6
"""Number of decimals to which its angles and rates are rounded; an encoder step is 1e-3 rad."""
_FREE_SWING = """system = "pendulum"
title = "Single pendulum, free swing, encoder"

[channels.q]
unit = "rad"      # 0 = hanging straight down

[channels.qd]
unit = "rad/s"

[constants]
mass = 0.1476     # kg, bob and rod
length = 0.1478   # m, hinge to centre of mass
gravity = 9.81    # m/s^2
"""
"""Description (TOML) of the free swing, without its runs."""
Advance = Callable[[int], None]
"""Callback with the number of bytes received."""
Conversion = Callable[[Mapping[str, bytes]], dict[str, Content]]
"""Function from the contents of a data set's files, by name, to the files to write, by name."""


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
        conversion: key of `CONVERSIONS`; empty if the files are used without conversion.
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


def find_present_folder(data_set: DataSet, target_folder: Path | None) -> Path | None:
    """Return the folder of a data set that is already present; None if it must be downloaded.

    Args:
        data_set: data set of the catalogue: its files, source and licence.
        target_folder: folder below which it may be; None for the usual ones.
    """
    if target_folder is None:
        return data_set.folder()
    # In a named folder the files themselves are looked for.
    folder = target_folder / data_set.name
    return folder if all((folder / file).is_file() for file in data_set.provides) else None


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


def download(
    data_set: DataSet, folder: Path, source: str = "", advance: Advance = lambda _: None
) -> Path:
    """Download a data set, check and convert its files, and write them into the folder NAME.

    The files are used as they are if the data set has no conversion. Its licence and a note on its
    source are always written.

    Args:
        data_set: data set of the catalogue: its files, source and licence.
        folder: parent folder of NAME; created if it does not exist.
        source: source of the files instead of their public repository: a folder that contains them,
            such as a clone at the data set's commit, or an address that serves the repository's
            files; empty for the public repository.
        advance: called with the number of bytes whenever some are received.

    Returns:
        The data set's folder.

    Raises:
        InputError: a file cannot be downloaded or is not the published one, or the folder cannot be
            written. Nothing is written then.
    """
    target = folder / data_set.name
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise InputError(
            f"{target}: exists and does not contain {' and '.join(data_set.provides)}; "
            "delete it, or choose another folder with --out"
        )
    downloaded = {
        file.name: _check_content(file, *_fetch_file(data_set, file, source, advance))
        for file in data_set.files
    }
    contents: dict[str, Content] = dict(downloaded)
    if data_set.conversion:
        contents = CONVERSIONS[data_set.conversion](downloaded)
        contents["LICENSE"] = downloaded["LICENSE"]
    contents["SOURCE.txt"] = _format_provenance(data_set)
    _write_folder(target, contents)
    return target


def _fetch_file(
    data_set: DataSet, file: SourceFile, source: str, advance: Advance
) -> tuple[str, bytes]:
    """Fetch a file from the folder or address that the user gave, or from the public repository.

    Args:
        data_set: Data set that has the file.
        file: File to read.
        source: Folder, or http or https address; empty for the public repository.
        advance: Called with the number of bytes received.

    Returns:
        Path or address of the file, for messages, and its content, which is not checked yet.

    Raises:
        InputError: The source is of another form, or the file cannot be read.
    """
    if source and "://" not in source:
        return _read_file(data_set, file, Path(source), advance)
    if source and not source.startswith(("http://", "https://")):
        raise InputError(f"--from {source}: expected a folder, or an http or https address")
    url = f"{(source or data_set.base_url).rstrip('/')}/{file.path}"
    return url, _download_content(url, data_set, file, advance)


def _read_file(
    data_set: DataSet, file: SourceFile, folder: Path, advance: Advance
) -> tuple[str, bytes]:
    """Read a file from a folder that contains a clone, or the files without subfolders.

    At most one byte more than expected is read: enough for the later check to see that the file is
    too long.

    Args:
        data_set: Data set that has the file.
        file: File to read.
        folder: Folder that the user gave.
        advance: Called with the number of bytes read.

    Returns:
        Path and content of the file.

    Raises:
        InputError: The file is not there, or cannot be read.
    """
    if not folder.is_dir():
        raise InputError(f"--from {folder}: no such folder")
    for path in (folder / file.path, folder / Path(file.path).name, folder / file.name):
        if path.is_file():
            try:
                with path.open("rb") as stream:
                    content = stream.read(file.bytes + 1)
            except OSError as error:
                raise InputError(f"{path}: cannot be read ({error.strerror})") from None
            advance(len(content))
            return str(path), content
    origin = f"commit {data_set.commit[:7]} of {data_set.repository}"
    raise InputError(
        f"{folder}: expected {file.path} of {origin}, or the file alone; found neither"
    )


def _download_content(url: str, data_set: DataSet, file: SourceFile, advance: Advance) -> bytes:
    """Download the content of an address, in blocks.

    At most one byte more than expected is received: enough for the later check to see that the file
    is too long.

    Args:
        url: Address of the file.
        data_set: Data set, for the advice in messages.
        file: Expected size of the content.
        advance: Called with the number of bytes received.

    Raises:
        InputError: The file cannot be downloaded.
    """
    # Most commands only look up data sets and do not download them.
    import http.client
    import urllib.error
    import urllib.request

    remedy = (
        f"download it by other means and give its folder with `{data_set.command} --from FOLDER`"
    )
    request = urllib.request.Request(url, headers={"User-Agent": f"simgap/{__version__}"})
    content = b""
    try:
        with urllib.request.urlopen(request, timeout=_TIMEOUT) as response:
            while len(content) <= file.bytes:
                block = response.read(min(_READ_BLOCK_BYTES, file.bytes + 1 - len(content)))
                if not block:
                    break
                content += block
                advance(len(block))
    except urllib.error.HTTPError as error:
        response_text = f"the server answers {error.code} {error.reason}"
        raise InputError(f"{url}: {response_text}; {remedy}") from None
    except (OSError, ValueError, http.client.HTTPException) as error:
        reason = getattr(error, "reason", None) or error
        raise InputError(f"{url}: cannot be downloaded ({reason}); {remedy}") from None
    return content


def _check_content(file: SourceFile, location: str, content: bytes) -> bytes:
    """Return the content of a file if it is the published one.

    Args:
        file: File with its published size and SHA-256.
        location: Path or address from which it was fetched, for messages.
        content: Content of the file.

    Raises:
        InputError: Size or SHA-256 differ.
    """
    size = len(content)
    if size > file.bytes:
        raise InputError(f"{location}: expected {file.bytes} bytes, found more; nothing is written")
    if size < file.bytes:
        mismatch = f"expected {file.bytes} bytes, found {size}"
        raise InputError(
            f"{location}: {mismatch}: incomplete; download it again; nothing is written"
        )
    digest = hashlib.sha256(content).hexdigest()
    if digest != file.sha256:
        mismatch = f"expected SHA-256 {file.sha256}, found {digest}"
        raise InputError(f"{location}: {mismatch}: not the published file; nothing is written")
    return content


def _format_provenance(data_set: DataSet) -> str:
    """Format the text of SOURCE.txt: source, citation, licence and hashes of the files.

    It also says how files were converted, if they were.

    Args:
        data_set: Data set with its repository, commit, licence and files.
    """
    lines = [
        data_set.title,
        f"Source: {data_set.repository}, commit {data_set.commit}",
        f"Cite: {data_set.cite}",
        f"Licence: {data_set.licence}, see LICENSE",
        *(f"File: {file.path}, SHA-256 {file.sha256}" for file in data_set.files),
    ]
    if data_set.conversion:
        lines.append(
            f"{', '.join(data_set.provides)}: converted from it by `{data_set.command}` of simgap "
            f"{__version__} (bench/datasets/public_datasets.py, {data_set.conversion})"
        )
    return "\n".join(lines) + "\n"


def _write_folder(target: Path, contents: dict[str, Content]) -> None:
    """Write the folder of a data set as a whole, or not at all.

    Args:
        target: Folder of the data set, which must be empty or missing.
        contents: Files by name; text is written as UTF-8.

    Raises:
        InputError: The folder cannot be written.
    """
    try:
        with atomic_new_folder(target) as partial:
            for name, content in contents.items():
                data = content.encode() if isinstance(content, str) else content
                (partial / name).write_bytes(data)
    except OSError as error:
        remedy = "choose another folder with --out"
        raise InputError(f"{target}: cannot be written ({error.strerror}); {remedy}") from None


def free_swing(files: Mapping[str, bytes]) -> dict[str, Content]:
    """Convert the free swing of the single pendulum to a recording with runs of 5 s.

    The MATLAB file holds one swing, sampled every 1 ms and divided into pieces: ``Y_id`` and
    ``Y_vad`` are cell arrays of pieces (2, T) with angles in rad (pi is hanging) and rates in
    rad/s. The pieces are joined, every fifth sample is kept, and the angle is measured from
    hanging. Runs from number 7 on are held out. The samples after the last whole run are left out.

    Args:
        files: Contents of the downloaded files by name.

    Returns:
        Table (CSV) and description (TOML) by file name.

    Raises:
        InputError: the file does not have this form.
    """
    (name,) = [name for name in files if name.endswith(".mat")]
    angles, rates = _join_records(name, files[name])[:, ::_DECIMATION]
    q = np.round(angles, _DECIMALS) - np.pi
    qd = np.round(rates, _DECIMALS)
    run_count = q.size // _SAMPLES_PER_RUN
    if run_count == 0:
        raise InputError(
            f"{name}: expected at least {_SAMPLES_PER_RUN * _DECIMATION} samples of 1 ms"
        )
    # Index of the run, and of the sample in its run, for each row of the table.
    run_indices, samples = np.divmod(np.arange(run_count * _SAMPLES_PER_RUN), _SAMPLES_PER_RUN)
    t = samples * _DECIMATION * _PERIOD_MS / 1000  # s
    columns = (run_indices + 1, t, q[: t.size], qd[: t.size])
    table = io.StringIO()
    np.savetxt(table, np.stack(columns, axis=1), "%.7g", ",", header="run,t,q,qd", comments="")
    held_out = range(_HELD_OUT_FROM, run_count + 1)
    description = _FREE_SWING + "".join(f"\n[runs.{run}]\nheld_out = true\n" for run in held_out)
    return {"recording.csv": table.getvalue(), "recording.toml": description}


def _join_records(name: str, content: bytes) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Join the angles and rates (2, T) of all pieces of a MATLAB file, in their order.

    The pieces are entries of the cell arrays ``Y_id`` and, after them, ``Y_vad``.

    Args:
        name: name of the file, for messages.
        content: content of the file.

    Raises:
        InputError: the file is damaged or has another form.
    """
    from scipy.io import loadmat

    try:
        arrays = loadmat(io.BytesIO(content))  # type: ignore[arg-type]  # the stubs know no streams
        records = [record for key in ("Y_id", "Y_vad") for record in arrays[key].ravel()]
        joined_samples = np.concatenate([np.asarray(record, float) for record in records], axis=1)
    except Exception as error:  # the reader raises various errors for a damaged file
        reason = f"{type(error).__name__}: {error}"
        expected = "a MATLAB file with cell arrays Y_id and Y_vad of (2, T) numbers"
        raise InputError(f"{name}: expected {expected} ({reason})") from None
    if joined_samples.shape[0] != 2:
        raise InputError(
            f"{name}: expected 2 rows in Y_id and Y_vad, found {joined_samples.shape[0]}"
        )
    return joined_samples


CONVERSIONS: Mapping[str, Conversion] = {"free_swing": free_swing}
"""Conversions by their names in datasets.toml."""
