"""Train the weights of a network with torch, on the CPU.

Equal random generators give bit-identical weights, and global random state is not changed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from methods.learning.library_isolation import deterministic_training
from methods.tuner import Array

Data = TypeVar("Data")
ConvertedData = TypeVar("ConvertedData")
Weights = dict[str, Any]
"""Weights as torch tensors, by name: ``LAYER.weight`` (inputs, outputs), ``LAYER.bias``."""

INITIAL_WEIGHT_LIMIT = 1.7
"""Limit of initial weights times the root of the number of inputs of a layer.

It gives a variance close to 1 / inputs.
"""


@dataclass(frozen=True)
class TrainingMonitor(Generic[Data]):
    """Monitor of the training of one network; the weights do not depend on it.

    Attributes:
        held_out: data that are used for evaluation only.
        epoch: called after each epoch with its number from 1, the number of epochs, training loss
            and held-out loss, both without a penalty on the weights.
    """

    held_out: Data
    epoch: Callable[[int, int, float, float], None]

    def convert(self, function: Callable[[Data], ConvertedData]) -> TrainingMonitor[ConvertedData]:
        """Return a monitor that gets converted data, such as input rows of simulations."""
        return TrainingMonitor(function(self.held_out), self.epoch)


def train_weights(
    shapes: dict[str, tuple[int, ...]],
    get_gain: Callable[[str], float],
    rng: np.random.Generator,
    fit: Callable[[Weights, Any], None],
) -> dict[str, Array]:
    """Draw initial weights uniform in +- gain / sqrt(inputs), and train them.

    Args:
        shapes: shape of each array; the biases of a layer follow its weights.
        get_gain: returns the gain for the name of an array; 0 for biases of zero.
        rng: seeds the random generator of torch.
        fit: changes the weights in place; its second argument is the generator of torch.

    Returns:
        Trained arrays by name.
    """
    import torch

    # Layers this small do not use a GPU well: an H100 takes 1.6 to 2.7 times as long as its host.
    with deterministic_training(), torch.enable_grad():
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        weights: Weights = {}
        fan_in = 1
        for name, shape in shapes.items():
            # A bias has the same number of inputs as the weights of its layer.
            fan_in = shape[0] if name.endswith("weight") else fan_in
            limit = get_gain(name) / fan_in**0.5
            uniform = torch.rand(shape, generator=generator) * 2 - 1
            weights[name] = (uniform * limit).requires_grad_()
        fit(weights, generator)
        return {name: w.detach().numpy().astype(np.float64) for name, w in weights.items()}


def minimise_loss(
    optimiser: Any,
    rates: Iterable[float],
    epochs: int,
    draw_batches: Callable[[], Iterable[Any]],
    compute_loss: Callable[[Any], Any],
    monitor: TrainingMonitor[Callable[[], Any]] | None,
    compute_penalty: Callable[[], Any] = lambda: 0.0,
) -> None:
    """Minimise a loss by gradient descent on batches; the weights are changed in place.

    Args:
        optimiser: torch's optimiser of the weights.
        rates: learning rate of each epoch.
        epochs: number of epochs, for the monitor.
        draw_batches: divides the training data into batches, for each epoch anew.
        compute_loss: computes the loss of a batch.
        monitor: gets the losses after each epoch; its `held_out` computes the held-out loss.
        compute_penalty: computes a penalty on the weights, which is added to the loss.
    """
    import torch

    for epoch, rate in enumerate(rates, 1):
        for group in optimiser.param_groups:
            group["lr"] = rate
        losses = []
        for batch in draw_batches():
            optimiser.zero_grad()
            loss = compute_loss(batch)
            (loss + compute_penalty()).backward()
            optimiser.step()
            losses.append(loss.detach())
        if monitor is not None:
            with torch.no_grad():
                training, held_out = float(torch.stack(losses).mean()), float(monitor.held_out())
            monitor.epoch(epoch, epochs, training, held_out)


def compute_cosine_rates(rate: float, epochs: int) -> list[float]:
    """Compute the learning rate of each epoch, which falls to zero along half a cosine."""
    return [rate * (0.5 + 0.5 * float(np.cos(np.pi * epoch / epochs))) for epoch in range(epochs)]


def check_shapes(
    arrays: dict[str, Array], expected: dict[str, tuple[int, ...]]
) -> dict[str, Array]:
    """Return the arrays in the order of the expected names, after a check of their shapes.

    Args:
        arrays: arrays by name, such as those of a weights file.
        expected: shape of each array by name.

    Raises:
        ValueError: arrays have other names or shapes, or numbers that are not finite.
    """
    if arrays.keys() != expected.keys():
        raise ValueError(f"expected arrays {sorted(expected)}, found {sorted(arrays)}")
    for name, shape in expected.items():
        if arrays[name].shape != shape or not np.isfinite(arrays[name]).all():
            raise ValueError(
                f"array {name}: expected finite numbers of shape {shape}, "
                f"found {arrays[name].shape}"
            )
    return {name: arrays[name] for name in expected}
