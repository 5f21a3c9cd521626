"""Read HDF5 and Parquet files as logs.

A column is named by the path of its dataset, ``obs/joint_pos``. The log of a run is addressed as if
its group were a folder, ``demo.hdf5/data/demo_3``. The package h5py is imported when a file is
read.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from sims.core.simulator import Array, InputError, make_read_only
from sims.recording.log_formats.log_columns import MAX_COLUMNS, convert_read_errors


def read_numeric_columns(table: Any) -> tuple[dict[str, Array], list[str]]:
    """Read the numeric columns of a pyarrow table.

    Shapes: T rows.

    Args:
        table: Table of pyarrow.

    Returns:
        Numbers by column name, (T,), or (T, k) for lists of k numbers; and the names of the columns
        without numbers.
    """
    columns: dict[str, Array] = {}
    texts = []
    for name in table.column_names:
        values = _convert_to_numbers(table.column(name))
        if values is None:
            texts.append(name)
        else:
            columns[name] = make_read_only(values)
    return columns, texts


def is_numeric_type(kind: Any) -> bool:
    """Return whether columns of a pyarrow type hold numbers, booleans, times or lists of them."""
    import pyarrow

    if _is_list(kind):
        kind = kind.value_type
    types = pyarrow.types
    predicates = types.is_integer, types.is_floating, types.is_timestamp, types.is_boolean
    return any(predicate(kind) for predicate in predicates)


def _is_list(kind: Any) -> bool:
    """Return whether an Arrow type is a list, of any of the three kinds in a Parquet table."""
    import pyarrow

    types = pyarrow.types
    return bool(types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind))


def _convert_to_numbers(column: Any) -> Array | None:
    """Return the numbers of a column as floats; None if it holds no numbers.

    Shapes: T rows.

    Time stamps become numbers in their own unit, and booleans 0 and 1.

    Args:
        column: Column of a pyarrow table.

    Returns:
        (T,) numbers, or (T, k) for lists of numbers, which must all have the same length k.
    """
    import pyarrow

    types = pyarrow.types
    if types.is_timestamp(column.type):
        column = column.cast(pyarrow.int64())
    elif types.is_boolean(column.type):
        column = column.cast(pyarrow.int8())
    if types.is_integer(column.type) or types.is_floating(column.type):
        return np.asarray(column.to_numpy(zero_copy_only=False), dtype=np.float64)
    if not _is_list(column.type):
        return None
    rows = column.to_pylist()
    lengths = {len(row) if row is not None else -1 for row in rows}  # -1 for a missing list
    if len(lengths) != 1 or not 0 < max(lengths) <= MAX_COLUMNS:
        return None
    try:
        return np.array(rows, dtype=np.float64)
    except (TypeError, ValueError):
        return None


ENDINGS = (".h5", ".hdf5", ".hdf")
"""Endings of the names of HDF5 files."""
MAX_DATASET_ENTRIES = 250_000_000
"""Maximum number of entries of a dataset that is read (2 GB of 64-bit numbers)."""
_RUN_NAME_PATTERN = re.compile(r"[A-Za-z_ -]*\d+")


def is_hdf5(path: Path) -> bool:
    """Return whether a path is an HDF5 file, by its ending."""
    return path.suffix.lower() in ENDINGS and path.is_file()


def split_group_path(path: Path) -> tuple[Path, str] | None:
    """Split a path into an HDF5 file and a group in it; None if it is not inside such a file.

    The group of the file itself is ``/``. A path in a file, such as ``demo.hdf5/data/demo_3``, does
    not exist on disk; the first of its parents that exists is the file.
    """
    if is_hdf5(path):
        return path, "/"
    for parent in path.parents:
        if parent.exists():
            return (parent, path.relative_to(parent).as_posix()) if is_hdf5(parent) else None
    return None


def list_run_paths(path: Path) -> list[Path]:
    """List the log of each run of a file: its numbered groups, or the file itself.

    Datasets of robot learning have groups such as ``data/demo_0``, ``data/demo_1``, one for a run.
    All groups at the top level or in ``data`` must be numbered; else the file is one run.

    Args:
        path: HDF5 file.

    Raises:
        InputError: The file cannot be read, or h5py is not installed.
    """
    with _open_file(path) as file:
        for parent in ("", "data"):
            members = _list_members(file.get(parent or "/"))
            groups = [name for name, member in members if hasattr(member, "items")]
            if groups and all(map(_RUN_NAME_PATTERN.fullmatch, groups)):
                return [path / parent / run for run in sorted(groups, key=_make_natural_sort_key)]
    return [path]


def read_group(path: Path, group: str) -> tuple[dict[str, Array], dict[str, list[str]]]:
    """Read the datasets of a group and of the groups in it.

    Shapes: T rows.

    Args:
        path: HDF5 file.
        group: Path of the group in it.

    Returns:
        Numbers by the path of their dataset in the group, (T,), or (T, k) with k columns; and the
        texts of each other dataset, empty where it holds neither numbers nor a list of texts.

    Raises:
        InputError: There is no such group, or the file cannot be read.
    """
    columns: dict[str, Array] = {}
    texts: dict[str, list[str]] = {}
    with _open_file(path) as file:
        parent_group = file.get(group)
        if parent_group is None or not hasattr(parent_group, "items"):
            known = ", ".join(_list_group_names(file)) or "none"
            raise InputError(f"{path}: unknown group '{group}'; there are: {known}")
        # All members of the group and of the groups in it, by their paths.
        datasets: dict[str, Any] = {}
        parent_group.visititems(lambda name, dataset: datasets.update({name: dataset}))
        for name, dataset in datasets.items():
            # A name that is not UTF-8 comes as bytes.
            if not hasattr(dataset, "dtype") or not isinstance(name, str):
                continue
            is_numeric = dataset.dtype.kind in "fiub"  # floats, integers and booleans
            is_wide = dataset.ndim > 1 and dataset.shape[1] > MAX_COLUMNS
            if not is_numeric or dataset.ndim not in (1, 2) or is_wide:
                texts[name] = _read_texts(dataset)
            elif dataset.size > MAX_DATASET_ENTRIES:
                raise InputError(f"{path}: {name} has {dataset.size} entries; at most 250 million")
            else:
                columns[name] = make_read_only(np.asarray(dataset[()], dtype=np.float64))
    return columns, texts


@contextmanager
def _open_file(path: Path) -> Iterator[Any]:
    """Open an HDF5 file, and convert the errors of its reader to one line.

    Args:
        path: HDF5 file.

    Raises:
        InputError: The optional package h5py is not installed, or the file cannot be read.
    """
    try:
        import h5py
    except ImportError:
        raise InputError(
            f"{path}: needs h5py to read it, not installed (pip install h5py)"
        ) from None
    with convert_read_errors(path, "an HDF5 file"), h5py.File(path, "r") as file:
        yield file


def _list_members(group: Any) -> list[tuple[str, Any]]:
    """Return the members of a group; empty if it is not a group."""
    members = group.items() if hasattr(group, "items") else []
    # h5py returns a name that is not UTF-8 as bytes.
    return [(name, member) for name, member in members if isinstance(name, str)]


def _list_group_names(file: Any) -> list[str]:
    """List the names of the first groups of a file."""
    group_names: list[str] = []
    file.visititems(lambda name, item: group_names.append(name) if hasattr(item, "items") else None)
    return group_names[:12]


def _read_texts(dataset: Any) -> list[str]:
    """Return the texts of a dataset that is a list of texts; empty for another dataset."""
    if dataset.ndim != 1 or dataset.dtype.kind not in "OSU" or dataset.size > MAX_COLUMNS:
        return []
    return [
        text.decode("utf-8", errors="replace") if isinstance(text, bytes) else str(text)
        for text in dataset[()].tolist()
    ]


def _make_natural_sort_key(name: str) -> tuple[str, int]:
    """Return a sort key by the number at the end of a name: ``demo_2`` before ``demo_10``."""
    digits = re.search(r"\d+$", name)
    return (name[: digits.start()], int(digits[0])) if digits else (name, 0)
