"""Result of a search for causes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bench.diagnosis.fitting.base_fit import BaseFit
from bench.diagnosis.fitting.fitted_models import FittedModel
from bench.diagnosis.pipeline.base_model import BaseModel
from bench.diagnosis.pipeline.parameter_estimates import ParameterEstimates
from bench.diagnosis.pipeline.simulated_runs import SimulatedRuns
from bench.diagnosis.search.diagnose import DiagnosisResult
from bench.diagnosis.search.effect_search import EffectSearch
from bench.diagnosis.verdict import RecordingFault

EXPLAINED_VERDICTS = ("adequate", "named", "ambiguous")
"""Verdicts for which the model explains the data down to the noise."""


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Result of a search for causes.

    Attributes:
        base: base model from which it started.
        search: the search, with its fitted models.
        finding: outcome of the search.
        rng: random generator of the search.
        errors: wrong units and signs of the recording.
    """

    base: BaseModel
    search: EffectSearch
    finding: DiagnosisResult
    rng: np.random.Generator
    errors: tuple[RecordingFault, ...] = ()

    @property
    def runs(self) -> SimulatedRuns:
        """Runs that were explained."""
        return self.base.runs

    @property
    def searched_base(self) -> BaseModel:
        """The best fit of the base model, which the search may have improved."""
        search = self.search
        return BaseModel(self.runs, BaseFit(search.base_model.fit, search.fixed_parameters))

    @cached_property
    def estimates(self) -> ParameterEstimates:
        """Estimates of the parameters and coefficients of the found model."""
        return self.estimate(self.finding.model)

    def estimate(self, model: FittedModel) -> ParameterEstimates:
        """Return the estimates of a model of the search, which may have ended early."""
        stop = self.finding.early_stop
        is_finished = stop is None or "base_fit" not in stop.skipped_questions
        return ParameterEstimates(self.search, model, is_finished)

    @property
    def is_explained(self) -> bool:
        """Return whether the result explains the data down to the noise."""
        return self.finding.verdict in EXPLAINED_VERDICTS

    @property
    def has_ended(self) -> bool:
        """Return whether no other numerical settings are tried.

        This is so if the recording has errors, or if the search has to end.
        """
        is_stopped = self.finding.early_stop is not None
        return bool(self.errors) or is_stopped or self.runs.context.search_control.is_over()

    def list_models_with_alternatives(self) -> list[FittedModel]:
        """List the fitted models with an alternative in place of one of the causes.

        The alternatives explain the data as well as the cause, and an experiment should distinguish
        them. The strongest cause with fitted alternatives is replaced; the most plausible
        alternative comes first. The list is empty if no cause has alternatives.
        """
        for cause in self.finding.causes:
            others = {name for name in self.finding.model.effects if name != cause.effect}
            # Fitted models are found by the set of their effects.
            keys = [frozenset({*others, effect}) for effect in cause.alternatives]
            competing_models = [
                self.search.models[key] for key in keys if key in self.search.models
            ]
            if competing_models:
                return competing_models
        return []

    def rate(self) -> tuple[float, float]:
        """Return the penalised log-likelihood and the excess RMS residual of the found model."""
        return rate_model(self.search, self.finding.model)


def rate_model(search: EffectSearch, model: FittedModel) -> tuple[float, float]:
    """Return the penalised log-likelihood and the excess RMS residual of a fitted model.

    Args:
        search: search with the noise that defines the excess.
        model: the fitted model.
    """
    return model.penalised_log_likelihood, search.compute_excess_residual(model)
