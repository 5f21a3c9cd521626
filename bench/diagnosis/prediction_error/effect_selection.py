"""Select the effects that a robot's model lacks, with repeated fits of the process noise.

    1. Follow the runs with the model by a Kalman filter about the measured motion.
    2. Compute the response of the innovations to every candidate effect.
    3. Select effects by regression, whatever their number.
    4. Put them into the linear model, fit the process noise again, and continue with 3, because the
       innovations contain more information with less process noise.

(L. Ljung, System Identification, 2nd ed., 1999, chapters 3, 7 and 16.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.diagnosis.kalman.candidate_responses import Columns, FollowedRuns
from bench.diagnosis.prediction_error.regression_selection import (
    Regression,
    group_probes,
    list_columns,
)
from bench.diagnosis.search.explained_variance import DirectionGroup
from sims.core.simulator import Array

MAX_REGRESSIONS = 4
"""Maximum number of regressions, each with the process noise of the previous selection."""
MAX_SET_SIZE = 8
"""Maximum number of effects in a set."""


@dataclass(frozen=True)
class Selected:
    """The result of a selection.

    Attributes:
        groups: the selected groups of columns.
        coefficients: coefficients of each group, in units of the probes' coefficients.
        regression: the last regression.
        log_likelihood: log-likelihood of the innovations with the selected effects.
        followed: the runs, with the selected effects in the linear model.
        numerics: share of the integrator's step errors in the linear model.
        shows_steps: whether the innovations show these errors.
    """

    groups: Sequence[DirectionGroup]
    coefficients: Sequence[Array]
    regression: Regression
    log_likelihood: float
    followed: FollowedRuns
    numerics: float
    shows_steps: bool

    @property
    def effects(self) -> list[str]:
        """Names of the selected effects."""
        return [group.effect for group in self.groups]


def shows_step_errors(followed: FollowedRuns) -> bool:
    """Return whether the innovations show the errors of the integrator's steps.

    They do if the recorded motion is one of continuous time, and do not if the engine generated it.
    """
    return regress(followed, followed.columns([])).shows_nuisance([])


def identify(followed: FollowedRuns, columns: Columns, first: Regression | None = None) -> Selected:
    """Select effects, with the process noise fitted again after each selection.

    Args:
        followed: the runs, without any effect.
        columns: inputs of the candidates.
        first: regression of these runs on the columns, if it is known.
    """
    refitted, selected_before = followed, list[DirectionGroup]()
    coefficients: list[Array] = []
    result: Selected | None = None
    numerics = 0.0
    for _ in range(MAX_REGRESSIONS):
        regression = first or regress(refitted, columns, selected_before, coefficients, numerics)
        first = None
        selected = regression.prune(selected_before) if selected_before else []
        selected = regression.select(MAX_SET_SIZE, selected)
        _, new_coefficients = regression.solve(selected)
        numerics = regression.nuisance(selected)
        refitted = follow_linear_with_effects(
            followed, columns, selected, new_coefficients, numerics
        )
        likelihood = refitted.log_likelihood
        has_converged = result is not None and likelihood < result.log_likelihood + 1.0
        if result is None or likelihood > result.log_likelihood:
            result = Selected(
                selected,
                new_coefficients,
                regression,
                likelihood,
                refitted,
                numerics,
                regression.shows_nuisance(selected),
            )
        if has_converged:
            break
        selected_before, coefficients = selected, new_coefficients
    assert result is not None
    return result


def regress(
    followed: FollowedRuns,
    columns: Columns,
    chosen: Sequence[DirectionGroup] = (),
    coefficients: Sequence[Array] = (),
    numerics: float = 0.0,
    always: Sequence[int] = (),
) -> Regression:
    """Set up the regression of all that effects explain, including those in the linear model.

    Args:
        followed: the runs, filtered with the chosen effects in the linear model.
        columns: inputs of the candidates.
        chosen: the effects in the linear model.
        coefficients: coefficients of these effects.
        numerics: share of the integrator's errors that is in the linear model.
        always: indices of probes that are part of every set, and are not candidates.
    """
    responses = followed.responses(columns)
    run_count, _, _, count = responses.shape
    nuisance = followed.step_error_response()
    own_columns = list_columns(chosen)
    weights = np.concatenate([*coefficients, np.zeros(0)])
    grams = np.zeros((run_count, count + 1, count + 1))
    crosses, totals = np.zeros((run_count, count + 1)), np.zeros(run_count)
    for run in range(run_count):
        target = followed.filtered.whitened[run].reshape(-1)
        rows = responses[run].reshape(target.size, count).astype(np.float64)
        rows = np.concatenate([rows, nuisance[run].reshape(-1, 1)], axis=1)
        target = target + rows[:, own_columns] @ weights + numerics * rows[:, -1]
        grams[run] = rows.T @ rows
        crosses[run] = rows.T @ target
        totals[run] = target @ target
    contains = {
        name: effect.contains for name, effect in followed.evaluator.available_effects.items()
    }
    groups = [g for g in group_probes(columns.probes) if not set(g.column_indices) & set(always)]
    samples = int(followed.runs.recorded.sum())
    return Regression(groups, grams, crosses, totals, samples, contains, (count, *always))


def follow_linear_with_effects(
    followed: FollowedRuns,
    columns: Columns,
    chosen: Sequence[DirectionGroup],
    coefficients: Sequence[Array],
    numerics: float,
) -> FollowedRuns:
    """Put effects into the linear model, and fit the process noise again.

    Args:
        followed: the runs, without any effect.
        columns: inputs of the candidates.
        chosen: groups of columns of the effects.
        coefficients: coefficients of each group.
        numerics: share of the integrator's errors to put into the linear model.
    """
    own_columns = [c for group in chosen for c in group.column_indices]
    runs = followed.runs
    defects, residuals = runs.defects - numerics * runs.step_errors, runs.residuals
    if own_columns:
        pushed, readings = columns.total(own_columns, np.concatenate(list(coefficients)))
        defects = defects - np.einsum("rtze,rte->rtz", runs.inputs, pushed)
        residuals = np.where(runs.recorded, residuals - readings, 0.0)
    return followed.refit_noise(replace(runs, defects=defects, residuals=residuals))
