"""Base class of tuners on TuneNet's pair network: training of the network, and its estimates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from methods.learning.gap_filling import fill_gaps
from methods.learning.input_features import FeatureConfig, InputFeatures
from methods.learning.network_training import TrainingMonitor, check_shapes
from methods.learning.noise_matched_networks import NoiseMatchedTuner
from methods.learning.pair_network import (
    PairInputs,
    PairNetworkDesign,
    estimate_difference,
    get_weight_shapes,
    train_pair_network,
)
from methods.learning.training_data import TrainingData
from methods.tuner import Array, Task

_PROPOSED_SIDE_PREFIX = "own-"
"""Prefix of array names of the proposed side if both sides have different inputs."""


@dataclass(frozen=True)
class TrainedPairNetwork:
    """A trained pair network with its input features.

    Attributes:
        design: design of the network.
        features: map from observations and scenarios to input rows of the target's side.
        weights: weight arrays by name.
        proposed: map to input rows of the proposed side; the object `features` if both sides have
            the same inputs.
    """

    design: PairNetworkDesign
    features: InputFeatures
    weights: dict[str, Array]
    proposed: InputFeatures

    @classmethod
    def train(
        cls,
        design: PairNetworkDesign,
        data: TrainingData,
        rng: np.random.Generator,
        reading: FeatureConfig,
        alone: bool,
        monitor: TrainingMonitor[TrainingData] | None,
    ) -> TrainedPairNetwork:
        """Choose the inputs, and train the network on them.

        Args:
            design: design of the network.
            data: training data.
            rng: random generator.
            reading: configuration of the inputs; its `proposed` is that of the proposed side if it
                differs, otherwise None.
            alone: True to learn the parameters from the target's side alone (direct regression).
            monitor: monitor of the training; None for none.
        """
        features = InputFeatures.fit(data, reading)
        proposed = (
            InputFeatures.fit(data.without_noise, reading.proposed)
            if reading.proposed
            else features
        )
        rows_monitor = None
        if monitor is not None:
            rows_monitor = monitor.convert(
                lambda held_out: (
                    _compute_input_rows(proposed, features, held_out),
                    held_out.parameters,
                )
            )
        rows = _compute_input_rows(proposed, features, data)
        weights = train_pair_network(rows, data.parameters, design, rng, alone, rows_monitor)
        return cls(design, features, weights, proposed)

    def predict_difference(self, proposed: Array, target: Array) -> Array:
        """Estimate the parameters of the target less those of the proposed simulations.

        Args:
            proposed: (n, D) or (D,) input rows of the proposed side.
            target: (n, E) or (E,) input rows of the target's side.
        """
        return estimate_difference(self.weights, self.design, proposed, target)

    def make_estimator(self, task: Task) -> Callable[[Array], Array]:
        """Return a function that estimates the parameter error of one simulation (1, T, C).

        The function returns the target's parameters less those of the simulation, (dim,), as the
        network estimates them from both observations; NaN if the simulation failed. `self.proposed`
        makes the row of network inputs of a simulation, `self.features` that of the target. They
        are one function unless the target has another sensor, such as a camera.

        Shapes: T samples, C channels.

        Args:
            task: the target, with its observation, sample counts and scene.
        """
        is_shared = self.proposed is self.features
        # Samples missing in the target are hidden in the simulation too. A simulation at the true
        # parameters then has the same row of inputs as the target.
        hidden = np.isnan(task.observed) if is_shared else None
        row = None
        if is_shared:
            # The row of the target is then equal for all simulations, and computed once.
            row = self.features(task.observed[None], task.lengths, task.scene, hidden)[0]

        def difference(observations: Array) -> Array:
            """Estimate the parameters (dim,) of the target less those of a simulation (1, T, C).

            If the target has another sensor, its missing samples are first filled from the
            simulation.

            Shapes: T samples, C channels.
            """
            if not np.isfinite(observations).all():
                return np.full(task.dim, np.nan)
            (proposed,) = self.proposed(observations, task.lengths, task.scene, hidden)
            target = row
            if target is None:
                filled_target = _fill_target_gaps(task, observations[0], self)
                target = self.features(filled_target[None], task.lengths, task.scene)[0]
            return self.predict_difference(proposed, target)

        return difference

    def to_arrays(self) -> dict[str, Array]:
        """Return weights and input features as plain arrays by name."""
        state = self.features.to_arrays() | self.weights
        if self.proposed is self.features:
            return state
        # The arrays of both sides have the same names.
        arrays = {
            _PROPOSED_SIDE_PREFIX + name: array for name, array in self.proposed.to_arrays().items()
        }
        return arrays | state

    @classmethod
    def from_arrays(
        cls, state: dict[str, Array], design: PairNetworkDesign, reading: FeatureConfig
    ) -> TrainedPairNetwork:
        """Restore a network from the arrays of `to_arrays`.

        Args:
            state: arrays by name.
            design: design of the network.
            reading: configuration of the inputs.

        Raises:
            ValueError: arrays have other names or shapes, or numbers that are not finite.
        """
        proposed_arrays: dict[str, Array] = {}
        common: dict[str, Array] = {}
        for name, array in state.items():
            part = proposed_arrays if name.startswith(_PROPOSED_SIDE_PREFIX) else common
            part[name.removeprefix(_PROPOSED_SIDE_PREFIX)] = array
        features, arrays = InputFeatures.from_arrays(common, reading)
        proposed = (
            InputFeatures.from_arrays(proposed_arrays, reading.proposed)[0]
            if reading.proposed
            else features
        )
        dim = arrays.get("output.bias", np.empty(0)).size
        expected = get_weight_shapes(
            (proposed.feature_count, features.feature_count), design.width, dim
        )
        return cls(design, features, check_shapes(arrays, expected), proposed)


def _compute_input_rows(
    proposed: InputFeatures, target: InputFeatures, data: TrainingData
) -> PairInputs:
    """Compute input rows of both sides; separate inputs of the proposed side have no noise.

    Args:
        proposed: inputs of the proposed side.
        target: inputs of the target side; the same object if both sides are equal.
        data: training data.
    """
    rows = target.compute_rows(data)
    proposed_rows = rows if proposed is target else proposed.compute_rows(data.without_noise)
    return PairInputs(proposed_rows, rows)


def _fill_target_gaps(task: Task, simulated: Array, network: TrainedPairNetwork) -> Array:
    """Fill the gaps of the target (T, C) from a simulation (T, C), run by run.

    This is done only if the network reads one channel of the simulation.

    Shapes: T samples, C channels.

    Args:
        task: the task, with the observations of the target.
        simulated: (T, C) a simulation.
        network: network, with the channels that it compares.
    """
    # Simulation and target may have different channels, such as a position and its pixels.
    sensor = network.proposed.reading.select_channels(simulated)
    filled = task.observed.copy()
    # With several channels of the simulation, the one that belongs to the sensor is not known.
    if sensor.shape[-1] != 1:
        return filled
    run_ends = np.cumsum(task.lengths)
    for first, end in zip(run_ends - task.lengths, run_ends, strict=True):
        # Slices of the copy are filled in place.
        for channel in network.features.reading.select_channels(filled[first:end]).T:
            channel[:] = fill_gaps(channel, sensor[first:end, 0])
    return filled


class PairTuner(NoiseMatchedTuner[TrainedPairNetwork]):
    """Base class of tuners on TuneNet's network.

    Subclasses define the design, the inputs and the tuning loop.
    """

    is_single_input: ClassVar[bool] = False
    """True if the network has a single input, the target; see `pair_network.train`."""

    def make_network_design(self) -> PairNetworkDesign:
        """Return the design of the network."""
        raise NotImplementedError

    def train_network(
        self,
        data: TrainingData,
        rng: np.random.Generator,
        training_range: Array,  # noqa: ARG002 - the network learns differences of parameters
        monitor: TrainingMonitor[TrainingData] | None,
    ) -> TrainedPairNetwork:
        """Train the network on simulations with the noise of one level.

        Args:
            data: simulations to train on, with noise.
            rng: random generator.
            training_range: (2, dim) corners of the training range; unused.
            monitor: monitor of the training; None for none.
        """
        return TrainedPairNetwork.train(
            self.make_network_design(),
            data,
            rng,
            self.make_feature_config(),
            self.is_single_input,
            monitor,
        )

    def restore_network(self, arrays: dict[str, Array]) -> TrainedPairNetwork:
        """Restore one network from its arrays; see `TrainedPairNetwork.from_arrays`."""
        return TrainedPairNetwork.from_arrays(
            arrays, self.make_network_design(), self.make_feature_config()
        )
