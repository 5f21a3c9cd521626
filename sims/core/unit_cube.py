"""Map between physical parameters and the unit cube in which tuners work."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sims.core.simulator import Array, Parameter, make_read_only


class UnitCube:
    """Map between physical parameters and the unit cube in which all tuners work.

    0..1 spans each parameter's `bounds`, linearly, or logarithmically for log-scaled parameters.
    With bounds a and b, a parameter p and its coordinate u in the cube,

        p = a + u (b - a),    or    p = exp(log a + u (log b - log a))     (1)

    This class is the only implementation of the map.
    """

    def __init__(self, parameters: Sequence[Parameter]) -> None:
        """Store the bounds of the parameters, as logarithms for those that are log-scaled.

        `training` has the training ranges (2, dim) in coordinates of the cube: lower ends, then
        upper ends.

        Args:
            parameters: Parameters with bounds and training range.
        """
        self.parameters = tuple(parameters)
        self._log = np.array([p.log for p in self.parameters])
        self._any_log = bool(self._log.any())
        pairs = [p.bounds for p in self.parameters]
        bounds = np.array(pairs, dtype=np.float64).reshape(-1, 2)  # also without parameters
        self._low, self._high = self._apply_log_scale(bounds.T)
        self._span = self._high - self._low
        self.training: Array = make_read_only(
            self.to_unit_cube(np.array([p.training_range for p in self.parameters]).T)
        )

    @property
    def dim(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    def _apply_log_scale(self, theta: Array) -> Array:
        """Return parameters (..., dim) with logarithms of those that are log-scaled."""
        if not self._any_log:
            return theta
        # Use the logarithm of 1 for linear parameters, because that of a negative number warns.
        positive = np.where(self._log, theta, 1.0)
        scaled: Array = np.where(self._log, np.log(positive), theta)
        return scaled

    def to_physical(self, points: Array) -> Array:
        """Map unit-cube points (..., dim) to physical parameter vectors."""
        scaled: Array = self._low + points * self._span  # (1)
        if not self._any_log:
            return scaled
        logarithm = np.where(self._log, scaled, 0.0)
        mixed: Array = np.where(self._log, np.exp(logarithm), scaled)  # (1)
        return mixed

    def to_unit_cube(self, theta: Array) -> Array:
        """Map physical parameter vectors (..., dim) to unit-cube points."""
        result: Array = (
            self._apply_log_scale(np.asarray(theta, dtype=np.float64)) - self._low
        ) / self._span
        return result

    def compute_training_widths(self) -> Array:
        """Return the widths (dim,) of the training ranges in the parameters' units.

        The metric `param_error` is measured in these widths.
        """
        ranges = np.array([p.training_range for p in self.parameters], dtype=np.float64)
        return ranges[:, 1] - ranges[:, 0]

    def compute_distance_from_training(self, theta: Array) -> float:
        """Return the distance of parameters from the training range.

        It is the largest distance of any parameter, in units of the width of the parameter's
        training range; 0 inside.

        Args:
            theta: (dim,) parameters in their physical units.
        """
        ranges = np.array([p.training_range for p in self.parameters])
        # One of the two differences is positive outside, both are negative inside.
        excess = np.maximum(ranges[:, 0] - theta, theta - ranges[:, 1])
        return float(max(0.0, (excess / self.compute_training_widths()).max()))
