"""Least squares on trajectories: parameters that all runs share, initial states that each run has
for itself.

Levenberg-Marquardt for many models at once, so that one call of the engine serves all of them.
Initial states are eliminated run by run (damping by Nielsen's rule, IMM-REP-1999-05; the Schur
complement of the arrow-shaped normal equations; B. Triggs et al., Bundle adjustment, 2000,
doi:10.1007/3-540-44480-7_21, section 6), so the cost grows linearly with the number of runs. Noise
that remembers is whitened first (`colour`), which makes the fit one of generalised least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bench.gap.model.bounds import coefficient_bounds
from bench.gap.model.noise import Noise, whitened
from bench.gap.model.world import Indices, Mask, World
from sims.base import Array

RESPONSE = 0.1
"""Finite differences move a parameter until the observation changes by this share of its noise,
RMS.
"""
UNMEASURED, MEASURED = 3.0, 100.0
"""1 sigma of what is known beforehand of an initial state, SI units: without, and with samples that
show it.
"""
BEATEN, RACED, HOPE = 100.0, 4, 10.0
"""After so many steps a model is given up whose sum of squares, less several times what the next
step promises, is so much above the best one's."""
ENOUGH, SHARE = 0.02, 1e-4
"""A fit has converged when a step lowers the sum of squares, in units of the noise, by less than
this and less than this share of it."""


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


@dataclass
class _Problem:
    """One model on its way."""

    start: Start
    free: Indices
    low: Array
    high: Array
    widths: Array
    steps: Array
    theta: Array
    states: Array
    simulated: Array = field(default_factory=lambda: np.empty(0))
    jacobian: Array = field(default_factory=lambda: np.empty(0))
    cost: float = np.inf
    damping: float = 1e-3
    growth: float = 2.0
    promised: float = np.inf
    done: bool = False

    def fit(self) -> Fit:
        return Fit(
            self.start.effects,
            self.theta,
            self.states,
            self.free,
            self.simulated,
            self.jacobian,
            self.cost,
        )


@dataclass(frozen=True)
class Fitter:
    """Fits models to the runs of a world.

    Attributes:
        world: the runs.
        noise: of each channel.
        frozen: parameters that are not fitted, as the data do not show them.
        share: only this first share of each run counts.
        parameters: False to fit initial states alone.
    """

    world: World
    noise: Noise
    frozen: frozenset[int] = frozenset()
    share: float = 1.0
    parameters: bool = True

    def fit(
        self,
        starts: Sequence[Start],
        iterations: int = 12,
        race: bool = False,
        reached: float = np.inf,
    ) -> list[Fit]:
        """Fit each model from its start; in a race, those far behind the best, or the cost reached,
        stay unfinished.
        """
        problems = [self._problem(start) for start in starts]
        seen = self.world.counted(self.share)
        for problem, (simulated, jacobian) in zip(
            problems, self._derivatives(problems), strict=True
        ):
            self._take(problem, problem.theta, problem.states, simulated, jacobian, seen)
        for taken in range(iterations):
            best = min(reached, *(p.cost for p in problems))
            for p in problems if race and taken >= RACED else ():
                p.done |= p.cost - HOPE * p.promised > best + BEATEN
            active = [p for p in problems if not p.done]
            trials = [(p, *self._step(p, seen)) for p in active]
            trials = [(p, t, s) for p, t, s in trials if not p.done]
            if not trials:
                break
            moved = [replace_at(p, theta, states) for p, theta, states in trials]
            for (p, theta, states), (simulated, jacobian) in zip(
                trials, self._derivatives(moved), strict=True
            ):
                self._judge(p, theta, states, simulated, jacobian, seen)
        return [p.fit() for p in problems]

    def _problem(self, start: Start) -> _Problem:
        world = self.world
        free = [int(i) for i in world.base if int(i) not in self.frozen] if self.parameters else []
        bounds = [world.parameters[i].bounds for i in free]
        if self.parameters:
            for name in start.effects:
                free += range(*world.slots[name].indices(len(world.parameters)))
                bounds += coefficient_bounds(world, name)
        low, high = np.array(bounds, dtype=np.float64).reshape(-1, 2).T
        ranges = [world.parameters[i].bounds for i in free]
        widths = np.array([b - a for a, b in ranges], dtype=np.float64)
        theta = start.theta.copy()
        theta[free] = np.clip(theta[free], low, high)
        steps = np.concatenate([1e-4 * widths, np.full(len(world.states), 1e-5)])
        return _Problem(
            start,
            np.array(free, dtype=np.intp),
            low,
            high,
            widths,
            steps,
            theta,
            start.states.copy(),
        )

    def _derivatives(self, problems: Sequence[_Problem]) -> list[tuple[Array, Array]]:
        """Simulated runs (R, T, C) of each problem and their derivatives (R, T, C, q + s), in one
        call.
        """
        runs, states = self.world.guess.shape
        blocks = []
        for p in problems:
            count = 1 + p.free.size + states
            theta = np.tile(p.theta, (count, 1))
            begin = np.tile(p.states, (count, 1, 1))
            steps = self._steps(p)
            for j, place in enumerate(p.free):
                theta[1 + j, place] += steps[j]
            for j in range(states):
                begin[1 + p.free.size + j, :, j] += steps[p.free.size + j]
            blocks.append((theta, begin, steps))
        thetas = np.concatenate([np.repeat(theta, runs, axis=0) for theta, _, _ in blocks])
        begins = np.concatenate([begin.reshape(-1, states) for _, begin, _ in blocks])
        lanes = np.tile(np.arange(runs), len(thetas) // runs)
        seen = self.world.simulate(thetas, lanes, begins, self.share)
        result, place = [], 0
        for theta, _, steps in blocks:
            part = seen[place : place + len(theta) * runs].reshape(
                len(theta), runs, *seen.shape[1:]
            )
            place += len(theta) * runs
            with np.errstate(all="ignore"):
                jacobian = np.moveaxis(part[1:] - part[0], 0, -1) / steps
            result.append((part[0], np.nan_to_num(jacobian, nan=0.0, posinf=0.0, neginf=0.0)))
        return result

    def _steps(self, p: _Problem) -> Array:
        """Signed steps of the finite differences: inward at an upper bound."""
        steps = p.steps.copy()
        beyond = p.theta[p.free] + steps[: p.free.size] > p.high
        steps[: p.free.size][beyond] *= -1.0
        return steps

    def _take(
        self,
        p: _Problem,
        theta: Array,
        states: Array,
        simulated: Array,
        jacobian: Array,
        seen: Mask,
    ) -> None:
        p.theta, p.states, p.simulated, p.jacobian = theta, states, simulated, jacobian
        p.cost = self._cost(simulated, states, seen)
        sizes = np.sqrt(np.mean(np.square(jacobian / self.noise.sigma[:, None]), axis=(0, 1, 2)))
        largest = np.concatenate([1e-2 * p.widths, np.full(states.shape[1], 1e-2)])
        with np.errstate(divide="ignore"):
            p.steps = np.clip(
                RESPONSE / np.where(sizes > 0, sizes, 1e-300), 1e-5 * largest, largest
            )

    def _cost(self, simulated: Array, states: Array, seen: Mask) -> float:
        residual = np.where(seen, self.world.observed - simulated, 0.0)
        if not np.isfinite(residual).all():
            return np.inf
        w = whitened(residual, seen, self.noise)
        drift = (states - self.world.guess) / prior_of(self.world)
        return float((w * w).sum() + (drift * drift).sum())

    def _step(self, p: _Problem, seen: Mask) -> tuple[Array, Array]:
        """The next parameters and initial states to try; marks the problem done if they promise
        nothing.
        """
        q = p.free.size
        if not np.isfinite(p.cost):
            p.done = True
            return p.theta, p.states
        residual = whitened(
            np.where(seen, self.world.observed - p.simulated, 0.0), seen, self.noise
        )
        jacobian = whitened(np.where(seen[..., None], p.jacobian, 0.0), seen, self.noise)
        prior = prior_of(self.world)
        drift, stuck = (p.states - self.world.guess) / prior, _stuck(p, residual, jacobian)
        solved = arrow_step(residual, jacobian, q, drift, prior, self.world.known, p.damping, stuck)
        theta = p.theta.copy()
        theta[p.free] = np.clip(theta[p.free] + solved.shared, p.low, p.high)
        p.promised = solved.promised
        if solved.promised < ENOUGH + SHARE * p.cost or p.damping > 1e8:
            p.done = True
        return theta, p.states + solved.own

    def _judge(
        self,
        p: _Problem,
        theta: Array,
        states: Array,
        simulated: Array,
        jacobian: Array,
        seen: Mask,
    ) -> None:
        cost = self._cost(simulated, states, seen)
        if cost < p.cost:
            gained = p.cost - cost
            ratio = gained / max(p.promised, 1e-300)
            self._take(p, theta, states, simulated, jacobian, seen)
            p.damping, p.growth = (
                max(p.damping * max(0.1, 1.0 - (2.0 * ratio - 1.0) ** 3), 1e-10),
                2.0,
            )
            p.done = gained < ENOUGH + SHARE * cost
        else:
            p.damping, p.growth = p.damping * 2.0 * p.growth, 2.0 * p.growth


def replace_at(p: _Problem, theta: Array, states: Array) -> _Problem:
    """The same problem elsewhere."""
    return replace(p, theta=theta, states=states)


def prior_of(world: World) -> Array:
    """(s,) what is known of initial states beforehand, 1 sigma."""
    system, shown = world.simulator.system, set(world.channels)
    pairs = dict(zip(system.rates, system.coordinates, strict=False))
    measured = [name in shown or pairs.get(name) in shown for name in world.states]
    return np.where(measured, MEASURED, UNMEASURED)


@dataclass(frozen=True)
class _Solved:
    shared: Array
    own: Array
    promised: float


def arrow_step(
    residual: Array,
    jacobian: Array,
    q: int,
    drift: Array,
    prior: Array,
    known: Mask,
    damping: float,
    stuck: Mask,
) -> _Solved:
    """One damped Gauss-Newton step: shared parameters (q,), initial states (R, s), promised
    decrease of the cost.
    """
    runs, size = len(residual), jacobian.shape[3]
    j = jacobian.reshape(runs, -1, size)
    r = residual.reshape(runs, -1)
    normal = np.matmul(j.transpose(0, 2, 1), j)
    right = np.matmul(j.transpose(0, 2, 1), r[:, :, None])[:, :, 0]
    own = slice(q, size)
    inner = normal[:, own, own] + np.diag(1.0 / prior**2)
    diagonal = np.einsum("rii->ri", inner).copy()
    inner = inner + damping * diagonal[:, :, None] * np.eye(size - q)
    pull = right[:, own] - drift / prior
    cross = normal[:, :q, own].copy()
    fixed = np.broadcast_to(known[:, :], diagonal.shape)
    inner = np.where(fixed[:, :, None] | fixed[:, None, :], np.eye(size - q), inner)
    pull = np.where(fixed, 0.0, pull)
    cross[np.broadcast_to(fixed[:, None, :], cross.shape)] = 0.0
    inverse_cross = np.linalg.solve(inner, cross.transpose(0, 2, 1))
    inverse_pull = np.linalg.solve(inner, pull[:, :, None])[:, :, 0]
    shared_normal = normal[:, :q, :q].sum(axis=0)
    scale = np.maximum(np.diagonal(shared_normal), 1e-12)
    damped = shared_normal + np.diag(damping * scale + 1e-9 * scale + 1e-12)
    schur = damped - np.matmul(cross, inverse_cross).sum(axis=0)
    gradient = right[:, :q].sum(axis=0) - np.einsum("rqs,rs->q", cross, inverse_pull)
    step = np.zeros(q)
    moves = ~stuck
    if moves.any():
        step[moves] = np.linalg.lstsq(schur[np.ix_(moves, moves)], gradient[moves], rcond=None)[0]
    own_step = inverse_pull - np.einsum("rsq,q->rs", inverse_cross, step)
    whole = np.concatenate([np.tile(step, (runs, 1)), own_step], axis=1)
    left = r - np.matmul(j, whole[:, :, None])[:, :, 0]
    promised = float((r * r).sum() - (left * left).sum())
    promised += float((drift**2).sum() - ((drift + own_step / prior) ** 2).sum())
    return _Solved(step, own_step, promised)


def _stuck(p: _Problem, residual: Array, jacobian: Array) -> Mask:
    """(q,) parameters at a bound that the data push against."""
    q = p.free.size
    pushed = np.einsum("rtc,rtcq->q", residual, jacobian[..., :q])
    here = p.theta[p.free]
    stuck: Mask = ((here <= p.low) & (pushed < 0)) | ((here >= p.high) & (pushed > 0))
    return stuck
