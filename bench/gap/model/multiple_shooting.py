"""Fits short pieces of the runs first, each from initial states of its own, to begin long runs near
the right minimum.

Over a long run a small change of a period, a limit or a delay moves the trajectory far from the
data, so the sum of squares has many minima. Over pieces it has few, since every piece begins where
the data are (multiple shooting; H. G. Bock 1983, doi:10.1007/978-1-4684-7324-7_7). With y the
observation and h the simulated one at time t, from the state z_k that piece k has at τ_k, what is
fitted is

    min over θ, z_1 ... z_K of  Σ_k Σ_{τ_k ≤ t < τ_{k+1}} |y(t) - h(t; z_k, θ)|² / σ²            (1)

Bock demands besides that piece k ends where piece k + 1 begins. Here nothing does: what the pieces
find is where fits of the whole runs begin, which join them; it decides nothing.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from bench.gap.model.noise import Mask, Noise
from bench.gap.model.problem import Fit, Start
from bench.gap.model.world import World
from sims.base import Array
from sims.recording.recording import Run

PIECES = 4
"""Of each run so many pieces, if each has enough samples; else fewer."""
LEAST = 20
"""Samples of a piece on average, at least."""
HOLES = 2
"""A single piece may have this many times fewer, as samples may be missing."""
LAST = 0.1
"""Share of a run that is its end."""
FORGOTTEN = 0.1
"""Share of what an initial state acts on a motion at most, below which it is forgotten."""


def pieces(world: World) -> World | None:
    """The world of the pieces, with the same parameters; None where every run is too short for two.

    None for what floats, since nothing says where it is when a piece begins. None for what bounces,
    too: a piece that begins beside an impact leaves open on which side of it, and a ball that comes
    to rest is searched for a minimum among hundreds of small bounces (minutes, on the exam's
    updrafts).
    """
    if world.simulator.system.bounces or world.simulator.system.afloat:
        return None
    runs = [piece for run in world.runs for piece in _cut(run)]
    if len(runs) == len(world.runs):
        return None
    return world.over(runs)


def _cut(run: Run) -> list[Run]:
    """The pieces of a run, the run itself where it is too short."""
    # a sample counts where any of the channels has it
    values = np.stack(list(run.channels.values()))
    seen: Mask = np.any(np.isfinite(values), axis=0)
    count = int(np.clip(seen.sum() // LEAST, 1, PIECES))
    edges = np.linspace(0, run.times.size, count + 1).astype(int)
    parts = [slice(a, b) for a, b in pairwise(edges)]
    # pieces are equally long, but samples may be missing in one of them
    if any(seen[part].sum() < LEAST // HOLES for part in parts):
        return [run]
    return [run.part(part, f"{run.name}.{n}") for n, part in enumerate(parts)]


def whole(world: World, found: Fit) -> Start:
    """Where a fit of the whole runs begins, from a fit of their pieces."""
    counts = [len(_cut(run)) for run in world.runs]
    # each run goes on from where its first piece began
    first = np.cumsum([0, *counts])[:-1]
    return Start(found.effects, found.theta, found.states[first])


def forgets(world: World, noise: Noise, derivatives: Array) -> bool:
    """Whether the motion forgets how it began before its runs end: initial states act on the last
    samples by a small share of what they act on any.

    Then a fit of whole runs has no more minima than one of their pieces.

    Args:
        world: the runs.
        noise: of each channel.
        derivatives: (R, T, C, s) of a model's runs by their initial states; zero where one is
            known.
    """
    seen = np.isfinite(world.observed)[..., None]
    sizes = np.abs(np.where(seen, derivatives / noise.sigma[:, None], 0.0)).max(axis=2)
    for run, length in zip(sizes, world.lengths, strict=True):
        last = run[int((1.0 - LAST) * length) : int(length)]
        # Of a beginning that is known nothing shows how long it acts.
        if not run.any() or (last.max(axis=0) > FORGOTTEN * run.max(axis=0)).any():
            return False
    return True
