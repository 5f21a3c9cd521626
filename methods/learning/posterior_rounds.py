"""Rounds of sequential neural posterior estimation on one target, by sbi.

A simulation enters as its residuals, reduced to their principal components: with some hundred
simulations, a network cannot read thousands of samples.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from methods.learning.library_isolation import NullTracker, isolated_library_call
from methods.tuner import Array, Evaluation, Task

_MAX_COMPONENTS = 10
"""Maximum number of principal components of the residuals that the network reads."""
_POSTERIOR_DRAWS = 1000
"""Number of posterior samples of which the mean is the recommendation."""
_MIN_INSIDE_SHARE = 0.1
"""Share of the posterior samples within the bounds below which all samples are used, clipped."""
_BOUND_MARGIN = 1e-6
"""Distance from the bounds of points that are moved there."""
_MIN_SINGULAR_VALUE = 1e-9
"""Singular value, relative to the largest one, below which a component is a rounding error."""


class PosteriorRounds:
    """Posterior of one target's parameters, improved round by round.

    Args:
        task: task of the target.

    Attributes:
        mean: (dim,) posterior mean; None before the first update.
    """

    def __init__(self, task: Task) -> None:
        """Begin without simulations; the network is made with the first round's components.

        `_trainer` and `_posterior` are objects of sbi. `_components` (N, P) are the P principal
        components of the N residuals, `_residual_mean` (N,) their mean, `_component_spread` (P,)
        the spread along each component.

        Args:
            task: task of the target.
        """
        self.mean: Array | None = None
        self._task = task
        self._trainer: Any = None
        self._posterior: Any = None
        self._components: Array | None = None
        self._residual_mean: Array = np.zeros(0)
        self._component_spread: Array = np.ones(0)

    def update(self, evaluation: Evaluation, count: int, rng: np.random.Generator) -> Array:
        """Train on one more round of simulations, and draw the points of the next.

        With too few successful simulations the points are uniformly random.

        Args:
            evaluation: evaluation of the round's points.
            count: number of points to draw.
            rng: random generator.

        Returns:
            (count, dim) points drawn from the posterior.
        """
        residuals = self._task.residuals(evaluation.observations)
        usable = np.isfinite(residuals).all(axis=1)
        # Two simulations are the minimum for a training and a validation set; the first round also
        # needs some for the principal components.
        min_simulations = 4 if self._components is None else 2
        if usable.sum() < min_simulations:
            return rng.uniform(size=(count, self._task.dim))
        points, residuals = evaluation.proposals[usable], residuals[usable]
        if self._components is None:
            self._fit_components(residuals)
        with isolated_library_call(rng):
            return self._train_round(points, self._compute_features(residuals), count)

    def _fit_components(self, residuals: Array) -> None:
        """Compute the principal components of the first round's residuals (n, N).

        There are N residuals of each of n simulations. Later rounds use the same components, so
        that the network's inputs keep their meaning. At most `_MAX_COMPONENTS` are used; those
        without variance (rounding errors) are left out.
        """
        self._residual_mean = residuals.mean(axis=0)
        centred = residuals - self._residual_mean
        _, singular, directions = np.linalg.svd(centred, full_matrices=False)
        component_count = max(
            int((singular[:_MAX_COMPONENTS] > _MIN_SINGULAR_VALUE * singular[0]).sum()), 1
        )
        self._components = directions[:component_count].T
        spread = (centred @ self._components).std(axis=0)
        self._component_spread = np.where(spread > 0, spread, 1.0)

    def _compute_features(self, residuals: Array) -> Array:
        """Return the scaled components of residuals (n, N); a perfect simulation has residual 0."""
        assert self._components is not None
        centred = residuals - self._residual_mean
        features: Array = centred @ self._components / self._component_spread
        return features

    def _train_round(self, points: Array, features: Array, count: int) -> Array:
        """Add one round of simulations, train the posterior, and draw `count` points (count, dim).

        The posterior is that of a residual of zero, the features of a perfect simulation. It is
        also the proposal of the next round, by which sbi weights the next simulations.

        Args:
            points: (n, dim) simulated points.
            features: (n, P) the P scaled principal components of their residuals.
            count: number of points to draw.
        """
        import torch
        from sbi.inference import NPE
        from sbi.utils import BoxUniform

        dim = self._task.dim
        if self._trainer is None:
            prior = BoxUniform(torch.zeros(dim), torch.ones(dim))
            self._trainer = NPE(prior=prior, tracker=NullTracker(), show_progress_bars=False)
        self._trainer.append_simulations(
            torch.as_tensor(points, dtype=torch.float32),
            torch.as_tensor(features, dtype=torch.float32),
            proposal=self._posterior,
        )
        self._trainer.train(training_batch_size=min(50, len(points)))
        zero = self._compute_features(np.zeros((1, len(self._residual_mean))))
        target = torch.as_tensor(zero, dtype=torch.float32)
        self._posterior = self._trainer.build_posterior().set_default_x(target)
        # Enough that `count` remain if only a tenth of them lies within the bounds.
        drawn_points = self._draw_points(max(round(count / _MIN_INSIDE_SHARE), _POSTERIOR_DRAWS))
        self.mean = drawn_points.mean(axis=0)
        return drawn_points[:count]

    def _draw_points(self, count: int) -> Array:
        """Draw `count` points from the posterior; return those in the bounds (n, dim).

        A posterior network may have nearly all of its mass outside the bounds ("leakage",
        Greenberg et al. 2019); rejecting until enough points lie inside would then not end. If
        fewer than a tenth lies inside, all are used, moved to the bounds.
        """
        draws = self._posterior.sample((count,), reject_outside_prior=False)
        points: Array = draws.detach().numpy().astype(np.float64)
        inside = points[((points >= 0.0) & (points <= 1.0)).all(axis=1)]
        if len(inside) >= _MIN_INSIDE_SHARE * count:
            return inside
        # On a bound, sbi counts a point as outside its prior.
        return np.clip(points, _BOUND_MARGIN, 1.0 - _BOUND_MARGIN)
