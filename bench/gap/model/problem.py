"""One model on its way to a least-squares fit: where it stands, and how boldly it goes on.

A step that promised a decrease p of the cost F and brought it from F to F' has the gain ratio

    ρ = (F - F') / p                                                                             (1)

and the damping λ follows it by Nielsen's rule (H. B. Nielsen, Damping parameter in Marquardt's
method, IMM-REP-1999-05), here quicker in both directions: his least factor is 1/3, his growth ν λ.

    λ ← λ max(0.1, 1 - (2ρ - 1)³),   ν ← 2        where F' < F, and the step is taken            (2)
    λ ← 2ν λ,                        ν ← 2ν       where it is not                                (3)

Derivatives J that cost much may serve for several steps. What a step δ changed beside what was
expected is put into them, along the step alone, with D the scales of the unknowns (C. G. Broyden,
Math. Comp. 19, 577, 1965, doi:10.1090/S0025-5718-1965-0198670-6; in this method: K. Madsen, H. B.
Nielsen, O. Tingleff, Methods for Non-Linear Least Squares Problems, 2004, section 3.3),

    J ← J + (y(x + δ) - y(x) - J δ) δᵀ D⁻² / (δᵀ D⁻² δ)                                          (4)

and they are taken anew where steps no longer keep their promises: where ρ is far from 1, or F has
grown.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from bench.gap.model.noise import Mask
from bench.gap.model.world import Indices
from sims.base import Array

ENOUGH = 0.02
"""A fit has converged when a step lowers the sum of squares, in units of the noise, by less than
this and the share below of it.
"""
SHARE = 1e-4
"""The share."""
EXACT = 0.002
"""The same of a fit whose numbers are told: so far from the lowest sum of squares, they are off by
a twentieth of what noise makes of them.
"""

# The cost of a robot's fit is rough: a joint that sticks one integration step later changes it by
# more than the fit can still gain. These constants end such fits.
COARSE_SHARE = 1e-3
"""Convergence threshold as a share of the sum of squares, where the model is far from the data."""
FAR = 2.0
"""A model is far from the data above this mean squared residual, in units of the noise."""
STAGNANT_RATIO = 0.3
"""Maximum gain ratio (1) of a step that ends a fit far from the data."""
STAGNANT_SHARE = 5e-3
"""Maximum gain of such a step, as a share of the sum of squares."""
ROUGHNESS = 3.0
"""A fit has converged where a step with derivatives of its own point promises less than this, in
units of the noise, and gains nothing.
"""
EXACT_ROUGHNESS = 1.0
"""The value of `ROUGHNESS` for fits whose parameters are reported."""

FIRST_DAMPING = 1e-3
"""Where the λ of (2) begins."""
LEAST_DAMPING = 1e-10
"""The lowest one: from zero, no factor would bring it back."""
LARGEST_DAMPING = 1e8
"""Above it no step downhill is to be found, however short."""
GROWTH = 2.0
"""Where the ν of (3) begins, and by what it grows."""
LEAST_FACTOR = 0.1
"""The least factor of (2)."""
KEPT = 0.5
"""Derivatives serve for another step while ρ is no farther from 1."""


SHARED_RENEWALS = 2
"""Number of renewals of the derivatives after which a model near the data gets derivatives by its
initial states of its own.
"""


class Known(NamedTuple):
    """Derivatives (R, T, C, q) of the runs by some of the parameters, (q,) of theta, about a point
    nearby.
    """

    free: Indices
    jacobian: Array

    def without(self, places: Collection[int]) -> Known:
        """Those by the others alone."""
        kept = [j for j, place in enumerate(self.free.tolist()) if place not in places]
        return Known(self.free[kept], self.jacobian[..., kept])

    def beside(self, places: Sequence[int], jacobian: Array) -> Known:
        """With those by further parameters (R, T, C, k)."""
        free = np.concatenate([self.free, np.array(places, dtype=np.intp)])
        return Known(free, np.concatenate([self.jacobian, jacobian], axis=3))


@dataclass(frozen=True)
class Start:
    """Where a fit begins: the effects that act, parameters (P,), initial states (R, s); and what is
    known of its derivatives already, if anything.
    """

    effects: tuple[str, ...]
    theta: Array
    states: Array
    known: Known | None = None


@dataclass(frozen=True)
class Fit:
    """A fitted model.

    Attributes:
        effects: which effects act.
        theta: (P,) parameters and coefficients.
        states: (R, s) initial states.
        free: (q,) which of theta were fitted.
        simulated: (R, T, C).
        jacobian: (R, T, C, q + s) its derivatives, initial states last.
        cost: sum of squares of the whitened residual.
        own: whether the derivatives are those of this very point.
    """

    effects: tuple[str, ...]
    theta: Array
    states: Array
    free: Indices
    simulated: Array
    jacobian: Array
    cost: float
    own: bool = True

    def known(self) -> Known:
        """Its derivatives by parameters, for what begins nearby."""
        return Known(self.free, self.jacobian[..., : self.free.size])

    def start(self) -> Start:
        """To go on from here."""
        return Start(self.effects, self.theta, self.states)


@dataclass(frozen=True)
class Point:
    """Where a model stands, and what it gives there; attributes as those of `Fit`."""

    start: Start
    simulated: Array
    jacobian: Array
    cost: float


@dataclass
class Problem:
    """One model on its way.

    Attributes:
        point: the best one so far.
        free: (q,) which of theta are fitted.
        low, high: (q,) where they may be.
        widths: (q,) the ranges of their bounds.
        steps: (q + s,) of the finite differences.
        damping: λ.
        growth: ν.
        promised: decrease of the cost that the last step promised.
        done: whether it has converged, or is given up.
        here: whether the point's derivatives are its own, and not those of another one.
        stale: whether they have to be taken anew before it goes on.
        waits: whether that can wait until it is known that it is not far behind.
        exact: whether it goes on until `EXACT`.
        rough: whether its cost is not smooth at the scale of the noise.
        samples: number of samples that count.
        renewals: number of times that derivatives were taken anew.
        by_states: (R, T, C, s) derivatives by initial states about this model; None for those that
            all models share.
    """

    point: Point
    free: Indices
    low: Array
    high: Array
    widths: Array
    steps: Array
    damping: float = FIRST_DAMPING
    growth: float = GROWTH
    promised: float = np.inf
    done: bool = False
    here: bool = True
    stale: bool = False
    waits: bool = False
    exact: bool = False
    rough: bool = False
    samples: int = 0
    renewals: int = 0
    by_states: Array | None = None

    @property
    def needs_own_states(self) -> bool:
        """Whether derivatives by initial states that all models share do not serve this one: near
        the data it has needed new ones for its parameters again and again.
        """
        slow = self.rough and self.by_states is None and self.renewals >= SHARED_RENEWALS
        return slow and not self._is_far(self.point.cost)

    def enough(self, cost: float) -> float:
        """By less than this a step need not lower the cost."""
        if self.exact:
            return EXACT
        return ENOUGH + (COARSE_SHARE if self._is_far(cost) else SHARE) * cost

    def _is_far(self, cost: float) -> bool:
        """Whether a rough fit is far from the data."""
        return self.rough and cost > FAR * self.samples

    def fit(self) -> Fit:
        """What has been fitted by now."""
        at = self.point
        return Fit(
            at.start.effects,
            at.start.theta,
            at.start.states,
            self.free,
            at.simulated,
            at.jacobian,
            at.cost,
            self.here,
        )

    def inward(self, theta: Array) -> Array:
        """(q + s,) the steps from parameters (P,), with their signs: inward at an upper bound."""
        steps = self.steps.copy()
        own = steps[: self.free.size]
        own[theta[self.free] + own > self.high] *= -1.0
        return steps

    def learnt(self, reached: Point) -> Array:
        """(R, T, C, q + s) derivatives at a point that a step has reached, by what it has shown
        beside those that it began with: (4), run by run.
        """
        at = self.point
        # What nobody simulates, behind the end of a shorter run, has not changed.
        shown = np.nan_to_num(reached.simulated - at.simulated)
        shared = (reached.start.theta - at.start.theta)[self.free]
        own = reached.start.states - at.start.states
        moved = np.concatenate([np.broadcast_to(shared, (len(own), shared.size)), own], axis=1)
        weighed = moved / np.square(self.steps)
        length = np.sum(weighed * moved, axis=1)
        # A run of which nothing was moved shows nothing.
        along = weighed / np.where(length > 0, length, np.inf)[:, None]
        missed = shown - np.einsum("rtcq,rq->rtc", at.jacobian, moved)
        learnt: Array = at.jacobian + missed[..., None] * along[:, None, None, :]  # (4)
        return learnt

    def finish(self) -> None:
        """It has converged, as far as its derivatives tell: those of another point have to be taken
        anew before it is believed.
        """
        if self.here:
            self.done = True
        else:
            self.stale = self.waits = True

    def taken(self, gained: float, cost: float, own: bool) -> None:
        """Learn from a step that brought the cost down.

        Args:
            gained: by how much.
            cost: to which.
            own: whether the derivatives were those of the very point where the step began.
        """
        ratio = gained / max(self.promised, 1e-300)  # (1)
        self.stale = not self.here and abs(ratio - 1.0) > KEPT
        factor = max(LEAST_FACTOR, 1.0 - (2.0 * ratio - 1.0) ** 3)
        self.damping = max(self.damping * factor, LEAST_DAMPING)  # (2)
        self.growth = GROWTH
        stagnant = ratio < STAGNANT_RATIO and gained < STAGNANT_SHARE * cost
        if own and not self.exact and stagnant and self._is_far(cost):
            self.done = True
        # With derivatives of its own it has converged; with others it may have.
        if gained < self.enough(cost):
            self.finish()

    def refused(self) -> None:
        """After a step that did not, (3), unless its derivatives were to blame."""
        if not self.here:
            self.stale = True
            return
        if self.rough and self.promised < (EXACT_ROUGHNESS if self.exact else ROUGHNESS):
            self.done = True
            return
        self.damping = self.damping * GROWTH * self.growth
        self.growth = GROWTH * self.growth

    def stuck(self, residual: Array, jacobian: Array) -> Mask:
        """(q,) parameters at a bound that the data push against."""
        # the gradient of the cost, downhill
        pushed = np.einsum("rtc,rtcq->q", residual, jacobian[..., : self.free.size])
        here = self.point.start.theta[self.free]
        below = (here <= self.low) & (pushed < 0)
        above = (here >= self.high) & (pushed > 0)
        stuck: Mask = below | above
        return stuck
