"""Train learned tuners, here or in isolated processes, and cache their weights as arrays.

The name of a weights file contains a hash of everything that determines the weights: the code that
makes runs, source and options of the tuner and simulator, the training range and scenarios, budget,
seed, and the versions of the numerical packages (`runner.run_fingerprint`). The file contains the
same hash, so that an exchanged file is detected. Nothing is ever unpickled.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from bench.benchmark.isolation.process_errors import RunEndedError
from bench.benchmark.isolation.tuner_processes import TunerSpec, relocate, train_remotely
from bench.benchmark.problem.experiment_config import Experiment, TunerEntry
from bench.benchmark.problem.robot_experiment import get_simulator_class
from bench.benchmark.problem.training_simulator import CountedTrainingSimulator, RandomisedSimulator
from bench.benchmark.problem.tuning_problem import TuningProblem
from bench.benchmark.runner.retry_after_kill import RepeatedRequests, retry_if_killed
from bench.benchmark.runner.run_fingerprint import (
    IRRELEVANT_KEYS,
    compute_digest,
    hash_class_source,
    hash_effect_sources,
    hash_package_versions,
    hash_recording,
    hash_source_folders,
    select_relevant_keys,
)
from bench.benchmark.runner.trained_weights import (
    RETRAIN_ADVICE,
    TrainingResult,
    WeightsError,
    get_weights_folder,
    read_training_cost,
    read_weights,
    write_weights,
)
from bench.benchmark.runner.tuner_process_start import start_isolated_tuner
from bench.core.plugin_registries import tuners
from bench.core.random_streams import make_seed_words
from methods.tuner import TrainingCallback, Tuner
from sims.core.simulator import Array, InputError

TRAINING_IRRELEVANT_KEYS = {
    **IRRELEVANT_KEYS,
    "resolution": "rounds target observations only",
    "error_channel": "selects the reported error",
    "ranges": "describes the targets, which are used after the training",
    "targets": "describes the targets, which are used after the training",
    "same_targets_as": "describes the targets, which are used after the training",
    "held_out": "describes the targets, which are used after the training",
    "world": "simulates the targets; tuners train in the tuned simulator",
    "seeds": "number of trainings; each key covers its own seed",
    "budget": "limits a run, not a training",
    "timeout": "limits a run, not a training",
    "memory": "limits a run, not a training",
    "isolation": "applies to runs; a training always has its own process",
    "salt": "describes the targets, which are used after the training",
    "salt_sha256": "describes the targets, which are used after the training",
    "tuners": "each key covers its own tuner with its options",
}
"""Keys of an experiment that do not change trained weights, each with the reason."""


@dataclass(frozen=True)
class TrainingRequest:
    """Request of one training.

    Attributes:
        entry: tuner with its options.
        seed: seed of the training.
        tuned: specification with which an isolated process builds the tuner; None if the tuner is
            trusted and trains in this process.
        hidden: folders that this process must not access.
    """

    entry: TunerEntry
    seed: int
    tuned: TunerSpec | None = None
    hidden: tuple[str, ...] = ()

    def list_files(self) -> tuple[Path, ...]:
        """Return the files that another machine needs for the training."""
        return (Path(self.tuned.file),) if self.tuned and self.tuned.file else ()

    def relocate(self, new_paths: Mapping[Path, Path]) -> TrainingRequest:
        """Return the request with other paths of its files.

        Args:
            new_paths: new path of each file by its present path.
        """
        return self if self.tuned is None else replace(self, tuned=relocate(self.tuned, new_paths))


def train_or_load(
    experiment: Experiment,
    request: TrainingRequest,
    watch: TrainingCallback | None = None,
    anew: bool = False,
) -> TrainingResult:
    """Train a tuner, or find its weights in the cache.

    Args:
        experiment: configuration with the simulator and the training budget.
        request: request of the training.
        watch: training callback; None for none.
        anew: True to train even if there are weights, and to replace them.

    Returns:
        File of the weights and cost of the training.

    Raises:
        WeightsError: there is a file, but it is damaged or belongs to another training.
        RunEndedError: the tuner failed in its process.
    """
    requests = RepeatedRequests()
    return retry_if_killed(
        lambda: _train_or_read_weights(experiment, request, watch, anew, requests)
    )


def _train_or_read_weights(
    experiment: Experiment,
    request: TrainingRequest,
    callback: TrainingCallback | None,
    trains_anew: bool,
    requests: RepeatedRequests,
) -> TrainingResult:
    """Train the tuner of a request, or check its weights in the cache; see `train_or_load`.

    A trusted tuner trains in this process, others in an isolated one. The weights are written with
    the cost of the training and its key.

    Args:
        experiment: experiment with simulator, training ranges and budget.
        request: names the tuner's entry and the seed, and how to build the tuner in isolation.
        callback: gets the losses of each epoch.
        trains_anew: train even if the cache has the weights.
        requests: simulations that were requested before an external kill; a repetition must
            request the same.

    Returns:
        File of the weights and cost of the training; for weights of the cache the cost that is
        stored with them.
    """
    # The requests of this attempt are compared with the recorded ones from the first one on.
    requests.restart()
    entry, seed = request.entry, request.seed
    training_key = compute_training_key(experiment, entry, seed)
    path = get_weights_folder() / f"{training_key}.npz"
    if path.exists() and not trains_anew:
        cached = read_training_cost(path)
        # Weights that do not fit must be reported now, and not in every run.
        _check_weights(request, path)
        return cached
    problem = TuningProblem(experiment)
    # Tuners with the same `trains_as` share a random stream, so that they have the same network.
    stream = make_seed_words(
        experiment.name, "fit", tuners.get(entry.tuner).trains_as or entry.tuner, seed
    )
    randomised_simulator = RandomisedSimulator(problem) if entry.randomised else None
    simulator = CountedTrainingSimulator(
        problem, experiment.training_budget, randomised_simulator, requests.check
    )
    started = perf_counter()
    state = _train(request, simulator, stream, callback)
    seconds = perf_counter() - started
    problem.close()
    if randomised_simulator is not None:
        randomised_simulator.close()
    return write_weights(path, state, simulator.used, seconds)


def _train(
    request: TrainingRequest,
    simulator: CountedTrainingSimulator,
    stream: NDArray[np.uint32],
    callback: TrainingCallback | None,
) -> Mapping[str, Array]:
    """Train a tuner, and return its weights.

    A trusted tuner trains in this process, others in an isolated one; this process simulates.

    Args:
        request: tuner and seed of the training.
        simulator: training simulator that counts its simulations.
        stream: words of the seed of the random stream.
        callback: receives the progress; None for no progress.

    Returns:
        Trained arrays by name.
    """
    # A request without the specification of an isolated tuner is that of a trusted one.
    if request.tuned is None:
        trusted_tuner = build_tuner(request.entry)
        trusted_tuner.watch = callback
        trusted_tuner.fit(simulator, np.random.default_rng(stream), simulator.budget)
        return trusted_tuner.state()
    with start_isolated_tuner(request.tuned, request.seed, "run", request.hidden) as tuner:
        return train_remotely(tuner.child, simulator, stream, callback)


def compute_training_key(experiment: Experiment, entry: TunerEntry, seed: int) -> str:
    """Return the key of a training: a name with a hash of everything that determines the weights.

    It is the name of the file of the weights, so that weights are reused only by an equal training.

    Args:
        experiment: configuration with the simulator, the training range and the training budget.
        entry: tuner with its options.
        seed: seed of the training.

    Raises:
        InputError: the source of the tuner or the simulator cannot be found.
    """
    simulator = get_simulator_class(experiment)
    hashed = compute_digest(
        select_relevant_keys(experiment, TRAINING_IRRELEVANT_KEYS),
        hash_recording(experiment),
        entry.tuner,
        dict(entry.options),
        seed,
        [hash_class_source(tuners.get(entry.tuner)), hash_class_source(simulator)],
        hash_effect_sources(experiment.settings),
        hash_source_folders(),
        hash_package_versions(),
        # Effects with random coefficients act only if the entry trains with them.
        *([dict(experiment.nuisance)] if entry.randomised else []),
        length=16,
    )
    return f"{entry.tuner}-{experiment.simulator}-{seed}-{hashed}"


def _check_weights(request: TrainingRequest, path: Path) -> None:
    """Restore the tuner from stored weights, to raise an error if it does not accept them.

    The code of a tuner that is not trusted runs in an isolated process.

    Args:
        request: tuner, and how to build it in isolation.
        path: file of the weights.

    Raises:
        WeightsError: the tuner does not accept the weights.
    """
    # A trusted tuner has no specification for an isolated process.
    if request.tuned is None:
        load_trained_tuner(request.entry, path)
        return
    try:
        # The tuner restores the weights when it is started, so nothing is left to do in the block.
        with start_isolated_tuner(
            request.tuned, request.seed, "run", request.hidden, state=read_weights(path)
        ):
            return
    except RunEndedError as ended:
        last_line = ended.reason.strip().splitlines()[-1:]
        raise _make_weights_error(path, request.entry, "".join(last_line)) from None


def _make_weights_error(path: Path, entry: TunerEntry, reason: object) -> WeightsError:
    return WeightsError(f"{path}: not the weights of {entry.label}: {reason}; {RETRAIN_ADVICE}")


def load_trained_tuner(entry: TunerEntry, path: Path) -> Tuner:
    """Build the tuner of an entry, and load its weights.

    Raises:
        WeightsError: the file is missing, damaged, or of another training.
    """
    tuner = build_tuner(entry)
    try:
        tuner.restore(read_weights(path))
    except ValueError as error:
        raise _make_weights_error(path, entry, error) from None
    return tuner


def build_tuner(entry: TunerEntry) -> Tuner:
    """Build the tuner of an entry with its options.

    Raises:
        InputError: the tuner does not have an option, or refuses its value.
    """
    tuner_class = tuners.get(entry.tuner)
    try:
        return tuner_class(**entry.options)
    # Python raises a TypeError for an unknown option, and tuners a ValueError for a bad value.
    except (TypeError, ValueError) as error:
        raise InputError(f"tuner {entry.label}: {error}") from None
