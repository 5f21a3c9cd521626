"""Declaration of every column and key in the files of a result folder.

`storage.cell_validation` checks the cells of a column, and `storage.result_file_consistency` the
rows of a run and the consistency between files. A column that is added later is `required=False`
and has a `default`, so that older folders can still be read.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

from bench.benchmark.problem.experiment_config import RANGES, Experiment
from bench.benchmark.storage.run_status import STATUSES

SHOT_STATUSES = (*STATUSES, "no plan", "no recording")
"""Possible statuses of a bounce shot."""
ERROR_METRICS = (
    "param_abs_error",
    "param_error",
    "stiff_error",
    "sloppy_error",
    "obs_error",
    "heldout_error",
)
"""Error metrics in table.csv, which are columns of runs.parquet."""
ERROR_FLOOR = 1e-9
"""Errors below this value count as equal to it; they are smaller than rounding in observations."""


class EmptyCellRule(Enum):
    """Where cells of a column are empty, that is empty text or NaN."""

    NEVER = "never"
    MAY = "anywhere"
    AT_START = "where k = 0, and nowhere else"
    RECORDING_ONLY = "on a recording, and nowhere else"


@dataclass(frozen=True)
class ColumnSpec:
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
    empty: EmptyCellRule = EmptyCellRule.NEVER
    infinite: bool = False
    required: bool = True
    default: Any = None

    @property
    def expected_text(self) -> str:
        """Description of a valid cell, for messages."""
        if self.words:
            return f"one of {', '.join(word for word in self.words if word)}"
        if self.kind is str:
            return "text"
        if self.kind is bool:
            return "True or False"
        number = "a whole number" if self.kind is int else "a number"
        if self.low == -math.inf:
            return number
        # This upper limit, or none, excludes no sensible number, so it is not mentioned.
        if self.high >= _MAX_EXACT_INTEGER:
            return f"{number} of at least {self.low:g}"
        return f"{number} from {self.low:g} to {self.high:g}"


Columns = Sequence[ColumnSpec]
_MAX_EXACT_INTEGER = 2.0**53
"""Upper limit of whole numbers that a float represents exactly."""


def _declare_size_column(
    name: str, empty: EmptyCellRule = EmptyCellRule.NEVER, **options: Any
) -> ColumnSpec:
    """Declare a column of non-negative numbers.

    Args:
        name: name of the column.
        empty: where its cells are empty.
        **options: further fields of `ColumnSpec`.
    """
    return ColumnSpec(name, float, low=0.0, empty=empty, **options)


def _declare_count_column(name: str, low: int = 0, **options: Any) -> ColumnSpec:
    """Declare a column of whole numbers.

    Args:
        name: name of the column.
        low: smallest allowed number.
        **options: further fields of `ColumnSpec`.
    """
    return ColumnSpec(name, int, low=low, high=_MAX_EXACT_INTEGER, **options)


_TRUSTED = ColumnSpec("trusted", bool, required=False, default=False)
_RANGE = ColumnSpec("range", str, words=RANGES)

RUN_COLUMNS: Columns = (
    *(ColumnSpec(name, str) for name in ("run", "experiment", "tuner", "simulator", "target")),
    _declare_count_column("seed"),
    _RANGE,
    _declare_count_column("k"),
    _declare_size_column("loss", EmptyCellRule.AT_START, infinite=True),
    _declare_size_column("param_error", EmptyCellRule.RECORDING_ONLY),
    _declare_size_column("param_abs_error", EmptyCellRule.RECORDING_ONLY, required=False),
    _declare_size_column("stiff_error", EmptyCellRule.MAY, required=False),
    _declare_size_column("sloppy_error", EmptyCellRule.MAY, required=False),
    _declare_size_column("outside", EmptyCellRule.RECORDING_ONLY),
    ColumnSpec("proposal_PARAMETER", float, empty=EmptyCellRule.AT_START),
    ColumnSpec("recommendation_PARAMETER", float),
    ColumnSpec("true_PARAMETER", float, empty=EmptyCellRule.RECORDING_ONLY),
    _declare_size_column("obs_error", EmptyCellRule.MAY, infinite=True),
    _declare_size_column("heldout_error", EmptyCellRule.MAY, infinite=True),
    _declare_size_column("obs_error_CHANNEL_in_noise", EmptyCellRule.MAY, infinite=True),
    _declare_size_column("obs_error_CHANNEL", EmptyCellRule.MAY, infinite=True),
    _declare_size_column("heldout_error_CHANNEL", EmptyCellRule.MAY, infinite=True),
    _declare_size_column("tuner_seconds", EmptyCellRule.AT_START),
    _declare_size_column("simulator_seconds", EmptyCellRule.AT_START),
    _TRUSTED,
)
"""Columns of runs.parquet, parts and records: one row per simulation."""

RUN_CONSTANT_COLUMNS = (
    "experiment",
    "tuner",
    "simulator",
    "target",
    "seed",
    "range",
    "outside",
    "trusted",
)
"""Columns of `RUN_COLUMNS` that are constant within a run, as are all true parameters."""

STATUS_COLUMNS: Columns = (
    *(ColumnSpec(name, str) for name in ("run", "tuner", "simulator")),
    ColumnSpec("target", str, empty=EmptyCellRule.MAY),  # Of a tuner that was skipped.
    _declare_count_column("seed"),
    ColumnSpec("status", str, words=STATUSES),
    ColumnSpec("reason", str, empty=EmptyCellRule.MAY),
    _declare_count_column("simulations"),
    _declare_size_column("seconds"),
    _TRUSTED,
)
"""Columns of a comparison's status.csv and of stored statuses: one row per run."""

TRAINING_COLUMNS: Columns = (
    ColumnSpec("tuner", str),
    _declare_count_column("seed"),
    _declare_count_column("simulations"),
    _declare_size_column("seconds"),
    _TRUSTED,
)
"""Columns of training.csv: one row per training."""

IDENTIFIABILITY_COLUMNS: Columns = (
    ColumnSpec("experiment", str),
    ColumnSpec("target", str),
    _RANGE,
    _declare_count_column("direction", low=1),
    _declare_size_column("eigenvalue", infinite=True),
    _declare_size_column("sigma", infinite=True),
    ColumnSpec("stiff", bool),
    ColumnSpec("PARAMETER", float, low=-1.0 - 1e-9, high=1.0 + 1e-9),
)
"""Columns of identifiability.csv: one row per target and direction."""

ERROR_TABLE_COLUMNS: Columns = (
    ColumnSpec("experiment", str),
    ColumnSpec("tuner", str),
    ColumnSpec("range", str, words=(*RANGES, "")),
    _declare_count_column("simulations"),
    ColumnSpec("metric", str, words=(*ERROR_METRICS, "")),
    *(
        _declare_size_column(name, EmptyCellRule.MAY, infinite=True)
        for name in ("median", "mean", "low", "high")
    ),
    _declare_count_column("runs"),
    _declare_count_column("failures"),
    _declare_size_column("fit_simulations"),
    _declare_size_column("fit_seconds"),
    _declare_size_column("tuner_seconds", EmptyCellRule.MAY),
    _declare_size_column("simulator_seconds", EmptyCellRule.MAY),
    ColumnSpec("salt", str, words=("secret", "public"), required=False),
    _TRUSTED,
)
"""Columns of a comparison's table.csv."""

_MODEL = ColumnSpec("model", str, words=("plain", "extended"))
MISSPECIFICATION_TABLE_COLUMNS: Columns = (
    ColumnSpec("experiment", str),
    _MODEL,
    ColumnSpec("tuner", str),
    ColumnSpec("metric", str, words=("bias", "absolute_error", "param_error", "heldout_error")),
    ColumnSpec("parameter", str, empty=EmptyCellRule.MAY),
    ColumnSpec("unit", str),
    *(ColumnSpec(name, float, empty=EmptyCellRule.MAY) for name in ("mean", "low", "high")),
    _declare_count_column("targets"),
    _declare_count_column("runs"),
    _declare_count_column("failures"),
    _TRUSTED,
)
"""Columns of table.csv of a study of a missing effect; errors over all parameters name none."""

_RANKED = ColumnSpec("metric", str, words=("param_error", "heldout_error"))
MISSPECIFICATION_RANK_COLUMNS: Columns = (
    ColumnSpec("experiment", str),
    _RANKED,
    ColumnSpec("tuner", str),
    *(_declare_size_column(name) for name in ("plain", "extended")),
    _TRUSTED,
)
"""Columns of ranks.csv of a study of a missing effect: mean rank over targets by simulator."""

RANK_AGREEMENT_COLUMNS: Columns = (
    ColumnSpec("experiment", str),
    _RANKED,
    _declare_count_column("tuners"),
    _declare_count_column("targets"),
    *(
        ColumnSpec(name, float, empty=EmptyCellRule.MAY, low=-1.0, high=1.0)
        for name in ("tau", "low", "high", "tau_of_halves")
    ),
    *(
        _declare_size_column(name, EmptyCellRule.MAY, high=1.0)
        for name in ("p_value", "friedman_plain", "friedman_extended")
    ),
    _TRUSTED,
)
"""Columns of ranking.csv of a study of a missing effect: agreement of tuner rankings."""

SHOT_MODEL_COLUMNS: Columns = (
    ColumnSpec("method", str),
    _declare_size_column("restitution", EmptyCellRule.MAY),
    _declare_count_column("simulations"),
    _declare_size_column("seconds", EmptyCellRule.MAY),
    ColumnSpec("status", str, words=SHOT_STATUSES),
    ColumnSpec("reason", str, empty=EmptyCellRule.MAY),
    _declare_size_column("height", EmptyCellRule.MAY),
    ColumnSpec("margin", float, empty=EmptyCellRule.MAY),
)
"""Keys of a model in shots/NAME.json, in addition to its ``effects``."""

SHOT_COLUMNS: Columns = (
    *(ColumnSpec(name, str) for name in ("shot", "ball", "method")),
    ColumnSpec("hit", bool),
    *(
        ColumnSpec(name, float, empty=EmptyCellRule.MAY, infinite=True)
        for name in ("off", "margin", "planned_margin")
    ),
    _declare_size_column("prediction_error", EmptyCellRule.MAY),
    _declare_size_column("drop_height", EmptyCellRule.MAY),
    _declare_size_column("restitution", EmptyCellRule.MAY),
    _declare_size_column("true_restitution"),
    ColumnSpec("effects", str, empty=EmptyCellRule.MAY),
    _declare_count_column("simulations"),
    _declare_size_column("seconds", EmptyCellRule.MAY),
    ColumnSpec("status", str, words=SHOT_STATUSES),
    ColumnSpec("reason", str, empty=EmptyCellRule.MAY),
    _declare_size_column("seen", high=1.0),
    _TRUSTED,
)
"""Columns of a bounce shot's shots.csv; rows in shots/NAME.json lack the last column."""

SHOT_STATUS_COLUMNS: Columns = tuple(
    replace(column, words=SHOT_STATUSES)
    if column.name == "status"
    else replace(column, empty=EmptyCellRule.MAY)
    if column.name == "seconds"
    else column
    for column in STATUS_COLUMNS
)
"""Columns of a bounce shot's status.csv."""

SHOT_TABLE_COLUMNS: Columns = (
    ColumnSpec("method", str),
    ColumnSpec("ball", str),
    _declare_count_column("shots", low=1),
    _declare_count_column("hits"),
    *(_declare_size_column(name, high=1.0) for name in ("rate", "low", "high")),
    *(
        _declare_size_column(name, EmptyCellRule.MAY, infinite=True)
        for name in ("off_median", "off_90")
    ),
    *(
        _declare_size_column(f"prediction_error_{name}", EmptyCellRule.MAY)
        for name in ("median", "mean")
    ),
    _declare_size_column("simulations"),
    _declare_size_column("seconds", EmptyCellRule.MAY),
    _declare_count_column("failures"),
    _TRUSTED,
)
"""Columns of a bounce shot's table.csv."""

ENVIRONMENT_KEYS: Mapping[str, Any] = {
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
OPTIONAL_ENVIRONMENT_KEYS = ("fingerprint", "seals", "stepping", "redrawn_targets", "target_draws")
"""Keys that folders of an older simgap may lack; the last two belong to tuner comparisons only."""


def expand_columns(
    columns: Columns, parameters: Iterable[str], channels: Iterable[str]
) -> list[ColumnSpec]:
    """Replace each column with a placeholder by one column for each parameter or channel.

    ``true_PARAMETER`` becomes ``true_damping`` and so on. Other columns are kept.

    Args:
        columns: Declared columns.
        parameters: Names that replace ``PARAMETER``.
        channels: Names that replace ``CHANNEL``.
    """
    names = {"PARAMETER": list(parameters), "CHANNEL": list(channels)}
    expanded_columns = []
    for column in columns:
        placeholders = [placeholder for placeholder in names if placeholder in column.name]
        if not placeholders:
            expanded_columns.append(column)
        for placeholder in placeholders:
            expanded_columns += [
                replace(column, name=column.name.replace(placeholder, n))
                for n in names[placeholder]
            ]
    return expanded_columns


def declare_run_columns(names: list[str], experiment: Experiment) -> list[ColumnSpec]:
    """Return the columns that the runs of an experiment must have, with their types and limits.

    Some columns exist once for each parameter or channel. The parameters are those in the names of
    the file's columns and those that the experiment changes; the channels are those that the
    experiment observes, or else those in the names. If there are none, these columns keep the
    placeholder PARAMETER or CHANNEL in their names.

    Args:
        names: Names of the file's columns.
        experiment: Content of the experiment's TOML file: simulator, tuners, targets and budget.
    """
    parameters = dict.fromkeys([*list_parameters(names), *experiment.parameters])
    channels = experiment.observe or list_channels(names)
    columns = expand_columns(RUN_COLUMNS, parameters or ["PARAMETER"], channels or ["CHANNEL"])
    # A single parameter also has its error in its own unit.
    return [c for c in columns if c.name != "param_abs_error" or len(parameters) == 1]


def list_parameters(names: Iterable[str]) -> list[str]:
    """List the parameters in the names of a file's columns."""
    return _list_name_parts(names, "proposal_", "recommendation_", "true_")


def list_channels(names: Iterable[str]) -> list[str]:
    """List the channels in the names of a file's columns."""
    suffixes = _list_name_parts(names, "obs_error_", "heldout_error_")
    return list(dict.fromkeys(name.removesuffix("_in_noise") for name in suffixes))


def _list_name_parts(names: Iterable[str], *prefixes: str) -> list[str]:
    name_parts = [name[len(p) :] for name in names for p in prefixes if name.startswith(p)]
    return list(dict.fromkeys(name_parts))
