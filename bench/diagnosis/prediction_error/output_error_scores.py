"""Score single effects of a robot on the ground by the residual of its simulated pieces.

Where wheels and feet lift off and land, a Kalman filter needs much process noise, which hides most
of what an effect does to the following samples. The pieces are short, so that a simulation of the
base model stays near the recording (output error; L. Ljung, System Identification, 2nd ed., 1999,
section 7.2). With the residual r of the simulation, its derivatives H by the first states, and the
responses s_k of the candidates, all divided by the noise, and p the prior standard deviations of
first states,

    minimise |P (r - sum_k c_k s_k)|^2,    P = I - Q Q^T,    Q R = [H; diag(1 / p)]            (1)

so that only what no first state explains counts.

A larger wheel or foot raises the body, and rolls farther per turn, v = omega r. A linear response
begins with the wheel inside the floor and is that of a jump. So the response to another geometry is
a difference of simulations, each from first states whose contacts are settled for its geometry.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from bench.diagnosis.evaluation.candidate_direction import CandidateDirection
from bench.diagnosis.evaluation.coefficient_bounds import get_bounds_by_index
from bench.diagnosis.fitting.fitted_models import FittedModel
from bench.diagnosis.fitting.levenberg_marquardt_state import FitStart
from bench.diagnosis.prediction_error.effect_proposals import SearchContext
from bench.diagnosis.prediction_error.regression_selection import Regression, group_probes
from bench.diagnosis.prediction_error.simulated_fits import (
    fit_by_simulation,
    is_explained,
    remove_idle_effects,
    select_more_likely,
)
from sims.core.effect import members_of
from sims.core.simulator import Array
from sims.robot.model_field_effects import MODEL_FIELD_EFFECTS

GEOMETRY_FIELDS = frozenset({"geom_size", "body_pos"})
"""Fields of a model that move the points at which wheels and feet touch."""
DIFFERENCE_SHARE = 0.02
"""Finite change of a coefficient, as a share of its plausible range."""
MAX_SIMULATED = 8
"""Maximum number of effects that are simulated with their regression coefficients."""
MAX_REFINED = 5
"""Maximum number of effects whose coefficients are refined before any is fitted."""
MAX_FITTED = 3
"""Maximum number of effects that are fitted by simulation."""
MAX_REFINEMENTS = 3
"""Maximum number of Gauss-Newton steps of the coefficients before a fit."""
MIN_DECREASE = 0.02
"""Minimum relative decrease of the sum of squares for another Gauss-Newton step."""


def fit_best_scored(context: SearchContext) -> FittedModel:
    """Fit the single effects that explain most of the simulation residual.

    Args:
        context: context of the search, of a robot on the ground.

    Returns:
        The best model, or the base model.
    """
    best = context.search.base_model
    search_control = context.evaluator.search_control
    scores = OutputErrorScores(context)
    # Refining costs a tenth of a fit, and a better order saves whole fits.
    starts = [scores.refine(start) for start in scores.list_starts()[:MAX_REFINED]]
    starts.sort(key=lambda start: scores.compute_cost(start.theta))
    for start in starts[:MAX_FITTED]:
        fitted = fit_by_simulation(context, start)
        if np.isfinite(fitted.fit.cost):
            best = select_more_likely(best, fitted)
        if is_explained(context, best):
            return remove_idle_effects(context, best)
        if search_control.is_over():
            break
    return best


@dataclass(frozen=True)
class OutputErrorScores:
    """Scores of single effects by eq. (1).

    Attributes:
        context: context of the search, of a robot on the ground.
    """

    context: SearchContext

    def list_starts(self) -> list[FitStart]:
        """Return starts with one effect each, the one with the smallest residual first.

        The effects that gain most by regression are simulated, because a response is linear only
        for small coefficients.
        """
        regression, starts = self.regression, dict[str, FitStart]()
        net_gains = regression.compute_net_gains()
        for i in np.argsort(-net_gains, kind="stable").tolist():
            group = regression.groups[i]
            if net_gains[i] <= 0.0 or len(starts) == MAX_SIMULATED:
                break
            if group.effect not in starts:
                coefficients = regression.solve([group])[1]
                starts[group.effect] = self.context.columns.start([group], coefficients)
        costs = [self.compute_cost(start.theta) for start in starts.values()]
        ordered = list(starts.values())
        return [ordered[i] for i in np.argsort(costs, kind="stable").tolist()]

    def refine(self, start: FitStart) -> FitStart:
        """Return a start with coefficients that minimise (1) of settled simulations.

        Args:
            start: start whose coefficients are improved by Gauss-Newton steps.
        """
        evaluator, theta = self.context.evaluator, start.theta
        bounds = get_bounds_by_index(evaluator, start.effects)
        residual = self._compute_residual(theta)
        for _ in range(MAX_REFINEMENTS):
            columns = []
            for place, (_, high) in bounds.items():
                step = self._get_difference(place)
                changed = theta.copy()
                changed[place] += step if theta[place] + step <= high else -step
                difference = self._compute_residual(changed) - residual
                columns.append(difference / (changed[place] - theta[place]))
            if not np.isfinite(columns).all():
                break
            change = np.linalg.lstsq(np.stack(columns, axis=1), -residual, rcond=None)[0]
            changed = theta.copy()
            for (place, (low, high)), value in zip(bounds.items(), change.tolist(), strict=True):
                changed[place] = np.clip(theta[place] + value, low, high)
            new_residual = self._compute_residual(changed)
            before, after = residual @ residual, new_residual @ new_residual
            if not after < before:
                break
            theta, residual = changed, new_residual
            if after > (1.0 - MIN_DECREASE) * before:
                break
        return replace(start, theta=theta)

    def compute_cost(self, theta: Array) -> float:
        """Return the sum of squares of the projected residual (1) of a simulation.

        Args:
            theta: (P,) parameters of the model.
        """
        residual = self._compute_residual(theta)
        cost = float(residual @ residual)
        return cost if np.isfinite(cost) else np.inf

    def _compute_residual(self, theta: Array) -> Array:
        """Return the projected residual (1) of a simulation from settled first states, (n,)."""
        residual = self.context.evaluator.observed - self._simulate_settled(theta)
        return self._project(residual[..., None]).reshape(-1)

    def _get_difference(self, place: int) -> float:
        """Return the finite change of a coefficient, by its index in theta."""
        low, high = self.context.evaluator.parameters[place].bounds
        return DIFFERENCE_SHARE * (float(high) - float(low))

    @cached_property
    def regression(self) -> Regression:
        """Regression (1) of the residual of the base model on the candidates of the library."""
        context, followed = self.context, self.context.filters.base
        library = context.columns.library
        responses = followed.sensitivities(library)
        for column, probe in enumerate(library.probes):
            if self._changes_geometry(probe):
                responses[..., column] = self._simulate_geometry(probe)
        target = context.evaluator.observed - self._base_simulation
        projected = self._project(np.concatenate([responses, target[..., None]], axis=3))
        products = np.einsum("rnk,rnl->rkl", projected, projected)
        contains = {
            name: effect.contains for name, effect in context.evaluator.available_effects.items()
        }
        return Regression(
            group_probes(library.probes),
            products[:, :-1, :-1],
            products[:, :-1, -1],
            products[:, -1, -1],
            int(followed.runs.recorded.sum()),
            contains,
        )

    def _changes_geometry(self, probe: CandidateDirection) -> bool:
        """Return whether a candidate moves the points at which wheels and feet touch."""
        effect = self.context.evaluator.available_effects[probe.effect]
        return any(
            not GEOMETRY_FIELDS.isdisjoint(MODEL_FIELD_EFFECTS[member.of or member.name].fields)
            for member in members_of(effect)
            if (member.of or member.name) in MODEL_FIELD_EFFECTS
        )

    def _simulate_geometry(self, probe: CandidateDirection) -> Array:
        """Return the response (R, T, C) to another geometry, per unit of the coefficient.

        It is a central difference of simulations that begin with settled contacts.

        Args:
            probe: candidate whose coefficient changes.
        """
        evaluator, theta = self.context.evaluator, self.context.filters.base.theta
        place = evaluator.get_coefficient_indices(probe.effect)[probe.coefficient_index]
        step = self._get_difference(place)
        simulated = []
        for sign in (1.0, -1.0):
            changed = theta.copy()
            changed[place] += sign * step
            simulated.append(self._simulate_settled(changed))
        response: Array = np.nan_to_num((simulated[0] - simulated[1]) / (2.0 * step))
        return response

    def _simulate_settled(self, theta: Array) -> Array:
        """Simulate all runs (R, T, C) from first states whose contacts are settled.

        Args:
            theta: (P,) parameters of the model.
        """
        followed = self.context.filters.base
        states = followed.settle(theta, followed.get_first_states(), is_other_geometry=True)
        return self._simulate(theta, states)

    @cached_property
    def _base_simulation(self) -> Array:
        """Simulation (R, T, C) of the base model."""
        followed = self.context.filters.base
        return self._simulate(followed.theta, followed.get_first_states())

    def _simulate(self, theta: Array, states: Array) -> Array:
        evaluator, runs = self.context.evaluator, len(states)
        return evaluator.simulate(np.tile(theta, (runs, 1)), np.arange(runs), states)

    def _project(self, values: Array) -> Array:
        """Return P v of (1), (R, n, K), for values v (R, T, C, K) of the readings.

        Unrecorded samples count as zero.
        """
        followed = self.context.filters.base
        runs, samples, channels, count = values.shape
        with np.errstate(all="ignore"):
            scaled = values / followed.noise.sigma[:, None]
        scaled[~followed.runs.recorded] = 0.0
        rows = np.zeros((runs, len(self._bases[0]), count))
        rows[:, : samples * channels] = scaled.reshape(runs, -1, count)
        projected: Array = np.array(
            [
                run_rows - basis @ (basis.T @ run_rows)
                for basis, run_rows in zip(self._bases, rows, strict=True)
            ]
        )
        return projected

    @cached_property
    def _bases(self) -> list[Array]:
        """Q of (1) for each run; the rows are readings, then the prior of first states."""
        followed = self.context.filters.base
        derivatives = followed.compute_state_sensitivities() / followed.noise.sigma[:, None]
        derivatives[~followed.runs.recorded] = 0.0
        prior = followed.get_state_prior()
        assert prior is not None
        size = derivatives.shape[3]
        return [
            np.linalg.qr(np.concatenate([rows.reshape(-1, size), np.diag(1.0 / prior)]))[0]
            for rows in derivatives
        ]
