"""HDF5 files as logs: plain ones as one log, those of robomimic with a group for each run.

A column is named by the path of its dataset, ``obs/joint_pos``; the log of a run is the group as if
it were a folder, ``demo.hdf5/data/demo_3``. The package h5py is loaded when a file is read.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from sims.base import Array, InputError, frozen
from sims.recording.columnar import WIDEST

ENDINGS = (".h5", ".hdf5", ".hdf")
"""Endings of the names of HDF5 files."""
LARGEST_DATASET = 250_000_000
"""Maximum number of entries of a dataset that is read (2 GB of 64-bit numbers)."""
_RUN = re.compile(r"[A-Za-z_ -]*\d+")


def is_hdf5(path: Path) -> bool:
    """Return whether a path is that of an HDF5 file, by its ending."""
    return path.suffix.lower() in ENDINGS and path.is_file()


def group_of(path: Path) -> tuple[Path, str] | None:
    """Return the HDF5 file that a path leads into, and the group there; None if into none."""
    if is_hdf5(path):
        return path, "/"
    for parent in path.parents:
        if parent.exists():
            return (parent, path.relative_to(parent).as_posix()) if is_hdf5(parent) else None
    return None


def runs_in(path: Path) -> list[Path]:
    """Return the log of each run of a file: its groups that are numbered, else the file itself.

    Raises:
        InputError: it cannot be read, or h5py is not installed.
    """
    with _opened(path) as file:
        for name in ("", "data"):
            group = file.get(name or "/")
            groups = [key for key, own in _items(group) if hasattr(own, "items")]
            runs = [key for key in groups if _RUN.fullmatch(key)]
            if runs and len(runs) == len(groups):
                return [path / name / run for run in sorted(runs, key=_natural)]
    return [path]


def read_group(path: Path, group: str) -> tuple[dict[str, Array], dict[str, list[str]]]:
    """Read the numbers of a group by name, (T,) or (T, k), and its texts.

    Raises:
        InputError: there is no such group, or the file cannot be read.
    """
    columns: dict[str, Array] = {}
    texts: dict[str, list[str]] = {}
    with _opened(path) as file:
        own = file.get(group)
        if own is None or not hasattr(own, "items"):
            raise InputError(
                f"{path}: unknown group '{group}'; there are: {', '.join(_groups(file)) or 'none'}"
            )
        datasets: dict[str, Any] = {}
        own.visititems(lambda name, one: datasets.update({name: one}))
        for name, one in datasets.items():
            if not hasattr(one, "dtype"):
                continue
            wide = one.ndim > 1 and one.shape[1] > WIDEST
            if one.dtype.kind not in "fiub" or one.ndim not in (1, 2) or wide:
                texts[name] = _texts(one)
            elif one.size > LARGEST_DATASET:
                raise InputError(f"{path}: {name} has {one.size} entries; at most 250 million")
            else:
                columns[name] = frozen(np.asarray(one[()], dtype=np.float64))
    return columns, texts


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open an HDF5 file; whatever its reader raises becomes one line."""
    try:
        import h5py
    except ImportError:
        raise InputError(
            f"{path}: needs h5py to read it, not installed (pip install h5py)"
        ) from None
    try:
        with h5py.File(path, "r") as file:
            yield file
    except (InputError, MemoryError, KeyboardInterrupt):
        raise
    except Exception as error:  # of a file that is spoilt the reader raises what it likes
        what = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: not an HDF5 file that can be read: {what[:200]}") from None


def _items(group: Any) -> list[tuple[str, Any]]:
    """What stands in a group; nothing where there is no group."""
    return list(group.items()) if hasattr(group, "items") else []


def _groups(file: Any) -> list[str]:
    """Names of the groups of a file, the first ones of many."""
    found: list[str] = []
    file.visititems(lambda name, one: found.append(name) if hasattr(one, "items") else None)
    return found[:12]


def _texts(dataset: Any) -> list[str]:
    """The texts of a list of texts; nothing of another dataset."""
    if dataset.ndim != 1 or dataset.dtype.kind not in "OSU" or dataset.size > WIDEST:
        return []
    return [
        one.decode("utf-8", errors="replace") if isinstance(one, bytes) else str(one)
        for one in dataset[()].tolist()
    ]


def _natural(name: str) -> tuple[str, int]:
    """Order by number where names end in one: ``demo_2`` before ``demo_10``."""
    digits = re.search(r"\d+$", name)
    return (name[: digits.start()], int(digits[0])) if digits else (name, 0)
