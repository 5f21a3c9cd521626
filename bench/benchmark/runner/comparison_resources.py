"""Estimate what a comparison or a training needs, from its experiment alone.

See `core.resource_estimates`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from bench.benchmark.problem.experiment_config import Experiment, TunerEntry, expand_sweep
from bench.benchmark.problem.experiment_recording import find_recording
from bench.benchmark.problem.robot_experiment import get_simulator_class
from bench.benchmark.problem.tuning_problem import TuningProblem
from bench.benchmark.runner.experiment_runner import check_tuners, count_seeds
from bench.core.plugin_registries import tuners
from bench.core.resource_estimates import (
    BYTES_PER_NUMBER,
    BYTES_PER_STEP,
    MIN_SIMULATION_SECONDS,
    MIN_STEP_SECONDS,
    ResourceNeed,
    check_feasible,
    get_machine_resources,
    get_max_step,
)
from bench.logs.quality.log_quality import check_recording_plausible
from sims.recording.recording import read_recording

_ROW_DISK = 50
"""Size of a row on disk in bytes; 70 were measured."""
_ROW_MEMORY = 80
"""Memory of a row in bytes while tables and figures are made; 110 were measured."""
_ROW_SECONDS = 1e-6
"""Time to write and read a row, in seconds."""
_RUN_MEMORY = 500
"""Memory of a planned run in bytes: its request, its id and its status."""
_RUN_SECONDS = 5e-4
"""Time to score and store a run, in seconds."""
_WORKER_BYTES = 30e6
"""Memory of a worker process in bytes that is not shared with other processes."""
_MAX_CLUSTER_WORKERS = 10_000
"""Assumed maximum number of workers of a cluster."""
_MIN_TRAINING_SECONDS = 0.1
"""Minimum duration of a training in seconds."""
_TYPICAL_SIZES: Mapping[str, float] = {
    "targets": 100,
    "seeds": 5,
    "budget": 100,
    "training_budget": 1600,
    "held_out.scenarios": 3,
    "sampling.samples": 400,
    "steps": 2000,
    "jobs": 8,
}
"""Typical sizes of experiments."""


class _ExperimentSizes:
    """Sizes of an experiment from which its needs are computed."""

    def __init__(self, experiment: Experiment) -> None:
        """Build the problem to read its sizes, and select the tuners that can run on this machine.

        `samples` and `steps` are the numbers of samples and of time steps of one evaluation.
        `learned` is True if at least one of these tuners must be trained.

        Args:
            experiment: Experiment whose needs are estimated.
        """
        problem = TuningProblem(experiment)
        self.channels = len(problem.channels)
        self.dim = problem.cube.dim
        self.samples, self.steps = _count_simulated_samples(problem)
        problem.close()
        skipped = check_tuners(experiment)
        self.tuners = [e for e in experiment.tuners if e.label not in skipped]
        self.learned = any(tuners.get(e.tuner).learned for e in self.tuners)

    @property
    def observation(self) -> float:
        """Size of an observation in bytes."""
        return float(self.samples) * self.channels * BYTES_PER_NUMBER

    @property
    def simulation(self) -> float:
        """Duration of a simulation in seconds."""
        return MIN_SIMULATION_SECONDS + MIN_STEP_SECONDS * self.steps


def _count_simulated_samples(problem: TuningProblem) -> tuple[int, float]:
    """Return the numbers of samples and of time steps that one evaluation simulates.

    An evaluation simulates one point for all runs of a target. With a recording, these are its
    fitting runs; otherwise it is one run of the experiment's sampling.

    Args:
        problem: Tuning problem with its simulator, true system and data.

    Returns:
        The samples of all runs, and the time steps at the smaller step of both simulators.
    """
    experiment = problem.experiment
    step = min(map(get_max_step, (problem.simulator, problem.world)))
    if problem.recording:
        scenarios = problem.recording.fitting.scenarios
        seconds = sum(float(s.times[-1] - s.times[0]) for s in scenarios)
        return sum(s.times.size for s in scenarios), seconds / step
    samples = experiment.sampling.samples
    seconds = (samples - 1) / experiment.sampling.rate
    # Between two samples there is at least one step.
    return samples, max(seconds / step, samples - 1)


def check_comparison_size(
    experiment: Experiment,
    folder: Path | None = None,
    jobs: int = 2,
    cluster: bool = False,
    force: bool = False,
) -> None:
    """Raise an error for a comparison that is not feasible on this machine.

    Memory, disk space and duration are estimated before the first run. A recording
    is checked for anomalies too, since a comparison on damaged data would waste the time.

    Args:
        experiment: configuration; it may sweep over values.
        folder: result folder.
        jobs: number of worker processes; 0 for none.
        cluster: True if a cluster executes the runs.
        force: True to skip the check.

    Raises:
        InputError: it needs more than is available, or its recording has anomalies.
    """
    if force:
        return
    # A diagnosis is limited by its own time and memory limits.
    if experiment.diagnosis:
        return
    for part in expand_sweep(experiment):
        need = estimate_comparison_need(part, jobs, cluster)
        check_feasible(f"experiment {part.name}", need, get_machine_resources(folder))
        if part.recording:
            simulator_class = get_simulator_class(part)
            path = find_recording(part.recording.path)
            check_recording_plausible(read_recording(path, simulator_class), simulator_class)


def estimate_comparison_need(
    experiment: Experiment, jobs: int = 2, cluster: bool = False
) -> ResourceNeed:
    """Estimate the memory, disk space and seconds that an experiment needs.

    There is one run for each tuner, target and seed; a run simulates as often as its budget allows,
    and stores one row for each simulation and one for the start. The needs are sums of these counts
    times sizes and durations that were measured once. The counts are also part of the message that
    explains the estimate to the user.

    Args:
        experiment: configuration without a sweep.
        jobs: number of worker processes; 0 for none.
        cluster: True if a cluster executes the runs.

    Returns:
        Memory and disk space in bytes, time steps of one simulation, and seconds, with a text of
        the counts and a suggestion how to reduce the largest one.
    """
    sizes = _ExperimentSizes(experiment)
    # For a bounce shot (table [shot]), `targets` is the number of shots with each ball. Only one
    # ball is counted, since there are only a few.
    targets = experiment.targets * len(experiment.ranges)
    seeds_and_budgets = [
        # A tuner may have its own budget; otherwise that of the experiment applies.
        (count_seeds(experiment, entry), entry.budget or experiment.budget)
        for entry in sizes.tuners
    ]
    runs = targets * sum(seeds for seeds, _ in seeds_and_budgets)
    simulations = targets * sum(seeds * budget for seeds, budget in seeds_and_budgets)
    row_count = runs + simulations
    held_out = experiment.held_out.scenarios if experiment.held_out else 0
    max_budget = max((budget for _, budget in seeds_and_budgets), default=0)
    training_simulations = experiment.training_budget if sizes.learned else 0
    workers = _MAX_CLUSTER_WORKERS if cluster else max(jobs, 1)
    memory = (
        runs * _RUN_MEMORY
        # One fitted observation and the held-out ones for each target.
        + targets * (1 + held_out) * sizes.observation
        + row_count * _ROW_MEMORY
        # The worker processes; those of a cluster run on other machines.
        + (0 if cluster else jobs * _WORKER_BYTES)
        # The largest run stores its proposals and their losses.
        + max_budget * (sizes.dim + 1) * BYTES_PER_NUMBER
        + training_simulations * sizes.observation
        # The state of one running simulation.
        + sizes.steps * BYTES_PER_STEP
    )
    seconds = (
        # Each recommended point is simulated in the held-out scenarios, too.
        simulations * sizes.simulation * (1 + held_out) / workers
        # At least one training, which one process executes.
        + training_simulations * sizes.simulation
        + row_count * _ROW_SECONDS
        + runs * _RUN_SECONDS
    )
    counts = {
        "targets": targets,
        "seeds": max((seeds for seeds, _ in seeds_and_budgets), default=0),
        "budget": max_budget,
        "training_budget": training_simulations,
        "held_out.scenarios": held_out,
        "sampling.samples": sizes.samples,
        "steps": sizes.steps,
        "jobs": jobs,
    }
    counts_text = ", ".join(f"{name} {count:.4g}" for name, count in counts.items() if count)
    return ResourceNeed(
        f"tuners {len(seeds_and_budgets)}, {counts_text}",
        _suggest_reduction(counts),
        memory=memory,
        disk=row_count * _ROW_DISK,
        steps=sizes.steps,
        seconds=seconds,
    )


def _suggest_reduction(counts: Mapping[str, float]) -> str:
    """Suggest a change: reduce the number that is largest compared with its typical value."""
    largest = max(counts, key=lambda name: counts[name] / _TYPICAL_SIZES[name])
    if largest == "steps":
        return "set a longer time_step, or sample a shorter time"
    return f"lower {largest}"


def check_training_size(
    experiment: Experiment, entry: TunerEntry, seeds: int, force: bool = False
) -> None:
    """Raise an error for trainings that are not feasible on this machine.

    Args:
        experiment: configuration of the training.
        entry: entry of the tuner.
        seeds: number of trainings.
        force: True to skip the check.

    Raises:
        InputError: the trainings need more than is available.
    """
    sizes = _ExperimentSizes(experiment)
    budget = experiment.training_budget
    need = ResourceNeed(
        f"{seeds} trainings of {entry.label} with {budget} simulations, each of {sizes.samples}"
        f" samples and {sizes.steps:.3g} steps,",
        _suggest_reduction({"seeds": seeds, "training_budget": budget, "steps": sizes.steps}),
        memory=budget * sizes.observation + sizes.steps * BYTES_PER_STEP,
        steps=sizes.steps,
        seconds=seeds * (_MIN_TRAINING_SECONDS + budget * sizes.simulation),
    )
    check_feasible(f"experiment {experiment.name}", need, get_machine_resources(), force)
