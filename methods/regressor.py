"""The direct regressor that TuneNet is compared with, arXiv 1907.11200, section III and Fig. 1."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from methods.base import Ask, Steps, Task
from methods.learning.pair_fit import PairTuner
from methods.learning.pair_network import PUBLISHED, Design
from methods.learning.reader import Reading


@dataclass(eq=False)
class Regressor(PairTuner):
    """TuneNet's network on the target alone: its proposed input is zero, its output the parameters
    themselves.

    It needs no simulation of the target: it recommends its one estimate from the beginning,
    simulates it, and stops.

    Attributes:
        published: the network and training of the authors' released code; other options are ignored
            except `points`.
        scenarios: training scenarios, at most as many as the budget allows.
        each: simulations in each scenario, at least 2 (dim + 1).
        points: points to which each run is resampled.
        inputs: inputs kept of those an observation offers.
        strictness: see `methods.learning.pair_inputs.weighed_inputs`.
        noise: as in `methods.tunenet.TuneNet`.
        epochs: passes over the training data.
        rate: learning rate at the beginning.
        weight_decay: lambda in Eq. 1.
        told: read what is known of the scenario too, where scenarios differ in it
            (`methods.learning.circumstances`).
        channels: first and last channel that is read, by number, where targets do not show the
            others; None for all.
        clean: as in `methods.tunenet.TuneNet`.
    """

    name: ClassVar[str] = "regressor"
    alone: ClassVar[bool] = True

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
    told: bool = True
    channels: tuple[int, int] | None = None
    clean: bool = True

    def design(self) -> Design:
        """Return the design of the network."""
        if self.published:
            return PUBLISHED
        # The two inputs of this network are not a pair that could be exchanged.
        return Design(
            antisymmetric=False,
            epochs=self.epochs,
            rate=self.rate,
            weight_decay=self.weight_decay,
        )

    def reading(self) -> Reading:
        """Return the configuration of the inputs."""
        if self.published:
            return Reading(self.points, noise=0.0, raw=True)
        return Reading(
            self.points,
            self.inputs,
            self.strictness,
            self.noise,
            told=self.told,
            channels=self.channels,
            clean=self.clean,
        )

    def layout(self, dim: int) -> tuple[int, int]:
        """Return the maximum number of training scenarios and the number of simulations in each."""
        if self.published:
            return 800, 1
        # Half of them are enough for a linear fit of the parameters; the others are for its
        # residual.
        return self.scenarios, max(self.each, 2 * (dim + 1))

    def tune(self, task: Task, rng: np.random.Generator) -> Steps:  # noqa: ARG002
        """Propose one estimate from the target, and stop after its simulation."""
        network = self.fitted().suited(task)
        target = network.read(task.observed[None], task.lengths, task.scene)[0]
        # The proposed input is zero, so the difference is the parameters themselves.
        nothing = np.zeros_like(target)
        guess = np.clip(network.difference(nothing, target), 0.0, 1.0)
        yield Ask(guess, recommend=guess)
        return "it estimates once"
