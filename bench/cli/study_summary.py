"""Summary of a study's folder for the JSON documents of commands: its files and results."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from bench.cli.output import JsonDocument

if TYPE_CHECKING:
    from bench.benchmark.runner.study_base import Study

_FIGURES_FOLDER = "figures"
"""Name of the folder of figures."""


def summarise_study(study: Study) -> JsonDocument:
    """Summarise a study: name, folder, files, isolation, kind of salt, and results."""
    experiment = study.configuration.experiment
    return {
        "name": experiment.name,
        "folder": study.folder,
        "trusted": experiment.trusted,
        "salt": "secret" if experiment.salt_sha256 else "public",
        "files": list_result_files(study.folder),
        "results": summarise_results(study.folder / "table.csv"),
    }


def list_result_files(folder: Path) -> list[Path]:
    """List the files of a result folder and its figures, without the data of single runs."""
    paths = [*folder.glob("*"), *(folder / _FIGURES_FOLDER).glob("*")]
    return sorted(path for path in paths if path.is_file() and not path.name.startswith("."))


def summarise_results(table: Path) -> list[JsonDocument]:
    """Read the last row of each tuner, range and metric from a table.

    All rows are read for bounce shots and diagnosers, and none if there is no table.
    """
    if not table.is_file():
        return []
    import pandas as pd

    # Only empty cells are missing values, and names such as "None" are not.
    lines = pd.read_csv(table, keep_default_na=False, na_values=[""]).astype(object)
    if "simulations" in lines and "metric" in lines:
        # Rows are ordered by the number of simulations.
        lines = lines.groupby(["tuner", "range", "metric"], sort=False, dropna=False).tail(1)
    rows = lines.where(lines.notna(), None).to_dict("records")
    return [{str(name): value for name, value in row.items()} for row in rows]
