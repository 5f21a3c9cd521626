"""What a study's folder holds once it has been reported, as a document."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from bench.commands.answer import Document

if TYPE_CHECKING:
    from bench.study import Study

_DRAWN = "figures"
"""The folder of figures."""


def outcome(study: Study) -> Document:
    """Name, folder, files, how its targets and tuners were kept apart, and what came out."""
    experiment = study.configuration.experiment
    return {
        "name": experiment.name,
        "folder": study.folder,
        "trusted": experiment.trusted,
        "salt": "secret" if experiment.salt_sha256 else "public",
        "files": files(study.folder),
        "results": results(study.folder / "table.csv"),
    }


def files(folder: Path) -> list[Path]:
    """The files of a folder of results, and its figures; not what is kept of single runs or
    shots.
    """
    inside = [*folder.glob("*"), *(folder / _DRAWN).glob("*")]
    return sorted(path for path in inside if path.is_file() and not path.name.startswith("."))


def results(table: Path) -> list[Document]:
    """The last line of each tuner, range and metric in a table, with its columns; all of a bounce
    shot's and of diagnosers'; none where there is no table.
    """
    if not table.is_file():
        return []
    import pandas as pd

    lines = pd.read_csv(table, keep_default_na=False, na_values=[""]).astype(object)
    if "simulations" in lines and "metric" in lines:
        lines = lines.groupby(["tuner", "range", "metric"], sort=False, dropna=False).tail(1)
    rows = lines.where(lines.notna(), None).to_dict("records")
    return [{str(name): value for name, value in row.items()} for row in rows]
