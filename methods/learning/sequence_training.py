"""Training of the network that reads tuning histories (`methods.learning.sequence_network`).

Source: X. Zhang, S. Liu et al., IEEE RA-L 2025, arXiv 2410.20357, Algorithm 2. With e_i the
simulations of a history and t the target's parameters:

    (1)  loss = mean |first guess - t|^2 + |next after e_i - t|^2 / (|e_i - t|^2 + relative^2)
    (2)  published: loss = mean |next after e_i - e_(i + 1)|^2

Both get lambda |weights|^2.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from methods.base import Array
from methods.learning.histories import Histories
from methods.learning.pair_network import reproducible
from methods.learning.sequence_network import Design, proposals, shapes

if TYPE_CHECKING:
    import torch

_SPREAD = 1.7
"""Limit of initial weights times the root of a layer's inputs: a variance close to 1 / inputs."""
_SMALL = 0.3
"""Of that, for layers whose sum with something else is what counts: they begin as hardly anything.
"""
_SUMMED = ("mixed", "outer", "guess", "next")
_TAMED = 1.0 / 3.0
"""Times relative squared errors, beside those of the first guess."""


class Material(NamedTuple):
    """What is learned from.

    Attributes:
        shown: (scenarios, m, D) input rows of simulations.
        target: (scenarios, m, D) of the same where they are targets.
        parameters: (scenarios, m, dim), in half widths from the middle of the training range.
    """

    shown: Array
    target: Array
    parameters: Array

    def tensors(self) -> list[Any]:
        """For torch."""
        import torch

        return [torch.as_tensor(array, dtype=torch.float32) for array in self]


class Watched(NamedTuple):
    """Held-out material, and who is told of the losses: epoch from 1, number of epochs, training
    and held-out loss.
    """

    material: Material
    epoch: Callable[[int, int, float, float], None]


def train(
    material: Material,
    drawn: Callable[[np.random.Generator], Histories],
    design: Design,
    rng: np.random.Generator,
    watched: Watched | None = None,
) -> dict[str, Array]:
    """Fit the weights; the same generator gives the same weights bit for bit.

    Args:
        material: what is learned from.
        drawn: draws the histories of a batch.
        design: how the network is built and trained.
        rng: seeds the initial weights and all that is drawn; no global random state is touched.
        watched: told of the losses, without the penalty; the weights do not depend on it.

    Returns:
        Weights as in `shapes`.
    """
    import torch

    with reproducible(), torch.enable_grad():
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        named = shapes(material.shown.shape[-1], material.parameters.shape[-1], design)
        w = _initial(named, generator)
        _descend(w, material, drawn, design, rng, watched)
        return {name: v.detach().numpy().astype(np.float64) for name, v in w.items()}


def _initial(named: dict[str, tuple[int, ...]], generator: torch.Generator) -> dict[str, Any]:
    """Weights uniform in +- gain / sqrt(inputs); biases zero."""
    import torch

    w: dict[str, Any] = {}
    for name, shape in named.items():
        gain = _SPREAD if name.endswith("weight") else 0.0
        if name.startswith(_SUMMED):
            gain *= _SMALL
        limit = gain / shape[0] ** 0.5
        uniform = torch.rand(shape, generator=generator) * 2 - 1
        w[name] = (uniform * limit).requires_grad_()
    return w


def _descend(
    w: dict[str, Any],
    material: Material,
    drawn: Callable[[np.random.Generator], Histories],
    design: Design,
    rng: np.random.Generator,
    watched: Watched | None,
) -> None:
    """Change the weights, in place, by Adam."""
    import torch

    parts = material.tensors()
    apart = watched and watched.material.tensors()
    # torch's weight_decay is the gradient of half of it times the squared norm
    decay = 2.0 * design.weight_decay
    optimiser: Any = torch.optim.Adam(list(w.values()), design.rate, weight_decay=decay, fused=True)
    for epoch in range(design.epochs):
        falling = 0.5 + 0.5 * float(np.cos(np.pi * epoch / design.epochs))
        for group in optimiser.param_groups:
            group["lr"] = design.rate * falling
        order = rng.permutation(len(parts[0]))
        losses = []
        for first in range(0, len(order), design.batch):
            batch = order[first : first + design.batch]
            optimiser.zero_grad()
            error = _loss(w, design, [part[batch] for part in parts], drawn(rng))
            error.backward()
            optimiser.step()
            losses.append(error.detach())
        if watched and apart:
            # a stream of its own: what is learned is the same whether anybody looks
            chosen = drawn(np.random.default_rng(0))
            with torch.no_grad():
                held_out = float(_loss(w, design, apart, chosen))
                training = float(torch.stack(losses).mean())
            watched.epoch(epoch + 1, design.epochs, training, held_out)


def _loss(w: dict[str, Any], design: Design, parts: list[Any], chosen: Histories) -> Any:
    """(1), or (2), over scenarios and their histories."""
    import torch

    shown, target, parameters = parts
    seen = (shown @ w["seen.weight"])[:, chosen.tried]
    aim = (target @ w["seen.weight"])[:, chosen.targets]
    tried = parameters[:, chosen.tried]
    truth = parameters[:, chosen.targets][:, :, None]
    out = proposals(torch, w, design, aim, seen, tried)
    if design.published:
        return ((out[:, :, 1:-1] - tried[:, :, 1:]) ** 2).mean()  # (2)
    squares = ((out - truth) ** 2).sum(dim=-1)
    # small distances are what the last steps are made of: they must not drown
    distances = ((tried - truth) ** 2).sum(dim=-1) + design.relative**2
    parts = [squares[:, :, :1], squares[:, :, 1:] / distances * _TAMED]
    return torch.cat(parts, dim=2).mean()  # (1)
