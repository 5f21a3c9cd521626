"""Levenberg-Marquardt on the difference between simulated and observed samples: what a practitioner
tries first.

Sources: D. W. Marquardt, An algorithm for least-squares estimation of nonlinear parameters, SIAM J.
Appl. Math. 11(2), 1963, doi:10.1137/0111030. J. Nocedal, S. J. Wright, Numerical Optimization, 2nd
ed., 2006, chapter 10, doi:10.1007/978-0-387-40065-5. H. B. Nielsen, Damping parameter in
Marquardt's method, IMM-REP-1999-05, Technical University of Denmark. K. Madsen, H. B. Nielsen, O.
Tingleff, Methods for non-linear least squares problems, 2nd ed., IMM lecture note, 2004, section
3.5 (the secant version). C. G. Broyden, A class of methods for solving nonlinear simultaneous
equations, Math. Comp. 19, 1965, doi:10.1090/S0025-5718-1965-0198670-6.

With r the residual at θ, J its Jacobian, s a step and D the diagonal of J^T J:

    (1)  (J^T J + mu D) s = -J^T r                       Marquardt's step
    (2)  gain = decrease of r^T r / the decrease promised by r + J s
    (3)  mu <- mu max(1/3, 1 - (2 gain - 1)^3) where gain > 0, else mu <- mu nu, nu <- 2 nu
    (4)  J <- J + (r(θ + s) - r - J s) s^T / (s^T s)     Broyden's update

(3) is Nielsen's rule.

Two things go beyond the textbook. A small change of a parameter grows along a simulation until
impacts fall into other time steps, so the residual as a whole is jagged, with many local minima,
while its first part is smooth: the fit starts on the first samples of each run and takes in more of
them step by step. (This is continuation from an easy problem to the hard one; C. Bunks et al. do it
with the frequencies of seismic data, Geophysics 60(5), 1995, doi:10.1190/1.1443880.) And what
remains of the budget is spent on new starts, far from everything tried so far.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from methods.base import Array, Ask, Evaluation, Steps, Task, Tuner

Result = TypeVar("Result")
Simulates = Generator["Array | Ask", Evaluation, Result]
"""A part of a run: it may simulate, and returns a Result."""
Mask = NDArray[np.bool_]
_POLISHED = 1e-8
"""Share of the sum of squares that a step must promise on all samples."""
_COARSE = 0.1
"""The same on a horizon that only leads to the next, which need not be polished."""
_KEPT = 0.5
"""Share of what was promised from which on a model is trusted."""
_DEAF = 1e-6
"""Of the mean sensitivity over all samples: a horizon that responds less tells nothing."""
_FLAT = 1e-6
"""Of the largest sensitivity: a parameter of less is damped as one of so much."""
_CANDIDATES = 64
"""Random points, per parameter, of which a new start is the farthest from all tried ones."""


@dataclass(eq=False)
class LeastSquares(Tuner):
    """Levenberg-Marquardt with secant updates, a growing horizon and new starts; recommends the
    lowest loss seen.

    `LeastSquares(horizons=(1.0,), secant=False, difference=1e-4, restart=False)` is the textbook's.

    Attributes:
        horizons: shares of each run's samples to fit, one after another; (1.0,) fits all of them at
            once.
        secant: keep the Jacobian up to date with Broyden's formula, and take finite differences
            anew only where that fails; otherwise take finite differences after every step that
            succeeds.
        difference: longest step of the finite differences, a share of the cube; it shrinks with the
            fit's own steps.
        smallest_difference: its lower limit.
        damping: first damping, relative to the squared sensitivities.
        patience: a fit is stuck after this many steps in succession without progress.
        progress: share by which a step must lower the sum of squares to count as progress.
        step_tolerance: a fit has converged when its step is shorter than this share of the cube.
        restart: whether to start again elsewhere when the target has not been reproduced.
        reproduced: the target is reproduced when the loss is below this share of the observation's
            root mean square.
        ahead: recommend a step before it is simulated where all samples are fitted and the last
            step did what the model promised; otherwise the lowest loss seen.
    """

    horizons: tuple[float, ...] = (0.0625, 0.09, 0.125, 0.18, 0.25, 0.35, 0.5, 0.7, 1.0)
    secant: bool = True
    difference: float = 0.03
    smallest_difference: float = 1e-6
    damping: float = 1e-3
    patience: int = 3
    progress: float = 0.1
    step_tolerance: float = 1e-10
    restart: bool = True
    reproduced: float = 1e-10
    ahead: bool = False

    def tune(self, task: Task, rng: np.random.Generator) -> Steps:
        """Fit from the start, then from other points until the target is reproduced."""
        run = History(task, self.reproduced)
        yield from self.fit_from(run, task.start)
        while not run.finished:
            if not self.restart:
                return "the fit reached a minimum"
            yield from self.fit_from(run, run.untried(rng))
        return "the simulation reproduces the target"

    def fit_from(self, run: History, point: Array) -> Simulates[None]:
        """One fit from `point`, of which nothing is known."""
        (residual,) = yield from run.simulate(point[None])
        # without a residual there is nothing to differentiate
        if not np.isnan(residual).any():
            model = yield from self._differentiate(run, point, residual, self.difference)
            yield from self.fit_model(run, model)

    def fit_model(self, run: History, model: LinearModel) -> Simulates[None]:
        """One fit over all horizons, beginning with a model."""
        for share in self.horizons:
            chosen = run.samples(share)
            # before the first impact nothing may depend on the parameters
            if share >= 1.0 or model.sensitive(chosen):
                model = yield from self._descend(run, model, chosen)
            if run.finished:
                return

    def _differentiate(
        self, run: History, point: Array, residual: Array, longest: float
    ) -> Simulates[LinearModel]:
        """One-sided differences, inward at the upper border; to the other side where a simulation
        failed.
        """
        h = min(max(longest, self.smallest_difference), self.difference)
        steps = np.where(point + h > 1.0, -h, h)
        moved = yield from run.simulate(point + np.diag(steps))
        failed = np.isnan(moved).any(axis=1)
        if failed.any():
            steps[failed] *= -1.0
            moved[failed] = yield from run.simulate(point + np.diag(steps)[failed])
        slopes = (moved - residual) / steps[:, None]
        # where both sides fail, the column stays zero
        return LinearModel(point, residual, np.nan_to_num(slopes).T)

    def _descend(self, run: History, model: LinearModel, chosen: Mask) -> Simulates[LinearModel]:
        """Levenberg-Marquardt on the chosen samples until they are fitted, or it is stuck."""
        worthwhile = _POLISHED if chosen.all() else _COARSE
        damping = _Damping(self.damping)
        stalled = 0
        failed = 0
        while stalled < self.patience:
            before = model.error(chosen)
            step, promised = model.step(chosen, damping.mu)
            if np.abs(step).max() < self.step_tolerance or promised <= worthwhile * before:
                break
            proposal = model.point + step
            # on an early horizon, or after a broken promise, a step is a guess
            trusted = self.ahead and model.trusted and chosen.all()
            hopeful = proposal if trusted else None
            (residual,) = yield from run.simulate(proposal[None], hopeful)
            # NaN where the simulation failed, which compares as no better
            after = float(residual[chosen] @ residual[chosen])
            better = after < before
            # a step that failed to lead down still tells the slope along it
            if np.isfinite(after):
                model.update(step, residual)
            if better:
                model.point = proposal
                model.residual = residual
            decrease = before - after
            model.trusted = decrease > _KEPT * promised
            damping.adapt(decrease / promised)  # (2)
            failed = 0 if better else failed + 1
            stalled = 0 if after < (1.0 - self.progress) * before else stalled + 1
            if run.finished:
                break
            # with one parameter the secant is the slope; with several it may have gone stale
            stale = failed == 2 and len(step) > 1
            if stale or (better and not self.secant):
                longest = float(np.abs(step).max())
                model = yield from self._differentiate(run, model.point, model.residual, longest)
        return model


@dataclass
class _Damping:
    """Nielsen's rule (3): gentle where the model is good, ever stronger where it fails."""

    mu: float
    nu: float = 2.0

    def adapt(self, gain: float) -> None:
        """`gain`: decrease as a share of what the model promised; NaN for a failed simulation."""
        if gain > 0.0:
            self.mu *= max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
            self.nu = 2.0
        elif np.isnan(gain):
            # a quarter of the step, where the parameters do not interact: (1) divides by 1 + mu
            self.mu = 4.0 * self.mu + 3.0
        else:
            self.mu *= self.nu
            self.nu *= 2.0


@dataclass
class LinearModel:
    """The residual near a point: r(θ + s) ≈ residual + jacobian s; arrays (dim,), (samples,),
    (samples, dim).

    `trusted` where the last step did at least half of what was promised.
    """

    point: Array
    residual: Array
    jacobian: Array
    trusted: bool = False

    def error(self, chosen: Mask) -> float:
        """Sum of squares of the chosen samples."""
        return float(self.residual[chosen] @ self.residual[chosen])

    def sensitive(self, chosen: Mask) -> bool:
        """Whether the chosen samples respond to any parameter, compared with all samples."""
        here = (self.jacobian[chosen] ** 2).mean()
        return bool(here > _DEAF * (self.jacobian**2).mean())

    def step(self, chosen: Mask, mu: float) -> tuple[Array, float]:
        """The step (1) within the cube, and the decrease of the sum of squares that it promises."""
        r = self.residual[chosen]
        jacobian = self.jacobian[chosen]
        gradient = jacobian.T @ r
        # a parameter at a border that would leave the cube stays there
        below = (self.point <= 0.0) & (gradient > 0.0)
        above = (self.point >= 1.0) & (gradient < 0.0)
        free = ~(below | above)
        scale = np.sqrt((jacobian**2).sum(0))
        scale = np.maximum(scale, _FLAT * scale.max())
        # (1) as a least-squares problem, which does not square the condition of J
        stacked = np.vstack([jacobian, np.diag(np.sqrt(mu) * scale)])[:, free]
        step = np.zeros_like(self.point)
        target = np.append(-r, np.zeros_like(step))
        step[free] = np.linalg.lstsq(stacked, target, rcond=None)[0]
        # what leaves the cube on the way is cut, and the promise is that of the cut step
        step = np.clip(self.point + step, 0.0, 1.0) - self.point
        remaining = r + jacobian @ step
        return step, float(r @ r - remaining @ remaining)

    def update(self, step: Array, residual: Array) -> None:
        """Broyden's update: the smallest change of the Jacobian that explains what the step did."""
        missed = residual - self.residual - self.jacobian @ step
        self.jacobian = self.jacobian + np.outer(missed, step / (step @ step))  # (4)


@dataclass
class History:
    """What one run has simulated."""

    task: Task
    reproduced: float
    tried: list[Array] = field(default_factory=list)
    residuals: list[Array] = field(default_factory=list)
    losses: list[float] = field(default_factory=list)
    finished: bool = False

    def __post_init__(self) -> None:
        observed = np.nan_to_num(self.task.observed) / self.task.scale
        self.enough = self.reproduced * float(np.sqrt(np.mean(observed**2)))

    def simulate(self, points: Array, recommend: Array | None = None) -> Simulates[Array]:
        """Residuals (n, samples) of the points; rows of NaN where the simulation failed."""
        points = np.clip(points, 0.0, 1.0)
        evaluation = yield points if recommend is None else Ask(points, recommend)
        return self.seen(evaluation)

    def seen(self, evaluation: Evaluation) -> Array:
        """Note what was simulated; its residuals."""
        proposals, observations, losses = evaluation
        finite = np.isfinite(losses)
        residuals = np.where(finite[:, None], self.task.residuals(observations), np.nan)
        self.tried.extend(proposals)
        self.residuals.extend(residuals)
        self.losses.extend(losses.tolist())
        self.finished = self.finished or bool((losses <= self.enough).any())
        return residuals

    def samples(self, share: float) -> Mask:
        """Which residuals belong to the first `share` of their run."""
        first = np.concatenate([np.arange(n) < share * n for n in self.task.lengths])
        return np.repeat(first, self.task.observed.shape[1])

    def untried(self, rng: np.random.Generator) -> Array:
        """The point farthest from all tried ones, among random candidates."""
        dim = self.task.dim
        candidates = rng.uniform(size=(_CANDIDATES * dim, dim))
        squares = [((candidates - point) ** 2).sum(1) for point in self.tried]
        farthest: Array = candidates[np.min(squares, axis=0).argmax()]
        return farthest
