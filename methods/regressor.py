"""The direct regressor that TuneNet is compared with, arXiv 1907.11200, section III and Fig. 1."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from methods.base import Array, Ask, Practice, Steps, Task, Tuner
from methods.pair_fit import Prepared, rehearse
from methods.pair_network import PUBLISHED, Design


@dataclass(eq=False)
class Regressor(Tuner):
    """TuneNet's network on the target alone: its proposed input is zero, its output the parameters themselves.

    It needs no simulation of the target: it recommends its one estimate from the beginning, simulates it, and stops.

    Attributes:
        published: the network and training of the authors' released code; other options are ignored except `points`.
        scenarios: training scenarios, at most as many as the budget allows.
        each: simulations in each scenario, at least 2 (dim + 1).
        points: points to which each run is resampled.
        inputs: inputs kept of those an observation offers.
        strictness: see `methods.pair_inputs.weighed_inputs`.
        noise: as in `methods.tunenet.TuneNet`.
        epochs: passes over the training data.
        rate: learning rate at the beginning.
        weight_decay: lambda in Eq. 1.
    """

    name: ClassVar[str] = "regressor"
    requires: ClassVar[tuple[str, ...]] = ("torch",)
    stochastic: ClassVar[bool] = False
    learned: ClassVar[bool] = True

    published: bool = False
    scenarios: int = 400
    each: int = 4
    points: int = 400
    inputs: int = 400
    strictness: float = 100.0
    noise: float = 0.01
    epochs: int = 100
    rate: float = 3e-3
    weight_decay: float = 1e-6
    _fitted: Prepared | None = field(default=None, init=False, repr=False)

    def fit(self, simulator: Practice, rng: np.random.Generator, budget: int) -> None:
        """Train on at most `budget` simulations of the training range.

        Raises:
            ValueError: a budget of less than two scenarios.
        """
        each = 1 if self.published else max(self.each, 2 * (simulator.dim + 1))
        data = rehearse(simulator, rng, budget, 800 if self.published else self.scenarios, each)
        self._fitted = Prepared.train(self._design(), data, rng, self, alone=True)

    def _design(self) -> Design:
        if self.published:
            return PUBLISHED
        return Design(antisymmetric=False, epochs=self.epochs, rate=self.rate, weight_decay=self.weight_decay)

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
        """One estimate from the target, simulated once."""
        if self._fitted is None:
            raise RuntimeError("regressor has not been trained; call fit or restore first")
        network = self._fitted.suited(task)
        target = network.rows(task.observed[None], task.lengths)[0]
        guess = np.clip(network.difference(np.zeros_like(target), target), 0.0, 1.0)
        yield Ask(guess, recommend=guess)
        return "it estimates once"
