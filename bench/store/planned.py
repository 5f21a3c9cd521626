"""What an experiment asks for: targets, seeds, runs; and that a plan is one of it, and whole."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bench.problem.entries import Entry
from bench.problem.experiment import Experiment
from bench.registry import tuners
from bench.store.faults import MaybeFault, check_known, refuse
from sims.base import InputError
from sims.user_toml import shown

if TYPE_CHECKING:
    import pandas as pd

_SEED = re.compile("[0-9]{1,9}")


def targets_of(experiment: Experiment) -> list[str]:
    """The names of all targets of an experiment."""
    return [f"{kind}-{i:03d}" for i in range(experiment.targets) for kind in experiment.ranges]


def labels_of(experiment: Experiment) -> list[str]:
    """The labels of its tuners."""
    return [entry.label for entry in experiment.tuners]


def check_plan(plan: Sequence[str], experiment: Experiment, path: Path, remedy: str) -> None:
    """See that a plan is one of the experiment, and whole.

    Args:
        plan: the id of every run.
        experiment: what is compared.
        path: of the plan.
        remedy: what to do where it is damaged.

    Raises:
        InputError: something does not hold.
    """
    import pandas as pd

    def at(row: int | None, says: str) -> InputError:
        place = "" if row is None else f", line {row + 1}"
        return InputError(f"{path}{place}: {says}; {remedy}")

    rows = []
    for row, name in enumerate(plan):
        parts = name.rsplit("/", 3)
        if len(parts) != 4 or not _SEED.fullmatch(parts[2]):
            raise at(row, f"expected TUNER/TARGET/SEED/HASH, found {shown(name)}")
        rows.append((name, parts[0], parts[1], int(parts[2])))
    planned = pd.DataFrame(rows, columns=["run", "tuner", "target", "seed"])
    names = planned["run"]
    refuse(names.duplicated(), at, lambda row: f"expected every run once, found {names[row]} again")
    check_known(planned["tuner"], labels_of(experiment), "tuner", at)
    check_known(planned["target"], targets_of(experiment), "target", at)
    check_complete(planned, experiment, at)


def check_complete(made: pd.DataFrame, experiment: Experiment, fault: MaybeFault) -> None:
    """See that no run is missing of a tuner that has some, and that none is one too many.

    Args:
        made: tuner, target and seed of each; the index is the row in the file.
        experiment: what was compared.
        fault: makes the error for a row, or for the file.
    """
    targets = targets_of(experiment)
    for entry in experiment.tuners:
        mine = made[made["tuner"] == entry.label]
        if mine.empty:
            continue
        seeds = range(_seeds(entry, experiment, mine["seed"].max()))
        found = set(zip(mine["target"], mine["seed"].tolist(), strict=True))
        missing = next(((t, s) for t in targets for s in seeds if (t, s) not in found), None)
        if missing:
            target, seed = missing
            says = f"expected a run of {entry.label} on {target} with seed {seed}, found none"
            raise fault(None, says)
        if len(mine) > len(targets) * len(seeds):
            twice = mine.duplicated(["target", "seed"]) | (mine["seed"] >= len(seeds))
            row = int(mine.index[int(twice.to_numpy().argmax())])
            raise fault(
                row,
                f"run: expected {len(targets)} targets with {len(seeds)} seeds, "
                f"found one more: {mine['run'][row]}",
            )


def _seeds(entry: Entry, experiment: Experiment, largest: int) -> int:
    """How many seeds an entry runs; as `bench.runs.runner.seeds_of`, where its tuner is known."""
    wanted = entry.seeds or experiment.seeds
    if wanted == 1 or largest > 0:
        return wanted
    # One seed is right for a tuner without chance. Only now, for a tuner may import much.
    try:
        kind = tuners.get(entry.tuner)
    except InputError:  # of a plugin that is not loaded, or cannot be used here
        return 1
    return wanted if kind.stochastic or kind.learned else 1
