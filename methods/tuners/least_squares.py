"""Levenberg-Marquardt on the difference between simulated and observed samples.

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

Two additions to the textbook: A small change of a parameter grows along a simulation until impacts
fall into other time steps. Therefore the whole residual is jagged, with many local minima, while
its first part is smooth. The fit starts on the first samples of each run and adds more step by step
(continuation, as in C. Bunks et al. with the frequencies of seismic data, Geophysics 60(5), 1995,
doi:10.1190/1.1443880). The rest of the budget is spent on new starts, far from all points tried.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from methods.tuner import Array, Evaluation, Proposal, Task, Tuner, TunerGenerator

Result = TypeVar("Result")
SimulationGenerator = Generator["Array | Proposal", Evaluation, Result]
"""Part of a run: a generator that may simulate, and returns a Result."""
Mask = NDArray[np.bool_]
_FINAL_CONVERGENCE_SHARE = 1e-8
"""Minimum predicted decrease of a step on all samples, as a share of the sum of squares."""
_HORIZON_CONVERGENCE_SHARE = 0.1
"""Minimum predicted decrease of a step on a shorter horizon, as a share of the sum of squares.

It is larger than for all samples, because such a fit is only a start for the next horizon.
"""
_MIN_TRUST_RATIO = 0.5
"""Minimum ratio of actual to predicted decrease at which a linear model is trusted."""
_MIN_RELATIVE_SENSITIVITY = 1e-6
"""Minimum mean squared sensitivity of a horizon, as a share of that of all samples.

A horizon with a smaller one gives no information about the parameters.
"""
_MIN_DAMPING_SENSITIVITY = 1e-6
"""Minimum sensitivity for the damping, as a share of the largest one.

A parameter with a smaller sensitivity is damped as if it had this one.
"""
_START_CANDIDATES = 64
"""Number of random points per parameter, from which a new start is chosen."""


@dataclass(eq=False)
class LeastSquares(Tuner):
    """Levenberg-Marquardt with secant updates, a growing horizon and restarts.

    It recommends the lowest loss so far. The textbook's method is
    `LeastSquares(horizons=(1.0,), secant=False, difference=1e-4, restart=False)`.

    Attributes:
        horizons: shares of each run's samples to fit, one after another; (1.0,) fits all at once.
        secant: update the Jacobian with Broyden's formula, and take finite differences only where
            that fails; otherwise take them after every step that succeeds.
        difference: longest step of the finite differences, a share of the cube; it shrinks with the
            steps of the fit.
        smallest_difference: its lower limit.
        damping: first damping, relative to the squared sensitivities.
        patience: a fit is stuck after this many steps in succession without progress.
        progress: share by which a step must lower the sum of squares to count as progress.
        step_tolerance: a fit has converged when its step is shorter than this share of the cube.
        restart: start again elsewhere if the target has not been reproduced.
        reproduced: the target is reproduced if the loss is below this share of the observation's
            root mean square.
        ahead: recommend a step before its simulation if all samples are fitted and the last step
            was as predicted; otherwise the lowest loss.
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

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:
        """Fit from the start, then from other points until the target is reproduced.

        Args:
            task: start, observations, number of parameters and budget of the run.
            rng: random numbers of the run.
        """
        run = EvaluationHistory(task, self.reproduced)
        yield from self.fit_from_point(run, task.start)
        while not run.finished:
            if not self.restart:
                return "the fit reached a minimum"
            yield from self.fit_from_point(run, run.find_untried_point(rng))
        return "the simulation reproduces the target"

    def fit_from_point(self, run: EvaluationHistory, point: Array) -> SimulationGenerator[None]:
        """Fit from a point that has not been simulated; nothing follows if its simulation fails.

        It is simulated, the derivatives there are computed by finite differences, and the fit
        begins.

        Args:
            run: history of the run.
            point: (dim,) starting point in the unit cube.
        """
        (residual,) = yield from run.simulate(point[None])
        # Without a residual there is nothing to differentiate.
        if not np.isnan(residual).any():
            model = yield from self._compute_differences(run, point, residual, self.difference)
            yield from self.fit_from_model(run, model)

    def fit_from_model(
        self, run: EvaluationHistory, model: LinearModel
    ) -> SimulationGenerator[None]:
        """Fit on all horizons in succession, beginning with a linear model.

        Args:
            run: history of the run.
            model: linear model at the starting point.
        """
        for share in self.horizons:
            is_selected = run.select_samples(share)
            # Before the first impact the samples may not depend on the parameters.
            if share >= 1.0 or model.is_sensitive(is_selected):
                model = yield from self._run_levenberg_marquardt(run, model, is_selected)
            if run.finished:
                return

    def _compute_differences(
        self, run: EvaluationHistory, point: Array, residual: Array, longest: float
    ) -> SimulationGenerator[LinearModel]:
        """Compute the linear model at a point by one-sided differences, inward at the upper bound.

        If a simulation fails, the difference is taken on the other side.

        Args:
            run: record of all simulations of the run, extended in place.
            point: (dim,) point of the unit cube.
            residual: (samples,) residual at the point.
            longest: longest step, a share of the cube, limited by `difference` and
                `smallest_difference`.
        """
        difference = min(max(longest, self.smallest_difference), self.difference)
        steps = np.where(point + difference > 1.0, -difference, difference)
        probe_residuals = yield from run.simulate(point + np.diag(steps))
        failed = np.isnan(probe_residuals).any(axis=1)
        if failed.any():
            steps[failed] *= -1.0
            probe_residuals[failed] = yield from run.simulate(point + np.diag(steps)[failed])
        # One simulation per parameter, which is a column of the Jacobian.
        slopes = (probe_residuals - residual) / steps[:, None]
        # If both sides fail, the column stays zero.
        return LinearModel(point, residual, np.nan_to_num(slopes).T)

    def _run_levenberg_marquardt(
        self, run: EvaluationHistory, model: LinearModel, is_selected: Mask
    ) -> SimulationGenerator[LinearModel]:
        """Run Levenberg-Marquardt on the chosen samples until convergence or lack of progress.

        After each step the Jacobian gets Broyden's update; it is computed again by finite
        differences when it is outdated.

        Args:
            run: record of all simulations of the run, extended in place.
            model: linear model (point, residual, Jacobian) at the starting point; changed in place.
            is_selected: mask of the residuals to fit, for example of a short horizon at first,
                since a long simulation can have many local minima.

        Returns:
            The linear model at the last point.
        """
        convergence_share = (
            _FINAL_CONVERGENCE_SHARE if is_selected.all() else _HORIZON_CONVERGENCE_SHARE
        )
        damping = _Damping(self.damping)
        stalled_steps = 0  # steps in a row without progress
        failed_steps = 0  # steps in a row that did not decrease the error
        while stalled_steps < self.patience:
            error_before = model.compute_error(is_selected)
            step, predicted_decrease = model.compute_step(is_selected, damping.mu)
            # Converged: the step is negligible, or the model predicts too small a decrease.
            if (
                np.abs(step).max() < self.step_tolerance
                or predicted_decrease <= convergence_share * error_before
            ):
                break
            proposal = model.point + step
            # On a short horizon, or after a wrong prediction, a step is too uncertain to be
            # recommended.
            is_trusted = self.ahead and model.trusted and is_selected.all()
            expected_proposal = proposal if is_trusted else None
            (residual,) = yield from run.simulate(proposal[None], expected_proposal)
            # The error is NaN if the simulation failed, and then `is_better` is False.
            error_after = float(residual[is_selected] @ residual[is_selected])
            is_better = error_after < error_before
            # A step that increased the error still gives information about the slope along it.
            if np.isfinite(error_after):
                model.apply_broyden_update(step, residual)
            if is_better:
                model.point = proposal
                model.residual = residual
            decrease = error_before - error_after
            model.trusted = decrease > _MIN_TRUST_RATIO * predicted_decrease
            damping.adapt(decrease / predicted_decrease)  # the gain (2)
            failed_steps = 0 if is_better else failed_steps + 1
            has_progress = error_after < (1.0 - self.progress) * error_before
            stalled_steps = 0 if has_progress else stalled_steps + 1
            if run.finished:
                break
            # With one parameter the secant is the slope; with several the secants may be outdated.
            is_stale = failed_steps == 2 and len(step) > 1
            if is_stale or (is_better and not self.secant):
                longest = float(np.abs(step).max())
                model = yield from self._compute_differences(
                    run, model.point, model.residual, longest
                )
        return model


@dataclass
class _Damping:
    """Damping by Nielsen's rule (3): smaller after good predictions, larger after bad ones."""

    mu: float
    nu: float = 2.0

    def adapt(self, gain: float) -> None:
        """Adapt the damping mu to the result of a step, by Nielsen's rule (3).

        With a gain above zero, mu is multiplied by max(1/3, 1 - (2 gain - 1)^3). With another gain
        it is multiplied by nu, which doubles each time in a row.

        Args:
            gain: ratio of actual to predicted decrease; NaN for a failed simulation.
        """
        if gain > 0.0:
            self.mu *= max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
            self.nu = 2.0
        elif np.isnan(gain):
            # If the parameters do not interact, Marquardt's step is that of Gauss-Newton divided by
            # 1 + mu; so it becomes a quarter.
            self.mu = 4.0 * self.mu + 3.0
        else:
            self.mu *= self.nu
            self.nu *= 2.0


@dataclass
class LinearModel:
    """Linear model of the residual near a point: r(θ + s) ≈ residual + jacobian s.

    Attributes:
        point: (dim,) point of the unit cube.
        residual: (samples,) residual at the point.
        jacobian: (samples, dim) Jacobian at the point.
        trusted: whether the last step gave at least half of the predicted decrease.
    """

    point: Array
    residual: Array
    jacobian: Array
    trusted: bool = False

    def compute_error(self, chosen: Mask) -> float:
        """Return the sum of squares of the chosen samples."""
        return float(self.residual[chosen] @ self.residual[chosen])

    def is_sensitive(self, chosen: Mask) -> bool:
        """Return whether the chosen samples are sensitive to any parameter.

        Their sensitivity is compared with that of all samples.
        """
        mean_square = (self.jacobian[chosen] ** 2).mean()
        return bool(mean_square > _MIN_RELATIVE_SENSITIVITY * (self.jacobian**2).mean())

    def compute_step(self, chosen: Mask, mu: float) -> tuple[Array, float]:
        """Compute Marquardt's step from the model's point, clipped to the unit cube.

        The step s solves (J^T J + mu D) s = -J^T r (1), with the diagonal D of J^T J.

        Args:
            chosen: mask of the fitted samples.
            mu: damping; a larger one gives a shorter step.

        Returns:
            The step (dim,), and the decrease of the sum of squares that the linear model predicts.
        """
        r = self.residual[chosen]
        jacobian = self.jacobian[chosen]
        gradient = jacobian.T @ r
        # A parameter at a bound that would leave the cube stays at the bound.
        is_at_lower_bound = (self.point <= 0.0) & (gradient > 0.0)
        is_at_upper_bound = (self.point >= 1.0) & (gradient < 0.0)
        is_free = ~(is_at_lower_bound | is_at_upper_bound)
        scale = np.sqrt((jacobian**2).sum(0))
        scale = np.maximum(scale, _MIN_DAMPING_SENSITIVITY * scale.max())
        # (1) is solved as a least-squares problem, which does not square the condition number of J.
        stacked = np.vstack([jacobian, np.diag(np.sqrt(mu) * scale)])[:, is_free]
        step = np.zeros_like(self.point)
        target = np.append(-r, np.zeros_like(step))
        step[is_free], *_ = np.linalg.lstsq(stacked, target, rcond=None)
        # The step is clipped to the cube, and the predicted decrease is that of the clipped step.
        step = np.clip(self.point + step, 0.0, 1.0) - self.point
        remaining = r + jacobian @ step
        return step, float(r @ r - remaining @ remaining)

    def apply_broyden_update(self, step: Array, residual: Array) -> None:
        """Apply Broyden's update, the smallest Jacobian change that explains a step's result.

        It is J + (r(θ + s) - r - J s) s^T / (s^T s) (4), with the residual r and the step s.

        Args:
            step: (dim,) step from the point.
            residual: (samples,) residual after the step.
        """
        prediction_error = residual - self.residual - self.jacobian @ step
        self.jacobian = self.jacobian + np.outer(prediction_error, step / (step @ step))  # (4)


@dataclass
class EvaluationHistory:
    """Record of everything that one run has simulated.

    Attributes:
        task: task of the target.
        reproduced: loss at which the target counts as reproduced, as a share of the observation's
            root mean square.
        tried: simulated points.
        residuals: residual of each point; NaN if the simulation failed.
        losses: loss of each point.
        finished: whether the target has been reproduced.
    """

    task: Task
    reproduced: float
    tried: list[Array] = field(default_factory=list)
    residuals: list[Array] = field(default_factory=list)
    losses: list[float] = field(default_factory=list)
    finished: bool = False

    def __post_init__(self) -> None:
        # `enough` is the loss at which the target counts as reproduced.
        observed = np.nan_to_num(self.task.observed) / self.task.scale
        self.enough = self.reproduced * float(np.sqrt(np.mean(observed**2)))

    def simulate(self, points: Array, recommend: Array | None = None) -> SimulationGenerator[Array]:
        """Simulate points: yield them to the caller, who sends back their evaluation, and store it.

        Args:
            points: (n, dim) points, which are clipped to the unit cube.
            recommend: (dim,) recommended point; None for the lowest loss so far.

        Returns:
            Residuals (n, samples); rows of NaN if the simulation failed.
        """
        points = np.clip(points, 0.0, 1.0)
        evaluation = yield points if recommend is None else Proposal(points, recommend)
        return self.record(evaluation)

    def record(self, evaluation: Evaluation) -> Array:
        """Record an evaluation of n points, and return the N residuals (n, N) of each.

        The residuals of a failed simulation are NaN. The run is finished as soon as a loss is at
        most `enough`.
        """
        proposals, observations, losses = evaluation
        finite = np.isfinite(losses)
        residuals = np.where(finite[:, None], self.task.residuals(observations), np.nan)
        self.tried.extend(proposals)
        self.residuals.extend(residuals)
        self.losses.extend(losses.tolist())
        self.finished = self.finished or bool((losses <= self.enough).any())
        return residuals

    def select_samples(self, share: float) -> Mask:
        """Return the mask (T C,) of the residuals in the first `share` of their run."""
        is_early = np.concatenate(
            [np.arange(length) < share * length for length in self.task.lengths]
        )
        return np.repeat(is_early, self.task.observed.shape[1])

    def find_untried_point(self, rng: np.random.Generator) -> Array:
        """Return the random candidate point that is farthest from all simulated points."""
        dim = self.task.dim
        candidates = rng.uniform(size=(_START_CANDIDATES * dim, dim))
        squares = [((candidates - point) ** 2).sum(1) for point in self.tried]
        farthest_point: Array = candidates[np.min(squares, axis=0).argmax()]
        return farthest_point
