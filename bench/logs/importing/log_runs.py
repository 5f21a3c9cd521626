"""Assign the logs that a user names to runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from sims.core.simulator import InputError
from sims.recording.log_formats.hdf5_and_parquet import is_hdf5, list_run_paths
from sims.recording.log_formats.lerobot_dataset import is_dataset
from sims.recording.log_formats.log_files import LOG_SUFFIXES, list_logs, read_log
from sims.recording.log_formats.ros_bags import BAG_SUFFIXES, is_bag

TABLE_ENDINGS = tuple(ending for ending in LOG_SUFFIXES if ending not in (".txt", ".dat"))
"""File extensions of logs that are read from a folder; other text files may contain anything."""


class RunFiles(NamedTuple):
    """The logs of one run.

    Attributes:
        folder: Folder or bag that contains the logs.
        paths: Paths of the logs.
        alone: Whether the run is one file of a folder whose other files are runs as well.
        chosen: Whether the user named the files; then each of them must be readable.
    """

    folder: Path
    paths: list[Path]
    alone: bool = False
    chosen: bool = False

    def name(self, path: Path) -> str:
        """Return the name of a log in a description."""
        return path.relative_to(self.folder).as_posix()


def group_logs_by_run(logs: Sequence[Path]) -> dict[str, RunFiles]:
    """Group logs by run: those of each folder, bag or episode, or the files themselves.

    The files of one folder are one run, unless all of them have the same columns: then each file is
    a run.

    Raises:
        InputError: There is no log.
    """
    files = [path for path in logs if not path.is_dir() and not is_bag(path)]
    runs: dict[str, RunFiles] = {}
    for folder in (path for path in logs if path not in files):
        is_whole = is_bag(folder) or is_dataset(folder)
        parts = [folder] if is_whole else [folder, *sorted(folder.iterdir())]
        datasets = [part for part in parts if is_dataset(part)]
        for part in parts:
            if part in datasets:
                prefix = f"{part.name}_" if len(datasets) > 1 else ""
                runs |= {
                    f"{prefix}{path.parent.name}": RunFiles(path.parent, [path])
                    for path in list_logs(part)
                }
                continue
            if is_bag(part):
                paths = list(list_logs(part))
            elif part.is_dir():
                paths = [path for path in list_logs(part) if path.suffix.lower() in TABLE_ENDINGS]
            else:
                continue
            if paths:
                runs[part.stem if part.is_file() else part.name] = RunFiles(part, paths)
    if files and runs:
        raise InputError("expected files of one run, or folders of one run each, found both")
    if files:
        folders = {path.parent for path in files}
        if len(folders) > 1:
            raise InputError("expected the files of one run in one folder; name the folders")
        runs = {"": RunFiles(folders.pop(), files, chosen=True)}
    if not runs:
        log_names = ", ".join(map(str, logs))
        kinds = ", ".join((*TABLE_ENDINGS, *BAG_SUFFIXES))
        raise InputError(f"{log_names}: expected logs ({kinds}), found none")
    if len(runs) == 1:
        ((name, run),) = runs.items()
        return _make_run_per_group(run) or _make_run_per_file(run) or {name: run}
    return runs


def _make_run_per_group(run: RunFiles) -> dict[str, RunFiles]:
    """Return a run for each group of an HDF5 file with several runs; otherwise an empty dict."""
    if len(run.paths) != 1 or not is_hdf5(run.paths[0]):
        return {}
    groups = list_run_paths(run.paths[0])
    if groups == run.paths:
        return {}
    return {group.name: RunFiles(run.folder, [group], True, run.chosen) for group in groups}


def _make_run_per_file(run: RunFiles) -> dict[str, RunFiles]:
    """Return a run for each file if all files have the same columns; otherwise an empty dict."""
    tables = [path for path in run.paths if path.suffix.lower() in TABLE_ENDINGS and path.is_file()]
    stems = [path.stem for path in tables]
    if len(tables) < 2 or len(tables) < len(run.paths) or len(set(stems)) < len(stems):
        return {}
    columns = []
    for path in tables:
        try:
            columns.append(tuple(read_log(path).list_columns()))
        except InputError:  # Reported when the run is read.
            return {}
    if len(set(columns)) > 1:
        return {}
    return {path.stem: RunFiles(run.folder, [path], True, run.chosen) for path in tables}
