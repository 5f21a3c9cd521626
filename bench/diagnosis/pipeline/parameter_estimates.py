"""Estimates of parameters and coefficients of a fitted model, with intervals and file values."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np

from bench.diagnosis.evaluation.parameter_bounds import bound_of, get_bounds_by_index, is_unusual
from bench.diagnosis.evaluation.time_scaled_ranges import is_instant
from bench.diagnosis.fitting.fitted_models import FittedModel
from bench.diagnosis.search.effect_search import EffectSearch
from bench.diagnosis.validation.confidence_intervals import compute_intervals
from sims.core.effect import Effect, members_of
from sims.extended_simulator import FittedValue
from sims.robot.fitted_causes import is_gravity_compensated


@dataclass(frozen=True, eq=False)
class ParameterEstimates:
    """Estimates of the parameters and coefficients of a fitted model.

    Attributes:
        search: Search that fitted the model.
        model: The model.
        is_finished: Whether the base model was fitted to the end.
    """

    search: EffectSearch
    model: FittedModel
    is_finished: bool = True

    @cached_property
    def values(self) -> dict[int, FittedValue]:
        """Estimates by index in the parameter vector, with 95 % intervals where the data give some.

        * Unfitted parameters, those at a bound of their range, and all of an unfinished fit have no
          interval.
        * An estimate outside its plausible range is marked with this range.
        * For a robot, the numbers of the model file and the resulting totals are added.
        """
        evaluator, model = self.search.evaluator, self.model
        intervals = compute_intervals(self.search, model)
        if not self.is_finished:
            # The curvature of an unfinished fit says nothing about the distance to its optimum.
            intervals = {i: (value, np.nan, np.nan) for i, (value, _, _) in intervals.items()}
        ranges = {i: evaluator.parameters[i].bounds for i in evaluator.base_indices.tolist()}
        ranges |= get_bounds_by_index(evaluator, model.effects)
        estimates = {}
        for index, parameter in enumerate(evaluator.parameters):
            # Insensitive parameters stay nominal; effects that are not in the model are zero.
            unfitted_estimate = float(model.fit.theta[index]), np.nan, np.nan
            value, low, high = intervals.get(index, unfitted_estimate)
            if is_instant(parameter):
                # The time of an event is only known to one sample spacing.
                half_interval = evaluator.sample_interval / 2
                low, high = low - half_interval, high + half_interval
            is_fitted = index in intervals
            # Which bound of its range a value is at: "low", "high" or None.
            at_bound = bound_of(value, *ranges[index]) if is_fitted else None
            # JSON has no number for an unknown bound; at a bound the curvature gives no interval.
            has_interval = np.isfinite(low) and np.isfinite(high) and at_bound is None
            plausible_range = self._get_plausible_range(index) if is_fitted else parameter.bounds
            # The time of an event has no plausible range: it may happen at any time.
            is_outside = not is_instant(parameter) and is_unusual(value, *plausible_range)
            estimates[index] = FittedValue(
                value,
                parameter.unit,
                low=low if has_interval else None,
                high=high if has_interval else None,
                at_bound=at_bound,
                usual_range=plausible_range if is_outside else None,
            )
        if evaluator.kind.has_model:
            self._add_totals(estimates)
        return estimates

    def _get_plausible_range(self, index: int) -> tuple[float, float]:
        """Return the plausible range of a parameter, by its index in the parameter vector.

        A robot's free number, a number of its model file that is fitted, may have wide bounds. If
        it has a range for training (`training`), that is the plausible one.

        Args:
            index: index in the parameter vector.
        """
        evaluator = self.search.evaluator
        parameter = evaluator.parameters[index]
        is_free = evaluator.kind.has_model and index in evaluator.base_indices
        return parameter.training or parameter.bounds if is_free else parameter.bounds

    def _add_totals(self, numbers: dict[int, FittedValue]) -> None:
        """Add to each fitted number of a robot the model file's value and the resulting value.

        An effect corrects a number of the file, for example by a share of the mass; readers need
        the corrected mass. Effects that change no number of the file, or change it by zero, remain
        as they are.

        Args:
            numbers: fitted numbers by index in the parameter vector; they are replaced.
        """
        kind: Any = self.search.evaluator.kind
        # This import is needed for robots only.
        from sims.robot.export.model_file_totals import compute_file_totals

        placed_effects = list(self._iterate_fitted_effects())
        fitted_effects = [
            (effect, [numbers[i].value for i in indices]) for effect, indices in placed_effects
        ]
        for (effect, indices), effect_totals in zip(
            placed_effects, compute_file_totals(kind.robot, fitted_effects), strict=True
        ):
            # The model file keeps its gravity if the bodies are gravity-compensated. The name of
            # the coefficient, here empty, does not matter.
            is_compensated = is_gravity_compensated(effect.name, {"": numbers[indices[0]]})
            # An effect whose coefficients are all zero changes nothing.
            if is_compensated or not any(numbers[i].value for i in indices):
                continue
            for i, number_total in zip(indices, effect_totals, strict=True):
                # The model file may have no number for a coefficient.
                if number_total is not None:
                    # The unit of the total is stated only if it differs from the estimate's.
                    unit = number_total.unit if number_total.unit != numbers[i].unit else ""
                    file_value, total = number_total.stated, number_total.total
                    numbers[i] = replace(
                        numbers[i], stated=file_value, total=total, total_unit=unit
                    )

    def _iterate_fitted_effects(self) -> Iterator[tuple[type[Effect], list[int]]]:
        """Yield each fitted effect at one place, with the indices of its coefficients in theta.

        These are the effects of the numbers that the user freed, then those of the model. An effect
        that acts at all places (a family) is divided into its members, one for each place.
        """
        evaluator, kind = self.search.evaluator, cast(Any, self.search.evaluator.kind)
        # The free numbers of the user come first in theta, in the order of their effects. The
        # iterator hands out the indices one after another.
        remaining_indices = iter(range(evaluator.system_parameter_count))
        for effect in kind.system.freed_effects:
            yield effect, [next(remaining_indices) for _ in effect.coefficients]
        for name in self.model.effects:
            members = members_of(evaluator.available_effects[name])
            indices = evaluator.get_coefficient_indices(name)
            # A family with one coefficient for all places changes no number of the file.
            if sum(len(member.coefficients) for member in members) != len(indices):
                continue
            remaining_indices = iter(indices)
            for member in members:
                yield type(member), [next(remaining_indices) for _ in member.coefficients]

    def select_coefficients(self, name: str) -> dict[str, FittedValue]:
        """Return the estimates of an effect by the names of its coefficients.

        Args:
            name: Name of the effect.
        """
        evaluator = self.search.evaluator
        coefficients = evaluator.available_effects[name].on(evaluator.simulator.system)
        indices = evaluator.get_coefficient_indices(name)
        return {c.name: self.values[i] for c, i in zip(coefficients, indices, strict=True)}
