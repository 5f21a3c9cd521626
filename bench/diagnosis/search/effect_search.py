"""Beam search for the set of effects that explains a recording: add, drop, simplify, swap effects.

Linear scores select candidates, full fits decide, and moves between models correct errors. Forward
selection alone is not enough: if two effects act, the first choice is often a third effect that
mimics both. Therefore several models are extended (beam search), and each larger model is compared
with those that lack or replace one of its effects (A. Miller, Subset Selection in Regression, 2nd
ed., 2002, doi:10.1201/9781420035933, chapter 3).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain

import numpy as np

from bench.diagnosis.fitting.fitted_models import FittedModel, ModelSet, select_likeliest
from bench.diagnosis.fitting.levenberg_marquardt import FitStart
from bench.diagnosis.fitting.multiple_shooting import (
    forgets_initial_state,
    join_segment_fits,
    make_segment_evaluator,
)
from bench.diagnosis.search.scored_models import ScoredModelSet
from bench.diagnosis.search.verdict_rules import EFFECT_P_VALUE_THRESHOLD
from sims.core.simulator import Array

MAX_P_VALUE_FIRST_EFFECT = 0.1
"""Maximum p-value of the linear scores at which a first effect is tried by simulation."""
MAX_P_VALUE_FURTHER_EFFECT = 0.015
"""Maximum p-value of the linear scores at which a further effect is tried by simulation."""
MAX_EFFECTS = 3
"""Maximum number of effects in a model."""
FAR_EXCESS = 0.5
"""Minimum excess over the noise at which the search continues although no effect was added."""
MAX_PAIR_EXCESS_SHARE = 0.5
"""Maximum share of the base model's excess left by two effects at which a third is tried."""
MAX_PAIR_EXCESS_SHARE_OF_SINGLE = 0.85
"""Maximum excess of a model with two effects at which a third is tried, relative to single effects.

It is a share of the excess of the best single effect. Above it, no effect of the library explains
the residual.
"""
MAX_REPLACEMENT_EXCESS_SHARE = 0.5
"""Maximum excess of a model that replaces effects of a smaller one, as a share of its excess."""
MAX_EFFECTS_ON_SEGMENTS = 2
"""Maximum number of effects of models that are searched on short segments."""
SEGMENT_MODELS_KEPT = 5
"""Number of best models on short segments that are fitted to the whole runs."""
STEP_CORRECTION_REFIT_DISTANCE = 100.0
"""Maximum distance of models that are refitted after a discretisation correction.

It is a difference in penalised log-likelihood.
"""
BEAM_WIDTH = 3
"""Maximum number of models with the highest penalised log-likelihood that are extended."""
BEAM_WIDTH_BY_SQUARES = 2
"""Number of models with the lowest sum of squares that are extended in addition."""
MIN_RELATIVE_GAIN_IN_BEAM = 0.5
"""Minimum gain of a model in the beam, as a share of the gain of the best model."""
MAX_REFITTED_CANDIDATES = 7
"""Maximum number of top-scoring candidates that are refitted about one model."""
MAX_SWAP_ROUNDS = 2
"""Maximum number of consecutive exchanges of one effect."""
MAX_RICHER_LAW_EXCESS_RATIO = 0.95
"""Maximum excess of a model with a richer law, as a share of the excess with the simpler law.

Above this share, the simpler law is used instead.
"""
MIN_SCORE_GAIN = 1e-6
"""Minimum gain in penalised log-likelihood of an exchange; smaller gains are rounding."""

EffectStarts = dict[str, Array]
"""Effects with their initial coefficients."""


@dataclass
class EffectSearch(ScoredModelSet):
    """Search from the base model to the model of all effects that the data show.

    Attributes:
        best_supported_model: the model that the data support so far.
        settled_effects: effects of a model that was already compared with all its neighbours on
            thinned runs.
        step_corrected_effects: effects of the model for which the discretisation error was last
            corrected.
        thorough: whether the search continues while the models with the lowest excess improve, even
            if the model that it extends does not.

    `_reduced_effect_sets` has the models (as sets of effects) whose effects were removed one by one
    already, and `_fitted_simplifications` the pairs of a model and its simplification that were
    fitted already.
    """

    best_supported_model: FittedModel | None = None
    settled_effects: frozenset[str] | None = None
    step_corrected_effects: frozenset[str] | None = None
    thorough: bool = False
    _segment_search: EffectSearch | None = None
    _reduced_effect_sets: set[frozenset[str]] = field(default_factory=set)
    _fitted_simplifications: set[tuple[frozenset[str], frozenset[str]]] = field(default_factory=set)

    def run(self) -> FittedModel:
        """Return the model of all effects that the data show (beam search).

        Models are stored by their effects. The base model has none. For each number of effects:

        1. Stop if neither scores nor residual suggest a further effect.
        2. Fit models with one more effect.
        3. Accept the best of them if its gain is significant.
        4. Otherwise continue only if the residual of the best model is far above the noise: if two
           effects explain the data only together, neither gains much alone.
        5. Stop if the larger model is still far from the data.
        """
        best = self.base_model
        for effect_count in range(1, MAX_EFFECTS + 1):
            # Stored for a search that has to end early.
            self.best_supported_model = best
            # 1. Completeness.
            # A further effect requires stronger evidence than the first one.
            if self.is_complete(
                best, MAX_P_VALUE_FURTHER_EFFECT if best.effects else MAX_P_VALUE_FIRST_EFFECT
            ):
                break
            # 2. One more effect.
            larger = self._search_size(best, effect_count)
            # No model of this size could be fitted.
            if larger is None:
                break
            # 3. Significant gain.
            if (
                larger.penalised_log_likelihood > best.penalised_log_likelihood
                and self.compute_missing_effect_p_value(best, larger) <= EFFECT_P_VALUE_THRESHOLD
            ):
                best = self.correct_step_errors(larger)
            # 4. No significant gain.
            # Near the noise, or if the residual may be noise, adding two effects at once would fit
            # noise.
            elif self.compute_excess_residual(best) < FAR_EXCESS or self.is_noise_like(best):
                break
            # 5. No progress.
            # The missing effect is then not in the library, and three effects would only mimic it.
            if effect_count > 1 and is_hopeless(self, larger):
                break
        self.best_supported_model = best
        return best

    def correct_step_errors(self, model: FittedModel) -> FittedModel:
        """Correct the discretisation error about a model, and refit its close competing models.

        Competing models have as many effects, and about the same penalised log-likelihood. A coarse
        time step of a robot's simulator causes an error that an effect may imitate. After the
        correction, another model may be better, possibly with a simpler effect; it is returned. The
        correction is undone if the best of these models is likelier without it.

        Args:
            model: the fitted model.

        Returns:
            The best model with as many effects after the correction; the given one for systems that
            are not robots, or if the correction was last made about the same effects.
        """
        key = frozenset(model.effects)
        # Only robots are corrected, and not twice in succession about the same effects.
        if not self.evaluator.has_linearisation or key == self.step_corrected_effects:
            return model
        self.step_corrected_effects = key
        # Imported here, because only robots need it.
        from bench.diagnosis.evaluation.discretisation_error import correct_discretisation

        correction_before = self.evaluator.discretisation_correction
        models_before = dict(self.models)
        correct_discretisation(
            self.evaluator, self.noise, model.fit.theta, model.fit.initial_states
        )
        effect_count = len(model.effects)
        # A richer effect may have fitted only the discretisation error.
        close_models = [
            m
            for m in select_by_size(self, effect_count)
            if m.penalised_log_likelihood
            > model.penalised_log_likelihood - STEP_CORRECTION_REFIT_DISTANCE
        ]
        self.refit_models([m.fit.make_start() for m in close_models], is_racing=False)
        # The models are in descending order of their penalised log-likelihood.
        best = select_by_size(self, effect_count)[0]
        # A refit replaces a model only if it is likelier. If the best model is one from before, no
        # corrected model is likelier.
        if models_before.get(frozenset(best.effects)) is best:
            self.evaluator.discretisation_correction = correction_before
        return best

    def get_best_so_far(self) -> FittedModel:
        """Return the best supported model of a search that has to end now, without any simulation.

        A model is supported if the search found its gain over the smaller models significant. The
        base model, which has no effects, always is. The best larger fitted model replaces the
        present one if its penalised log-likelihood is higher and its gain is significant by the
        known scores.
        """
        # The latest fit of these effects.
        best = self.models[frozenset((self.best_supported_model or self.base_model).effects)]
        larger = [m for m in self.models.values() if len(m.effects) > len(best.effects)]
        scores = self.scores_by_effects.get(frozenset(best.effects))
        if scores is None or not larger:
            return best
        best_extension = select_likeliest(*larger)
        gain = best_extension.likelihood.value - best.likelihood.value
        if (
            self.compute_gain_p_value(scores, best_extension, gain) <= EFFECT_P_VALUE_THRESHOLD
            and best_extension.penalised_log_likelihood > best.penalised_log_likelihood
        ):
            return best_extension
        return best

    def _search_size(self, best: FittedModel, size: int) -> FittedModel | None:
        """Fit models of `size` effects, and return the best one after exchanges and simplification.

        The exchange of effects corrects choices of the smaller model that were wrong. A larger
        model that replaces effects of the best smaller one is accepted only for a good reason.

        Args:
            best: the best smaller model.
            size: number of effects.

        Returns:
            The best model, with fewer effects if some were not needed; None if no model of this
            size could be fitted.
        """
        if size > 1:
            self.evaluator.search_control.begin_larger_models()
        larger = self._grow_models(size)
        if larger is None:
            return None
        # A single effect has no others to drop or exchange.
        if size == 1:
            return self.simplify_laws(self._choose_simpler_effect(larger))
        # An unneeded effect is dropped before the exchange, which would only replace it by another
        # unneeded one.
        larger = self.swap_effect(self.drop_unneeded_effects(larger))
        larger = self.drop_unneeded_effects(larger)
        return self.simplify_laws(select_conservative_model(self, best, larger))

    def _grow_models(self, size: int) -> FittedModel | None:
        """Return the best model with `size` effects; None if none could be fitted.

        First only the best smaller model is extended. If that does not explain the data, further
        and slower methods follow: fits to short segments; then, for single effects, fits of all
        candidates, and for more effects, extensions of the other good models (the beam).

        Args:
            size: number of effects of the models.
        """
        # The best smaller models, the likeliest first.
        smaller_models = select_beam(self, size - 1)
        self.refit_extensions(smaller_models[:1], MAX_REFITTED_CANDIDATES)
        # Each further method needs more simulations, so it is skipped if the data are explained.
        if self._is_explained_with(size):
            return self.get_best(size)
        self.refit_from_segments(size)
        if self._is_explained_with(size):
            return self.get_best(size)
        if size == 1:
            self.refit_extensions(smaller_models, MAX_REFITTED_CANDIDATES, fits_all=True)
        else:
            for members in self._group_models(smaller_models[1:]):
                self.refit_extensions(members, MAX_REFITTED_CANDIDATES)
                if self._is_explained_with(size):
                    break
        return self.get_best(size)

    def _is_explained_with(self, size: int) -> bool:
        """Return whether the best model with `size` effects leaves nothing to explain.

        Its residual must be noise, and no effect that it lacks may have a significant score. Scores
        cost many simulations, and are computed only if the residual is noise. It is False if no
        model of this size was fitted.

        Args:
            size: number of effects of the models.
        """
        model = self.get_best(size)
        if model is None:
            return False
        # The discretisation error of a robot's simulator, for example of friction, could be
        # mistaken for a missing effect.
        if self.evaluator.has_linearisation and self.compute_excess_residual(model) < FAR_EXCESS:
            model = self.correct_step_errors(model)
        return self.is_noise_like(model) and self.is_complete(model, EFFECT_P_VALUE_THRESHOLD)

    def _group_models(
        self, competing_models: Sequence[FittedModel]
    ) -> Sequence[Sequence[FittedModel]]:
        """Return groups of models to extend together.

        For a robot, whose simulations are expensive, models are extended one by one until the data
        are explained; otherwise all of them together.
        """
        if self.evaluator.has_linearisation:
            return [[competing_model] for competing_model in competing_models]
        return [competing_models]

    def refit_from_segments(self, size: int) -> None:
        """Search on short segments of the runs, and refit the best models to whole runs.

        Each segment has its own initial state, so errors accumulate less and fits have fewer local
        minima (multiple shooting). The refitted models are stored in `models`. The search is
        skipped if segments are no easier to fit than whole runs, and for more than
        `MAX_EFFECTS_ON_SEGMENTS` effects.

        Args:
            size: number of effects of the models that are searched.
        """
        if size > MAX_EFFECTS_ON_SEGMENTS or self._forgets_initial_state:
            return
        segment_evaluator = make_segment_evaluator(self.evaluator)
        # The runs cannot be split.
        if segment_evaluator is None:
            return
        # One search on segments serves every size, beginning with the base model; it decides
        # nothing, and only provides starts.
        if self._segment_search is None:
            self._segment_search = EffectSearch(
                segment_evaluator,
                noise=self.noise,
                fixed_parameters=self.fixed_parameters,
                rng=self.make_rng("pieces"),
                is_noise_stated=self.is_noise_stated,
            )
            # The base model, which has no effects.
            self._segment_search.refit_models(
                [FitStart((), self.base_model.fit.theta, segment_evaluator.initial_state_guesses)]
            )
        segment_search = self._segment_search
        segment_search.refit_extensions(
            select_beam(segment_search, size - 1), MAX_REFITTED_CANDIDATES
        )
        best_models = select_by_size(segment_search, size)[:SEGMENT_MODELS_KEPT]
        # Whole runs begin at the initial states of their first segments.
        if best_models:
            self.refit_models(
                [join_segment_fits(self.evaluator, model.fit) for model in best_models]
            )

    @cached_property
    def _forgets_initial_state(self) -> bool:
        """True if initial states hardly change the end of the runs, as in strongly damped systems.

        Short segments of the runs are then no easier to fit than whole runs.
        """
        evaluator = self.evaluator
        # Robots have linearised derivatives (R, T, C, s) by the initial states, which all models
        # share; other systems have those of the base fit.
        state_jacobian = (
            evaluator.state_derivatives
            if evaluator.has_linearisation
            else self.base_model.fit.state_jacobian
        )
        return state_jacobian is not None and forgets_initial_state(
            evaluator, self.noise, state_jacobian
        )

    def _choose_simpler_effect(self, single: FittedModel) -> FittedModel:
        """Return the model of a simpler effect in place of a single effect, if it is preferable.

        A simpler effect is one that the effect contains, as Stribeck friction contains Coulomb
        friction. It is preferred if something is still missing, to which the richer effect may have
        adapted, and the richer one does not at least halve the excess residual (RMS residual in
        units of the noise, minus one). Only simpler effects that were fitted already are compared.

        Args:
            single: fitted model with one effect; it is returned if no simpler one is preferable.
        """
        if self.is_complete(single, EFFECT_P_VALUE_THRESHOLD):
            return single
        for name in self.evaluator.available_effects[single.effects[0]].contains:
            simpler_model = self.models.get(frozenset([name]))
            if simpler_model is not None and self.compute_excess_residual(
                single
            ) > MAX_REPLACEMENT_EXCESS_SHARE * self.compute_excess_residual(simpler_model):
                return simpler_model
        return single

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
        """For each name, fit and store the model without this effect.

        Each fit starts from the present parameters and initial states of the model.

        Args:
            model: fitted model with all effects.
            names: names of effects of the model, which are removed one at a time.
        """
        starts = []
        for name in names:
            # Zero coefficients switch the effect off, and they are not fitted; all else starts as
            # it is, except richer laws that contain this one and act in its place.
            theta = model.fit.theta.copy()
            remaining_effects = tuple(n for n in model.effects if n != name)
            for richer_law in remaining_effects:
                contained_slices = self.find_contained_slices(richer_law)
                if name in contained_slices:
                    theta[contained_slices[name]] += theta[self.evaluator.coefficient_slices[name]]
            theta[self.evaluator.coefficient_slices[name]] = 0.0
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
        log-likelihood. Effects are dropped one at a time, and the remaining model is tested again.

        Args:
            model: the fitted model.
        """
        key = frozenset(model.effects)
        # Smaller models are fitted again from this one, even if they are known: they may reach a
        # minimum that was missed when they were built up. This is done once for each model.
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

        A law is replaced by one or all of the simpler laws that it contains, and a family (one
        effect at several joints or bodies) by its most active member. The simpler model must have
        at least the same penalised log-likelihood, or nearly the same excess residual (RMS residual
        in units of the noise, minus one). It is then simplified further.

        Args:
            model: the fitted model; it is returned if no simpler model is as good.
        """
        for name in model.effects:
            # The simpler effects that replace the effect together, usually a single one.
            for parts in self._iterate_simpler_effects(model, name):
                simpler_model = self._fit_with_parts(model, name, parts)
                # Without an excess, both models leave only noise, and the ratio means nothing.
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

        Yields:
            One or several simpler effects that replace it together, with their coefficients (k,).
        """
        contained_laws = self._split_into_contained_laws(model, name)
        for law, coefficients in contained_laws.items():
            yield {law: coefficients}
        # If the shape parameter of a law is far from the range of the data, such as a time longer
        # than the runs, the law acts as the sum of the laws that it contains.
        if len(contained_laws) > 1:
            yield contained_laws
        yield from self._find_dominant_member(model, name)

    def _split_into_contained_laws(self, model: FittedModel, name: str) -> EffectStarts:
        """Return the simpler laws that an effect contains, with its fitted coefficients.

        Args:
            model: fitted model: its effects, parameters, initial states and likelihood.
            name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
        """
        slices = self.find_contained_slices(name)
        return {law: model.fit.theta[indices] for law, indices in slices.items()}

    def find_contained_slices(self, name: str) -> dict[str, slice]:
        """Return the simpler laws that an effect contains, with the places of their coefficients.

        For example, Stribeck friction contains Coulomb friction. The scaling coefficients of the
        contained laws come first among the coefficients of the effect, in the order in which it
        names the laws.

        Args:
            name: name of the effect, with its place on a robot: ``drag.linear@elbow``.

        Returns:
            For each law, the slice of theta with its coefficients within those of this effect.
        """
        effects = self.evaluator.available_effects
        slices = dict[str, slice]()
        begin = self.evaluator.coefficient_slices[name].start
        for law in effects[name].contains:
            # A contained effect at another place is a member of a family, and not a simpler law.
            if law in effects and effects[law].place == effects[name].place:
                end = begin + len(self.evaluator.get_coefficient_indices(law))
                slices[law] = slice(begin, end)
                begin = end
        return slices

    def _find_dominant_member(self, model: FittedModel, name: str) -> Iterator[EffectStarts]:
        """Yield the member of a family that changes the runs most, with its coefficients.

        The members are one effect at several joints or bodies. Nothing is yielded for other
        effects, or if the members share their coefficients.

        Shapes: M members with k coefficients each.

        Args:
            model: fitted model: its effects, parameters, initial states and likelihood.
            name: name of the family.
        """
        # Only a family has members; they are all of one kind.
        members = getattr(self.evaluator.available_effects[name], "members", ())
        indices = self.evaluator.get_coefficient_indices(name)
        count_per_member = len(members[0].coefficients) if members else 0
        if len(members) < 2 or len(indices) != count_per_member * len(members):
            return
        coefficients = model.fit.theta[indices].reshape(len(members), count_per_member)  # (M, k)
        # Columns of the Jacobian that belong to these coefficients.
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
        # The parts take the place of the effect. One that the model has already is listed once.
        effects_of_each = ([*parts] if n == name else [n] for n in model.effects)
        names = tuple(dict.fromkeys(chain.from_iterable(effects_of_each)))
        key = frozenset(names)
        simplification = frozenset(model.effects), key
        # A known model may be at a poor local minimum, so it is fitted again unless it is better
        # than the model with the richer effect.
        is_fit_needed = (
            key not in self.models
            or self.models[key].penalised_log_likelihood < model.penalised_log_likelihood
        )
        if is_fit_needed and simplification not in self._fitted_simplifications:
            self._fitted_simplifications.add(simplification)
            theta = model.fit.theta.copy()
            theta[self.evaluator.coefficient_slices[name]] = 0.0
            for part, coefficients in parts.items():
                # A part that the model has already gets the sum of both coefficients.
                theta[self.evaluator.coefficient_slices[part]] += coefficients
            return self.fit_one(FitStart(names, theta, model.fit.initial_states))
        return self.models[key]

    def swap_effect(self, model: FittedModel) -> FittedModel:
        """Replace one effect at a time by a better one, while that improves the model.

        Each effect in turn is removed, and the smaller model is extended by the most promising
        effects. The best model of the size then loses effects that it does not need.

        Args:
            model: the fitted model.

        Returns:
            The improved model; the given one if no exchange improves it.
        """
        for _ in range(MAX_SWAP_ROUNDS):
            # Each smaller model is extended again, because the removed effect may not be the best.
            self.refit_extensions(
                [self.remove_effect(model, name) for name in model.effects], MAX_REFITTED_CANDIDATES
            )
            # The best of all models with as many effects.
            better = self.get_best(len(model.effects))
            if (
                better is None
                or better.penalised_log_likelihood
                <= model.penalised_log_likelihood + MIN_SCORE_GAIN
            ):
                break
            model = self.drop_unneeded_effects(better)
        return model


def select_by_size(models: ModelSet, size: int) -> list[FittedModel]:
    """Return the fitted models with `size` effects, by descending penalised log-likelihood."""
    members = [model for model in models.models.values() if len(model.effects) == size]
    return sorted(members, key=lambda model: -model.penalised_log_likelihood)


def select_beam(search: EffectSearch, size: int) -> list[FittedModel]:
    """Return the models with `size` effects to extend: the likeliest and the nearest to the data.

    The likeliest have the highest penalised log-likelihood. Far from the data it is misleading,
    because AR(1) noise explains almost any residual there. So those with the lowest sum of squares,
    the nearest, are added.

    Args:
        search: the search, with all fitted models.
        size: number of effects of the models.
    """
    members = select_by_size(search, size)
    # Of size 0, there is only the base model.
    if not size or not members:
        return members
    base_likelihood = search.base_model.penalised_log_likelihood
    # The members are in descending order of their likelihood.
    best_gain = members[0].penalised_log_likelihood - base_likelihood
    best_models = [
        model
        for model in members
        if model.penalised_log_likelihood - base_likelihood >= MIN_RELATIVE_GAIN_IN_BEAM * best_gain
    ][:BEAM_WIDTH]
    nearest_models = sorted(members, key=lambda model: model.fit.cost)[:BEAM_WIDTH_BY_SQUARES]
    return best_models + [model for model in nearest_models if model not in best_models]


def is_hopeless(search: EffectSearch, larger: FittedModel) -> bool:
    """Return whether a model of several effects is too far from the data to try another effect.

    Its excess residual (RMS residual in units of the noise, minus one) must be below a share of
    those of the base model and of the best single effect; otherwise it is too far. In a thorough
    search, all models of the same size must be too far.

    Args:
        search: the search, with all fitted models.
        larger: the model of several effects.
    """
    # If two effects leave as much as the best single one, a third effect will not help.
    limit_by_base = MAX_PAIR_EXCESS_SHARE * search.compute_excess_residual(search.base_model)
    limit_by_single = MAX_PAIR_EXCESS_SHARE_OF_SINGLE * min(
        _list_excess_residuals(search, 1), default=np.inf
    )
    excess = search.compute_excess_residual(larger)
    if search.thorough:
        # The model to extend need not have the lowest excess, because likelihoods are misleading
        # there.
        excess = min(excess, *_list_excess_residuals(search, len(larger.effects)))
    return excess > min(limit_by_base, limit_by_single)


def _list_excess_residuals(search: EffectSearch, size: int) -> list[float]:
    """Return the excess residuals of all models with `size` effects.

    The excess residual is the RMS residual in units of the noise, minus one.

    Args:
        search: the search, with all fitted models.
        size: number of effects of the models.
    """
    return [
        search.compute_excess_residual(m) for m in search.models.values() if len(m.effects) == size
    ]


def select_conservative_model(
    search: EffectSearch, best: FittedModel, larger: FittedModel
) -> FittedModel:
    """Return the larger model only if it replaces effects of the smaller one for a good reason.

    Two effects can mimic a third one. So a larger model that replaces effects of the best smaller
    model must reduce the excess clearly. Otherwise the best extension of the smaller model by one
    effect is returned, or the smaller model itself.

    Args:
        search: search with all fitted models.
        best: best model with fewer effects.
        larger: model with more effects.
    """
    # A model that contains the effects of the best one replaces none of them.
    is_extension = set(best.effects) <= set(larger.effects)
    if is_extension or search.compute_excess_residual(
        larger
    ) < MAX_REPLACEMENT_EXCESS_SHARE * search.compute_excess_residual(best):
        return larger
    extensions = [
        model
        for model in search.models.values()
        if set(best.effects) < set(model.effects)
        and len(model.effects) == len(best.effects) + 1
        and model.penalised_log_likelihood > best.penalised_log_likelihood
    ]
    return max(extensions, key=lambda model: model.penalised_log_likelihood, default=best)
