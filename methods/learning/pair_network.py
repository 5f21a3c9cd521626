"""Pair network of TuneNet, its training, and the base class of the tuners that use it.

The network has one branch for each of two observations; the branches are concatenated and followed
by fully connected layers. `train_pair_network` trains it with torch; tuning uses
`estimate_difference`, a forward pass in numpy with double precision. Source: arXiv 1907.11200,
section III and Eq. 1; layer sizes and training from the authors' released code.

With a and b the input rows of the proposed and the target side, u the units, [ ] concatenation:

    (1)  n(a, b) = Wo u(Wj [u(Wp a), u(Wt b)]), each W with its bias; published: tanh of it
    (2)  h(a, b) = (n(a, b) - n(b, a)) / 2, so that h(o, o) = 0; published: h = n
    (3)  loss = mean |h - difference|^2 / (|difference|^2 + relative^2) + lambda |weights|^2

Eq. 1 of the paper is (3) without the denominator, so that the size of the difference does not
matter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from methods.learning.gap_filling import fill_target_gaps
from methods.learning.input_features import FeatureConfig, InputFeatures
from methods.learning.network_training import (
    INITIAL_WEIGHT_LIMIT,
    TrainingMonitor,
    Weights,
    check_shapes,
    compute_cosine_rates,
    minimise_loss,
    train_weights,
)
from methods.learning.noise_matched_networks import NoiseMatchedTuner
from methods.learning.training_data import TrainingData
from methods.tuner import Array, Task

LAYER_NAMES = ("proposed", "target", "joined", "output")
"""Names of the fully connected layers.

Each has a `.weight` (inputs, outputs) and a `.bias` (outputs,).
"""

_SOFTPLUS_AT_ZERO = float(np.log(2.0))
"""Softplus at zero; it is subtracted, so that a unit with input zero has output zero."""
_LOSS_SCALE = 30.0
"""Divisor of relative squared errors; for Adam only their ratio to the penalty matters."""
_LEARNING_RATE_DECAY = 0.99
"""Factor by which the published learning rate decreases in each epoch."""
_PROPOSED_SIDE_PREFIX = "own-"
"""Prefix of array names of the proposed side if both sides have different inputs."""


@dataclass(frozen=True)
class PairNetworkDesign:
    """Design of a network and of its training.

    The defaults are this project's, those of `PUBLISHED_DESIGN` the authors'.

    Attributes:
        width: number of units of each branch and of the joined layer.
        smooth: True for softplus units (shifted through the origin), False for rectified linear
            ones.
        antisymmetric: True for h(a, b) = (n(a, b) - n(b, a)) / 2, hence h(o, o) = 0 exactly; False
            for h = n.
        bounded: True for tanh at the output.
        relative: each pair's squared error is weighted by 1 / (|difference|^2 + relative^2), unit
            cube; 0 gives equal weights.
        adam: True for Adam with a cosine learning rate; False for SGD without momentum and a rate
            that is multiplied by 0.99 per epoch.
        rate: initial learning rate.
        weight_decay: lambda in Eq. 1, per mean squared error.
        epochs: number of passes over the training data.
        batch: number of scenarios, all of whose pairs are used (published: one pair each, the first
            member proposed).
    """

    width: int = 32
    smooth: bool = True
    antisymmetric: bool = True
    bounded: bool = False
    relative: float = 0.02
    adam: bool = True
    rate: float = 3e-3
    weight_decay: float = 1e-5
    epochs: int = 100
    batch: int = 10


PUBLISHED_DESIGN = PairNetworkDesign(
    smooth=False,
    antisymmetric=False,
    bounded=True,
    relative=0.0,
    adam=False,
    rate=0.1,
    # torch's weight_decay of 1e-2 is the gradient of half of it times the squared norm.
    weight_decay=0.5e-2,
    epochs=200,
    batch=50,
)


def get_weight_shapes(inputs: tuple[int, int], width: int, dim: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of every weight array by name, in the order of the network.

    Args:
        inputs: number of inputs of the proposed and of the target side.
        width: number of units of a layer.
        dim: number of parameters.
    """
    proposed_inputs, target_inputs = inputs
    sizes = (
        (proposed_inputs, width),
        (target_inputs, width),
        (2 * width, width),
        (width, dim),
    )
    shapes_by_name: dict[str, tuple[int, ...]] = {}
    for layer, (fan_in, fan_out) in zip(LAYER_NAMES, sizes, strict=True):
        shapes_by_name[f"{layer}.weight"] = fan_in, fan_out
        shapes_by_name[f"{layer}.bias"] = (fan_out,)
    return shapes_by_name


def estimate_difference(
    weights: dict[str, Array], design: PairNetworkDesign, proposed: Array, target: Array
) -> Array:
    """Compute h(proposed, target), the estimated parameter difference target - proposed.

    It is the network's output n for these inputs (1), or, if antisymmetric, half the difference of
    n(proposed, target) and n(target, proposed) (2), so that equal inputs give zero.

    Args:
        weights: weight arrays as in `get_weight_shapes`.
        design: design of the network.
        proposed: (n, D) or (D,) input rows of the proposed simulations, D numbers each.
        target: (n, E) or (E,) input rows of the targets, E numbers each; E is D if the network is
            antisymmetric.

    Returns:
        (n, dim) or (dim,) differences in the unit cube.
    """
    w = weights

    def unit(x: Array) -> Array:
        # Softplus is smooth beyond the training range, where rectified linear units have a corner.
        return np.logaddexp(0.0, x) - _SOFTPLUS_AT_ZERO if design.smooth else np.maximum(x, 0.0)

    def branch(x: Array, layer: str) -> Array:
        return unit(x @ w[f"{layer}.weight"] + w[f"{layer}.bias"])

    def joined(a: Array, b: Array) -> Array:
        """Compute the network's output (..., dim) for inputs of its first and second branch.

        Eq. (1): both branches are concatenated, then follow one hidden and one linear layer.

        Args:
            a: (..., D) input rows of the first branch, the proposed side.
            b: (..., E) input rows of the second branch, the target side.
        """
        branches = np.concatenate([branch(a, "proposed"), branch(b, "target")], axis=-1)
        hidden = branch(branches, "joined")
        output: Array = hidden @ w["output.weight"] + w["output.bias"]  # (1)
        return np.tanh(output) if design.bounded else output

    if design.antisymmetric:
        return (joined(proposed, target) - joined(target, proposed)) / 2.0  # (2)
    return joined(proposed, target)


class PairInputs(NamedTuple):
    """Input rows of simulations for both sides of the network.

    Attributes:
        proposed: (scenarios, m, D) rows of the proposed side.
        target: (scenarios, m, E) rows of the target side; the same array if both sides have the
            same inputs.
    """

    proposed: Array
    target: Array


def train_pair_network(
    rows: PairInputs,
    parameters: Array,
    design: PairNetworkDesign,
    rng: np.random.Generator,
    alone: bool = False,
    watched: TrainingMonitor[tuple[PairInputs, Array]] | None = None,
) -> dict[str, Array]:
    """Train the weights; equal generators give bit-identical weights.

    The loss is the mean of |h - d|^2, relative to |d|^2 unless published, plus a multiple of the
    squared weights; h is the network's estimate of the difference d of the parameters of a pair of
    simulations (Eq. 1 of the paper). The method is Adam with a learning rate that falls along half
    a cosine, or as published plain gradient descent with a rate that falls exponentially.

    Args:
        rows: input rows of both sides.
        parameters: (scenarios, m, dim) parameters of m simulations per scenario, in the unit cube.
        design: design of the network and of its training.
        rng: seeds the initial weights and the order; global random state is not changed.
        alone: True to learn parameters from the target alone, with a proposed input of zero (the
            direct regressor).
        watched: input rows and parameters of held-out data, with a callback for the losses.

    Returns:
        Weight arrays as in `get_weight_shapes`.
    """
    import torch

    def get_gain(name: str) -> float:
        """Return the factor of the initial weights of an array."""
        # As published: torch's default, uniform in +- 1 / sqrt(inputs) for weights and biases.
        if not design.adam:
            return 1.0
        return INITIAL_WEIGHT_LIMIT if name.endswith("weight") else 0.0

    def fit(weights: Weights, generator: Any) -> None:
        """Minimise the loss; the weights are changed in place.

        Args:
            weights: initial weights by name, tensors of torch.
            generator: random generator of torch for the order of the samples.
        """
        proposed_rows, target_rows, y = _convert_to_tensors(rows, parameters)
        loss = _make_loss(design, weights, alone)
        monitor = None
        if watched is not None:
            held_out = _convert_to_tensors(*watched.held_out)
            monitor = TrainingMonitor(lambda: loss(*held_out), watched.epoch)
        rates = [design.rate * _LEARNING_RATE_DECAY**epoch for epoch in range(design.epochs)]
        optimiser_class: Any = torch.optim.SGD
        if design.adam:
            optimiser_class = torch.optim.Adam
            rates = compute_cosine_rates(design.rate, design.epochs)

        def draw_batches() -> Any:
            order: Any = torch.randperm(len(proposed_rows), generator=generator)
            return order.split(design.batch)

        values = list(weights.values())
        minimise_loss(
            optimiser_class(values, lr=design.rate),
            rates,
            design.epochs,
            draw_batches,
            lambda batch: loss(proposed_rows[batch], target_rows[batch], y[batch]),
            monitor,
            # The penalty is in the loss and not torch's option, so that it is Eq. 1 for Adam too.
            lambda: design.weight_decay * sum((v**2).sum() for v in values),
        )

    inputs = (rows.proposed.shape[-1], rows.target.shape[-1])
    shapes = get_weight_shapes(inputs, design.width, parameters.shape[-1])
    return train_weights(shapes, get_gain, rng, fit)


def _convert_to_tensors(rows: PairInputs, parameters: Array) -> tuple[Any, Any, Any]:
    """Convert input rows of both sides and parameters to float32 tensors.

    If both sides have the same rows, they share one tensor, which saves memory.

    Args:
        rows: input rows of the proposed side and of the target's side.
        parameters: (scenarios, m, dim) parameters of m simulations per scenario.

    Returns:
        Rows of the proposed side, rows of the target's side, and parameters.
    """
    import torch

    def tensor(array: Array) -> Any:
        return torch.as_tensor(array, dtype=torch.float32)

    proposed = tensor(rows.proposed)
    is_shared = rows.target is rows.proposed
    target = proposed if is_shared else tensor(rows.target)
    return proposed, target, tensor(parameters)


def _make_loss(
    design: PairNetworkDesign, w: dict[str, Any], is_target_only: bool
) -> Callable[[Any, Any, Any], Any]:
    """Return a function that computes the loss (3) without the penalty on the weights.

    It is the mean squared error of the estimated parameter differences, relative to their size. The
    estimate is the network's output n (1), or, if antisymmetric, half of n(a, b) - n(b, a) (2).

    The function's arguments are the input rows of the proposed side (n, m, D) and of the target's
    side (n, m, E), and the parameters (n, m, dim), for n scenarios of m simulations.

    Args:
        design: sizes and learning settings of the network.
        w: weights as tensors, by name.
        is_target_only: whether the network sees the target only (direct regression).
    """
    import torch
    from torch.nn.functional import softplus

    def activate(x: Any) -> Any:
        return softplus(x) - _SOFTPLUS_AT_ZERO if design.smooth else torch.relu(x)

    def compute_branch(x: Any, layer: str) -> Any:
        return activate(x @ w[f"{layer}.weight"] + w[f"{layer}.bias"])

    def compute_output(a: Any, b: Any) -> Any:
        hidden = compute_branch(torch.cat([a, b], dim=-1), "joined")
        output = hidden @ w["output.weight"] + w["output.bias"]  # (1)
        return torch.tanh(output) if design.bounded else output

    def objective(x: Any, target_rows: Any, y: Any) -> Any:
        """Compute the mean squared error of the estimated parameter differences.

        All m (m - 1) / 2 pairs of the m simulations of a scenario are used. Unless published, the
        error of a pair is relative to the squared difference (3). With `is_target_only` (one
        input), the network estimates the parameters y themselves from the target's side.

        Args:
            x: (n, m, D) input rows of the proposed side, for n scenarios of m simulations.
            target_rows: (n, m, E) input rows of the target's side, which may be of another length.
            y: (n, m, dim) parameters.
        """
        b = compute_branch(target_rows, "target")
        if is_target_only:
            # A proposed input of zero leaves the branch's bias.
            zero_branch = activate(w["proposed.bias"]).expand_as(b)
            error = compute_output(zero_branch, b) - y
            return (error**2).sum(dim=-1).mean()
        # Half of the ordered pairs is enough, because the network is antisymmetric.
        first, second = torch.triu_indices(x.shape[1], x.shape[1], offset=1)
        a = compute_branch(x, "proposed")
        h = compute_output(a[:, first], b[:, second])
        if design.antisymmetric:
            h = (h - compute_output(a[:, second], b[:, first])) / 2.0  # (2)
        difference = y[:, second] - y[:, first]
        squares = ((h - difference) ** 2).sum(dim=-1)
        if design.relative:
            # Small differences matter in the last steps of tuning, so they must have enough weight.
            sizes = (difference**2).sum(dim=-1) + design.relative**2
            squares = squares / sizes / _LOSS_SCALE  # (3)
        return squares.mean()

    return objective


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
                filled_target = fill_target_gaps(
                    task, observations[0], self.proposed.reading, self.features.reading
                )
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


class PairTuner(NoiseMatchedTuner[TrainedPairNetwork]):
    """Base class of tuners on TuneNet's pair network.

    Subclasses define the design, the inputs and the tuning loop.
    """

    is_single_input: ClassVar[bool] = False
    """True if the network has a single input, the target; see `TrainedPairNetwork.train`."""

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
