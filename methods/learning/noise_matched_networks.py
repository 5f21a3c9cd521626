"""Networks for several noise levels, chosen by the noise of the target, and their tuners."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Generic, Protocol, TypeVar

import numpy as np

from methods.learning.input_features import FeatureConfig
from methods.learning.network_training import TrainingMonitor
from methods.learning.training_data import TrainingData, generate_training_data
from methods.tuner import Array, Task, TrainingSimulator, Tuner

_MAX_PARTS = 8
"""Maximum number of parts of a run for the noise estimate."""


_MIN_PART_DIFFERENCES = 16
"""Minimum number of third differences in a part."""


_NORMAL_MAD = 0.6745
"""Median absolute value of a normal variable, in standard deviations."""


_THIRD_DIFFERENCE_STD: float = 20.0**0.5
"""Standard deviation of third differences of white noise with variance 1.

The variance is 1 + 9 + 9 + 1 = 20.
"""


def estimate_noise_sigma(observations: Array, lengths: tuple[int, ...]) -> Array:
    """Estimate the standard deviation of white noise from the third differences of each run.

    It is the one that explains the median third difference of the run's smoothest part, because
    smooth motion has nearly none. A run is divided into up to eight parts of at least sixteen
    differences, so that impacts and rattling elsewhere do not count.

    Shapes: n observations, T samples, C channels.

    Args:
        observations: (n, T, C) observations; NaN for missing samples.
        lengths: number of samples of each run.

    Returns:
        (n, C) noise in SI units: for each channel the largest one of all runs, 0 if no run has four
        successive samples.
    """
    sigmas = np.zeros((observations.shape[0], observations.shape[2]))
    for run in np.split(observations, np.cumsum(lengths)[:-1], axis=1):
        # Third differences of a parabola are zero, so those of smooth motion are small.
        third_differences = np.abs(np.diff(run, n=3, axis=1))
        count = min(_MAX_PARTS, max(1, third_differences.shape[1] // _MIN_PART_DIFFERENCES))
        parts = np.array_split(third_differences, count, axis=1)
        for index in np.ndindex(sigmas.shape):
            observation_index, channel_index = index
            min_median = _compute_min_part_median(
                [part[observation_index, :, channel_index] for part in parts]
            )
            noise = min_median / (_NORMAL_MAD * _THIRD_DIFFERENCE_STD)
            sigmas[index] = max(float(sigmas[index]), noise)
    return sigmas


def _compute_min_part_median(parts: list[Array]) -> float:
    """Return the smallest median of the parts, without NaN; 0 if there are no values."""
    medians = []
    for part in parts:
        available_values = part[~np.isnan(part)]
        if available_values.size:
            medians.append(float(np.median(available_values)))
    return min(medians, default=0.0)


_CLEAN_ROUGHNESS_FACTOR = 2.0
"""Maximum roughness of a noise-free target, in multiples of the simulations' roughness."""
_NOISE_SHARE_THRESHOLD = 50.0
"""Divisor of the training noise that gives the threshold for noisy targets.

A target counts as noisy if its noise exceeds 1/50 of the noise of the training.
"""


class StorableNetwork(Protocol):
    """Trained network that can be stored."""

    def to_arrays(self) -> dict[str, Array]:
        """Return everything as plain arrays by name."""
        ...


Learner = TypeVar("Learner", bound=StorableNetwork)
TrainFunction = Callable[[str, TrainingData, "Array | None"], Learner]
"""Function that trains a network.

Its arguments are the name of the stage, the training data, and the standard deviations (C,) of the
noise that was added to them; None for noise-free data.
"""


@dataclass(frozen=True)
class NoiseMatchedNetworks(Generic[Learner]):
    """One network for noise-free targets, and one for noisy targets.

    The two networks use different features of an observation. Without noise, single samples follow
    the parameters exactly even far outside the training range. With noise, a combination of many
    samples is needed.

    Attributes:
        clean: network trained on noise-free simulations; the noisy one if noise-free targets are
            excluded.
        noisy: network trained on the same simulations with noise; the clean one if there is no
            noise.
        limit: (C,) roughness above which a target counts as noisy, SI units.
    """

    clean: Learner
    noisy: Learner
    limit: Array

    @classmethod
    def train(
        cls,
        data: TrainingData,
        rng: np.random.Generator,
        reading: FeatureConfig,
        learn: TrainFunction[Learner],
    ) -> NoiseMatchedNetworks[Learner]:
        """Train both networks on the same simulations, or one if one kind of target is expected.

        Args:
            data: training data.
            rng: random generator.
            reading: configuration of the inputs and of the noise.
            learn: function that trains a network.
        """
        spread = data.flattened_observations.std(axis=(0, 1))
        # A target counts as noisy if it is clearly rougher than every noise-free simulation.
        data_noise = estimate_noise_sigma(data.flattened_observations, data.lengths).max(axis=0)
        limit = (
            _CLEAN_ROUGHNESS_FACTOR * data_noise + reading.noise / _NOISE_SHARE_THRESHOLD * spread
        )

        def noisy() -> Learner:
            """Train the network for noisy targets, on the simulations with noise."""
            noise = reading.noise * spread
            return learn("noisy", data.with_noise(noise, rng), noise)

        # Autocorrelated sensor errors look as smooth as a noise-free target, so there is one
        # network.
        if reading.noise and not reading.clean:
            network = noisy()
            return cls(network, network, limit)
        clean_network = learn("clean", data, None)
        return cls(clean_network, noisy() if reading.noise else clean_network, limit)

    def select_for(self, task: Task) -> Learner:
        """Return the network for a target, chosen by the target's roughness."""
        # One estimate per channel; one rough channel makes the target noisy.
        (roughness,) = estimate_noise_sigma(task.observed[None], task.lengths)
        return self.noisy if (roughness > self.limit).any() else self.clean

    def to_arrays(self) -> dict[str, Array]:
        """Return both networks as plain arrays by name, as a weights file stores them.

        If one network serves for all noise levels, it is stored once.
        """
        arrays = {f"clean.{name}": array for name, array in self.clean.to_arrays().items()}
        if self.noisy is not self.clean:
            arrays |= {f"noisy.{name}": array for name, array in self.noisy.to_arrays().items()}
        return arrays | {"limit": self.limit}

    @classmethod
    def from_arrays(
        cls,
        state: dict[str, Array],
        reading: FeatureConfig,
        restore: Callable[[dict[str, Array]], Learner],
    ) -> NoiseMatchedNetworks[Learner]:
        """Restore the networks from the arrays of `to_arrays`.

        Args:
            state: arrays by name.
            reading: configuration of the inputs and of the noise.
            restore: function that restores one network from its arrays.

        Raises:
            ValueError: arrays have other names or shapes, or numbers that are not finite.
        """
        arrays_by_part: dict[str, dict[str, Array]] = {"clean": {}, "noisy": {}, "limit": {}}
        for name, array in state.items():
            part, _, array_name = name.partition(".")
            if part not in arrays_by_part:
                raise ValueError(f"expected arrays of {sorted(arrays_by_part)}, found {name}")
            arrays_by_part[part][array_name] = array
        limit = np.array(arrays_by_part["limit"].get("", np.nan), dtype=np.float64)
        if limit.ndim != 1 or not np.isfinite(limit).all():
            raise ValueError(
                "array limit: expected finite numbers of shape (channels,), "
                f"found shape {limit.shape}"
            )
        # As in `train`: one network without noise, or without noise-free targets.
        has_two_networks = bool(reading.noise) and reading.clean
        if has_two_networks != bool(arrays_by_part["noisy"]):
            raise ValueError(
                f"expected {'two networks' if has_two_networks else 'one network'}, found another "
                "number of them"
            )
        clean_network = restore(arrays_by_part["clean"])
        noisy_network = restore(arrays_by_part["noisy"]) if has_two_networks else clean_network
        return cls(clean_network, noisy_network, limit)


def add_noise_to_held_out(held_out: TrainingData, noise: Array | None) -> TrainingData:
    """Add noise of standard deviations (C,) to held-out simulations; None for no noise."""
    # A separate random stream keeps the training independent of the evaluation.
    return held_out if noise is None else held_out.with_noise(noise, np.random.default_rng(0))


_UNIT_RANGE = np.array([[0.0], [1.0]])
"""Corners of the unit cube, a training range in any number of dimensions."""


class NoiseMatchedTuner(Tuner, Generic[Learner]):
    """Base class of tuners with a network for each noise level: training, state, configuration.

    Subclasses define the training of a network, its arrays and the tuning loop. The attributes are
    options of those subclasses that do not define `make_feature_config` themselves; see
    `methods.tuners.tunenet.TuneNet`.
    """

    requires: ClassVar[tuple[str, ...]] = ("torch",)
    stochastic: ClassVar[bool] = False
    learned: ClassVar[bool] = True

    points: int
    inputs: int
    strictness: float
    noise: float
    told: bool
    channels: tuple[int, int] | None
    clean: bool

    _fitted: NoiseMatchedNetworks[Learner] | None = None

    def make_feature_config(self) -> FeatureConfig:
        """Return the configuration of the inputs."""
        return FeatureConfig(
            self.points,
            self.inputs,
            self.strictness,
            self.noise,
            use_scenario_features=self.told,
            channels=self.channels,
            clean=self.clean,
        )

    def choose_training_layout(self, dim: int) -> tuple[int, int]:
        """Return the maximum number of training scenarios, and of simulations in each."""
        raise NotImplementedError

    def draw_points(
        self, simulator: TrainingSimulator, rng: np.random.Generator, count: int
    ) -> Array:
        """Draw the points (count, dim) of a training scenario, uniformly by default."""
        return simulator.sample(rng, count)

    def train_network(
        self,
        data: TrainingData,
        rng: np.random.Generator,
        training_range: Array,
        monitor: TrainingMonitor[TrainingData] | None,
    ) -> Learner:
        """Train the network for one noise level.

        Args:
            data: simulations to train on, with noise.
            rng: random generator.
            training_range: (2, dim) corners of the training range.
            monitor: monitor of the training; None for none.
        """
        raise NotImplementedError

    def restore_network(self, arrays: dict[str, Array]) -> Learner:
        """Restore one network from its arrays.

        Raises:
            ValueError: arrays have other names or shapes, or numbers that are not finite.
        """
        raise NotImplementedError

    def fit(self, simulator: TrainingSimulator, rng: np.random.Generator, budget: int) -> None:
        """Train on at most `budget` simulations of the training range.

        Args:
            simulator: training simulator.
            rng: random generator.
            budget: maximum number of simulations.

        Raises:
            ValueError: the budget is smaller than two scenarios.
        """
        scenarios, per_scenario = self.choose_training_layout(simulator.dim)
        training_data = generate_training_data(
            simulator, rng, budget, scenarios, per_scenario, self.draw_points
        )
        held_out = None
        # A watched training also reports the loss on simulations that are not trained on.
        if self.watch is not None:
            ground = self.watch.ground
            # Separate simulations and a separate random stream do not affect the training.
            stream = np.random.default_rng(0)
            held_out = generate_training_data(
                ground, stream, ground.budget, scenarios, max(per_scenario, 2), self.draw_points
            )
        self.train_on(training_data, rng, held_out, np.array(simulator.training, dtype=np.float64))

    def train_on(
        self,
        data: TrainingData,
        rng: np.random.Generator,
        held_out: TrainingData | None = None,
        training_range: Array = _UNIT_RANGE,
    ) -> None:
        """Train on simulations, one network for each noise level.

        Args:
            data: training data.
            rng: random generator.
            held_out: held-out data for the losses that the callback `watch` gets; None for none.
            training_range: (2, dim) corners of the training range.
        """
        callback = self.watch

        def learn(stage: str, noisy_data: TrainingData, noise: Array | None) -> Learner:
            """Train the network for one noise level; called by `NoiseMatchedNetworks.train`.

            `rng`, `callback` and `held_out` belong to the training that `train_on` runs.

            Args:
                stage: name of this training, for the callback.
                noisy_data: simulations to train on, with noise.
                noise: noise that is also added to the held-out simulations; None for none.
            """
            monitor = None
            if callback is not None and held_out is not None:
                monitor = TrainingMonitor(
                    add_noise_to_held_out(held_out, noise), partial(callback.epoch, stage)
                )
            return self.train_network(noisy_data, rng, training_range, monitor)

        self._fitted = NoiseMatchedNetworks.train(data, rng, self.make_feature_config(), learn)

    def state(self) -> dict[str, Array]:
        """Return weights and input features by name; empty before `fit`."""
        return {} if self._fitted is None else self._fitted.to_arrays()

    def restore(self, state: dict[str, Array]) -> None:
        """Restore the arrays that `state` returned.

        Raises:
            ValueError: arrays have other names or shapes, or numbers that are not finite.
        """
        self._fitted = NoiseMatchedNetworks.from_arrays(
            state, self.make_feature_config(), self.restore_network
        )

    def get_trained_network(self) -> NoiseMatchedNetworks[Learner]:
        """Return the trained networks.

        Raises:
            RuntimeError: the tuner has not been trained.
        """
        if self._fitted is None:
            raise RuntimeError(f"{self.name} has not been trained; call fit or restore first")
        return self._fitted
