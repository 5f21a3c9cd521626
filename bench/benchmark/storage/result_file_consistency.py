"""Check the files of a comparison against each other, the experiment and the plan of its runs.

Every file is checked cell by cell first. runs.parquet is then reduced to one line per run, which is
compared with status.csv, training.csv, identifiability.csv and the plan.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.benchmark.problem.experiment_config import Experiment, TunerEntry
from bench.benchmark.storage.cell_validation import (
    CellError,
    Mask,
    check_cells,
    make_table_error,
    parse_parquet_column,
    select_declared_columns,
    to_numpy_mask,
)
from bench.benchmark.storage.csv_reader import CsvTable
from bench.benchmark.storage.run_journal import JOURNAL_REMEDY
from bench.benchmark.storage.run_status import STATUS_COLUMN_NAMES, RunStatus
from bench.benchmark.storage.table_schemas import (
    ERROR_TABLE_COLUMNS,
    IDENTIFIABILITY_COLUMNS,
    RUN_CONSTANT_COLUMNS,
    STATUS_COLUMNS,
    TRAINING_COLUMNS,
    ColumnSpec,
    declare_run_columns,
    expand_columns,
)
from bench.core.plugin_registries import tuners
from sims.core.files import get_first_line
from sims.core.simulator import InputError
from sims.core.toml_validation import format_value

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa


_SEED_PATTERN = re.compile("[0-9]{1,9}")
"""Pattern of the seed in the id of a run."""
RowErrorFactory = Callable[[int, str], InputError]
"""Makes the error for a row of a file, counted from 0."""
TableErrorFactory = Callable[[int | None, str], InputError]
"""Makes the error for a row of a file, counted from 0, or for the whole file (None)."""


class CheckedFiles(NamedTuple):
    """The files of a comparison with stored runs, checked cell by cell.

    Attributes:
        runs: One line per run; see `RunsTable.read_runs`.
        statuses: Rows of status.csv.
        training: Rows of training.csv.
        spectra: Rows of identifiability.csv; None if there is no such file.
    """

    runs: pd.DataFrame
    statuses: pd.DataFrame
    training: pd.DataFrame
    spectra: pd.DataFrame | None


def check_files(
    folder: Path, experiment: Experiment, *, is_unfinished: bool, plan: list[str] | None = None
) -> CheckedFiles:
    """Check runs.parquet, status.csv, training.csv, identifiability.csv and their consistency.

    The tables are checked alone first, then against each other and against the plan, the list of
    all runs. A tuner that could not be used is skipped: it has a row in status.csv, but no runs.

    Args:
        folder: Folder of the comparison.
        experiment: Content of the experiment's TOML file: simulator, tuners, targets and budget.
        is_unfinished: Whether runs may be missing.
        plan: The id of every run; None if unknown.

    Raises:
        InputError: A check fails; the message is one line.
    """
    remedy = get_remedy(folder, is_unfinished=is_unfinished)
    file = RunsTable(folder / "runs.parquet", remedy)
    runs = file.read_runs(experiment)
    status = CsvTable(folder / "status.csv", STATUS_COLUMNS, remedy)
    statuses = status.table.to_pandas()
    check_statuses(statuses, experiment, status.make_error)
    executed = statuses[statuses["status"] != "skipped"]
    if not is_unfinished:
        check_complete(executed, experiment, status.make_error)
        # A tuner without runs is skipped, and then has a row that says so.
        labels = set(statuses["tuner"])
        missing_labels = [label for label in list_tuner_labels(experiment) if label not in labels]
        if missing_labels:
            raise status.make_error(
                None, f"tuner: expected runs of {missing_labels[0]}, found none"
            )
    if plan is not None:
        is_planned = executed["run"].isin(plan)
        raise_for_first_bad_row(
            ~is_planned,
            # `i` counts the executed runs only; the index is the row in the file.
            lambda i, reason: status.make_error(int(executed.index[i]), reason),
            lambda i: f"run: expected one of segments/plan.txt, found {executed['run'].iloc[i]}",
        )
    check_runs(runs, file, experiment)
    check_rows_match_statuses(runs, file, statuses, status.make_error, "status.csv")
    training = CsvTable(folder / "training.csv", TRAINING_COLUMNS, remedy)
    trainings = training.table.to_pandas()
    check_known(trainings["tuner"], list_tuner_labels(experiment), "tuner", training.make_error)
    raise_for_first_bad_row(
        trainings.duplicated(["tuner", "seed"]),
        training.make_error,
        lambda _: "tuner and seed: expected every training once, found one twice",
    )
    return CheckedFiles(
        runs, statuses, trainings, _read_identifiability_table(folder, experiment, remedy)
    )


def get_remedy(folder: Path, *, is_unfinished: bool) -> str:
    """Return advice for a damaged file of results.

    Args:
        folder: Folder of the comparison.
        is_unfinished: Whether its segments still exist.
    """
    if is_unfinished:  # The segments contain everything.
        return f"write it again with simgap compare --resume {folder}"
    return "restore the file, or start a new comparison"


def check_table(folder: Path) -> None:
    """Check table.csv if it exists.

    Raises:
        InputError: It is damaged.
    """
    path = folder / "table.csv"
    if path.exists():
        CsvTable(path, ERROR_TABLE_COLUMNS, f"write it again with simgap plot {folder}")


def _read_identifiability_table(
    folder: Path, experiment: Experiment, remedy: str
) -> pd.DataFrame | None:
    """Read and check identifiability.csv; None if the comparison has no such file.

    The file has the directions of the parameter space of each target, in order of number. Targets
    must be those of the experiment, and the directions of a target must be numbered 1, 2, ....

    Args:
        folder: Folder of the comparison.
        experiment: Content of the experiment's TOML file: simulator, tuners, targets and budget.
        remedy: Advice for a damaged file.

    Returns:
        Rows of the file.

    Raises:
        InputError: The file is damaged.
    """
    path = folder / "identifiability.csv"
    if not path.exists():
        return None
    file = CsvTable(path, _list_identifiability_columns, remedy)
    spectra: pd.DataFrame = file.table.to_pandas()
    check_known(spectra["target"], list_target_names(experiment), "target", file.make_error)
    expected = spectra.groupby("target").cumcount() + 1
    raise_for_first_bad_row(
        spectra["direction"] != expected,
        file.make_error,
        lambda row: f"direction: expected {expected[row]}, found {spectra['direction'][row]}",
    )
    return spectra


def _list_identifiability_columns(names: list[str]) -> list[ColumnSpec]:
    """Return the columns of identifiability.csv: all without a declared name are parameters."""
    declared_names = [column.name for column in IDENTIFIABILITY_COLUMNS]
    return expand_columns(
        IDENTIFIABILITY_COLUMNS, [name for name in names if name not in declared_names], ()
    )


class RunsTable(NamedTuple):
    """A file of runs.

    Attributes:
        path: Path of the file.
        remedy: Advice for a damaged file.
        rows: Rows that were read already, for a file that is not Parquet; otherwise None.
        first_row: Number of the first of these rows in the file.
    """

    path: Path
    remedy: str
    rows: pa.Table | None = None
    first_row: int = 0

    def make_error(self, row: int | None, problem: str) -> InputError:
        """Make the error for a row, counted from 0, or for the whole file.

        Args:
            row: Row, or None for the file.
            problem: What is wrong.
        """
        place = None if row is None else f"row {self.first_row + row}"
        return make_table_error(self.path, place, problem, self.remedy)

    def read_runs(self, experiment: Experiment) -> pd.DataFrame:
        """Check all rows, and return one line per run, in the order of the file.

        Each line has the columns that are constant within the run, ``row``, at which it begins, and
        ``used``, its last k. Columns are read one by one, since all of many rows would not fit in
        memory.

        Args:
            experiment: Experiment of the runs.

        Raises:
            InputError: The file is damaged; the message is one line.
        """
        import pyarrow as pa
        from pyarrow import parquet

        try:
            if self.rows is not None:
                return _read_checked_runs(self.rows.select, self.rows.column_names, experiment)
            with parquet.ParquetFile(self.path) as file:
                names = list(file.schema_arrow.names)
                return _read_checked_runs(
                    lambda columns: file.read(columns=columns), names, experiment
                )
        except CellError as error:
            raise self.make_error(error.row, error.says) from None
        # In a damaged file even the names of columns may be invalid text.
        except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
            raise self._make_read_error(error) from None

    def _make_read_error(self, error: Exception) -> InputError:
        """Make the one-line error for a file that is missing, or is not a Parquet file."""
        missing = isinstance(error, FileNotFoundError)
        reason = (
            "no such file" if missing else f"expected a Parquet file, found {get_first_line(error)}"
        )
        return self.make_error(None, f"not a complete comparison: {reason}")


def _read_checked_runs(
    read_columns: Callable[[list[str]], pa.Table], names: list[str], experiment: Experiment
) -> pd.DataFrame:
    """Check rows of runs and return one line per run; see `RunsTable.read_runs`.

    A run has one row for each number of simulations k, in consecutive rows. The columns that
    describe the run itself, such as tuner and target, must be constant within these rows.

    Args:
        read_columns: Reads columns by their names.
        names: Names of the columns.
        experiment: Experiment of the runs.

    Returns:
        One line per run: its constant columns, ``row``, at which it begins, and ``used``, its last
        k.

    Raises:
        CellError: A cell or a run violates its declaration.
    """
    import pandas as pd
    import pyarrow as pa
    from pyarrow import compute

    if not names:  # Without runs there are no columns.
        return pd.DataFrame(columns=["run", *RUN_CONSTANT_COLUMNS, "row", "used"])
    columns = select_declared_columns(names, declare_run_columns(names, experiment))
    declared = {column.name: column for column in columns}

    def read(name: str) -> pa.Array:
        return parse_parquet_column(declared[name], read_columns([name])[name])

    run, k = read("run"), read("k").to_numpy()
    is_recording = to_numpy_mask(compute.equal(read("range"), "real"))
    is_run_start = np.ones(len(k), dtype=bool)
    is_run_start[1:] = _find_changes(run)
    _check_counts(run, k, is_run_start)
    rows = np.flatnonzero(is_run_start)
    constants = {"run": run.take(rows)}
    for name, column in declared.items():
        values = read(name)
        # Some columns must be empty at k = 0, others for a recording.
        check_cells(column, values, k == 0, is_recording)
        if name in RUN_CONSTANT_COLUMNS or name.startswith("true_"):
            # A row that does not start a run belongs to the same run as the row before.
            _check_constant(name, values, ~is_run_start[1:])
            constants[name] = values.take(rows)
    # k counts without gaps, so the number of rows gives the last k.
    used = np.diff(np.append(rows, len(k))) - 1
    runs: pd.DataFrame = pa.table(constants).to_pandas().assign(row=rows, used=used)
    is_repeated = runs["run"].duplicated().to_numpy(dtype=bool)
    if is_repeated.any():
        repeated = int(is_repeated.argmax())
        name = runs["run"][repeated]
        raise CellError(int(rows[repeated]), "run", "every run once", f"{name} again")
    return runs


def _find_changes(values: pa.Array) -> Mask:
    """Return an (n - 1,) mask of values that differ from the previous one; NaN equals NaN."""
    import pyarrow as pa
    from pyarrow import compute

    if pa.types.is_floating(values.type):
        numbers = values.to_numpy()
        is_both_missing = np.isnan(numbers[1:]) & np.isnan(numbers[:-1])
        is_changed: Mask = (numbers[1:] != numbers[:-1]) & ~is_both_missing
        return is_changed
    return to_numpy_mask(compute.not_equal(values[1:], values[:-1]))


def _check_counts(run: pa.Array, k: NDArray[np.int64], is_run_start: Mask) -> None:
    """Check that k, the number of simulations, counts 0, 1, 2, ... in the rows of every run.

    Args:
        run: (n,) id of the run of each row.
        k: (n,) number of simulations of each row.
        is_run_start: (n,) mask of the rows with which a run begins.

    Raises:
        CellError: k has another value, so that a row is missing or added.
    """
    # The value of the row before plus one; the first row, to which `roll` wraps around, is a start.
    expected = np.where(is_run_start, 0, np.roll(k, 1) + 1)
    is_wrong = k != expected
    if is_wrong.any():
        row = int(is_wrong.argmax())
        raise CellError(row, "k", f"{expected[row]}, the next of {run[row].as_py()}", str(k[row]))


def _check_constant(name: str, values: pa.Array, is_same_run: Mask) -> None:
    """Check that a column that describes a run, such as tuner and target, is constant within it.

    Args:
        name: Name of the column.
        values: (n,) values, in which the rows of a run follow each other.
        is_same_run: (n - 1,) mask of rows that belong to the run of the row before.

    Raises:
        CellError: a value differs from the row before.
    """
    is_changed = _find_changes(values) & is_same_run
    if is_changed.any():
        row = int(is_changed.argmax()) + 1
        before, found = values[row - 1].as_py(), values[row].as_py()
        raise CellError(row, name, f"{before} as in the row before", str(found))


def list_target_names(experiment: Experiment) -> list[str]:
    """List the names of all targets of an experiment."""
    return [f"{kind}-{i:03d}" for i in range(experiment.targets) for kind in experiment.ranges]


def list_tuner_labels(experiment: Experiment) -> list[str]:
    """List the labels of an experiment's tuners."""
    return [entry.label for entry in experiment.tuners]


def check_plan(plan: Sequence[str], experiment: Experiment, path: Path, remedy: str) -> None:
    """Check that a plan (the list of all runs) belongs to an experiment and is complete.

    Args:
        plan: The id of every run.
        experiment: Content of the experiment's TOML file: simulator, tuners, targets and budget.
        path: Path of the plan.
        remedy: Advice for a damaged plan.

    Raises:
        InputError: A check fails.
    """
    import pandas as pd

    def make_line_error(row: int | None, problem: str) -> InputError:
        line = "" if row is None else f", line {row + 1}"
        return InputError(f"{path}{line}: {problem}; {remedy}")

    planned_runs = []
    for row, name in enumerate(plan):
        # The id is split from its end, since a label may contain slashes.
        parts = name.rsplit("/", 3)
        tuner, target, seed, _ = parts if len(parts) == 4 else [""] * 4
        if not _SEED_PATTERN.fullmatch(seed):
            raise make_line_error(
                row, f"expected TUNER/TARGET/SEED/HASH, found {format_value(name)}"
            )
        planned_runs.append((name, tuner, target, int(seed)))
    plan_table = pd.DataFrame(planned_runs, columns=["run", "tuner", "target", "seed"])
    names = plan_table["run"]
    raise_for_first_bad_row(
        names.duplicated(),
        make_line_error,
        lambda row: f"expected every run once, found {names[row]} twice",
    )
    check_known(plan_table["tuner"], list_tuner_labels(experiment), "tuner", make_line_error)
    check_known(plan_table["target"], list_target_names(experiment), "target", make_line_error)
    check_complete(plan_table, experiment, make_line_error)


def check_complete(
    executed_runs: pd.DataFrame, experiment: Experiment, make_error: TableErrorFactory
) -> None:
    """Check that each tuner with runs has all of its runs, and no more.

    It has one run for each target and seed. Tuners without any run were skipped, and are checked
    elsewhere.

    Args:
        executed_runs: Tuner, target and seed of each run; the index is the row in the file.
        experiment: Content of the experiment's TOML file: simulator, tuners, targets and budget.
        make_error: Makes the error for a row, or for the file.

    Raises:
        InputError: A run is missing, or there is one too many.
    """
    targets = list_target_names(experiment)
    for entry in experiment.tuners:
        tuner_rows = executed_runs[executed_runs["tuner"] == entry.label]
        if tuner_rows.empty:
            continue
        seeds = range(_count_seeds(entry, experiment, tuner_rows["seed"].max()))
        # Pairs of target and seed that have a run.
        executed = set(zip(tuner_rows["target"], tuner_rows["seed"].tolist(), strict=True))
        missing = next(((t, s) for t in targets for s in seeds if (t, s) not in executed), None)
        if missing:
            target, seed = missing
            problem = f"expected a run of {entry.label} on {target} with seed {seed}, found none"
            raise make_error(None, problem)
        # Nothing is missing, so a larger number means a repeated run or a seed that is too large.
        if len(tuner_rows) > len(targets) * len(seeds):
            is_surplus = tuner_rows.duplicated(["target", "seed"]) | (
                tuner_rows["seed"] >= len(seeds)
            )
            row = int(tuner_rows.index[int(is_surplus.to_numpy().argmax())])
            raise make_error(
                row,
                f"run: expected {len(targets)} targets with {len(seeds)} seeds, "
                f"found one more: {tuner_rows['run'][row]}",
            )


def _count_seeds(entry: TunerEntry, experiment: Experiment, largest: int) -> int:
    """Return the number of seeds that an entry's runs must have.

    A deterministic tuner has one seed, whatever the experiment states. If more than one seed
    occurs, the tuner is not deterministic, and need not be loaded to find out. The result equals
    `bench.benchmark.runner.experiment_runner.count_seeds` if the tuner is known.

    Args:
        entry: Entry of the tuner.
        experiment: Experiment, whose number of seeds applies unless the entry has its own.
        largest: Largest seed in the entry's runs; seeds count from 0.
    """
    seed_count = entry.seeds or experiment.seeds
    if seed_count == 1 or largest > 0:
        return seed_count
    # A single seed is correct for a deterministic tuner. The tuner is loaded only now, since it may
    # import large packages.
    try:
        tuner_class = tuners.get(entry.tuner)
    except InputError:  # A tuner of a plugin that is not loaded or cannot be used here.
        return 1
    return seed_count if tuner_class.stochastic or tuner_class.learned else 1


def check_statuses(
    statuses: pd.DataFrame, experiment: Experiment, make_error: RowErrorFactory
) -> None:
    """Check that statuses are unique, belong to the experiment, and are within its budget.

    Checked are: unique IDs that begin with tuner, target and seed; known tuners, simulator and
    targets; and numbers of simulations that fit to budget and status.

    Args:
        statuses: Rows with the columns of `table_schemas.STATUS_COLUMNS`, cells checked.
        experiment: Content of the experiment's TOML file: simulator, tuners, targets and budget.
        make_error: Makes the error for a row.

    Raises:
        InputError: A check fails.
    """
    raise_for_first_bad_row(
        statuses["run"].duplicated(),
        make_error,
        lambda row: f"run: expected every run once, found {statuses['run'].iloc[row]} twice",
    )
    check_known(statuses["tuner"], list_tuner_labels(experiment), "tuner", make_error)
    check_known(statuses["simulator"], [experiment.simulator], "simulator", make_error)
    _check_run_ids(statuses, make_error)
    is_executed = statuses["status"] != "skipped"
    executed_rows = np.flatnonzero(is_executed)
    check_known(
        statuses["target"][is_executed],
        list_target_names(experiment),
        "target",
        # `row` counts only the executed runs.
        lambda row, reason: make_error(int(executed_rows[row]), reason),
    )
    _check_simulation_counts(statuses, experiment, make_error)


def _check_run_ids(statuses: pd.DataFrame, make_error: RowErrorFactory) -> None:
    """Check that the id of each run begins with its tuner, target and seed.

    Args:
        statuses: Rows with the columns of `table_schemas.STATUS_COLUMNS`.
        make_error: Makes the error for a row.

    Raises:
        InputError: An id is not valid.
    """
    skipped = statuses["status"] == "skipped"
    id_prefixes = (
        statuses["tuner"] + "/" + statuses["target"] + "/" + statuses["seed"].astype(str) + "/"
    )
    # The id of a tuner that was skipped is its label alone.
    has_valid_id = [
        run == tuner if is_skipped else run.startswith(prefix)
        for run, tuner, prefix, is_skipped in zip(
            statuses["run"], statuses["tuner"], id_prefixes, skipped, strict=True
        )
    ]
    raise_for_first_bad_row(
        ~np.array(has_valid_id, dtype=bool),
        make_error,
        lambda row: (
            f"run: expected one that begins with {id_prefixes.iloc[row]}, "
            f"found {statuses['run'].iloc[row]}"
        ),
    )


def _check_simulation_counts(
    statuses: pd.DataFrame, experiment: Experiment, make_error: RowErrorFactory
) -> None:
    """Check that the number of simulations of each run fits its tuner's budget and its status.

    Args:
        statuses: Rows with the columns of `table_schemas.STATUS_COLUMNS`.
        experiment: Content of the experiment's TOML file, with the budgets.
        make_error: Makes the error for a row.

    Raises:
        InputError: A run has more simulations than its budget, or is done with fewer.
    """
    # A tuner may have its own budget; otherwise that of the experiment applies.
    budgets = {entry.label: entry.budget or experiment.budget for entry in experiment.tuners}
    budget = statuses["tuner"].map(budgets).astype(np.int64)  # Also for an empty column.
    simulations = statuses["simulations"]
    raise_for_first_bad_row(
        simulations > budget,
        make_error,
        lambda row: (
            f"simulations: expected at most {budget.iloc[row]}, "
            f"the budget of {statuses['tuner'].iloc[row]}, found {simulations.iloc[row]}"
        ),
    )
    # "done" means that the budget was used; a run that ends earlier has converged or failed.
    raise_for_first_bad_row(
        (statuses["status"] == "done") & (simulations != budget),
        make_error,
        lambda row: (
            f"simulations: expected {budget.iloc[row]} as the run is done, found "
            f"{simulations.iloc[row]}"
        ),
    )


def check_rows_match_statuses(
    runs: pd.DataFrame,
    file: RunsTable,
    statuses: pd.DataFrame,
    make_error: RowErrorFactory,
    source: str,
) -> None:
    """Check that rows and statuses describe the same runs consistently.

    Two files contain the runs: the rows with one line per simulation, and the statuses with one
    line per run. Every row must belong to an executed run, every executed run must have rows, and
    the number of simulations, tuner, simulator, target and seed must agree.

    Args:
        runs: One line per run, as read from `file`.
        file: File of the rows.
        statuses: Rows of status.csv, whose cells have been checked one by one.
        make_error: Makes the error for a row of the statuses.
        source: Name of the file of statuses, for messages.

    Raises:
        InputError: A check fails.
    """
    import pandas as pd

    # Row of each run among the statuses; -1 if it is not there.
    status_rows = pd.Index(statuses["run"]).get_indexer(runs["run"])
    file_rows = runs["row"].to_numpy()
    names = runs["run"]

    # Errors are reported at the row of the file with which the run begins.
    def make_row_error(i: int, reason: str) -> InputError:
        return file.make_error(int(file_rows[i]), reason)

    raise_for_first_bad_row(
        status_rows < 0,
        make_row_error,
        lambda i: f"run: expected one of {source}, found {names[i]}",
    )
    is_executed = (statuses["status"] != "skipped").to_numpy()
    raise_for_first_bad_row(
        ~is_executed[status_rows],
        make_row_error,
        lambda i: f"run: {names[i]} is skipped by {source}, and has rows",
    )
    has_rows = np.zeros(len(statuses), dtype=bool)
    has_rows[status_rows] = True
    ids = statuses["run"]
    raise_for_first_bad_row(
        is_executed & ~has_rows,
        make_error,
        lambda row: f"run: {ids[row]} has no rows in {file.path.name}",
    )
    # The statuses in the order of `runs`; `used` is the last k of each run.
    run_statuses, used_counts = statuses.iloc[status_rows].reset_index(drop=True), runs["used"]
    raise_for_first_bad_row(
        run_statuses["simulations"] != used_counts,
        lambda i, reason: make_error(int(status_rows[i]), reason),
        lambda i: (
            f"simulations: expected {used_counts[i]}, the last k of {names[i]} in "
            f"{file.path.name}, found {run_statuses['simulations'][i]}"
        ),
    )
    for name in ("tuner", "simulator", "target", "seed"):
        check_equal(runs[name], run_statuses[name], name, f"as in {source}", make_row_error)


def check_runs(runs: pd.DataFrame, file: RunsTable, experiment: Experiment) -> None:
    """Check that the runs belong to one experiment, and agree on the parameters of each target.

    Args:
        runs: One line per run, as read from `file`.
        file: File of the rows.
        experiment: Content of the experiment's TOML file: simulator, tuners, targets and budget.

    Raises:
        InputError: A check fails.
    """

    def make_row_error(i: int, problem: str) -> InputError:
        return file.make_error(int(runs["row"][i]), problem)

    check_known(runs["experiment"], [experiment.name], "experiment", make_row_error)
    # The name of a target is its range and a number, as `wide-017`.
    ranges_of_targets = runs["target"].str.replace(r"-\d+$", "", regex=True)
    check_equal(runs["range"], ranges_of_targets, "range", "of its target", make_row_error)
    # Columns such as `true_damping` have the true parameters of the run's target.
    for name in runs.columns:
        if name.startswith("true_"):
            first = runs.drop_duplicates("target").set_index("target")[name]
            expected = runs["target"].map(first)
            reason = "as in other runs on this target"
            check_equal(runs[name], expected, name, reason, make_row_error)


def check_journal_statuses(
    path: Path,
    statuses_by_index: Mapping[int, RunStatus],
    experiment: Experiment,
    plan: Sequence[str] | None,
) -> pd.DataFrame:
    """Check the statuses of a journal: its runs must be those of the plan.

    The journal is the file to which an unfinished comparison appends each run that has ended.

    Args:
        path: Path of the journal.
        statuses_by_index: Statuses by index in the plan.
        experiment: Content of the experiment's TOML file: simulator, tuners, targets and budget.
        plan: The id of every run; None if unknown.

    Returns:
        The statuses as rows of status.csv.

    Raises:
        InputError: A check fails.
    """
    import pandas as pd

    plan_indices = list(statuses_by_index)

    def make_status_error(row: int, problem: str) -> InputError:
        return InputError(f"{path}, run {plan_indices[row]}: {problem}; {JOURNAL_REMEDY}")

    statuses = pd.DataFrame(
        [vars(status) for status in statuses_by_index.values()], columns=STATUS_COLUMN_NAMES
    )
    check_statuses(statuses, experiment, make_status_error)
    if plan is not None:
        expected = [plan[index] if index < len(plan) else "none" for index in plan_indices]
        check_equal(
            statuses["run"],
            pd.Series(expected, dtype=object),
            "run",
            "by plan.txt",
            make_status_error,
        )
    return statuses


def check_known(
    values: pd.Series, known_values: Iterable[str], column: str, make_error: RowErrorFactory
) -> None:
    """Reject values that the experiment does not define.

    Args:
        values: Values to check.
        known_values: Values that the experiment defines.
        column: Name of the quantity.
        make_error: Makes the error.

    Raises:
        InputError: There is an unknown value.
    """
    raise_for_first_bad_row(
        ~values.isin(list(known_values)),
        make_error,
        lambda row: (
            f"{column}: expected one of experiment.toml, found {format_value(values.iloc[row])}"
        ),
    )


def check_equal(
    found: pd.Series, expected: pd.Series, name: str, why: str, make_error: RowErrorFactory
) -> None:
    """Reject values that differ from the expected ones; two missing values are equal.

    Args:
        found: Values to check, with the index 0, 1, 2, ....
        expected: Expected values, with the same index.
        name: Name of the column.
        why: Reason for the expected values.
        make_error: Makes the error.

    Raises:
        InputError: A value differs.
    """
    is_different = found.to_numpy() != expected.to_numpy()
    raise_for_first_bad_row(
        is_different & ~(found.isna() & expected.isna()).to_numpy(),
        make_error,
        lambda i: f"{name}: expected {expected[i]} {why}, found {found[i]}",
    )


def raise_for_first_bad_row(
    bad: pd.Series | Mask, make_error: RowErrorFactory, describe_row: Callable[[int], str]
) -> None:
    """Raise an error for the first bad row.

    Args:
        bad: Mask of bad rows.
        make_error: Makes the error for the position of a row in this mask.
        describe_row: Describes what is wrong in a row.

    Raises:
        InputError: There is a bad row.
    """
    mask = np.asarray(bad, dtype=bool)
    if mask.any():
        row = int(mask.argmax())
        raise make_error(row, describe_row(row))
