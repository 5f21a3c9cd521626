"""Columns of the regressions: inputs that effects add to the states and readings of a filter.

There are columns for library effects, for forces of any shape, and for effects that are already in
the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.parameter_bounds import (
    clip_coefficients,
    compute_coefficient_bounds,
)
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.fitted_models import FittedModel
from bench.diagnosis.fitting.levenberg_marquardt import FitStart, KnownJacobian
from bench.diagnosis.fitting.trajectory_derivatives import CandidateDirection
from bench.diagnosis.kalman.candidate_responses import (
    Columns,
    compute_columns,
    compute_sensitivities,
)
from bench.diagnosis.kalman.linearised_filter import FollowedRuns
from bench.diagnosis.prediction_error.effects_at_joints import acts_at_joint, has_many_shapes
from bench.diagnosis.prediction_error.filters_with_effects import FilteredSet, ModelFilters
from bench.diagnosis.prediction_error.regression_selection import (
    Regression,
    Selected,
    identify,
    regress,
)
from bench.diagnosis.search.candidate_directions import list_probes
from bench.diagnosis.search.lack_of_fit import JointHatForce, list_hat_probes
from bench.diagnosis.search.score_test import DirectionGroup
from sims.core.simulator import Array

RELATIVE_DIFFERENCE = 0.02
"""Finite-difference step of a coefficient, as a share of the coefficient."""


class ModelRegression(NamedTuple):
    """A regression with effects in the model.

    Attributes:
        regression: regression of the innovations on the candidates.
        own: columns of each effect in the model, by name, which are part of every set; the first
            column is its whole change.
    """

    regression: Regression
    own: dict[str, list[int]]


@dataclass
class LibraryColumns:
    """The columns of a search, about the smoothed motion of the base model's filter.

    Attributes:
        filters: the filters of the search.
    """

    filters: ModelFilters
    _library: Columns | None = None
    _base_regression: tuple[Columns, Regression] | None = None
    _hats: Columns | None = None
    _newest_regression: tuple[FittedModel, ModelRegression] | None = None

    @property
    def library(self) -> Columns:
        """Candidates of the library: effects with few shapes, and those that were added."""
        if self._library is None:
            evaluator = self.filters.evaluator
            names = [name for name in evaluator.library if not has_many_shapes(name)]
            evaluator.search_control.begin_stage(f"testing {len(names)} effects", 1)
            self._library = compute_columns(self.filters.base, self.probes(names))
        return self._library

    @property
    def base_regression(self) -> Regression:
        """Regression of the innovations of the base model on the candidates of the library."""
        library = self.library
        if self._base_regression is None or self._base_regression[0] is not library:
            self._base_regression = library, regress(self.filters.base, [library])
        return self._base_regression[1]

    @property
    def known_base_regression(self) -> Regression | None:
        """The last regression of the innovations of the base model; None if there was none."""
        return self._base_regression[1] if self._base_regression else None

    @property
    def hats(self) -> Columns:
        """Forces of any shape as candidates: triangular functions ("hats") of one signal.

        The hats of a family cover the range of one signal. The label of the family takes the place
        of the effect's name.
        """
        if self._hats is None:
            probes, _ = list_hat_probes(self.filters.evaluator)
            # All hats are simulated by one effect; the labels of the families replace its name.
            named = [replace(probe, effect=JointHatForce.name) for probe in probes]
            self._hats = replace(compute_columns(self.filters.base, named), probes=tuple(probes))
        return self._hats

    def take_over(self, other: LibraryColumns) -> None:
        """Reuse the columns of another search of the same runs."""
        self._library, self._hats = other._library, other._hats
        self._base_regression = other._base_regression

    def add(self, names: Sequence[str]) -> None:
        """Add effects to the candidates of the library."""
        self._library = self.library.joined(compute_columns(self.filters.base, self.probes(names)))

    def probes(self, names: Sequence[str]) -> list[CandidateDirection]:
        """Return small trial coefficients (probes) of effects; their responses are regressors."""
        model = self.filters.models.base_model
        return list_probes(self.filters.evaluator, model.effects, names)

    def select(self) -> Selected:
        """Select effects of the library by regression."""
        library = self.library
        self.filters.evaluator.search_control.begin_stage("selecting effects", 1)
        selected = identify(self.filters.base, library, self.base_regression)
        self.filters.numerics = selected.numerics
        return selected

    def select_with_shapes(self, selected: Selected) -> Selected:
        """Select again with effects of many shapes, at the joints where a force is missing.

        A force is missing at a joint if the filter needs process noise there. These effects, such
        as forces of any period, are many and slow to test, so they are left out of the first
        selection.

        Args:
            selected: the first selection.

        Returns:
            The new selection; the first one if the library has no such effects at these joints.
        """
        evaluator, missing_forces = self.filters.evaluator, selected.followed.missing_forces
        # A selection that leaves no force missing but does not explain simulated runs is wrong.
        if not missing_forces.any():
            missing_forces = self.filters.base.missing_forces
        joints = np.flatnonzero(missing_forces).tolist()
        effects_with_shapes = [
            name
            for name in evaluator.library
            if has_many_shapes(name) and acts_at_joint(evaluator, name, joints)
        ]
        if not effects_with_shapes:
            return selected
        evaluator.search_control.begin_stage(
            f"testing {len(effects_with_shapes)} effects with several coefficients", 1
        )
        self.add(effects_with_shapes)
        return self.select()

    def start(self, groups: Sequence[DirectionGroup], coefficients: Sequence[Array]) -> FitStart:
        """Return the start of a fit with effects at the coefficients of a regression.

        All other parameters are those without any effect; first states are those of the base model.

        Args:
            groups: columns of the regression for each effect.
            coefficients: regression coefficients of these columns, for each group.
        """
        theta, base = self.filters.reference.copy(), self.filters.models.base_model
        for group, solution in zip(groups, coefficients, strict=True):
            theta[self.filters.evaluator.coefficient_slices[group.effect]] = self.coefficients(
                group, solution
            )
        return FitStart(tuple(group.effect for group in groups), theta, base.fit.initial_states)

    def coefficients(self, group: DirectionGroup, solution: Array) -> Array:
        """Return the coefficients (k,) of an effect from the regression.

        Args:
            group: columns of the effect.
            solution: regression coefficients of these columns.
        """
        return group_coefficients(self.filters.evaluator, self.library.probes, group, solution)

    def solve_alone(self, regression: Regression, group: DirectionGroup) -> Array:
        """Return the coefficients (k,) of an effect that a regression fits alone.

        Args:
            regression: regression of innovations on columns of the library.
            group: columns of the effect.
        """
        (solution,) = regression.solve([group]).coefficients
        return self.coefficients(group, solution)

    def regression(self, model: FittedModel) -> ModelRegression:
        """Return the regression with the effects of a fitted model in the filter's model.

        The candidates are the library and forces of any shape. The derivatives by the coefficients
        of the model are part of every set, so that a regression about nearly the same coefficients
        gives the same gains to first order. The newest regression is therefore reused for the same
        effects if no parameter differs by more than the share `RELATIVE_DIFFERENCE`.

        Args:
            model: the fitted model.
        """
        if self._newest_regression is not None:
            known, regression = self._newest_regression
            if _has_similar_parameters(model, known):
                return regression
        # A regression is large, so the last one is released before the next one is made.
        self._newest_regression = None
        current = FilteredSet(self.filters.get_filter(model), model.effects)
        regression = build_regression_about(current, [self.library, self.hats], self.filters.base)
        self._newest_regression = model, regression
        return regression

    def release_regressions(self) -> None:
        """Release the memory of the regressions; `known_base_regression` is None afterwards."""
        self._newest_regression = self._base_regression = None

    def sensitivities(self, start: FitStart) -> KnownJacobian:
        """Return the derivatives of the runs by the coefficients of a model's effects.

        Each effect is simulated in the linear model as it is, and with one coefficient displaced at
        a time. The derivative is the difference of the two responses divided by the displacement.
        Responses are about the measured motion.

        Args:
            start: the model, with the coefficients at which derivatives are taken.
        """
        evaluator, followed = self.filters.evaluator, self.filters.base
        tangents = [_make_tangent_probes(evaluator, name, start.theta) for name in start.effects]
        columns = compute_columns(
            followed, [probe for effect_probes in tangents for probe in effect_probes]
        )
        responses = compute_sensitivities(followed, columns)
        # The columns of an effect begin with the effect as it is.
        # `first_column` is the column of this response.
        indices, derivatives, first_column = list[int](), [], 0
        for name, (whole_change, *displaced) in zip(start.effects, tangents, strict=True):
            for k, probe in enumerate(displaced):
                # A coefficient whose bounds are equal is not displaced; its derivative is zero.
                step = float(probe.coefficients[k] - whole_change.coefficients[k]) or np.inf
                change = responses[..., first_column + 1 + k] - responses[..., first_column]
                derivatives.append(change / step)
            indices += evaluator.get_coefficient_indices(name)
            first_column += 1 + len(displaced)
        return KnownJacobian(np.array(indices, dtype=np.intp), np.stack(derivatives, axis=-1))


def _has_similar_parameters(model: FittedModel, other: FittedModel) -> bool:
    """Return whether two models have the same effects and nearly the same parameters."""
    theta, other_theta = model.fit.theta, other.fit.theta
    is_similar = np.abs(theta - other_theta) <= RELATIVE_DIFFERENCE * np.abs(other_theta)
    return model.effects == other.effects and bool(is_similar.all())


def group_coefficients(
    evaluator: RunEvaluator,
    probes: Sequence[CandidateDirection],
    group: DirectionGroup,
    solution: Array,
) -> Array:
    """Return the coefficients (k,) of an effect from the regression, within their bounds.

    The regression gives one factor for each column, which is the response to one probe: trial
    coefficients of the effect.

    - Most effects are linear in one or more coefficients, which these factors are. The others, such
      as a period, are those of the probe.
    - An effect that is valid only at the size of its probe keeps the coefficients of the probe.
    - An effect with probe points is not linear in its coefficients. It combines the points of its
      probes, weighted by the factors.

    Args:
        evaluator: the runs.
        probes: probes of all columns of the regression.
        group: columns of the effect, as indices into `probes`.
        solution: regression coefficients of these columns.
    """
    effect = evaluator.available_effects[group.effect]
    group_probes = [probes[i] for i in group.column_indices]
    if effect.probe_points():
        sizes = np.array([probe.coefficients[probe.coefficient_index] for probe in group_probes])
        points = np.array([probe.coefficients for probe in group_probes])
        return clip_coefficients(evaluator, group.effect, effect.combine(points, solution / sizes))
    coefficients = group_probes[0].coefficients.copy()
    for column, value in zip(group.column_indices, solution, strict=True):
        if not probes[column].is_single_size:
            coefficients[probes[column].coefficient_index] = value
    return clip_coefficients(evaluator, group.effect, coefficients)


def build_regression_about(
    current: FilteredSet, columns: Sequence[Columns], followed: FollowedRuns
) -> ModelRegression:
    """Set up the regression of innovations on candidates, with effects in the filter's model.

    The columns of the effects that are in the model, as they are and with each coefficient
    displaced, are added after those of the candidates and are part of every set. So a candidate
    gains only by what a change of the present coefficients cannot explain.

    Args:
        current: the runs, filtered with these effects.
        columns: inputs of the candidates, in one or more parts.
        followed: filtered runs about whose motion the effects are linearised.

    Returns:
        The regression, and the indices of the columns of each effect in the model, by name.
    """
    own_columns: dict[str, list[int]] = {}
    probes: list[CandidateDirection] = []
    # Number of columns of the candidates.
    count = sum(len(part.probes) for part in columns)
    for name in current.names:
        tangents = _make_tangent_probes(followed.evaluator, name, current.followed.theta)
        first_column = count + len(probes)
        own_columns[name] = list(range(first_column, first_column + len(tangents)))
        probes += tangents
    parts = [*columns, compute_columns(followed, probes)] if probes else columns
    always = range(count, count + len(probes))
    return ModelRegression(regress(current.followed, parts, always=always), own_columns)


def _make_tangent_probes(
    evaluator: RunEvaluator, name: str, theta: Array
) -> list[CandidateDirection]:
    """Return probes for an effect of the model: as it is, and with each coefficient displaced.

    The first shows the whole change by the effect; the differences of the others from it show the
    derivatives by the coefficients. A displacement is a small share of the coefficient, or of its
    range if the coefficient is small; it goes downwards at the upper bound.

    Args:
        evaluator: the runs.
        name: name of the effect.
        theta: (P,) parameters of the model, with its coefficients.
    """
    coefficients = theta[evaluator.coefficient_slices[name]]
    # A single size: the response is not divided by the coefficient. Each probe has a grid point of
    # its own, here 0 and below 1, 2, ..., so that they form no group.
    probes = [
        CandidateDirection(name, 0, 0, coefficients, can_be_negative=True, is_single_size=True)
    ]
    for index, (low, high) in enumerate(compute_coefficient_bounds(evaluator, name)):
        displaced = coefficients.copy()
        size = max(abs(float(coefficients[index])), RELATIVE_DIFFERENCE * (high - low))
        step = RELATIVE_DIFFERENCE * size
        displaced[index] += step if displaced[index] + step <= high else -step
        probes.append(
            CandidateDirection(
                name, 1 + index, index, displaced, can_be_negative=True, is_single_size=True
            )
        )
    return probes
