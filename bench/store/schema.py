"""Declaration of every column and key in the files of a result folder.

`bench.store.cells` checks the cells of a column, `bench.store.rows` the rows of a run, and
`bench.store.sound` the consistency between files. A column that is added later is `required=False`
and has a `default`, so that older folders can still be read.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

from bench.problem.experiment import RANGES
from bench.store.status import STATUSES

SHOT_STATUSES = (*STATUSES, "no plan", "no recording")
"""Possible statuses of a bounce shot."""
METRICS = (
    "param_abs_error",
    "param_error",
    "stiff_error",
    "sloppy_error",
    "obs_error",
    "heldout_error",
)
"""Error metrics in table.csv, which are columns of runs.parquet."""


class Empty(Enum):
    """Where cells of a column are empty, that is empty text or NaN."""

    NEVER = "never"
    MAY = "anywhere"
    AT_START = "where k = 0, and nowhere else"
    NO_TRUTH = "on a recording, and nowhere else"


@dataclass(frozen=True)
class Column:
    """Declaration of a column.

    Attributes:
        name: Name; ``PARAMETER`` or ``CHANNEL`` in it stands for each parameter or channel.
        kind: str, int, float or bool.
        low: Smallest allowed number.
        high: Largest allowed number.
        words: Allowed texts; empty for any text.
        empty: Where cells are empty.
        infinite: Whether a number may be infinite.
        required: Whether a file without the column is damaged.
        default: Value if the column is missing.
    """

    name: str
    kind: type
    low: float = -math.inf
    high: float = math.inf
    words: tuple[str, ...] = ()
    empty: Empty = Empty.NEVER
    infinite: bool = False
    required: bool = True
    default: Any = None

    @property
    def wanted(self) -> str:
        """Description of a valid cell, for messages."""
        if self.words:
            return f"one of {', '.join(word for word in self.words if word)}"
        if self.kind in (str, bool):
            return {str: "text", bool: "True or False"}[self.kind]
        ends = {
            (False, False): "",
            (True, False): f" of at least {self.low:g}",
            (True, True): f" from {self.low:g} to {self.high:g}",
        }[self.low > -math.inf, self.high < _LARGEST]
        number = "a whole number" if self.kind is int else "a number"
        return f"{number}{ends}"


Columns = Sequence[Column]
_LARGEST = 2.0**53
"""Upper limit of whole numbers that a float represents exactly."""


def _size(name: str, empty: Empty = Empty.NEVER, **options: Any) -> Column:
    """Declare a column of non-negative numbers."""
    return Column(name, float, low=0.0, empty=empty, **options)


def _count(name: str, low: int = 0, **options: Any) -> Column:
    """Declare a column of whole numbers that are not negative."""
    return Column(name, int, low=low, high=_LARGEST, **options)


_TRUSTED = Column("trusted", bool, required=False, default=False)
_RANGE = Column("range", str, words=RANGES)

RUNS: Columns = (
    *(Column(name, str) for name in ("run", "experiment", "tuner", "simulator", "target")),
    _count("seed"),
    _RANGE,
    _count("k"),
    _size("loss", Empty.AT_START, infinite=True),
    _size("param_error", Empty.NO_TRUTH),
    _size("param_abs_error", Empty.NO_TRUTH, required=False),
    _size("stiff_error", Empty.MAY, required=False),
    _size("sloppy_error", Empty.MAY, required=False),
    _size("outside", Empty.NO_TRUTH),
    Column("proposal_PARAMETER", float, empty=Empty.AT_START),
    Column("recommendation_PARAMETER", float),
    Column("true_PARAMETER", float, empty=Empty.NO_TRUTH),
    _size("obs_error", Empty.MAY, infinite=True),
    _size("heldout_error", Empty.MAY, infinite=True),
    _size("obs_error_CHANNEL_in_noise", Empty.MAY, infinite=True),
    _size("obs_error_CHANNEL", Empty.MAY, infinite=True),
    _size("heldout_error_CHANNEL", Empty.MAY, infinite=True),
    _size("tuner_seconds", Empty.AT_START),
    _size("simulator_seconds", Empty.AT_START),
    _TRUSTED,
)
"""Columns of runs.parquet, parts and records: one row per simulation."""

OF_A_RUN = ("experiment", "tuner", "simulator", "target", "seed", "range", "outside", "trusted")
"""Columns of `RUNS` that are constant within a run, as are all true parameters."""

STATUS: Columns = (
    *(Column(name, str) for name in ("run", "tuner", "simulator")),
    Column("target", str, empty=Empty.MAY),  # Of a tuner that was skipped.
    _count("seed"),
    Column("status", str, words=STATUSES),
    Column("reason", str, empty=Empty.MAY),
    _count("simulations"),
    _size("seconds"),
    _TRUSTED,
)
"""Columns of a comparison's status.csv and of stored statuses: one row per run."""

TRAINING: Columns = (
    Column("tuner", str),
    _count("seed"),
    _count("simulations"),
    _size("seconds"),
    _TRUSTED,
)
"""Columns of training.csv: one row per training."""

IDENTIFIABILITY: Columns = (
    Column("experiment", str),
    Column("target", str),
    _RANGE,
    _count("direction", low=1),
    _size("eigenvalue", infinite=True),
    _size("sigma", infinite=True),
    Column("stiff", bool),
    Column("PARAMETER", float, low=-1.0 - 1e-9, high=1.0 + 1e-9),
)
"""Columns of identifiability.csv: one row per target and direction."""

TABLE: Columns = (
    Column("experiment", str),
    Column("tuner", str),
    Column("range", str, words=(*RANGES, "")),
    _count("simulations"),
    Column("metric", str, words=(*METRICS, "")),
    *(_size(name, Empty.MAY, infinite=True) for name in ("median", "mean", "low", "high")),
    _count("runs"),
    _count("failures"),
    _size("fit_simulations"),
    _size("fit_seconds"),
    _size("tuner_seconds", Empty.MAY),
    _size("simulator_seconds", Empty.MAY),
    Column("salt", str, words=("secret", "public"), required=False),
    _TRUSTED,
)
"""Columns of a comparison's table.csv."""

_MODEL = Column("model", str, words=("plain", "extended"))
MISSPECIFIED_TABLE: Columns = (
    Column("experiment", str),
    _MODEL,
    Column("tuner", str),
    Column("metric", str, words=("bias", "absolute_error", "param_error", "heldout_error")),
    Column("parameter", str, empty=Empty.MAY),
    Column("unit", str),
    *(Column(name, float, empty=Empty.MAY) for name in ("mean", "low", "high")),
    _count("targets"),
    _count("runs"),
    _count("failures"),
    _TRUSTED,
)
"""Columns of table.csv of a study of a missing effect; errors over all parameters name none."""

_RANKED = Column("metric", str, words=("param_error", "heldout_error"))
MISSPECIFIED_RANKS: Columns = (
    Column("experiment", str),
    _RANKED,
    Column("tuner", str),
    *(_size(name) for name in ("plain", "extended")),
    _TRUSTED,
)
"""Columns of ranks.csv of a study of a missing effect: mean rank over targets by simulator."""

MISSPECIFIED_RANKING: Columns = (
    Column("experiment", str),
    _RANKED,
    _count("tuners"),
    _count("targets"),
    *(
        Column(name, float, empty=Empty.MAY, low=-1.0, high=1.0)
        for name in ("tau", "low", "high", "tau_of_halves")
    ),
    *(
        _size(name, Empty.MAY, high=1.0)
        for name in ("p_value", "friedman_plain", "friedman_extended")
    ),
    _TRUSTED,
)
"""Columns of ranking.csv of a study of a missing effect: agreement of tuner rankings."""

MODEL: Columns = (
    Column("method", str),
    _size("restitution", Empty.MAY),
    _count("simulations"),
    _size("seconds", Empty.MAY),
    Column("status", str, words=SHOT_STATUSES),
    Column("reason", str, empty=Empty.MAY),
    _size("height", Empty.MAY),
    Column("margin", float, empty=Empty.MAY),
)
"""Keys of a model in shots/NAME.json, in addition to its ``effects``."""

SHOTS: Columns = (
    *(Column(name, str) for name in ("shot", "ball", "method")),
    Column("hit", bool),
    *(
        Column(name, float, empty=Empty.MAY, infinite=True)
        for name in ("off", "margin", "planned_margin")
    ),
    _size("prediction_error", Empty.MAY),
    _size("drop_height", Empty.MAY),
    _size("restitution", Empty.MAY),
    _size("true_restitution"),
    Column("effects", str, empty=Empty.MAY),
    _count("simulations"),
    _size("seconds", Empty.MAY),
    Column("status", str, words=SHOT_STATUSES),
    Column("reason", str, empty=Empty.MAY),
    _size("seen", high=1.0),
    _TRUSTED,
)
"""Columns of a bounce shot's shots.csv; rows in shots/NAME.json lack the last column."""

SHOT_STATUS: Columns = tuple(
    replace(column, words=SHOT_STATUSES)
    if column.name == "status"
    else replace(column, empty=Empty.MAY)
    if column.name == "seconds"
    else column
    for column in STATUS
)
"""Columns of a bounce shot's status.csv."""

SHOT_TABLE: Columns = (
    Column("method", str),
    Column("ball", str),
    _count("shots", low=1),
    _count("hits"),
    *(_size(name, high=1.0) for name in ("rate", "low", "high")),
    *(_size(name, Empty.MAY, infinite=True) for name in ("off_median", "off_90")),
    *(_size(f"prediction_error_{name}", Empty.MAY) for name in ("median", "mean")),
    _size("simulations"),
    _size("seconds", Empty.MAY),
    _count("failures"),
    _TRUSTED,
)
"""Columns of a bounce shot's table.csv."""

ENVIRONMENT: Mapping[str, Any] = {
    "simgap": str,
    "experiment": str,
    "plugins": tuple[str, ...],
    "jobs": int,
    "seals": tuple[str, ...],
    "started": str,
    "python": str,
    "platform": str,
    "machine": str,
    "processors": int,
    "fingerprint": Mapping[str, str],
    "stepping": str,
    "packages": Mapping[str, str],
    "redrawn_targets": int,
    "target_draws": int,
}
"""Types of the values in environment.json, by key; a file may have further keys."""
OLDER = ("fingerprint", "seals", "stepping", "redrawn_targets", "target_draws")
"""Keys that folders of an older simgap may lack; the last two belong to tuner comparisons only."""


def spelled(columns: Columns, parameters: Iterable[str], channels: Iterable[str]) -> list[Column]:
    """Replace placeholder columns by one column for each parameter and channel.

    Args:
        columns: Declared columns.
        parameters: Names that replace ``PARAMETER``.
        channels: Names that replace ``CHANNEL``.
    """
    names = {"PARAMETER": list(parameters), "CHANNEL": list(channels)}
    result = []
    for column in columns:
        marks = [mark for mark in names if mark in column.name]
        if not marks:
            result.append(column)
        for mark in marks:
            result += [replace(column, name=column.name.replace(mark, n)) for n in names[mark]]
    return result


def parameters_in(names: Iterable[str]) -> list[str]:
    """List the parameters in the names of a file's columns."""
    return _spoken_of(names, "proposal_", "recommendation_", "true_")


def channels_in(names: Iterable[str]) -> list[str]:
    """List the channels in the names of a file's columns."""
    found = _spoken_of(names, "obs_error_", "heldout_error_")
    return list(dict.fromkeys(name.removesuffix("_in_noise") for name in found))


def _spoken_of(names: Iterable[str], *prefixes: str) -> list[str]:
    rests = [name[len(p) :] for name in names for p in prefixes if name.startswith(p)]
    return list(dict.fromkeys(rests))
