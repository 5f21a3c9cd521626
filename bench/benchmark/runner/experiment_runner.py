"""Run an experiment: tuners x targets x seeds, in worker processes or in this process.

Every run is stored as soon as it has ended.
"""

from __future__ import annotations

import math
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from bench.benchmark.isolation.linux_syscalls import not_dumpable
from bench.benchmark.isolation.process_errors import RunEndedError
from bench.benchmark.isolation.resource_limits import import_resource_module
from bench.benchmark.isolation.tuner_processes import TunerSpec
from bench.benchmark.problem.experiment_config import Experiment, TunerEntry
from bench.benchmark.problem.fisher_information import InformationSpectrum, compute_target_spectrum
from bench.benchmark.problem.targets import Redraws, Target, count_redraws, draw_targets
from bench.benchmark.problem.tuning_problem import TuningProblem, numeric_warnings_silenced
from bench.benchmark.runner.plugin_inspection import (
    check_classes_importable,
    describe_plugins,
    must_build_isolated,
)
from bench.benchmark.runner.run_fingerprint import RunIds
from bench.benchmark.runner.run_in_worker import (
    RunOutcome,
    RunRequest,
    execute_run,
    make_unfinished_outcome,
)
from bench.benchmark.runner.run_result_rows import build_rows, make_status
from bench.benchmark.runner.trained_weights import TrainingResult, WeightsError
from bench.benchmark.runner.tuner_author_notes import Notes
from bench.benchmark.runner.tuner_process_start import make_tuner_spec
from bench.benchmark.runner.tuner_training import TrainingRequest, build_tuner, train_or_load
from bench.benchmark.runner.worker_pools import (
    Call,
    Pool,
    PoolLostError,
    WorkerDiedError,
    make_pool,
)
from bench.benchmark.storage.run_journal import RunJournal
from bench.benchmark.storage.run_status import RunStatus
from bench.core.plugin_registries import PartUnavailableError, tuners
from sims.core.simulator import InputError

ProgressFactory = Callable[[str, int], Callable[[], None]]
"""Function that gets a title and a number of steps.

It returns a function that is called after each step.
"""


def no_progress(_title: str, _steps: int) -> Callable[[], None]:
    """Ignore progress."""
    return lambda: None


class MemoryRunSink:
    """Storage of finished runs in memory, by their index in the plan."""

    def __init__(self) -> None:
        self.columns: dict[int, Mapping[str, Any]] = {}
        self.statuses: dict[int, RunStatus] = {}

    def append(self, plan_index: int, columns: Mapping[str, Any], status: RunStatus) -> None:
        """Store the rows and the status of a finished run.

        Args:
            plan_index: index of the run in the plan.
            columns: rows of runs.parquet, by column.
            status: status of the run.
        """
        self.columns[plan_index], self.statuses[plan_index] = columns, status


@dataclass
class ExperimentRun:
    """A comparison while it is running: its problem, plan, stored runs and trainings.

    Attributes:
        problem: tuning problem.
        run_sink: storage of finished runs.
        plan: all runs.
        trainings: result of each training, by tuner label and seed.
        spectra: Fisher-information spectrum by target name, if it can be computed.
        skipped: reason by label of each tuner that cannot be used.
        tuned: specification by label of each tuner that runs in an isolated process.
        hidden_paths: paths that isolated processes must not access.
        redraws: number of targets that were drawn again.
        interrupted: whether the user interrupted the comparison.
        stopped: why the comparison stopped early; empty if it did not.
        notes: notes for the authors of tuners, from the runs of this process.
    """

    problem: TuningProblem
    run_sink: MemoryRunSink | RunJournal = field(default_factory=MemoryRunSink)
    plan: list[PlannedRun] = field(default_factory=list)
    trainings: dict[tuple[str, int], TrainingResult] = field(default_factory=dict)
    spectra: dict[str, InformationSpectrum] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    tuned: dict[str, TunerSpec] = field(default_factory=dict)
    hidden_paths: tuple[str, ...] = ()
    redraws: Redraws | None = None
    interrupted: bool = False
    stopped: str = ""
    notes: Notes = field(init=False)

    def __post_init__(self) -> None:
        self.notes = Notes(self.problem.experiment.isolation)

    def build_training_rows(self) -> list[tuple[str, int, int, float]]:
        """Return rows of training.csv: tuner, seed, simulations, seconds."""
        return [
            (label, seed, t.simulations, t.seconds) for (label, seed), t in self.trainings.items()
        ]

    def build_skipped_rows(self) -> list[dict[str, Any]]:
        """Return rows of status.csv for tuners that could not be used.

        A tuner is skipped if, for example, a package that it needs is not installed; it has one row
        without a target.
        """
        experiment = self.problem.experiment
        common_cells: dict[str, Any] = {
            "simulator": experiment.simulator,
            "target": "",
            "seed": 0,
            "status": "skipped",
            "simulations": 0,
            "seconds": 0.0,
            "trusted": experiment.trusted,
        }
        return [
            {"run": label, "tuner": label, **common_cells, "reason": reason}
            for label, reason in self.skipped.items()
        ]


@dataclass(frozen=True)
class PlannedRun:
    """Run request with its target including the true parameters; stays in the parent process."""

    request: RunRequest
    target: Target


def count_seeds(experiment: Experiment, entry: TunerEntry) -> int:
    """Return the number of seeds of an entry.

    It is the entry's own number, or else that of the experiment, but one if the tuner is
    deterministic: its runs would all be equal.
    """
    tuner_class = tuners.get(entry.tuner)
    # A learned tuner is trained with each seed, even if its runs use no random numbers.
    if not (tuner_class.stochastic or tuner_class.learned):
        return 1
    return entry.seeds or experiment.seeds


def check_tuners(experiment: Experiment) -> dict[str, str]:
    """Build every tuner once, so that errors are reported before the work begins.

    Args:
        experiment: Experiment with its tuners and their options.

    Returns:
        Reason by label of each tuner that is skipped.

    Raises:
        InputError: a tuner cannot be built, for example because it refuses an option.
    """
    skipped = {}
    for entry in experiment.tuners:
        try:
            # A tuner that must be built in isolation has been built there by the check itself.
            if experiment.trusted or not must_build_isolated(entry):
                build_tuner(entry)
        except PartUnavailableError as error:
            skipped[entry.label] = error.reason
    return skipped


@numeric_warnings_silenced()
def prepare_experiment(experiment: Experiment, salt: str | None = None) -> ExperimentRun:
    """Check an experiment completely before any work, and plan its runs.

    Every tuner is built once, the targets (systems with true parameters to find) are drawn, and a
    run is planned for each tuner, target and seed. Tuners that cannot be used here are skipped.

    Args:
        experiment: configuration of the experiment; its plugins are already registered.
        salt: secret salt from which its targets are drawn; None for the experiment's own.

    Raises:
        InputError: the experiment, its simulator, recording or tuners have an error.
    """
    if not experiment.tuners:
        remedy = "add a [tuners.NAME] table or choose some"
        raise InputError(f"experiment {experiment.name}: names no tuner; {remedy}")
    # A memory limit that this system does not support would crash every run.
    if experiment.memory:
        import_resource_module()
    results = ExperimentRun(TuningProblem(experiment, salt), skipped=check_tuners(experiment))
    entries = [entry for entry in experiment.tuners if entry.label not in results.skipped]
    if not experiment.trusted:
        results.tuned = {entry.label: make_tuner_spec(entry) for entry in entries}
    targets = draw_targets(results.problem)
    results.redraws = count_redraws(experiment, targets)
    results.plan = list(_iterate_planned_runs(experiment, entries, targets))
    # Workers open their own simulators, and this process does not need one for now.
    results.problem.close()
    return results


def _iterate_planned_runs(
    experiment: Experiment, entries: list[TunerEntry], targets: list[Target]
) -> Iterator[PlannedRun]:
    """Iterate over all runs, target by target, so that the remaining time can be estimated.

    Args:
        experiment: configuration of the experiment, with numbers of seeds and simulations.
        entries: entries of the tuners that can be used here.
        targets: targets with their true parameters.
    """
    make_run_id = RunIds(experiment).make_run_id
    for target in targets:
        for entry in entries:
            budget = entry.budget or experiment.budget
            for seed in range(count_seeds(experiment, entry)):
                run = make_run_id(entry, target.blinded, seed, budget)
                yield PlannedRun(RunRequest(run, entry, seed, target.blinded, budget), target)


@numeric_warnings_silenced()
def run_experiment(
    results: ExperimentRun,
    plugins: Sequence[str] = (),
    jobs: int = 2,
    progress: ProgressFactory = no_progress,
    pool: Pool | None = None,
) -> None:
    """Execute every run of a prepared experiment that is not yet stored.

    First learned tuners are trained; runs whose training failed are stored as failures. Then all
    other runs are sent to workers, and each result is appended to `results.run_sink` as soon as its
    run ends. An interrupt by the user, or the loss of the pool, is noted in `results`.

    Args:
        results: prepared experiment from `prepare_experiment`.
        plugins: plugin files that workers need; already registered in this process.
        jobs: number of worker processes; 0 to run everything in this process. The results do not
            depend on their number.
        progress: called for every step.
        pool: pool to use instead, for example of a cluster.

    Raises:
        InputError: workers cannot be started, or a class is needed that they cannot load.
    """
    experiment = results.problem.experiment
    if pool is not None or jobs or not experiment.trusted:
        check_classes_importable(experiment, workers=pool is not None or jobs > 0)
    # This process has the true parameters, and a tuner's process may run as the same user.
    memory_protection = nullcontext() if experiment.trusted else not_dumpable()
    # A given pool, such as that of a cluster, has priority over processes on this machine.
    with memory_protection, pool or make_pool(jobs) as workers:
        workers.load_plugins(describe_plugins(plugins, experiment))
        try:
            _compute_target_spectra(results, progress)
            failures = _train_learned_entries(workers, results, progress)
            ready = _store_untrained_runs(results, failures, progress)
            # Each outcome is stored before the next one, so that a kill loses running calls only.
            calls = _LazyCalls(results, ready.plan_indices)
            for i, outcome in workers.iterate_results(calls, experiment.timeout):
                _store_result(results, ready.plan_indices[i], outcome)
                ready.step()
        except KeyboardInterrupt:
            results.interrupted = True
        except PoolLostError as error:
            results.stopped = str(error)


class _ReadyRuns(NamedTuple):
    """Indices in the plan of runs that can be executed, and the callback after each of them."""

    plan_indices: list[int]
    step: Callable[[], None]


def _store_untrained_runs(
    results: ExperimentRun,
    failures: Mapping[tuple[str, int], Exception],
    progress: ProgressFactory,
) -> _ReadyRuns:
    """Store runs whose training failed as failures, and return the other missing runs.

    A run is missing if it is in the plan and not stored yet. A failure is a result too, so these
    runs are not tried again when the study is resumed.

    Args:
        results: Plan and stored runs of the experiment.
        failures: Errors of trainings by label of the tuner and seed.
        progress: Makes a progress bar from a title and the number of steps.

    Returns:
        Indices in the plan of the runs that can be executed, and the callback that advances the
        progress bar.
    """
    missing = [
        index for index in range(len(results.plan)) if index not in results.run_sink.statuses
    ]
    ready = _ReadyRuns([], progress("running", len(missing)))
    for index in missing:
        request = results.plan[index].request
        failure = failures.get((request.entry.label, request.seed))
        if failure is None:
            ready.plan_indices.append(index)
        else:
            _store_result(results, index, failure)
            ready.step()
    return ready


def _compute_target_spectra(results: ExperimentRun, progress: ProgressFactory) -> None:
    """Compute the Fisher-information spectrum of each target.

    The spectrum tells which combinations of parameters the observations determine well, and which
    badly (stiff and sloppy directions); errors are reported separately for both. With one parameter
    there is nothing to separate. Only the parent process can do this, because it needs the true
    parameters if there are any.

    Args:
        results: the comparison; the spectra are added to it.
        progress: makes a progress bar from a title and the number of steps.
    """
    problem = results.problem
    if not problem.has_several_parameters:
        return
    targets = {planned.target.blinded.name: planned.target for planned in results.plan}
    step = progress("identifiability", len(targets))
    for name, target in targets.items():
        if (spectrum := compute_target_spectrum(problem, target)) is not None:
            results.spectra[name] = spectrum
        step()
    # The spectra have opened the simulators; the runs do not use those of this process.
    problem.close()


class _LazyCalls(Sequence[Call]):
    """Lazy sequence of the calls that execute runs of the plan.

    Each call is created when it is accessed, because a million calls would fill the memory.
    """

    def __init__(self, results: ExperimentRun, plan_indices: list[int]) -> None:
        self._results, self._plan_indices = results, plan_indices

    def __len__(self) -> int:
        return len(self._plan_indices)

    def __getitem__(self, i: Any) -> Any:
        """Return the call that executes the planned run number `i` of those still to be run.

        The run's request is completed here with what is known after the plan was made: how to build
        the tuner in isolation, the folders it must not see, and the file of its trained weights.
        """
        results = self._results
        request = results.plan[self._plan_indices[i]].request
        request = replace(
            request, tuned=results.tuned.get(request.entry.label), hidden=results.hidden_paths
        )
        # The plan was made before the training; run ids do not depend on the location of weights.
        training = results.trainings.get((request.entry.label, request.seed))
        if training is not None:
            request = replace(request, weights=training.path)
        return execute_run, (results.problem.experiment, request)


def _train_learned_entries(
    pool: Pool, results: ExperimentRun, progress: ProgressFactory
) -> dict[tuple[str, int], Exception]:
    """Train every learned tuner of the experiment with each of its seeds, or load its weights.

    Args:
        pool: worker pool that makes the calls.
        results: prepared run of the experiment, to which weights are added.
        progress: makes progress callbacks.

    Returns:
        Exception by label and seed of each training that failed.

    Raises:
        WeightsError: stored weights are damaged. The user must repair this, and no run has started.
    """
    experiment = results.problem.experiment
    requested = [
        (entry, seed)
        for entry in experiment.tuners
        if entry.label not in results.skipped and tuners.get(entry.tuner).learned
        for seed in range(count_seeds(experiment, entry))
    ]
    failures: dict[tuple[str, int], Exception] = {}
    # A progress bar without steps would never end.
    if not requested:
        return failures
    step = progress("training", len(requested))
    requests = [
        TrainingRequest(entry, seed, results.tuned.get(entry.label), results.hidden_paths)
        for entry, seed in requested
    ]
    calls = [(train_or_load, (experiment, request)) for request in requests]
    for index, training in pool.iterate_results(calls, math.inf):
        entry, seed = requested[index]
        if isinstance(training, TrainingResult):
            results.trainings[entry.label, seed] = training
        elif isinstance(training, WeightsError):
            raise training
        else:
            failures[entry.label, seed] = training
        step()
    return failures


def _store_result(results: ExperimentRun, index: int, outcome: RunOutcome | Exception) -> None:
    """Store the result of a worker: an outcome, or the error that ended the run.

    Every run gets rows and a status, because a failure is a result too: "timeout" if the worker was
    killed at the time limit, "crashed" if it died or raised an error, or the status that the error
    states.

    Args:
        results: results so far; the run is added to its tables and notes.
        index: position of the run in the plan.
        outcome: what the worker returned or raised.
    """
    problem = results.problem
    request, target = results.plan[index].request, results.plan[index].target
    if isinstance(outcome, TimeoutError):
        reason = f"killed after its limit of {problem.experiment.timeout:g} s"
        outcome = make_unfinished_outcome(problem, target.blinded, "timeout", reason)
    elif isinstance(outcome, WorkerDiedError):
        outcome = make_unfinished_outcome(problem, target.blinded, "crashed", str(outcome))
    elif isinstance(outcome, RunEndedError):
        outcome = make_unfinished_outcome(problem, target.blinded, outcome.status, outcome.reason)
    elif isinstance(outcome, Exception):
        reason = "".join(traceback.format_exception(outcome))
        outcome = make_unfinished_outcome(problem, target.blinded, "crashed", reason)
    results.notes.add(request.entry.label, outcome)
    spectrum = results.spectra.get(request.target.name)
    columns = build_rows(problem, request, target, outcome, spectrum)
    results.run_sink.append(index, columns, make_status(problem, request, outcome))
