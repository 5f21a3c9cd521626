"""Conformance checks of a tuner, with its default options and in its isolated process."""

from __future__ import annotations

import hashlib
import inspect
import pickle
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from bench.benchmark.isolation.isolation_layers import PROJECT_ROOT
from bench.benchmark.isolation.process_errors import KilledExternallyError, RunEndedError
from bench.benchmark.isolation.tuner_processes import IsolatedRun, TunerSpec
from bench.benchmark.runner.preloadable_packages import find_preloadable_packages
from bench.benchmark.runner.tuner_loop import RunTrace, drive_tuner
from bench.benchmark.runner.tuner_process_start import start_isolated_tuner
from bench.conformance.check_base import (
    Check,
    CheckError,
    NotApplicable,
    call_in_processes,
    check,
    check_global_random_state,
    is_bitwise_equal,
)
from bench.conformance.toy_systems import (
    SAMPLE_TIMES,
    TRAINING_RANGE_HIGH,
    TRAINING_RANGE_LOW,
    make_evaluate,
    make_task,
    simulate_toy_problem,
)
from methods.tuner import (
    EMPTY_SCENE,
    BudgetExceededError,
    Evaluation,
    Proposal,
    Task,
    Tuner,
    TunerGenerator,
)
from sims.core.simulator import Array

_NAME = re.compile(r"[a-z][a-z0-9_-]*$")
"""Pattern of a tuner's name."""
_RUN_SIMULATIONS = 5
"""Number of simulations of a run, enough for a tuner to use all of its features."""
_SEED = 0
"""Seed of the runs that are compared."""
_SIGNIFICANCE_LEVEL = 0.05
"""Significance level of the comparison with random search, over all targets together."""
_SEQUENTIAL_TEST_TARGETS = (6, 12, 24)
"""Numbers of targets after which random search is compared, each at a third of 5 %."""
FIT_BUDGET = 240
"""Number of training simulations of a trained tuner; small, so that the suite is fast."""
TRAINED_TUNERS: dict[tuple[type[Tuner], int], dict[str, Array]] = {}
"""Trained state of each tuner in this process, by class and dimension, because training is slow."""


def make_trained_tuner(kind: type[Tuner], dim: int = 2, anew: bool = False) -> Tuner:
    """Make a tuner, trained on the toy problem if necessary.

    Args:
        kind: class of the tuner.
        dim: number of parameters.
        anew: whether to train again instead of using the cached state.
    """
    tuner = kind()
    if not anew and (kind, dim) in TRAINED_TUNERS:
        tuner.restore(TRAINED_TUNERS[kind, dim])
        return tuner
    tuner.fit(ToyTrainingSimulator(dim), np.random.default_rng(0), FIT_BUDGET)
    if kind.learned:
        TRAINED_TUNERS[kind, dim] = tuner.state()
    return tuner


def run_tuner(
    tuner: Tuner,
    budget: int,
    dim: int = 2,
    seed: int = 0,
    fails: Callable[[int], bool] = lambda _: False,
    target: int = 0,
) -> RunTrace:
    """Run a tuner on the toy problem.

    Args:
        tuner: instance of the tuner.
        budget: maximum number of simulations.
        dim: number of parameters.
        seed: seed of the run.
        fails: returns whether simulation number k fails.
        target: seed of the task.
    """
    task, _ = make_task(budget, dim, target)
    evaluate = make_evaluate(task, fails)
    return drive_tuner(tuner, task, evaluate, np.random.default_rng(seed))


class ToyTrainingSimulator:
    """Training simulator of the toy problem; see `methods.tuner.TrainingSimulator`."""

    def __init__(self, dim: int) -> None:
        """Set the sizes of the toy problem: two channels of 40 samples, and `dim` parameters."""
        self.dim, self.scale = dim, np.ones(2)
        self.lengths: tuple[int, ...] = (SAMPLE_TIMES.size,)
        self.scene = EMPTY_SCENE
        self.training = np.array([[TRAINING_RANGE_LOW] * dim, [TRAINING_RANGE_HIGH] * dim])
        self.used, self.budget = 0, FIT_BUDGET

    def sample(self, rng: np.random.Generator, n: int) -> Array:
        """Draw parameters uniformly from the training range.

        Args:
            rng: random generator.
            n: number of points.
        """
        return rng.uniform(TRAINING_RANGE_LOW, TRAINING_RANGE_HIGH, size=(n, self.dim))

    def simulate(self, rng: np.random.Generator, points: Array) -> Array:  # noqa: ARG002
        """Simulate points, and count the simulations.

        Args:
            rng: not used.
            points: points in the unit cube, (n, dim).

        Returns:
            Observations, (n, 40, 2).

        Raises:
            CheckError: a point is outside the training range.
            BudgetExceededError: the training budget is exceeded.
        """
        if not ((points >= TRAINING_RANGE_LOW) & (points <= TRAINING_RANGE_HIGH)).all():
            raise CheckError(
                "expected training inside the training range; found a point outside; see `fit`"
            )
        self.used += len(points)
        if self.used > self.budget:
            raise BudgetExceededError(f"{self.used} training simulations, {self.budget} allowed")
        return simulate_toy_problem(points)


def _check_run_completed(kind: type[Tuner], trace: RunTrace, condition: str) -> None:
    """Check that a run of the tuner was not ended by an error or a time limit.

    Args:
        kind: class of the tuner.
        trace: trace of the run.
        condition: circumstances of the run in words, the end of the message.

    Raises:
        CheckError: the run failed.
    """
    outcome, location = f"{trace.status}: {trace.reason}", f"{kind.__name__}.tune"
    check(
        trace.status in ("done", "converged"),
        f"a run that ends well {condition}",
        outcome,
        location,
    )


def check_api_is_complete(kind: type[Tuner]) -> None:
    """Check that the interface of the tuner is complete.

    It needs a valid name, default options, a generator `tune` and, if it is trained, `fit`, `state`
    and `restore`.
    """
    location = kind.__name__
    check(bool(_NAME.match(kind.name)), "a name in lower case", repr(kind.name), f"{location}.name")
    try:
        tuner = kind()
    except TypeError as error:
        raise CheckError(
            f"expected a default for every option; found {error}; see {location}.__init__"
        ) from None
    # The returned object is tested: a `tune` that returns a list would only fail in the harness's
    # loop. A learned tuner must be trained before.
    steps = make_trained_tuner(kind).tune(make_task(budget=5)[0], np.random.default_rng(0))
    check(
        inspect.isgenerator(steps),
        "a generator (with a yield)",
        type(steps).__name__,
        f"{location}.tune",
    )
    if tuner.learned:
        missing = [
            name
            for name in ("fit", "state", "restore")
            if getattr(kind, name) is getattr(Tuner, name)
        ]
        check(
            not missing,
            "fit, state and restore of a learned tuner",
            f"no {', '.join(missing)}",
            location,
        )


def check_runs_in_one_and_in_ten_dimensions(kind: type[Tuner]) -> None:
    """Check that the tuner works with one and with ten parameters."""
    # With one parameter, vector code meets a scalar; with ten, a full grid does not fit into
    # memory.
    for dim in (1, 10):
        _check_run_completed(
            kind,
            run_tuner(make_trained_tuner(kind, dim), dim=dim, budget=25),
            f"with {dim} parameters",
        )


def check_budget_is_exact(kind: type[Tuner]) -> None:
    """Check that budgets of 1 to 7 simulations are used and never exceeded.

    A tuner may end early if it gives a reason.
    """
    tuner = make_trained_tuner(kind)
    # Populations are larger than these budgets, so a batch must be cut.
    for budget in range(1, 8):
        trace = run_tuner(tuner, budget=budget)
        _check_run_completed(kind, trace, f"with budget {budget}")
        # Fewer simulations are correct if the tuner gives a reason.
        used_simulations = len(trace.losses)
        is_exact = used_simulations == budget or (
            trace.status == "converged" and used_simulations < budget
        )
        check(is_exact, f"{budget} simulations", used_simulations, f"{kind.__name__}.tune")


class _InspectedTuner(Tuner):
    """Tuner under test, whose proposals and received arrays are kept.

    The harness would clip the proposals, and its arrays are read-only: a tuner that writes to them
    would crash before the check could report it. Here it receives copies.

    Attributes:
        proposals: (n, dim) proposed and recommended points.
        received: arrays that the tuner received, each with its original.
    """

    def __init__(self, tuner: Tuner) -> None:
        """Wrap a trained tuner."""
        self.tuner = tuner
        self.proposals: list[Array] = []
        self.received: list[tuple[Array, Array]] = []

    def _copy(self, original: Array) -> Array:
        copied = original.copy()
        self.received.append((copied, original))
        return copied

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:
        """Run the tuner unchanged, and keep what it proposes and receives.

        Args:
            task: number of parameters and budget.
            rng: random numbers of the tuner.
        """
        copied_task = replace(
            task,
            start=self._copy(task.start),
            observed=self._copy(task.observed),
            scale=self._copy(task.scale),
            training=self._copy(task.training),
        )
        steps = self.tuner.tune(copied_task, rng)
        try:
            proposal = next(steps)
            while True:
                # A plain array has points without a recommendation.
                points, recommended = (
                    proposal if isinstance(proposal, Proposal) else (proposal, None)
                )
                self.proposals += [
                    np.atleast_2d(point) for point in (points, recommended) if point is not None
                ]
                # Let the harness simulate the points, and pass the result on to the tuner.
                evaluation = yield proposal
                proposal = steps.send(Evaluation(*map(self._copy, evaluation)))
        except StopIteration as stop:
            return str(stop.value)
        finally:
            steps.close()


def _inspect_run(kind: type[Tuner]) -> _InspectedTuner:
    """Run the tuner under test on the toy problem with 30 simulations, and return what it did."""
    inspected = _InspectedTuner(make_trained_tuner(kind))
    run_tuner(inspected, budget=30)
    return inspected


def check_arguments_are_not_changed(kind: type[Tuner]) -> None:
    """Check that the tuner does not write to the task and the evaluations of the harness."""
    changed = [
        original.shape
        for copied, original in _inspect_run(kind).received
        if not is_bitwise_equal(copied, original)
    ]
    check(
        not changed,
        "unchanged arguments",
        f"changed arrays of shapes {changed}",
        f"{kind.__name__}.tune",
    )


def check_proposals_stay_in_the_unit_cube(kind: type[Tuner]) -> None:
    """Check that all proposals and recommendations are in the unit cube.

    The harness would clip others without informing the tuner.
    """
    all_points = np.concatenate(_inspect_run(kind).proposals)
    outside = all_points[~((all_points >= 0.0) & (all_points <= 1.0)).all(axis=1)]
    check(not len(outside), "points inside the unit cube", outside[:1], f"{kind.__name__}.tune")


def check_same_seed_gives_the_same_run(kind: type[Tuner]) -> None:
    """Check that two runs with the same seed agree bit for bit.

    The global random generators have different states in the two runs.
    """
    # Two runs of one instance, because state left by a run must not matter either.
    tuner = make_trained_tuner(kind)
    first_run = run_tuner(tuner, budget=25, seed=3)
    saved_state = np.random.get_state()  # noqa: NPY002
    np.random.seed(12345)  # noqa: NPY002 - a tuner that draws from it would now differ
    try:
        second_run = run_tuner(tuner, budget=25, seed=3)
    finally:
        np.random.set_state(saved_state)  # noqa: NPY002
    is_same = is_bitwise_equal(first_run.proposals, second_run.proposals) and is_bitwise_equal(
        first_run.recommendations, second_run.recommendations
    )
    check(is_same, "the same run for the same seed", "another", f"{kind.__name__}.tune: use rng")


def check_runs_do_not_touch_each_other(kind: type[Tuner]) -> None:
    """Check that a run on a used instance equals one on a fresh instance.

    A tuner that keeps state in `self` between runs would make results depend on their order.

    Args:
        kind: Tuner class under test.
    """
    used_tuner = make_trained_tuner(kind)
    run_tuner(used_tuner, budget=15, seed=1)
    used_trace = run_tuner(used_tuner, budget=15, seed=2)
    fresh_trace = run_tuner(make_trained_tuner(kind), budget=15, seed=2)
    is_same = is_bitwise_equal(used_trace.proposals, fresh_trace.proposals)
    check(
        is_same,
        "no state kept between runs",
        "a different run",
        f"what {kind.__name__}.tune keeps in self",
    )


def check_global_random_state_is_left_alone(kind: type[Tuner]) -> None:
    """Check that neither training nor tuning uses or seeds a global random generator."""
    run_tuner(make_trained_tuner(kind), budget=3)  # performs lazy imports
    with check_global_random_state(f"{kind.__name__}.fit and .tune: use rng"):
        run_tuner(make_trained_tuner(kind, anew=True), budget=15)


def check_stochastic_is_declared(kind: type[Tuner]) -> NotApplicable | None:
    """Check that a tuner declared as not stochastic gives the same run for every seed.

    The harness repeats only stochastic tuners with several seeds.

    Args:
        kind: Tuner class under test.

    Returns:
        A reason why the check is not applicable; None if it passed.
    """
    if kind.stochastic:
        return NotApplicable("it declares that it is random")
    tuner = make_trained_tuner(kind)
    is_same = is_bitwise_equal(
        run_tuner(tuner, budget=15, seed=1).proposals,
        run_tuner(tuner, budget=15, seed=2).proposals,
    )
    location = f"{kind.__name__}.stochastic"
    check(is_same, "stochastic = True", "another run with another seed", location)
    return None


def check_failed_simulations_are_survived(kind: type[Tuner]) -> None:
    """Check that the tuner tolerates simulations that give NaN and an infinite loss.

    The first simulation, every third one, or all of them fail.
    """
    tuner = make_trained_tuner(kind)
    # Methods start from the first simulation; if all fail, nothing can be fitted. k counts from 1.
    for fails, condition in (
        (lambda k: k == 1, "when the first simulation fails"),
        (lambda k: k % 3 == 0, "when every third simulation fails"),
        (lambda _: True, "when every simulation fails"),
    ):
        trace = run_tuner(tuner, budget=15, fails=fails)
        # A run without a finite loss has the status `diverged`, however the tuner ends it.
        if trace.status != "diverged" or np.isfinite(trace.losses).any():
            _check_run_completed(kind, trace, condition)


def check_easy_problem_is_improved(kind: type[Tuner]) -> None:
    """Check that the tuner improves the start on a smooth, identifiable problem.

    The error of the recommendation after 60 simulations must be below half of the start's.
    """
    trace = run_tuner(make_trained_tuner(kind), budget=60)
    task, truth = make_task(budget=60)
    initial_error, final_error = (
        np.abs(point - truth).mean() for point in (task.start, trace.recommendations[-1])
    )
    check(
        final_error < initial_error / 2,
        f"an error below half of the start's, {initial_error / 2:.3g}",
        f"{final_error:.3g}",
        kind.__name__,
    )


def check_beats_random_search(kind: type[Tuner]) -> None:
    """Check that errors after 30 simulations on the easy problem are below those of random search.

    The test is a one-sided Wilcoxon signed-rank test of the paired log errors (scipy), at 5 % over
    at most three looks, so that a clear case is decided early.
    """
    from scipy.stats import wilcoxon

    tuner, random_search = make_trained_tuner(kind), _RandomSearchBaseline()
    # Bonferroni correction: three looks at 5 % in total.
    level = _SIGNIFICANCE_LEVEL / len(_SEQUENTIAL_TEST_TARGETS)
    log_errors: list[Array] = []  # of the tuner and of random search, one pair per target
    for target_count in _SEQUENTIAL_TEST_TARGETS:
        log_errors += [
            _compute_final_log_errors((tuner, random_search), target)
            for target in range(len(log_errors), target_count)
        ]
        tuner_logs, random_logs = np.array(log_errors).T
        p_value = 1.0  # the test is undefined without a difference
        if (tuner_logs != random_logs).any():
            p_value = float(wilcoxon(tuner_logs, random_logs, alternative="less").pvalue)
        if p_value < level:
            return
    medians = [f"{np.exp(np.median(logs)):.2g}" for logs in (tuner_logs, random_logs)]
    found_text = f"p = {p_value:.2g}, median error {' against '.join(medians)}"
    expected = f"errors below random search's (p < {level:.2g})"
    raise CheckError(f"expected {expected}; found {found_text}; see {kind.__name__}.tune")


def _compute_final_log_errors(subjects: tuple[Tuner, ...], target: int) -> Array:
    """Compute the logarithms of the final errors of several tuners on one target.

    Each runs on the toy problem with 2 parameters and 30 simulations. The error is the mean
    absolute error of the recommendation, at least 1e-12, so that its logarithm is finite.

    Args:
        subjects: the tuners.
        target: number of the target, which is also the seed.
    """
    _, truth = make_task(budget=30, seed=target)
    traces = [run_tuner(tuner, budget=30, seed=target, target=target) for tuner in subjects]
    return np.log(
        [max(np.abs(trace.recommendations[-1] - truth).mean(), 1e-12) for trace in traces]
    )


class _RandomSearchBaseline(Tuner):
    """Random search, the baseline that every tuner should beat."""

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:
        """Propose uniformly distributed points.

        Args:
            task: number of parameters and budget.
            rng: random numbers of the tuner.
        """
        while True:
            yield rng.uniform(size=(1, task.dim))


def compute_run_digests(
    kind: type[Tuner], seeds: tuple[int, ...], learned: dict[str, Array] | None = None
) -> list[str]:
    """Compute a hash of a run for each seed, for comparison between processes.

    Args:
        kind: class of the tuner.
        seeds: seeds of the runs.
        learned: trained state; None to train if necessary.

    Returns:
        A hash of proposals and recommendations for each seed.
    """
    # The runs have two parameters; a stored state of this dimension prevents a training.
    if learned:
        TRAINED_TUNERS[kind, 2] = learned
    traces = [run_tuner(make_trained_tuner(kind), budget=12, seed=seed) for seed in seeds]
    return [
        hashlib.sha256(trace.proposals.tobytes() + trace.recommendations.tobytes()).hexdigest()[:16]
        for trace in traces
    ]


def check_same_run_in_other_processes(kind: type[Tuner]) -> None:
    """Check that runs agree bit for bit here, in another process, and in 1 and 4 workers.

    Results must not depend on the number of workers, else a comparison could not be repeated
    elsewhere. Runs are compared by digests of their proposals.

    Args:
        kind: Tuner class under test.
    """
    location = f"{kind.__name__}: what depends on the process, e.g. hash(), the clock, threads"
    seeds = (0, 1, 2, 3)
    local_digests = compute_run_digests(kind, seeds)
    # One worker trains by itself, four get the state trained here; all must agree with this
    # process.
    for workers, trained_tuner in ((1, None), (4, TRAINED_TUNERS.get((kind, 2)))):
        other_outcomes = call_in_processes(
            compute_run_digests, [(kind, (seed,), trained_tuner) for seed in seeds], workers, kind
        )
        failures = [str(digest) for digest in other_outcomes if isinstance(digest, Exception)]
        check(not failures, f"runs that end in {workers} worker(s)", failures[:1], location)
        is_same = [digest for (digest,) in other_outcomes] == local_digests
        check(
            is_same, f"the same runs in {workers} worker(s) as in this process", "others", location
        )


def check_same_run_when_sealed(kind: type[Tuner]) -> NotApplicable | None:
    """Check that the tuner runs in an isolated process, with the same result as in this process.

    An isolated process cannot start other processes and cannot access files or the network. A tuner
    that a comparison evaluates runs in such a process.

    Args:
        kind: Tuner class under test.

    Returns:
        A reason why the check is not applicable; None if it passed.
    """
    tuned = _make_tuner_spec(kind)
    if tuned is None:
        return NotApplicable("its class is in no plugin file and no installed package")
    local_trace = run_tuner(make_trained_tuner(kind), budget=_RUN_SIMULATIONS, seed=_SEED)
    state = make_trained_tuner(kind).state() if kind.learned else None
    task, _ = make_task(budget=_RUN_SIMULATIONS)
    location = f"{kind.__name__}: what needs files, the network or processes; docs/isolation.md"
    try:
        with start_isolated_tuner(tuned, _SEED, "run", state=state) as tuner:
            # The isolated process makes the same random generator from this seed.
            seed_words = np.array([_SEED], dtype=np.uint32)
            isolated_run = IsolatedRun(tuner, seed_words, float("inf"))
            isolated_trace = drive_tuner(
                isolated_run, task, make_evaluate(task), np.random.default_rng(_SEED)
            )
    except (RunEndedError, KilledExternallyError) as error:
        last_line = str(error).strip().splitlines()[-1:]
        raise CheckError(
            f"expected a run in a process of its own; found {last_line}; see {location}"
        ) from None
    end_text = (
        isolated_trace.reason.strip().splitlines()[-1:]
        if isolated_trace.status != local_trace.status
        else ""
    )
    check(
        isolated_trace.status == local_trace.status,
        f"the status {local_trace.status} when isolated",
        end_text,
        location,
    )
    is_same = np.array_equal(isolated_trace.proposals, local_trace.proposals)
    check(is_same, "the same run when isolated", "another one", location)
    return None


def _make_tuner_spec(kind: type[Tuner]) -> TunerSpec | None:
    """Return the tuner specification for an isolated process; None if the class cannot load.

    The specification says from which module or plugin file another process loads the class.

    Args:
        kind: Tuner class under test.
    """
    module = sys.modules.get(kind.__module__)
    # A class that a function or a notebook cell defines is not in its module under its name.
    if getattr(module, kind.__name__, None) is not kind:
        return None
    file = inspect.getsourcefile(kind) or ""
    if kind.__module__.startswith("simgap_plugin_"):
        return TunerSpec(kind.name, "", file, {}, find_preloadable_packages(file))
    # A class of a script or a test is in a file that an isolated process cannot read.
    if not (file.startswith(str(PROJECT_ROOT / "methods")) or "site-packages" in file):
        return None
    return TunerSpec(kind.name, kind.__module__, "", {}, find_preloadable_packages(file))


def check_what_was_learned_can_be_stored(kind: type[Tuner]) -> NotApplicable | None:
    """Check that `state` and `restore` round-trip, and that the state of another tuner is rejected.

    The state must consist of plain numeric arrays.
    """
    if not kind.learned:
        return NotApplicable("it does not learn")
    tuner, restored_tuner = make_trained_tuner(kind), kind()
    state = tuner.state()
    # Floating-point numbers, integers and unsigned integers.
    is_numeric = all(
        isinstance(array, np.ndarray) and array.dtype.kind in "fiu" for array in state.values()
    )
    array_types = {name: type(array) for name, array in state.items()}
    check(bool(state) and is_numeric, "plain numeric arrays", array_types, f"{kind.__name__}.state")
    # A run is compared and not only the arrays, because scales and settings may be stored
    # elsewhere.
    restored_tuner.restore(state)
    is_same = is_bitwise_equal(
        run_tuner(tuner, budget=5).proposals,
        run_tuner(restored_tuner, budget=5).proposals,
    )
    check(is_same, "the same run after restore", "another one", f"{kind.__name__}.restore")
    # Weights of another version or another tuner must not be accepted.
    try:
        kind().restore({"weights": np.zeros(3)})
    except ValueError:
        return None
    raise CheckError(
        f"expected ValueError for foreign weights; found none; see {kind.__name__}.restore"
    )


def check_instances_can_be_sent_to_workers(kind: type[Tuner]) -> None:
    """Check that an instance with its options can be pickled."""
    try:
        pickle.loads(pickle.dumps(kind()))
    except Exception as error:
        raise CheckError(
            f"expected a tuner that can be pickled; found {error!r}; see {kind.__name__}"
        ) from error


_RUNS = check_runs_in_one_and_in_ten_dimensions
_REPEATS = check_same_seed_gives_the_same_run
TUNER_CHECKS: Mapping[Check, tuple[Check, ...]] = {
    check_api_is_complete: (),
    _RUNS: (check_api_is_complete,),
    check_budget_is_exact: (_RUNS,),
    check_arguments_are_not_changed: (_RUNS,),
    check_proposals_stay_in_the_unit_cube: (_RUNS,),
    check_global_random_state_is_left_alone: (_RUNS,),
    _REPEATS: (_RUNS, check_global_random_state_is_left_alone),
    check_runs_do_not_touch_each_other: (_REPEATS,),
    check_stochastic_is_declared: (_REPEATS,),
    check_failed_simulations_are_survived: (_RUNS,),
    check_easy_problem_is_improved: (_RUNS,),
    check_beats_random_search: (check_easy_problem_is_improved,),
    check_what_was_learned_can_be_stored: (_REPEATS,),
    check_instances_can_be_sent_to_workers: (check_api_is_complete,),
    check_same_run_in_other_processes: (_REPEATS,),
    check_same_run_when_sealed: (check_same_run_in_other_processes,),
}
"""Checks in the order in which they run, each with those that must pass for it to be meaningful."""
