"""A causal transformer that reads a tuning history and says what to try next.

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

so that next = e where a simulation shows what the target shows, and what is left over shrinks with
the difference. Published: next is linear in h always.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

_QUIET = 0.01
"""s0 in (3): differences far below those of training all look alike."""
_STILL = 1e-9
"""Keeps quotients of nothing and nothing finite."""
_FAR = 1e9
"""Taken off what tokens that come later would be heard with."""


@dataclass(frozen=True)
class Design:
    """How a network is built and trained.

    Attributes:
        window: simulations of a history that it looks back at.
        seen: size of d in (1).
        width: of a token's embedding and of the layers of a block.
        blocks: blocks of attention and layers.
        published: learn the next point of a randomised binary search, as a linear function of h;
            else learn the target's parameters, by (5).
        relative: weigh each squared error by 1 / (|e - truth|^2 + relative^2), half widths.
        rate: learning rate at the beginning; it falls along a cosine.
        weight_decay: times the squared norm of the weights, added to the loss.
        epochs: passes over the scenarios.
        batch: scenarios in a batch.
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


def shapes(inputs: int, dim: int, design: Design) -> dict[str, tuple[int, ...]]:
    """Shape of every weight array by name; `inputs` numbers in a row, `dim` parameters."""
    d, width = design.seen, design.width
    layers = {"first": (d, width), "token": (3 * d + 1 + 2 * dim, width)}
    for block in range(design.blocks):
        layers[f"heard{block}"] = width, 3 * width
        for part in ("mixed", "inner", "outer"):
            layers[f"{part}{block}"] = width, width
    layers["guess"] = width, dim
    layers["next"] = width, dim if design.published else dim * (d + 1)
    # a bias would fall out of every difference
    named: dict[str, tuple[int, ...]] = {"seen.weight": (inputs, d)}
    for layer, (fan_in, fan_out) in layers.items():
        named[f"{layer}.weight"] = fan_in, fan_out
        named[f"{layer}.bias"] = (fan_out,)
    for block in range(design.blocks):
        named[f"lag{block}.bias"] = (design.window + 1,)
    return named


def proposals(
    xp: Any, w: dict[str, Any], design: Design, target: Any, shown: Any, tried: Any
) -> Any:
    """What is proposed before and after each simulation of a history.

    Written once for numpy and torch, which call what it needs by the same names.

    Args:
        xp: numpy or torch.
        w: arrays as in `shapes`.
        design: how the network is built.
        target: (..., d) the target's row through W.
        shown: (..., k, d) rows of the simulations through W; k is at most the window.
        tried: (..., k, dim) their parameters, in half widths from the middle.

    Returns:
        (..., k + 1, dim), in the same unit.
    """
    here = target[..., None, :]
    far = shown - here
    size = xp.sqrt((far**2).mean(axis=-1, keepdims=True) + _STILL**2)
    unit = far / size  # (1)
    known = [unit, xp.log(size + _QUIET), tried, xp.broadcast_to(here, far.shape)]
    tokens = xp.concatenate([*known, *_stepped(xp, far, tried)], axis=-1)  # (3)
    h = xp.concatenate([_linear(w, "first", here), _linear(w, "token", tokens)], axis=-2)
    for block in range(design.blocks):
        h = h + _attended(xp, w, block, h)  # (4)
        h = h + _linear(w, f"outer{block}", _unit(xp, _linear(w, f"inner{block}", h)))
    guess = _linear(w, "guess", h[..., :1, :])
    following = _linear(w, "next", h[..., 1:, :])
    if not design.published:
        gain = following.reshape(*tried.shape, unit.shape[-1] + 1)
        along = (gain[..., :-1] * unit[..., None, :]).sum(axis=-1)
        following = tried + size * (along + gain[..., -1])  # (5)
    return xp.concatenate([guess, following], axis=-2)


def _stepped(xp: Any, far: Any, tried: Any) -> tuple[Any, Any]:
    """The direction of each step and (2); zeros for the first simulation."""
    step = tried[..., 1:, :] - tried[..., :-1, :]
    length = xp.sqrt((step**2).sum(axis=-1, keepdims=True) + _STILL**2)
    slope = (far[..., 1:, :] - far[..., :-1, :]) / length  # (2)

    def begun(like: Any, rest: Any) -> Any:
        return xp.concatenate([xp.zeros_like(like[..., :1, :]), rest], axis=-2)

    return begun(tried, step / length), begun(far, xp.arcsinh(slope))


def _attended(xp: Any, w: dict[str, Any], block: int, h: Any) -> Any:
    """Attention of each token (..., k, width) to those before it and to itself."""
    count, width = h.shape[-2:]
    heard = _linear(w, f"heard{block}", h)
    query, key = heard[..., :width], heard[..., width : 2 * width]
    lag = np.arange(count)[:, None] - np.arange(count)
    later = xp.asarray(np.where(lag < 0, _FAR, 0.0).astype(np.float32))
    score = query @ key.swapaxes(-1, -2) / width**0.5 + w[f"lag{block}.bias"][np.maximum(lag, 0)]
    score = score - later
    # the largest taken off: exponentials must not overflow
    share = xp.exp(score - xp.amax(score, -1)[..., None])
    share = share / share.sum(axis=-1, keepdims=True)
    return _linear(w, f"mixed{block}", share @ heard[..., 2 * width :])


def _linear(w: dict[str, Any], layer: str, x: Any) -> Any:
    return x @ w[f"{layer}.weight"] + w[f"{layer}.bias"]


def _unit(xp: Any, x: Any) -> Any:
    """The logistic unit: x times its logistic function, as a tanh, which does not overflow."""
    return x * (1.0 + xp.tanh(x / 2.0)) / 2.0
