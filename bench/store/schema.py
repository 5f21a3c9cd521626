"""What stands in the files of a result folder: every column and key, declared once.

`bench.store.cells` checks the cells of a column, `bench.store.rows` the rows of a run, and
`bench.store.sound` what must hold between files. A column that is added later is `required=False`
and has a `default`, so that older folders still read.
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
"""Words by which a shot of a bounce shot ends."""
METRICS = (
    "param_abs_error",
    "param_error",
    "stiff_error",
    "sloppy_error",
    "obs_error",
    "heldout_error",
)
"""Errors that table.csv has lines of: columns of runs.parquet."""


class Empty(Enum):
    """Where the cells of a column are empty: text without a letter, a number that is none."""

    NEVER = "never"
    MAY = "anywhere"
    AT_START = "where k = 0, and nowhere else"
    NO_TRUTH = "on a recording, and nowhere else"


@dataclass(frozen=True)
class Column:
    """One column.

    Attributes:
        name: ``PARAMETER`` or ``CHANNEL`` in it stands for each that there is.
        kind: str, int, float or bool.
        low: the least number.
        high: the largest one.
        words: the only texts that there are; any where there are none.
        empty: where there is no value.
        infinite: whether a number may be infinite.
        required: whether a file without it is damaged.
        default: of a column that is not there.
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
        """What a cell must be, for a message."""
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
"""Of the whole numbers that a float can count."""


def _size(name: str, empty: Empty = Empty.NEVER, **options: Any) -> Column:
    """A number that is not negative."""
    return Column(name, float, low=0.0, empty=empty, **options)


def _count(name: str, low: int = 0, **options: Any) -> Column:
    """A whole number that is not negative."""
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
"""runs.parquet, parts and records: a row a simulation."""

OF_A_RUN = ("experiment", "tuner", "simulator", "target", "seed", "range", "outside", "trusted")
"""Columns of `RUNS` that are the same in every row of a run; every true parameter is too."""

STATUS: Columns = (
    *(Column(name, str) for name in ("run", "tuner", "simulator")),
    Column("target", str, empty=Empty.MAY),  # of a tuner that was skipped
    _count("seed"),
    Column("status", str, words=STATUSES),
    Column("reason", str, empty=Empty.MAY),
    _count("simulations"),
    _size("seconds"),
    _TRUSTED,
)
"""status.csv of a comparison, and the statuses of parts and records: a row a run."""

TRAINING: Columns = (
    Column("tuner", str),
    _count("seed"),
    _count("simulations"),
    _size("seconds"),
    _TRUSTED,
)
"""training.csv: a row a training."""

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
"""identifiability.csv: a row a target and direction."""

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
"""table.csv of a comparison."""

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
"""table.csv of a study of a missing effect; an error of no one parameter has no name of one."""

_RANKED = Column("metric", str, words=("param_error", "heldout_error"))
MISSPECIFIED_RANKS: Columns = (
    Column("experiment", str),
    _RANKED,
    Column("tuner", str),
    *(_size(name) for name in ("plain", "extended")),
    _TRUSTED,
)
"""ranks.csv of a study of a missing effect: mean rank over targets in each simulator."""

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
"""ranking.csv of a study of a missing effect: whether the simulators rank tuners alike."""

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
"""A model in shots/NAME.json, beside its ``effects``."""

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
"""shots.csv of a bounce shot; without the last the rows in shots/NAME.json."""

SHOT_STATUS: Columns = tuple(
    replace(column, words=SHOT_STATUSES)
    if column.name == "status"
    else replace(column, empty=Empty.MAY)
    if column.name == "seconds"
    else column
    for column in STATUS
)
"""status.csv of a bounce shot."""

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
"""table.csv of a bounce shot."""

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
"""environment.json: by key what its value is; a file may have others beside them."""
OLDER = ("fingerprint", "seals", "stepping", "redrawn_targets", "target_draws")
"""Keys that folders of an older simgap lack; the last two are of comparisons of tuners alone."""


def spelled(columns: Columns, parameters: Iterable[str], channels: Iterable[str]) -> list[Column]:
    """The columns with a column for each parameter and channel that there is."""
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
    """The parameters that a file's columns speak of."""
    return _spoken_of(names, "proposal_", "recommendation_", "true_")


def channels_in(names: Iterable[str]) -> list[str]:
    """The channels that a file's columns speak of."""
    found = _spoken_of(names, "obs_error_", "heldout_error_")
    return list(dict.fromkeys(name.removesuffix("_in_noise") for name in found))


def _spoken_of(names: Iterable[str], *prefixes: str) -> list[str]:
    rests = [name[len(p) :] for name in names for p in prefixes if name.startswith(p)]
    return list(dict.fromkeys(rests))
