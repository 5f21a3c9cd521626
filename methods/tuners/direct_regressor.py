"""The direct regressor that TuneNet is compared with.

Source: arXiv 1907.11200, section III and Fig. 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from methods.learning.input_features import FeatureConfig
from methods.learning.pair_network import PUBLISHED_DESIGN, PairNetworkDesign, PairTuner
from methods.tuner import Proposal, Task, TunerGenerator


@dataclass(eq=False)
class DirectRegressor(PairTuner):
    """Direct regression: a network estimates the parameters from the target alone.

    It is TuneNet's network with zero in place of the proposed observation. It recommends its one
    estimate from the beginning, simulates it, and stops.

    Attributes:
        published: network and training of the authors' released code; of the other options only
            `points` counts.
        scenarios: training scenarios, at most as many as the budget allows.
        each: simulations in each scenario, at least 2 (dim + 1).
        points: points to which each run is resampled.
        inputs: maximum number of features of an observation.
        strictness: see `methods.learning.input_features.make_weighted_features`.
        noise: as in `methods.tuners.tunenet.TuneNet`.
        epochs: passes over the training data.
        rate: learning rate at the beginning.
        weight_decay: lambda in Eq. 1.
        told: read also what is known of the scenario, if scenarios differ in it.
        channels: first and last channel that is read, by number, if targets do not show the
            others; None for all.
        clean: as in `methods.tuners.tunenet.TuneNet`.
    """

    name: ClassVar[str] = "regressor"
    is_single_input: ClassVar[bool] = True

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

    def make_network_design(self) -> PairNetworkDesign:
        """Return the design of the network: that of TuneNet, with one observation as its input."""
        if self.published:
            return PUBLISHED_DESIGN
        # The two inputs of this network are not a pair that could be exchanged.
        return PairNetworkDesign(
            antisymmetric=False,
            epochs=self.epochs,
            rate=self.rate,
            weight_decay=self.weight_decay,
        )

    def make_feature_config(self) -> FeatureConfig:
        """Return how an observation becomes inputs of the network; raw samples if published."""
        if self.published:
            return FeatureConfig(self.points, noise=0.0, raw=True)
        return super().make_feature_config()

    def choose_training_layout(self, dim: int) -> tuple[int, int]:
        """Return the maximum number of training scenarios and the number of simulations in each."""
        if self.published:
            return 800, 1
        # Half of them are enough for a linear fit of the parameters; the others are for its
        # residual.
        return self.scenarios, max(self.each, 2 * (dim + 1))

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:  # noqa: ARG002
        """Propose one estimate from the target, and stop after its simulation.

        Args:
            task: start, observations, number of parameters and budget of the run.
            rng: unused; the method is deterministic.
        """
        network = self.get_trained_network().select_for(task)
        target = network.features(task.observed[None], task.lengths, task.scene)[0]
        # The proposed input is zero, so the difference is the parameters themselves.
        zero_input = np.zeros_like(target)
        estimate = np.clip(network.predict_difference(zero_input, target), 0.0, 1.0)
        yield Proposal(estimate, recommend=estimate)
        return "it estimates once"
