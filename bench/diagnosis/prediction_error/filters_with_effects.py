"""Kalman filters that follow the runs with effects in the model.

Regression is linear about the base model; a filter with an effect in its model is not. With the
right effects it needs no process noise, so its likelihood can compare sets of effects before any of
them is simulated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from bench.diagnosis.dry_friction_form import has_soft_form, make_soft_kind
from bench.diagnosis.evaluation.parameter_bounds import get_bounds_by_index
from bench.diagnosis.fitting.fitted_models import FittedModel
from bench.diagnosis.fitting.levenberg_marquardt import FitStart
from bench.diagnosis.kalman.likelihood_fit import maximise_innovation_likelihood
from bench.diagnosis.kalman.linearised_filter import FollowedRuns
from bench.diagnosis.prediction_error.effects_at_joints import get_only_joint
from bench.diagnosis.search.scored_models import ScoredModelSet
from sims.core.simulator import Array
from sims.robot.robot_simulator import RobotSimulator

MIN_MISSING_FORCE_SHARE = 0.05
"""Minimum loss without the process noise of a joint at which a force is missing there.

It is a share of the largest loss of all joints. If one effect is wrong at one joint, the losses at
the others are below 0.001 of it.
"""
OFFSET_THRESHOLD = 10.0
"""Minimum difference of positions, as a multiple of the noise, that is an encoder offset."""
RELINEARISATION_THRESHOLD = 100.0
"""Minimum change of the smoothed motion, in units of the noise, for another linearisation."""
GAUSS_NEWTON_STEPS = 2
"""Maximum number of Gauss-Newton steps for an effect that is tried in the model."""
COMPETING_MODEL_MARGIN = 20.0
"""Maximum distance in twice the log-likelihood of sets that are compared by simulation."""
LINEARISATION_ERROR = 0.03
"""Maximum relative error of a gain that is computed from linear responses."""


def compute_comparison_margin(gain: float) -> float:
    """Return by how much a set may be less likely than the best one and still be simulated.

    A filter is linear, so simulation decides between sets that are this close.

    Args:
        gain: gain of the best set over the base model, in twice the log-likelihood.

    Returns:
        The difference, like the gain, in twice the log-likelihood.
    """
    return COMPETING_MODEL_MARGIN + LINEARISATION_ERROR * gain


class FilteredSet(NamedTuple):
    """A set of effects in the model of a Kalman filter.

    Attributes:
        followed: the runs, followed by this filter: parameters of the model, innovations,
            log-likelihood, and the forces that are still missing.
        names: names of the effects.
    """

    followed: FollowedRuns
    names: tuple[str, ...]


@dataclass
class ModelFilters:
    """The filters of a search.

    Attributes:
        models: the base model and the fitted models.
        numerics: share of the integrator's step errors that the selection puts into the model.
    """

    models: ScoredModelSet
    numerics: float = 0.0
    _filters_by_theta: dict[bytes, FollowedRuns] = field(default_factory=dict)
    _newest_by_effects: dict[frozenset[str], FollowedRuns] = field(default_factory=dict)
    _newest_about_base: FollowedRuns | None = None
    _likelihoods: dict[tuple[bytes, bool], float] = field(default_factory=dict)
    _soft_friction_starts: dict[tuple[str, float], FitStart | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.evaluator, self.noise = self.models.evaluator, self.models.noise

    def take_over(self, other: ModelFilters) -> None:
        """Reuse likelihoods and soft friction that another search of the same models has found."""
        self._likelihoods = other._likelihoods
        self._soft_friction_starts = other._soft_friction_starts

    @cached_property
    def reference(self) -> Array:
        """Parameters (P,) without any effect.

        They are those of the base model, with free parameters as identified together with effects.
        Without effects, the base model may need absurd values.
        """
        theta: Array = self.models.base_model.fit.theta.copy()
        identified = self.evaluator.identified
        if identified is not None:
            is_free = [
                i not in self.models.fixed_parameters for i in self.evaluator.base_indices.tolist()
            ]
            theta[self.evaluator.base_indices[is_free]] = identified.base[is_free]
        return theta

    @property
    def base(self) -> FollowedRuns:
        """The runs, followed with the base model, which has no effects."""
        return FollowedRuns.get_or_follow(self.evaluator, self.reference, self.noise)

    @cached_property
    def _joints_missing_force(self) -> set[int]:
        """Indices of the joints at which the base model clearly lacks a force.

        There the filter of the base model is far less likely without process noise, which stands
        for missing forces. The set is empty if not all joints are measured, if the base of the
        robot moves or stands on the ground, or if servos reach their limits, where the linear model
        jumps: the losses are then no reliable sign.
        """
        base, evaluator = self.base, self.evaluator
        joints = evaluator.simulator.system.coordinates
        # A robot with a floating base has more forces than joints. `jumps` is the process noise
        # that is added where a servo reaches its limit.
        # `force` has a missing force for each joint and each motion of a floating base.
        if (
            base.force.size != len(joints)
            or not set(joints) <= set(evaluator.channels)
            or base.runs.jumps.any()
        ):
            return set()
        losses = base.losses_without_force
        is_missing = base.missing_forces & (losses > MIN_MISSING_FORCE_SHARE * losses.max())
        return set(np.flatnonzero(is_missing).tolist())

    def act_where_forces_are_missing(self, names: Iterable[str]) -> bool:
        """Return whether effects act at all joints at which the base model lacks a force.

        Such joints are those where its filter clearly needs process noise. If a force is missing at
        two joints, friction at one of them explains nothing alone. An effect that does not change
        the force of a single joint only, such as a payload, is taken to act at all joints.

        Args:
            names: names of the effects.
        """
        # None for an effect at several joints.
        joints = [get_only_joint(self.evaluator, name) for name in names]
        return None in joints or self._joints_missing_force <= set(joints)

    @property
    def empty_set(self) -> FilteredSet:
        """The base model as a set of effects."""
        return FilteredSet(self.base, ())

    def get_filter(self, model: FittedModel) -> FollowedRuns:
        """Return the Kalman filter of the runs with a fitted model; it is cached.

        The filter starts from the newest one with the same effects, or from that of the base model,
        about whose smoothed motion the model is linearised. The first filter with these effects is
        linearised once more, about its own motion with the same Jacobians. The share `numerics` of
        the integrator's step errors is subtracted from the defects of the steps (by how much a step
        of the model misses the next state), so that they are not taken for a missing force. This is
        done only if the runs are then likelier: a selection of wrong effects has a wrong share.

        Args:
            model: the fitted model; without effects, the result is the filter `base`.
        """
        if not model.effects:
            return self.base
        key = model.fit.theta.tobytes()
        if key not in self._filters_by_theta:
            names = frozenset(model.effects)
            # The newest filter with these effects, whatever their coefficients.
            same_effects = self._newest_by_effects.get(names)
            followed = (same_effects or self.base).with_parameters(model.fit.theta)
            if same_effects is None:
                followed = followed.with_parameters(model.fit.theta, similar=followed)
            self._newest_by_effects[names] = followed
            if self.numerics:
                defects = followed.runs.defects - self.numerics * followed.step_errors
                corrected = followed.refit_noise(replace(followed.runs, defects=defects))
                if corrected.log_likelihood > followed.log_likelihood:
                    followed = corrected
            self._filters_by_theta[key] = followed
        return self._filters_by_theta[key]

    def get_similar_filter(self, model: FittedModel) -> FollowedRuns:
        """Return a filter with the effects of a fitted model, perhaps with other coefficients."""
        return self._newest_by_effects.get(frozenset(model.effects)) or self.get_filter(model)

    def log_likelihood(self, theta: Array, is_soft: bool = False) -> float:
        """Return the log-likelihood of the innovations of a model; it is cached.

        The innovations are the prediction errors of a Kalman filter whose model has the given
        parameters.

        Args:
            theta: (P,) parameters of the model.
            is_soft: whether effects add dry friction in MuJoCo's soft form, whatever the form of
                the search.
        """
        if not is_soft and np.array_equal(theta, self.base.theta):
            return self.base.log_likelihood
        # The log-likelihood is stored, and not the filter.
        key = theta.tobytes(), is_soft
        if key not in self._likelihoods:
            followed = (
                self.follow_with_soft_friction(theta) if is_soft else self._follow_about_base(theta)
            )
            self._likelihoods[key] = followed.log_likelihood
        return self._likelihoods[key]

    def follow_with_soft_friction(
        self, theta: Array, similar: FollowedRuns | None = None
    ) -> FollowedRuns:
        """Follow the runs with a model whose effects add dry friction in MuJoCo's soft form.

        The model is linearised about the motion of the base model. Its log-likelihood is cached.

        Args:
            theta: (P,) parameters of the model.
            similar: a filter with a similar model, whose Jacobians are used; None to compute them.
        """
        followed = self.base.with_parameters(theta, self._soft_simulator, similar)
        self._likelihoods[theta.tobytes(), True] = followed.log_likelihood
        return followed

    def get_soft_friction_start(
        self, name: str, sign: float, search: Callable[[ModelFilters, str, float], FitStart | None]
    ) -> FitStart | None:
        """Return the likeliest model of soft dry friction at a joint; it is cached.

        A search compares several filters, which is slow. Its result, which may be None, is stored
        by effect and sign, and other searches of the same models reuse it (`take_over`).

        Args:
            name: name of a friction effect at a joint.
            sign: 1 for more friction than in the model file, -1 for less.
            search: function that finds the model for these filters, the name and the sign.
        """
        key = name, sign
        if key not in self._soft_friction_starts:
            self._soft_friction_starts[key] = search(self, name, sign)
        return self._soft_friction_starts[key]

    def _follow_about_base(self, theta: Array) -> FollowedRuns:
        """Follow the runs with other parameters, linearised about the motion of the base model.

        The newest filter is kept, because a model that is likelier than the base model is asked for
        again at once, to be refined.
        """
        if self._newest_about_base is None or not np.array_equal(
            self._newest_about_base.theta, theta
        ):
            self._newest_about_base = self.base.with_parameters(theta)
        return self._newest_about_base

    def compute_gain(self, followed: FollowedRuns) -> float:
        """Return the gain of a filter over the base model in twice the log-likelihood."""
        return 2.0 * (followed.log_likelihood - self.base.log_likelihood)

    def follow_with_effects(
        self, theta: Array, names: Sequence[str], steps: int = GAUSS_NEWTON_STEPS
    ) -> FilteredSet:
        """Follow the runs with effects in the model, and improve their coefficients.

        Args:
            theta: (P,) initial parameters.
            names: names of the effects.
            steps: maximum number of Gauss-Newton steps; 0 keeps the initial parameters.

        Returns:
            The effects with the filter of the improved parameters.
        """
        current = FilteredSet(self._follow_near(theta, self.base), tuple(names))
        return self.improve(current, steps)

    def improve(self, current: FilteredSet, steps: int = GAUSS_NEWTON_STEPS) -> FilteredSet:
        """Improve the coefficients of a set by Gauss-Newton steps.

        Args:
            current: the set, with its filter.
            steps: maximum number of steps.
        """
        bounds = get_bounds_by_index(self.evaluator, current.names)
        followed = maximise_innovation_likelihood(
            current.followed, bounds, steps, self._follow_near
        )
        return FilteredSet(followed, current.names)

    def _follow_near(self, theta: Array, neighbour: FollowedRuns) -> FollowedRuns:
        """Follow the runs with other parameters, linearised about the motion of a known filter.

        If the new filter smooths the motion far away from that one, the model is linearised once
        more, about the new motion.

        Args:
            theta: (P,) parameters.
            neighbour: a filter with similar parameters, whose smoothed motion is used.
        """
        # The newest filter about the base model's motion is cached.
        is_base = neighbour is self.base
        followed = self._follow_about_base(theta) if is_base else neighbour.with_parameters(theta)
        # Smoothed states are deviations from the motion about which the model is linear; their
        # first elements are the positions.
        deviations = np.abs(followed.smoothed.states[:, :, : followed.linear[0].positions])
        # This happens with an encoder offset: the true motion is far from the readings.
        is_far = deviations.max() > RELINEARISATION_THRESHOLD * float(np.nanmax(self.noise.sigma))
        return followed.with_parameters(theta) if is_far else followed

    def estimate_first_states(self, followed: FollowedRuns) -> Array:
        """Return states at the first samples (R, s) of the R runs, estimated from the readings.

        They are the guesses of the evaluator, the positions before the velocities. A position that
        is not known exactly is replaced by the smoothed one of the filter where this differs by far
        more than noise, because an encoder offset is then in the readings. The states of the base
        fit are not used, because they are biased by the effects that it lacks.

        Args:
            followed: the runs, followed by a filter.
        """
        # The first columns are the positions.
        states = self.evaluator.initial_state_guesses.copy()
        positions = followed.get_first_positions()
        measured_positions = states[:, : positions.shape[1]]
        max_sigma = float(np.nanmax(self.noise.sigma))
        has_moved = np.abs(positions - measured_positions) > OFFSET_THRESHOLD * max_sigma
        is_offset = (
            np.isfinite(positions)
            & has_moved
            & ~self.evaluator.known_state_mask[:, : positions.shape[1]]
        )
        states[:, : positions.shape[1]] = np.where(is_offset, positions, measured_positions)
        return states

    def penalty(self, name: str) -> float:
        """Return the minimum gain of an effect with k coefficients in twice the log-likelihood.

        It is the penalty of the search for k parameters, plus 2 log M for the best of the M effects
        of the library.
        """
        count = len(self.evaluator.get_coefficient_indices(name))
        return float(
            count * self.models.parameter_penalty + 2.0 * np.log(len(self.evaluator.library))
        )

    @property
    def is_soft(self) -> bool:
        """True if effects add dry friction in MuJoCo's soft form."""
        return has_soft_form(self.evaluator)

    @cached_property
    def _soft_simulator(self) -> RobotSimulator:
        """Simulator with dry friction in MuJoCo's soft form."""
        simulator = self.evaluator.make_simulator(make_soft_kind(self.evaluator.kind))
        assert isinstance(simulator, RobotSimulator)
        return simulator
