"""Reference results: comparisons that were run and looked at, which figures draw in grey behind a
user's own.

Those of a checkout are below results/reference, those of an installed wheel below bench/reference;
of each the wheel has the table, the configuration and the environment. Any folder with these three
serves too.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.store.csvs import Csv
from bench.store.folder import CONFIGURATION
from bench.store.schema import TABLE
from sims.base import InputError, unknown
from sims.files import first_line
from sims.user_toml import read_toml

if TYPE_CHECKING:
    import pandas as pd

    from bench.problem.experiment import Experiment

_PACKAGE = Path(__file__).resolve().parents[1]
_PLACES = (_PACKAGE.parent / "results" / "reference", _PACKAGE / "reference")
"""Where references are: beside a checkout's packages, or in the wheel's."""
_TABLE = "table.csv"
_DRAWN = ("tuner", "range", "simulations", "metric", "median")
_COLUMNS = [column for column in TABLE if column.name in _DRAWN]
"""Of a table; an older one may lack others."""
_SAME_PROBLEM = ("simulator", "model", "recording", "observe", "error_channel")
"""Keys without whose agreement two errors have nothing to do with each other."""
_ALIKE = (
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
"""Keys whose difference is said."""


@dataclass(frozen=True)
class Reference:
    """A reference result.

    Attributes:
        name: by which it was asked for.
        folder: where it lies.
        table: rows of its table.csv: tuner, range, simulations, metric, median.
        document: its experiment.toml.
        simgap: version that made it.
        revision: hash of the code that made its runs; empty where it is not known.
        started: time, UTC.
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
    def provenance(self) -> str:
        """``ball-drop (simgap 0.1.0, code 9276d6d2c3, 2026-11-21)``."""
        code = f", code {self.revision}" if self.revision else ""
        return f"{self.name} (simgap {self.simgap}{code}, {self.started[:10]})"

    def mismatches(self, experiment: Experiment) -> list[str]:
        """How it differs from an experiment that stands before it, a line each.

        Raises:
            InputError: it is of another problem, whose errors say nothing about these.
        """
        mine = _plain(experiment.document())
        # Keys that a later version has added say nothing about an older file.
        differing = [
            key
            for key in (*_SAME_PROBLEM, *_ALIKE)
            if key in self.document and _plain(self.document[key]) != mine.get(key)
        ]
        for key in differing:
            if key in _SAME_PROBLEM:
                raise InputError(
                    f"{self.name}: of another problem than experiment {experiment.name}: {key} is "
                    f"{_said(self.document[key])}, expected {_said(mine.get(key))}"
                )
        return [
            f"{key}: {_said(self.document[key])}, here {_said(mine.get(key))}" for key in differing
        ]

    def curve(self, tuner: str, kind: str, metric: str, budget: int) -> pd.DataFrame:
        """Simulations up to a budget, and the median after them; empty where there is none."""
        lines = self.table
        part = lines[
            (lines["tuner"] == tuner)
            & (lines["range"] == kind)
            & (lines["metric"] == metric)
            & (lines["simulations"] <= budget)
        ]
        return part[["simulations", "median"]].dropna().sort_values("simulations")

    def document_of(self, experiment: Experiment, drawn: list[Path]) -> dict[str, Any]:
        """For programs."""
        return {
            "name": self.name,
            "simgap": self.simgap,
            "revision": self.revision or None,
            "started": self.started,
            "mismatches": self.mismatches(experiment),
            "drawn": drawn,
        }


def names() -> list[str]:
    """The references that come with simgap, as their folders are called."""
    found = [
        table.parent.relative_to(place).as_posix()
        for place in _PLACES
        for table in sorted(place.rglob(_TABLE))
        if _is_one(table.parent)
    ]
    return sorted(set(found))


def _is_one(folder: Path) -> bool:
    """Whether it is a comparison's: a bounce shot has no curve of errors."""
    if not (folder / CONFIGURATION).is_file():
        return False
    with (folder / _TABLE).open(encoding="utf-8") as file:
        return "metric" in file.readline().split(",")


def find(name: str) -> Reference:
    """A reference by its name, or by the folder of any comparison.

    ``comparison/ball-wind`` is found as ``ball-wind`` too, where no other is called so.

    Raises:
        InputError: there is none, or what is there is damaged.
    """
    known = names()
    endings = [each for each in known if each.endswith(f"/{name}")]
    if name in known:
        return _read(name, _place(name))
    if len(endings) == 1:
        return _read(endings[0], _place(endings[0]))
    folder = Path(name)
    if (folder / CONFIGURATION).is_file():
        return _read(folder.resolve().name, folder)
    if len(endings) > 1:
        raise InputError(f"reference {name}: expected one of {', '.join(endings)}")
    error = unknown("reference", name, known)
    raise InputError(f"{error} (or give the folder of a comparison)")


def _place(name: str) -> Path:
    return next(place / name for place in _PLACES if (place / name / _TABLE).is_file())


def _read(name: str, folder: Path) -> Reference:
    path = folder / "environment.json"
    try:
        environment = json.loads(path.read_text(encoding="utf-8"))
        made = {key: str(environment[key]) for key in ("simgap", "started")}
        revision = str(environment.get("fingerprint", {}).get("code", ""))
    except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
        wanted = "expected what a comparison writes"
        raise InputError(f"{path}: {wanted}, found {first_line(error)}") from None
    table = Csv(folder / _TABLE, _COLUMNS, f"simgap plot {folder} writes it again").table
    document = read_toml(folder / CONFIGURATION)
    return Reference(name, folder, table.to_pandas(), document, **made, revision=revision)


def _plain(value: Any) -> Any:
    """Numbers and lists in one form, whether from TOML or from an experiment."""
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _said(value: Any) -> str:
    """A value in a line."""
    if isinstance(value, Mapping):
        inside = ", ".join(f"{key} = {_said(inner)}" for key, inner in value.items())
        return f"{{{inside}}}"[:80]
    if isinstance(value, list | tuple):
        return f"[{', '.join(_said(inner) for inner in value)}]"[:80]
    return f"{value:g}" if isinstance(value, float) else str(value)
