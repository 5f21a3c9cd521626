"""Collect, store and merge the errors of all runs of a benchmark suite.

A cell is a problem and a range of targets, or a problem before or after its simulator's extension.
The stored form has one row per run, so that a method can be ranked against methods that were run
elsewhere on the same targets.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bench.benchmark.problem.experiment_config import Experiment
from bench.benchmark.statistics.comparison_statistics import (
    REQUIRED_RUN_COLUMNS,
    ComparisonStatistics,
)
from bench.benchmark.statistics.error_curves import replace_unknown_errors
from bench.benchmark.storage.reference_results import REFERENCE_FOLDERS
from bench.benchmark.storage.result_folder import CONFIGURATION_FILE, read_comparison
from bench.benchmark.storage.run_journal import SEGMENTS_FOLDER
from bench.misspecification.calibration_recording import MODEL_LABELS, PLAIN
from sims.core.files import atomic_replacement, write_atomically
from sims.core.simulator import Array, InputError

CURVES_FILE = "curves.parquet"
"""File of the errors of all runs."""
CELLS_FILE = "cells.csv"
"""File of the cells with the properties of their problems."""
TRAINING_FILE = "training.csv"
"""File of the cost of each training."""
SKIPPED_FILE = "skipped.csv"
"""File of the tuners that could not be used, with the reason."""
RUN_COLUMNS = ["cell", "tuner", "target", "seed", "simulations", "seconds", "failed"]
RUN_KEYS = ["cell", "tuner", "target", "seed"]
"""Columns that identify a run."""
CELL_COLUMNS = [
    "cell",
    "problem",
    "range",
    "parameters",
    "tags",
    "negligible_error",
    "metric",
    "title",
    "tests",
    "identifiable",
    "suite",
]
TRAINING_COLUMNS = ["cell", "tuner", "fit_simulations", "fit_seconds"]
SKIPPED_COLUMNS = ["tuner", "reason"]
_STORED_DIGITS, _FORMER_DIGITS = 3, 4
"""Significant digits of stored errors, and those of files that do not state them."""
_DIGITS_KEY = b"significant_digits"
"""Key of the number of digits in the metadata of the file."""
_SECONDS_DIGITS = 2
"""Decimals of stored seconds."""
_ERRORS_COLUMNS = ("lengths", "mantissas", "exponents")
"""Columns with the errors after 0, 1, ... simulations; see `_encode_errors`."""
_SPLIT_COLUMNS = ("lengths", "mantissas")
"""Columns of the errors whose numbers have more than one byte."""
_MIN_EXPONENT = -100
"""Smallest stored exponent."""
_MISSING, _FAILED = 126, 127
"""Exponents that stand for NaN and for infinity."""


@dataclass(frozen=True)
class SuiteRuns:
    """Runs of a suite.

    Attributes:
        runs: one row per run, columns `RUN_COLUMNS`.
        errors: (R, K + 1) error after k simulations; NaN where a run had a smaller budget, infinite
            for a failed run. In widths of the training range, or in the channel's unit for measured
            data.
        cells: one row per cell, columns `CELL_COLUMNS`.
        training: cost of a training by cell and tuner, columns `TRAINING_COLUMNS`.
        skipped: tuners that could not be used, columns `SKIPPED_COLUMNS`.
    """

    runs: pd.DataFrame
    errors: Array
    cells: pd.DataFrame
    training: pd.DataFrame
    skipped: pd.DataFrame

    @property
    def budget(self) -> int:
        """Largest number of simulations on one target."""
        return int(self.errors.shape[1]) - 1

    @property
    def tuners(self) -> list[str]:
        """Tuner labels in the order of their first run."""
        return [str(name) for name in dict.fromkeys(self.runs["tuner"])]

    @property
    def version(self) -> str:
        """Name and version of the suite."""
        return str(self.cells["suite"].iloc[0])

    def select(self, mask: pd.Series[bool]) -> SuiteRuns:
        """Return the runs selected by a mask, and their cells."""
        selected_runs = self.runs[mask].reset_index(drop=True)
        cells = self.cells[self.cells["cell"].isin(selected_runs["cell"])].reset_index(drop=True)
        return replace(self, runs=selected_runs, errors=self.errors[mask.to_numpy()], cells=cells)


def is_stored_suite(folder: Path) -> bool:
    """Return whether a folder has the stored runs of a suite without its comparisons."""
    return (folder / CURVES_FILE).is_file() and not any(list_comparison_folders(folder))


def list_comparison_folders(folder: Path) -> Iterator[tuple[Path, str]]:
    """Yield the folders of a suite's comparisons, each with its condition.

    The condition is ``before`` or ``after`` the extension of a misspecified simulator, or empty.
    """
    for subfolder in sorted(path for path in folder.iterdir() if path.is_dir()):
        if (subfolder / CONFIGURATION_FILE).is_file():
            # A misspecification study has a comparison for each of its two simulators.
            models = [label for label in MODEL_LABELS if (subfolder / label).is_dir()]
            if models:
                yield from ((subfolder / m, "before" if m == PLAIN else "after") for m in models)
            else:
                yield subfolder, ""


def collect_suite_runs(folder: Path) -> SuiteRuns:
    """Collect the runs of all finished comparisons in the folder of a suite.

    Args:
        folder: folder that contains one subfolder per problem.

    Raises:
        InputError: no comparison is finished, or a folder is damaged.
    """
    # A comparison is finished when its segments, the plan and the journal of runs, are deleted.
    collected_runs = [
        _collect_comparison(part, condition)
        for part, condition in list_comparison_folders(folder)
        if (part / "runs.parquet").is_file() and not (part / SEGMENTS_FOLDER).exists()
    ]
    collected_runs = [part for part in collected_runs if len(part.runs)]
    if not collected_runs:
        raise InputError(
            f"{folder}: expected at least one finished comparison of a suite, found none; finish "
            f"it with simgap compare --resume {folder}"
        )
    return concatenate(collected_runs)


def _collect_comparison(folder: Path, condition: str) -> SuiteRuns:
    """Collect the runs of one comparison of a suite, with its cells and the cost of trainings.

    A cell is a problem with one range of targets.

    Args:
        folder: folder of the comparison.
        condition: ``before`` or ``after`` the extension of a misspecified simulator, else empty.

    Returns:
        The runs; without runs only the tuners that were skipped.
    """
    stored = read_comparison(folder, REQUIRED_RUN_COLUMNS)
    experiment = stored.experiment
    # With a condition, the comparison is in a subfolder of the problem.
    problem = folder.parent.name if condition else folder.name
    skipped = stored.statuses[stored.statuses["status"] == "skipped"]
    if stored.runs.empty:
        return _make_empty(skipped)
    statistics = ComparisonStatistics(stored)
    curves = statistics.curves
    statuses = stored.statuses.drop_duplicates("run").set_index("run")
    run_statuses = statuses.reindex(curves.keys["run"])
    keys = curves.keys
    cells = [name_cell(problem, str(kind), condition, experiment) for kind in keys["range"]]
    runs = pd.DataFrame(
        {
            "cell": cells,
            "tuner": keys["tuner"].astype(str),
            "target": keys["target"].astype(str),
            "seed": keys["seed"],
            "simulations": curves.used,
            "seconds": run_statuses["seconds"].to_numpy(),
            "failed": curves.failed,
        }
    )
    has_used_budget = (run_statuses["status"] == "done").to_numpy()
    errors = replace_unknown_errors(curves, has_used_budget, experiment.budget)
    properties = {
        "problem": problem,
        "parameters": _count_parameters(experiment),
        "tags": ";".join(experiment.tags),
        "negligible_error": experiment.negligible_error,
        "metric": statistics.metric,
        "title": experiment.title,
        "tests": experiment.says,
        "identifiable": experiment.identifiable,
        "suite": experiment.suite,
    }
    # One row for each cell, with the range of its targets.
    range_by_cell = dict(zip(cells, keys["range"], strict=True))
    cell_rows = [
        {"cell": cell, "range": condition or str(kind), **properties}
        for cell, kind in range_by_cell.items()
    ]
    training = pd.DataFrame(
        [(cell, tuner, *cost) for cell in range_by_cell for tuner, cost in stored.costs.items()],
        columns=TRAINING_COLUMNS,
    )
    reasons = skipped[SKIPPED_COLUMNS].drop_duplicates("tuner")
    return SuiteRuns(runs, errors, pd.DataFrame(cell_rows, columns=CELL_COLUMNS), training, reasons)


def name_cell(problem: str, kind: str, condition: str, experiment: Experiment) -> str:
    """Return the name of a cell: the problem, and what distinguishes it from its other cells.

    Args:
        problem: name of the problem.
        kind: range of the targets.
        condition: ``before`` or ``after`` the extension of a misspecified simulator, else empty.
        experiment: configuration of the problem, with its ranges.
    """
    if condition:
        return f"{problem} {condition}"
    return f"{problem} {kind}" if len(experiment.ranges) > 1 else problem


def _count_parameters(experiment: Experiment) -> int:
    """Return the number of tuned parameters; the simulator must be built, as it declares them."""
    from bench.benchmark.problem.tuning_problem import TuningProblem

    problem = TuningProblem(experiment)
    problem.close()
    return problem.cube.dim


def _make_empty(skipped: pd.DataFrame) -> SuiteRuns:
    """Return the result for a comparison without runs: only the tuners that were skipped.

    Args:
        skipped: Table of tuners that could not run, with the reason.
    """
    return SuiteRuns(
        pd.DataFrame(columns=RUN_COLUMNS),
        np.empty((0, 1)),
        pd.DataFrame(columns=CELL_COLUMNS),
        pd.DataFrame(columns=TRAINING_COLUMNS),
        skipped[SKIPPED_COLUMNS],
    )


def concatenate(parts: Sequence[SuiteRuns]) -> SuiteRuns:
    """Concatenate runs; the first row of each run, cell, training and skipped tuner stays.

    Args:
        parts: Runs of several comparisons; `errors` (runs, simulations + 1) may differ in width.

    Returns:
        All runs; shorter rows of errors are filled with NaN.
    """
    width = max(part.errors.shape[1] for part in parts)
    errors = np.concatenate(
        [
            np.pad(part.errors, ((0, 0), (0, width - part.errors.shape[1])), constant_values=np.nan)
            for part in parts
        ]
    )
    # A tuner that is skipped in one part may have runs in another one; then it is left out below.
    skipped = pd.concat([part.skipped for part in parts]).drop_duplicates("tuner")
    runs = pd.concat([part.runs for part in parts], ignore_index=True)
    is_first = ~runs.duplicated(RUN_KEYS)
    return SuiteRuns(
        runs[is_first].reset_index(drop=True),
        errors[is_first.to_numpy()],
        pd.concat([part.cells for part in parts]).drop_duplicates("cell").reset_index(drop=True),
        pd.concat([part.training for part in parts])
        .drop_duplicates(["cell", "tuner"])
        .reset_index(drop=True),
        skipped[~skipped["tuner"].isin(runs["tuner"])].reset_index(drop=True),
    )


def merge_runs(new_runs: SuiteRuns, stored: SuiteRuns) -> SuiteRuns:
    """Add stored runs of other tuners to own runs, in the cells and on the targets of both.

    Own runs in cells of which no target is stored are left out, unless nothing is in common.

    A cell is a problem with one range of targets.

    Args:
        new_runs: runs of one or more tuners.
        stored: runs of any tuners; those of a tuner that `new_runs` has in the same cell are left
            out.

    Returns:
        The own runs that are left, and the added ones.
    """
    # The cell and target of each run.
    own_targets, stored_targets = (
        pd.MultiIndex.from_frame(part.runs[["cell", "target"]]) for part in (new_runs, stored)
    )
    is_common = own_targets.isin(stored_targets)
    # Without a common target the methods cannot be compared.
    if not is_common.any():
        return new_runs
    own_tuners, stored_tuners = (
        pd.MultiIndex.from_frame(part.runs[["cell", "tuner"]]) for part in (new_runs, stored)
    )
    is_added = stored_targets.isin(own_targets) & ~stored_tuners.isin(own_tuners)
    return concatenate(
        [
            new_runs.select(pd.Series(is_common, index=new_runs.runs.index)),
            stored.select(pd.Series(is_added, index=stored.runs.index)),
        ]
    )


def write_suite_runs(suite: SuiteRuns, folder: Path) -> list[Path]:
    """Write runs in the stored form; errors are rounded to three significant digits.

    Args:
        suite: runs.
        folder: existing folder.

    Returns:
        Written files.
    """
    import pyarrow as pa
    from pyarrow import parquet

    table = pa.Table.from_pandas(
        suite.runs.assign(seconds=suite.runs["seconds"].round(_SECONDS_DIGITS)),
        preserve_index=False,
    )
    for name, column in _encode_errors(suite.errors).items():
        table = table.append_column(name, column)
    digits = {_DIGITS_KEY: str(_STORED_DIGITS).encode()}
    table = table.replace_schema_metadata({**(table.schema.metadata or {}), **digits})
    with atomic_replacement(folder / CURVES_FILE) as path:
        # Few errors occur twice, so that a dictionary of them takes more space than it saves. Each
        # column is one page, because columns are compressed page by page. Bytes of the same
        # significance are stored together, which saves a tenth.
        parquet.write_table(
            table,
            path,
            compression="brotli",
            compression_level=11,
            use_dictionary=False,
            data_page_size=2**26,
            column_encoding={
                f"{name}.list.element": "BYTE_STREAM_SPLIT" for name in _SPLIT_COLUMNS
            },
        )
    texts = {CELLS_FILE: suite.cells, TRAINING_FILE: suite.training, SKIPPED_FILE: suite.skipped}
    for name, table_frame in texts.items():
        write_atomically(folder / name, table_frame.to_csv(index=False))
    return [folder / name for name in (CURVES_FILE, *texts)]


def _encode_errors(errors: Array) -> dict[str, Any]:
    """Encode the errors of runs for storage: run-length encoding of rounded decimal numbers.

    An error often stays the same for many simulations, and is stored only where it changes. It is
    mantissa * 10 ** (exponent - `_STORED_DIGITS` + 1).

    Args:
        errors: (R, K + 1) errors of R runs after 0..K simulations; NaN and infinity are allowed.

    Returns:
        Columns of one list for each run: for how many simulations an error holds, its mantissa and
        its exponent.
    """
    import pyarrow as pa

    with np.errstate(divide="ignore", invalid="ignore"):
        exponents = np.floor(np.log10(np.abs(errors)))
    is_number = np.isfinite(errors) & np.isfinite(exponents)
    # An error below the smallest exponent is rounded to zero.
    exponents = np.where(is_number, np.maximum(exponents, _MIN_EXPONENT), 0.0)
    shifted = np.where(is_number, errors, 0.0) * 10.0 ** (_STORED_DIGITS - 1 - exponents)
    mantissas = np.round(shifted).astype(np.int16)
    exponents = exponents.astype(np.int8)
    exponents[np.isnan(errors)], exponents[np.isposinf(errors)] = _MISSING, _FAILED
    has_changed = np.ones(errors.shape, dtype=bool)
    has_changed[:, 1:] = (np.diff(mantissas, axis=1) != 0) | (np.diff(exponents, axis=1) != 0)
    # Positions in the flattened array at which an error begins to hold.
    starts = np.flatnonzero(has_changed)
    lengths = np.diff(starts, append=errors.size).astype(np.int16)
    # List r of a column has its elements offsets[r] to offsets[r + 1].
    offsets = np.concatenate([[0], np.cumsum(has_changed.sum(axis=1))]).astype(np.int32)
    values = lengths, mantissas[has_changed], exponents[has_changed]
    return {
        name: pa.ListArray.from_arrays(pa.array(offsets), pa.array(column))
        for name, column in zip(_ERRORS_COLUMNS, values, strict=True)
    }


def _decode_errors(table: Any) -> Array:
    """Return the errors (R, K + 1) of R stored runs after 0..K simulations.

    They are run-length encoded decimal numbers, see `_encode_errors`: each mantissa and exponent
    holds for a length (number of simulations).

    Args:
        table: stored runs, with the columns `_ERRORS_COLUMNS`.
    """
    lengths, mantissas, exponents = (
        table[name].combine_chunks().flatten().to_numpy() for name in _ERRORS_COLUMNS
    )
    digits = int((table.schema.metadata or {}).get(_DIGITS_KEY, _FORMER_DIGITS))
    values = mantissas * 10.0 ** (exponents.astype(np.float64) - digits + 1)
    values[exponents == _MISSING], values[exponents == _FAILED] = np.nan, np.inf
    errors: Array = np.repeat(values, lengths).reshape(len(table), -1)
    return errors


def read_suite_runs(folder: Path) -> SuiteRuns:
    """Read runs in the stored form.

    Raises:
        InputError: a file is missing or damaged.
    """
    from pyarrow import ArrowException, parquet

    try:
        table = parquet.read_table(folder / CURVES_FILE)
        frame = table.select(RUN_COLUMNS).to_pandas()
        cells, training, skipped = (
            pd.read_csv(folder / name, keep_default_na=False)
            for name in (CELLS_FILE, TRAINING_FILE, SKIPPED_FILE)
        )
        errors = _decode_errors(table)
        return SuiteRuns(
            frame,
            errors,
            cells[CELL_COLUMNS],
            training[TRAINING_COLUMNS],
            skipped[SKIPPED_COLUMNS],
        )
    except (OSError, ArrowException, KeyError, ValueError) as error:
        raise InputError(
            f"{folder}: expected the stored runs of a suite ({CURVES_FILE}, {CELLS_FILE}), found "
            f"{str(error).splitlines()[0]:.200}; restore the file or run the suite again"
        ) from None


_REFERENCE_NAME = "suite"
"""Folder of the stored runs among the reference results."""


def find_stored_runs(version: str) -> SuiteRuns | None:
    """Return the stored runs of a version of a suite; None if there are none.

    They are read from the reference results of this project.

    Args:
        version: Version of the suite, which changes when its problems change.
    """
    for parent in REFERENCE_FOLDERS:
        folder = parent / _REFERENCE_NAME
        if (folder / CURVES_FILE).is_file():
            stored = read_suite_runs(folder)
            if stored.version == version:
                return stored
    return None
