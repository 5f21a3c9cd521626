"""Build the verdict from a finding: intervals, held-out gain and ranked candidates."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import astuple, dataclass, replace
from typing import Any, cast

import numpy as np

from bench.core.random_streams import make_rng
from bench.diagnosis.evaluation.coefficient_bounds import (
    bound_of,
    get_bounds_by_index,
    is_unusual,
)
from bench.diagnosis.evaluation.run_data import is_instant
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.experiment_design.discriminating_run import (
    DiscriminatingRun,
    propose_discriminating_run,
)
from bench.diagnosis.fitting.fitted_models import EffectNames, FittedModel
from bench.diagnosis.friction_form_verdict import add_solver_parameters, get_friction_form
from bench.diagnosis.pipeline.search_result import SearchResult
from bench.diagnosis.search import verdict_rules
from bench.diagnosis.search.alternative_causes import CauseEvidence
from bench.diagnosis.search.diagnose import DiagnosisResult
from bench.diagnosis.search.score_test import estimate_tail_p_value
from bench.diagnosis.validation.gain_and_intervals import (
    HeldOutGain,
    compute_held_out_gain,
    compute_intervals,
)
from bench.diagnosis.verdict import Candidate, Cause, HeldOutResult, Verdict, to_finite_or_none
from sims.core.effect import Effect, members_of
from sims.core.simulator import Array
from sims.extended_simulator import FittedValue
from sims.robot.fitted_causes import GRAVITY_COMPENSATED, is_gravity_compensated

MIN_REPORTED_GAIN = -9.0
"""Lower limit of a candidate's reported share of the held-out gap; it only means "worse"."""


@dataclass(frozen=True)
class VerdictBuilder:
    """Builds the verdict and its numbers from the result of a search.

    Attributes:
        result: Result of the search.
    """

    result: SearchResult

    @property
    def _evaluator(self) -> RunEvaluator:
        """Run evaluator of the runs for fitting."""
        return self.result.runs.fitting

    def build_verdict(self) -> Verdict:
        """Build the verdict."""
        result, runs, evaluator = self.result, self.result.runs, self._evaluator
        finding = result.finding
        numbers = self.collect_parameter_estimates(finding.model)
        causes = self.build_causes()
        parameters = {
            evaluator.parameters[i].name: numbers[i] for i in evaluator.base_indices.tolist()
        }
        # Simulations for the proposal of an experiment are not part of the answer.
        simulations = evaluator.simulation_count
        if runs.validation is not None:
            simulations += runs.validation.simulations
        heldout = self._measure_held_out_gain()
        candidates = self._list_candidates()
        next_run = self._propose_next_run()
        return Verdict(
            finding.verdict,
            runs.recording.system,
            runs.engine or "its own",
            causes,
            parameters,
            heldout,
            candidates,
            next_run,
            int(simulations),
            time.perf_counter() - runs.context.started,
            finding.early_stop,
            recording_faults=result.errors,
            recording_notes=runs.recording.notes,
        )

    def build_causes(self) -> tuple[Cause, ...]:
        """Build the causes of the verdict: those found, with values and intervals of coefficients.

        Returns:
            One `Cause` of the verdict for each cause found, in the same order.
        """
        numbers = self.collect_parameter_estimates(self.result.finding.model)
        return tuple(self._build_cause(cause, numbers) for cause in self.result.finding.causes)

    def collect_parameter_estimates(self, model: FittedModel) -> dict[int, FittedValue]:
        """Collect the estimates of all parameters and coefficients by index.

        Args:
            model: Fitted model of the search.

        Returns:
            Estimates by index in the parameter vector; those that were not fitted, or not to the
            end, have no interval.
        """
        intervals = compute_intervals(self.result.search, model)
        early_stop = self.result.finding.early_stop
        if early_stop is not None and "base_fit" in early_stop.skipped_questions:
            # The curvature of an unfinished fit says nothing about the distance to its optimum.
            intervals = {i: (value, np.nan, np.nan) for i, (value, _, _) in intervals.items()}
        ranges = self._get_bounds(model)
        estimates = {}
        for index, parameter in enumerate(self._evaluator.parameters):
            # Insensitive parameters stay nominal; effects that are not in the model are zero.
            unfitted_estimate = float(model.fit.theta[index]), np.nan, np.nan
            value, low, high = intervals.get(index, unfitted_estimate)
            if is_instant(parameter):
                # The time of an event is only known to one sample spacing.
                low, high = (
                    low - self._evaluator.sample_interval / 2,
                    high + self._evaluator.sample_interval / 2,
                )
            at_bound = bound_of(value, *ranges[index]) if index in intervals else None
            # JSON has no number for an unknown bound; at a bound the curvature gives no interval.
            is_bounded = np.isfinite(low) and np.isfinite(high) and at_bound is None
            interval = (low, high) if is_bounded else (None, None)
            plausible_range = (
                self._get_plausible_range(index) if index in intervals else parameter.bounds
            )
            exceeded_range = (
                plausible_range
                if not is_instant(parameter) and is_unusual(value, *plausible_range)
                else None
            )
            unit = parameter.unit
            low_end, high_end = interval
            estimates[index] = FittedValue(
                value, unit, low_end, high_end, at_bound, usual_range=exceeded_range
            )
        return self._add_totals(model, estimates)

    def _get_plausible_range(self, index: int) -> tuple[float, float]:
        """Return the plausible range, narrower than the bounds for a robot's free numbers."""
        parameter = self._evaluator.parameters[index]
        is_free = self._evaluator.kind.has_model and index in self._evaluator.base_indices
        return parameter.training or parameter.bounds if is_free else parameter.bounds

    def _add_totals(
        self, model: FittedModel, numbers: dict[int, FittedValue]
    ) -> dict[int, FittedValue]:
        """Add to each fitted number of a robot the model file's value and the resulting value.

        Numbers of effects that change no number of the file remain as they are. `numbers` is by
        index in the parameter vector.
        """
        kind: Any = self._evaluator.kind
        if not kind.has_model:
            return numbers
        # This import is needed for robots only.
        from sims.robot.export.model_file_totals import compute_file_totals

        placed_effects = list(self._iterate_fitted_effects(model))
        fitted_effects = [
            (effect, [numbers[i].value for i in indices]) for effect, indices in placed_effects
        ]
        for (effect, indices), effect_totals in zip(
            placed_effects, compute_file_totals(kind.robot, fitted_effects), strict=True
        ):
            # The model file keeps its gravity if the bodies are gravity-compensated.
            is_compensated = is_gravity_compensated(effect.name, {"": numbers[indices[0]]})
            if is_compensated or not any(numbers[i].value for i in indices):
                continue
            for i, number_total in zip(indices, effect_totals, strict=True):
                if number_total is not None:
                    unit = number_total.unit if number_total.unit != numbers[i].unit else ""
                    file_value, total = number_total.stated, number_total.total
                    numbers[i] = replace(
                        numbers[i], stated=file_value, total=total, total_unit=unit
                    )
        return numbers

    def _iterate_fitted_effects(
        self, model: FittedModel
    ) -> Iterator[tuple[type[Effect], list[int]]]:
        """Yield each fitted effect at one place, with the indices of its coefficients in theta.

        An effect that acts at all places is divided into its members.
        """
        evaluator, kind = self._evaluator, cast(Any, self._evaluator.kind)
        # The free numbers of the user come first, in the order of their effects.
        indices = iter(range(evaluator.system_parameter_count))
        for effect in kind.system.freed_effects:
            yield effect, [next(indices) for _ in effect.coefficients]
        for name in model.effects:
            effect = evaluator.available_effects[name]
            members = members_of(effect)
            indices = iter(evaluator.get_coefficient_indices(name))
            # A family with one coefficient for all places changes no number of the file.
            if sum(len(member.coefficients) for member in members) == len(
                evaluator.get_coefficient_indices(name)
            ):
                for member in members:
                    yield type(member), [next(indices) for _ in member.coefficients]

    def _get_bounds(self, model: FittedModel) -> dict[int, tuple[float, float]]:
        """Return the bounds of each fitted number, by index in the parameter vector."""
        evaluator = self._evaluator
        ranges = {i: evaluator.parameters[i].bounds for i in evaluator.base_indices.tolist()}
        return ranges | get_bounds_by_index(evaluator, model.effects)

    def restrict_verdict(self) -> DiagnosisResult:
        """Return the finding with the verdict that its numbers and the fitted models allow."""
        finding = self.result.finding
        if finding.verdict == "unknown" and self._is_refuted():
            return replace(finding, verdict="adequate")
        estimates = self.collect_parameter_estimates(finding.model)
        unambiguous_causes = [cause for cause in finding.causes if not cause.alternatives]
        coefficient_indices = [
            i
            for cause in unambiguous_causes
            for i in self._evaluator.get_coefficient_indices(cause.effect)
        ]
        are_results = all(
            estimates[i].is_result for i in coefficient_indices
        ) and not self._is_at_bound(estimates)
        return replace(
            finding, verdict=verdict_rules.verdict_of_numbers(finding.verdict, are_results)
        )

    def _is_refuted(self) -> bool:
        """Return whether fitted models refute a missing effect that only the linear score suggests.

        This is so if no fitted model with effects has a higher penalised log-likelihood than the
        base model, or none predicts the held-out runs better. In closed loops and at rest,
        derivatives may predict a gain that no fit achieves.
        """
        search, finding = self.result.search, self.result.finding
        if finding.causes or finding.lack_of_fit.has_structure or finding.early_stop is not None:
            return False
        extended_models = [model for model in search.models.values() if model.effects]
        better_effects = [
            model.effects
            for model in extended_models
            if model.penalised_log_likelihood > search.base_model.penalised_log_likelihood
        ]
        held_out = finding.held_out_fits or {}
        excess = self._compute_held_out_excess()
        if not extended_models or (
            excess is not None and verdict_rules.misses_held_out_gap(excess, excess)
        ):
            return False
        return not any(
            names not in held_out
            or held_out[names].penalised_log_likelihood > held_out[()].penalised_log_likelihood
            for names in better_effects
        )

    def _compute_held_out_excess(self) -> float | None:
        """Return the excess RMS residual of the base model on held-out runs; None without them."""
        runs, held_out_fits = self.result.runs.predicted, self.result.finding.held_out_fits
        if runs is None or held_out_fits is None or () not in held_out_fits:
            return None
        sigma = self.result.runs.floor.sigma
        normalised_residual = (runs.observed - held_out_fits[()].simulated) / sigma
        return (
            float(np.sqrt(np.square(normalised_residual[np.isfinite(runs.observed)]).mean())) - 1.0
        )

    def _is_at_bound(self, numbers: Mapping[int, FittedValue]) -> bool:
        """Return whether a base parameter of the extended model is at a bound of its range.

        A cause may then compensate for a value beyond the bound.
        """
        base_estimates = [numbers[i] for i in self._evaluator.base_indices.tolist()]
        return any(n.at_bound is not None and not n.is_result for n in base_estimates)

    def estimate_noise_sigma(self) -> Array:
        """Return the noise floor (C,).

        It is the specified noise, or else the residual of a model without lack of fit.
        """
        finding, floor = self.result.finding, self.result.runs.floor
        residual_sigma = finding.model.likelihood.sigma
        # The noise estimate assumes white noise, so the residual of a good model may exceed it.
        is_usable = ~floor.is_stated & np.isfinite(residual_sigma) & (residual_sigma > floor.sigma)
        has_no_structure = not finding.lack_of_fit.has_structure
        return np.where(is_usable & has_no_structure, residual_sigma, floor.sigma)

    def _build_cause(self, evidence: CauseEvidence, numbers: dict[int, FittedValue]) -> Cause:
        """Build a cause of the verdict from an effect found by the search.

        Its description names the soft form of dry friction (MuJoCo's `frictionloss`) with the
        solver parameters if the friction has it.

        Args:
            evidence: the effect and its evidence.
            numbers: fitted values by their index in the parameter vector.
        """
        evaluator = self._evaluator
        effect = evaluator.available_effects[evidence.effect]
        # A coefficient that cannot be observed is fixed at zero and is not a result.
        coefficients = effect.on(evaluator.simulator.system)
        fixed = {c.name for c in coefficients if c.least is not None and c.least == c.most}
        fitted_values = {
            name: number
            for name, number in self.select_coefficients(evidence.effect, numbers).items()
            if name not in fixed
        }
        friction_form = get_friction_form(evaluator, evidence.effect)
        description = effect.says
        if friction_form is not None:
            description = add_solver_parameters(evaluator, evidence.effect, description)
        if evaluator.kind.has_model and is_gravity_compensated(evidence.effect, fitted_values):
            description = GRAVITY_COMPENSATED
        return Cause(
            evidence.effect,
            evidence.alternatives,
            description,
            fitted_values,
            evidence.p_value,
            friction_form,
        )

    def select_coefficients(
        self, name: str, estimates: Mapping[int, FittedValue]
    ) -> dict[str, FittedValue]:
        """Return the estimates of an effect by the names of its coefficients.

        Args:
            name: Name of the effect.
            estimates: Estimates by index in the parameter vector.
        """
        evaluator = self._evaluator
        coefficients = evaluator.available_effects[name].on(evaluator.simulator.system)
        indices = evaluator.get_coefficient_indices(name)
        return {c.name: estimates[i] for c, i in zip(coefficients, indices, strict=True)}

    def _list_counted_channels(self) -> list[int]:
        """List the channels with the same unit as the channel that sensor effects act on."""
        evaluator = self._evaluator
        units = [channel.unit for channel in evaluator.simulator.channels]
        reading = evaluator.simulator.system.reading(evaluator.channels)
        # Errors of different units cannot be added.
        unit = units[evaluator.channels.index(reading)]
        return [c for c, channel_unit in enumerate(units) if channel_unit == unit]

    def _compute_noise_floor(self) -> float:
        """Compute the RMS of the noise floor over the channels that count."""
        sigma = self.estimate_noise_sigma()[self._list_counted_channels()]
        return float(np.sqrt(np.square(sigma).mean()))

    def _measure_held_out_gain(self) -> HeldOutResult | None:
        """Measure by how much the causes improve the prediction of held-out runs.

        Return None if the prediction of the base model failed, or if no runs were predicted with
        both models.
        """
        runs, finding = self.result.runs.predicted, self.result.finding
        held_out_fits, names = finding.held_out_fits, finding.model.effects
        if runs is None or held_out_fits is None or names not in held_out_fits:
            return None
        before, after = held_out_fits[()].simulated, held_out_fits[names].simulated
        if self.result.runs.before is not None:
            before = self.result.runs.before
        # Without a prediction of the base model there is no gap to measure.
        if not np.isfinite(before[np.isfinite(runs.observed)]).all():
            return None
        gain = self._compute_gain(runs, before, after, self.result.rng)
        channel = self._evaluator.simulator.channels[self._list_counted_channels()[0]]
        return _build_held_out_result(gain, channel.unit)

    def _compute_gain(
        self, runs: RunEvaluator, before: Array, after: Array, rng: np.random.Generator
    ) -> HeldOutGain:
        """Compute the gain of a prediction over that of the base model.

        Args:
            runs: the predicted runs.
            before: (R, T, C) prediction of the base model.
            after: (R, T, C) the other prediction.
            rng: source of the bootstrap samples.
        """
        validation = self.result.runs.validation
        # Cross-validated runs are few, and gains are resampled by segments.
        by_segments = validation is not None and validation.is_cross_validation
        channels, floor = self._list_counted_channels(), self._compute_noise_floor()
        return compute_held_out_gain(runs, before, after, channels, floor, rng, by_segments)

    def _list_candidates(self) -> tuple[Candidate, ...]:
        """List all effects of the library with their scores about the base model, best first.

        A score is reduced by the price of each coefficient beyond the first, so that an effect
        precedes more general effects that contain it.
        """
        search = self.result.search
        scores = search.base_scores
        if scores is None:
            return ()
        base = search.base_model.likelihood.value
        candidates = []
        for i, effect in enumerate(scores.effects):
            score = float(scores.score[i])
            # A fit may gain more than the linear score predicts, in particular far from the data.
            single_effect_model = search.models.get(frozenset({effect}))
            if single_effect_model is not None:
                score = max(score, float(single_effect_model.likelihood.value - base))
            beyond_chance = np.array([score - scores.null_quantiles[i]])
            p_value = float(
                np.clip(estimate_tail_p_value(scores.null_scores, beyond_chance), 0.0, 1.0)
            )
            share = self._get_closed_share((effect,))
            coefficient_slice = search.evaluator.coefficient_slices[effect]
            score -= search.parameter_penalty * (
                coefficient_slice.stop - coefficient_slice.start - 1
            )
            candidates.append(Candidate(effect, max(score, 0.0), p_value, share))
        return tuple(sorted(candidates, key=lambda row: -row.score))

    def _get_closed_share(self, names: EffectNames) -> float | None:
        """Return the share of the held-out gap that a model closes; None if it is not measured.

        Args:
            names: names of the effects of the model.
        """
        runs, held_out_fits = self.result.runs.predicted, self.result.finding.held_out_fits
        if runs is None or held_out_fits is None or names not in held_out_fits:
            return None
        counted_channels = self._list_counted_channels()
        floor = self._compute_noise_floor()
        # As for the gain of the whole model, an error below the noise floor is not a gain.
        before = _compute_rmse(runs, held_out_fits[()].simulated, counted_channels)
        after = _compute_rmse(runs, held_out_fits[names].simulated, counted_channels)
        share = 0.0
        # At the noise floor there is no gap, and the quotient would be a rounding error.
        if before > floor * 1.001:
            share = (before - max(after, floor)) / (before - floor)
        return float(np.clip(share, MIN_REPORTED_GAIN, 1.0)) if np.isfinite(share) else None

    def share_intervals(self) -> dict[str, tuple[float, float]]:
        """Compute 95 % intervals of the share of the held-out gap that single effects close.

        Returns:
            Low and high end by effect, for effects that were simulated alone on held-out runs.
        """
        runs, held_out_fits = self.result.runs.predicted, self.result.finding.held_out_fits
        if runs is None or held_out_fits is None:
            return {}
        before = held_out_fits[()].simulated
        intervals = {}
        for names, simulated in held_out_fits.items():
            share = self._get_closed_share(names)
            if len(names) != 1 or share is None or share <= MIN_REPORTED_GAIN:
                continue
            # Each effect has its own random stream, so that its interval does not depend on the
            # others.
            rng = make_rng("held-out share", *names)
            result = self._compute_gain(runs, before, simulated.simulated, rng)
            if np.isfinite(result.low) and np.isfinite(result.high):
                intervals[names[0]] = result.low, result.high
        return intervals

    def _propose_next_run(self) -> DiscriminatingRun | None:
        """Propose a run that distinguishes the strongest cause from its most plausible alternative.

        If the base model is not identifiable, the run should identify its parameters. Return None
        if nothing is open, or if the search was stopped early.
        """
        search, finding = self.result.search, self.result.finding
        if finding.early_stop is not None:
            return None
        if finding.verdict == "unidentifiable":
            return _propose_identifying_run(finding.unidentified_parameters)
        competing_models = self.result.list_competing_models()
        if not competing_models:
            return None
        return propose_discriminating_run(search, finding.model, competing_models[0])


def _compute_rmse(evaluator: RunEvaluator, simulated: Array, channels: list[int]) -> float:
    """Compute the RMS error over the channels that count, in their unit.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: run evaluator: the recorded runs, and the simulator that is compared with them.
        simulated: (R, T, C) simulated channels.
        channels: indices of the channels that count.
    """
    observed_mask = np.isfinite(evaluator.observed)[..., channels]
    error = (evaluator.observed - simulated)[..., channels][observed_mask]
    return float(np.sqrt(np.square(error).mean()))


def _propose_identifying_run(unidentified: tuple[str, ...]) -> DiscriminatingRun:
    """Propose how to identify parameters that the data do not identify."""
    has_several = len(unidentified) > 1
    condition_text = "their influences differ" if has_several else "it changes the motion"
    names = " and ".join(unidentified)
    return DiscriminatingRun(
        f"Measure {names} separately, or record runs in which {condition_text}"
    )


def _build_held_out_result(gain: HeldOutGain, unit: str) -> HeldOutResult:
    """Convert a gain to the form of the verdict; an interval that the data do not give is None.

    Args:
        gain: errors before and after, and the share of the gap closed.
        unit: unit of the errors.
    """
    base, extended, floor, share, low, high = map(to_finite_or_none, astuple(gain))
    return HeldOutResult(base, extended, floor, share, low, high, unit)
