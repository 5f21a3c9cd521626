"""Check the consistency between the files of a comparison, and with the plan of its runs."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bench.benchmark.problem.experiment import Experiment
from bench.benchmark.problem.experiment_tables import TunerEntry
from bench.benchmark.storage.cell_validation import (
    RowErrorFactory,
    TableErrorFactory,
    check_equal,
    check_known,
    raise_for_first_bad_row,
)
from bench.benchmark.storage.csv_reader import CsvTable, RunsTable
from bench.benchmark.storage.run_journal import JOURNAL_REMEDY
from bench.benchmark.storage.run_status import STATUS_COLUMN_NAMES, RunStatus
from bench.benchmark.storage.table_schemas import (
    ERROR_TABLE_COLUMNS,
    IDENTIFIABILITY_COLUMNS,
    STATUS_COLUMNS,
    TRAINING_COLUMNS,
    ColumnSpec,
    expand_columns,
)
from bench.core.plugin_registries import tuners
from sims.core.simulator import InputError
from sims.core.toml_validation import format_value

if TYPE_CHECKING:
    import pandas as pd


_SEED_PATTERN = re.compile("[0-9]{1,9}")


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
        executed = set(zip(tuner_rows["target"], tuner_rows["seed"].tolist(), strict=True))
        missing = next(((t, s) for t in targets for s in seeds if (t, s) not in executed), None)
        if missing:
            target, seed = missing
            problem = f"expected a run of {entry.label} on {target} with seed {seed}, found none"
            raise make_error(None, problem)
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
    """Return the number of seeds of an entry; `largest` is the largest seed in its planned runs.

    A deterministic tuner has one seed, whatever the experiment states. If more than one seed
    occurs, the tuner is not deterministic, and need not be loaded to find out. The result equals
    `bench.benchmark.runner.experiment_runner.count_seeds` if the tuner is known.
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


class CheckedFiles(NamedTuple):
    """The files of a comparison with stored runs, checked cell by cell.

    Attributes:
        runs: One line per run; see `bench.benchmark.storage.csv_reader.RunsTable.runs`.
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

    The tables are checked alone first, then against each other and against the plan of runs.

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
