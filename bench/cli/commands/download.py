"""The command `simgap download`: data sets that experiments need."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from bench.cli.output import CommandResult, JsonDocument, PrintLine
from bench.cli.shared_options import parse_path

if TYPE_CHECKING:
    from bench.datasets.public_datasets import DataSet

_ALL = "all"


def add_download(parser: argparse.ArgumentParser) -> None:
    """Add the options of `simgap download`."""
    parser.add_argument(
        "names",
        metavar="NAME",
        nargs="*",
        default=[],
        help="data sets to download, or `all`; without a name the data sets are listed",
    )
    parser.add_argument(
        "--from",
        dest="source",
        metavar="FOLDER_OR_URL",
        default="",
        help="take the files from this folder (a clone at the data set's commit, or the files "
        "alone) or below this address, in place of GitHub",
    )
    parser.add_argument(
        "--out",
        type=parse_path,
        metavar="DIR",
        help="write the data set's folder into this one (default: SIMGAP_DATA or SIMGAP_ROBOTS "
        "where set, else simgap/ in XDG_DATA_HOME or ~/.local/share)",
    )
    parser.set_defaults(command=_run_download)


def _run_download(options: argparse.Namespace, print_line: PrintLine) -> CommandResult:
    """Execute `simgap download`: download the named data sets that are not on this machine yet.

    Without a name it lists all data sets and downloads nothing.

    Args:
        options: parsed arguments of the command.
        print_line: prints one line of text.

    Returns:
        The JSON document of the command, and its exit code (0).
    """
    from bench.benchmark.problem.missing_requirements import list_dependent_experiments
    from bench.datasets import public_datasets

    names_to_download = (
        public_datasets.names() if _ALL in options.names else list(dict.fromkeys(options.names))
    )
    data_sets = [public_datasets.get(name) for name in names_to_download]
    if not data_sets:
        catalogue = [public_datasets.get(name) for name in public_datasets.names()]
        for data_set in catalogue:
            for line in _format_data_set(data_set):
                print_line(line)
        return CommandResult(
            {"data_sets": [_make_data_set_document(each) for each in catalogue], "downloaded": []}
        )
    downloaded = []
    for data_set in data_sets:
        present_folder = public_datasets.find_present_folder(data_set, options.out)
        if present_folder:
            print_line(f"{data_set.name}: already in {present_folder}")
            continue
        print_line(f"{data_set.name}: {_download_data_set(data_set, options.source, options.out)}")
        downloaded.append(data_set.name)
        if options.out:
            print_line(_explain_folder_lookup(data_set, options.out))
        for name in list_dependent_experiments(data_set):
            print_line(f"needed by: simgap compare {name}")
    documents = [_make_data_set_document(each, options.out) for each in data_sets]
    return CommandResult({"data_sets": documents, "downloaded": downloaded})


def _download_data_set(data_set: DataSet, source: str, target_folder: Path | None) -> Path:
    """Download one data set with a progress bar; return its folder.

    Args:
        data_set: data set of the catalogue: its files, source and licence.
        source: address of its files.
        target_folder: folder below which it is stored; None for the usual one.
    """
    import sys

    from tqdm import tqdm

    from bench.datasets.public_datasets import download, list_search_folders

    with tqdm(
        total=data_set.bytes,
        desc=data_set.name,
        unit="B",
        unit_scale=True,
        file=sys.stderr,
        disable=not sys.stderr.isatty(),
        leave=False,
    ) as bar:

        def advance(count: int) -> None:
            bar.update(count)

        return download(
            data_set, target_folder or next(list_search_folders(data_set.kind)), source, advance
        )


def _explain_folder_lookup(data_set: DataSet, target_folder: Path) -> str:
    """Explain how experiments find a data set in a folder other than the default one.

    Args:
        data_set: data set of the catalogue: its files, source and licence.
        target_folder: folder below which it is stored.
    """
    from bench.datasets.public_datasets import FOLDER_VARIABLES, list_search_folders

    if target_folder.resolve() in [
        folder.resolve() for folder in list_search_folders(data_set.kind)
    ]:
        return f"{data_set.name}: experiments find it there"
    variable = FOLDER_VARIABLES[data_set.kind]
    return (
        f"{data_set.name}: experiments find it with {variable}={os.fspath(target_folder.resolve())}"
    )


def _format_data_set(data_set: DataSet) -> list[str]:
    """Format a data set for the list: size, licence, place, title, experiments and source."""
    from bench.benchmark.problem.missing_requirements import list_dependent_experiments

    folder = data_set.folder()
    state = f"in {folder}" if folder else f"not here: run `{data_set.command}`"
    experiment_names = ", ".join(list_dependent_experiments(data_set))
    return [
        f"{data_set.name:22} {data_set.size:>7}  {data_set.licence:11} {state}",
        f"  {data_set.title}",
        f"  needed by {experiment_names}",
        f"  {data_set.repository} at {data_set.commit[:7]}; {data_set.cite}",
    ]


def _make_data_set_document(data_set: DataSet, target_folder: Path | None = None) -> JsonDocument:
    """Convert a data set to a JSON document, with the address and hash of each file.

    `target_folder` is the folder that the user named for downloads; None for the default folder.
    """
    from bench.benchmark.problem.missing_requirements import list_dependent_experiments
    from bench.datasets.public_datasets import find_present_folder

    return {
        "name": data_set.name,
        "title": data_set.title,
        "kind": data_set.kind,
        "licence": data_set.licence,
        "cite": data_set.cite,
        "repository": data_set.repository,
        "commit": data_set.commit,
        "bytes": data_set.bytes,
        "files": [
            {
                "path": file.path,
                "url": f"{data_set.base_url}/{file.path}",
                "bytes": file.bytes,
                "sha256": file.sha256,
            }
            for file in data_set.files
        ],
        "provides": list(data_set.provides),
        "folder": find_present_folder(data_set, target_folder),
        "experiments": list_dependent_experiments(data_set),
    }
