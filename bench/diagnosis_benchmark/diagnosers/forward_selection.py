"""Forward selection: add one effect at a time, refitted with parameters and initial states.

A criterion decides when to stop. BIC (G. Schwarz, Ann. Stat. 6(2), 461, 1978,
doi:10.1214/aos/1176344136), with n samples and k numbers,

    BIC = n log(S / n) + k log n,    S the sum of squares in units of the noise               (1)

does not need the noise level; effects within 2 of the best are indistinguishable (R. E. Kass, A. E.
Raftery, JASA 90, 773, 1995). Chi squared uses the stated or estimated noise: a model is sufficient
if noise alone makes S as large in more than one of a hundred recordings (P. R. Bevington, D. K.
Robinson, Data Reduction and Error Analysis, chapter 11). Both assume white noise.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from bench.core.diagnoser import Answer, Diagnoser, DiagnosisCase, NamedCause
from bench.diagnosis.evaluation.parameter_bounds import compute_coefficient_bounds
from bench.diagnosis.fitting.levenberg_marquardt import FitStart, TrajectoryFit
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from bench.diagnosis_benchmark.diagnosers.regression_evidence import (
    EffectColumn,
    RegressionEvidence,
    compute_base_jacobian,
    find_strongest_columns,
)
from sims.core.simulator import Array

MAX_EFFECTS = 3
"""Maximum number of effects."""
REFITS_PER_ROUND = 8
"""Number of effects refitted per round: those with the best first-order prediction."""
MAX_FIT_ITERATIONS = 15
"""Maximum number of iterations of a fit."""
MIN_GAP_CLOSED = 0.7
"""Minimum fraction of the gap that must be closed before its causes are named."""
FALSE_ALARM_RATE = 0.01
"""False-alarm probability."""
CHI_SQUARED_TOLERANCE = 6.63
"""Chi-squared difference up to which two models are indistinguishable: 1 %, one free parameter."""
BIC_TOLERANCE = 2.0
"""BIC difference up to which two models are indistinguishable."""
Z95 = 1.96
"""Half width of a 95 % interval in standard errors."""


class RefittedModel(NamedTuple):
    """Fitted model.

    Attributes:
        fit: the fit.
        squares: sum of squares of the residual, in units of the noise.
        numbers: number of fitted parameters, including initial states.
    """

    fit: TrajectoryFit
    squares: float
    numbers: int


class _ForwardSelection(Diagnoser):
    """Base class of the forward selections."""

    def diagnose(self, case: DiagnosisCase) -> Answer:
        """Name the selected effects, with alternatives that the criterion cannot exclude."""
        with closing(RegressionEvidence.collect(case)) as evidence:
            return self._select_effects(evidence)

    def _select_effects(self, evidence: RegressionEvidence) -> Answer:
        """Add the best effect to the model, one at a time, and answer with the selected effects.

        The search stops if the model is sufficient, if no effect improves it, or at `MAX_EFFECTS`
        effects.

        In each round, `candidates` are the models with one more effect, ordered by the criterion,
        the lowest first. The best becomes the new model; candidates within the tolerance `near` of
        it are its alternatives.

        Args:
            evidence: fitted base model and directions of the effects.

        Returns:
            Verdict on the selected effects, each with its alternatives.
        """
        samples = int(evidence.observed_mask.sum())
        best = _measure_fit(evidence, evidence.base.fit)
        base_model = best
        causes: list[tuple[str, tuple[str, ...]]] = []
        while len(causes) < MAX_EFFECTS and not self._is_sufficient(best, samples):
            candidates = [
                _measure_fit(evidence, fit)
                for fit in _refit_with_one_more_effect(evidence, best.fit)
            ]
            candidates = [candidate for candidate in candidates if np.isfinite(candidate.squares)]
            if not candidates:
                break
            candidates.sort(key=lambda candidate: self.compute_criterion(candidate, samples))
            best_candidate, *other_candidates = candidates
            lowest_criterion = self.compute_criterion(best_candidate, samples)
            if lowest_criterion >= self.compute_criterion(best, samples):
                break
            # The last effect of a candidate is the one that was added.
            alternatives = [
                candidate.fit.effects[-1]
                for candidate in other_candidates
                if self.compute_criterion(candidate, samples) <= lowest_criterion + self.near
            ]
            best = best_candidate
            causes.append((best.fit.effects[-1], tuple(alternatives)))
        return self._make_answer(evidence, base_model, best, causes, samples)

    def _make_answer(
        self,
        evidence: RegressionEvidence,
        first: RefittedModel,
        best: RefittedModel,
        causes: Sequence[tuple[str, tuple[str, ...]]],
        samples: int,
    ) -> Answer:
        """Give the verdict on the selected effects.

        The verdict is "adequate" if the base model suffices, "unknown" if the effects explain less
        than `MIN_GAP_CLOSED` of the excess sum of squares, "partial" if they explain more but not
        all, and otherwise "named", or "ambiguous" with alternatives. A criterion without p-value,
        such as BIC, gives neither "unknown" nor "partial".

        Args:
            evidence: fitted base model and directions of the effects.
            first: the base model.
            best: selected model with its effects, refitted to the runs.
            causes: each selected effect with its alternatives.
            samples: number of samples.
        """
        intervals = _compute_intervals(evidence, best)
        # Coefficients of effects have a dot in their names, parameters of the system have none.
        parameters = {name: interval for name, interval in intervals.items() if "." not in name}
        p_value = self.compute_p_value(first, samples)
        # A criterion that only compares models finds the selected one good enough.
        is_explained = p_value is None or self._is_sufficient(best, samples)
        named_causes = tuple(
            NamedCause(name, alternatives, _select_effect_intervals(intervals, name), p_value)
            for name, alternatives in causes
        )
        if is_explained:
            verdict = "named" if causes else "adequate"
            if any(alternatives for _, alternatives in causes):
                verdict = "ambiguous"
            return Answer(verdict, named_causes, parameters, p_value)
        # Noise alone gives a sum of squares of about its degrees of freedom; the excess is the gap.
        gap = max(first.squares - float(samples - best.numbers), 1e-9)
        if not causes or (first.squares - best.squares) / gap < MIN_GAP_CLOSED:
            return Answer("unknown", (), parameters, p_value)
        return Answer("partial", named_causes, parameters, p_value)

    def _is_sufficient(self, model: RefittedModel, samples: int) -> bool:
        """Return whether noise alone may explain the residual, so that the search can stop.

        Args:
            model: model with its effects, refitted to the runs.
            samples: number of samples.
        """
        p_value = self.compute_p_value(model, samples)
        return p_value is not None and p_value > FALSE_ALARM_RATE

    near: float

    @abstractmethod
    def compute_criterion(self, model: RefittedModel, samples: int) -> float:
        """Compute the criterion, which is minimised.

        Args:
            model: model with its effects, refitted to the runs.
            samples: number of samples.
        """

    @abstractmethod
    def compute_p_value(self, model: RefittedModel, samples: int) -> float | None:
        """Compute the p-value of a model under the hypothesis that nothing is missing.

        Args:
            model: model with its effects, refitted to the runs.
            samples: number of samples.

        Returns:
            The p-value, or None if the criterion gives none: it then only compares models.
        """


class ForwardBIC(_ForwardSelection):
    """Forward selection of refitted effects by BIC."""

    name = "forward-bic"
    near = BIC_TOLERANCE

    def compute_criterion(self, model: RefittedModel, samples: int) -> float:
        """Compute the Bayesian information criterion, BIC = n log(S / n) + k log n, equation (1).

        Args:
            model: a fitted model, with sum of squares S and k numbers.
            samples: number of samples n.
        """
        return float(samples * np.log(model.squares / samples) + model.numbers * np.log(samples))

    def compute_p_value(self, model: RefittedModel, samples: int) -> float | None:
        """Return None: BIC only compares models; the search continues while a model is better.

        Args:
            model: unused.
            samples: unused.
        """
        return None


class ForwardChi2(_ForwardSelection):
    """Forward selection of refitted effects by chi squared, with stated or estimated noise."""

    name = "forward-chi2"
    near = CHI_SQUARED_TOLERANCE

    def compute_criterion(self, model: RefittedModel, samples: int) -> float:
        """Return the sum of squares.

        Args:
            model: model with its effects, refitted to the runs.
            samples: unused.
        """
        return model.squares

    def compute_p_value(self, model: RefittedModel, samples: int) -> float | None:
        """Compute the probability that noise alone gives a sum of squares as large as this one.

        The sum of squares is chi-squared distributed with `samples` minus fitted numbers degrees of
        freedom if the noise is white and the model is correct.

        Args:
            model: model with its effects, refitted to the runs.
            samples: number of samples.
        """
        from scipy.special import chdtrc

        return float(chdtrc(max(samples - model.numbers, 1), model.squares))


def _measure_fit(evidence: RegressionEvidence, fit: TrajectoryFit) -> RefittedModel:
    """Compute sum of squares and number of parameters of a fit, by which models are compared.

    Unknown initial states count as parameters.

    Args:
        evidence: base fit, noise, and directions of the effects on a recording.
        fit: a fitted model. A fit that diverged gets an infinite sum of squares.
    """
    residual = (evidence.evaluator.observed - fit.simulated) / evidence.noise.sigma
    squares = float(np.square(residual[evidence.observed_mask]).sum())
    numbers = fit.free_indices.size + int((~evidence.evaluator.known_state_mask).sum())
    return RefittedModel(fit, squares if np.isfinite(squares) else np.inf, numbers)


def _refit_with_one_more_effect(
    evidence: RegressionEvidence, current_fit: TrajectoryFit
) -> list[TrajectoryFit]:
    """Add each of the most promising effects to a model, and refit all parameters by least squares.

    Promising are the `REFITS_PER_ROUND` effects that decrease the sum of squares most to first
    order, when parameters and initial states may change, too. Each is fitted from several starting
    values.

    Args:
        evidence: fitted base model and directions of the effects.
        current_fit: the model to which an effect is added.

    Returns:
        The best fit for each effect.
    """
    evaluator = evidence.evaluator
    names = tuple(name for name in evaluator.library if name not in current_fit.effects)
    # Directions of further effects must be computed at the current model: a copy recomputes them.
    evidence = replace(evidence, base=replace(evidence.base, fit=current_fit), names=names)
    residual, effects = evidence.build_trajectory_regression().project_out_base()
    best = find_strongest_columns(residual, effects, evidence.effect_columns)
    promising = sorted(best.values(), key=lambda strongest: -strongest.gain)[:REFITS_PER_ROUND]
    starts = [
        start
        for _, column in promising
        for start in _choose_starts(evidence, current_fit, column, residual, effects)
    ]
    if not starts:
        return []
    fits = TrajectoryFitter(evaluator, evidence.noise, evidence.base.fixed_parameters).fit_models(
        starts, MAX_FIT_ITERATIONS, is_racing=True
    )
    by_name: dict[str, TrajectoryFit] = {}
    for fit in fits:
        name = fit.effects[-1]
        if name not in by_name or fit.cost < by_name[name].cost:
            by_name[name] = fit
    return list(by_name.values())


def _choose_starts(
    evidence: RegressionEvidence,
    current_fit: TrajectoryFit,
    column: EffectColumn,
    residual: Array,
    effects: Array,
) -> list[FitStart]:
    """Choose starting values for a fit with one more effect.

    They are the size predicted by the linear model, and 0.3 of it because the linear model holds
    for small sizes only. An effect that exists in one size only has one start: that size.

    Args:
        evidence: directions of the effects at the current model.
        current_fit: the current model.
        column: the effect and its best directions, one per coefficient on which the change of the
            residual depends linearly.
        residual: residual of N samples after parameters and initial states are projected out, (N,).
        effects: columns of all K directions after this projection, (N, K).

    Returns:
        One or two starts: effects, parameters with coefficients, and initial states.
    """
    evaluator, name = evidence.evaluator, column.effect
    # A probe has the coefficients with which a direction was simulated, and the index of the one
    # that scales it.
    probes = [evidence.sensitivity_directions.candidates[index] for index in column.places]
    bounds = compute_coefficient_bounds(evaluator, name)
    sizes, *_ = np.linalg.lstsq(effects[:, list(column.places)], residual, rcond=1e-9)
    starts = []
    for factor in (1.0,) if probes[0].is_single_size else (1.0, 0.3):
        start_coefficients = probes[0].coefficients.copy()
        for probe, size in zip(probes, sizes.tolist(), strict=True):
            # A probe of a single size keeps the coefficients with which it was simulated.
            if not probe.is_single_size:
                start_coefficients[probe.coefficient_index] = np.clip(
                    factor * size, *bounds[probe.coefficient_index]
                )
        theta = current_fit.theta.copy()
        theta[evaluator.coefficient_slices[name]] = start_coefficients
        starts.append(FitStart((*current_fit.effects, name), theta, current_fit.initial_states))
    return starts


def _compute_intervals(
    evidence: RegressionEvidence, model: RefittedModel
) -> dict[str, tuple[float | None, float | None]]:
    """Compute 95 % intervals of the fitted parameters, by name, from the curvature at the fit.

    They are the linear least-squares intervals: value plus or minus 1.96 standard errors, with the
    noise variance estimated from the residual. The columns of the Jacobian are scaled to equal
    length before the inversion, since parameters have different units.

    Args:
        evidence: base fit, noise, and directions of the effects on a recording.
        model: model with its effects, refitted to the runs.

    Returns:
        Interval (low, high) by name: ``mass`` for a parameter of the system, or
        ``drag.linear.coefficient`` for a coefficient of an effect.
    """
    evaluator, fit = evidence.evaluator, model.fit
    # Initial states are unknowns too, but only the parameters, the first columns, get intervals.
    columns = compute_base_jacobian(evaluator, fit) / evidence.noise.sigma[:, None]
    whitened_rows = columns[evidence.observed_mask]
    whitened_rows = whitened_rows[np.isfinite(whitened_rows).all(axis=1)]
    scale = np.sqrt(np.square(whitened_rows).sum(axis=0))
    scale[scale == 0] = 1.0
    inverse = np.linalg.pinv((whitened_rows / scale).T @ (whitened_rows / scale), rcond=1e-12)
    standard_errors = np.sqrt(np.abs(np.diag(inverse))) / scale
    residual_variance = model.squares / max(len(whitened_rows) - model.numbers, 1)
    standard_errors = standard_errors * np.sqrt(max(residual_variance, 1e-12))
    intervals: dict[str, tuple[float | None, float | None]] = {}
    for i, parameter_index in enumerate(fit.free_indices.tolist()):
        value, half_width = float(fit.theta[parameter_index]), Z95 * float(standard_errors[i])
        intervals[evaluator.parameters[parameter_index].name] = (
            value - half_width,
            value + half_width,
        )
    return intervals


def _select_effect_intervals(
    intervals: dict[str, tuple[float | None, float | None]], effect: str
) -> dict[str, tuple[float | None, float | None]]:
    """Select the intervals of one effect's coefficients, by the name of the coefficient alone.

    Args:
        intervals: intervals by ``effect.coefficient``, or by the name of a base parameter.
        effect: name of the effect, with its place on a robot: ``drag.linear@elbow``.
    """
    prefix = f"{effect}."
    return {
        name.removeprefix(prefix): interval
        for name, interval in intervals.items()
        if name.startswith(prefix)
    }
