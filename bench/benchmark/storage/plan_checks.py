"""List the targets, seeds and runs of an experiment, and check plans for completeness."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bench.benchmark.problem.experiment import Experiment
from bench.benchmark.problem.tuner_entries import TunerEntry
from bench.benchmark.storage.row_errors import (
    TableErrorFactory,
    check_known,
    raise_for_first_bad_row,
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
    """Check that a plan belongs to an experiment and is complete.

    Args:
        plan: The id of every run.
        experiment: The experiment.
        path: Path of the plan.
        remedy: Advice for a damaged plan.

    Raises:
        InputError: A check fails.
    """
    import pandas as pd

    def make_line_error(row: int | None, problem: str) -> InputError:
        place = "" if row is None else f", line {row + 1}"
        return InputError(f"{path}{place}: {problem}; {remedy}")

    rows = []
    for row, name in enumerate(plan):
        parts = name.rsplit("/", 3)
        if len(parts) != 4 or not _SEED_PATTERN.fullmatch(parts[2]):
            raise make_line_error(
                row, f"expected TUNER/TARGET/SEED/HASH, found {format_value(name)}"
            )
        rows.append((name, parts[0], parts[1], int(parts[2])))
    plan_table = pd.DataFrame(rows, columns=["run", "tuner", "target", "seed"])
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

    Args:
        executed_runs: Tuner, target and seed of each run; the index is the row in the file.
        experiment: The experiment.
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

    It equals `bench.benchmark.runner.experiment_runner.count_seeds` if the tuner is known.
    """
    seed_count = entry.seeds or experiment.seeds
    if seed_count == 1 or largest > 0:
        return seed_count
    # A single seed is correct for a deterministic tuner. The tuner is loaded only now, since it may
    # import large packages.
    try:
        kind = tuners.get(entry.tuner)
    except InputError:  # A tuner of a plugin that is not loaded or cannot be used here.
        return 1
    return seed_count if kind.stochastic or kind.learned else 1
