"""Search moves between models: drop, simplify or swap effects.

Forward selection never removes an effect, and its first choice is often one effect that mimics two.
Dropping and exchanging effects of the larger model corrects this (A. Miller, Subset Selection in
Regression, 2nd ed., 2002, doi:10.1201/9781420035933, chapter 3).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import chain

import numpy as np

from bench.diagnosis.fitting.fit_state import FitStart
from bench.diagnosis.fitting.model_set import FittedModel
from bench.diagnosis.search.scored_models import ScoredModelSet
from sims.core.simulator import Array

MAX_REFITTED_CANDIDATES = 7
"""Maximum number of top-scoring candidates that are refitted about one model."""
MAX_SWAP_ROUNDS = 2
"""Maximum number of consecutive exchanges of one effect."""
MAX_RICHER_LAW_EXCESS_RATIO = 0.95
"""Maximum excess of a model with a richer law, as a share of the excess with the simpler law.

Above this share, the simpler law is used instead.
"""
MIN_SCORE_GAIN = 1e-6
"""Minimum gain in merit of an exchange; smaller gains are rounding."""

EffectStarts = dict[str, Array]
"""Effects with their initial coefficients."""


@dataclass
class ModelMoves(ScoredModelSet):
    """Scored models, and the moves from one to another."""

    _lessened: set[frozenset[str]] = field(default_factory=set)
    _simplified: set[tuple[frozenset[str], frozenset[str]]] = field(default_factory=set)

    def remove_effect(self, model: FittedModel, name: str) -> FittedModel:
        """Return the model with one of its effects removed.

        Args:
            model: the model.
            name: name of the effect.
        """
        remaining_effects = frozenset(n for n in model.effects if n != name)
        if remaining_effects not in self.models:
            self._fit_without(model, [name])
        return self.models[remaining_effects]

    def _fit_without(self, model: FittedModel, names: Iterable[str]) -> None:
        """Fit and store the models that lack one of the effects `names`.

        Each fit starts from the present parameters and initial states of the model.
        """
        starts = []
        for name in names:
            # Zero coefficients switch the effect off, and they are not fitted; all else starts as
            # it is.
            theta = model.fit.theta.copy()
            theta[self.evaluator.coefficient_slices[name]] = 0.0
            remaining_effects = tuple(n for n in model.effects if n != name)
            known_jacobian = model.fit.get_known_jacobian().drop_parameters(
                self.evaluator.get_coefficient_indices(name)
            )
            starts.append(
                FitStart(remaining_effects, theta, model.fit.initial_states, known_jacobian)
            )
        self.refit_models(starts)

    def drop_unneeded_effects(self, model: FittedModel) -> FittedModel:
        """Return the model without effects that it does not need.

        Each smaller model is fitted from the larger one, even if it is known.
        """
        key = frozenset(model.effects)
        # From here, the smaller model may reach a minimum that was missed when it was built up.
        if len(model.effects) > 1 and key not in self._lessened:
            self._lessened.add(key)
            self._fit_without(model, model.effects)
        for name in model.effects:
            submodel = self.remove_effect(model, name)
            if submodel.penalised_log_likelihood >= model.penalised_log_likelihood:
                return self.drop_unneeded_effects(submodel)
        return model

    def simplify_laws(self, model: FittedModel) -> FittedModel:
        """Return the model with richer laws and families replaced by simpler ones.

        A law is replaced by one or all of the simpler laws that it contains, and a family by its
        most active member, if the simpler model has at least the same merit or nearly the same
        excess.
        """
        for name in model.effects:
            for parts in self._iterate_contained_effects(model, name):
                simpler_model = self._fit_with_parts(model, name, parts)
                is_excess_close = (
                    self.compute_excess_residual(model)
                    > MAX_RICHER_LAW_EXCESS_RATIO * self.compute_excess_residual(simpler_model)
                    > 0.0
                )
                if (
                    simpler_model.penalised_log_likelihood >= model.penalised_log_likelihood
                    or is_excess_close
                ):
                    return self.simplify_laws(simpler_model)
        return model

    def _iterate_contained_effects(self, model: FittedModel, name: str) -> Iterator[EffectStarts]:
        """Yield simpler effects that may replace an effect, with initial coefficients.

        They are the simpler laws at the same place, one by one and all together, and the most
        active member of a family.
        """
        effects, slots = self.evaluator.available_effects, self.evaluator.coefficient_slices
        coefficients = model.fit.theta[slots[name]]
        part_coefficients, begin = EffectStarts(), 0
        for part in effects[name].contains:
            if part in effects and effects[part].place == effects[name].place:
                # The scaling coefficient of a contained law comes first in the law that contains
                # it.
                end = begin + slots[part].stop - slots[part].start
                part_coefficients[part], begin = coefficients[begin:end], end
        yield from ({part: c} for part, c in part_coefficients.items())
        # If the shape parameter of a law lies outside the range of the data, the law acts as the
        # sum of its parts. One law with a time far longer than the runs replaces two simpler laws,
        # and fits the data immediately.
        if len(part_coefficients) > 1:
            yield part_coefficients
        members = getattr(effects[name], "members", ())
        coefficient_count = len(members[0].coefficients) if members else 0
        # A coefficient shared by all places says nothing about a single place.
        if len(members) > 1 and coefficients.size == coefficient_count * len(members):
            free = model.fit.free_indices.tolist()
            columns = [free.index(place) for place in self.evaluator.get_coefficient_indices(name)]
            responses = np.sqrt(np.square(model.fit.jacobian[..., columns]).sum(axis=(0, 1, 2)))
            sizes = (
                (np.abs(coefficients) * responses)
                .reshape(len(members), coefficient_count)
                .max(axis=1)
            )
            largest_member = int(np.argmax(sizes))
            yield {
                members[largest_member].name: coefficients[
                    coefficient_count * largest_member : coefficient_count * (largest_member + 1)
                ]
            }

    def _fit_with_parts(self, model: FittedModel, name: str, parts: EffectStarts) -> FittedModel:
        """Fit the model with the simpler effects `parts` in place of the richer effect `name`.

        All other parameters start from their present values. A model that was already fitted from
        here is not fitted again.
        """
        replaced = ([*parts] if n == name else [n] for n in model.effects)
        names = tuple(dict.fromkeys(chain.from_iterable(replaced)))
        key, step = frozenset(names), (frozenset(model.effects), frozenset(names))
        # A known model may be at a poor local minimum, so it is fitted again unless it is better.
        is_fit_needed = (
            key not in self.models
            or self.models[key].penalised_log_likelihood < model.penalised_log_likelihood
        )
        if is_fit_needed and step not in self._simplified:
            self._simplified.add(step)
            theta = model.fit.theta.copy()
            theta[self.evaluator.coefficient_slices[name]] = 0.0
            for part, c in parts.items():
                theta[self.evaluator.coefficient_slices[part]] += c
            return self.fit_one(FitStart(names, theta, model.fit.initial_states))
        return self.models[key]

    def swap_effect(self, model: FittedModel) -> FittedModel:
        """Replace one effect at a time by a better one, while that improves the model.

        Each effect in turn is removed, and the smaller model is extended by the most promising
        effects.
        """
        for _ in range(MAX_SWAP_ROUNDS):
            # Each smaller model is extended again, because the removed effect may not be the best.
            self.refit_extensions(
                [self.remove_effect(model, name) for name in model.effects], MAX_REFITTED_CANDIDATES
            )
            better = self.get_best(len(model.effects))
            if (
                better is None
                or better.penalised_log_likelihood
                <= model.penalised_log_likelihood + MIN_SCORE_GAIN
            ):
                break
            model = self.drop_unneeded_effects(better)
        return model
