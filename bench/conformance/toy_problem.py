"""Toy problem for checks of tuners: a smooth, identifiable simulator of any dimension.

Parameter i has the rate r_i = 0.5 + 0.6 p_i. The two channels are the sums over i = 1, 2, ... of

    cos(r_i t + 0.3 i) / i            (1)
    exp(-r_i t) (1 + 0.1 i)           (2)

so that every parameter is observable, no two can be exchanged, and there is no symmetry in p.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bench.benchmark.runner.tuner_loop import Evaluate, RunTrace, drive_tuner
from bench.conformance.check_base import CheckError
from methods.tuner import EMPTY_SCENE, BudgetExceededError, Task, Tuner
from sims.core.simulator import Array

SAMPLE_TIMES = np.linspace(0.0, 3.0, 40)
"""Sample times of the toy simulator, seconds."""
FIT_BUDGET = 240
"""Number of training simulations of a trained tuner; small, so that the suite is fast."""
TRAINING_RANGE_LOW = 0.25
"""Lower bound of the training range in every direction of the unit cube."""
TRAINING_RANGE_HIGH = 0.75
"""Upper bound of the training range in every direction of the unit cube."""


def simulate_toy_problem(points: Array) -> Array:
    """Simulate the toy problem: (n, 40, 2) from (n, dim) points of the unit cube."""
    # index i of (1) and (2)
    phases = np.arange(1, points.shape[1] + 1)
    rates = 0.5 + 0.6 * points
    waves = np.cos(rates[:, None, :] * SAMPLE_TIMES[:, None] + 0.3 * phases) / phases  # (1)
    slopes = np.exp(-rates[:, None, :] * SAMPLE_TIMES[:, None]) * (1.0 + 0.1 * phases)  # (2)
    return np.stack([waves.sum(axis=2), slopes.sum(axis=2)], axis=2)


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


TRAINED_TUNERS: dict[tuple[type[Tuner], int], dict[str, Array]] = {}
"""Trained state of each tuner in this process, by class and dimension, because training is slow."""


def make_trained_tuner(kind: type[Tuner], dim: int, anew: bool = False) -> Tuner:
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


def make_task(dim: int, budget: int, seed: int = 0) -> tuple[Task, Array]:
    """Make a task with its true parameters; its arrays are read-only.

    Args:
        dim: number of parameters.
        budget: maximum number of simulations.
        seed: seed of the true parameters and of the start.

    Returns:
        The task, and its true parameters (dim,) inside the training range.
    """
    rng = np.random.default_rng(seed)
    # Away from the bounds, where a tuner that clips would find the true parameters by clipping.
    truth, start = rng.uniform(0.3, 0.7, size=(2, dim))
    observed = simulate_toy_problem(truth[None])[0]
    training = np.array([[TRAINING_RANGE_LOW] * dim, [TRAINING_RANGE_HIGH] * dim])
    # Read-only as in the harness, where writing to them fails too.
    for array in (observed, start, training):
        array.setflags(write=False)
    return Task(dim, start, observed, np.ones(2), training, budget, (SAMPLE_TIMES.size,)), truth


def run_tuner(
    tuner: Tuner,
    dim: int,
    budget: int,
    seed: int = 0,
    fails: Callable[[int], bool] = lambda _: False,
    target: int = 0,
) -> RunTrace:
    """Run a tuner on the toy problem.

    Args:
        tuner: the tuner.
        dim: number of parameters.
        budget: maximum number of simulations.
        seed: seed of the run.
        fails: returns whether simulation number k fails.
        target: seed of the task.
    """
    task, _ = make_task(dim, budget, target)
    evaluate = make_evaluate(task, fails)
    return drive_tuner(tuner, task, evaluate, np.random.default_rng(seed))


def make_evaluate(task: Task, fails: Callable[[int], bool] = lambda _: False) -> Evaluate:
    """Make the function that simulates and evaluates points on a task.

    Args:
        task: the task.
        fails: returns whether simulation number k fails.
    """
    simulated = 0

    def evaluate(points: Array) -> tuple[Array, Array]:
        """Simulate points and compute their losses, as the harness of a comparison does.

        Args:
            points: (n, dim) points of the unit cube.

        Returns:
            Observations (n, 40, 2) and losses (n,); NaN and infinite for simulations that fail.
        """
        nonlocal simulated
        observations = simulate_toy_problem(points)
        for lane in observations:
            simulated += 1
            if fails(simulated):
                lane[:] = np.nan
        losses = np.sqrt(((observations - task.observed) ** 2).mean(axis=(1, 2)))
        losses[np.isnan(losses)] = np.inf  # as the harness does for a failed simulation
        return observations, losses

    return evaluate
