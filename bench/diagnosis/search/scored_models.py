"""Fitted models together with the scores of all effects that they lack.

Each model is scored once against the whole library by a linear test (`search.score_test`). The
score and the size of the residual show whether the model lacks something.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from bench.diagnosis.evaluation.autoregressive_surrogates import draw_surrogates
from bench.diagnosis.evaluation.noise_model import Mask, NoiseModel, compute_portmanteau_p_value
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.fitted_models import FittedModel, ModelSet
from bench.diagnosis.fitting.levenberg_marquardt import FitStart, TrajectoryFit
from bench.diagnosis.search.candidate_directions import DirectionSet, compute_directions
from bench.diagnosis.search.fit_starts import select_refit_starts
from bench.diagnosis.search.score_test import (
    CandidateScores,
    ScoreTest,
    compute_calibrated_scores,
    estimate_tail_p_value,
)
from bench.diagnosis.search.verdict_rules import MAX_AUTOCORRELATED_NOISE_RATIO
from sims.core.simulator import Array

SURROGATE_COUNT = 120
"""Number of surrogate residuals that calibrate the scores about one model."""
CERTAIN_P_VALUE = 1e-6
"""P-value below which surrogates with another spectrum are not needed."""
NOISE_RATIO_THRESHOLD = 1.3
"""Maximum ratio of the residual to the noise floor at which the scores alone are trusted.

A larger residual is examined by simulation, whatever the scores are.
"""
WHITENESS_P_VALUE_THRESHOLD = 0.01
"""Minimum p-value at which a residual above an estimated noise floor counts as AR(1) noise."""

DIRECTION_CACHE_BYTES = 400e6
"""Maximum size in bytes of stored directions, in addition to those of the base model.

The oldest ones are removed; in the rare case that they are needed again, they are recomputed.
"""
MAX_EXCESS_TO_STOP = 0.02
"""Maximum excess of a model at which no richer law is fitted."""
NESTED_MODEL_TOLERANCE = 1.0
"""Maximum distance in twice the log-likelihood of a model from one that it contains.

A fit that is further behind has stopped in a poor local minimum.
"""
UNCHANGED_FIT_SIGMAS = 0.1
"""Maximum RMS change of a fit, in sigmas, at which its directions are kept.

Directions are derivatives, so they have changed as little as the fit.
"""


class ModelScan(NamedTuple):
    """Directions, score test and scores about one model.

    Attributes:
        fit: the fit that the directions refer to.
        directions: directions of the effects that the model lacks.
        test: score test with these directions.
        scores: scores of these effects.
    """

    fit: TrajectoryFit
    directions: DirectionSet
    test: ScoreTest
    scores: CandidateScores


@dataclass
class ScoredModelSet(ModelSet):
    """Models and their scores.

    Attributes:
        scores_by_effects: scores about each scored model, by its effects.
        cached_scans: directions, tests and scores about the base model and the latest scored
            models.
        best_p_values: p-value of the best score about each model, by its effects.
        superseded_scans: results about models that have been replaced by better fits.
        reference_scores: scores whose surrogates stand for those of models that are not scored;
            None if every smaller model is scored.
        excluded_effects: effects that are not scored.
    """

    scores_by_effects: dict[frozenset[str], CandidateScores] = field(default_factory=dict)
    cached_scans: dict[frozenset[str], ModelScan] = field(default_factory=dict)
    best_p_values: dict[frozenset[str], float] = field(default_factory=dict)
    superseded_scans: dict[frozenset[str], ModelScan] = field(default_factory=dict)
    reference_scores: CandidateScores | None = None
    excluded_effects: frozenset[str] = frozenset()

    @property
    def base_model(self) -> FittedModel:
        """The fitted model without any effect."""
        return self.models[frozenset()]

    @property
    def base_scores(self) -> CandidateScores | None:
        """Scores of all effects about the base model; None if it was not scored.

        If the base model was replaced by a better fit, these are the scores about its previous fit.
        """
        # The base model has no effects.
        key: frozenset[str] = frozenset()
        # The scores about the present fit, or None if there are none about any fit.
        if key in self.scores_by_effects or key not in self.superseded_scans:
            return self.scores_by_effects.get(key)
        return self.superseded_scans[key].scores

    def release_memory(self) -> None:
        """Release what only the search itself needs; here nothing."""

    def get_known_directions(self) -> tuple[TrajectoryFit, DirectionSet] | None:
        """Return the directions of all candidates about the base model, if already computed.

        Here always None; subclasses may compute them separately from the scores.
        """
        return None

    def on_replaced(self, key: frozenset[str]) -> None:
        """Discard the scores about a model that was replaced by a better fit of the same effects.

        Its directions are kept, because they are reused if the better fit is nearly the same.
        """
        self.scores_by_effects.pop(key, None)
        if key in self.cached_scans:
            self.superseded_scans[key] = self.cached_scans.pop(key)

    def score_missing_effects(
        self, model: FittedModel, noise_residual: Array | None = None
    ) -> CandidateScores:
        """Score every effect that the model lacks, to find the effects that are worth fitting.

        A score is the gain of an effect to first order, without a fit. Surrogates are random noise
        that calibrates the scores. The scores about a model are computed once and stored. With a
        `noise_residual` they are computed anew, and replace the stored ones.

        Shapes: R runs, T samples, C channels.

        Args:
            model: fitted model, to whose residual the effects are compared.
            noise_residual: (R, T, C) residual whose spectrum the surrogates have; None for that of
                the model.
        """
        # Models and their scores are stored by the set of their effects.
        key = frozenset(model.effects)
        # New surrogates need the directions, which are stored with the scan.
        if key not in (self.scores_by_effects if noise_residual is None else self.cached_scans):
            self._score_models([model])
        if noise_residual is None:
            return self.scores_by_effects[key]
        stored_scan = self.cached_scans[key]
        self._report_scoring(model)
        # The directions (responses of the runs to the effects) cost one simulation for each
        # candidate, and are reused with other surrogates.
        residual = self.compute_residual(model.fit)
        rng = self.make_rng("library", model.effects)
        scores = _score_residual(
            stored_scan.test, residual, noise_residual, self.observed_mask, rng
        )
        self._store_scores(key, stored_scan._replace(scores=scores))
        return scores

    def _score_models(
        self, models: Sequence[FittedModel], other_kept_models: Sequence[FittedModel] = ()
    ) -> None:
        """Score the effects that each of the models lacks, in parallel, and store the results.

        Directions are the responses of the simulated runs to the effects; scores compare them with
        the residual.

        1. If a model was replaced by nearly the same fit, its stored directions are used again.
        2. The directions of the other models are simulated, one model in each worker.
        3. The oldest directions are removed if they take too much memory.

        Results are stored by the key of a model: the set of its effects.

        Args:
            models: models to score.
            other_kept_models: further models whose stored results must not be removed.
        """
        # One entry for each model whose directions must be simulated.
        scan_arguments: list[tuple[Any, ...]] = []
        keys: list[frozenset[str]] = []
        for model in models:
            self._report_scoring(model)
            # Scores need derivatives at the parameters of the model itself.
            model = self.refine_jacobian(model)
            key = frozenset(model.effects)
            residual = self.compute_residual(model.fit)
            rng = self.make_rng("library", model.effects)
            # 1. Directions of a fit that was replaced.
            previous_scan = self.superseded_scans.pop(key, None)
            # A model that has hardly moved keeps its directions; only its residual is scored anew.
            if (
                previous_scan is not None
                and self._compute_fit_distance(previous_scan.fit, model.fit) < UNCHANGED_FIT_SIGMAS
            ):
                scores = _score_residual(
                    previous_scan.test, residual, residual, self.observed_mask, rng
                )
                self._store_scores(key, previous_scan._replace(scores=scores))
                continue
            missing_effects = self._list_addable_effects(model)
            keys.append(key)
            # Arguments of `_scan_model` in a worker.
            scan_arguments.append(
                (
                    model.fit,
                    missing_effects,
                    self.compute_channel_weights(model),
                    residual,
                    self.observed_mask,
                    rng,
                )
            )
        # 2. The other models.
        for key, scan in zip(keys, self._scan_in_workers(scan_arguments), strict=True):
            # Stored scores remain valid if only the directions of the model were removed.
            scores = self.scores_by_effects.get(key, scan.scores)
            self._store_scores(key, scan._replace(scores=scores))
        # 3. Memory.
        self._limit_cache_size([*keys, *(frozenset(model.effects) for model in other_kept_models)])

    def _scan_in_workers(self, scan_arguments: Sequence[tuple[Any, ...]]) -> list[ModelScan]:
        """Simulate and score the effects that several models lack, one model in each worker.

        Args:
            scan_arguments: for each model, the arguments of `_scan_model` after the evaluator; the
                second one are the names of the missing effects.

        Returns:
            Directions, tests and scores of each model, in the order of the arguments.
        """
        if scan_arguments:
            max_effect_count = max(
                len(missing_effects) for _, missing_effects, *_ in scan_arguments
            )
            further_text = (
                f" added to each of {len(scan_arguments)} models" if len(scan_arguments) > 1 else ""
            )
            self.evaluator.search_control.begin_stage(
                f"testing {max_effect_count} effects{further_text}", len(scan_arguments)
            )
        # The workers return the results in any order.
        scans: dict[int, ModelScan] = {}
        for model_index, scan in self.evaluator.worker_pool.map_unordered(
            self.evaluator, _scan_model, scan_arguments
        ):
            scans[model_index] = scan
            self.evaluator.search_control.advance()
        return [scans[model_index] for model_index in range(len(scan_arguments))]

    def _report_scoring(self, model: FittedModel) -> None:
        """Report to the user that a model is scored now, and stop if the search has to end."""
        model_text = " + ".join(model.effects) or "the base model"
        self.evaluator.search_control.report_and_check(
            f"scores of the effect library at {model_text}"
        )

    def _limit_cache_size(self, kept_keys: Sequence[frozenset[str]]) -> None:
        """Remove the oldest stored directions until they fit in `DIRECTION_CACHE_BYTES`.

        Directions are the responses of the runs to all effects that a model lacks, and take much
        memory. Those of the base model (the empty key) and of the models `kept_keys` are needed
        next; they are never removed, and those of the base model are not counted.

        Args:
            kept_keys: models whose directions are kept, each as the set of its effects.
        """
        # Directions about replaced fits are removed first. A dictionary has its oldest entries
        # first.
        for cache in (self.superseded_scans, self.cached_scans):
            # An empty key is the base model.
            for key in [k for k in cache if k and k not in kept_keys]:
                cached_entries = [*self.superseded_scans.items(), *self.cached_scans.items()]
                size = sum(scan.directions.responses.nbytes for k, scan in cached_entries if k)
                if size <= DIRECTION_CACHE_BYTES:
                    return
                del cache[key]

    def _store_scores(self, key: frozenset[str], scan: ModelScan) -> None:
        """Store the scan of the model `key` (its effects) as the latest one, with its scores."""
        # Insert the entry again, so that it is the newest one.
        self.cached_scans.pop(key, None)
        self.cached_scans[key] = scan
        self.enter_scores(key, scan.scores)

    def enter_scores(self, key: frozenset[str], scores: CandidateScores) -> None:
        """Store the scores about a model.

        Those about the base model also give what each effect gains from noise alone (90 % quantile
        of its score over surrogates). It penalises the likelihood of all models with this effect.

        Args:
            key: effects of the model.
            scores: scores of the effects that the model lacks.
        """
        self.scores_by_effects[key] = scores
        self.best_p_values[key] = scores.p_value
        # The key of the base model is empty. Its first scores are kept, so that models fitted
        # before and after a better base fit can be compared.
        if not key and not self.null_gains:
            self.null_gains = dict(zip(scores.effects, scores.null_quantiles.tolist(), strict=True))

    def _compute_fit_distance(self, first: TrajectoryFit, second: TrajectoryFit) -> float:
        """Return the RMS difference of two simulations over all samples, in units of the noise.

        If it is small, responses to effects that were computed about the first fit are also valid
        for the second.

        Args:
            first: fit about which directions were computed.
            second: later fit to the same runs.
        """
        normalised_difference = (first.simulated - second.simulated) / self.noise.sigma
        return float(np.sqrt(np.square(normalised_difference[self.observed_mask]).mean()))

    def _list_addable_effects(self, model: FittedModel) -> list[str]:
        """Return the effects that could be added to a model.

        These are all effects of the library, except those in the model, those that one of its
        effects contains, and those that the search excludes (`excluded_effects`).
        """
        included_effects = {*model.effects, *self.excluded_effects}
        # An effect and one that it contains have no unique solution together.
        for name in model.effects:
            included_effects.update(self.evaluator.available_effects[name].contains)
        return [name for name in self.evaluator.library if name not in included_effects]

    def refit_extensions(
        self, beam: Iterable[FittedModel], max_count: int, fits_all: bool = False
    ) -> None:
        """Fit the models with one more effect that have the highest scores, and store them.

        Scores are linear, so the best candidates are fitted by simulation. For robots, this is done
        in two steps, because richer laws cost more simulation time:

        1. Fit models with laws of which no simpler law is known.
        2. Fit models with richer laws, if the models with the simpler ones leave more than noise.

        Args:
            beam: models to extend (the best ones of the beam search).
            max_count: maximum number of candidates per model.
            fits_all: whether to include all candidates, also those that were fitted before. There
                are many, so that the beginnings of the runs are fitted first, and only the best
                models are fitted to whole runs.
        """
        starts = self._collect_extension_starts(beam, max_count, fits_all)
        # Only robots have a linearisation.
        if not self.evaluator.has_linearisation or fits_all:
            if starts:
                self.refit_models(starts, is_staged=fits_all)
            return
        # Models that are fitted now or were fitted before, as sets of effects.
        known_models = {frozenset(start.effects) for start in starts} | set(self.models)
        # Each start with its models in which a simpler law replaces one of its laws.
        starts_and_simpler = [
            (start, self._list_simpler_models(start) & known_models) for start in starts
        ]
        # 1. Simple laws.
        simple_starts = [start for start, simpler in starts_and_simpler if not simpler]
        if simple_starts:
            self.refit_models(simple_starts)
        # 2. Richer laws.
        richer_starts = [
            start
            for start, simpler in starts_and_simpler
            if simpler and not self._leaves_only_noise(simpler)
        ]
        if richer_starts:
            self.refit_models(richer_starts)

    def _collect_extension_starts(
        self, beam: Iterable[FittedModel], max_count: int, fits_all: bool
    ) -> list[FitStart]:
        """Return starts of fits of each model of the beam with one more effect.

        Starting values of the effect are those with the best score. Models whose directions are not
        stored are scored first. Directions are the responses of the runs to the missing effects.

        Args:
            beam: the models to extend.
            max_count: maximum number of effects that are tried with each model.
            fits_all: whether to include all effects, also those that were fitted before.
        """
        starts = []
        models = list(beam)
        # A better fit may have discarded the scores of some models.
        unscanned_models = [
            model for model in models if frozenset(model.effects) not in self.cached_scans
        ]
        self._score_models(unscanned_models, other_kept_models=models)
        for model in models:
            effect_set = frozenset(model.effects)
            stored_scan = self.cached_scans[effect_set]
            # The model may have been improved since it was put into the beam.
            latest_model = self.models[effect_set]
            extension_starts = select_refit_starts(
                self.evaluator,
                self.noise,
                latest_model,
                stored_scan.directions,
                stored_scan.scores,
                max_count,
                fits_all,
            )
            starts += [s for s in extension_starts if fits_all or self._is_new(s, latest_model)]
        return starts

    def _is_new(self, start: FitStart, model: FittedModel) -> bool:
        """Return whether a fit from this start may find a better model than the known fits.

        This is the case if no fit of these effects is known. For a robot, whose effects start far
        from the optimum, a known fit may have stopped in a poor local minimum: it is worse than the
        model `model`, which it contains. Then it is fitted again.

        Args:
            start: start of a fit of `model` with one more effect.
            model: the fitted model that is extended.
        """
        stored_model = self.models.get(frozenset(start.effects))
        if stored_model is None:
            return True
        # A model with more effects can fit at least as well. Only robots have a linearisation.
        likelihood_deficit = model.likelihood.value - stored_model.likelihood.value
        return self.evaluator.has_linearisation and likelihood_deficit > NESTED_MODEL_TOLERANCE

    def _list_simpler_models(self, start: FitStart) -> set[frozenset[str]]:
        """Return the models in which one effect of a start is replaced by a simpler one.

        The effect contains the simpler one: it acts like it at some values of its coefficients. If
        such a model already leaves only noise, the start need not be fitted.

        Args:
            start: start of a fit, with its effects.

        Returns:
            The models, each as the set of its effects.
        """
        effect_names = frozenset(start.effects)
        effects = self.evaluator.available_effects
        return {
            effect_names - {name} | {simpler_effect}
            for name in effect_names
            for simpler_effect in effects[name].contains
        }

    def _leaves_only_noise(self, keys: Iterable[frozenset[str]]) -> bool:
        """Return whether one of the fitted models `keys` (sets of effects) leaves only noise."""
        models = [self.models[key] for key in keys if key in self.models]
        return any(
            self.is_noise_like(m) and self.compute_excess_residual(m) < MAX_EXCESS_TO_STOP
            for m in models
        )

    def compute_missing_effect_p_value(self, model: FittedModel, larger: FittedModel) -> float:
        """Return the p-value of the gain of a model with more effects.

        A small value means that the smaller model lacks an effect. The null hypothesis is that it
        lacks none. The gain is compared with those from surrogates: random noise with the spectrum
        of a residual.

        1. Use the spectrum of the residual of the smaller model. It contains what an effect
           explains, so it makes large gains seem likely; a very small p-value decides nevertheless.
        2. Otherwise use the residual of the larger model, which is closer to pure noise.

        Args:
            model: model with fewer effects.
            larger: model with more effects.
        """
        # Gain in twice the log-likelihood.
        gain = larger.likelihood.value - model.likelihood.value
        # The given model may be a refit, while the stored scores belong to the fit of the search.
        model = self.models[frozenset(model.effects)]
        # 1. Residual of the smaller model.
        p_value = self.compute_gain_p_value(self.score_missing_effects(model), larger, gain)
        if p_value < CERTAIN_P_VALUE:
            return p_value
        # 2. Residual of the larger model.
        scores = self.score_missing_effects(model, self.compute_residual(larger.fit))
        return min(scores.p_value, self.compute_gain_p_value(scores, larger, gain))

    def compute_gain_p_value(
        self, scores: CandidateScores, larger: FittedModel, gain: float
    ) -> float:
        """Return the p-value of a gain in twice the log-likelihood, compared with surrogate noise.

        An effect with many shapes gains more from pure noise. So the gain that the larger model's
        effects reach under the null hypothesis (90 % quantile over the surrogates) is subtracted
        first.

        Args:
            scores: scores of the effects that the smaller model lacks, with those of surrogates.
            larger: model with more effects.
            gain: gain of the larger model in twice the log-likelihood.
        """
        null_quantiles = dict(zip(scores.effects, scores.null_quantiles.tolist(), strict=True))
        # Among several effects, the highest null-hypothesis level is used.
        effect_null_quantiles = [null_quantiles.get(name, 0.0) for name in larger.effects]
        null_quantile = max(effect_null_quantiles, default=0.0)
        # From the scores of the surrogates (`null_scores`), these quantiles are subtracted as well.
        excess = np.array([gain - null_quantile])
        return estimate_tail_p_value(scores.null_scores, excess)

    def is_complete(self, model: FittedModel, p_value_threshold: float) -> bool:
        """Return whether neither scores nor residual suggest that the model lacks an effect.

        Then the search stops at this model.

        Args:
            model: fitted model to test.
            p_value_threshold: p-value threshold of the scores.
        """
        # The residual is tested first, because scores need thousands of simulations.
        return (
            self.is_noise_like(model)
            and self.score_missing_effects(model).p_value > p_value_threshold
        )

    def is_noise_like(self, model: FittedModel) -> bool:
        """Return whether the residual of a model may be noise, so that no effect can be missing.

        It may be noise in two cases:

        1. It is at the noise floor in all channels.
        2. It is above a floor that was estimated, not stated, by no more than
           `MAX_AUTOCORRELATED_NOISE_RATIO`, and the Ljung-Box test accepts it as AR(1) noise. The
           floor is estimated for white noise, so AR(1) noise may exceed it (see
           `verdict_rules.exceeds_noise`).

        Args:
            model: fitted model, with the standard deviation of its residual in each channel.
        """
        # A model that could not be simulated has no residual.
        if not np.isfinite(model.fit.cost):
            return False
        # Without a sigma (NaN), a channel counts as above the noise.
        residual_sigma = np.nan_to_num(model.likelihood.sigma, nan=np.inf)
        # 1. At the noise floor.
        is_above_noise = residual_sigma >= NOISE_RATIO_THRESHOLD * self.noise.sigma
        if not is_above_noise.any():
            return True
        # 2. Autocorrelated noise above an estimated floor.
        # Specified noise is known, so a larger residual is not noise, whatever its spectrum.
        if (is_above_noise & self.is_noise_stated).any():
            return False
        # Autocorrelated noise exceeds an estimated floor only by this factor.
        if (residual_sigma > MAX_AUTOCORRELATED_NOISE_RATIO * self.noise.sigma).any():
            return False
        # Ljung-Box test, eq. (5) of `bench.diagnosis.evaluation.noise_model`.
        residual = self.compute_residual(model.fit)
        return (
            compute_portmanteau_p_value(residual, self.observed_mask, model.likelihood)
            > WHITENESS_P_VALUE_THRESHOLD
        )


def list_submodels(search: ScoredModelSet, model: FittedModel) -> list[FittedModel]:
    """Return the fitted models that have all effects of a model except one.

    From each of them, the gain of the missing effect is measured.

    Args:
        search: the search, with all fitted models.
        model: the model with all effects.
    """
    names = set(model.effects)
    size = len(names) - 1
    submodels = []
    for other_model in search.models.values():
        if len(other_model.effects) == size and set(other_model.effects) < names:
            submodels.append(other_model)
    return submodels


def _scan_model(
    evaluator: RunEvaluator,
    fit: TrajectoryFit,
    missing_effects: Sequence[str],
    weights: NoiseModel,
    residual: Array,
    observed_mask: Mask,
    rng: np.random.Generator,
) -> ModelScan:
    """Simulate the directions of all effects that a model lacks, and score them; runs in a worker.

    A direction is the response of the runs to an effect, and a score the gain in likelihood that it
    predicts.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: evaluator that simulates the recorded runs.
        fit: fit of the model, about which the directions are derivatives.
        missing_effects: names of the effects that the model lacks.
        weights: noise that weights the channels.
        residual: (R, T, C) residual of the model.
        observed_mask: (R, T, C) mask of available samples.
        rng: random generator of the surrogates.
    """
    directions = compute_directions(evaluator, fit, missing_effects)
    test = ScoreTest(fit, directions, observed_mask, weights)
    # Surrogates have the spectrum of the residual itself.
    scores = _score_residual(test, residual, residual, observed_mask, rng)
    return ModelScan(fit, directions, test, scores)


def _score_residual(
    test: ScoreTest,
    residual: Array,
    noise_residual: Array,
    observed_mask: Mask,
    rng: np.random.Generator,
) -> CandidateScores:
    """Return the scores of a residual, with a p-value from surrogate residuals.

    The surrogates are random noise with the spectrum of a residual. They contain no effect, so
    their scores show which scores noise alone reaches.

    Shapes: R runs, T samples, C channels.

    Args:
        test: score test of the candidate effects about the model.
        residual: (R, T, C) residual that effects may explain.
        noise_residual: (R, T, C) residual whose spectrum the surrogates have.
        observed_mask: (R, T, C) whether a sample is recorded.
        rng: random generator of the surrogates.
    """
    return compute_calibrated_scores(
        test,
        residual,
        lambda count: draw_surrogates(
            noise_residual, observed_mask, count, rng, project_out=test.project_out
        ),
        SURROGATE_COUNT,
    )
