"""Reference results: checked comparisons that figures draw in grey behind the user's own.

In a checkout they are below results/reference, in an installed wheel below bench/reference; the
wheel contains the table, configuration and environment of each. Any other folder with these three
files can be used, too.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.benchmark.storage.csv_reader import CsvTable
from bench.benchmark.storage.result_folder import CONFIGURATION_FILE
from bench.benchmark.storage.table_schemas import ERROR_TABLE_COLUMNS
from sims.core.files import get_first_line
from sims.core.simulator import InputError, make_unknown_name_error
from sims.core.toml_validation import read_toml

if TYPE_CHECKING:
    import pandas as pd

    from bench.benchmark.problem.experiment_config import Experiment

_PACKAGE_FOLDER = Path(__file__).resolve().parents[2]
REFERENCE_FOLDERS = (
    _PACKAGE_FOLDER.parent / "results" / "reference",
    _PACKAGE_FOLDER / "reference",
)
"""Folders of references: in the root of a checkout, or in the package of a wheel."""
_TABLE = "table.csv"
_USED_COLUMNS = ("tuner", "range", "simulations", "metric", "median")
_READ_COLUMNS = [column for column in ERROR_TABLE_COLUMNS if column.name in _USED_COLUMNS]
"""Columns of a table that are read; an older table may lack others."""
_PROBLEM_KEYS = ("simulator", "model", "recording", "observe", "error_channel")
"""Keys that must be equal for the errors of two comparisons to be comparable."""
_COMPARED_KEYS = (
    "ranges",
    "targets",
    "seeds",
    "budget",
    "training_budget",
    "noise",
    "settings",
    "world",
    "constants",
    "parameters",
    "initial",
    "inputs",
    "sampling",
    "held_out",
    "free",
)
"""Keys whose differences are reported."""


@dataclass(frozen=True)
class ReferenceResult:
    """A reference result.

    Attributes:
        name: Name by which it was requested.
        folder: Its folder.
        table: Rows of its table.csv: tuner, range, simulations, metric, median.
        document: Content of its experiment.toml.
        simgap: Version that made it.
        revision: Hash of the code that made its runs; empty if unknown.
        started: Time of its start, UTC.
    """

    name: str
    folder: Path
    table: pd.DataFrame
    document: Mapping[str, Any]
    simgap: str
    revision: str
    started: str

    @property
    def tuners(self) -> list[str]:
        """Labels in the order of its table."""
        return [str(tuner) for tuner in dict.fromkeys(self.table["tuner"])]

    @property
    def provenance_text(self) -> str:
        """Provenance as text: ``ball-drop (simgap 0.1.0, code 9276d6d2c3, 2026-11-21)``."""
        code = f", code {self.revision}" if self.revision else ""
        return f"{self.name} (simgap {self.simgap}{code}, {self.started[:10]})"

    def find_mismatches(self, experiment: Experiment) -> list[str]:
        """List the differences from an experiment that is drawn over it, one line each.

        The reference is drawn in grey behind the results of the experiment. Keys that define the
        problem, such as the simulator, must be equal; differences of other settings, such as the
        budget, are allowed and listed.

        Args:
            experiment: Experiment that is drawn over the reference.

        Raises:
            InputError: It is of another problem, so the errors are not comparable.
        """
        drawn_document = _normalise_value(experiment.document())
        # Keys that were added in a later version cannot be compared with an older file.
        differing = [
            key
            for key in (*_PROBLEM_KEYS, *_COMPARED_KEYS)
            if key in self.document
            and _normalise_value(self.document[key]) != drawn_document.get(key)
        ]
        for key in differing:
            if key in _PROBLEM_KEYS:
                raise InputError(
                    f"{self.name}: of another problem than experiment {experiment.name}: {key} is "
                    f"{_format_setting(self.document[key])}, "
                    f"expected {_format_setting(drawn_document.get(key))}"
                )
        return [
            f"{key}: {_format_setting(self.document[key])}, here "
            f"{_format_setting(drawn_document.get(key))}"
            for key in differing
        ]

    def get_curve(self, tuner: str, kind: str, metric: str, budget: int) -> pd.DataFrame:
        """Return the median of a metric by number of simulations, up to a budget.

        Args:
            tuner: Label of the tuner.
            kind: Range of the targets.
            metric: Name of the metric.
            budget: Maximum number of simulations.

        Returns:
            Columns simulations and median; empty if there is no such curve.
        """
        lines = self.table
        part = lines[
            (lines["tuner"] == tuner)
            & (lines["range"] == kind)
            & (lines["metric"] == metric)
            & (lines["simulations"] <= budget)
        ]
        return part[["simulations", "median"]].dropna().sort_values("simulations")

    def to_document(self, experiment: Experiment, figure_files: list[Path]) -> dict[str, Any]:
        """Build the JSON document of the reference.

        Args:
            experiment: Experiment that is drawn over it.
            figure_files: Paths of the figures.
        """
        return {
            "name": self.name,
            "simgap": self.simgap,
            "revision": self.revision or None,
            "started": self.started,
            "mismatches": self.find_mismatches(experiment),
            "drawn": figure_files,
        }


def list_reference_names() -> list[str]:
    """List the names of the references of simgap, which are the names of their folders."""
    names = [
        table.parent.relative_to(folder).as_posix()
        for folder in REFERENCE_FOLDERS
        for table in sorted(folder.rglob(_TABLE))
        if _is_reference_folder(table.parent)
    ]
    return sorted(set(names))


def _is_reference_folder(folder: Path) -> bool:
    """Return whether a folder is a comparison's; a bounce shot has no error curves."""
    if not (folder / CONFIGURATION_FILE).is_file():
        return False
    with (folder / _TABLE).open(encoding="utf-8") as file:
        return "metric" in file.readline().split(",")


def find_reference(name: str) -> ReferenceResult:
    """Find a reference by its name, or by the folder of any comparison.

    A name is tried in this order: the whole name of a reference; its end, as ``ball-wind`` for
    ``comparison/ball-wind``, if only one reference ends so; a folder of the user.

    Raises:
        InputError: There is no such reference, or it is damaged.
    """
    names = list_reference_names()
    endings = [known_name for known_name in names if known_name.endswith(f"/{name}")]
    if name in names:
        return _read_reference(name, _find_reference_folder(name))
    if len(endings) == 1:
        return _read_reference(endings[0], _find_reference_folder(endings[0]))
    folder = Path(name)
    if (folder / CONFIGURATION_FILE).is_file():
        return _read_reference(folder.resolve().name, folder)
    if len(endings) > 1:
        raise InputError(f"reference {name}: expected one of {', '.join(endings)}")
    error = make_unknown_name_error("reference", name, names)
    raise InputError(f"{error} (or give the folder of a comparison)")


def _find_reference_folder(name: str) -> Path:
    folders = [parent / name for parent in REFERENCE_FOLDERS]
    return next(folder for folder in folders if (folder / _TABLE).is_file())


def _read_reference(name: str, folder: Path) -> ReferenceResult:
    """Read the table, configuration and environment of a reference comparison from its folder.

    Args:
        name: name by which the reference was requested.
        folder: its folder.

    Raises:
        InputError: one of the three files is missing or damaged.
    """
    path = folder / "environment.json"
    try:
        environment = json.loads(path.read_text(encoding="utf-8"))
        origin = {key: str(environment[key]) for key in ("simgap", "started")}
        revision = str(environment.get("fingerprint", {}).get("code", ""))
    except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
        expected = "expected the results of a comparison"
        raise InputError(f"{path}: {expected}, found {get_first_line(error)}") from None
    table = CsvTable(
        folder / _TABLE, _READ_COLUMNS, f"write it again with simgap plot {folder}"
    ).table
    document = read_toml(folder / CONFIGURATION_FILE)
    return ReferenceResult(name, folder, table.to_pandas(), document, **origin, revision=revision)


def _normalise_value(value: Any) -> Any:
    """Convert numbers to float and tuples to lists, so that TOML and experiments compare equal."""
    if isinstance(value, Mapping):
        return {str(key): _normalise_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_normalise_value(item) for item in value]
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _format_setting(value: Any) -> str:
    """Format a value of a configuration in one line, lists and tables cut off at 80 characters."""
    if isinstance(value, Mapping):
        entries = ", ".join(f"{key} = {_format_setting(item)}" for key, item in value.items())
        return f"{{{entries}}}"[:80]
    if isinstance(value, list | tuple):
        return f"[{', '.join(_format_setting(item) for item in value)}]"[:80]
    return f"{value:g}" if isinstance(value, float) else str(value)
