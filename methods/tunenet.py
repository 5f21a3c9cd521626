"""TuneNet: residual tuning, Allevato et al., CoRL 2019, arXiv 1907.11200, Eq. 1 and Algorithm 1."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from methods.base import Array, Ask, Practice, Steps, Task, Tuner
from methods.pair_fit import Prepared, rehearse
from methods.pair_network import PUBLISHED, Design


@dataclass(eq=False)
class TuneNet(Tuner):
    """A network trained on pairs of simulations estimates the parameter difference from two observations.

    Algorithm 1 adds that estimate to the guess, simulates the new guess, and repeats; it recommends its newest guess.

    The default differs from the published method in what the network sees (`methods.pair_inputs`), in its training
    (`methods.pair_network.Design`), in h(o, o) = 0 by construction, and in the step: the estimates are read as the
    residuals of an equation h = 0, solved by Broyden's method (Math. Comp. 19, 1965; in one dimension the secant),
    which starts as Algorithm 1 does and converges where the network's scale is wrong, as outside its training range.

    Attributes:
        published: the network, training, data, and steps of the authors' released code; other options are ignored
            except `points`.
        scenarios: training scenarios, at most as many as the budget allows.
        each: simulations in each scenario, at least 2 (dim + 1); every two of them are a training pair.
        points: points to which each run is resampled; L in Algorithm 1.
        inputs: inputs kept of those an observation offers.
        strictness: see `methods.pair_inputs.weighed_inputs`.
        noise: sensor noise that a second network prepares for, 1 sigma, in units of each channel's standard deviation
            in training; used where the target is rougher than the simulations. 0 for no second network.
        epochs: passes over the training data.
        rate: learning rate at the beginning.
        weight_decay: lambda in Eq. 1.
        broyden: solve h = 0; without it each step is that of Algorithm 1.
    """

    name: ClassVar[str] = "tunenet"
    requires: ClassVar[tuple[str, ...]] = ("torch",)
    stochastic: ClassVar[bool] = False
    learned: ClassVar[bool] = True

    published: bool = False
    scenarios: int = 100
    each: int = 8
    points: int = 400
    inputs: int = 400
    strictness: float = 1000.0
    noise: float = 0.01
    epochs: int = 300
    rate: float = 3e-3
    weight_decay: float = 1e-5
    broyden: bool = True
    _fitted: Prepared | None = field(default=None, init=False, repr=False)

    def fit(self, simulator: Practice, rng: np.random.Generator, budget: int) -> None:
        """Train on at most `budget` simulations of the training range.

        Raises:
            ValueError: a budget of less than two scenarios.
        """
        each = 2 if self.published else max(self.each, 2 * (simulator.dim + 1))
        data = rehearse(simulator, rng, budget, 800 if self.published else self.scenarios, each)
        self._fitted = Prepared.train(self._design(), data, rng, self)

    def _design(self) -> Design:
        if self.published:
            return PUBLISHED
        return Design(epochs=self.epochs, rate=self.rate, weight_decay=self.weight_decay)

    def state(self) -> dict[str, Array]:
        """The network's weights and what it reads, by name; empty before `fit`."""
        return {} if self._fitted is None else self._fitted.state()

    def restore(self, state: dict[str, Array]) -> None:
        """Take back what `state` gave.

        Raises:
            ValueError: arrays of other names or shapes.
        """
        self._fitted = Prepared.restored(state, self._design(), self)

    def tune(self, task: Task, rng: np.random.Generator) -> Steps:  # noqa: ARG002 (the contract's signature)
        """Algorithm 1, one simulation an iteration."""
        if self._fitted is None:
            raise RuntimeError("tunenet has not been trained; call fit or restore first")
        network, missing = self._fitted.suited(task), np.isnan(task.observed)
        target = network.rows(task.observed[None], task.lengths, missing)[0]
        search = _Search(task)
        guess = task.start
        while True:
            seen = yield Ask(guess, recommend=guess)
            proposed = network.rows(seen.observations, task.lengths, missing)[0]
            residual = network.difference(proposed, target)
            if not np.isfinite(seen.observations).all():  # the simulation failed: nothing was seen
                residual = np.full(task.dim, np.nan)
            if self.published:
                guess = np.maximum(seen.proposals[0] + residual, 0.0)
            elif not self.broyden:
                guess = np.clip(seen.proposals[0] + residual, 0.0, 1.0)
            else:
                guess = search.after(seen.proposals[0], residual)
                if np.abs(guess - search.best).max() <= _SETTLED:
                    return "the estimate no longer changes"


_SETTLED = 1e-10
"""A step as small as this is rounding, unit cube."""


_LONGEST = 2.0
"""Broyden's step against that of Algorithm 1, at most."""


class _Search:
    """Broyden's method on h(simulation of x, target) = 0, beginning with the step of Algorithm 1: slope -1."""

    def __init__(self, task: Task) -> None:
        self._slope = -np.eye(task.dim)
        self._fallback = task.training.mean(axis=0)
        self._last: tuple[Array, Array] | None = None
        self._residual: Array | None = None
        self._setbacks = 0
        self._low, self._high = -np.inf, np.inf
        self.best = task.start

    def after(self, point: Array, residual: Array) -> Array:
        """The next guess, once `residual` has been seen at `point`."""
        if not np.isfinite(residual).all():  # the simulation failed: half the way back
            return (point + (self._fallback if self._residual is None else self.best)) / 2.0
        if self._last is not None:
            step, change = point - self._last[0], residual - self._last[1]
            if step @ step > 0.0:
                self._slope = self._slope + np.outer(change - self._slope @ step, step) / (step @ step)
        self._last = point, residual
        if self._residual is None or residual @ residual < self._residual @ self._residual:
            self.best, self._residual, self._setbacks = point, residual, 0
        else:
            self._setbacks += 1
        guess: Array = np.clip(self.best + self._step(self._residual), 0.0, 1.0)
        return self._bracketed(guess, point, residual) if len(point) == 1 else guess

    def _step(self, residual: Array) -> Array:
        """Broyden's step from the best point, at most twice Algorithm 1's; the latter where the former turns back.

        The first setback has its remedy in the slope that it taught; after more of them the step is halved each time.
        """
        try:
            step = np.linalg.solve(self._slope, -residual)
        except np.linalg.LinAlgError:
            step = residual
        if not step @ residual > 0.0:
            step = residual
        longest = _LONGEST * float(np.linalg.norm(residual)) / max(float(np.linalg.norm(step)), 1e-300)
        share = min(1.0, longest) / 2.0 ** max(self._setbacks - 1, 0)
        return np.asarray(step * share, dtype=np.float64)

    def _bracketed(self, guess: Array, point: Array, residual: Array) -> Array:
        """In one dimension, after a setback, keep between a point that was too low and one that was too high."""
        if residual[0] > 0.0:
            self._low = max(self._low, point[0])
        elif residual[0] < 0.0:
            self._high = min(self._high, point[0])
        known = np.isfinite([self._low, self._high]).all() and self._low < self._high
        if self._setbacks and known and not self._low < guess[0] < self._high:
            return np.array([(self._low + self._high) / 2.0])
        return guess
