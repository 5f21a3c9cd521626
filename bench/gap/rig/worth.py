"""What runs that could be recorded are worth, by simulation.

Where two models explain the data so far, a run x is worth what the rival would still leave of it
after it is fitted again to both, with what the old data know of its numbers, C, and d the
difference of the two on the run (T-optimality; A. C. Atkinson, V. V. Fedorov, Biometrika 62(1), 57,
1975, doi:10.1093/biomet/62.1.57),

    T(x) = min over δ, z of  |d - J δ - B z|^2 + δ' C^-1 δ                                      (1)

whitened by the noise as the data have it, J and B the rival's derivatives by its numbers and by the
run's initial state, which is free. Nobody knows which of the models is true, so that it counts the
lesser of the two, either being fitted to what the other says. Where nothing is open but numbers are
wide, a run is worth what it narrows them by (D-optimality; V. V. Fedorov, Theory of Optimal
Experiments, 1972),

    D(x) = 1/2 log det(I + C J' (I - B B^+) J)                                                  (2)

Twice the log likelihood by which the rival falls behind scatters about T with the variance 4 T, as
the noise of the run will have it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np

from bench.gap.measure import covariance, curved
from bench.gap.model.models import Model, Models
from bench.gap.model.noise import Noise, whitened
from bench.gap.rig.limits import Limits
from bench.gap.rig.plans import Run
from sims.base import Array

SPLITS = 25.0
"""(1) from which a run settles it: in 19 of 20 cases odds of 33 to 1 remain in its noise."""
ENOUGH = 4.0 * SPLITS
"""(1) beyond which more of it is worth no more."""
BEST = 12
"""Runs of a robot of the largest plain difference for which (1) is asked at all."""
MANY, FEWER = 12, 4
"""Fits of (1) in a row, of a system and of a robot, which takes its time."""
LITTLE = 1e-3
"""Of a channel's usual size, by which an initial state is moved for a derivative."""
WILD = 100.0
"""Times that such a shift may grow on the way."""
STEPS = 12
"""Of a fit of a rival to a run that does not exist."""
STIFFEST = 1e8
"""Damping (D. W. Marquardt 1963) at which such a fit is at its end."""


class _Known(NamedTuple):
    """What the old runs know of a model's numbers, each in units of `spread`: 1 sigma but no more
    than a tenth of its bounds.
    """

    model: Model
    spread: Array
    inverse: Array
    """Of their covariance."""


class _Slopes(NamedTuple):
    """A run with a model, and its derivatives, all whitened: (n,), (n, q) by numbers, each in units
    of its spread, (n, s) by its initial state.
    """

    centre: Array
    numbers: Array
    states: Array


class Worth(NamedTuple):
    """A run, (1) of each ordered pair of models or (2) alone, what that is worth, and whether it is
    so in full, or by the first step.
    """

    run: Run
    values: Array
    worth: float
    full: bool = False


def by_worth(entry: Worth) -> tuple[float, str]:
    """A key that puts the best first."""
    return -entry.worth, entry.run.says


class Judge:
    """Says what runs are worth for some models, the first of which stands."""

    def __init__(self, models: Models, rivals: Sequence[Model]) -> None:
        self.models, self.world = models, models.world
        self.known = [_known(models, one) for one in rivals]
        self.noise: Noise = curved(models, rivals[0]).noise
        self.limits = Limits(self.world, rivals[0])
        count = len(rivals)
        self.pairs = list(permutations(range(count), 2))
        self.most = ENOUGH * len(self.pairs) / 2 if self.pairs else np.inf
        self.patience = FEWER if self.world.kind.has_model else MANY
        self.free = ~self.world.known.all(axis=0)

    # -- runs

    def judged(self, runs: Sequence[Run]) -> list[Worth]:
        """Those that can be made, the best first, by the first step of (1) or by (2)."""
        stands = self.known[0].model
        able = [run for run, may in zip(runs, self.limits(stands, runs), strict=True) if may]
        if self.world.kind.has_model:
            able = self._plainest(able)
        entries = []
        for run in able:
            slopes = [self._slopes(run, one, one.model.fit.theta) for one in self.known]
            if all(one is not None for one in slopes):
                entries.append(self._entry(run, [one for one in slopes if one is not None]))
        return sorted(entries, key=by_worth)

    def _entry(self, run: Run, slopes: Sequence[_Slopes]) -> Worth:
        if not self.pairs:
            value = _narrowed(slopes[0], self.known[0])
            return Worth(run, np.array([value]), value)
        values = np.zeros((len(slopes), len(slopes)))
        for true, rival in self.pairs:
            gap = slopes[true].centre - slopes[rival].centre
            values[true, rival] = _left(gap, slopes[rival], self.known[rival])[0]
        return Worth(run, values, _worth(values))

    def fitted(self, entry: Worth) -> Worth:
        """With (1) in full: what a run shows of a rival may be far from it."""
        if not self.pairs:
            return entry._replace(full=True)
        values = entry.values.copy()
        for true, rival in self.pairs:
            values[true, rival] = self._told(entry.run, self.known[true], self.known[rival])
        # Whichever is true, the run has to be one that can be made.
        for one in self.known[1:]:
            if not self.limits(one.model, [entry.run])[0]:
                values[:] = 0.0
        return Worth(entry.run, values, _worth(values), full=True)

    def _plainest(self, runs: Sequence[Run]) -> list[Run]:
        """Runs of a robot of which models differ most before any refit: it takes its time."""
        sizes = []
        for run in runs:
            thetas = [one.model.fit.theta for one in self.known]
            seen = self._whitened(self._simulated(run, thetas, [run.states] * len(thetas)))
            gaps = [seen[b] - seen[a] for a, b in combinations(range(len(seen)), 2)]
            gaps = gaps or [seen[0] - seen[0].mean()]
            size = float(sum(np.log1p(np.square(gap).sum()) for gap in gaps))
            sizes.append(size if np.isfinite(size) else -np.inf)
        order = np.argsort(-np.array(sizes), kind="stable")
        return [runs[place] for place in order[:BEST].tolist()]

    # -- one run

    def _simulated(self, run: Run, thetas: Sequence[Array], states: Sequence[Array]) -> Array:
        """(L, T, C) the run with each parameter vector and state."""
        scenarios = [run.scenario] * len(thetas)
        return self.world.elsewhere(np.array(thetas), scenarios, np.array(states))

    def _whitened(self, values: Array) -> Array:
        """(L, n) observations, or differences of them, in units of the noise."""
        seen = np.ones((1, *values.shape[1:]), dtype=np.bool_)
        lanes = np.moveaxis(values, 0, -1)[None]
        result: Array = np.moveaxis(whitened(lanes, seen, self.noise)[0], -1, 0)
        return result.reshape(len(values), -1)

    def _slopes(
        self, run: Run, known: _Known, at: Array, states: Array | None = None
    ) -> _Slopes | None:
        """Derivatives about a parameter vector; None where there are none, or where the run
        amplifies how it begins: nobody could say later where it went, or why.
        """
        begin = run.states if states is None else states
        free = known.model.fit.free.tolist()
        thetas = [at] * (1 + len(free) + int(self.free.sum()))
        for row, place in enumerate(free):
            moved = at.copy()
            moved[place] += known.spread[row]
            thetas[1 + row] = moved
        shifts = LITTLE * np.eye(begin.size)[self.free]
        begins = [begin] * (1 + len(free)) + [begin + shift for shift in shifts]
        seen = self._simulated(run, thetas, begins)
        if not np.isfinite(seen).all():
            return None
        apart = np.abs(seen[1 + len(free) :] - seen[0])
        sizes = np.array([channel.scale for channel in self.world.simulator.channels])
        if apart.size and (apart / sizes).max() > WILD * LITTLE:
            return None
        lanes = self._whitened(np.concatenate([seen[:1], seen[1:] - seen[0]]))
        numbers, initial = lanes[1 : 1 + len(free)], lanes[1 + len(free) :]
        return _Slopes(lanes[0], numbers.T, initial.T / LITTLE)

    def _told(self, run: Run, true: _Known, rival: _Known) -> float:
        """(1), fitted by Levenberg and Marquardt."""
        fit = rival.model.fit
        shown = self._simulated(run, [true.model.fit.theta], [run.states])
        aim = self._whitened(shown)[0]
        at, states, gone = fit.theta.copy(), run.states.copy(), np.zeros(fit.free.size)
        slopes, damping = self._slopes(run, rival, at), 1e-6
        if slopes is None or not np.isfinite(aim).all():
            return 0.0
        least = float(np.square(aim - slopes.centre).sum())
        for _ in range(STEPS):
            if damping > STIFFEST:
                break
            _, step, moved = _left(aim - slopes.centre, slopes, rival, gone, damping)
            tried, begin = at.copy(), states.copy()
            tried[fit.free] += step * rival.spread
            begin[self.free] += moved
            after = self._slopes(run, rival, tried, begin)
            own = np.inf if after is None else float(np.square(aim - after.centre).sum())
            cost = own + float((gone + step) @ rival.inverse @ (gone + step))
            if after is None or not cost < least:
                damping *= 100.0
                continue
            done = least - cost < 1e-3 * least
            at, states, gone, slopes, least = tried, begin, gone + step, after, cost
            damping /= 10.0
            if done:
                break
        return least


def _known(models: Models, model: Model) -> _Known:
    own = covariance(models, model)
    bounds = np.array([models.world.parameters[i].bounds for i in model.fit.free]).reshape(-1, 2)
    widest = 0.1 * (bounds[:, 1] - bounds[:, 0])
    spread = np.minimum(np.sqrt(np.maximum(np.diagonal(own), 1e-300)), widest)
    inverse = np.asarray(np.linalg.pinv(own / np.outer(spread, spread), hermitian=True))
    return _Known(model, np.asarray(spread), inverse)


def _worth(values: Array) -> float:
    """What a run tells of all pairs, more than enough counted once."""
    least = np.minimum(values, values.T)
    return float(np.minimum(least[np.triu_indices(len(least), 1)], ENOUGH).sum())


def _left(
    gap: Array,
    slopes: _Slopes,
    known: _Known,
    gone: Array | None = None,
    damping: float = 1e-9,
) -> tuple[float, Array, Array]:
    """(1) to first order, and where its least is: steps of numbers, in their spread, and of states.

    Args:
        gap: (n,) what the rival leaves.
        slopes: of the rival.
        known: of it.
        gone: (q,) how far its numbers are from what the old runs say.
        damping: of the step.
    """
    q = len(known.spread)
    gone = np.zeros(q) if gone is None else gone
    columns = np.concatenate([slopes.numbers, slopes.states], axis=1)
    normal, pull = columns.T @ columns, columns.T @ gap
    normal[:q, :q] += known.inverse
    pull[:q] -= known.inverse @ gone
    damped = normal + damping * np.diag(np.diagonal(normal)) + 1e-18 * np.eye(len(normal))
    step = np.linalg.solve(damped, pull)
    begun = float(gap @ gap + gone @ known.inverse @ gone)
    least = begun - 2.0 * float(pull @ step) + float(step @ normal @ step)
    return max(least, 0.0), step[:q], step[q:]


def _narrowed(slopes: _Slopes, known: _Known) -> float:
    """(2), as a logarithm."""
    basis, _ = np.linalg.qr(slopes.states)
    own = slopes.numbers - basis @ (basis.T @ slopes.numbers)
    scaled = np.linalg.pinv(known.inverse, hermitian=True)
    _, value = np.linalg.slogdet(np.eye(len(scaled)) + scaled @ (own.T @ own))
    return float(0.5 * value)
