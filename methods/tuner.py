"""Tuner interface: a run is a generator that yields proposals and receives evaluations.

A tuner works in the unit cube and has no access to units, the simulator or the true parameters. The
harness (`bench`) runs the loop: it simulates, counts, measures time and logs. The code of a tuner
can therefore follow its paper closely.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
FAILED_RESIDUAL = 1e10
"""Residual of every sample of a failed simulation, in scales of the channel."""


class Evaluation(NamedTuple):
    """Result of simulating the proposals of one `yield`.

    Attributes:
        proposals: (n, dim) simulated points: the proposals, moved to the boundary of the unit cube
            if they were outside.
        observations: (n, T, C) observations in SI units.
        losses: (n,) root mean square of the scaled residuals of each observation; not finite if the
            simulation failed.
    """

    proposals: Array
    observations: Array
    losses: Array


class Proposal(NamedTuple):
    """Proposals together with what the tuner recommends now.

    Yield a bare array to have the harness recommend the proposal with the lowest loss so far; yield
    a `Proposal` to recommend another point. The recommendation is valid until the next `yield`.

    Attributes:
        points: (n, dim) or (dim,) proposals in the unit cube.
        recommend: (dim,) recommendation in the unit cube, made from the evaluations received so
            far; None for the proposal with the lowest loss.
    """

    points: Array
    recommend: Array | None = None


TunerGenerator = Generator["Array | Proposal", Evaluation, "str | None"]
"""Run of a tuner; its return value, if any, is the reason why it stopped by itself."""


class ScenarioInfo(NamedTuple):
    """Scenario information: what is known of a target's scenario in addition to its observation.

    Attributes:
        initial: (K,) initial values that no channel shows, and constants of the run, in SI units;
            run by run, sorted by name.
        inputs: (T, U) input signals in SI units, sorted by name; the runs are concatenated along T.
    """

    initial: Array
    inputs: Array


EMPTY_SCENE = ScenarioInfo(np.empty(0), np.empty((0, 0)))
"""Empty scenario information, if nothing relevant is known."""


@dataclass(frozen=True)
class Task:
    """Everything that a tuner gets of one target; it does not contain the true parameters.

    Attributes:
        dim: number of parameters.
        start: (dim,) point of the unit cube where every tuner starts on this target.
        observed: (T, C) observation of the target in SI units; NaN for missing samples. The runs of
            a recording with several runs are concatenated along T.
        scale: (C,) divisor of the residuals: the channel's noise if known, else its typical
            magnitude.
        training: (2, dim) lower and upper corner of the training range in the unit cube.
        budget: number of simulations that the tuner may use.
        lengths: number of samples of each run; their sum is T.
        scene: scenario information.
    """

    dim: int
    start: Array
    observed: Array
    scale: Array
    training: Array
    budget: int
    lengths: tuple[int, ...]
    scene: ScenarioInfo = EMPTY_SCENE

    def residuals(self, observations: Array) -> Array:
        """Compute scaled differences simulated - observed, shape (n, T * C).

        They are zero where the target's sample is missing.
        """
        difference = (observations - self.observed) / self.scale
        return np.where(np.isnan(self.observed), 0.0, difference).reshape(len(observations), -1)

    def compute_finite_residuals(self, evaluation: Evaluation) -> Array:
        """Return the residuals of an evaluation; those of a failed simulation are large numbers.

        Libraries for least squares do not accept NaN.
        """
        return np.nan_to_num(
            self.residuals(evaluation.observations),
            nan=FAILED_RESIDUAL,
            posinf=FAILED_RESIDUAL,
            neginf=FAILED_RESIDUAL,
        )


class TrainingSimulator(Protocol):
    """Training simulator of a learned tuner: counted, and limited to the training range.

    Attributes:
        dim: number of parameters.
        training: (2, dim) corners of the training range in the unit cube.
        scale: (C,) as in `Task`.
        lengths: as in `Task`.
        scene: as in `Task`, for the scenario of the last call of `simulate`; before the first call,
            for any scenario.
        used: number of simulations made so far.
        budget: number of simulations allowed.
    """

    dim: int
    training: Array
    scale: Array
    lengths: tuple[int, ...]
    scene: ScenarioInfo
    used: int
    budget: int

    def sample(self, rng: np.random.Generator, n: int) -> Array:
        """Draw parameters uniformly from the training range.

        Args:
            rng: random generator.
            n: number of points.

        Returns:
            (n, dim) points of the unit cube.
        """
        ...

    def simulate(self, rng: np.random.Generator, points: Array) -> Array:
        """Simulate points, all in one scenario that is drawn in the same way as those of targets.

        Shapes: T samples, C channels.

        Args:
            rng: random generator.
            points: (n, dim) points of the unit cube.

        Returns:
            Observations (n, T, C).

        Raises:
            ValueError: a point is outside the training range.
            BudgetExceededError: more simulations are requested than the training budget allows.
        """
        ...


class TrainingCallback(Protocol):
    """Callback that observes the training of a learned tuner, without any effect on its result."""

    @property
    def ground(self) -> TrainingSimulator:
        """Simulator of the training range for evaluation; the training budget does not count it."""
        ...

    def epoch(self, stage: str, epoch: int, epochs: int, loss: float, held_out: float) -> None:
        """Report one pass over the training data of one stage.

        Args:
            stage: name of the stage.
            epoch: number of the pass, from 1.
            epochs: number of passes.
            loss: training loss.
            held_out: loss on held-out data.
        """
        ...


class BudgetExceededError(RuntimeError):
    """A learned tuner requested more training simulations than it may use."""


class Tuner:
    """Base class of all tuners; subclasses implement `tune`.

    Learned tuners also implement `fit`, `state` and `restore`. Options are keyword arguments with
    defaults (a dataclass is suitable). An instance is used for several runs and must not store
    anything between them, except what `fit` learned.

    Attributes:
        name: name of the tuner in tables; by default derived from the class name (RandomSearch ->
            random_search).
        requires: importable packages without which this tuner is listed as skipped.
        stochastic: whether `tune` uses its generator; if not, one seed is enough.
        learned: whether `fit` must be called before `tune`.
        trains_as: another tuner that trains in the same way; its random stream is used, so that a
            comparison of the two uses the same network.
        known_failures: conformance checks (by function name) that the tuner fails on purpose, with
            the reason.
        watch: training callback for `fit`; None for none.
    """

    name: ClassVar[str] = ""
    requires: ClassVar[tuple[str, ...]] = ()
    stochastic: ClassVar[bool] = True
    learned: ClassVar[bool] = False
    trains_as: ClassVar[str] = ""
    known_failures: ClassVar[Mapping[str, str]] = {}
    watch: TrainingCallback | None = None

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Give a subclass without an own `name` one derived from its class name in snake case."""
        super().__init_subclass__(**kwargs)
        # The class's own name: a subclass of a named tuner is another tuner.
        if "name" not in cls.__dict__:
            cls.name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:
        """Yield proposals (n, dim) in the unit cube, and receive their `Evaluation`.

        Args:
            task: task of the target.
            rng: random generator of the run.

        Returns:
            Generator of the run; it may return a reason to stop early.
        """
        raise NotImplementedError(f"{type(self).__name__} does not implement tune")

    def fit(self, simulator: TrainingSimulator, rng: np.random.Generator, budget: int) -> None:
        """Learn from at most `budget` simulations of the training range.

        Args:
            simulator: training simulator.
            rng: random generator.
            budget: maximum number of simulations.
        """

    def state(self) -> dict[str, Array]:
        """Return what `fit` learned, as plain arrays by name."""
        return {}

    def restore(self, state: dict[str, Array]) -> None:
        """Restore the arrays that `state` returned.

        Raises:
            ValueError: arrays have other names or shapes than this tuner's.
        """


_THREAD_TIMEOUT_SECONDS = 5.0
"""Timeout in seconds for the end of a callback optimiser's thread."""


class _OptimiserStopped(BaseException):
    """Raised inside a callback optimiser's thread when the harness ends its run."""


def get_first_loss(evaluation: Evaluation) -> float:
    """Return the loss of the first point of an evaluation."""
    return float(evaluation.losses[0])


def from_callback(
    minimise: Callable[[Callable[[Array], Any]], str | None],
    get_value: Callable[[Evaluation], Any] = get_first_loss,
) -> TunerGenerator:
    """Turn an optimiser that only takes an objective function into a tuner's generator.

    The optimiser runs in its own thread, and never at the same time as the harness: each call of
    the objective passes its points to the harness and waits for the result.

    Args:
        minimise: called with the objective; returns the reason why it stopped, or None. It must not
            catch exceptions of the objective. The objective takes one point (dim,) or several
            (n, dim).
        get_value: value of the objective for an evaluation; by default the loss of one point.

    Returns:
        The generator; its return value is the reason.
    """
    to_harness: list[Array] = []
    to_optimiser: list[Any] = []
    outcome: list[str | None] = []
    failure: list[BaseException] = []
    # Each side waits for the other's semaphore, so that only one of the two runs at any time.
    point_ready = threading.Semaphore(0)
    value_ready = threading.Semaphore(0)
    is_closing = False

    def objective(point: Array) -> Any:
        """Pass a point to the harness, and wait for the value of its evaluation.

        It runs in the optimiser's thread. When the run is closed it raises an exception that ends
        the optimiser.
        """
        if is_closing:
            raise _OptimiserStopped
        to_harness.append(np.array(point, dtype=np.float64))
        point_ready.release()
        value_ready.acquire()
        if is_closing:
            raise _OptimiserStopped
        return to_optimiser.pop()

    def work() -> None:
        """Run the optimiser in its thread.

        Its result is stored in `outcome`, and an error in `failure`.

        `minimise` is the optimiser, and `objective` the function that hands its points to the
        harness.
        """
        try:
            value_ready.acquire()
            if not is_closing:
                outcome.append(minimise(objective))
        except _OptimiserStopped:
            pass
        except BaseException as error:
            # An exception that ends this thread would be lost, so it is passed to the harness.
            failure.append(error)
        finally:
            # Without a new point, the harness sees that the optimiser has ended.
            point_ready.release()

    # A daemon thread, because an optimiser that never returns must not keep the process alive.
    worker = threading.Thread(target=work, daemon=True, name="callback-optimiser")
    worker.start()
    try:
        value_ready.release()
        while True:
            point_ready.acquire()
            if failure:
                raise failure[0]
            # Without a new point, the optimiser has ended.
            if not to_harness:
                return outcome[0] if outcome else None
            evaluation = yield np.atleast_2d(to_harness.pop())
            to_optimiser.append(get_value(evaluation))
            value_ready.release()
    finally:
        # The harness has closed the generator, or the optimiser has ended: an optimiser that still
        # waits for a value gets an exception instead.
        is_closing = True
        value_ready.release()
        worker.join(timeout=_THREAD_TIMEOUT_SECONDS)
        if worker.is_alive():
            raise RuntimeError(
                "the optimiser caught the exception that ends its run; its thread cannot be stopped"
            )
