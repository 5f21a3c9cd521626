"""Folder of a comparison: configuration, versions, machine, and statuses of runs."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from bench import __version__
from bench.benchmark.problem.experiment_config import Experiment, parse_experiment
from bench.benchmark.problem.targets import Redraws
from bench.benchmark.storage.provenance import describe_machine, get_utc_time, list_package_versions
from bench.benchmark.storage.result_file_consistency import check_files, check_table
from bench.benchmark.storage.run_journal import SEGMENTS_FOLDER, RunJournal, read_plan
from bench.benchmark.storage.run_status import STATUS_COLUMN_NAMES
from bench.benchmark.storage.table_schemas import (
    ENVIRONMENT_KEYS,
    OPTIONAL_ENVIRONMENT_KEYS,
    RUN_COLUMNS,
    STATUS_COLUMNS,
    Columns,
)
from sims.core.files import (
    atomic_new_folder,
    atomic_replacement,
    check_folder_empty,
    get_first_line,
    make_timestamped_path,
    write_atomically,
)
from sims.core.simulator import InputError
from sims.core.toml_validation import check_entries, format_value, read_toml, to_toml_value
from sims.engines.engine_lookup import describe_stepping

if TYPE_CHECKING:
    import pandas as pd


CONFIGURATION_FILE = "experiment.toml"
"""Name of the file that identifies the folder of a study."""
SALT_FILE = "salt"
"""Name of the file of a secret salt, in the folder of segments."""
DEFAULT_RESULTS_FOLDER = Path("results")
"""Default parent folder of new results."""


def choose_free_folder(experiment: Experiment, out: Path | None) -> Path:
    """Choose the folder of a new study.

    Args:
        experiment: Content of the experiment's TOML file: simulator, tuners, targets and budget.
        out: Wanted folder; None for a folder in results/ named after the experiment and the time.

    Raises:
        InputError: `out` exists and is not empty.
    """
    folder = out or make_timestamped_path(DEFAULT_RESULTS_FOLDER, experiment.name)
    try:
        check_folder_empty(folder)
    except InputError as error:
        raise InputError(f"{error}, or resume what is in it") from None
    return folder


class FolderConfiguration(NamedTuple):
    """Configuration of a study's folder.

    Attributes:
        experiment: The exact configuration of the experiment.
        plugins: Plugin files that it needs.
        fingerprint: Hashes of what must not change until the study is complete.
        isolation_layers: Isolation layers that were available for its tuners when it was started.
    """

    experiment: Experiment
    plugins: list[str]
    fingerprint: dict[str, str]
    isolation_layers: tuple[str, ...] = ()


def create_folder(
    folder: Path,
    configuration: FolderConfiguration,
    jobs: int,
    secret: str | None = None,
    seals: Sequence[str] = (),
    redraws: Redraws | None = None,
) -> None:
    """Make the folder with experiment.toml and environment.json, all at once or not at all.

    A secret salt is written to a file that only its owner can read; the file is deleted when the
    study is complete.

    Args:
        folder: Path of a new or empty folder.
        configuration: Its configuration.
        jobs: Planned number of worker processes.
        secret: Salt from which its targets are drawn; see `bench.benchmark.storage.secret_salt`.
        seals: Isolation layers that are available for its tuners on this machine.
        redraws: Number of targets that were drawn again; None for studies without such targets.

    Raises:
        InputError: The folder cannot be made.
    """
    experiment = configuration.experiment
    environment = {
        "simgap": __version__,
        "experiment": experiment.name,
        "plugins": [str(Path(p).resolve()) for p in configuration.plugins],
        "jobs": jobs,
        "seals": list(seals),
        "started": get_utc_time(),
        **describe_machine(),
        "fingerprint": configuration.fingerprint,
        "stepping": describe_stepping(),
        "packages": list_package_versions(),
    }
    if redraws is not None:
        environment |= {"redrawn_targets": redraws.redrawn, "target_draws": redraws.draws}
    try:
        # An interrupted start must not leave a folder without its configuration.
        with atomic_new_folder(folder) as partial:
            write_configuration(partial, experiment)
            write_atomically(partial / "environment.json", json.dumps(environment, indent=1) + "\n")
            (partial / SEGMENTS_FOLDER).mkdir()
            if secret is not None:
                _write_private_file(partial / SEGMENTS_FOLDER / SALT_FILE, secret)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror})") from None


def _write_private_file(path: Path, secret: str) -> None:
    """Write a file that only its owner can read."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with os.fdopen(descriptor, "w", encoding="utf-8") as file:
        file.write(secret)


def write_configuration(folder: Path, experiment: Experiment) -> None:
    """Write experiment.toml completely or not at all."""
    import tomli_w

    write_atomically(
        folder / CONFIGURATION_FILE, tomli_w.dumps(to_toml_value(experiment.document()))
    )


def read_configuration(folder: Path) -> FolderConfiguration:
    """Read the configuration of a comparison's folder.

    Raises:
        InputError: It is not such a folder, or a file in it is damaged.
    """
    path = folder / CONFIGURATION_FILE
    if not path.is_file():
        raise InputError(
            f"{folder}: expected the folder of a comparison with {CONFIGURATION_FILE} in it, "
            "found none"
        )
    environment = read_environment(folder)
    experiment = parse_experiment(str(environment["experiment"]), read_toml(path), path)
    # Folders of older versions lack some of the hashes and the isolation layers.
    return FolderConfiguration(
        experiment,
        list(environment["plugins"]),
        dict(environment.get("fingerprint", {})),
        tuple(environment.get("seals", ())),
    )


def read_environment(folder: Path) -> dict[str, Any]:
    """Read and check environment.json; undeclared keys are left out.

    Returns:
        Values by key, see `ENVIRONMENT_KEYS`: versions, machine, plugin files and hashes.

    Raises:
        InputError: It is damaged.
    """
    path = folder / "environment.json"
    problem, remedy = f"{path}: not a complete comparison", "restore it, or start a new comparison"
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{problem}: {get_first_line(error)}; {remedy}") from None
    if not isinstance(document, dict):
        raise InputError(f"{problem}: expected a table, found {format_value(document)}; {remedy}")
    for key in ENVIRONMENT_KEYS:
        if key not in document and key not in OPTIONAL_ENVIRONMENT_KEYS:
            raise InputError(f"{problem}: expected a key {key}, found none; {remedy}")
    entries = {key: value for key, value in document.items() if key in ENVIRONMENT_KEYS}
    # On some systems the number of processors is unknown.
    if entries["processors"] is None:
        del entries["processors"]
    try:
        return check_entries(path, "", entries, ENVIRONMENT_KEYS)
    except InputError as error:
        raise InputError(f"{error}; {remedy}") from None


def write_results(
    folder: Path,
    journal: RunJournal,
    trainings: Iterable[tuple[str, int, int, float]],
    skipped: Iterable[Mapping[str, Any]],
    trusted: bool = False,
) -> None:
    """Write runs.parquet, training.csv and status.csv in the order of the plan.

    Each file is written completely or not at all.

    Args:
        folder: Folder of the comparison.
        journal: Its finished runs.
        trainings: Tuner, seed, simulations and seconds of each training.
        skipped: Rows of status.csv for tuners that could not be used.
        trusted: Whether the tuners ran without isolation.
    """
    import pandas as pd
    import pyarrow as pa
    from pyarrow import parquet

    with atomic_replacement(folder / "runs.parquet") as partial:
        writer = None
        for _, rows in journal.iterate_tables():
            # The first table defines the columns.
            writer = writer or parquet.ParquetWriter(partial, rows.schema, compression="zstd")
            writer.write_table(rows)
        # Without any run there are no columns, but the file must exist.
        if writer is None:
            parquet.write_table(pa.table({}), partial)
        else:
            writer.close()
    training = pd.DataFrame(sorted(trainings), columns=["tuner", "seed", "simulations", "seconds"])
    training["trusted"] = trusted
    write_atomically(folder / "training.csv", training.to_csv(index=False))
    # The statuses are stored by index in the plan.
    rows_of_statuses = [
        asdict(journal.statuses[index]) for index in sorted(journal.statuses)
    ] + list(skipped)
    statuses = pd.DataFrame(rows_of_statuses, columns=STATUS_COLUMN_NAMES)
    write_atomically(folder / "status.csv", statuses.to_csv(index=False))


class StoredComparison(NamedTuple):
    """A comparison read from its folder.

    Attributes:
        experiment: The experiment.
        runs: Rows of runs.parquet.
        statuses: Rows of status.csv.
        costs: (simulations, seconds) of one training, by tuner.
        spectra: Rows of identifiability.csv; None if there is no such file.
    """

    experiment: Experiment
    runs: pd.DataFrame
    statuses: pd.DataFrame
    costs: dict[str, tuple[float, float]]
    spectra: pd.DataFrame | None = None


def read_comparison(folder: Path, columns: Sequence[str] | None = None) -> StoredComparison:
    """Read and check the folder of a finished or interrupted comparison.

    Columns that a folder of an older version lacks get their default values.

    Args:
        folder: Folder of the comparison.
        columns: Columns of the runs to read, if present; a name that ends with an underscore stands
            for all that begin with it; None for all.

    Raises:
        InputError: A file is missing or violates `storage.table_schemas`, or runs are missing.
    """
    from pyarrow import parquet

    experiment = read_configuration(folder).experiment
    path = folder / "runs.parquet"
    # The segments, the plan and the journal of finished runs, are deleted when all is complete.
    is_unfinished = (folder / SEGMENTS_FOLDER).exists()
    # The study was killed before its first results were written, so nothing is damaged.
    if not path.exists() and is_unfinished:
        raise InputError(
            f"{folder}: not finished, and no tables are written yet; resume it to run what is "
            "missing"
        )
    plan = read_plan(folder) if is_unfinished else None
    files = check_files(folder, experiment, is_unfinished=is_unfinished, plan=plan)
    stored_names = parquet.read_schema(path).names
    prefixes = tuple(name for name in columns or () if name.endswith("_"))
    read_names = [
        name
        for name in stored_names
        if columns is None or name in columns or name.startswith(prefixes)
    ]
    # `check_files` has reduced its rows to one line per run; here all rows are read.
    runs = parquet.read_table(path, columns=read_names).to_pandas()
    # A file without runs has no columns, and none are added.
    return StoredComparison(
        experiment,
        _add_missing_columns(runs, RUN_COLUMNS, columns) if stored_names else runs,
        _add_missing_columns(files.statuses, STATUS_COLUMNS),
        _compute_training_costs(files.training),
        files.spectra,
    )


def read_checked_comparison(folder: Path) -> StoredComparison:
    """Read and check a comparison as `read_comparison` does, and also check table.csv.

    Raises:
        InputError: A file in the folder is damaged.
    """
    stored = read_comparison(folder)
    check_table(folder)
    return stored


def _add_missing_columns(
    frame: pd.DataFrame, declared: Columns, selected: Sequence[str] | None = None
) -> pd.DataFrame:
    """Add columns that a folder of an older version lacks, filled with their declared default.

    Args:
        frame: Table that has been read.
        declared: Declared columns; those without a default are not added.
        selected: Names of the columns that are used; None for all.
    """
    missing = {
        column.name: column.default
        for column in declared
        if column.default is not None
        and column.name not in frame
        and (selected is None or column.name in selected)
    }
    return frame.assign(**missing)


def _compute_training_costs(training: pd.DataFrame) -> dict[str, tuple[float, float]]:
    """Compute simulations and seconds of one training, mean over seeds, by tuner."""
    mean_costs = training.groupby("tuner")[["simulations", "seconds"]].mean()
    return {
        str(tuner): (float(simulations), float(seconds))
        for tuner, simulations, seconds in mean_costs.itertuples()
    }
