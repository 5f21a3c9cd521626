"""Train diagnosers, cache the results in the user's cache folder, and store costs in training.csv.

The cache key contains everything that the result depends on.
"""

from __future__ import annotations

import csv
import io
import json
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.benchmark.isolation.tuner_processes import TunerSpec
from bench.benchmark.runner.code_digest import (
    compute_digest,
    hash_package_versions,
    hash_source_folders,
)
from bench.benchmark.runner.tuner_process_reuse import retry_if_killed
from bench.benchmark.runner.tuner_training import get_weights_folder
from bench.core.random_streams import make_seed_words
from bench.diagnosis_benchmark.case_evaluation import train_isolated
from sims.core.files import atomic_replacement, write_atomically

CACHE_SUBFOLDER = "diagnosers"
"""Subfolder of the cache of trained weights."""
TRAINING_SOURCE_FOLDERS = (
    "sims",
    "bench/benchmark/isolation",
    "bench/diagnosis",
    "bench/logs",
    "bench/diagnosis_benchmark/diagnosers",
)
"""Source folders that determine the result of a training."""


class TrainedDiagnoser(NamedTuple):
    """Result of training a diagnoser for a system.

    Attributes:
        path: file with the trained arrays.
        simulations: number of simulations that the training used.
        seconds: time that the training took.
        found: whether the result was already in the cache.
    """

    path: Path
    simulations: int
    seconds: float
    found: bool


def train_or_load(
    code: TunerSpec,
    source: str,
    system: str,
    budget: int,
    seconds: float,
    hidden: tuple[str, ...],
    trusted: bool,
) -> TrainedDiagnoser:
    """Train a diagnoser for a system, or load the cached result.

    The file name in the cache contains a hash of everything that determines the result. The arrays
    are written before their cost, so that a file with a cost belongs to a complete training.

    Args:
        code: where its code is.
        source: hash of its code.
        system: name of the system, such as ``pendulum``.
        budget: maximum number of simulations.
        seconds: maximum time.
        hidden: folders that the diagnoser's process must not read.
        trusted: whether the diagnoser runs in this process.

    Raises:
        RunEndedError: the training failed.
    """
    key = compute_digest(
        code.name,
        source,
        system,
        budget,
        hash_source_folders(TRAINING_SOURCE_FOLDERS),
        hash_package_versions(),
        length=20,
    )
    path = get_weights_folder() / CACHE_SUBFOLDER / f"{code.name}-{system}-{key}.npz"
    cost_file = path.with_suffix(".json")
    if (cost := _read_training_cost(cost_file)) is not None and zipfile.is_zipfile(path):
        return TrainedDiagnoser(path, *cost, found=True)
    training_request: dict[str, Any] = {
        "wanted": {"name": code.name, "module": code.module, "file": code.file},
        "system": system,
        "budget": budget,
        "seed": make_seed_words("diagnosis", "lesson", code.name, system).tolist(),
    }
    arrays, used_simulations, spent_seconds = retry_if_killed(
        lambda: train_isolated(code, training_request, seconds, hidden, trusted)
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_replacement(path, keep_ending=True) as partial:
        named_arrays: dict[str, Any] = dict(arrays)
        np.savez_compressed(partial, **named_arrays)
    with atomic_replacement(cost_file) as partial:
        partial.write_text(json.dumps([used_simulations, spent_seconds]), encoding="utf-8")
    return TrainedDiagnoser(path, used_simulations, spent_seconds, found=False)


def _read_training_cost(path: Path) -> tuple[int, float] | None:
    """Read the cost of a cached training.

    Args:
        path: JSON file next to the trained arrays.

    Returns:
        Number of simulations and seconds; None if the file is missing or damaged, so that the
        diagnoser is trained again.
    """
    try:
        used_simulations, seconds = json.loads(path.read_text(encoding="utf-8"))
        return int(used_simulations), float(seconds)
    except (OSError, ValueError, TypeError):
        return None


TRAINING_COSTS_FILE = "training.csv"
TRAINING_COST_COLUMNS = ("diagnoser", "system", "simulations", "seconds", "fault")


class TrainingCost(NamedTuple):
    """Cost of training one diagnoser for one system.

    Attributes:
        diagnoser: label of the diagnoser.
        system: name of the system.
        simulations: number of simulations used.
        seconds: elapsed time.
        fault: error message if the training failed, otherwise empty.
    """

    diagnoser: str
    system: str
    simulations: int
    seconds: float
    fault: str = ""


def write_training_costs(folder: Path, costs: Iterable[TrainingCost]) -> None:
    """Write training.csv; write no file if no diagnoser was trained.

    Args:
        folder: result folder.
        costs: training costs, one per diagnoser and system.
    """
    rows = [cost._asdict() for cost in costs]
    if not rows:
        return
    text = io.StringIO()
    writer = csv.DictWriter(text, TRAINING_COST_COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(folder / TRAINING_COSTS_FILE, text.getvalue())


def read_training_costs(folder: Path) -> list[dict[str, str]]:
    """Read the rows of training.csv; return an empty list if the file does not exist."""
    path = folder / TRAINING_COSTS_FILE
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))
