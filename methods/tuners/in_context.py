"""A network that sees the whole history of a tuning and proposes what to try next.

The idea is that of CAPTURE: X. Zhang et al., Dynamics as Prompts: In-Context Learning for
Sim-to-Real System Identifications, IEEE Robotics and Automation Letters, 2025, arXiv 2410.20357.
There a causal transformer P reads the last k iterations with their parameters e, actions a,
simulated and real trajectories s and r,

    (1)  e_i = P(e_j, a_j, s_j, r_j for j = i - k ... i - 1)

and learns to continue randomised binary searches with known targets (its Algorithm 1). It needs no
gradient and no training on the target.

Here the policy that chooses an action at each step is left out, since a target is one observation.
These changes measured better (docs/tunenet.md): P learns the target's parameters, not the next
point of the search; every simulation of a scenario is the target of the others, in any order; a
proposal is a step from the last simulation that vanishes with the difference of the observations;
the first guess comes from the target alone. `published` undoes these changes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np

from methods.learning.broyden_search import MIN_STEP
from methods.learning.history_transformer import (
    HistoryIndices,
    HistoryTransformerDesign,
    TrainingHistories,
    draw_binary_search,
    get_weight_shapes,
    make_ordered_histories,
    make_shuffled_histories,
    predict_proposals,
    train_history_transformer,
)
from methods.learning.input_features import FeatureConfig, InputFeatures
from methods.learning.network_training import TrainingMonitor, check_shapes
from methods.learning.noise_matched_networks import NoiseMatchedTuner
from methods.learning.training_data import TrainingData
from methods.tuner import Array, Proposal, Task, TrainingSimulator, TunerGenerator

_RANGE_ARRAY = "box"
"""Name of the array with the training range."""


@dataclass(frozen=True)
class TrainedHistoryNetwork:
    """A trained network with its input features.

    Attributes:
        design: design of the network.
        input_features: map from observations and scenarios to input rows.
        weights: weight arrays by name.
        training_range: (2, dim) training range in the unit cube.
    """

    design: HistoryTransformerDesign
    input_features: InputFeatures
    weights: dict[str, Array]
    training_range: Array

    def apply_weights(self, rows: Array) -> Array:
        """Project input rows (n, D) by W to (n, d)."""
        return rows @ self.weights["seen.weight"]

    def propose_next(
        self, target: Array, simulations_seen: list[Array], tried: list[Array]
    ) -> Array:
        """Propose the next point (dim,) of the unit cube, from the latest simulations.

        The network sees points relative to the middle of the training range.

        Args:
            target: (d,) row of network inputs of the target, projected to d numbers by
                `apply_weights`.
            simulations_seen: such rows (d,) of the simulations so far.
            tried: points (dim,) of the simulations so far.
        """
        window = self.design.window
        low, high = self.training_range
        middle, half_widths = (low + high) / 2.0, (high - low) / 2.0
        # Without simulations the arrays have no rows, but the same columns.
        simulations = np.array(simulations_seen[-window:]).reshape(-1, target.size)
        points = np.array(tried[-window:]).reshape(-1, half_widths.size)
        proposals = predict_proposals(
            np, self.weights, self.design, target, simulations, (points - middle) / half_widths
        )
        next_point: Array = np.clip(middle + half_widths * proposals[-1], 0.0, 1.0)
        return next_point

    def to_arrays(self) -> dict[str, Array]:
        """Return everything as plain arrays by name."""
        return self.input_features.to_arrays() | self.weights | {_RANGE_ARRAY: self.training_range}

    @classmethod
    def from_arrays(
        cls, state: dict[str, Array], design: HistoryTransformerDesign, reading: FeatureConfig
    ) -> TrainedHistoryNetwork:
        """Restore a network from the arrays of `to_arrays`.

        Args:
            state: arrays by name.
            design: design of the network.
            reading: configuration of the inputs.

        Raises:
            ValueError: arrays have other names or shapes, or numbers that are not finite.
        """
        features, arrays = InputFeatures.from_arrays(state, reading)
        dim = arrays.get("guess.bias", np.empty(0)).size
        expected = get_weight_shapes(features.feature_count, dim, design) | {_RANGE_ARRAY: (2, dim)}
        weights = check_shapes(arrays, expected)
        return cls(design, features, weights, weights.pop(_RANGE_ARRAY))


@dataclass(eq=False)
class InContextTransformer(NoiseMatchedTuner[TrainedHistoryNetwork]):
    """Causal transformer that reads the tuning history and proposes the next point.

    It is trained on simulated tuning histories, and recommends its newest proposal. Failed
    simulations are left out of the history.

    Attributes:
        published: learn the next point of a randomised binary search, from histories in their
            order, and begin at the given start.
        window: number of past simulations that it reads.
        scenarios: training scenarios, at most as many as the budget allows.
        each: simulations in each scenario, at least 2 (dim + 1): a target and a search for it.
        points: points to which each run is resampled.
        inputs: maximum number of features of an observation.
        strictness: see `methods.learning.input_features.make_weighted_features`.
        noise: as in `methods.tuners.tunenet.TuneNet`.
        epochs: passes over the training data.
        rate: learning rate at the beginning.
        weight_decay: factor of the squared norm of the weights in the loss.
        told: as in `methods.tuners.tunenet.TuneNet`.
        channels: as in `methods.tuners.tunenet.TuneNet`.
        clean: as in `methods.tuners.tunenet.TuneNet`.
    """

    name: ClassVar[str] = "in_context"

    published: bool = False
    window: int = 7
    scenarios: int = 100
    each: int = 8
    points: int = 400
    inputs: int = 400
    strictness: float = 1000.0
    noise: float = 0.01
    epochs: int = 80
    rate: float = 3e-3
    weight_decay: float = 1e-5
    told: bool = True
    channels: tuple[int, int] | None = None
    clean: bool = True

    def make_network_design(self) -> HistoryTransformerDesign:
        """Return the design of the network."""
        return HistoryTransformerDesign(
            self.window,
            published=self.published,
            epochs=self.epochs,
            rate=self.rate,
            weight_decay=self.weight_decay,
        )

    def choose_training_layout(self, dim: int) -> tuple[int, int]:
        """Return the maximum number of training scenarios and the number of simulations in each."""
        return self.scenarios, max(self.each, 2 * (dim + 1))

    def draw_points(
        self, simulator: TrainingSimulator, rng: np.random.Generator, count: int
    ) -> Array:
        """Draw a target and a random binary search for it."""
        return draw_binary_search(simulator, rng, count)

    def train_network(
        self,
        data: TrainingData,
        rng: np.random.Generator,
        training_range: Array,
        monitor: TrainingMonitor[TrainingData] | None,
    ) -> TrainedHistoryNetwork:
        """Train a transformer on histories of simulated tuning runs, for one noise level.

        Args:
            data: simulations to train on, with noise.
            rng: random generator.
            training_range: (2, dim) corners of the training range.
            monitor: monitor of the training; None for none.
        """
        features = InputFeatures.fit(data, self.make_feature_config())
        history_monitor = None
        if monitor is not None:
            history_monitor = monitor.convert(
                lambda held_out: _build_training_histories(features, held_out, training_range)
            )
        design = self.make_network_design()
        material = _build_training_histories(features, data, training_range)
        per_scenario = data.parameters.shape[1]
        weights = train_history_transformer(
            material, partial(self._draw_histories, per_scenario), design, rng, history_monitor
        )
        return TrainedHistoryNetwork(design, features, weights, training_range)

    def _draw_histories(self, each: int, rng: np.random.Generator) -> HistoryIndices:
        """Draw the histories of a batch from `each` simulations per scenario.

        A history is a sequence of simulations and a target among the others, given by their
        indices. As published it follows the order of the binary search; otherwise the order is
        random.

        Args:
            each: number of simulations per scenario.
            rng: random numbers of the training.
        """
        window = min(self.window, each - 1)
        if self.published:
            return make_ordered_histories(each, window)
        return make_shuffled_histories(rng, each, window)

    def restore_network(self, arrays: dict[str, Array]) -> TrainedHistoryNetwork:
        """Restore one network from its arrays; see `TrainedHistoryNetwork.from_arrays`."""
        return TrainedHistoryNetwork.from_arrays(
            arrays, self.make_network_design(), self.make_feature_config()
        )

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:  # noqa: ARG002
        """Propose one point per iteration, until the proposal no longer changes.

        The network proposes from the target and all successful simulations so far. After a failed
        simulation the next point is half way back to the last successful one.

        Args:
            task: task of the target.
            rng: not used.
        """
        network = self.get_trained_network().select_for(task)
        missing = np.isnan(task.observed)
        row = network.input_features(task.observed[None], task.lengths, task.scene, missing)
        target = network.apply_weights(row)[0]
        simulations: list[Array] = []
        proposals: list[Array] = []
        guess = (
            task.start if self.published else network.propose_next(target, simulations, proposals)
        )
        while True:
            evaluation = yield Proposal(guess, recommend=guess)
            point = evaluation.proposals[0]
            if np.isfinite(evaluation.observations).all():
                row = network.input_features(
                    evaluation.observations, task.lengths, task.scene, missing
                )
                simulations.append(network.apply_weights(row)[0])
                proposals.append(point)
                guess = network.propose_next(target, simulations, proposals)
                if np.abs(guess - point).max() <= MIN_STEP:
                    return "the proposal no longer changes"
            else:
                # Half the distance to the last successful point, or to the middle of the training
                # range.
                fallback = proposals[-1] if proposals else task.training.mean(axis=0)
                guess = (point + fallback) / 2.0


def _build_training_histories(
    features: InputFeatures, data: TrainingData, box: Array
) -> TrainingHistories:
    """Build the training data: simulations without noise, targets with the sensor's noise.

    Parameters are scaled to half widths from the middle of the training range, as in the network's
    input.

    Args:
        features: converts observations to inputs of the network.
        data: training simulations.
        box: (2, dim) corners of the training range.
    """
    low, high = box
    parameters = (data.parameters - box.mean(axis=0)) / ((high - low) / 2.0)
    targets = features.compute_rows(data)
    simulations = targets
    if data.noise_free_observations is not None:
        simulations = features.compute_rows(data.without_noise)
    return TrainingHistories(simulations, targets, parameters)
