"""Measures what an extension gains: on held-out runs against the noise floor, and how well its
numbers are known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from bench.gap.causes.search import Search
from bench.gap.model.fit import RESPONSE, Fit, Fitter, Start, prior_of
from bench.gap.model.models import Model, freedom
from bench.gap.model.noise import Noise, likelihood, whitened
from bench.gap.model.world import Mask, World
from sims.base import Array

Z95 = 1.959964
RESAMPLES = 2000
STAGES = ((0.2, 6), (0.45, 6), (0.7, 6), (1.0, 10))
"""Shares of a run over which its initial state is fitted one after another, and steps of each."""
TWICE = 2.0
"""Models this much farther from held-out runs than the nearest one, as a sum of squares, are fitted
there once more.
"""


@dataclass(frozen=True)
class Measured:
    """Runs simulated with parameters that others gave: (R, T, C), and their merit, which counts
    initial states.
    """

    simulated: Array
    merit: float


class HeldOut:
    """Runs on which nothing is fitted but their initial states.

    Args:
        world: the runs, with the effects of the fitted model in the same places.
        noise: weighs the channels.
    """

    def __init__(self, world: World, noise: Noise) -> None:
        self.world, self.noise = world, noise
        self.seen: Mask = np.isfinite(world.observed)

    def measure(self, thetas: Sequence[Array]) -> list[Measured]:
        """Simulate with each parameter vector (P,), initial states estimated run by run.

        Least squares may end in another minimum for one model than for its neighbour, and luck
        would then decide between them: every model is fitted again from the states of the nearest
        one, and the better fit counts.
        """
        fits = self._fitted([Start((), theta, self.world.guess) for theta in thetas], STAGES)
        nearest = min(fits, key=lambda fit: fit.cost)
        apart = [i for i, fit in enumerate(fits) if not fit.cost < TWICE * nearest.cost]
        again = self._fitted(
            [replace(fits[i].start(), states=nearest.states) for i in apart], STAGES[1:]
        )
        for i, fit in zip(apart, again, strict=True):
            fits[i] = min(fits[i], fit, key=lambda fit: fit.cost)
        return [self._measured(fit) for fit in fits]

    def _fitted(self, starts: Sequence[Start], stages: Sequence[tuple[float, int]]) -> list[Fit]:
        """Initial states fitted over longer and longer parts of the runs."""
        fits: list[Fit] = []
        for share, iterations in stages if starts else ():
            fits = Fitter(self.world, self.noise, share=share, parameters=False).fit(
                starts, iterations
            )
            starts = [fit.start() for fit in fits]
        return fits

    def _measured(self, fit: Fit) -> Measured:
        if not np.isfinite(fit.cost):
            return Measured(np.full_like(self.world.observed, np.nan), -np.inf)
        residual = np.where(self.seen, self.world.observed - fit.simulated, 0.0)
        free = freedom(self.world, fit, self.noise)
        value = likelihood(residual, self.seen, free).value - free * float(
            np.log(max(int(self.seen.sum()), 2))
        )
        return Measured(fit.simulated, value)


def central(world: World, fit: Fit, noise: Noise) -> Fit:
    """The fit with its Jacobian by central differences.

    One-sided ones are good enough to descend by, but their curvature makes parameters look
    different that are not.
    """
    q, runs, size = fit.free.size, *fit.states.shape
    bounds = np.array([world.parameters[i].bounds for i in fit.free]).reshape(-1, 2)
    bounds = np.stack(
        [
            np.minimum(bounds[:, 0], fit.theta[fit.free]),
            np.maximum(bounds[:, 1], fit.theta[fit.free]),
        ],
        1,
    )
    moved = np.sqrt(np.mean(np.square(fit.jacobian / noise.sigma[:, None]), axis=(0, 1, 2)))
    largest = np.concatenate([1e-2 * (bounds[:, 1] - bounds[:, 0]), np.full(size, 1e-2)])
    steps = np.clip(RESPONSE / np.maximum(moved, 1e-300), 1e-5 * largest, largest)
    theta, states = np.tile(fit.theta, (2, q + size, 1)), np.tile(fit.states, (2, q + size, 1, 1))
    for side, sign in enumerate((-1.0, 1.0)):
        for j, place in enumerate(fit.free):
            theta[side, j, place] = np.clip(theta[side, j, place] + sign * steps[j], *bounds[j])
        for j in range(size):
            states[side, q + j, :, j] += sign * steps[q + j]
    rows = np.repeat(theta.reshape(-1, theta.shape[2]), runs, axis=0)
    lanes = np.tile(np.arange(runs), 2 * (q + size))
    seen = world.simulate(rows, lanes, states.reshape(-1, size)).reshape(
        2, q + size, *fit.simulated.shape
    )
    apart = np.concatenate(
        [np.diagonal(theta[1][:q][:, fit.free] - theta[0][:q][:, fit.free]), 2.0 * steps[q:]]
    )
    jacobian = np.moveaxis(seen[1] - seen[0], 0, -1) / apart
    return replace(fit, jacobian=np.nan_to_num(jacobian, nan=0.0, posinf=0.0, neginf=0.0))


def covariance(search: Search, model: Model) -> Array:
    """(q, q) of the fitted parameters, from the curvature, with the noise's own correlation.

    Generalised least squares (W. H. Greene, Econometric Analysis, chapter 9): initial states are
    eliminated run by run.
    """
    world, fit, q = (
        search.world,
        central(search.world, model.fit, search.noise),
        model.fit.free.size,
    )
    noise = Noise(np.maximum(model.likelihood.sigma, 1e-300), model.likelihood.phi)
    jacobian = whitened(np.where(search.seen[..., None], fit.jacobian, 0.0), search.seen, noise)
    j = jacobian.reshape(len(jacobian), -1, jacobian.shape[3])
    normal = np.matmul(j.transpose(0, 2, 1), j)
    inner = normal[:, q:, q:] + np.diag(1.0 / prior_of(world) ** 2)
    cross = np.where(world.known[:, None, :], 0.0, normal[:, :q, q:])
    schur = normal[:, :q, :q].sum(axis=0) - np.matmul(
        cross, np.linalg.solve(inner, cross.transpose(0, 2, 1))
    ).sum(0)
    scale = np.sqrt(np.maximum(np.diagonal(normal[:, :q, :q].sum(axis=0)), 1e-300))
    inverse = np.linalg.pinv(schur / np.outer(scale, scale), rcond=1e-13, hermitian=True)
    values, vectors = np.linalg.eigh(schur / np.outer(scale, scale))
    lost = values < 1e-12
    if lost.any():  # a direction that the data do not fix at all has no pseudo-inverse that says so
        inverse = inverse + (vectors[:, lost] * 1e12) @ vectors[:, lost].T
    result: Array = inverse / np.outer(scale, scale)
    return result


def intervals(search: Search, model: Model) -> dict[int, tuple[float, float, float]]:
    """Value, low and high (95 %) of each fitted parameter by its place; NaN where the data do not
    bound it.
    """
    spread = np.sqrt(np.maximum(np.diagonal(covariance(search, model)), 0.0))
    result = {}
    for place, sd in zip(model.fit.free.tolist(), spread.tolist(), strict=True):
        value = float(model.fit.theta[place])
        low, high = search.world.parameters[place].bounds
        known = np.isfinite(sd) and 2.0 * Z95 * sd < 4.0 * max(high - low, abs(value))
        result[place] = (
            (value, value - Z95 * sd, value + Z95 * sd) if known else (value, np.nan, np.nan)
        )
    return result


@dataclass(frozen=True)
class Gain:
    """Held-out error in the unit of the channels counted, and the share of the gap closed with its
    95 % interval.
    """

    base: float
    extended: float
    floor: float
    closed: float
    low: float
    high: float


def gain(
    world: World,
    before: Array,
    after: Array,
    channels: Sequence[int],
    floor: float,
    rng: np.random.Generator,
) -> Gain:
    """Share of the gap closed, (before - after) / (before - floor) in RMSE, with a bootstrap
    interval over runs.

    With a single run the resampling is over stretches of it (circular blocks; D. N. Politis, J. P.
    Romano 1992).

    Args:
        world: the runs.
        before: (R, T, C) simulated by the base model.
        after: (R, T, C) simulated by the extended one.
        channels: those that count; they share a unit.
        floor: RMS of the noise over them.
        rng: of the resampling.
    """
    pieces = _pieces(world, before, after, channels)
    whole = pieces.sum(axis=0)
    rows = rng.integers(len(pieces), size=(RESAMPLES, len(pieces)))
    shares = _closed(pieces[rows].sum(axis=1), floor)
    low, high = (
        (float(v) for v in np.quantile(shares, [0.025, 0.975]))
        if len(pieces) > 1
        else (np.nan, np.nan)
    )
    base, extended = float(np.sqrt(whole[0] / whole[2])), float(np.sqrt(whole[1] / whole[2]))
    return Gain(base, extended, floor, float(_closed(whole[None], floor)[0]), low, high)


def _pieces(world: World, before: Array, after: Array, channels: Sequence[int]) -> Array:
    """(n, 3): sums of squares before and after, and samples, of each run, or of ten stretches of a
    single one.
    """
    parts: list[tuple[int, slice]] = [(r, slice(None)) for r in range(len(world.tracks))]
    if len(parts) == 1:
        edges = np.linspace(0, world.lengths[0], 11).astype(int)
        parts = [(0, slice(int(a), int(b))) for a, b in pairwise(edges) if b > a]
    rows = []
    for run, part in parts:
        seen = np.isfinite(world.observed[run, part][:, channels])
        if seen.any():
            errors = [(world.observed - s)[run, part][:, channels][seen] for s in (before, after)]
            rows.append([*(float(e @ e) for e in errors), float(seen.sum())])
    return np.array(rows)


def _closed(sums: Array, floor: float) -> Array:
    """Shares of the gap closed of rows (n, 3); 0 where there is no gap above the floor."""
    base, extended = np.sqrt(sums[:, 0] / sums[:, 2]), np.sqrt(sums[:, 1] / sums[:, 2])
    gap = base - floor
    with np.errstate(all="ignore"):
        share: Array = np.where(gap > 1e-3 * floor, (base - np.maximum(extended, floor)) / gap, 0.0)
    return np.clip(share, -9.0, 1.0)
