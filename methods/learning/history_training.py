"""Train the network that reads tuning histories (`methods.learning.history_transformer`).

Source: X. Zhang, S. Liu et al., IEEE RA-L 2025, arXiv 2410.20357, Algorithm 2. With e_i the
simulations of a history and t the target's parameters:

    (1)  loss = mean |first guess - t|^2 + |next after e_i - t|^2 / (|e_i - t|^2 + relative^2)
    (2)  published: loss = mean |next after e_i - e_(i + 1)|^2

The penalty lambda |weights|^2 is added to both.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from methods.learning.deterministic_torch import deterministic_training
from methods.learning.history_transformer import (
    HistoryTransformerDesign,
    get_weight_shapes,
    predict_proposals,
)
from methods.learning.tuning_histories import HistoryIndices
from methods.tuner import Array

if TYPE_CHECKING:
    import torch

_INITIAL_WEIGHT_LIMIT = 1.7
"""Limit of initial weights times the root of the number of inputs of a layer.

It gives a variance close to 1 / inputs.
"""
_RESIDUAL_WEIGHT_FACTOR = 0.3
"""Factor of the initial weights of layers whose output is added to another value.

With small weights these layers initially change the sum only a little.
"""
_RESIDUAL_LAYERS = ("mixed", "outer", "guess", "next")
_ERROR_FACTOR = 1.0 / 3.0
"""Factor of relative squared errors, compared with the errors of the first guess."""


class TrainingHistories(NamedTuple):
    """Training data of the network.

    Attributes:
        shown: (scenarios, m, D) input rows of the simulations.
        target: (scenarios, m, D) input rows of the same simulations as targets.
        parameters: (scenarios, m, dim) parameters, in half widths from the middle of the training
            range.
    """

    shown: Array
    target: Array
    parameters: Array

    def to_tensors(self) -> list[Any]:
        """Convert the arrays to torch tensors."""
        import torch

        return [torch.as_tensor(array, dtype=torch.float32) for array in self]


class HistoryValidationMonitor(NamedTuple):
    """Held-out data, and a callback for the losses.

    Attributes:
        material: held-out data.
        epoch: called with the epoch from 1, the number of epochs, training and held-out loss.
    """

    material: TrainingHistories
    epoch: Callable[[int, int, float, float], None]


def train_history_transformer(
    material: TrainingHistories,
    draw_histories: Callable[[np.random.Generator], HistoryIndices],
    design: HistoryTransformerDesign,
    rng: np.random.Generator,
    watched: HistoryValidationMonitor | None = None,
) -> dict[str, Array]:
    """Train the weights; equal generators give bit-identical weights.

    Args:
        material: training data.
        draw_histories: function that draws the histories of a batch.
        design: design of the network and of its training.
        rng: seeds the initial weights and all random draws; global random state is not changed.
        watched: held-out data and callback for the losses, without the penalty; the weights do not
            depend on it.

    Returns:
        Weight arrays as in `get_weight_shapes`.
    """
    import torch

    with deterministic_training(), torch.enable_grad():
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        shapes_by_name = get_weight_shapes(
            material.shown.shape[-1], material.parameters.shape[-1], design
        )
        w = _draw_initial_weights(shapes_by_name, generator)
        _minimise_loss(w, material, draw_histories, design, rng, watched)
        return {name: v.detach().numpy().astype(np.float64) for name, v in w.items()}


def _draw_initial_weights(
    shapes_by_name: dict[str, tuple[int, ...]], generator: torch.Generator
) -> dict[str, Any]:
    """Draw initial weights uniform in +- gain / sqrt(inputs); biases are zero.

    `shapes_by_name` has the shape of each array. Layers whose output is added to another value
    (names that begin with one of `_RESIDUAL_LAYERS`) get a smaller gain.
    """
    import torch

    w: dict[str, Any] = {}
    for name, shape in shapes_by_name.items():
        gain = _INITIAL_WEIGHT_LIMIT if name.endswith("weight") else 0.0
        if name.startswith(_RESIDUAL_LAYERS):
            gain *= _RESIDUAL_WEIGHT_FACTOR
        limit = gain / shape[0] ** 0.5
        uniform = torch.rand(shape, generator=generator) * 2 - 1
        w[name] = (uniform * limit).requires_grad_()
    return w


def _minimise_loss(
    w: dict[str, Any],
    material: TrainingHistories,
    draw_histories: Callable[[np.random.Generator], HistoryIndices],
    design: HistoryTransformerDesign,
    rng: np.random.Generator,
    monitor: HistoryValidationMonitor | None,
) -> None:
    """Minimise the loss with Adam; the weights are changed in place.

    The learning rate falls to zero along half a cosine. `w` are the weights, `material` the
    training simulations, and `draw_histories` draws the histories of one batch. `monitor` gets the
    losses on training and held-out data after each epoch; None for none.
    """
    import torch

    parts = material.to_tensors()
    watched_parts = monitor and monitor.material.to_tensors()
    # torch's weight_decay is the gradient of half of it times the squared norm.
    decay = 2.0 * design.weight_decay
    optimiser: Any = torch.optim.Adam(list(w.values()), design.rate, weight_decay=decay, fused=True)
    for epoch in range(design.epochs):
        rate_factor = 0.5 + 0.5 * float(np.cos(np.pi * epoch / design.epochs))
        for group in optimiser.param_groups:
            group["lr"] = design.rate * rate_factor
        order = rng.permutation(len(parts[0]))
        losses = []
        for first in range(0, len(order), design.batch):
            batch = order[first : first + design.batch]
            optimiser.zero_grad()
            error = _compute_loss(w, design, [part[batch] for part in parts], draw_histories(rng))
            error.backward()
            optimiser.step()
            losses.append(error.detach())
        if monitor and watched_parts:
            # A separate random stream keeps the training independent of the evaluation.
            histories = draw_histories(np.random.default_rng(0))
            with torch.no_grad():
                held_out = float(_compute_loss(w, design, watched_parts, histories))
                training = float(torch.stack(losses).mean())
            monitor.epoch(epoch + 1, design.epochs, training, held_out)


def _compute_loss(
    w: dict[str, Any], design: HistoryTransformerDesign, parts: list[Any], histories: HistoryIndices
) -> Any:
    """Compute the mean squared error of the proposals: loss (1), or (2) if published.

    (1) compares each proposal with the target's parameters, relative to the distance of the
    simulation before; (2) compares it with the next point of the history. `parts` are input rows
    without and with noise, and parameters, of one batch of scenarios; `histories` are the indices
    of the simulations that form each history and of its target.
    """
    import torch

    simulations, target, parameters = parts
    tokens = (simulations @ w["seen.weight"])[:, histories.tried]
    aim = (target @ w["seen.weight"])[:, histories.targets]
    proposed = parameters[:, histories.tried]
    truth = parameters[:, histories.targets][:, :, None]
    proposals = predict_proposals(torch, w, design, aim, tokens, proposed)
    if design.published:
        return ((proposals[:, :, 1:-1] - proposed[:, :, 1:]) ** 2).mean()  # (2)
    squares = ((proposals - truth) ** 2).sum(dim=-1)
    # Small distances matter in the last steps of tuning, so they must have enough weight.
    distances = ((proposed - truth) ** 2).sum(dim=-1) + design.relative**2
    parts = [squares[:, :, :1], squares[:, :, 1:] / distances * _ERROR_FACTOR]
    return torch.cat(parts, dim=2).mean()  # (1)
