"""Runs an experiment: tuners x targets x seeds, in worker processes or in this one; every finished
run is kept the moment it ends.
"""

from __future__ import annotations

import math
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

from bench.problem.experiment import Entry, Experiment
from bench.problem.identifiability import Spectrum
from bench.problem.numeric_warnings import numeric_warnings_silenced
from bench.problem.problem import Problem
from bench.problem.targets import Redraws, Target, redraws_of
from bench.registry import Registry, SkippedError, effects, simulators, tuners
from bench.runs.housing import tuned_of
from bench.runs.identity import Identities
from bench.runs.notes import Notes
from bench.runs.pools import Call, DeathError, LostError, Pool, pool_of
from bench.runs.rows import rows, status_of, unfinished
from bench.runs.sources import effect_names
from bench.runs.survey import admitted, unbuildable
from bench.runs.training import Lesson, Training, WeightsError, build, train
from bench.runs.worker import Order, Outcome, perform
from bench.sealing.ended import EndedError
from bench.sealing.kernel import memory_hidden
from bench.sealing.memory import limits
from bench.sealing.outside import Tuned
from bench.store.status import Status
from sims.base import InputError

Progress = Callable[[str, int], Callable[[], None]]
"""Called with a title and a number of steps; gives the function to call after each step."""


def silent(_title: str, _steps: int) -> Callable[[], None]:
    """Progress that nobody looks at."""
    return lambda: None


class Keep(Protocol):
    """Where finished runs go, each by its place in the plan; `statuses` says which there are."""

    statuses: dict[int, Status]

    def add(self, place: int, columns: Mapping[str, Any], status: Status) -> None:
        """Keep the rows and the status of a finished run."""
        ...


class Memory:
    """Keeps runs in memory."""

    def __init__(self) -> None:
        self.columns: dict[int, Mapping[str, Any]] = {}
        self.statuses: dict[int, Status] = {}

    def add(self, place: int, columns: Mapping[str, Any], status: Status) -> None:
        """Keep the rows and the status of a finished run."""
        self.columns[place], self.statuses[place] = columns, status


@dataclass
class Results:
    """A comparison: its problem, its plan once there is one, where its runs are kept, and what
    training cost.

    `spectra` says what each target's data identify, by its name, where that can be asked; `tuned`
    which tuner lives in a process of its own, by label; `hidden` what it must not reach; `redraws`
    how many targets were drawn again; `notes` what the runs made now tell the authors of their
    tuners.
    """

    problem: Problem
    kept: Keep = field(default_factory=Memory)
    plan: list[Job] = field(default_factory=list)
    trainings: dict[tuple[str, int], Training] = field(default_factory=dict)
    spectra: dict[str, Spectrum] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    tuned: dict[str, Tuned] = field(default_factory=dict)
    hidden: tuple[str, ...] = ()
    redraws: Redraws | None = None
    interrupted: bool = False
    stopped: str = ""
    notes: Notes = field(init=False)

    def __post_init__(self) -> None:
        self.notes = Notes(self.problem.experiment.isolation)

    def training_rows(self) -> list[tuple[str, int, int, float]]:
        """Rows of training.csv: tuner, seed, simulations, seconds."""
        return [
            (label, seed, t.simulations, t.seconds) for (label, seed), t in self.trainings.items()
        ]

    def skipped_rows(self) -> list[dict[str, Any]]:
        """Rows of status.csv for tuners that could not be used."""
        experiment = self.problem.experiment
        simulator = experiment.simulator
        fixed = {"target": "", "seed": 0, "status": "skipped", "simulations": 0, "seconds": 0.0}
        fixed["trusted"] = experiment.trusted
        return [
            {"run": label, "tuner": label, "simulator": simulator, **fixed, "reason": reason}
            for label, reason in self.skipped.items()
        ]


@dataclass(frozen=True)
class Job:
    """An order and the target it is for, truth included; stays in the parent process."""

    order: Order
    target: Target


def seeds_of(experiment: Experiment, entry: Entry) -> int:
    """How many seeds an entry runs: its own number, the experiment's, or one where nothing is
    random.
    """
    kind = tuners.get(entry.tuner)
    if not (kind.stochastic or kind.learned):
        return 1
    return entry.seeds or experiment.seeds


def check(experiment: Experiment) -> dict[str, str]:
    """Build every tuner once, so that a fault shows before the work; returns the skipped entries
    with their reason.
    """
    skipped = {}
    for entry in experiment.tuners:
        try:
            if experiment.trusted or not unbuildable(entry):
                build(entry)
        except SkippedError as error:
            skipped[entry.label] = error.reason
    return skipped


def refuse_unreachable(experiment: Experiment, workers: bool = True) -> None:
    """Refuse classes that exist in this process alone, if other processes are to work with them.

    A worker starts afresh, so that no tuner finds the true parameters in its memory. It loads
    plugin files and installed packages, and does not import the script or notebook that calls
    simgap. The same holds for the process of a tuner.

    Args:
        experiment: what is to be run.
        workers: whether worker processes simulate; else only tuners have processes.

    Raises:
        InputError: the simulator, a tuner or an effect is such a class.
    """
    tuned: list[tuple[Registry[Any], str]] = [(tuners, e.tuner) for e in experiment.tuners]
    used = tuned
    if workers:
        named = effect_names(experiment.settings, experiment.world)
        simulated = [] if experiment.model else [(simulators, experiment.simulator)]
        used = [*simulated, *tuned, *((effects, name) for name in named)]
    for registry, name in used:
        added = registry.snapshot().get(name)
        if added is not None and added.path is None:
            raise unreachable(registry.kind, name, added.part)


def unreachable(kind: str, name: str, part: type) -> InputError:
    """The error for a class that worker processes cannot load.

    Args:
        kind: what it is, as ``tuner``.
        name: under which it is registered.
        part: the class.
    """
    file = getattr(sys.modules.get(part.__module__), "__file__", None)
    main = part.__module__ == "__main__"
    where = "this session"
    if file:
        where = f"the script {Path(file).resolve()}" if main else str(Path(file).resolve())
    plugin = f"{name}.py" if main or not file else str(Path(file).resolve())
    move = f"put it into a file of its own, say {plugin}, and " if main or not file else ""
    named = f"tuners=[{name!r}], " if kind in ("tuner", "diagnoser") else ""
    return InputError(
        f"{kind} {name}: class {part.__qualname__} is defined in {where}, which "
        f"worker processes do not import; {move}pass {named}plugins=[{plugin!r}], or pass "
        "jobs=0, which runs everything in this process"
    )


@numeric_warnings_silenced()
def prepare(experiment: Experiment, salt: str | None = None) -> Results:
    """Check an experiment whole before any work: its simulator, recording, tuners and their
    options; plan its runs.

    Args:
        experiment: what is to be compared; its plugins are known.
        salt: the secret one that its targets are drawn from; the experiment's own where None.

    Raises:
        InputError: a fault in it.
    """
    if not experiment.tuners:
        remedy = "add a [tuners.NAME] table or choose some"
        raise InputError(f"experiment {experiment.name}: names no tuner; {remedy}")
    # A limit that this system does not have would crash every single run.
    if experiment.memory:
        limits()
    results = Results(Problem(experiment, salt), skipped=check(experiment))
    entries = [entry for entry in experiment.tuners if entry.label not in results.skipped]
    if not experiment.trusted:
        results.tuned = {entry.label: tuned_of(entry) for entry in entries}
    drawn = results.problem.targets()
    results.redraws = redraws_of(experiment, drawn)
    results.plan = list(_plan(experiment, entries, drawn))
    # Workers open their own; what is left to do here needs no simulator for a while.
    results.problem.close()
    return results


def _plan(experiment: Experiment, entries: list[Entry], targets: list[Target]) -> Iterator[Job]:
    """Every run, target by target, so that the time left can be estimated from the time gone."""
    name = Identities(experiment).run
    for target in targets:
        for entry in entries:
            budget = entry.budget or experiment.budget
            for seed in range(seeds_of(experiment, entry)):
                run = name(entry, target.sealed, seed, budget)
                yield Job(Order(run, entry, seed, target.sealed, budget), target)


@numeric_warnings_silenced()
def run(
    results: Results,
    plugins: Sequence[str] = (),
    jobs: int = 2,
    progress: Progress = silent,
    pool: Pool | None = None,
) -> None:
    """Make every run of a prepared experiment that is not kept already; `results.kept` gets each as
    it ends.

    Args:
        results: from `prepare`.
        plugins: plugin files that workers need; the caller has made them known in this process.
        jobs: worker processes; 0 for none, and everything in this one. The results do not depend
            on their number.
        progress: told of every step.
        pool: where to run instead, e.g. on a cluster.

    Raises:
        InputError: workers cannot be had, or a class that they cannot have is wanted.
    """
    experiment = results.problem.experiment
    if pool is not None or jobs or not experiment.trusted:
        refuse_unreachable(experiment, workers=pool is not None or jobs > 0)
    # Here are the truths, and a tuner's process may be this user's.
    hidden = nullcontext() if experiment.trusted else memory_hidden()
    with hidden, pool or pool_of(jobs) as workers:
        workers.load(admitted(plugins, results.problem.experiment))
        try:
            _run(results, workers, progress)
        except KeyboardInterrupt:
            results.interrupted = True
        except LostError as error:
            results.stopped = str(error)


def _run(results: Results, pool: Pool, progress: Progress) -> None:
    missing = [place for place in range(len(results.plan)) if place not in results.kept.statuses]
    _identify(results, progress)
    failures = _train(pool, results, progress)
    step = progress("running", len(missing))
    ready: list[int] = []
    # Runs of a tuner whose training failed stay in the table, as failures.
    for place in missing:
        order = results.plan[place].order
        if (failure := failures.get((order.entry.label, order.seed))) is not None:
            _file(results, place, failure)
            step()
        else:
            ready.append(place)
    # Each outcome is kept before the next is waited for: a kill costs what is under way.
    calls = _Calls(results, ready)
    for i, outcome in pool.results(calls, results.problem.experiment.timeout):
        _file(results, ready[i], outcome)
        step()


def _identify(results: Results, progress: Progress) -> None:
    """Find what each target's data identify; only the parent process can: where there is a truth
    it takes that.
    """
    problem, targets = results.problem, {job.target.sealed.name: job.target for job in results.plan}
    if not problem.identifiable:
        return
    step = progress("identifiability", len(targets))
    for name, target in targets.items():
        if (spectrum := problem.spectrum(target)) is not None:
            results.spectra[name] = spectrum
        step()
    problem.close()


class _Calls(Sequence[Call]):
    """The calls for these places of the plan, each made when it is asked for: a million of them
    would fill memory.
    """

    def __init__(self, results: Results, places: list[int]) -> None:
        self._results, self._places = results, places

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, i: Any) -> Any:
        results = self._results
        order = results.plan[self._places[i]].order
        order = replace(order, tuned=results.tuned.get(order.entry.label), hidden=results.hidden)
        # The plan was made before the training, and ids do not depend on where weights lie.
        training = results.trainings.get((order.entry.label, order.seed))
        if training is not None:
            order = replace(order, weights=training.path)
        return perform, (results.problem.experiment, order)


def _train(pool: Pool, results: Results, progress: Progress) -> dict[tuple[str, int], Exception]:
    """Train every learned entry with each of its seeds; returns the reasons of those that failed.

    Raises:
        WeightsError: trained weights are there and damaged: the user's to mend, and nothing has
            been run yet.
    """
    experiment = results.problem.experiment
    wanted = [
        (entry, seed)
        for entry in experiment.tuners
        if entry.label not in results.skipped and tuners.get(entry.tuner).learned
        for seed in range(seeds_of(experiment, entry))
    ]
    failures: dict[tuple[str, int], Exception] = {}
    # A bar that has nothing to do would stand there for ever.
    if not wanted:
        return failures
    step = progress("training", len(wanted))
    lessons = [
        Lesson(entry, seed, results.tuned.get(entry.label), results.hidden)
        for entry, seed in wanted
    ]
    calls = [(train, (experiment, lesson)) for lesson in lessons]
    for place, training in pool.results(calls, math.inf):
        entry, seed = wanted[place]
        if isinstance(training, Training):
            results.trainings[entry.label, seed] = training
        elif isinstance(training, WeightsError):
            raise training
        else:
            failures[entry.label, seed] = training
        step()
    return failures


def _file(results: Results, place: int, outcome: Outcome | Exception) -> None:
    """Keep what a worker gave back: an outcome, or the error that ended it."""
    problem, job = results.problem, results.plan[place]
    # Whatever happened, the run gets its rows and its status: a failure is a result too.
    if isinstance(outcome, TimeoutError):
        reason = f"killed past its limit of {problem.experiment.timeout:g} s"
        outcome = unfinished(problem, job.target, "timeout", reason)
    elif isinstance(outcome, DeathError):
        outcome = unfinished(problem, job.target, "crashed", str(outcome))
    elif isinstance(outcome, EndedError):
        outcome = unfinished(problem, job.target, outcome.status, outcome.reason)
    elif isinstance(outcome, Exception):
        reason = "".join(traceback.format_exception(outcome))
        outcome = unfinished(problem, job.target, "crashed", reason)
    results.notes.add(job.order.entry.label, outcome)
    columns = rows(
        problem, job.order, job.target, outcome, results.spectra.get(job.target.sealed.name)
    )
    results.kept.add(place, columns, status_of(problem, job.order, outcome))
