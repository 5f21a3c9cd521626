"""The problem that tuners are checked on: a smooth, identifiable simulator of any dimension.

Parameter i has the rate r_i = 0.5 + 0.6 p_i; the two channels are the sums over i = 1, 2, ... of

    cos(r_i t + 0.3 i) / i            (1)
    exp(-r_i t) (1 + 0.1 i)           (2)

so that every parameter shows, none can take another's place, and no square of p is symmetric.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bench.checks.base import CheckError
from bench.runs.drive import Evaluate, Trace, drive
from methods.base import NOTHING, BudgetExceededError, Task, Tuner
from sims.base import Array

TIMES = np.linspace(0.0, 3.0, 40)
"""Sample times of the toy simulator in seconds."""
FIT_BUDGET = 240
"""Simulations that a learned tuner may train with: few, so that the suite stays quick."""
LOW = 0.25
"""Lower end of the training range in every direction of the unit cube."""
HIGH = 0.75
"""Its upper end."""


def observe(points: Array) -> Array:
    """A smooth, identifiable toy simulator: (n, 40, 2) from (n, dim) points of the unit cube."""
    # the i of (1) and (2)
    phases = np.arange(1, points.shape[1] + 1)
    rates = 0.5 + 0.6 * points
    waves = np.cos(rates[:, None, :] * TIMES[:, None] + 0.3 * phases) / phases  # (1)
    slopes = np.exp(-rates[:, None, :] * TIMES[:, None]) * (1.0 + 0.1 * phases)  # (2)
    return np.stack([waves.sum(axis=2), slopes.sum(axis=2)], axis=2)


class PracticeGround:
    """Practice ground on the toy simulator; see `methods.base.Practice`."""

    def __init__(self, dim: int) -> None:
        self.dim, self.scale = dim, np.ones(2)
        self.lengths: tuple[int, ...] = (TIMES.size,)
        self.scene = NOTHING
        self.training = np.array([[LOW] * dim, [HIGH] * dim])
        self.used, self.budget = 0, FIT_BUDGET

    def sample(self, rng: np.random.Generator, n: int) -> Array:
        """Parameters drawn evenly from the training range."""
        return rng.uniform(LOW, HIGH, size=(n, self.dim))

    def simulate(self, rng: np.random.Generator, points: Array) -> Array:  # noqa: ARG002
        """Observations (n, 40, 2), counted.

        Raises:
            CheckError: a point outside the training range.
            BudgetExceededError: more simulations than the training budget.
        """
        if not ((points >= LOW) & (points <= HIGH)).all():
            raise CheckError(
                "expected training inside the training range; found a point outside; see `fit`"
            )
        self.used += len(points)
        if self.used > self.budget:
            raise BudgetExceededError(f"{self.used} training simulations, {self.budget} allowed")
        return observe(points)


LEARNED: dict[tuple[type[Tuner], int], dict[str, Array]] = {}
"""What each tuner learned in this process, by class and dimension: training takes seconds."""


def ready(kind: type[Tuner], dim: int, anew: bool = False) -> Tuner:
    """A tuner of this kind, trained on the toy simulator if it is a learned one: once a process,
    unless anew.
    """
    tuner = kind()
    if not anew and (kind, dim) in LEARNED:
        tuner.restore(LEARNED[kind, dim])
        return tuner
    tuner.fit(PracticeGround(dim), np.random.default_rng(0), FIT_BUDGET)
    if kind.learned:
        LEARNED[kind, dim] = tuner.state()
    return tuner


def task_of(dim: int, budget: int, seed: int = 0) -> tuple[Task, Array]:
    """A target and its truth (dim,), both inside the training range; its arrays are read-only."""
    rng = np.random.default_rng(seed)
    # Away from the range's ends, where a tuner that clips would find the truth by clipping.
    truth, start = rng.uniform(0.3, 0.7, size=(2, dim))
    observed = observe(truth[None])[0]
    training = np.array([[LOW] * dim, [HIGH] * dim])
    # As the harness gives them: who writes to one crashes there too.
    for array in (observed, start, training):
        array.setflags(write=False)
    return Task(dim, start, observed, np.ones(2), training, budget, (TIMES.size,)), truth


def run(
    tuner: Tuner,
    dim: int,
    budget: int,
    seed: int = 0,
    fails: Callable[[int], bool] = lambda _: False,
    target: int = 0,
) -> Trace:
    """One run; simulation number k fails where `fails(k)`."""
    given, _ = task_of(dim, budget, target)
    evaluate = evaluation_of(given, fails)
    return drive(tuner, given, evaluate, np.random.default_rng(seed))


def evaluation_of(given: Task, fails: Callable[[int], bool] = lambda _: False) -> Evaluate:
    """What simulates on a target; simulation number k fails where `fails(k)`."""
    simulated = 0

    def evaluate(points: Array) -> tuple[Array, Array]:
        nonlocal simulated
        observations = observe(points)
        for lane in observations:
            simulated += 1
            if fails(simulated):
                lane[:] = np.nan
        losses = np.sqrt(((observations - given.observed) ** 2).mean(axis=(1, 2)))
        losses[np.isnan(losses)] = np.inf  # what the harness says of a simulation that failed
        return observations, losses

    return evaluate
