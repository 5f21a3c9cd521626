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

from bench.diagnosis.fitting.fitted_models import FittedModel
from bench.diagnosis.fitting.levenberg_marquardt_state import FitStart
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
    """Scored models, and the moves from one to another.

    `_reduced_effect_sets` has the models (as sets of effects) whose effects were removed one by one
    already, and `_fitted_simplifications` the pairs of a model and its simplification that were
    fitted already.
    """

    _reduced_effect_sets: set[frozenset[str]] = field(default_factory=set)
    _fitted_simplifications: set[tuple[frozenset[str], frozenset[str]]] = field(default_factory=set)

    def remove_effect(self, model: FittedModel, name: str) -> FittedModel:
        """Return the model with one of its effects removed.

        Args:
            model: fitted model: its effects, parameters, initial states and likelihood.
            name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
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

        An effect is not needed if the model without it has at least the same penalised
        log-likelihood. Each smaller model is fitted from the larger one, even if it is known.
        Effects are dropped one at a time.
        """
        key = frozenset(model.effects)
        # From here, the smaller model may reach a minimum that was missed when it was built up.
        if len(model.effects) > 1 and key not in self._reduced_effect_sets:
            self._reduced_effect_sets.add(key)
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
            for parts in self._iterate_simpler_effects(model, name):
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

    def _iterate_simpler_effects(self, model: FittedModel, name: str) -> Iterator[EffectStarts]:
        """Yield simpler effects that may replace an effect, with initial coefficients.

        They are the simpler laws that the effect contains at the same joint or body, one by one and
        all together, and the most active member of a family (one effect at all joints or bodies).

        Args:
            model: fitted model: its effects, parameters, initial states and likelihood.
            name: name of the effect to replace.
        """
        contained_laws = self._split_into_contained_laws(model, name)
        yield from ({law: c} for law, c in contained_laws.items())
        # If the shape parameter of a law lies outside the range of the data, the law acts as the
        # sum of its parts. One law with a time far longer than the runs replaces two simpler laws,
        # and fits the data immediately.
        if len(contained_laws) > 1:
            yield contained_laws
        yield from self._find_dominant_member(model, name)

    def _split_into_contained_laws(self, model: FittedModel, name: str) -> EffectStarts:
        """Return the simpler laws that an effect contains, with its fitted coefficients.

        For example, Stribeck friction contains Coulomb friction. The scaling coefficients of the
        contained laws come first among the coefficients of the effect, in the order in which it
        names the laws.

        Args:
            model: fitted model: its effects, parameters, initial states and likelihood.
            name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
        """
        effects = self.evaluator.available_effects
        coefficient_slices = self.evaluator.coefficient_slices
        coefficients = model.fit.theta[coefficient_slices[name]]
        laws, begin = EffectStarts(), 0
        for law in effects[name].contains:
            if law in effects and effects[law].place == effects[name].place:
                end = begin + coefficient_slices[law].stop - coefficient_slices[law].start
                laws[law], begin = coefficients[begin:end], end
        return laws

    def _find_dominant_member(self, model: FittedModel, name: str) -> Iterator[EffectStarts]:
        """Yield the member of a family that changes the runs most, with its coefficients.

        The members are one effect at several joints or bodies. Nothing is yielded for other
        effects, or if the members share their coefficients.

        Args:
            model: fitted model: its effects, parameters, initial states and likelihood.
            name: name of the family.
        """
        members = getattr(self.evaluator.available_effects[name], "members", ())
        indices = self.evaluator.get_coefficient_indices(name)
        per_member = len(members[0].coefficients) if members else 0
        if len(members) < 2 or len(indices) != per_member * len(members):
            return
        coefficients = model.fit.theta[indices].reshape(len(members), per_member)
        free_indices = model.fit.free_indices.tolist()
        columns = [free_indices.index(index) for index in indices]
        # Change of all samples per unit of each coefficient (root of the sum of squares).
        responses = np.sqrt(np.square(model.fit.jacobian[..., columns]).sum(axis=(0, 1, 2)))
        changes = np.abs(coefficients) * responses.reshape(coefficients.shape)
        largest = int(np.argmax(changes.max(axis=1)))
        yield {members[largest].name: coefficients[largest]}

    def _fit_with_parts(self, model: FittedModel, name: str, parts: EffectStarts) -> FittedModel:
        """Fit the model with simpler effects in place of a richer one.

        All other parameters start from their present values. A model that was already fitted from
        here is not fitted again.

        Args:
            model: fitted model with the richer effect.
            name: the richer effect.
            parts: the simpler effects, with coefficients to start from.
        """
        effects_of_each = ([*parts] if n == name else [n] for n in model.effects)
        names = tuple(dict.fromkeys(chain.from_iterable(effects_of_each)))
        key = frozenset(names)
        simplification = frozenset(model.effects), key
        # A known model may be at a poor local minimum, so it is fitted again unless it is better.
        is_fit_needed = (
            key not in self.models
            or self.models[key].penalised_log_likelihood < model.penalised_log_likelihood
        )
        if is_fit_needed and simplification not in self._fitted_simplifications:
            self._fitted_simplifications.add(simplification)
            theta = model.fit.theta.copy()
            theta[self.evaluator.coefficient_slices[name]] = 0.0
            for part, coefficients in parts.items():
                theta[self.evaluator.coefficient_slices[part]] += coefficients
            return self.fit_one(FitStart(names, theta, model.fit.initial_states))
        return self.models[key]

    def swap_effect(self, model: FittedModel) -> FittedModel:
        """Replace one effect at a time by a better one, while that improves the model.

        Each effect in turn is removed, and the smaller model is extended by the most promising
        effects. The best model of the size then loses effects that it does not need.
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
