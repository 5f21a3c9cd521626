"""How large a hidden effect has to be: the gap that it leaves once base parameters and initial
states are refitted.

Only here is the batch engine used, to choose sizes; the exam's data never come from it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from bench.diagnosis.worlds.settings import Setting
from bench.diagnosis.worlds.world import SIMULATORS, Effects
from sims.base import Array

ACCURATE = 0.03  # of the wanted size
LEAP = 8.0  # strength grows by no more at once, so that the fit can follow
NUDGE = 1e-5  # of a fitted number's scale, for its derivative
ENDLESS = 1e30  # of the noise: the motion explodes


@dataclass(frozen=True)
class Fit:
    """What is left of observations at the best fit.

    Attributes:
        left: root mean square over all samples and channels, in units of the noise.
        theta: base parameters, then coefficients.
        starts: initial states (R, S), as `Fitter` was given them at first.
    """

    left: float
    theta: Array
    starts: Array


class Fitter:
    """Least squares over base parameters, coefficients of `effects`, and the initial state of every
    run.
    """

    def __init__(self, setting: Setting, effects: Sequence[str] = ()) -> None:
        kind = SIMULATORS[setting.system]
        self.simulator = kind(setting.constants, setting.channels, engine="batch", effects=effects)
        self.scenarios, self.sigma, self.states = (
            list(setting.scenarios),
            setting.sigma,
            list(kind.states),
        )
        base = [setting.parameters[p.name] for p in kind.system.parameters]
        self.theta = np.array([*base, *(p.nominal for p in self.simulator.parameters[len(base) :])])
        self.starts = np.array(
            [[s.initial[name] for name in self.states] for s in setting.scenarios]
        )
        low, high = np.array([p.bounds for p in self.simulator.parameters]).T
        self.low, self.high = (
            low,
            np.where(np.arange(low.size) < len(base), high, low + 2 * (high - low)),
        )
        self.scales = np.where(np.arange(low.size) < len(base), self.theta, 0.1 * (high - low))

    def __call__(
        self,
        observed: Array,
        theta: Array | Sequence[float] | None = None,
        starts: Array | None = None,
        rounds: int = 12,
    ) -> Fit:
        """Fit observations (R, T, C), from `theta` and `starts` (default: the setting's)."""
        theta = self.theta if theta is None else np.asarray(theta, dtype=float)
        starts, damping = self.starts if starts is None else starts, 1e-6
        rest, slope = self.look(observed, theta, starts)
        if not np.isfinite(rest).all():
            return Fit(np.inf, theta, starts)
        for _ in range(rounds):
            step = self.step(rest, slope, damping)
            count = theta.size
            new = np.clip(theta + step[:count] * self.scales, self.low, self.high)
            begun = starts + step[count:].reshape(starts.shape)
            tried, steeper = self.look(observed, new, begun)
            if not tried @ tried < rest @ rest:  # NaN is no improvement
                damping *= 30.0
                if damping > 1e3:
                    break
                continue
            gained = 1.0 - np.sqrt((tried @ tried) / (rest @ rest))
            theta, starts, rest, slope, damping = new, begun, tried, steeper, damping / 10.0
            if gained < 1e-3:
                break
        return Fit(float(np.sqrt(np.mean(rest**2))), theta, starts)

    @staticmethod
    def step(rest: Array, slope: Array, damping: float) -> Array:
        """The damped step (P,) of least squares, each number in its scale."""
        gram = slope.T @ slope
        diagonal = np.diag(gram)
        gram = gram + np.diag(damping * diagonal + 1e-9 * diagonal.max())
        return np.asarray(np.linalg.solve(gram, slope.T @ rest), dtype=np.float64)

    def look(self, observed: Array, theta: Array, starts: Array) -> tuple[Array, Array]:
        """What is left (N,), and how the simulation changes (N, P) with each fitted number in its
        scale.
        """
        runs, states, count = len(starts), len(self.states), theta.size
        moved = 1 + count + states
        thetas, begun = np.tile(theta, (runs, moved, 1)), np.tile(starts[:, None], (1, moved, 1))
        for i in range(count):
            thetas[:, 1 + i, i] += NUDGE * self.scales[i]
        for i in range(states):
            begun[:, 1 + count + i, i] += NUDGE
        initial = {name: begun[:, :, i].ravel() for i, name in enumerate(self.states)}
        scenarios = [s for s in self.scenarios for _ in range(moved)]
        seen = (
            self.simulator.simulate_lanes(thetas.reshape(runs * moved, count), scenarios, initial)
            / self.sigma
        )
        seen = seen.reshape(runs, moved, -1)
        rest = (observed / self.sigma).reshape(runs, -1) - seen[:, 0]
        slopes = (seen[:, 1:] - seen[:, :1]) / NUDGE
        slope = np.zeros((*rest.shape, count + runs * states))
        for r in range(runs):
            slope[r, :, :count] = slopes[r, :count].T
            slope[r, :, count + r * states : count + (r + 1) * states] = slopes[r, count:].T
        good = (np.abs(seen) < ENDLESS).all()
        return rest.ravel() if good else np.full(rest.size, np.inf), slope.reshape(rest.size, -1)


def observed_by_batch(setting: Setting, effects: Effects) -> Array:
    """Noiseless observations (R, T, C) with these effects."""
    kind = SIMULATORS[setting.system]
    fixed = {name: list(c) for name, c in effects.items()}
    simulator = kind(setting.constants, setting.channels, engine="batch", fixed=fixed)
    theta = np.array(
        [[setting.parameters[p.name] for p in kind.system.parameters]] * len(setting.scenarios)
    )
    return simulator.simulate_lanes(theta, setting.scenarios)


def gap(setting: Setting, observed: Callable[[float], Array]) -> Callable[[float], float]:
    """The gap by strength: what base parameters and initial states leave of `observed(strength)`,
    (R, T, C).
    """
    fit = Fitter(setting)
    last: list[tuple[float, Fit]] = []

    def left(strength: float) -> float:
        theta, starts = fit.theta, fit.starts
        if last:  # they move about in proportion
            before, found = last[-1]
            share = strength / before
            theta = np.clip(theta + share * (found.theta - theta), fit.low, fit.high)
            starts = starts + share * (found.starts - starts)
        found = fit(observed(strength), theta, starts)
        if np.isfinite(found.left):
            last.append((strength, found))
        return found.left

    return left


def sized(
    left: Callable[[float], float], wanted: float, largest: float, first: float = 1e-3
) -> float | None:
    """The strength at which `left(strength)`, which grows from zero, is `wanted`; None if it is not
    below `largest`.

    Secants on logarithmic scales, within a bracket once there is one.
    """
    low, high, strength = (0.0, 0.0), (np.inf, np.inf), first
    for _ in range(12):
        now = left(strength)
        if abs(now / wanted - 1) < ACCURATE:
            return strength
        if now < wanted:
            if strength >= largest or now * (largest / strength) ** 2 < wanted:
                return None
            low = strength, now
        else:  # NaN and infinity too
            high = strength, now
        strength = float(min(_between(low, high, wanted), largest))
    return None


def _between(low: tuple[float, float], high: tuple[float, float], wanted: float) -> float:
    """The next strength to try, given (strength, left) on either side of what is wanted."""
    if not low[0]:
        return (
            high[0] * min(max(wanted / high[1], 1e-2), 0.9) if np.isfinite(high[1]) else high[0] / 5
        )
    if not np.isfinite(high[0]):
        return low[0] * min(wanted / max(low[1], 1e-9), LEAP)
    if not np.isfinite(high[1]) or high[0] / low[0] > LEAP**2:
        return float(np.sqrt(low[0] * high[0]))
    share = float(np.log(wanted / low[1]) / np.log(high[1] / low[1]))
    part = min(max(share, 0.05), 0.95)
    return float(low[0] * (high[0] / low[0]) ** part)
