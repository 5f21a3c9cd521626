"""Execute one run on one target in a worker process; request and outcome of a run.

Trainings are executed by `tuner_training.train_or_load`. True parameters never enter a worker: it
gets `BlindedTarget`s and returns traces, which the parent process scores. Code of tuners does not
enter it either, unless the tuners are trusted. The worker simulates, counts and measures time, and
the tuner lives in its own process (`bench.benchmark.isolation`). The parent process makes the
outcome of a run whose worker returns none.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np

from bench.benchmark.isolation.process_errors import RunEndedError
from bench.benchmark.isolation.resource_limits import limited_memory
from bench.benchmark.isolation.tuner_processes import (
    NOTHING_WRITTEN,
    IsolatedRun,
    TunerSpec,
    Written,
    relocate,
)
from bench.benchmark.problem.experiment_config import Experiment, TunerEntry
from bench.benchmark.problem.targets import BlindedTarget
from bench.benchmark.problem.tuning_problem import ProposalEvaluator, TuningProblem
from bench.benchmark.runner.retry_after_kill import RepeatedRequests, retry_if_killed
from bench.benchmark.runner.trained_weights import read_weights
from bench.benchmark.runner.tuner_loop import Evaluate, RunTrace, drive_tuner
from bench.benchmark.runner.tuner_process_start import start_isolated_tuner
from bench.benchmark.runner.tuner_training import build_tuner, load_trained_tuner
from bench.benchmark.storage.run_status import FAILED_STATUSES
from bench.core.random_streams import make_rng, make_seed_words
from methods.tuner import Task, Tuner
from sims.core.simulator import Array


@dataclass(frozen=True)
class RunRequest:
    """Request of one run.

    Attributes:
        run: id of the run.
        entry: entry of the tuner.
        seed: seed of the tuner.
        target: target without its true parameters.
        budget: number of simulations.
        weights: file of the weights of a learned tuner; None for none.
        tuned: specification of the tuner for an isolated process; None if it is trusted.
        hidden: folders that this process must not access.
    """

    run: str
    entry: TunerEntry
    seed: int
    target: BlindedTarget
    budget: int
    weights: Path | None = None
    tuned: TunerSpec | None = None
    hidden: tuple[str, ...] = ()

    def list_files(self) -> tuple[Path, ...]:
        """Return the files that another machine needs for the run."""
        plugin = Path(self.tuned.file) if self.tuned and self.tuned.file else None
        return tuple(path for path in (self.weights, plugin) if path is not None)

    def relocate(self, new_paths: Mapping[Path, Path]) -> RunRequest:
        """Return the request with other paths of its files.

        Args:
            new_paths: new path of each file by its present path.
        """
        weights = None if self.weights is None else new_paths[self.weights]
        tuned = None if self.tuned is None else relocate(self.tuned, new_paths)
        return replace(self, weights=weights, tuned=tuned)


@dataclass(frozen=True)
class RunOutcome:
    """Outcome of one run, with the errors of its recommendations after 0..k simulations.

    Attributes:
        trace: trace of the run.
        obs_rmse: (k + 1, C) RMS error on the target's fitted runs, in channel units.
        heldout_rmse: (k + 1, C) RMS error on its held-out runs; None if there are none.
        seconds: wall-clock time of the run in seconds, without the scoring.
        written: files that the tuner wrote and that were deleted with its process.
        import_seconds: time in seconds for imports of the tuner's file before the run.
    """

    trace: RunTrace
    obs_rmse: Array
    heldout_rmse: Array | None
    seconds: float
    written: Written = NOTHING_WRITTEN
    import_seconds: float = 0.0


class HiddenSimulationError(RuntimeError):
    """A tuner simulated points without the harness counting them."""


_problems: dict[int, tuple[Experiment, TuningProblem]] = {}
"""Last problem of this process; several problems would hold several simulators open."""


def get_problem(experiment: Experiment) -> TuningProblem:
    """Return the problem of an experiment; it is cached until another one is needed.

    Building a problem opens simulators, which takes time; a worker executes many runs of one.
    """
    # There is at most one problem, under the key 0.
    cached = _problems.get(0)
    if cached is None or cached[0] != experiment:
        close_problem()
        cached = _problems[0] = (experiment, TuningProblem(experiment))
    return cached[1]


def close_problem() -> None:
    """Close the cached problem of this process."""
    for _, problem in _problems.values():
        problem.close()
    _problems.clear()


def execute_run(experiment: Experiment, request: RunRequest) -> RunOutcome:
    """Execute one run of a tuner on a target; a failure becomes a status of the run's trace.

    The tuner runs in this process if it is trusted, otherwise in an isolated one. Then it is
    checked that no simulation was made that the harness did not count. Afterwards the errors of the
    recommended points are computed, on the target's fitted runs and on its held-out runs. An
    isolated run is repeated if something else kills its process.

    Args:
        experiment: configuration of the experiment.
        request: request of the run.

    Raises:
        HiddenSimulationError: more points were simulated than the tuner requested from the harness.
        RunEndedError: the tuner's process was killed externally several times.
    """
    requests = RepeatedRequests()
    return retry_if_killed(lambda: _execute_once(experiment, request, requests))


def _execute_once(
    experiment: Experiment, request: RunRequest, requests: RepeatedRequests
) -> RunOutcome:
    """Execute a run once: let the tuner propose points, and compute the errors of its results.

    Args:
        experiment: configuration of the experiment.
        request: tuner, target, seed and budget of the run.
        requests: points that the tuner requested before its process was killed; a repetition must
            request the same.

    Returns:
        Trace of the run, RMS errors of its recommendations, seconds, and files written.

    Raises:
        HiddenSimulationError: more points were simulated than the tuner requested from the harness.
        KilledExternallyError: the tuner's process was killed externally.
    """
    # The requests of this attempt are compared with the recorded ones from the first one on.
    requests.restart()
    problem = get_problem(experiment)
    target = request.target
    evaluator = ProposalEvaluator(problem, target.fitting)
    task = Task(
        dim=problem.cube.dim,
        start=target.start,
        observed=target.fitting.observed,
        scale=problem.scale,
        training=problem.cube.training,
        budget=request.budget,
        lengths=tuple(s.times.size for s in target.fitting.scenarios),
        scene=problem.describe_scenarios(target.fitting.scenarios),
    )
    # The problem also counts simulations of the scoring and of earlier runs.
    simulated_before = problem.simulated
    started = perf_counter()
    written, import_seconds = NOTHING_WRITTEN, 0.0
    if request.tuned is None:
        # The tuner is trusted and runs in this process.
        rng = make_rng(*_list_stream_names(experiment, request))
        with limited_memory(experiment.memory):
            trace = drive_tuner(_build_tuner(request), task, evaluator, rng, experiment.timeout)
    else:

        def evaluate(points: Array) -> tuple[Array, Array]:
            requests.check(points.tobytes())
            return evaluator(points)

        trace, written, import_seconds = _run_isolated(experiment, request, task, evaluate)
    seconds = perf_counter() - started
    # A trusted tuner could call the simulator itself, and so simulate outside its budget.
    hidden_simulations = problem.simulated - simulated_before - len(trace.losses)
    # A crashed run is exempt: a simulator that raises an error has counted simulations that have no
    # result.
    if hidden_simulations > 0 and trace.status != "crashed":
        raise HiddenSimulationError(f"{hidden_simulations} simulations outside the budget")
    if trace.status == "crashed":
        # The stderr of a worker is discarded; without workers the author of the tuner sees it.
        sys.stderr.write(trace.reason)
    # Held-out runs are simulated after the run, so that the tuner cannot see them.
    heldout = None
    if target.held_out.scenarios:
        # No proposal was simulated on these runs, so there are none (`[:0]`) to look up.
        heldout = ProposalEvaluator(problem, target.held_out).compute_rmse(
            trace.proposals[:0], trace.recommendations
        )
    rmse = evaluator.compute_rmse(trace.proposals, trace.recommendations)
    return RunOutcome(trace, rmse, heldout, seconds, written, import_seconds)


def _list_stream_names(experiment: Experiment, request: RunRequest) -> tuple[str | int, ...]:
    """Return the names that determine the random stream of the run.

    Args:
        experiment: configuration of the experiment.
        request: requested run: tuner, target and seed.
    """
    return experiment.name, request.entry.tuner, request.target.name, request.seed


def _build_tuner(request: RunRequest) -> Tuner:
    """Build a tuner that works in this process, with its weights if it has been trained."""
    if request.weights is None:
        return build_tuner(request.entry)
    return load_trained_tuner(request.entry, request.weights)


def _run_isolated(
    experiment: Experiment, request: RunRequest, task: Task, evaluate: Evaluate
) -> tuple[RunTrace, Written, float]:
    """Execute a run whose tuner has an isolated process; this process simulates its proposals.

    If the tuner cannot be built, the run fails without simulations. After any failure the process
    is ended, since it may be in any state.

    Args:
        experiment: content of the experiment's TOML file: simulator, tuners, targets and budget.
        request: request of the run.
        task: task of the target.
        evaluate: function that simulates points and computes their losses.

    Returns:
        The trace, the files that the tuner wrote, and the seconds of its imports.
    """
    assert request.tuned is not None  # otherwise the tuner is trusted and runs in this process
    state = None if request.weights is None else read_weights(request.weights)
    stream_names = _list_stream_names(experiment, request)
    tuner_context = start_isolated_tuner(
        request.tuned, request.seed, experiment.isolation, request.hidden, experiment.memory, state
    )
    try:
        with tuner_context as tuner:
            run = IsolatedRun(tuner, make_seed_words(*stream_names), experiment.timeout)
            trace = drive_tuner(run, task, evaluate, make_rng(*stream_names), experiment.timeout)
            written = tuner.child.written()
            if trace.status in FAILED_STATUSES:
                tuner.child.end()
            return trace, written, tuner.import_seconds
    except RunEndedError as ended:
        trace = RunTrace.make_unfinished(
            ended.status, ended.reason or "its process did not start in time", task.start
        )
        return trace, NOTHING_WRITTEN, 0.0


def make_unfinished_outcome(
    problem: TuningProblem, target: BlindedTarget, status: str, reason: str
) -> RunOutcome:
    """Make the outcome of a run that ended without a trace, as if its process was killed.

    It has no simulations, and its only recommendation is the start of the target.

    Args:
        problem: tuning problem.
        target: target of the run.
        status: how the run ended, such as ``crashed`` or ``timeout``.
        reason: reason of the status.
    """
    trace = RunTrace.make_unfinished(status, reason, target.start)
    # The errors (1, C) have one row, for the start, which was not simulated.
    unknown_errors = np.full((1, len(problem.channels)), np.nan)
    return RunOutcome(trace, obs_rmse=unknown_errors, heldout_rmse=None, seconds=0.0)
