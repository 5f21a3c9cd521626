"""Broyden's method for the parameters at which the estimated difference to the target is zero.

With h the difference that a network estimates from the simulation of a point and the target, B the
slope of h, a step s and the change y of h (C. G. Broyden, Math. Comp. 19, 1965):

    (1)  s = -B^-1 h,  at first B = -1, which is a step of TuneNet's Algorithm 1
    (2)  B <- B + (y - B s) s^T / (s^T s)
"""

from __future__ import annotations

import numpy as np

from methods.tuner import Array, Task

MIN_STEP = 1e-10
"""Step length in the unit cube below which a step is rounding."""


_MAX_BROYDEN_STEP_RATIO = 2.0
"""Maximum length of a Broyden step, in multiples of the step of Algorithm 1."""
_MAX_BISECTION_STEP_RATIO = 10.0
"""Maximum length of a bisection step, in multiples of the step of Algorithm 1."""


class BroydenSearch:
    """Broyden's method for h(simulation of x, target) = 0.

    The initial slope is -1, so that the first step is that of Algorithm 1.

    Attributes:
        best: (dim,) point with the smallest estimated difference so far.
    """

    def __init__(self, task: Task) -> None:
        """Begin at the start of the task, with slope -1 in every direction.

        `_slope` (dim, dim) estimates dh/dx. `_last_evaluation` is the last point with its estimate
        h, `_best_residual` the estimate at `best`, and `_setbacks` counts the points since then
        that were not better. `_fallback` is the middle of the training range, used if the first
        simulation fails.

        Args:
            task: task of the target.
        """
        self._slope = -np.eye(task.dim)
        self._fallback = task.training.mean(axis=0)
        self._last_evaluation: tuple[Array, Array] | None = None
        self._best_residual: Array | None = None
        self._setbacks = 0
        # In one dimension: the largest point known to be too low, and the smallest known too high.
        self._bracket_low = -np.inf
        self._bracket_high = np.inf
        self.best = task.start

    def propose_next(self, point: Array, residual: Array) -> Array:
        """Compute the next guess from the best point so far, its residual and the residuals' slope.

        Args:
            point: (dim,) simulated point.
            residual: (dim,) estimate h at this point; NaN if the simulation failed.

        Returns:
            (dim,) point of the unit cube.
        """
        if not np.isfinite(residual).all():
            # The simulation failed: go half the way to the best point, or to the middle of the
            # training range.
            fallback = self._fallback if self._best_residual is None else self.best
            return (point + fallback) / 2.0
        if self._last_evaluation is not None:
            last_point, last_residual = self._last_evaluation
            self._update_slope(point - last_point, residual - last_residual)
        self._last_evaluation = point, residual
        # The smallest estimate so far, or another setback.
        if (
            self._best_residual is None
            or residual @ residual < self._best_residual @ self._best_residual
        ):
            self.best = point
            self._best_residual = residual
            self._setbacks = 0
        else:
            self._setbacks += 1
        guess: Array = np.clip(self.best + self._compute_step(self._best_residual), 0.0, 1.0)
        return self._limit_to_bracket(guess, point, residual) if len(point) == 1 else guess

    def _update_slope(self, step: Array, change: Array) -> None:
        """Correct the slope B by Broyden's update, B + (y - B s) s^T / (s^T s) (2).

        Then B explains the last step. A step of length zero is ignored.

        Args:
            step: (dim,) s, the difference of two points.
            change: (dim,) y, the difference of the network's estimates h at these points.
        """
        square = step @ step
        if square > 0.0:
            prediction_error = change - self._slope @ step
            self._slope = self._slope + np.outer(prediction_error, step) / square

    def _compute_step(self, residual: Array) -> Array:
        """Compute Broyden's step from the best point, at most twice as long as Algorithm 1's.

        It is s = -B^-1 h (1), with the slope B of the network's estimate h; B = -1 at first. The
        step of TuneNet's Algorithm 1 is h itself; it is used if s points against h. After the first
        setback (a point that was not better) the updated slope is enough; after each further one
        the step is halved.

        Args:
            residual: (dim,) estimate h at the best point, the difference to the target.

        Returns:
            (dim,) step in the unit cube.
        """
        try:
            step = np.linalg.solve(self._slope, -residual)  # (1)
        except np.linalg.LinAlgError:
            step = residual
        # If the step points against the estimate, the slope is wrong, because h is trained to have
        # the right direction.
        if not step @ residual > 0.0:
            step = residual
        length = max(float(np.linalg.norm(step)), 1e-300)
        longest = _MAX_BROYDEN_STEP_RATIO * float(np.linalg.norm(residual)) / length
        share = min(1.0, longest) / 2.0 ** max(self._setbacks - 1, 0)
        return np.asarray(step * share, dtype=np.float64)

    def _limit_to_bracket(self, guess: Array, point: Array, residual: Array) -> Array:
        """Limit the guess in one dimension to the interval between a low and a high point.

        This is done after a setback. The step to the middle of the interval is limited, because the
        middle is far away if the other end is one of the first points; a guess that is already
        close would be lost if the estimates are inaccurate.

        Args:
            guess: (1,) the next point, in the unit cube.
            point: (1,) the present point.
            residual: (1,) estimated step from the present point to the target.
        """
        # A positive estimate means that the target is above the point.
        if residual[0] > 0.0:
            self._bracket_low = max(self._bracket_low, point[0])
        elif residual[0] < 0.0:
            self._bracket_high = min(self._bracket_high, point[0])
        # Inaccurate estimates may contradict each other; then there is no interval.
        low, high = self._bracket_low, self._bracket_high
        has_bracket = np.isfinite([low, high]).all() and low < high
        if self._setbacks and has_bracket and not low < guess[0] < high:
            max_step = 1.0
            if self._best_residual is not None:
                max_step = _MAX_BISECTION_STEP_RATIO * float(np.abs(self._best_residual).max())
            halfway = np.array([(low + high) / 2.0])
            limited_guess: Array = np.clip(halfway, self.best - max_step, self.best + max_step)
            return limited_guess
        return guess
