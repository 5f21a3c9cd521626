"""Transformer over tuning histories, its training, and the histories it is trained on.

Source: X. Zhang, S. Liu et al., Dynamics as Prompts: In-Context Learning for Sim-to-Real System
Identifications (CAPTURE), IEEE RA-L 2025, arXiv 2410.20357, section III; attention: A. Vaswani et
al., NeurIPS 2017, arXiv 1706.03762, Eq. 1.

With a the input row of a simulation at e, o that of the target, W a learned projection, e in half
widths from the middle of the training range:

    (1)  d = W (a - o),  s = root mean square of d,  u = d / s
    (2)  slope = (d - d of the simulation before) / |step|
    (3)  token = [u, log(s + s0), e, W o, step / |step|, arsinh(slope)]; the first one has W o alone
    (4)  h = blocks of attention to the tokens before, and of two layers, on the token's embedding
    (5)  next = e + s (A(h) u + c(h)), A and c linear in h; before any simulation: linear in h

With (5), next = e if the simulation equals the target, and the step decreases with the difference.
Published: next is always linear in h.

Source: X. Zhang, S. Liu et al., Dynamics as Prompts, IEEE RA-L 2025, arXiv 2410.20357, Algorithm 1.
From a source to a target, the next point lies between the nearest points tried on either side:

    (6)  l = max tried below the target, u = min tried above it, in each parameter
    (7)  next = l + r (u - l), r from Beta(a, a)

Source: X. Zhang, S. Liu et al., IEEE RA-L 2025, arXiv 2410.20357, Algorithm 2. With e_i the
simulations of a history and t the target's parameters:

    (8)  loss = mean |first guess - t|^2 + |next after e_i - t|^2 / (|e_i - t|^2 + relative^2)
    (9)  published: loss = mean |next after e_i - e_(i + 1)|^2

The penalty lambda |weights|^2 is added to both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from methods.learning.network_training import (
    INITIAL_WEIGHT_LIMIT,
    TrainingMonitor,
    Weights,
    compute_cosine_rates,
    minimise_loss,
    train_weights,
)
from methods.tuner import Array, TrainingSimulator

_SIGMA_ZERO = 0.01
"""Constant s0 in (3): differences far below those of the training give equal tokens."""
_MIN_STEP_LENGTH = 1e-9
"""Minimum divisor, so that zero divided by zero is finite."""
_CAUSAL_MASK_OFFSET = 1e9
"""Value subtracted from attention scores of later tokens (causal mask)."""


@dataclass(frozen=True)
class HistoryTransformerDesign:
    """Design of a network and of its training.

    Attributes:
        window: number of simulations of a history that the network reads.
        seen: length of d in (1).
        width: width of a token's embedding and of the layers of a block.
        blocks: number of blocks of attention and layers.
        published: True to learn the next point of a randomised binary search, as a linear function
            of h; False to learn the target's parameters, by (5).
        relative: each squared error is weighted by 1 / (|e - target|^2 + relative^2), in half
            widths.
        rate: initial learning rate; it decreases along a cosine.
        weight_decay: factor of the squared norm of the weights in the loss.
        epochs: number of passes over the scenarios.
        batch: number of scenarios in a batch.
    """

    window: int = 7
    seen: int = 8
    width: int = 32
    blocks: int = 1
    published: bool = False
    relative: float = 0.3
    rate: float = 3e-3
    weight_decay: float = 1e-5
    epochs: int = 80
    batch: int = 10


def get_weight_shapes(
    inputs: int, dim: int, design: HistoryTransformerDesign
) -> dict[str, tuple[int, ...]]:
    """Return the shape of every weight array by name, from which saved weights are checked.

    The layers: ``seen`` projects input rows, ``first`` and ``token`` embed tokens. Each block has
    ``heard`` (queries, keys and values of the attention), ``mixed`` (its output), ``lag`` (bias by
    distance of two tokens), and the two layers ``inner`` and ``outer``. ``guess`` and ``next`` give
    the proposals before and after a simulation.

    Args:
        inputs: length of an input row.
        dim: number of parameters.
        design: design of the network.
    """
    d, width = design.seen, design.width
    # A token has three vectors of d projected numbers (direction of the difference, target, slope),
    # the size of the difference, and two vectors of dim numbers (parameters, step).
    layers = {"first": (d, width), "token": (3 * d + 1 + 2 * dim, width)}
    for block in range(design.blocks):
        layers[f"heard{block}"] = width, 3 * width
        for part in ("mixed", "inner", "outer"):
            layers[f"{part}{block}"] = width, width
    layers["guess"] = width, dim
    # A proposal itself, or for each parameter d gains and an offset, see `predict_proposals`.
    layers["next"] = width, dim if design.published else dim * (d + 1)
    # The projection has no bias, because a bias would cancel in every difference.
    shapes_by_name: dict[str, tuple[int, ...]] = {"seen.weight": (inputs, d)}
    for layer, (fan_in, fan_out) in layers.items():
        shapes_by_name[f"{layer}.weight"] = fan_in, fan_out
        shapes_by_name[f"{layer}.bias"] = (fan_out,)
    for block in range(design.blocks):
        shapes_by_name[f"lag{block}.bias"] = (design.window + 1,)
    return shapes_by_name


def predict_proposals(
    xp: Any,
    w: dict[str, Any],
    design: HistoryTransformerDesign,
    target: Any,
    simulations: Any,
    tried: Any,
) -> Any:
    """Compute the proposals before and after each simulation of a history.

    Each simulation becomes a token: direction u and size s of its difference from the target, its
    parameters e, the target, and the step from the simulation before (3). The first token is that
    of the target alone. Blocks of attention turn the tokens into outputs h (4). From these, the
    next proposal is e + s (A(h) u + c(h)) (5), with a matrix A and a vector c that are linear in h;
    as published, it is itself linear in h.

    The code is shared by numpy and torch, whose functions have the same names.

    Args:
        xp: module numpy or torch.
        w: weight arrays as in `get_weight_shapes`.
        design: design of the network.
        target: (..., d) row of the target, projected to d numbers by the weights ``seen``.
        simulations: (..., k, d) projected rows of the k simulations; k is at most the window.
        tried: (..., k, dim) parameters of the simulations, in half widths from the middle.

    Returns:
        (..., k + 1, dim) proposals, in half widths from the middle.
    """
    target_row = target[..., None, :]
    differences = simulations - target_row
    # Root mean square, and direction of the difference.
    size = xp.sqrt((differences**2).mean(axis=-1, keepdims=True) + _MIN_STEP_LENGTH**2)
    unit = differences / size
    base_features = [
        unit,
        xp.log(size + _SIGMA_ZERO),
        tried,
        xp.broadcast_to(target_row, differences.shape),
    ]
    tokens = xp.concatenate(
        [*base_features, *_compute_step_features(xp, differences, tried)], axis=-1
    )  # (3)
    h = xp.concatenate(
        [_apply_linear_layer(w, "first", target_row), _apply_linear_layer(w, "token", tokens)],
        axis=-2,
    )
    for block in range(design.blocks):
        h = h + _compute_causal_attention(xp, w, block, h)  # (4)
        h = h + _apply_linear_layer(
            w, f"outer{block}", _compute_swish(xp, _apply_linear_layer(w, f"inner{block}", h))
        )
    # The first token is that of the target alone.
    guess = _apply_linear_layer(w, "guess", h[..., :1, :])
    next_proposals = _apply_linear_layer(w, "next", h[..., 1:, :])
    if not design.published:
        # For each parameter a row of the matrix A, then its entry of c.
        gain = next_proposals.reshape(*tried.shape, unit.shape[-1] + 1)
        direction_sum = (gain[..., :-1] * unit[..., None, :]).sum(axis=-1)
        next_proposals = tried + size * (direction_sum + gain[..., -1])  # (5)
    return xp.concatenate([guess, next_proposals], axis=-2)


def _compute_step_features(xp: Any, differences: Any, proposed: Any) -> tuple[Any, Any]:
    """Compute the direction of each step, and the slope (2): change of the difference per length.

    Both are zero for the first simulation, which has no step before it.

    Args:
        xp: module numpy or torch.
        differences: (..., k, d) differences of k simulations from the target, each d projected
            numbers.
        proposed: (..., k, dim) points of the simulations.

    Returns:
        Unit vectors (..., k, dim) of the steps, and slopes (..., k, d) as arsinh, because they can
        be very large.
    """
    step = proposed[..., 1:, :] - proposed[..., :-1, :]
    length = xp.sqrt((step**2).sum(axis=-1, keepdims=True) + _MIN_STEP_LENGTH**2)
    slope = (differences[..., 1:, :] - differences[..., :-1, :]) / length  # (2)

    def prepend_zeros(like: Any, later_values: Any) -> Any:
        return xp.concatenate([xp.zeros_like(like[..., :1, :]), later_values], axis=-2)

    return prepend_zeros(proposed, step / length), prepend_zeros(differences, xp.arcsinh(slope))


def _compute_causal_attention(xp: Any, w: dict[str, Any], block: int, h: Any) -> Any:
    """Compute the attention of each token (..., k, width) to itself and to earlier tokens.

    A token asks with its query, and gets the mean of the values of the tokens, weighted by softmax
    of query . key / sqrt(width) (Eq. 1 of Vaswani et al., 2017), plus a learned bias for each lag
    (number of tokens between two).

    Args:
        xp: module numpy or torch.
        w: weight arrays as in `get_weight_shapes`.
        block: number of the block.
        h: (..., k, width) tokens, in the order of the simulations.
    """
    count, token_size = h.shape[-2:]
    projections = _apply_linear_layer(w, f"heard{block}", h)
    query = projections[..., :token_size]
    key = projections[..., token_size : 2 * token_size]
    value = projections[..., 2 * token_size :]
    lag = np.arange(count)[:, None] - np.arange(count)
    # Subtracted from the scores of later tokens, so that their attention is zero.
    future_penalty = xp.asarray(np.where(lag < 0, _CAUSAL_MASK_OFFSET, 0.0).astype(np.float32))
    score = (
        query @ key.swapaxes(-1, -2) / token_size**0.5 + w[f"lag{block}.bias"][np.maximum(lag, 0)]
    )
    score = score - future_penalty
    # The largest score is subtracted, so that the exponentials do not overflow.
    attention = xp.exp(score - xp.amax(score, -1)[..., None])
    attention = attention / attention.sum(axis=-1, keepdims=True)
    return _apply_linear_layer(w, f"mixed{block}", attention @ value)


def _apply_linear_layer(w: dict[str, Any], layer: str, x: Any) -> Any:
    return x @ w[f"{layer}.weight"] + w[f"{layer}.bias"]


def _compute_swish(xp: Any, x: Any) -> Any:
    """Compute x times its logistic function (swish), with a tanh that does not overflow.

    Args:
        xp: module with ``tanh``, numpy or torch.
        x: array or tensor of any shape.
    """
    return x * (1.0 + xp.tanh(x / 2.0)) / 2.0


_BETA_PARAMETER = 2.0
"""Parameter a of (7), which the paper does not state; 1 would be a uniform distribution."""


def draw_binary_search(simulator: TrainingSimulator, rng: np.random.Generator, count: int) -> Array:
    """Draw a target and a random binary search for it, in the training range.

    In each parameter, the next point is l + r (u - l) (7), with the nearest point l tried below the
    target, the nearest one u above it (6), and a random share r.

    Args:
        simulator: training simulator.
        rng: random generator.
        count: number of points, including the target.

    Returns:
        (count, dim) points; the first one is the target.
    """
    target, start = simulator.sample(rng, 2)
    # At first the nearest points on either side are the corners of the training range.
    lower, upper = (corner.copy() for corner in simulator.training)
    points = [target, start]
    while len(points) < count:
        last = points[-1]
        is_below = last < target
        lower = np.where(is_below, last, lower)  # (6)
        upper = np.where(is_below, upper, last)
        share = rng.beta(_BETA_PARAMETER, _BETA_PARAMETER, size=last.size)
        points.append(lower + share * (upper - lower))  # (7)
    return np.array(points[:count])


class HistoryIndices(NamedTuple):
    """Indices of the simulations of a scenario that form histories.

    Attributes:
        targets: (n,) indices of the targets.
        tried: (n, window) indices of the tried simulations, in their order.
    """

    targets: NDArray[np.intp]
    tried: NDArray[np.intp]


def make_shuffled_histories(rng: np.random.Generator, count: int, window: int) -> HistoryIndices:
    """Make one history for each simulation as target, with other simulations in random order.

    Args:
        rng: random generator.
        count: number of simulations.
        window: length of a history.
    """
    histories = np.empty((count, window), dtype=np.intp)
    for target in range(count):
        other_simulations = rng.permutation(np.delete(np.arange(count), target))
        histories[target] = other_simulations[:window]
    return HistoryIndices(np.arange(count), histories)


def make_ordered_histories(count: int, window: int) -> HistoryIndices:
    """Make histories of `window` successive simulations for the first one as target, as published.

    Args:
        count: number of simulations.
        window: length of a history.
    """
    first_indices = np.arange(1, count - window + 1)
    return HistoryIndices(
        np.zeros(len(first_indices), dtype=np.intp), first_indices[:, None] + np.arange(window)
    )


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


def train_history_transformer(
    material: TrainingHistories,
    draw_histories: Callable[[np.random.Generator], HistoryIndices],
    design: HistoryTransformerDesign,
    rng: np.random.Generator,
    watched: TrainingMonitor[TrainingHistories] | None = None,
) -> dict[str, Array]:
    """Train the weights by Adam; equal generators give bit-identical weights.

    The learning rate falls to zero along half a cosine.

    Args:
        material: training data.
        draw_histories: function that draws the histories of a batch.
        design: design of the network and of its training.
        rng: seeds the initial weights and all random draws; global random state is not changed.
        watched: held-out data and callback for the losses.

    Returns:
        Weight arrays as in `get_weight_shapes`.
    """
    import torch

    def get_gain(name: str) -> float:
        """Return the factor of the initial weights of an array; biases begin at zero."""
        gain = INITIAL_WEIGHT_LIMIT if name.endswith("weight") else 0.0
        return gain * _RESIDUAL_WEIGHT_FACTOR if name.startswith(_RESIDUAL_LAYERS) else gain

    def fit(weights: Weights, _: object) -> None:
        """Minimise the loss; the weights are changed in place, and torch's generator is unused."""
        tensors = material.to_tensors()
        monitor = None
        if watched is not None:
            parts = watched.held_out.to_tensors()

            def compute_held_out_loss() -> Any:
                # A separate random stream keeps the training independent of the evaluation.
                histories = draw_histories(np.random.default_rng(0))
                return _compute_loss(weights, design, parts, histories)

            monitor = TrainingMonitor(compute_held_out_loss, watched.epoch)
        # torch's weight_decay is the gradient of half of it times the squared norm.
        decay = 2.0 * design.weight_decay
        optimiser: Any = torch.optim.Adam(
            list(weights.values()), design.rate, weight_decay=decay, fused=True
        )
        count = len(tensors[0])
        minimise_loss(
            optimiser,
            compute_cosine_rates(design.rate, design.epochs),
            design.epochs,
            lambda: np.split(rng.permutation(count), range(design.batch, count, design.batch)),
            lambda batch: _compute_loss(
                weights, design, [part[batch] for part in tensors], draw_histories(rng)
            ),
            monitor,
        )

    shapes = get_weight_shapes(material.shown.shape[-1], material.parameters.shape[-1], design)
    return train_weights(shapes, get_gain, rng, fit)


def _compute_loss(
    w: dict[str, Any], design: HistoryTransformerDesign, parts: list[Any], histories: HistoryIndices
) -> Any:
    """Compute the mean squared error of the proposals: loss (8), or (9) if published.

    (8) compares each proposal with the target's parameters. Each squared error after a simulation
    is divided by the squared distance of that simulation from the target, plus `design.relative`^2.
    (9) compares each proposal with the next point of the history.

    Args:
        w: weights by name.
        design: design of the network.
        parts: `TrainingHistories` of one batch of scenarios as tensors: input rows of simulations
            and of targets, and parameters.
        histories: indices of the simulations that form each history, and of its target.
    """
    import torch

    # Shapes: B scenarios of m simulations, and n histories of k simulations in each scenario.
    # Tokens are (B, n, k, d), aims (B, n, d), points (B, n, k, dim), proposals (B, n, k + 1, dim).
    simulations, target, parameters = parts
    tokens = (simulations @ w["seen.weight"])[:, histories.tried]
    aim = (target @ w["seen.weight"])[:, histories.targets]
    proposed = parameters[:, histories.tried]
    truth = parameters[:, histories.targets][:, :, None]
    proposals = predict_proposals(torch, w, design, aim, tokens, proposed)
    if design.published:
        # Without the first guess, and the proposal after the last simulation.
        return ((proposals[:, :, 1:-1] - proposed[:, :, 1:]) ** 2).mean()  # (9)
    squares = ((proposals - truth) ** 2).sum(dim=-1)
    # Small distances matter in the last steps of tuning, so they must have enough weight.
    distances = ((proposed - truth) ** 2).sum(dim=-1) + design.relative**2
    first_guess_errors = squares[:, :, :1]
    relative_errors = squares[:, :, 1:] / distances * _ERROR_FACTOR
    return torch.cat([first_guess_errors, relative_errors], dim=2).mean()  # (8)
