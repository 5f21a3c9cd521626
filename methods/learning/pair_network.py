"""The network of TuneNet: one branch for each of two observations, concatenated, fully connected.

Training uses torch (imported where it is needed); the forward pass used in tuning is plain numpy in
double precision. Source: arXiv 1907.11200, section III and Eq. 1; layer sizes and training from the
authors' released code.

With a and b the input rows of the proposed and the target side, u the units, [ ] concatenation:

    (1)  n(a, b) = Wo u(Wj [u(Wp a), u(Wt b)]), each W with its bias; published: tanh of it
    (2)  h(a, b) = (n(a, b) - n(b, a)) / 2, so that h(o, o) = 0; published: h = n
    (3)  loss = mean |h - difference|^2 / (|difference|^2 + relative^2) + lambda |weights|^2

Eq. 1 of the paper is (3) without the denominator: there the difference's size does not matter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from methods.base import Array

if TYPE_CHECKING:
    import torch

LAYERS = ("proposed", "target", "joined", "output")
"""The fully connected layers; each has a `.weight` (inputs, outputs) and a `.bias` (outputs,)."""

_LOG_2 = float(np.log(2.0))
"""Softplus at zero; taken off, a unit that hears nothing says nothing."""
_TAMED = 30.0
"""Divides relative squared errors; to Adam only their ratio to the weights' penalty matters."""
_SPREAD = 1.7
"""Limit of initial weights times the root of a layer's inputs: a variance close to 1 / inputs."""
_COOLING = 0.99
"""Factor on the published rate from epoch to epoch."""


@dataclass(frozen=True)
class Design:
    """How a network is built and trained; the defaults are this project's, `PUBLISHED` the
    authors'.

    Attributes:
        width: units of each branch and of the joined layer.
        smooth: softplus units (shifted through the origin) in place of rectified linear ones.
        antisymmetric: h(a, b) = (n(a, b) - n(b, a)) / 2, hence h(o, o) = 0 exactly; else h = n.
        bounded: tanh at the output.
        relative: weigh each pair's squared error by 1 / (|difference|^2 + relative^2), unit cube; 0
            weighs all alike.
        adam: Adam and a rate falling along a cosine; else SGD without momentum and a rate x 0.99 an
            epoch.
        rate: learning rate at the beginning.
        weight_decay: lambda in Eq. 1, per mean squared error.
        epochs: passes over the training data.
        batch: scenarios, all of whose pairs are used (published: one pair each, the first member
            proposed).
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


PUBLISHED = Design(
    smooth=False,
    antisymmetric=False,
    bounded=True,
    relative=0.0,
    adam=False,
    rate=0.1,
    # torch's weight_decay 1e-2 is the gradient of half of it times the squared norm
    weight_decay=0.5e-2,
    epochs=200,
    batch=50,
)


def shapes(inputs: tuple[int, int], width: int, dim: int) -> dict[str, tuple[int, ...]]:
    """Shape of every weight array by name, in the order of the network; inputs of the proposed and
    the target side.
    """
    sizes = (
        (inputs[0], width),
        (inputs[1], width),
        (2 * width, width),
        (width, dim),
    )
    named: dict[str, tuple[int, ...]] = {}
    for layer, (fan_in, fan_out) in zip(LAYERS, sizes, strict=True):
        named[f"{layer}.weight"] = fan_in, fan_out
        named[f"{layer}.bias"] = (fan_out,)
    return named


def estimate(weights: dict[str, Array], design: Design, proposed: Array, target: Array) -> Array:
    """h(proposed, target): the estimated parameter difference target - proposed.

    Args:
        weights: as in `shapes`.
        design: how the network is built.
        proposed: (n, D) input rows of the proposed simulations, or (D,).
        target: (n, E) or (E,), likewise; E is D where the network is antisymmetric.

    Returns:
        (n, dim) or (dim,), unit cube.
    """
    w = weights

    def unit(x: Array) -> Array:
        # smooth ones bend gently beyond the training range, where rectified ones have a corner
        return np.logaddexp(0.0, x) - _LOG_2 if design.smooth else np.maximum(x, 0.0)

    def branch(x: Array, layer: str) -> Array:
        return unit(x @ w[f"{layer}.weight"] + w[f"{layer}.bias"])

    def joined(a: Array, b: Array) -> Array:
        both = np.concatenate([branch(a, "proposed"), branch(b, "target")], axis=-1)
        hidden = branch(both, "joined")
        out: Array = hidden @ w["output.weight"] + w["output.bias"]  # (1)
        return np.tanh(out) if design.bounded else out

    if design.antisymmetric:
        return (joined(proposed, target) - joined(target, proposed)) / 2.0  # (2)
    return joined(proposed, target)


class Sides(NamedTuple):
    """Input rows of simulations as either side of the network reads them.

    Attributes:
        proposed: (scenarios, m, D).
        target: (scenarios, m, E); the same array where both sides read the same.
    """

    proposed: Array
    target: Array


class Watched(NamedTuple):
    """Held-out data, and who is told of the losses: epoch from 1, number of epochs, training and
    held-out loss.
    """

    rows: Sides
    parameters: Array
    epoch: Callable[[int, int, float, float], None]


def train(
    rows: Sides,
    parameters: Array,
    design: Design,
    rng: np.random.Generator,
    alone: bool = False,
    watched: Watched | None = None,
) -> dict[str, Array]:
    """Fit the weights by Eq. 1, on the CPU; the same generator gives the same weights bit for bit.

    Args:
        rows: input rows of both sides.
        parameters: (scenarios, m, dim), unit cube.
        design: how the network is built and trained.
        rng: seeds the initial weights and the order; no global random state is touched.
        alone: learn parameters from the target alone, the proposed input being zero (the direct
            regressor).
        watched: told of the losses, without the penalty on the weights; the weights do not depend
            on it.

    Returns:
        Weights as in `shapes`.
    """
    import torch

    # layers this small keep a GPU waiting: an H100 takes 1.6 to 2.7 times as long as its host
    with reproducible(), torch.enable_grad():
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        inputs = (rows.proposed.shape[-1], rows.target.shape[-1])
        weights = _initial(inputs, parameters.shape[-1], design, generator)
        _descend(
            _loss(design, weights, alone),
            list(weights.values()),
            _data(rows, parameters),
            design,
            generator,
            watched,
        )
        trained: dict[str, Array] = {}
        for name, weight in weights.items():
            trained[name] = weight.detach().cpu().numpy().astype(np.float64)
        return trained


@contextmanager
def reproducible() -> Iterator[None]:
    """Sums in a fixed order, and the machine's other cores left to other runs."""
    import torch

    threads = torch.get_num_threads()
    # a sum shared out over threads depends on how many there are
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _data(rows: Sides, parameters: Array) -> tuple[Any, Any, Any]:
    """Rows of both sides and parameters as tensors; one tensor where both sides read the same."""
    import torch

    def tensor(array: Array) -> Any:
        return torch.as_tensor(array, dtype=torch.float32)

    proposed = tensor(rows.proposed)
    same = rows.target is rows.proposed
    target = proposed if same else tensor(rows.target)
    return proposed, target, tensor(parameters)


def _initial(
    inputs: tuple[int, int], dim: int, design: Design, generator: torch.Generator
) -> dict[str, Any]:
    """Weights uniform in +- gain / sqrt(inputs); biases too (published), or zero."""
    import torch

    weights: dict[str, Any] = {}
    fan_in = 1
    for name, shape in shapes(inputs, design.width, dim).items():
        is_weight = name.endswith("weight")
        # a layer's bias follows its weights and has their number of inputs
        fan_in = shape[0] if is_weight else fan_in
        gain = 1.0
        if design.adam:
            gain = _SPREAD if is_weight else 0.0
        limit = gain / fan_in**0.5
        uniform = torch.rand(shape, generator=generator) * 2 - 1
        weights[name] = (uniform * limit).requires_grad_()
    return weights


def _loss(design: Design, w: dict[str, Any], alone: bool) -> Callable[[Any, Any, Any], Any]:
    """The data term of (3) of both sides' rows (n, m, D), (n, m, E) and parameters (n, m, dim)."""
    import torch
    from torch.nn.functional import softplus

    def unit(x: Any) -> Any:
        return softplus(x) - _LOG_2 if design.smooth else torch.relu(x)

    def branch(x: Any, layer: str) -> Any:
        return unit(x @ w[f"{layer}.weight"] + w[f"{layer}.bias"])

    def joined(a: Any, b: Any) -> Any:
        hidden = branch(torch.cat([a, b], dim=-1), "joined")
        out = hidden @ w["output.weight"] + w["output.bias"]  # (1)
        return torch.tanh(out) if design.bounded else out

    def objective(x: Any, seen: Any, y: Any) -> Any:
        b = branch(seen, "target")
        if alone:
            # a proposed input of zero leaves the branch's bias
            silent = unit(w["proposed.bias"]).expand_as(b)
            error = joined(silent, b) - y
            return (error**2).sum(dim=-1).mean()
        # antisymmetric: half of the ordered pairs will do, the other half are mirror images
        one, other = torch.triu_indices(x.shape[1], x.shape[1], offset=1)
        a = branch(x, "proposed")
        h = joined(a[:, one], b[:, other])
        if design.antisymmetric:
            h = (h - joined(a[:, other], b[:, one])) / 2.0  # (2)
        difference = y[:, other] - y[:, one]
        squares = ((h - difference) ** 2).sum(dim=-1)
        if design.relative:
            # small differences are what the last steps are made of: they must not drown
            sizes = (difference**2).sum(dim=-1) + design.relative**2
            squares = squares / sizes / _TAMED  # (3)
        return squares.mean()

    return objective


def _descend(
    loss: Callable[[Any, Any, Any], Any],
    weights: list[Any],
    data: tuple[Any, Any, Any],
    design: Design,
    generator: torch.Generator,
    watched: Watched | None,
) -> None:
    """Change the weights, in place, by gradients of (3)."""
    import torch

    x, seen, y = data
    held_out = watched and _data(watched.rows, watched.parameters)
    kind = torch.optim.Adam if design.adam else torch.optim.SGD
    optimiser: Any = kind(weights, lr=design.rate)
    for epoch in range(design.epochs):
        falling = _COOLING**epoch
        if design.adam:
            falling = 0.5 + 0.5 * np.cos(np.pi * epoch / design.epochs)
        for group in optimiser.param_groups:
            group["lr"] = design.rate * float(falling)
        order = torch.randperm(len(x), generator=generator)
        losses = []
        for first in range(0, len(x), design.batch):
            batch = order[first : first + design.batch]
            optimiser.zero_grad()
            error = loss(x[batch], seen[batch], y[batch])
            # in the loss and not torch's option, so that it is Eq. 1 for Adam too
            penalty = design.weight_decay * sum((v**2).sum() for v in weights)
            (error + penalty).backward()
            optimiser.step()
            losses.append(error.detach())
        if watched and held_out:
            with torch.no_grad():
                training_loss = float(torch.stack(losses).mean())
                held_out_loss = float(loss(*held_out))
            watched.epoch(epoch + 1, design.epochs, training_loss, held_out_loss)
