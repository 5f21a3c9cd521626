"""Hybrid tuner: TuneNet (arXiv 1907.11200) first, then Levenberg-Marquardt.

The network knows the simulator, so its first steps are better than those of any search. Outside its
training range and with noise, its estimate may settle where the simulation does not fit, which the
loss shows.

Levenberg-Marquardt begins with a Jacobian J that explains the simulations nearby, with steps s from
the best point and changes y of the residual, instead of finite differences:

    (1)  J s = y for each, by least squares
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from methods.learning.broyden_search import MIN_STEP, BroydenSearch
from methods.tuner import Array, Proposal, Task, TunerGenerator
from methods.tuners.least_squares import (
    EvaluationHistory,
    LeastSquares,
    LinearModel,
    Mask,
    SimulationGenerator,
)
from methods.tuners.tunenet import TuneNet

_ROUNDING_LOSS = 1e-13
"""Loss caused by rounding, as a share of the observation's root mean square."""
_FULL_HORIZON = LeastSquares(
    (1.0,),
    ahead=True,
    patience=2,
    damping=1e-6,
    step_tolerance=_ROUNDING_LOSS,
    reproduced=_ROUNDING_LOSS,
)
"""Options of a least-squares fit of all samples at once, for a start near the solution."""
_MIN_ORTHOGONAL_SHARE = 0.5
"""Minimum share of a step that is orthogonal to the chosen secants, for a further secant."""


@dataclass(eq=False)
class TuneNetLeastSquares(TuneNet):
    """TuneNet while its steps pay, then least squares from its simulations.

    Least squares begins at the lowest loss. It fits all samples first, then growing horizons, then
    from new starts (`methods.tuners.least_squares`).

    Attributes:
        pays: a network step pays if it brings the loss below this share of the lowest so far.
        patience: least squares begins after this many steps in succession that do not pay.
        near: distance in any coordinate, unit cube, up to which a simulated point counts as near.
    """

    name: ClassVar[str] = "hybrid"
    stochastic: ClassVar[bool] = True
    trains_as: ClassVar[str] = "tunenet"

    pays: float = 0.5
    patience: int = 2
    near: float = 0.1

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:
        """Take network steps, then fit by least squares from there, then from new starts.

        The least-squares fit begins at the lowest loss, first with all samples, then with growing
        parts of the runs (horizons). Each stage ends the run if the target is reproduced.

        Args:
            task: start, observations, number of parameters and budget of the run.
            rng: random numbers of the run.
        """
        finish = LeastSquares(reproduced=_ROUNDING_LOSS)
        run = EvaluationHistory(task, _ROUNDING_LOSS)
        is_trusted = yield from self._take_network_steps(run, task)
        # Without any successful simulation, the middle of the training range is the start.
        if not np.isfinite(run.losses).any():
            yield from finish.fit_from_point(run, task.training.mean(axis=0))
        # Growing horizons cost simulations, so they are used only if a fit of all samples failed.
        for fit in (_FULL_HORIZON, finish):
            # Without a successful simulation there is no point to begin at.
            if run.finished or not np.isfinite(run.losses).any():
                break
            model = yield from self._build_linear_model(run, finish)
            model.trusted = is_trusted
            yield from fit.fit_from_model(run, model)
            if min(run.losses) <= run.enough:
                break
            is_trusted = False
        while min(run.losses) > run.enough:
            yield from finish.fit_from_point(run, run.find_untried_point(rng))
        return "the simulation reproduces the target"

    def _take_network_steps(self, run: EvaluationHistory, task: Task) -> SimulationGenerator[bool]:
        """Take TuneNet's steps while each one reduces the loss enough.

        A step pays if the loss falls below `pays` times the lowest one before; after
        `patience` steps in a row that do not pay, the network is given up.

        Args:
            run: record of all simulations of the run, extended in place.
            task: start and observations of the target.

        Returns:
            True if the last step paid, so that least squares can trust the point reached.
        """
        estimate = self.get_trained_network().select_for(task).make_estimator(task)
        search = BroydenSearch(task)
        guess = task.start
        lowest = np.inf
        unprofitable_steps = 0
        while not run.finished:
            evaluation = yield Proposal(guess, recommend=guess)
            run.record(evaluation)
            loss = float(evaluation.losses[0])
            # The first successful simulation has no loss to be compared with.
            is_profitable = loss < self.pays * lowest or not np.isfinite(lowest)
            unprofitable_steps = 0 if is_profitable else unprofitable_steps + 1
            lowest = min(lowest, loss)
            # A single increase of a jagged loss is not enough to stop.
            if unprofitable_steps == self.patience:
                return False
            guess = search.propose_next(evaluation.proposals[0], estimate(evaluation.observations))
            if np.abs(guess - search.best).max() <= MIN_STEP:
                break
        return unprofitable_steps == 0

    def _build_linear_model(
        self, run: EvaluationHistory, finish: LeastSquares
    ) -> SimulationGenerator[LinearModel]:
        """Build the linear model of the residuals around the point with the lowest loss.

        The Jacobian J is the least-squares solution of J s = y (1) for steps s from that point and
        changes y of the residual. They are secants to nearby points, which have been simulated
        already, and finite differences, which are simulated here, in the remaining directions.

        Args:
            run: record of all simulations of the run, extended in place.
            finish: options of the least-squares fit, with the limits of its differences.
        """
        finite = np.isfinite(run.losses)
        best = int(np.nanargmin(np.where(finite, run.losses, np.nan)))
        point = run.tried[best]
        residual = run.residuals[best]
        steps = np.array(run.tried) - point
        chosen_steps, basis = self._choose_secants(steps, finite, finish.smallest_difference)
        directions = steps[chosen_steps]
        changes = [run.residuals[i] - residual for i in chosen_steps]
        missing = _compute_orthogonal_complement(basis, len(point))
        if len(missing):
            # Differences have the length of the secants, so that all columns have similar accuracy.
            size = float(np.abs(directions).max()) if chosen_steps else finish.difference
            size = min(max(size, finish.smallest_difference), finish.difference)
            # Towards the middle of the cube, so that the points stay inside.
            inward = np.where(missing @ (0.5 - point) < 0.0, -size, size)
            probe_points = np.clip(point + missing * inward[:, None], 0.0, 1.0)
            residuals = yield from run.simulate(probe_points)
            is_complete = ~np.isnan(residuals).any(axis=1)
            # Failed simulations give no difference.
            directions = np.concatenate([directions, (probe_points - point)[is_complete]])
            changes += list(residuals[is_complete] - residual)
        # If no simulation nearby succeeded, the model predicts no decrease.
        if not changes:
            return LinearModel(point, residual, np.zeros((len(residual), len(point))))
        slopes, *_ = np.linalg.lstsq(directions, np.array(changes), rcond=None)  # (1)
        return LinearModel(point, residual, np.asarray(slopes, dtype=np.float64).T)

    def _choose_secants(
        self, steps: Array, finite: Mask, smallest: float
    ) -> tuple[list[int], list[Array]]:
        """Choose secants, steps to earlier points from which derivatives follow at no further cost.

        They must be short and point in different directions; the shortest are preferred.

        Args:
            steps: (n, dim) steps from the best point.
            finite: (n,) mask of successful simulations.
            smallest: minimum length of a secant.

        Returns:
            Indices of the chosen steps, and an orthonormal basis of them.
        """
        lengths = np.abs(steps).max(axis=1)
        # Shorter steps than the smallest difference are dominated by rounding.
        usable = finite & (lengths <= self.near)
        usable &= lengths >= smallest
        nearest = np.argsort((steps**2).sum(axis=1), kind="stable")
        basis: list[Array] = []
        chosen_steps: list[int] = []
        # The nearest points come first; each step is orthogonalised by Gram-Schmidt.
        for point_index in nearest[usable[nearest]]:
            step = steps[point_index]
            parallel_part = sum(
                (direction * (direction @ step) for direction in basis), np.zeros(len(step))
            )
            orthogonal_part = step - parallel_part
            length = np.linalg.norm(orthogonal_part)
            if length > _MIN_ORTHOGONAL_SHARE * np.linalg.norm(step):
                basis.append(orthogonal_part / length)
                chosen_steps.append(int(point_index))
        return chosen_steps, basis


def _compute_orthogonal_complement(basis: list[Array], dim: int) -> Array:
    """Return orthonormal directions (m, dim) orthogonal to `basis`; the axes if it is empty.

    Args:
        basis: orthonormal vectors (dim,): directions in which the slope is already known.
        dim: number of parameters.
    """
    if not basis:
        return np.eye(dim)
    _, _, right_vectors = np.linalg.svd(np.array(basis))
    directions: Array = right_vectors[len(basis) :]  # those beyond the rank
    return directions
