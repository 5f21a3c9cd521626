"""Score single effects of a robot on the ground by the residual of its simulated pieces.

Where wheels and feet lift off and land, a Kalman filter needs much process noise, which hides most
of what an effect does to the following samples. The pieces are short, so that a simulation of the
base model stays near the recording (output error; L. Ljung, System Identification, 2nd ed., 1999,
section 7.2). With the residual r of the simulation and the responses s_k of the candidates, both in
units of the noise, and the projection P of `settled_simulations` on what no first state explains,

    minimise |P (r - sum_k c_k s_k)|^2                                                         (1)

A larger wheel or foot raises the body, and rolls farther per turn, v = omega r. A linear response
begins with the wheel inside the floor and is that of a jump. So the response to another geometry is
a difference of simulations, each from first states whose contacts are settled for its geometry.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bench.diagnosis.fitting.fitted_models import FittedModel, select_likeliest
from bench.diagnosis.fitting.levenberg_marquardt import FitStart
from bench.diagnosis.fitting.trajectory_derivatives import CandidateDirection
from bench.diagnosis.kalman.candidate_responses import compute_sensitivities
from bench.diagnosis.prediction_error.effect_proposals import SearchContext
from bench.diagnosis.prediction_error.regression_products import GramMatrices
from bench.diagnosis.prediction_error.regression_selection import Regression
from bench.diagnosis.prediction_error.settled_simulations import SettledSimulations
from bench.diagnosis.prediction_error.simulated_fits import (
    fit_by_simulation,
    is_explained,
    remove_idle_effects,
)
from bench.diagnosis.search.score_test import group_probes
from sims.core.effect import members_of
from sims.core.simulator import Array
from sims.robot.model_field_effects import MODEL_FIELD_EFFECTS

GEOMETRY_FIELDS = frozenset({"geom_size", "body_pos"})
"""Fields of a model that move the points at which wheels and feet touch."""
MAX_SIMULATED = 8
"""Maximum number of effects that are simulated with their regression coefficients."""
MAX_REFINED = 5
"""Maximum number of effects whose coefficients are refined before any is fitted."""
MAX_FITTED = 3
"""Maximum number of effects that are fitted by simulation."""


def fit_best_scored(scores: OutputErrorScores) -> FittedModel:
    """Fit the single effects that explain most of the simulation residual, one after another.

    Coefficients of the best effects are refined first. The fits end with the first model that
    explains the runs, from which needless effects are removed.

    Args:
        scores: scores of the effects of a robot on the ground.

    Returns:
        The best model, which may be the base model.
    """
    context = scores.context
    best = context.search.base_model
    search_control = context.evaluator.search_control
    # Refining costs a tenth of a fit, and a better order saves whole fits.
    simulations = scores.simulations
    starts = [simulations.refine(start) for start in scores.list_starts()[:MAX_REFINED]]
    starts.sort(key=lambda start: simulations.compute_cost(start.theta))
    for start in starts[:MAX_FITTED]:
        fitted = fit_by_simulation(context, start)
        if np.isfinite(fitted.fit.cost):
            best = select_likeliest(best, fitted)
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

    @cached_property
    def simulations(self) -> SettledSimulations:
        """Simulations from the first states of the base model."""
        base = self.context.filters.base
        return SettledSimulations(base.first_state_fitter, base.get_first_states())

    def list_starts(self) -> list[FitStart]:
        """Return starts with one effect each, the one with the smallest residual first.

        The effects that gain most by regression are simulated with their coefficients from it,
        because a response is linear only for small coefficients. Effects whose gain does not exceed
        their minimum gain (`price`) are left out.
        """
        regression, starts = self.regression, dict[str, FitStart]()
        net_gains = regression.compute_net_gains()
        for i in np.argsort(-net_gains, kind="stable").tolist():
            # One shape of an effect; the best shape of each effect comes first.
            group = regression.groups[i]
            if net_gains[i] <= 0.0 or len(starts) == MAX_SIMULATED:
                break
            if group.effect not in starts:
                coefficients = regression.solve([group]).coefficients
                starts[group.effect] = self.context.columns.start([group], coefficients)
        costs = [self.simulations.compute_cost(start.theta) for start in starts.values()]
        ordered = list(starts.values())
        return [ordered[i] for i in np.argsort(costs, kind="stable").tolist()]

    @property
    def known_regression(self) -> Regression | None:
        """The regression if it was computed."""
        return self.__dict__.get("regression")

    @cached_property
    def regression(self) -> Regression:
        """Regression (1) of the residual of the base model on the candidates of the library.

        Responses to candidates that change the geometry of wheels or feet are simulated; the others
        are linear. What first states explain is projected out of all of them.
        """
        context, followed = self.context, self.context.filters.base
        library = context.columns.library
        # Responses (R, T, C, K) of K candidates.
        responses = compute_sensitivities(followed, library)
        for column, probe in enumerate(library.probes):
            if self._changes_geometry(probe):
                responses[..., column] = self._simulate_geometry(probe)
        fitter = followed.first_state_fitter
        target = fitter.simulate_residuals(followed.theta, followed.get_first_states())
        projected = self.simulations.project(
            np.concatenate([fitter.scale_by_noise(responses), target[..., None]], axis=3)
        )
        # Inner products (R, K + 1, K + 1) of all columns in each piece; the last column is the
        # residual.
        products = projected.transpose(0, 2, 1) @ projected
        contains = {
            name: effect.contains for name, effect in context.evaluator.available_effects.items()
        }
        return Regression(
            group_probes(library.probes),
            GramMatrices(products[:, :-1, :-1], products[:, :-1, -1], products[:, -1, -1]),
            int(followed.runs.recorded.sum()),
            contains,
        )

    def _changes_geometry(self, probe: CandidateDirection) -> bool:
        """Return whether a candidate moves the points at which wheels and feet touch.

        It does if a member of its effect writes one of the fields `GEOMETRY_FIELDS` of the model.
        """
        effect = self.context.evaluator.available_effects[probe.effect]
        laws = [member.of or member.name for member in members_of(effect)]
        return any(
            not GEOMETRY_FIELDS.isdisjoint(MODEL_FIELD_EFFECTS[law].fields)
            for law in laws
            if law in MODEL_FIELD_EFFECTS
        )

    def _simulate_geometry(self, probe: CandidateDirection) -> Array:
        """Return the response of the readings to another geometry, per unit of the coefficient.

        It is a central difference of simulations, each from first states whose contacts are in
        equilibrium for its geometry. A reading that diverges has no response.

        Args:
            probe: candidate whose coefficient changes.

        Returns:
            Derivatives (R, T, C) for T samples of C channels in R pieces, in the unit of each
            channel per unit of the coefficient.
        """
        evaluator, theta = self.context.evaluator, self.context.filters.base.theta
        # Index of the coefficient in theta, and its finite change.
        index = evaluator.get_coefficient_indices(probe.effect)[probe.coefficient_index]
        step = self.simulations.get_difference(index)
        simulated = []
        for change in (step, -step):
            changed = theta.copy()
            changed[index] += change
            simulated.append(self.simulations.simulate_settled(changed))
        increased, decreased = simulated
        response: Array = np.nan_to_num((increased - decreased) / (2.0 * step))
        return response
