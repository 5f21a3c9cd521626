"""Measures what an extension gains: on held-out runs against the noise floor, and how well its
numbers are known.

The share of the gap closed, of RMS errors b before, a after and the floor n, is

    closed = (b - max(a, n)) / (b - n)                                                         (1)

The covariance of the fitted parameters is the inverse of the curvature of the sum of squares after
the initial states of every run r are eliminated (W. H. Greene, Econometric Analysis, chapter 9;
generalised least squares). With the whitened Jacobian J_r = [A_r B_r], of parameters and of initial
states, and what was known of these beforehand, sigma_0,

    covariance = (sum_r A_r' A_r - A_r' B_r (B_r' B_r + diag sigma_0^-2)^-1 B_r' A_r)^-1       (2)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from bench.gap.model.arrow import held, schur_complement
from bench.gap.model.differences import difference_steps
from bench.gap.model.fit import prior_of
from bench.gap.model.models import Model, Models
from bench.gap.model.noise import Noise, whitened
from bench.gap.model.problem import Fit
from bench.gap.model.world import World
from sims.base import Array

Z95 = 1.959964
"""Sigmas on either side that hold 95 % of a normal distribution."""
RESAMPLES = 2000
"""Bootstrap samples."""
STRETCHES = 10
"""Parts into which a run is divided for resampling, where runs are too few."""
UNBOUNDED = 4.0
"""An interval wider than so many times the bounds, or the value, says that the data do not bound
the parameter.
"""
UNTOUCHED = 1e-200
"""Curvature of a number that the data do not touch: small, and none that overflows when divided by.
"""
ALIKE = 1e-12
"""Share of its curvature that an initial state gets besides, so that none is like another."""
WORST = -9.0
"""Shares of the gap closed are cut here: how many times worse a failed model is has no meaning."""


def central(world: World, fit: Fit, noise: Noise) -> Fit:
    """The fit with its Jacobian by central differences.

    One-sided ones are good enough to descend by, but their curvature makes parameters look
    different that are not.
    """
    q = fit.free.size
    runs, size = fit.states.shape
    bounds = _bounds_around(world, fit)
    ranges = bounds[:, 1] - bounds[:, 0]
    steps = difference_steps(fit.jacobian, noise, ranges)
    # Derivatives by initial states that come from a tangent are no one-sided differences.
    if world.linear:
        steps = steps[:q]
    theta, states = _both_sides(fit, steps, bounds)

    # One call for both sides and all runs: the engine steps its lanes at once.
    vectors = theta.reshape(-1, fit.theta.size)
    rows = np.repeat(vectors, runs, axis=0)
    lanes = np.tile(np.arange(runs), len(vectors))
    simulated = world.simulate(rows, lanes, states.reshape(-1, size))
    below, above = simulated.reshape(2, steps.size, *fit.simulated.shape)

    # Row j has moved parameter j, so its widths stand on the diagonal.
    lower, upper = theta[:, :q, fit.free]
    moved = np.diagonal(upper - lower)
    widths = np.concatenate([moved, 2.0 * steps[q:]])
    jacobian = np.moveaxis(above - below, 0, -1) / widths
    # A simulation that failed on one side tells nothing of the slope.
    jacobian = np.nan_to_num(jacobian, nan=0.0, posinf=0.0, neginf=0.0)
    own = fit.jacobian[..., q:] if world.linear else jacobian[..., q:]
    return replace(fit, jacobian=np.concatenate([jacobian[..., :q], own], axis=3))


def derived(models: Models, fit: Fit) -> Fit:
    """`central` of a fit, simulated once for all who ask."""
    known = models.derived.get(id(fit))
    # A number of an object that is gone may come again: the object itself decides.
    if known is None or known[0] is not fit:
        known = models.derived[id(fit)] = fit, central(models.world, fit, models.noise)
    return known[1]


def _both_sides(fit: Fit, steps: Array, bounds: Array) -> tuple[Array, Array]:
    """Parameters (2, n, P) and initial states (2, n, R, s): on the side below and on that above,
    each row has one number moved by its step, of the first n ones.
    """
    q = fit.free.size
    theta = np.tile(fit.theta, (2, len(steps), 1))
    states = np.tile(fit.states, (2, len(steps), 1, 1))
    for side, sign in enumerate((-1.0, 1.0)):
        shifts = sign * steps
        for j, place in enumerate(fit.free):
            moved = fit.theta[place] + shifts[j]
            # At a bound the step is one-sided, so what it comes to must be what is divided by.
            theta[side, j, place] = np.clip(moved, *bounds[j])
        for j, shift in enumerate(shifts[q:]):
            states[side, q + j, :, j] += shift
    return theta, states


def _bounds_around(world: World, fit: Fit) -> Array:
    """(q, 2) bounds of the fitted parameters, widened to hold the fit: coefficients may lie beyond
    their plausible range.
    """
    values = fit.theta[fit.free]
    bounds = [world.parameters[i].bounds for i in fit.free]
    # Shaped by hand, since there may be no parameter at all.
    table = np.array(bounds).reshape(-1, 2)
    low, high = table.T
    lowest = np.minimum(low, values)
    highest = np.maximum(high, values)
    return np.stack([lowest, highest], 1)


def covariance(models: Models, model: Model) -> Array:
    """(q, q) of the fitted parameters, (2), with the noise's own correlation."""
    found = curved(models, model)
    own = found.own.sum(axis=0)
    # The theorem by which a step of the fit is solved eliminates them here, too.
    left, _ = schur_complement(own, found.cross, found.inner)
    return inverted(own, left)


def inverted(own: Array, left: Array) -> Array:
    """The inverse of the second of two (q, q) matrices, scaled by the first: the first sum of (2),
    and both together.
    """
    # Parameters of any unit on one scale, so that the cut-off below means the same for each.
    powers = np.diagonal(own)
    scale = np.sqrt(np.maximum(powers, UNTOUCHED))
    units = np.outer(scale, scale)
    scaled = left / units
    inverse = np.linalg.pinv(scaled, rcond=1e-13, hermitian=True)
    values, vectors = np.linalg.eigh(scaled)
    lost = values < 1e-12
    # A direction that the data do not fix at all has no pseudo-inverse that says so.
    if lost.any():
        free = vectors[:, lost]
        inverse = inverse + (free * 1e12) @ free.T
    result: Array = inverse / units  # (2)
    return result


class Curved(NamedTuple):
    """The pieces of (2), run by run.

    Attributes:
        noise: by which they are whitened: what the model leaves.
        jacobian: (R, n, q + s) whitened derivatives by parameters and by initial states.
        own: (R, q, q) A' A.
        cross: (R, q, s) A' B, zero where an initial state is known.
        inner: (R, s, s) B' B with what was known beforehand.
    """

    noise: Noise
    jacobian: Array
    own: Array
    cross: Array
    inner: Array


def curved(models: Models, model: Model) -> Curved:
    """The curvature of the sum of squares about a fitted model, run by run."""
    fit = derived(models, model.fit)
    # What the model leaves is the noise, whatever the recording states of it.
    sigma = np.maximum(model.likelihood.sigma, 1e-300)
    noise = Noise(sigma, model.likelihood.phi)
    return curvature(models.world, fit.jacobian, model.fit.free.size, noise)


def curvature(world: World, jacobian: Array, q: int, noise: Noise) -> Curved:
    """The same of derivatives (R, T, C, q + s) by any q numbers, initial states last."""
    seen = np.isfinite(world.observed)
    jacobian = whitened(np.where(seen[..., None], jacobian, 0.0), seen, noise)
    runs, *_, size = jacobian.shape
    j = jacobian.reshape(runs, -1, size)
    normal = np.matmul(j.transpose(0, 2, 1), j)
    precision = 1.0 / prior_of(world) ** 2
    # In an unstable motion all initial states may show alike.
    powers = np.einsum("rii->ri", normal[:, q:, q:])
    ridge = ALIKE * powers[:, :, None] * np.eye(powers.shape[1])
    # An initial state that is known is not fitted, so it takes nothing away.
    inner, cross = held(
        normal[:, q:, q:] + np.diag(precision) + ridge,
        normal[:, :q, q:],
        world.known,
    )
    return Curved(noise, j, normal[:, :q, :q], cross, inner)


def intervals(models: Models, model: Model) -> dict[int, tuple[float, float, float]]:
    """Value, low and high (95 %) of each fitted parameter by its place; NaN where the data do not
    bound it.
    """
    variances = np.diagonal(covariance(models, model))
    # Rounding may leave a variance below zero.
    spread = np.sqrt(np.maximum(variances, 0.0))
    places = model.fit.free.tolist()
    result = {}
    for place, sd in zip(places, spread.tolist(), strict=True):
        value = float(model.fit.theta[place])
        low, high = models.world.parameters[place].bounds
        # A value may lie far beyond its plausible bounds, and is then the scale itself.
        size = max(high - low, abs(value))
        known = np.isfinite(sd) and 2.0 * Z95 * sd < UNBOUNDED * size
        reach = Z95 * sd if known else np.nan
        result[place] = (
            value,
            value - reach,
            value + reach,
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
    by_stretches: bool = False,
) -> Gain:
    """Share of the gap closed (1), with a bootstrap interval over runs.

    With a single run, or if asked for, the resampling is over stretches of the runs (circular
    blocks; D. N. Politis, J. P. Romano 1992).

    Args:
        world: the runs.
        before: (R, T, C) simulated by the base model.
        after: (R, T, C) simulated by the extended one.
        channels: those that count; they share a unit.
        floor: RMS of the noise over them.
        rng: of the resampling.
        by_stretches: resample stretches of the runs, as two or three runs are too few to resample.
    """
    sums = _sums(world, before, after, channels, by_stretches)
    whole = sums.sum(axis=0)
    before_sum, after_sum, count = whole
    base = float(np.sqrt(before_sum / count))
    extended = float(np.sqrt(after_sum / count))
    # Runs are drawn whole: samples of one run depend on each other.
    parts = len(sums)
    rows = rng.integers(parts, size=(RESAMPLES, parts))
    resampled = sums[rows].sum(axis=1)
    shares = _closed(resampled, floor)
    low = high = np.nan
    # Of one stretch every resample is the same, and would look certain.
    if parts > 1:
        low, high = np.quantile(shares, [0.025, 0.975]).tolist()
    closed = float(_closed(whole[None], floor)[0])
    return Gain(base, extended, floor, closed, low, high)


def _sums(
    world: World, before: Array, after: Array, channels: Sequence[int], by_stretches: bool
) -> Array:
    """(n, 3): sums of squares before and after, and samples, of each run or stretch."""
    rows = []
    for run, part in _parts(world, by_stretches):
        observed = world.observed[run, part][:, channels]
        seen = np.isfinite(observed)
        # A part without samples would be a row of zeros, and its error a quotient of them.
        if not seen.any():
            continue
        row = []
        for simulated in (before, after):
            there = simulated[run, part][:, channels]
            error = (observed - there)[seen]
            row.append(float(error @ error))
        row.append(float(seen.sum()))
        rows.append(row)
    return np.array(rows)


def _parts(world: World, by_stretches: bool) -> list[tuple[int, slice]]:
    """What is resampled: whole runs, or stretches where runs are too few."""
    count = len(world.tracks)
    if count > 1 and not by_stretches:
        return [(run, slice(None)) for run in range(count)]
    parts = []
    for run, length in enumerate(world.lengths.tolist()):
        samples = np.linspace(0, length, STRETCHES + 1).astype(int).tolist()
        # A run of few samples has stretches without any.
        parts += [(run, slice(a, b)) for a, b in pairwise(samples) if b > a]
    return parts


def _closed(sums: Array, floor: float) -> Array:
    """Shares of the gap closed of rows (n, 3); 0 where there is no gap above the floor."""
    before, after, counts = sums.T
    base = np.sqrt(before / counts)
    extended = np.sqrt(after / counts)
    gap = base - floor
    # Below the floor there is nothing that a model could close.
    reached = np.maximum(extended, floor)
    with np.errstate(all="ignore"):
        share = (base - reached) / gap  # (1)
    # A gap of less than rounding would make any share of it, and a resample may have none.
    shares = np.where(gap > 1e-3 * floor, share, 0.0)
    return np.clip(shares, WORST, 1.0)
