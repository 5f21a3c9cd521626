"""Train diagnosers, cache the results in the user's cache folder, and store costs in training.csv.

The cache key contains everything that the result depends on.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

from bench.benchmark.isolation.message_channel import (
    MAX_STATE_BYTES,
    MessageKind,
    ProtocolError,
    unpack_arrays,
)
from bench.benchmark.isolation.tuner_processes import TunerSpec
from bench.benchmark.runner.retry_after_kill import retry_if_killed
from bench.benchmark.runner.run_fingerprint import (
    compute_digest,
    hash_package_versions,
    hash_source_folders,
)
from bench.benchmark.runner.trained_weights import (
    TrainingResult,
    WeightsError,
    get_weights_folder,
    read_training_cost,
    write_weights,
)
from bench.core.random_streams import make_seed_words
from bench.diagnosis_benchmark import diagnoser_process
from bench.diagnosis_benchmark.diagnoser_process import start_diagnoser_process
from sims.core.files import write_atomically
from sims.core.simulator import Array

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


def train_or_load(
    code: TunerSpec,
    source: str,
    system: str,
    budget: int,
    seconds: float,
    hidden: tuple[str, ...],
    trusted: bool,
) -> TrainingResult:
    """Train a diagnoser for a system, or load the cached result.

    The file name in the cache contains a hash of everything that determines the result. A damaged
    file is replaced.

    Args:
        code: name of the diagnoser, and the module or plugin file of its code.
        source: hash of its code.
        system: name of the system, such as ``pendulum``.
        budget: maximum number of simulations.
        seconds: maximum time.
        hidden: folders that the diagnoser's process must not read.
        trusted: whether the diagnoser runs in this process.

    Returns:
        Path of the file with the trained arrays, and the simulations and seconds that the training
        used when it ran.

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
    with suppress(WeightsError):  # missing, damaged or of another training: train
        return read_training_cost(path)
    training_request: dict[str, Any] = {
        "wanted": code.describe(),
        "system": system,
        "budget": budget,
        "seed": make_seed_words("diagnosis", "lesson", code.name, system).tolist(),
    }
    arrays, used_simulations, spent_seconds = retry_if_killed(
        lambda: train_isolated(code, training_request, seconds, hidden, trusted)
    )
    return write_weights(path, arrays, used_simulations, spent_seconds)


def train_isolated(
    code: TunerSpec, request: dict[str, Any], seconds: float, hidden: tuple[str, ...], trusted: bool
) -> tuple[dict[str, Array], int, float]:
    """Train a diagnoser for a system, in an isolated process unless it is trusted.

    A message has a kind of one letter. The process gets the request in a message of kind F, and
    answers with kind L: the trained arrays and, as one more array, the number of simulations.

    Args:
        code: name of the diagnoser, and the module or plugin file of its code.
        request: ``wanted`` (the content of `code` as JSON), ``system``, ``budget`` (maximum number
            of simulations) and ``seed``.
        seconds: maximum time.
        hidden: folders that the diagnoser must not read.
        trusted: whether it runs in this process.

    Returns:
        The trained arrays, the number of simulations and the seconds used.

    Raises:
        RunEndedError: the training failed.
    """
    started_at = perf_counter()
    if trusted:
        arrays, used_simulations = diagnoser_process.train_diagnoser(request)
        return dict(arrays), used_simulations, perf_counter() - started_at
    child = start_diagnoser_process(code, memory=0, hidden=hidden)  # memory is not limited
    try:
        deadline = started_at + seconds
        child.send(MessageKind.FIT, json.dumps(request).encode(), deadline=deadline)
        message = child.receive(MAX_STATE_BYTES, deadline)
        try:
            if message.kind != MessageKind.WEIGHTS:
                raise ProtocolError("it has no training result")
            trained_arrays = unpack_arrays(message.body)
            used_simulations = int(trained_arrays.pop("simulations")[0])
        except (ProtocolError, KeyError, ValueError) as error:
            raise child.fail_with_protocol_error(f"{error}") from None
        return trained_arrays, used_simulations, perf_counter() - started_at
    finally:
        child.end()


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
