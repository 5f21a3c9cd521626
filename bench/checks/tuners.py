"""Conformance of a tuner; each check takes the tuner's class, and works on its default options."""

from __future__ import annotations

import hashlib
import inspect
import pickle
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from bench.checks.base import CheckError, global_random_state_untouched, require, same_bits
from bench.checks.processes import elsewhere
from bench.runs.drive import Trace, drive
from methods.base import NOTHING, Ask, BudgetExceededError, Evaluation, Steps, Task, Tuner
from sims.base import Array

_TIMES = np.linspace(0.0, 3.0, 40)
_FIT_BUDGET = 240
_NAME = re.compile(r"[a-z][a-z0-9_-]*$")


def _observe(points: Array) -> Array:
    """A smooth, identifiable toy simulator: (n, 40, 2) from (n, dim) points of the unit cube."""
    phases = np.arange(1, points.shape[1] + 1)
    rates = 0.5 + 0.6 * points
    waves = np.cos(rates[:, None, :] * _TIMES[:, None] + 0.3 * phases) / phases
    slopes = np.exp(-rates[:, None, :] * _TIMES[:, None]) * (1.0 + 0.1 * phases)
    return np.stack([waves.sum(axis=2), slopes.sum(axis=2)], axis=2)


class _Practice:
    """Practice ground on the toy simulator."""

    def __init__(self, dim: int) -> None:
        self.dim, self.scale = dim, np.ones(2)
        self.lengths: tuple[int, ...] = (_TIMES.size,)
        self.scene = NOTHING
        self.training = np.array([[0.25] * dim, [0.75] * dim])
        self.used, self.budget = 0, _FIT_BUDGET

    def sample(self, rng: np.random.Generator, n: int) -> Array:
        return rng.uniform(0.25, 0.75, size=(n, self.dim))

    def simulate(self, rng: np.random.Generator, points: Array) -> Array:  # noqa: ARG002
        if not ((points >= 0.25) & (points <= 0.75)).all():
            raise CheckError(
                "expected training inside the training range; found a point outside; see `fit`"
            )
        self.used += len(points)
        if self.used > self.budget:
            raise BudgetExceededError(f"{self.used} training simulations, {self.budget} allowed")
        return _observe(points)


_learned: dict[tuple[type[Tuner], int], dict[str, Array]] = {}


def ready(kind: type[Tuner], dim: int, anew: bool = False) -> Tuner:
    """A tuner of this kind, trained on the toy simulator if it is a learned one: once a process,
    unless anew.
    """
    tuner = kind()
    if not anew and (kind, dim) in _learned:
        tuner.restore(_learned[kind, dim])
        return tuner
    tuner.fit(_Practice(dim), np.random.default_rng(0), _FIT_BUDGET)
    if kind.learned:
        _learned[kind, dim] = tuner.state()
    return tuner


def _task(dim: int, budget: int, seed: int = 0) -> tuple[Task, Array]:
    rng = np.random.default_rng(seed)
    truth, start = rng.uniform(0.3, 0.7, size=(2, dim))
    observed = _observe(truth[None])[0]
    training = np.array([[0.25] * dim, [0.75] * dim])
    for array in (observed, start, training):
        array.setflags(write=False)
    return Task(dim, start, observed, np.ones(2), training, budget, (_TIMES.size,)), truth


def _run(
    tuner: Tuner,
    dim: int,
    budget: int,
    seed: int = 0,
    fails: Callable[[int], bool] = lambda _: False,
    target: int = 0,
) -> Trace:
    """One run; simulation number k fails where `fails(k)`."""
    task, _ = _task(dim, budget, target)
    simulated = 0

    def evaluate(points: Array) -> tuple[Array, Array]:
        nonlocal simulated
        observations = _observe(points)
        for lane in observations:
            simulated += 1
            if fails(simulated):
                lane[:] = np.nan
        losses = np.sqrt(((observations - task.observed) ** 2).mean(axis=(1, 2)))
        losses[np.isnan(losses)] = np.inf
        return observations, losses

    return drive(tuner, task, evaluate, np.random.default_rng(seed))


def _ended_well(kind: type[Tuner], trace: Trace, when: str) -> None:
    found, look = f"{trace.status}: {trace.reason}", f"{kind.__name__}.tune"
    require(trace.status in ("done", "converged"), f"a run that ends well {when}", found, look)


def check_api_is_complete(kind: type[Tuner]) -> None:
    """A plain name; made without arguments; `tune` is a generator; a learned one has fit, state and
    restore.
    """
    look = kind.__name__
    require(bool(_NAME.match(kind.name)), "a name in lower case", repr(kind.name), f"{look}.name")
    try:
        tuner = kind()
    except TypeError as error:
        raise CheckError(
            f"expected a default for every option; found {error}; see {look}.__init__"
        ) from None
    steps = ready(kind, 2).tune(_task(2, 5)[0], np.random.default_rng(0))
    require(
        inspect.isgenerator(steps),
        "a generator (with a yield)",
        type(steps).__name__,
        f"{look}.tune",
    )
    if tuner.learned:
        missing = [
            name
            for name in ("fit", "state", "restore")
            if getattr(kind, name) is getattr(Tuner, name)
        ]
        require(
            not missing,
            "fit, state and restore of a learned tuner",
            f"no {', '.join(missing)}",
            look,
        )


def check_runs_in_one_and_in_ten_dimensions(kind: type[Tuner]) -> None:
    """It works whatever the number of parameters."""
    for dim in (1, 10):
        _ended_well(kind, _run(ready(kind, dim), dim, 25), f"with {dim} parameters")


def check_budget_is_exact(kind: type[Tuner]) -> None:
    """Budgets 1 to 7 are used, never overshot; ending early is said as a reason."""
    tuner = ready(kind, 2)
    for budget in range(1, 8):
        trace = _run(tuner, 2, budget)
        _ended_well(kind, trace, f"with budget {budget}")
        used = len(trace.losses)
        exact = used == budget or (trace.status == "converged" and used < budget)
        require(exact, f"{budget} simulations", used, f"{kind.__name__}.tune")


def check_arguments_are_not_changed(kind: type[Tuner]) -> None:
    """The task and the evaluations are the harness's: nothing in them is written to."""
    task, _ = _task(2, 20)
    task = replace(
        task, start=task.start.copy(), observed=task.observed.copy(), training=task.training.copy()
    )
    given = [task.start, task.observed, task.scale, task.training]
    before = [array.copy() for array in given]
    steps = ready(kind, 2).tune(task, np.random.default_rng(0))
    try:
        asked = next(steps)
        for _ in range(10):
            points = np.array(
                asked[0] if isinstance(asked, Ask) else asked, dtype=np.float64, ndmin=2
            ).clip(0.0, 1.0)
            observations = _observe(points)
            losses = np.sqrt(((observations - task.observed) ** 2).mean(axis=(1, 2)))
            shown = [points, observations, losses]
            given, before = given + shown, before + [array.copy() for array in shown]
            asked = steps.send(Evaluation(points, observations, losses))
    except StopIteration:
        pass
    finally:
        steps.close()
    changed = [a.shape for a, b in zip(given, before, strict=True) if not same_bits(a, b)]
    require(
        not changed,
        "arguments as they were",
        f"changed arrays of shapes {changed}",
        f"{kind.__name__}.tune",
    )


def check_proposals_stay_in_the_unit_cube(kind: type[Tuner]) -> None:
    """Nothing outside 0..1 is proposed or recommended: the harness would move it, and the tuner not
    know.
    """
    asked: list[Array] = []

    class Watched(Tuner):
        def tune(self, task: Task, rng: np.random.Generator) -> Steps:
            steps = ready(kind, 2).tune(task, rng)
            try:
                wanted = next(steps)
                while True:
                    points, recommended = wanted if isinstance(wanted, Ask) else (wanted, None)
                    asked.extend(np.atleast_2d(p) for p in (points, recommended) if p is not None)
                    wanted = steps.send((yield wanted))
            except StopIteration as stop:
                return str(stop.value)
            finally:
                steps.close()

    _run(Watched(), 2, 30)
    given = np.concatenate(asked)
    outside = given[~((given >= 0.0) & (given <= 1.0)).all(axis=1)]
    require(not len(outside), "points inside the unit cube", outside[:1], f"{kind.__name__}.tune")


def check_same_seed_gives_the_same_run(kind: type[Tuner]) -> None:
    """Two runs with one seed agree bit for bit, also when global generators stand elsewhere."""
    tuner = ready(kind, 2)
    first = _run(tuner, 2, 25, seed=3)
    saved = np.random.get_state()  # noqa: NPY002
    np.random.seed(12345)  # noqa: NPY002 - a tuner that draws from it would now differ
    try:
        second = _run(tuner, 2, 25, seed=3)
    finally:
        np.random.set_state(saved)  # noqa: NPY002
    same = same_bits(first.proposals, second.proposals) and same_bits(
        first.recommendations, second.recommendations
    )
    require(same, "the same run for the same seed", "another", f"{kind.__name__}.tune: use rng")


def check_runs_do_not_touch_each_other(kind: type[Tuner]) -> None:
    """A run on an instance that has run before equals one on a fresh instance."""
    used = ready(kind, 2)
    _run(used, 2, 15, seed=1)
    again, fresh = _run(used, 2, 15, seed=2), _run(ready(kind, 2), 2, 15, seed=2)
    same = same_bits(again.proposals, fresh.proposals)
    require(
        same,
        "nothing kept from run to run",
        "a different run",
        f"what {kind.__name__}.tune keeps in self",
    )


def check_global_random_state_is_left_alone(kind: type[Tuner]) -> None:
    """Neither training nor tuning draws from or seeds a global generator."""
    _run(ready(kind, 2), 2, 3)  # import what it imports lazily
    with global_random_state_untouched(f"{kind.__name__}.fit and .tune: use rng"):
        _run(ready(kind, 2, anew=True), 2, 15)


def check_stochastic_is_declared(kind: type[Tuner]) -> None:
    """A tuner that calls itself not stochastic gives the same run for every seed."""
    if kind.stochastic:
        return
    tuner = ready(kind, 2)
    same = same_bits(_run(tuner, 2, 15, seed=1).proposals, _run(tuner, 2, 15, seed=2).proposals)
    require(
        same, "stochastic = True", "another run with another seed", f"{kind.__name__}.stochastic"
    )


def check_failed_simulations_are_survived(kind: type[Tuner]) -> None:
    """The first simulation, some, or all of them give NaN and an infinite loss: the run still ends
    well.
    """
    tuner = ready(kind, 2)
    for fails, when in (
        (lambda k: k == 1, "when the first simulation fails"),
        (lambda k: k % 3 == 0, "when every third simulation fails"),
        (lambda _: True, "when every simulation fails"),
    ):
        _ended_well(kind, _run(tuner, 2, 15, fails=fails), when)


def check_easy_problem_is_improved(kind: type[Tuner]) -> None:
    """On a smooth, identifiable problem the recommendation after 60 simulations is better than the
    start.
    """
    trace = _run(ready(kind, 2), 2, 60)
    task, truth = _task(2, 60)
    before, after = (
        np.abs(point - truth).mean() for point in (task.start, trace.recommendations[-1])
    )
    require(
        after < before / 2,
        f"an error below half of the start's, {before / 2:.3g}",
        f"{after:.3g}",
        kind.__name__,
    )


_LOOKS = (6, 12, 24)
"""Targets after which `check_beats_random_search` looks; each look may be wrong in a third of 5 %.
"""


def check_beats_random_search(kind: type[Tuner]) -> None:
    """On targets of the easy problem its errors after 30 simulations are below random search's.

    One-sided Wilcoxon signed-rank tests of the paired log errors (scipy) at 5 % over at most three
    looks, so that a clear case is soon done.
    """
    from scipy.stats import wilcoxon

    tuner, chance = ready(kind, 2), _Chance()
    logs: list[Array] = []
    for look in _LOOKS:
        logs += [_final_logs((tuner, chance), target) for target in range(len(logs), look)]
        mine, random = np.array(logs).T
        p = (
            float(wilcoxon(mine, random, alternative="less").pvalue)
            if (mine != random).any()
            else 1.0
        )
        if p < 0.05 / len(_LOOKS):
            return
    found = f"p = {p:.2g}, median error {np.exp(np.median(mine)):.2g} against {np.exp(np.median(random)):.2g}"
    expected = f"errors below random search's (p < {0.05 / len(_LOOKS):.2g})"
    raise CheckError(f"expected {expected}; found {found}; see {kind.__name__}.tune")


def _final_logs(subjects: tuple[Tuner, ...], target: int) -> Array:
    """Logarithms of the errors with which these tuners end on one target."""
    _, truth = _task(2, 30, target)
    traces = [_run(tuner, 2, 30, seed=target, target=target) for tuner in subjects]
    return np.log(
        [max(np.abs(trace.recommendations[-1] - truth).mean(), 1e-12) for trace in traces]
    )


class _Chance(Tuner):
    """What every tuner should beat."""

    def tune(self, task: Task, rng: np.random.Generator) -> Steps:
        """Uniform points."""
        while True:
            yield rng.uniform(size=(1, task.dim))


def run_digests(
    kind: type[Tuner], seeds: tuple[int, ...], learned: dict[str, Array] | None = None
) -> list[str]:
    """Hashes of a run with each seed, for comparison between processes; trains unless it is given
    what was learned.
    """
    if learned:
        _learned[kind, 2] = learned
    traces = [_run(ready(kind, 2), 2, 12, seed) for seed in seeds]
    return [
        hashlib.sha256(t.proposals.tobytes() + t.recommendations.tobytes()).hexdigest()[:16]
        for t in traces
    ]


def check_same_run_in_other_processes(kind: type[Tuner]) -> None:
    """The same seeds give the same bits here, in another process, and in 1 and in 4 workers."""
    look = f"{kind.__name__}: what depends on the process, e.g. hash(), the clock, threads"
    seeds = (0, 1, 2, 3)
    here = run_digests(kind, seeds)
    for workers, learned in ((1, None), (4, _learned.get((kind, 2)))):
        there = elsewhere(run_digests, [(kind, (seed,), learned) for seed in seeds], workers, kind)
        ended = [str(digest) for digest in there if isinstance(digest, Exception)]
        require(not ended, f"runs that end in {workers} worker(s)", ended[:1], look)
        same = [digest for (digest,) in there] == here
        require(same, f"the same runs in {workers} worker(s) as in this process", "others", look)


def check_what_was_learned_can_be_stored(kind: type[Tuner]) -> None:
    """`state` and `restore` round-trip through plain arrays; arrays of another tuner are refused."""
    if not kind.learned:
        return
    tuner, other = ready(kind, 2), kind()
    state = tuner.state()
    plain = all(isinstance(a, np.ndarray) and a.dtype.kind in "fiu" for a in state.values())
    found = {name: type(array) for name, array in state.items()}
    require(bool(state) and plain, "plain numeric arrays", found, f"{kind.__name__}.state")
    other.restore(state)
    same = same_bits(_run(tuner, 2, 5).proposals, _run(other, 2, 5).proposals)
    require(same, "the same run after restore", "another one", f"{kind.__name__}.restore")
    try:
        kind().restore({"weights": np.zeros(3)})
    except ValueError:
        return
    raise CheckError(
        f"expected ValueError for foreign weights; found none; see {kind.__name__}.restore"
    )


def check_instances_can_be_sent_to_workers(kind: type[Tuner]) -> None:
    """An instance and its options survive pickling."""
    try:
        pickle.loads(pickle.dumps(kind()))
    except Exception as error:
        raise CheckError(
            f"expected a tuner that can be pickled; found {error!r}; see {kind.__name__}"
        ) from error


TUNER_CHECKS: tuple[Callable[[type[Tuner]], None], ...] = (
    check_api_is_complete,
    check_runs_in_one_and_in_ten_dimensions,
    check_budget_is_exact,
    check_arguments_are_not_changed,
    check_proposals_stay_in_the_unit_cube,
    check_same_seed_gives_the_same_run,
    check_same_run_in_other_processes,
    check_runs_do_not_touch_each_other,
    check_global_random_state_is_left_alone,
    check_stochastic_is_declared,
    check_failed_simulations_are_survived,
    check_easy_problem_is_improved,
    check_beats_random_search,
    check_what_was_learned_can_be_stored,
    check_instances_can_be_sent_to_workers,
)
