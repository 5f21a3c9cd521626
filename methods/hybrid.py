"""A learned start and a least-squares finish: TuneNet (arXiv 1907.11200) while it pays, then
Levenberg-Marquardt.

The network's first steps are worth more than any search's, since it knows the simulator. Its last
ones are not: outside its training range and under noise its estimate may settle where the
simulation does not fit. The loss tells which it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from methods.base import Array, Ask, Steps, Task
from methods.least_squares import LeastSquares, Model, Run, Simulates
from methods.tunenet import SETTLED, Search, TuneNet

_EXACT = 1e-13
"""Rounding: a loss below this share of the observation's root mean square."""
_WHOLE = LeastSquares(
    (1.0,), ahead=True, patience=2, damping=1e-6, step_tolerance=_EXACT, reproduced=_EXACT
)
"""All samples at once, for a start that is near."""


@dataclass(eq=False)
class Hybrid(TuneNet):
    """TuneNet as long as each step divides the loss; then least squares, which takes over what has
    been simulated.

    The finish begins at the lowest loss seen, with the secants of the points nearby in place of
    finite differences. It fits all samples first, then with growing horizons, then from new starts
    (`methods.least_squares`).

    Attributes:
        pays: a network step pays if it brings the loss below this share of the lowest so far.
        patience: the finish takes over after this many steps in succession that do not pay.
        near: a simulated point counts as near up to this distance in any coordinate, unit cube.
        finish: options of the finish.
    """

    name: ClassVar[str] = "hybrid"
    stochastic: ClassVar[bool] = True
    trains_as: ClassVar[str] = "tunenet"

    pays: float = 0.5
    patience: int = 2
    near: float = 0.1

    def tune(self, task: Task, rng: np.random.Generator) -> Steps:
        """Network steps, then a fit from there, then new starts."""
        finish = LeastSquares(reproduced=_EXACT)
        run = Run(task, _EXACT)
        enough = run.enough / _EXACT * finish.reproduced
        trusted = yield from self._approach(run, task)
        if not np.isfinite(run.losses).any():
            yield from finish.fit_from(run, task.training.mean(axis=0))
        for fit in (_WHOLE, finish):
            if run.finished or not np.isfinite(run.losses).any():
                break
            model = yield from self._model(run, finish)
            model.trusted = trusted
            yield from fit.fit_model(run, model)
            if min(run.losses) <= enough:
                break
            trusted = False
        while min(run.losses) > enough:
            yield from finish.fit_from(run, run.untried(rng))
        return "the simulation reproduces the target"

    def _approach(self, run: Run, task: Task) -> Simulates[bool]:
        """TuneNet's own steps, while they pay; returns whether they did to the end."""
        estimate, search = self.fitted().estimator(task), Search(task)
        guess, lowest, idle = task.start, np.inf, 0
        while not run.finished:
            seen = yield Ask(guess, recommend=guess)
            run.seen(seen)
            loss = float(seen.losses[0])
            idle = 0 if loss < self.pays * lowest or not np.isfinite(lowest) else idle + 1
            lowest = min(lowest, loss)
            if idle == self.patience:
                return False
            guess = search.after(seen.proposals[0], estimate(seen.observations))
            if np.abs(guess - search.best).max() <= SETTLED:
                break
        return idle == 0

    def _model(self, run: Run, finish: LeastSquares) -> Simulates[Model]:
        """The linear model at the lowest loss: secants to points nearby, finite differences in what
        they leave out.
        """
        best = int(np.nanargmin(np.where(np.isfinite(run.losses), run.losses, np.nan)))
        point, residual = run.tried[best], run.residuals[best]
        steps = np.array(run.tried) - point
        usable = np.isfinite(run.losses) & (np.abs(steps).max(axis=1) <= self.near)
        usable &= (
            np.abs(steps).max(axis=1) >= finish.smallest_difference
        )  # nearer ones differ by rounding
        order = [i for i in np.argsort((steps**2).sum(axis=1), kind="stable") if usable[i]]
        basis: list[Array] = []
        chosen: list[int] = []
        for i in order:
            across = steps[i] - sum((q * (q @ steps[i]) for q in basis), np.zeros(len(point)))
            if np.linalg.norm(across) > 0.5 * np.linalg.norm(steps[i]):
                basis.append(across / np.linalg.norm(across))
                chosen.append(int(i))
        directions, changes = steps[chosen], [run.residuals[i] - residual for i in chosen]
        missing = _complement(basis, len(point))
        if len(missing):
            size = float(np.abs(directions).max()) if chosen else finish.difference
            size = min(max(size, finish.smallest_difference), finish.difference)
            inward = np.where(missing @ (0.5 - point) < 0.0, -size, size)
            moved = np.clip(point + missing * inward[:, None], 0.0, 1.0)
            found = yield from run.simulate(moved)
            whole = ~np.isnan(found).any(axis=1)
            directions = np.concatenate([directions, (moved - point)[whole]])
            changes += list(found[whole] - residual)
        if not changes:
            return Model(point, residual, np.zeros((len(residual), len(point))))
        slopes = np.asarray(
            np.linalg.lstsq(directions, np.array(changes), rcond=None)[0], dtype=np.float64
        )
        return Model(point, residual, slopes.T)


def _complement(basis: list[Array], dim: int) -> Array:
    """Orthonormal directions (m, dim) across all of `basis`; the axes themselves where it is empty."""
    if not basis:
        return np.eye(dim)
    directions: Array = np.linalg.svd(np.array(basis))[2][len(basis) :]
    return directions
