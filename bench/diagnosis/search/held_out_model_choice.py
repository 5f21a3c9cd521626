"""Validation of the models of a search on held-out runs.

If there are too few runs to hold one out, each run is predicted by fits to the others
(`validation.held_out_runs`), and counts as held out. An effect that makes held-out predictions
worse is dropped. A discrepancy that only held-out runs show is something that the model does not
contain. Between models that explain the fitted runs equally well, the held-out likelihood counts,
too.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from bench.diagnosis.fitting.fitted_models import EffectNames, FittedModel
from bench.diagnosis.search.effect_search import MAX_PAIR_EXCESS_SHARE_OF_SINGLE, EffectSearch
from bench.diagnosis.search.lack_of_fit import LackOfFitResult
from bench.diagnosis.search.verdict_rules import (
    HELD_OUT_EXCESS_THRESHOLD,
    INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO,
    compute_excess_ratio,
    explains_gap,
    improves_held_out,
    is_indistinguishable,
    misses_held_out_gap,
)
from bench.diagnosis.validation.held_out_runs import HeldOutFit, Validation
from sims.core.simulator import Array

CLEARLY_CLOSED = 0.5
"""Maximum excess on fitted runs, as a share of that without the effect, to keep the effect.

It applies to an effect that improves the held-out runs only slightly.
"""
MAX_RICHER_MODELS = 8
"""Maximum number of models that contain the result and are evaluated on held-out runs."""


@dataclass(frozen=True)
class HeldOutValidation:
    """Models evaluated on held-out runs.

    Attributes:
        runs: predicts the held-out runs, or each run by cross-validation.
        held_out_fits: evaluated models, by their effects.
    """

    runs: Validation
    held_out_fits: dict[EffectNames, HeldOutFit] = field(default_factory=dict)

    def evaluate_models(self, models: Iterable[FittedModel]) -> None:
        """Predict the held-out runs with each model, and store the results by its effects.

        The models are evaluated together, because the initial states of a model that predicts badly
        are fitted again from those of the model that predicts best.
        """
        # Stored by effects, so that a repeated model is simulated only once.
        models_by_effects = {model.effects: model for model in models}
        results = self.runs.validate([model.fit for model in models_by_effects.values()])
        self.held_out_fits.update(zip(models_by_effects, results, strict=True))

    def compute_excess_residual(self, names: EffectNames, sigma: Array | None = None) -> float:
        """Return the RMS residual of a model on the held-out runs in units of the noise, minus one.

        Args:
            names: effects of a model that has been evaluated.
            sigma: (C,) noise of each channel; None for the noise of the runs.
        """
        runs = self.runs
        noise = runs.noise.sigma if sigma is None else sigma
        residual = runs.evaluator.observed - self.held_out_fits[names].simulated
        scaled = residual / noise
        # The mask `seen` selects the recorded samples.
        squares = np.square(scaled[runs.seen])
        return float(np.sqrt(squares.mean())) - 1.0

    def drop_unhelpful_effects(self, search: EffectSearch, model: FittedModel) -> FittedModel:
        """Return the model without the effects that held-out runs do not confirm.

        An effect is not confirmed if it makes held-out predictions worse, or hardly better while
        the excess residual is large. Effects are dropped one at a time. Only models that were
        evaluated on held-out runs are compared.

        Args:
            search: search with all fitted models.
            model: fitted model whose effects are tested.
        """
        while model.effects and model.effects in self.held_out_fits:
            # Models that lack one effect of the model.
            submodels = self._list_smaller_models(search, model)
            better_submodels = [
                smaller_model
                for smaller_model in submodels
                if not self._improves_prediction(search, smaller_model, model)
            ]
            if not better_submodels:
                return model
            # If several effects do not help, drop the one without which held-out runs are predicted
            # best.
            model = max(
                better_submodels,
                key=lambda smaller_model: (
                    self.held_out_fits[smaller_model.effects].penalised_log_likelihood
                ),
            )
        return model

    def find_better_extension(self, search: EffectSearch, model: FittedModel) -> FittedModel:
        """Return the extension of a model that held-out runs confirm best, or the model itself.

        If the residual has structure, likelihoods on fitted runs are unreliable, because each model
        mimics what is missing. A clearly lower residual on runs that were not fitted is reliable.

        Args:
            search: search with all fitted models.
            model: best model of the search, which has been evaluated on held-out runs.

        Returns:
            The best extension, without effects that do not help on held-out runs; the given model
            if no extension is clearly better, or if none of its further effects helps.
        """
        names = set(model.effects)
        # An extension has all effects of the model and further ones. Those that fit the runs best
        # (lowest cost) are compared.
        extensions = [m for m in search.models.values() if names < set(m.effects)]
        extensions = sorted(extensions, key=lambda m: m.fit.cost)[:MAX_RICHER_MODELS]
        fitted_models = search.models.values()
        # They show which effects of an extension do not help.
        submodels = [
            m
            for m in fitted_models
            if any(set(m.effects) < set(extension.effects) for extension in extensions)
        ]
        # The model is evaluated again: all initial states start from those of the model that
        # predicts best.
        self.evaluate_models([model, *extensions, *submodels])
        relative_excesses = {
            m.effects: self._compute_relative_excess(search, model, m) for m in extensions
        }
        best = min(extensions, key=lambda m: relative_excesses[m.effects], default=model)
        if best is model or not relative_excesses[best.effects] < 1.0:
            return model
        reduced_model = self.drop_unhelpful_effects(search, best)
        # The result must still contain the model.
        return reduced_model if names < set(reduced_model.effects) else model

    def _compute_relative_excess(
        self, search: EffectSearch, model: FittedModel, larger: FittedModel
    ) -> float:
        """Return the excess of a larger model relative to what its further effects must achieve.

        The excess is the RMS residual in units of the noise, minus one. Each further effect must
        reduce it by a factor. The value is one if the reduction is just enough; the worse of fitted
        and held-out runs counts.

        Args:
            search: the search, which computes the excess on the fitted runs.
            model: model with fewer effects.
            larger: a model with all its effects and further ones.
        """
        # Ratio of the excesses that all further effects must achieve together.
        required_ratio = MAX_PAIR_EXCESS_SHARE_OF_SINGLE ** (
            len(larger.effects) - len(model.effects)
        )
        fitted_ratio = compute_excess_ratio(
            search.compute_excess_residual(larger), search.compute_excess_residual(model)
        )
        held_out_ratio = compute_excess_ratio(
            self.compute_excess_residual(larger.effects),
            self.compute_excess_residual(model.effects),
        )
        return max(fitted_ratio, held_out_ratio) / required_ratio

    def _list_smaller_models(self, search: EffectSearch, model: FittedModel) -> list[FittedModel]:
        """Return the evaluated models that consist of the model without one of its effects.

        Args:
            search: the search, with all fitted models.
            model: fitted model: its effects, parameters, initial states and likelihood.
        """
        names = set(model.effects)
        size = len(names) - 1
        submodels = []
        for other_model in search.models.values():
            # A model that was not evaluated on held-out runs cannot be compared there.
            if other_model.effects not in self.held_out_fits:
                continue
            if len(other_model.effects) == size and set(other_model.effects) < names:
                submodels.append(other_model)
        return submodels

    def _improves_prediction(
        self, search: EffectSearch, reduced_model: FittedModel, full_model: FittedModel
    ) -> bool:
        """Return whether the effect by which two models differ improves held-out predictions.

        The excess residual is the RMS residual in units of the noise, minus one. One of these
        criteria must hold:

        1. Likelihood and excess residual of held-out runs improve.
        2. They improve a little, and the effect closes most of the gap on the fitted runs.
        3. Held-out runs hardly show the effect, and it explains the gap on the fitted runs.

        Args:
            search: search that fitted the models to the fitted runs.
            reduced_model: model without the effect.
            full_model: model with the effect.
        """
        # Without the effect (before) and with it (after).
        before = self.held_out_fits[reduced_model.effects].penalised_log_likelihood
        after = self.held_out_fits[full_model.effects].penalised_log_likelihood
        excess_before = self.compute_excess_residual(reduced_model.effects)
        excess_after = self.compute_excess_residual(full_model.effects)
        # 1. Clear improvement.
        # Far from the noise, a higher likelihood alone may only mimic another effect.
        if improves_held_out((before, after), (excess_before, excess_after)):
            return True
        fitted_excess_before = search.compute_excess_residual(reduced_model)
        fitted_excess_after = search.compute_excess_residual(full_model)
        # 2. Small improvement.
        # Errors of a motion without feedback accumulate, whatever their cause, so that a right
        # effect may reduce the excess only a little.
        is_better = (
            after > before + INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO and excess_after < excess_before
        )
        if is_better and fitted_excess_after < CLEARLY_CLOSED * fitted_excess_before:
            return True
        # 3. Not visible on held-out runs.
        # A limit that no held-out run approaches cannot be tested there; the result would be
        # random.
        is_hardly_visible = max(
            excess_before, excess_after
        ) < HELD_OUT_EXCESS_THRESHOLD and is_indistinguishable(before - after)
        return (
            is_hardly_visible
            and fitted_excess_before > HELD_OUT_EXCESS_THRESHOLD
            and explains_gap((fitted_excess_before - fitted_excess_after) / fitted_excess_before)
        )

    def has_unexplained_gap(self, model: FittedModel, lack_of_fit: LackOfFitResult) -> bool:
        """Return whether held-out runs show a discrepancy that the model does not remove.

        Args:
            model: the model, which has been evaluated.
            lack_of_fit: lack-of-fit test of the model, which tells whether its residual on the
                fitted runs has structure.
        """
        noise = self.runs.noise.sigma
        # The residual of the fitted runs is noise if it has no structure. The sigma of a channel
        # without samples is NaN.
        if not lack_of_fit.has_structure:
            noise = np.maximum(noise, np.nan_to_num(model.likelihood.sigma))
        # The base model has no effects.
        before = self.compute_excess_residual((), noise)
        after = self.compute_excess_residual(model.effects, noise)
        return misses_held_out_gap(before, after)
