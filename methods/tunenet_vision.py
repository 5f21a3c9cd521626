"""TuneNet on vision: simulated heights against what a tracker saw; Allevato et al., CoRL 2019, arXiv 1907.11200."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from methods.base import Ask, Steps, Task
from methods.pair_fit import PairTuner
from methods.pair_network import Design
from methods.reader import Reading
from methods.tunenet import SETTLED, Search


@dataclass(eq=False)
class TuneNetVision(PairTuner):
    """TuneNet with another sensor on the target's side: the network itself learns how the two correspond.

    The proposed side reads the first channel of the simulation, as `z` of simulator ball-filmed; the target's side
    reads the other channels of the target, as the pixel row `v`, and nothing of what is known of the camera, as
    published. Where there is one channel both sides read it. Inputs, training and the step are otherwise those of
    `methods.tunenet.TuneNet`; h(o, o) = 0 cannot hold by construction, since no target is seen as a simulation is.

    Attributes:
        scenarios: training scenarios, each with a camera of its own, at most as many as the budget allows.
        each: simulations in each scenario, at least 2 (dim + 1).
        points: points to which each run is resampled; L in Algorithm 1.
        inputs: inputs kept on each side.
        strictness: see `methods.pair_inputs.weighed_inputs`.
        noise: of the tracker, 1 sigma, in units of the channel's standard deviation in training; used where the target
            is rougher than the simulations.
        epochs: passes over the training data.
        rate: learning rate at the beginning.
        weight_decay: lambda in Eq. 1.
        told: read what is known of the scenario, such as where the camera stands.
    """

    name: ClassVar[str] = "tunenet-vision"

    scenarios: int = 200
    each: int = 8
    points: int = 400
    inputs: int = 400
    strictness: float = 100.0
    noise: float = 0.02
    epochs: int = 300
    rate: float = 3e-3
    weight_decay: float = 1e-5
    told: bool = False

    def design(self) -> Design:
        """How the network is built and trained."""
        return Design(antisymmetric=False, epochs=self.epochs, rate=self.rate, weight_decay=self.weight_decay)

    def reading(self) -> Reading:
        """What each side reads."""
        common = (self.points, self.inputs, self.strictness, self.noise, False)
        simulated = Reading(*common, told=False, channels=(0, 0))
        return Reading(*common, told=self.told, channels=(1, _LAST), proposed=simulated)

    def layout(self, dim: int) -> tuple[int, int]:
        """Training scenarios at most, and simulations in each."""
        return self.scenarios, max(self.each, 2 * (dim + 1))

    def tune(self, task: Task, rng: np.random.Generator) -> Steps:  # noqa: ARG002 (the contract's signature)
        """Algorithm 1 with Broyden's steps, one simulation an iteration."""
        estimate, search = self.fitted().estimator(task), Search(task)
        guess = task.start
        while True:
            seen = yield Ask(guess, recommend=guess)
            guess = search.after(seen.proposals[0], estimate(seen.observations))
            if np.abs(guess - search.best).max() <= SETTLED:
                return "the estimate no longer changes"


_LAST = 1_000_000
"""As many channels as there may be."""
