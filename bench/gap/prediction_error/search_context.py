"""What the steps of a search by prediction errors share."""

from __future__ import annotations

from dataclasses import dataclass

from bench.gap.causes.search import Search
from bench.gap.model.world import World
from bench.gap.prediction_error.effect_proposals import EffectProposals
from bench.gap.prediction_error.library_columns import LibraryColumns
from bench.gap.prediction_error.model_filters import ModelFilters


@dataclass(frozen=True)
class SearchContext:
    """The state of a search.

    Attributes:
        models: what has been fitted by simulation.
        filters: filters with effects in the model.
        columns: columns of regressions.
        proposals: effects that a set may lack.
    """

    models: Search
    filters: ModelFilters
    columns: LibraryColumns
    proposals: EffectProposals

    @classmethod
    def of(cls, models: Search) -> SearchContext:
        """Return the context of a search that begins."""
        filters = ModelFilters(models)
        columns = LibraryColumns(filters)
        return cls(models, filters, columns, EffectProposals(filters, columns))

    @property
    def world(self) -> World:
        """The runs for fitting."""
        return self.models.world
