"""One model on its way to a least-squares fit: where it stands, and how boldly it goes on.

A step that promised a decrease p of the cost F and brought it from F to F' has the gain ratio

    ρ = (F - F') / p                                                                             (1)

and the damping λ follows it by Nielsen's rule (H. B. Nielsen, Damping parameter in Marquardt's
method, IMM-REP-1999-05), here quicker in both directions: his least factor is 1/3, his growth ν λ.

    λ ← λ max(0.1, 1 - (2ρ - 1)³),   ν ← 2        where F' < F, and the step is taken            (2)
    λ ← 2ν λ,                        ν ← 2ν       where it is not                                (3)

Derivatives that cost much may serve for several steps (the chord method; C. T. Kelley, Iterative
Methods for Linear and Nonlinear Equations, 1995, section 5.4.1): as long as steps keep their
promises, so that ρ is near 1.
"""

from __future__ import annotations

from dataclasses import dataclass

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
KEPT = 0.2
"""Derivatives serve for another step while ρ is no farther from 1."""


@dataclass(frozen=True)
class Start:
    """Where a fit begins: the effects that act, parameters (P,), initial states (R, s)."""

    effects: tuple[str, ...]
    theta: Array
    states: Array


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
    """

    effects: tuple[str, ...]
    theta: Array
    states: Array
    free: Indices
    simulated: Array
    jacobian: Array
    cost: float

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
        here: whether the point's derivatives are its own, and not those of an earlier one.
        stale: whether they have to be taken anew before it goes on.
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
        )

    def inward(self, theta: Array) -> Array:
        """(q + s,) the steps from parameters (P,), with their signs: inward at an upper bound."""
        steps = self.steps.copy()
        own = steps[: self.free.size]
        own[theta[self.free] + own > self.high] *= -1.0
        return steps

    def taken(self, gained: float, cost: float) -> None:
        """After a step that brought the cost down to this."""
        self.stale = not self.here and abs(gained / max(self.promised, 1e-300) - 1.0) > KEPT
        ratio = gained / max(self.promised, 1e-300)  # (1)
        factor = max(LEAST_FACTOR, 1.0 - (2.0 * ratio - 1.0) ** 3)
        self.damping = max(self.damping * factor, LEAST_DAMPING)  # (2)
        self.growth = GROWTH
        self.done = gained < ENOUGH + SHARE * cost  # converged

    def refused(self) -> None:
        """After a step that did not, (3), unless its derivatives were to blame."""
        if not self.here:
            self.stale = True
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
