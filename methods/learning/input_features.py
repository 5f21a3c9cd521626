"""Input rows of the networks: features of the observation and of the scenario together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from methods.learning.network_training import check_shapes
from methods.learning.observation_features import (
    ObservationFeatures,
    make_raw_features,
    make_weighted_features,
)
from methods.learning.scenario_features import ScenarioFeatures
from methods.learning.training_data import TrainingData
from methods.tuner import Array, ScenarioInfo

_OBSERVATION_FEATURE_ARRAYS = ("chosen", "centre", "gain")
"""Names of the arrays of `ObservationFeatures` that are stored."""
_SCENARIO_FEATURE_ARRAYS = ("centre", "spread", "initial")
"""Names of the arrays of `ScenarioFeatures` that are stored."""
_MISSING_ARRAY = np.empty(0)
"""Replacement of a missing array."""


@dataclass(frozen=True)
class FeatureConfig:
    """Configuration of network inputs and of the noise in training.

    Attributes:
        points: number of points to which each run is resampled; L in Algorithm 1.
        inputs: maximum number of inputs that are used from an observation.
        strictness: see `methods.learning.observation_features.make_weighted_features`.
        noise: sensor noise that a second network is trained with, as standard deviation in units of
            each channel's standard deviation in training; 0 for no second network.
        raw: True for the resampled series in SI units without weights, as published; the other
            settings then have no effect.
        use_scenario_features: True to use scenario information too, if scenarios differ in it
            (`methods.learning.scenario_features`).
        channels: indices of the first and the last channel that are used; None for all.
        clean: whether targets may be noise-free; if not, only the network for noisy targets is
            trained.
        proposed: configuration of the inputs of the network's proposed side, if it differs.
    """

    points: int = 400
    inputs: int = 400
    strictness: float = 1000.0
    noise: float = 0.01
    raw: bool = False
    use_scenario_features: bool = True
    channels: tuple[int, int] | None = None
    clean: bool = True
    proposed: FeatureConfig | None = None

    def select_channels(self, observations: Array) -> Array:
        """Return the channels (..., c) that are used, of observations (..., C) with C channels.

        Indices beyond the last channel are replaced by the last one.
        """
        if self.channels is None:
            return observations
        last_channel = observations.shape[-1] - 1
        first, last = (min(channel, last_channel) for channel in self.channels)
        return observations[..., first : last + 1]


@dataclass(frozen=True)
class InputFeatures:
    """Map to input rows, chosen and scaled by the training simulations.

    Attributes:
        reading: configuration from which it was made.
        observation_features: map from observations to input rows.
        scenario_features: map from scenario information to further inputs; None if scenarios were
            equal in training.
    """

    reading: FeatureConfig
    observation_features: ObservationFeatures
    scenario_features: ScenarioFeatures | None = None

    @classmethod
    def fit(cls, data: TrainingData, reading: FeatureConfig) -> InputFeatures:
        """Choose the inputs from training data: samples that follow the parameters.

        If scenarios differ, numbers that describe them are added; if their input signals differ,
        these numbers replace the samples. As published (`reading.raw`) all resampled samples are
        inputs.

        Args:
            data: training simulations.
            reading: configuration of the inputs.
        """
        data = data._replace(observations=reading.select_channels(data.observations))
        if reading.raw:
            raw_features = make_raw_features(
                data.flattened_observations, data.lengths, reading.points
            )
            return cls(reading, raw_features)
        scenario_features = None
        if reading.use_scenario_features:
            scenario_features = ScenarioFeatures.fit(data.scenes, data.observations, data.lengths)
        # If inputs vary, samples have another meaning in each scenario, so only responses are used.
        has_varying_inputs = scenario_features is not None and scenario_features.has_varying_inputs
        input_count = 0 if has_varying_inputs else reading.inputs
        observation_features = make_weighted_features(
            data, reading.points, input_count, reading.strictness
        )
        return cls(reading, observation_features, scenario_features)

    @property
    def feature_count(self) -> int:
        """Length of an input row."""
        scenario_size = 0 if self.scenario_features is None else self.scenario_features.centre.size
        return self.observation_features.chosen.size + scenario_size

    def __call__(
        self,
        observations: Array,
        lengths: tuple[int, ...],
        scene: ScenarioInfo,
        missing: Array | None = None,
    ) -> Array:
        """Compute input rows (n, D) from observations (n, T, C) of one scenario.

        Shapes: n observations, T samples, C channels, D inputs of the network.

        Args:
            observations: observations in SI units; NaN for missing samples.
            lengths: number of samples of each run.
            scene: scenario information.
            missing: (T, C) mask of further samples to treat as missing: those missing in the
                target, so that a simulation with the true parameters gives the target's own row.

        Raises:
            ValueError: the observation or the scenario differs in its shape from those of the
                training.
        """
        if missing is not None and missing.any():
            observations = np.where(missing, np.nan, observations)
        observations = self.reading.select_channels(observations)
        rows = self.observation_features(observations, lengths)
        if self.scenario_features is None:
            return rows
        further = self.scenario_features(observations, lengths, scene)
        return np.concatenate([rows, further], axis=1)

    def compute_rows(self, data: TrainingData) -> Array:
        """Compute the input rows of training simulations.

        Returns:
            (scenarios, simulations per scenario, D) inputs of the network.
        """
        if self.scenario_features is None:
            # All scenarios are computed in one call, because the rows do not depend on the
            # scenario.
            rows = self.observation_features(
                self.reading.select_channels(data.flattened_observations), data.lengths
            )
            return rows.reshape(*data.parameters.shape[:2], -1)
        observed_scenarios = zip(data.observations, data.scenes, strict=True)
        return np.array(
            [self(observations, data.lengths, scene) for observations, scene in observed_scenarios]
        )

    def to_arrays(self) -> dict[str, Array]:
        """Return everything as plain arrays by name, as a weights file stores it."""
        state: dict[str, Array] = {}
        for name in _OBSERVATION_FEATURE_ARRAYS:
            state[f"inputs.{name}"] = np.asarray(getattr(self.observation_features, name))
        if self.scenario_features is not None:
            for name in _SCENARIO_FEATURE_ARRAYS:
                state[f"told.{name}"] = np.asarray(
                    getattr(self.scenario_features, name), dtype=np.float64
                )
        return state

    @classmethod
    def from_arrays(
        cls, state: dict[str, Array], reading: FeatureConfig
    ) -> tuple[InputFeatures, dict[str, Array]]:
        """Restore the map from the arrays of `to_arrays`.

        Arrays named `inputs.*` describe the features of observations, arrays named `told.*` those
        of scenarios.

        Args:
            state: arrays by name; other names, such as those of weights, are allowed.
            reading: configuration of the inputs.

        Returns:
            The map, and the arrays of other names.

        Raises:
            ValueError: arrays are missing or have other shapes, or numbers that are not finite.
        """
        arrays = {name: np.array(array, dtype=np.float64) for name, array in state.items()}
        own_arrays = {
            name: arrays.pop(name) for name in state if name.startswith(("inputs.", "told."))
        }
        # The size of one array of each part determines the shapes of the others.
        sizes = {
            part: own_arrays.get(f"{part}.centre", _MISSING_ARRAY).size
            for part in ("inputs", "told")
        }
        shapes: dict[str, tuple[int, ...]] = {
            f"inputs.{name}": (sizes["inputs"],) for name in _OBSERVATION_FEATURE_ARRAYS
        }
        has_scenario_features = any(name.startswith("told.") for name in own_arrays)
        if has_scenario_features:
            shapes |= {f"told.{name}": (sizes["told"],) for name in _SCENARIO_FEATURE_ARRAYS}
            shapes["told.initial"] = ()
        chosen_numbers, centre, gain, *scenario_arrays = check_shapes(own_arrays, shapes).values()
        if not sum(sizes.values()):
            raise ValueError("expected a network with inputs, found one without")
        observation_features = ObservationFeatures(
            reading.points, reading.raw, chosen_numbers, centre, gain
        )
        scenario_features = None
        if has_scenario_features:
            scenario_centre, spread, initial = scenario_arrays
            scenario_features = ScenarioFeatures(scenario_centre, spread, int(initial))
        return cls(reading, observation_features, scenario_features), arrays
