"""Shared state of the steps of a search by prediction errors."""

from __future__ import annotations

from dataclasses import dataclass

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.prediction_error.effect_proposals import EffectProposals
from bench.diagnosis.prediction_error.library_columns import LibraryColumns
from bench.diagnosis.prediction_error.model_filters import ModelFilters
from bench.diagnosis.search.effect_search import EffectSearch


@dataclass(frozen=True)
class SearchContext:
    """Shared state of a search.

    Attributes:
        search: the search, with all models fitted by simulation.
        filters: filters with effects in the model.
        columns: columns of regressions.
        proposals: effects that a set may lack.
    """

    search: EffectSearch
    filters: ModelFilters
    columns: LibraryColumns
    proposals: EffectProposals

    @classmethod
    def of(cls, search: EffectSearch) -> SearchContext:
        """Create the context of a new search."""
        filters = ModelFilters(search)
        columns = LibraryColumns(filters)
        return cls(search, filters, columns, EffectProposals(filters, columns))

    @property
    def world(self) -> RunEvaluator:
        """The runs for fitting."""
        return self.search.world
