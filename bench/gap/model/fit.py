"""Least squares on trajectories: parameters that all runs share, initial states that each run has
for itself.

Levenberg-Marquardt for many models at once, so that one call of the engine serves all of them. One
step of one model is in `arrow`. Noise that remembers is whitened first (`noise`), which makes the
fit one of generalised least squares.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bench.gap.model.arrow import arrow_step
from bench.gap.model.bounds import coefficient_bounds
from bench.gap.model.differences import (
    FIRST_STATE_STEP,
    FIRST_STEP,
    difference_steps,
    displaced,
    followed,
)
from bench.gap.model.noise import Mask, Noise, whitened
from bench.gap.model.problem import LARGEST_DAMPING, Fit, Point, Problem, Start
from bench.gap.model.race import RACED, Leg, give_up, legs
from bench.gap.model.world import FEWEST_LANES, Indices, World
from sims.base import Array

UNMEASURED = 3.0
"""1 sigma of what is known beforehand of an initial state that no sample shows, SI units."""
MEASURED = 100.0
"""The same where samples show it, SI units: so wide that they decide alone."""

GROUP = 60_000
"""What a group of models costs in a step, about, in samples that are simulated."""
ALGEBRA = 8_000
"""What the equations of one model cost in the same unit."""

_Trial = tuple[Problem, Start]
"""A model, and where it may go next."""


@dataclass(frozen=True)
class Fitter:
    """Fits models to the runs of a world.

    Attributes:
        world: the runs.
        noise: of each channel.
        frozen: parameters that are not fitted, as the data do not show them.
        share: only this first share of each run counts.
        parameters: False to fit initial states alone.
        exact: whether fits go on until nothing is left to gain, as where their numbers are told.
    """

    world: World
    noise: Noise
    frozen: frozenset[int] = frozenset()
    share: float = 1.0
    parameters: bool = True
    exact: bool = False

    def fit(
        self,
        starts: Sequence[Start],
        iterations: int = 12,
        race: bool = False,
        reached: float = np.inf,
        finished: Callable[[], None] = lambda: None,
    ) -> list[Fit]:
        """Fit each model from its start.

        Args:
            starts: where to begin; one or more.
            iterations: steps of each, at most.
            race: leave those unfinished that are far behind the best, or behind the cost reached.
            reached: what other models have come down to.
            finished: called once for each model whose fit has ended.
        """
        problems = [self._problem(start) for start in starts]
        for leg in legs(iterations, race):
            # who is not done goes on, in groups that know nothing of each other within a leg
            going = [i for i, problem in enumerate(problems) if not problem.done]
            if not going or (leg.first and self.world.watch.leaves(leg.first / iterations)):
                break
            best = min(reached, *(problem.point.cost for problem in problems))
            groups = self._groups(problems, going)
            calls = [(self._terms(), [problems[i] for i in g], leg, race, best) for g in groups]
            for number, members in self.world.crew.each(self.world, _gone, calls):
                for i, problem in zip(groups[number], members, strict=True):
                    problems[i] = problem
                    if problem.done or leg.last >= iterations:
                        finished()
        return [p.fit() for p in problems]

    def _terms(self) -> tuple[Any, ...]:
        """All but the world."""
        return self.noise, self.frozen, self.share, self.parameters, self.exact

    def _groups(self, problems: Sequence[Problem], going: Sequence[int]) -> list[list[int]]:
        """Those that go on, in groups of about `GROUP` samples to simulate, of one kind each as far
        as may be; one group where more lanes of a call cost less.
        """
        world = self.world
        if not world.apart:
            return [list(going)]
        runs, length, _ = world.observed.shape
        unknown = self._moved_states().size
        lanes = sum(1 + problems[i].free.size + unknown for i in going) * runs
        cost = lanes * length * self.share + ALGEBRA * len(going)
        # compiled lanes are stepped side by side, however long they are
        count = int(np.ceil(min(cost / GROUP, lanes / FEWEST_LANES)))
        kinds = world.kinds(np.stack([problems[i].point.start.theta for i in going]))
        order = [going[i] for i in np.argsort(kinds, kind="stable")]
        parts = np.array_split(order, min(count, len(order)))
        return [part.tolist() for part in parts]

    def go(
        self, problems: Sequence[Problem], leg: Leg, race: bool, reached: float
    ) -> list[Problem]:
        """Some problems after a leg of their way.

        Args:
            problems: where they stand.
            leg: which steps to make.
            race: as in `fit`.
            reached: likewise, those of other groups among them.
        """
        # the samples that count, (R, T, C)
        seen = self.world.counted(self.share)
        if not leg.first:
            self._begin(problems, seen)
        for iteration in range(leg.first, leg.last):
            # in its first steps even the right model may be far behind
            if race and iteration >= RACED:
                give_up(problems, reached)
            self._renew(problems, seen, waiting=not race or iteration >= RACED)
            trials = list(self._trials(problems, seen))
            if not trials and any(p.waits and not p.done for p in problems):
                continue
            # what comes after it sees that this was left off
            if not trials or self.world.watch.leaves(iteration / leg.all):
                break
            made = self._plain_points if self.world.linear else self._points
            for (problem, _), point in zip(trials, made(trials, seen), strict=True):
                self._judge(problem, point)
        return list(problems)

    def _begin(self, problems: Sequence[Problem], seen: Mask) -> None:
        """Where they begin, with derivatives; those that are known nearby do to begin with."""
        nearby = [p for p in problems if self._knows(p)]
        others = [p for p in problems if not self._knows(p)]
        if others:
            begun = self._points([(p, p.point.start) for p in others], seen)
            for problem, point in zip(others, begun, strict=True):
                self._take(problem, point)
        if nearby:
            begun = self._plain_points([(p, p.point.start) for p in nearby], seen)
            for problem, point in zip(nearby, begun, strict=True):
                assert point.start.known is not None
                own = self._begun(problem, point.start, point.simulated.shape[1])
                known = point.start.known.jacobian[:, : point.simulated.shape[1]]
                self._take(problem, replace(point, jacobian=np.concatenate([known, own], axis=3)))
                problem.here = False

    def _knows(self, problem: Problem) -> bool:
        """Whether derivatives are known near a start, by all that is fitted."""
        known = problem.point.start.known
        return self.world.linear and known is not None and np.array_equal(known.free, problem.free)

    def _renew(self, problems: Sequence[Problem], seen: Mask, waiting: bool) -> None:
        """Take the derivatives anew of problems whose own are not good enough; of those that can
        wait only where `waiting` says so.
        """
        stale = [p for p in problems if p.stale and not p.done and (waiting or not p.waits)]
        if not stale:
            return
        for problem in stale:
            problem.renewals += 1
            if problem.needs_own_states:
                # Loaded where there is a robot alone.
                from bench.gap.model.tangents import begun_about

                at = problem.point.start
                problem.by_states = begun_about(self.world, at.theta, at.states)
        points = self._points([(p, p.point.start) for p in stale], seen)
        for problem, point in zip(stale, points, strict=True):
            self._take(problem, point)

    def _problem(self, start: Start) -> Problem:
        """What of a model is fitted, and how far it may go."""
        world = self.world
        free: list[int] = []
        bounds: list[tuple[float, float]] = []
        if self.parameters:
            free += [i for i in world.base.tolist() if i not in self.frozen]
            bounds += [world.parameters[i].bounds for i in free]
            for name in start.effects:
                free += world.places(name)
                bounds += coefficient_bounds(world, name)
        # two columns also where nothing is free
        table = np.array(bounds, dtype=np.float64).reshape(-1, 2)
        low, high = table.T

        # plausible ranges scale the differences; a fit may leave them by far
        plausible = [world.parameters[i].bounds for i in free]
        widths = np.array([b - a for a, b in plausible], dtype=np.float64)
        state_steps = np.full(len(world.states), FIRST_STATE_STEP)

        # a start may be the size that a score asks for, or come from wider bounds
        theta = start.theta.copy()
        theta[free] = np.clip(theta[free], low, high)
        begun = Start(start.effects, theta, start.states.copy(), start.known)
        return Problem(
            point=Point(begun, np.empty(0), np.empty(0), np.inf),
            free=np.array(free, dtype=np.intp),
            low=low,
            high=high,
            widths=widths,
            steps=np.concatenate([FIRST_STEP * widths, state_steps]),
            exact=self.exact,
            rough=world.linear,
            samples=int(world.counted(self.share).sum()),
        )

    def _points(self, trials: Sequence[_Trial], seen: Mask) -> list[Point]:
        """What each problem gives at a trial's place, its derivatives and its cost.

        One call of the engine has every run of every model, with every unknown moved: it goes
        through time once for all of them. An initial state that every run knows is no unknown.
        """
        runs, size = self.world.guess.shape
        unknown = self._moved_states()
        steps = [problem.inward(start.theta) for problem, start in trials]
        moved = [
            displaced(start, problem.free, step, unknown)
            for (problem, start), step in zip(trials, steps, strict=True)
        ]
        # lanes model by model, in each unknown by unknown, in each run by run
        thetas = np.concatenate([np.repeat(theta, runs, axis=0) for theta, _ in moved])
        states = np.concatenate([begin.reshape(-1, size) for _, begin in moved])
        lanes = np.tile(np.arange(runs), len(thetas) // runs)
        simulated = self.world.simulate(thetas, lanes, states, self.share)
        simulated = simulated.reshape(-1, runs, *simulated.shape[1:])

        points = []
        first = 0
        for (problem, start), step in zip(trials, steps, strict=True):
            # as it is, and with each unknown moved
            last = first + 1 + problem.free.size + unknown.size
            part = simulated[first:last]
            first = last
            jacobian = self._derivatives(part, step, unknown)
            if self.world.linear:
                jacobian[..., problem.free.size :] = self._begun(problem, start, part.shape[2])
            cost = self._cost(part[0], start.states, seen)
            points.append(Point(start, part[0], jacobian, cost))
        return points

    def _plain_points(self, trials: Sequence[_Trial], seen: Mask) -> list[Point]:
        """The same with the derivatives of where each problem stands, which cost nothing."""
        runs = len(self.world.guess)
        simulated = self.world.simulate(
            np.concatenate([np.tile(start.theta, (runs, 1)) for _, start in trials]),
            np.tile(np.arange(runs), len(trials)),
            np.concatenate([start.states for _, start in trials]),
            self.share,
        ).reshape(len(trials), runs, *self.world.observed.shape[1:])
        return [
            Point(start, part, problem.point.jacobian, self._cost(part, start.states, seen))
            for (problem, start), part in zip(trials, simulated, strict=True)
        ]

    def _moved_states(self) -> Indices:
        """(n,) the initial states that are moved to find their derivatives: none where they come
        from elsewhere.
        """
        if self.world.linear:
            return np.array([], dtype=np.intp)
        return np.flatnonzero(~self.world.known.all(axis=0))

    def _begun(self, problem: Problem, start: Start, samples: int) -> Array:
        """(R, T, C, s) derivatives by initial states, of the problem or those that come with the
        world; zero where a state is known.
        """
        world = self.world
        # loaded where there is a robot alone
        from bench.gap.model.tangents import begun

        shared = problem.by_states
        if shared is None:
            shared = begun(world, start.theta, start.states)
        derivatives = shared[:, :samples]
        kept: Array = derivatives * ~world.known[:, None, None, :]
        return kept

    def _derivatives(self, part: Array, steps: Array, unknown: Indices) -> Array:
        """(R, T, C, q + s) difference quotients; zero by an initial state where it is known, which
        absorbs nothing.

        Args:
            part: (1 + q + n, R, T, C) as it is, and with each unknown moved.
            steps: (q + s,) by what.
            unknown: (n,) the initial states that are moved.
        """
        known = self.world.known
        q = steps.size - known.shape[1]
        columns = np.concatenate([np.arange(q), q + unknown])
        # a lane that was given up is NaN, and tells nothing of how its unknown acts
        with np.errstate(all="ignore"):
            quotients = np.moveaxis(part[1:] - part[0], 0, -1) / steps[columns]
        jacobian: Array = np.where(followed(quotients), quotients, 0.0)
        if columns.size == steps.size:
            return jacobian
        quotients, jacobian = jacobian, np.zeros((*part.shape[1:], steps.size))
        jacobian[..., columns] = quotients
        jacobian[..., q:] *= ~known[:, None, None, :]
        return jacobian

    def _take(self, problem: Problem, point: Point) -> None:
        """Go on from a point, with differences that suit what it responds to."""
        problem.point = point
        problem.here, problem.stale, problem.waits = True, False, False
        problem.steps = difference_steps(point.jacobian, self.noise, problem.widths)

    def _residual(self, simulated: Array, seen: Mask) -> Array:
        """(R, T, C) observed less simulated, zero where nothing counts."""
        residual: Array = np.where(seen, self.world.observed - simulated, 0.0)
        return residual

    def _drift(self, states: Array) -> Array:
        """(R, s) how far initial states are from their guesses, in sigmas."""
        drift: Array = (states - self.world.guess) / prior_of(self.world)
        return drift

    def cost(self, fit: Fit) -> float:
        """What a fit costs by this noise."""
        return self._cost(fit.simulated, fit.states, self.world.counted(self.share))

    def _cost(self, simulated: Array, states: Array, seen: Mask) -> float:
        """The cost of eq. (1) of `arrow`; infinite where the simulator gave up."""
        residual = self._residual(simulated, seen)
        # a lane that was given up is NaN, which compares with nothing
        if not np.isfinite(residual).all():
            return np.inf
        w = whitened(residual, seen, self.noise)
        drift = self._drift(states)
        return float((w * w).sum() + (drift * drift).sum())

    def _trials(self, problems: Sequence[Problem], seen: Mask) -> Iterator[_Trial]:
        """Where each problem that is not done goes next; one whose step promises nothing is."""
        for problem in problems:
            if problem.done or problem.waits:
                continue
            trial = self._trial(problem, seen)
            if trial is not None:
                yield problem, trial

    def _trial(self, problem: Problem, seen: Mask) -> Start | None:
        """The next parameters and initial states to try; None, and done, if they promise
        nothing.
        """
        at = problem.point
        # there is no downhill from where nothing could be simulated
        if not np.isfinite(at.cost):
            problem.done = True
            return None

        left = self._residual(at.simulated, seen)
        derivatives = np.where(seen[..., None], at.jacobian, 0.0)
        residual = whitened(left, seen, self.noise)
        jacobian = whitened(derivatives, seen, self.noise)
        step = arrow_step(
            residual,
            jacobian,
            problem.free.size,
            self._drift(at.start.states),
            prior_of(self.world),
            self.world.known,
            problem.damping,
            problem.stuck(residual, jacobian),  # clipped afterwards, they would spoil the rest
        )
        problem.promised = step.promised
        # converged, or no step is short enough; where numbers overflow none is known
        if (
            not np.isfinite(step.promised)
            or step.promised < problem.enough(at.cost)
            or problem.damping > LARGEST_DAMPING
        ):
            problem.finish()
            return None

        # a copy: where the trial is refused, the old point stands
        theta = at.start.theta.copy()
        moved = theta[problem.free] + step.shared
        theta[problem.free] = np.clip(moved, problem.low, problem.high)
        return replace(at.start, theta=theta, states=at.start.states + step.own)

    def _judge(self, problem: Problem, point: Point) -> None:
        """Take a trial's point if it is better, and learn from it how much to damp."""
        gained = problem.point.cost - point.cost
        own = problem.here
        if point.cost < problem.point.cost:
            if self.world.linear:
                problem.point = replace(point, jacobian=problem.learnt(point))
                problem.here = not problem.free.size
            else:
                self._take(problem, point)
            problem.taken(gained, point.cost, own)
        else:
            problem.refused()


def _gone(world: World, terms: tuple[Any, ...], *call: Any) -> list[Problem]:
    """A group after a leg, whoever goes it."""
    return Fitter(world, *terms).go(*call)


def prior_of(world: World) -> Array:
    """(s,) what is known of initial states beforehand, 1 sigma."""
    if world.state_prior is not None:
        return world.state_prior
    system, shown = world.simulator.system, set(world.channels)
    # a coordinate's samples show its rate, too; behind the rates an own system may have more
    pairs = dict(zip(system.rates, system.coordinates, strict=False))
    measured = [name in shown or pairs.get(name) in shown for name in world.states]
    return np.where(measured, MEASURED, UNMEASURED)
