"""Search for the effects that a robot's model lacks, by prediction errors.

`identification` selects effects by the innovations of a filter. Here selected sets are fitted to
whole simulated runs (output errors), which decide. The search ends as soon as a set leaves no more
than noise. The order:

    1. Select effects with few shapes by regression. Fit the dry friction among them alone, since it
       is not linear where a joint sticks, and then the set.
    2. Where a force is still missing, fit each of the effects alone that gain most, and those of
       the standard joint model.
    3. Add effects one by one, to dry friction in either of its forms or to nothing, each chosen by
       filters with the effect in the model.
    4. Select again, with effects of many shapes at the joints where a force is missing.
    5. Simulate elasticity and play between a drive and its links.
    6. Try one effect in place of several.

`fit_rivals` then fits the sets that do nearly as well: they may be equivalent.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from bench.gap.causes.candidates import Directions, Probe, first_probes
from bench.gap.causes.gains import Group
from bench.gap.causes.joint_hats import JointHat
from bench.gap.causes.nominate import with_effect
from bench.gap.causes.rules import ALPHA, SWITCH
from bench.gap.causes.score_test import Scores
from bench.gap.causes.search import Search
from bench.gap.causes.structure import hat_probes
from bench.gap.friction_form import (
    has_dry_friction,
    is_likelier_soft,
    plain_friction,
    soft_kind,
)
from bench.gap.model.base_fit import costs_of_starts
from bench.gap.model.bounds import coefficient_bounds
from bench.gap.model.fit import Fitter
from bench.gap.model.models import STEPS, Model
from bench.gap.model.problem import Fit, Known, Start
from bench.gap.model.tangents import begun
from bench.gap.prediction_error.candidate_responses import Columns, FollowedRuns
from bench.gap.prediction_error.identification import Selected, identify, regress
from bench.gap.prediction_error.likelihood_fit import gauss_newton_step, maximise_likelihood
from bench.gap.prediction_error.null_distribution import null_scores, p_value_of_gain
from bench.gap.prediction_error.selection import Regression
from sims.base import Array
from sims.robot.forces import OVER_TIME
from sims.robot.loops import coupled_joints
from sims.robot.native import FIELDS
from sims.robot.scales import scales
from sims.robot.series import is_series
from sims.robot.simulator import RobotSimulator
from sims.system import Effect, members_of

MANY_SHAPES = frozenset(
    {
        "force.periodic",
        "force.ripple",
        "friction.position",
        "friction.stribeck",
        "friction.warming",
        "sensor.slip",
        "state.limit",
    }
)
"""Effects that are tried at many shapes, and only where plain ones leave a force missing."""
RIVAL_MARGIN = 20.0
"""Rivals this near in twice the log likelihood of the regression are fitted by simulation."""
LINEARISATION_ERROR = 0.03
"""Share of a gain by which it may be wrong, since responses are linear."""
MAX_RIVALS = 5
"""Maximum number of rivals of each effect that are fitted by simulation."""
ALIKE_SHARE = 0.5
"""Share of an effect's gain by regression that another one at the same joint must have to be
followed in its place.
"""
JOINT_MODEL = ("friction.coulomb", "drag.linear", "inertia.armature")
"""Effects at a joint that are tried at the joint where most is missing."""
SERVO_MODEL = ("actuator.stiffness", "actuator.damping")
"""Effects at a servo that are tried at the servo of this joint."""
FIRST_SHARE = 0.1
"""Initial coefficient as a share of the stated friction or of the typical force."""
MAX_STEPS = 4
"""Maximum number of effects that are added one after another."""
MAX_TRIALS = 4
"""Maximum number of effects by regression that are tried in the model at each step."""
MAX_JOINT_TRIALS = 3
"""Maximum number of effects of the joint and servo models that are tried at each step."""
MAX_IMPROVED_TRIALS = 3
"""Maximum number of tried effects whose coefficients are improved at each step."""
MAX_REFINED_SINGLES = 3
"""Maximum number of effects that are fitted alone until nothing is left to gain."""
SETTLED_SHARE = 0.1
"""Share of a gain by which another trial must be behind not to be improved."""
MAX_FIRST_EFFECTS = 2
"""Number of the likeliest trials that are fitted by simulation, however far behind the best."""
ALL_SERVOS_STEPS = 6
"""Maximum number of Gauss-Newton steps for the coefficients of all servos."""
OFFSET_THRESHOLD = 10.0
"""A smoothed first position takes the place of the recorded one from so many times the noise."""
RELINEARISATION_THRESHOLD = 100.0
"""The model is linearised again where the smoothed motion has moved by so many times the noise."""
MAX_SURPLUS = 2
"""Number of selected effects that may gain too little one after another before the rest of a
selection is left out.
"""
MAX_SLOW_EFFECTS = 2
"""Sets of at most so many effects are fitted by simulation even where that is slow."""
MAX_CACHED_FILTERS = 6
"""Number of filters that are kept for effects that were tried."""
SOFT_FACTORS = (0.5, 0.8, 1.2, 1.8)
"""Multiples of the missing force that are tried as dry friction in the soft form."""
NEARBY = (0.8, 0.9, 0.96, 0.98, 0.99, 1.01, 1.02, 1.04, 1.1, 1.2)
"""Factors of a coefficient at which a fit looks for a lower cost nearby: where joints stick, and
where servos are at force limits, the cost is not smooth.
"""
MIN_GAIN_SHARE = 0.3
"""Share of the largest gain by regression that an effect must have to be tried in the model."""
GAUSS_NEWTON_STEPS = 2
"""Maximum number of Gauss-Newton steps for an effect that is tried in the model."""
MAX_IMPROVED_SIZE = 3
"""Maximum number of coefficients of a rival whose coefficients are improved."""
RELATIVE_DIFFERENCE = 0.02
"""Share of a coefficient by which it is moved for its derivative."""
TRIED_SHARES = (1.0, 0.5)
"""Shares of the coefficients by regression with which a filter must follow the runs better."""
EXPLAINED_EXCESS = 0.03
"""Excess over the noise below which a fitted set explains the data."""

LEAST_SHARE = 0.01
"""Share of the gain of a set by which each further effect must raise it. A model of a real robot is
never complete, and long recordings show that with certainty.
"""
NEARLY_EXPLAINED = 0.1
"""Share of the base model's excess over the noise below which effects are only added."""
NEGLIGIBLE, NEGLIGIBLE_SHARE = 0.1, 0.005
"""Excess over the noise, and share of that of the base model, below which the search ends."""


class SoftFrictionError(Exception):
    """Dry friction of these data has MuJoCo's soft form: search with a simulator of that form.

    Attributes:
        start: the model whose filter says so; None where simulation does.
        is_preliminary: whether filters alone say so, before anything was fitted.
    """

    is_preliminary = False

    def __init__(self, start: Start | None = None) -> None:
        super().__init__()
        self.start = start


class PreliminarySoftFrictionError(SoftFrictionError):
    """A filter with soft friction follows the runs better than one with what was selected."""

    is_preliminary = True


class _Trial(NamedTuple):
    """A set of effects in the model: the runs as a filter with it follows them, and the names."""

    followed: FollowedRuns
    names: tuple[str, ...]


@dataclass
class PredictionErrorSearch(Search):
    """A search whose candidates come from prediction errors.

    Attributes:
        is_form_given: whether the form of dry friction is not asked about before effects are
            fitted.
        likely: a model that is fitted before anything is selected, if there is one.
    """

    is_form_given: bool = False
    likely: Start | None = None
    _selected: Selected | None = None
    _columns: Columns | None = None
    _hats: Columns | None = None
    _followed: dict[bytes, FollowedRuns] = field(default_factory=dict)
    _followed_sets: dict[frozenset[str], FollowedRuns] = field(default_factory=dict)
    _regressions: dict[bytes, Regression] = field(default_factory=dict)
    _likelihoods: dict[tuple[bytes, bool], float] = field(default_factory=dict)
    _trial_filters: dict[bytes, FollowedRuns] = field(default_factory=dict)
    _model_columns: dict[bytes, dict[str, list[int]]] = field(default_factory=dict)

    def run(self) -> Model:
        """Return the model of all effects that the data show.

        Raises:
            SoftFrictionError: dry friction of the data has MuJoCo's soft form.
        """
        watch = self.world.watch
        self.supported = self.base
        if self.likely is not None:
            best = self._without_idle_effects(self._fit(self.likely))
            if self._is_explained(best):
                self.supported = best
                return best
        followed = self.follow()
        columns = self._library_columns()
        watch.stage("selecting effects", 1)
        selected = identify(followed, columns)
        self._selected = selected
        self._compare_soft_friction(selected)
        friction = self._fit_dry_friction(selected)
        best = friction
        if not self._is_explained(best):
            best = self._of_higher_merit(best, self._fit_quick_selection(selected))
        nearly = self._is_nearly_explained(best)
        if self._goes_on(best) and nearly and is_likelier_soft(self, best, SWITCH):
            raise SoftFrictionError
        if self._goes_on(best) and nearly and len(best.names) > 1:
            best = self._of_higher_merit(best, self._add_to(best))
        elif self._goes_on(best):
            best = self._of_higher_merit(best, self._fit_single_effects())
            if self._goes_on(best):
                best = self._of_higher_merit(best, self._add_to_dry_friction(selected, friction))
            if self._goes_on(best):
                best = self._of_higher_merit(best, self._select_in_model((), self._reference))
        if not self._is_explained(best):
            selected = self._select_with_shapes(selected)
            best = self._of_higher_merit(best, self._fit_quick_selection(selected))
        if not self._is_explained(best) and not self._must_end:
            best = self._of_higher_merit(best, self._fit_series_effects(selected))
        if not best.names:
            best = self._fit_selection(selected)
        best = self._try_single_effect(best)
        self.supported = best
        return best

    def _goes_on(self, best: Model) -> bool:
        """Whether effects that regression missed are sought: a force is missing, and there is time
        left.
        """
        lacks = self._lacks_force(self.follow())
        return lacks and not self._is_explained(best) and not self._must_end

    def _is_nearly_explained(self, model: Model) -> bool:
        """Whether a model closes most of the gap."""
        return self.excess(model) < NEARLY_EXPLAINED * self.excess(self.base)

    def _add_to(self, model: Model) -> Model:
        """Add effects to a fitted model while each pays, and fit the set."""
        trial = _Trial(self._followed_by(model), model.names)
        larger = self._grow(trial)
        return model if larger is trial else self._without_idle_effects(self._fit_trial(larger))

    def _fit_series_effects(self, selected: Selected) -> Model:
        """Fit elastic joints and play between drive and links, at the joint where most is missing.

        They have states of their own, so that each shape is simulated.
        """
        joint = selected.followed.joints_by_loss[0]
        effects = self.world.effects
        names = [n for n in self.world.library if is_series(effects[n])]
        probes = self._probes([n for n in names if self._acts_at(n, {joint})])
        if not probes:
            return self.base
        self.world.watch.stage("testing elasticity and play between drives and links", len(probes))
        starts = []
        for probe in probes:
            theta = self._reference.copy()
            theta[self.world.slots[probe.effect]] = probe.c
            starts.append(Start((probe.effect,), theta, self.world.guess))
        costs = costs_of_starts(self.world, self.noise, starts, share=1.0, lost=np.inf)
        best: dict[str, int] = {}
        for i in np.argsort(costs, kind="stable").tolist():
            best.setdefault(probes[i].effect, i)
        self.refit([starts[i] for i in best.values()], race=False)
        fitted = [self.models[frozenset((name,))] for name in best]
        likeliest = max(fitted, key=lambda model: model.merit)
        return self._fit(likeliest.fit.start())

    def _has_series(self, model: Model) -> bool:
        """Whether a model has joints in series with others, and so states of its own."""
        return any(is_series(self.world.effects[name]) for name in model.names)

    def _try_single_effect(self, best: Model) -> Model:
        """Return the model with one effect in place of several, where that does as well: two linear
        laws may imitate one that is not linear.
        """
        if (
            len(best.names) < 2
            or self._has_series(best)
            or not self._is_explained(best)
            or self._must_end
        ):
            return best
        tried = self._try_one_more(_Trial(self.follow(), ()))
        if not tried:
            return best
        own = self._followed_by(best).log_likelihood
        penalty = sum(self._penalty(one) for one in best.names) - self._penalty(tried[0].names[-1])
        if 2.0 * (own - tried[0].followed.log_likelihood) > penalty + RIVAL_MARGIN:
            return best
        single = self._fit_trial(tried[0])
        return self._of_higher_merit(self.fit_rivals(single), best)

    @staticmethod
    def _of_higher_merit(one: Model, other: Model) -> Model:
        return max(one, other, key=lambda model: model.merit)

    def _fit_dry_friction(self, selected: Selected) -> Model:
        """Fit the dry friction of a selection alone.

        Return the base model where no force is missing in addition to the selection, or where it
        has no friction.
        """
        plain = self._plain_friction(selected)
        if not plain or not self._lacks_force(selected.followed):
            return self.base
        theta = self._friction_of(selected, plain)
        best = self._fit(Start(plain, theta, self._first_states(self.follow())))
        return self._without_idle_effects(best) if self._is_explained(best) else best

    def _friction_of(self, selected: Selected, plain: Sequence[str]) -> Array:
        """The parameters (P,) with the dry friction of a selection, and nothing else of it."""
        theta = self._reference.copy()
        own = self._plain_theta(self._start(selected.groups, selected.coefficients))
        for name in plain:
            theta[self.world.slots[name]] = own[self.world.slots[name]]
        return theta

    def _add_to_dry_friction(self, selected: Selected, friction: Model) -> Model:
        """Add effects to the dry friction of a selection, which was fitted alone.

        Return the base model where it has none, or where other friction does better.

        Raises:
            SoftFrictionError: the friction has MuJoCo's soft form.
        """
        if not friction.names:
            return self.base
        stands, softer = self._form_of_friction(selected)
        if not stands:
            return self.base
        if softer and is_likelier_soft(self, friction, SWITCH):
            raise SoftFrictionError
        plain = self._plain_friction(selected)
        return self._select_in_model(plain, self._friction_of(selected, plain))

    def _compare_soft_friction(self, selected: Selected) -> None:
        """Compare a selection with dry friction in MuJoCo's soft form, before anything is fitted.

        Raises:
            SoftFrictionError: that is likelier than the selection.
        """
        if self._is_soft or self.is_form_given or not self._lacks_force(self.follow()):
            return
        kept = self._without_surplus(selected)
        own = self._likelihood(self._start(kept.groups, kept.coefficients).theta)
        likelihood, start = self._soft_friction
        if likelihood > own + 0.5 * SWITCH:
            raise PreliminarySoftFrictionError(start)

    def _check_soft_friction(self, best: _Trial) -> None:
        """Compare a trial with dry friction in MuJoCo's soft form.

        Raises:
            SoftFrictionError: that is likelier than the trial.
        """
        likelihood, start = self._soft_friction
        if likelihood > best.followed.log_likelihood + 0.5 * SWITCH:
            raise SoftFrictionError(start)

    @cached_property
    def _soft_friction(self) -> tuple[float, Start | None]:
        """The largest log likelihood with soft dry friction at the joint where most is missing, and
        the model; minus infinity where there is none.
        """
        world, followed = self.world, self.follow()
        joint = followed.joints_by_loss[0]
        name = f"friction.coulomb@{self._joint_name(joint)}"
        if self._is_soft or name not in world.library:
            return -np.inf, None
        best: tuple[float, Start | None] = -np.inf, None
        for factor in SOFT_FACTORS:
            theta = self._reference.copy()
            # A joint that slides lacks about the force of its friction.
            size = np.array([factor * float(followed.force[joint])])
            theta[world.slots[name]] = self._within_bounds(name, size)
            likelihood = self._likelihood(theta, self._soft_simulator)
            if likelihood > best[0]:
                best = likelihood, Start((name,), theta, self._first_states(followed))
        return best

    def _plain_friction(self, selected: Selected) -> tuple[str, ...]:
        """The dry friction of a selection, without a state; a family in place of its members."""
        world = self.world
        plain = dict.fromkeys(plain_friction(world, name) for name in selected.effects)
        native = [name for name in plain if name.partition("@")[0] in FIELDS]
        names = [name for name in native if has_dry_friction(world, [name])]
        return tuple(n for n in names if not any(n in world.effects[m].contains for m in names))

    @staticmethod
    def _lacks_force(followed: FollowedRuns) -> bool:
        """Whether a force is missing in the model with which a filter follows the runs."""
        return bool(followed.missing_forces.any())

    def _fit_quick_selection(self, selected: Selected) -> Model:
        """Fit the selected set by simulation.

        Return the base model where that is slow and a force is missing all the same.
        """
        kept = self._without_surplus(selected)
        large = len(kept.groups) > MAX_SLOW_EFFECTS
        if large and self._is_slow(kept) and self._lacks_force(selected.followed):
            return self.base
        return self._fit_selection(kept)

    def _without_surplus(self, selected: Selected) -> Selected:
        """Leave out the last effects of a selection that gain little when a filter has the set in
        the model: far from the base model a regression is wrong.
        """
        own = self._likelihood(self._reference)
        best, kept, gained = 0.0, 0, 0.0
        found: list[Array] = []
        for count in range(1, len(selected.groups) + 1):
            if count > kept + MAX_SURPLUS:
                break
            groups = selected.groups[:count]
            coefficients = selected.regression.solve(groups)[1]
            gain = 2.0 * (self._likelihood(self._start(groups, coefficients).theta) - own)
            penalty = sum(self._penalty(group.effect) for group in groups)
            least = LEAST_SHARE * max(gained, 0.0) * (count - kept)
            if gain - penalty > best and gain - gained > least:
                best, kept, gained, found = gain - penalty, count, gain, coefficients
        return replace(selected, groups=selected.groups[:kept], coefficients=found)

    def _select_with_shapes(self, selected: Selected) -> Selected:
        """Select again with effects of many shapes, at the joints where a force is missing."""
        joints = set(np.flatnonzero(selected.followed.missing_forces).tolist())
        rich = [
            n for n in self.world.library if self._has_many_shapes(n) and self._acts_at(n, joints)
        ]
        if not rich:
            return selected
        self.world.watch.stage(f"testing {len(rich)} effects with many shapes", 1)
        followed = self.follow()
        self._columns = self._library_columns().joined(followed.columns(self._probes(rich)))
        found = identify(followed, self._columns)
        self._selected = found
        return found

    def _is_slow(self, selected: Selected) -> bool:
        """Whether a set is slow to simulate, since its forces are computed in every step."""
        effects = [self.world.effects[name] for name in selected.effects]
        return any(m.of not in FIELDS for e in effects for m in members_of(e) if _is_force(m))

    # -- selection with the model linearised again after each effect

    def _first_states(self, followed: FollowedRuns) -> Array:
        """Return states at the first samples (R, s): of the readings, with smoothed positions
        where an encoder is off. States of the base fit are biased by what is missing.
        """
        states, positions = self.world.guess.copy(), followed.first_positions()
        own = states[:, : positions.shape[1]]
        noise = float(np.nanmax(self.noise.sigma))
        moved = np.abs(positions - own) > OFFSET_THRESHOLD * noise
        fine = np.isfinite(positions) & moved & ~self.world.known[:, : positions.shape[1]]
        states[:, : positions.shape[1]] = np.where(fine, positions, own)
        return states

    def _select_in_model(self, names: Sequence[str], theta: Array) -> Model:
        """Add effects one after another, each chosen by whole filters with the effect in the model.

        Where much is missing, the noise of the measured motion is in the innovations and in the
        responses of effects that follow the same readings, and regression prefers these. A filter
        with the right effect in the model needs no process noise any more.

        Args:
            names: dry friction that is in the model from the beginning.
            theta: (P,) parameters of the model with it.

        Raises:
            SoftFrictionError: dry friction is likelier in MuJoCo's soft form.
        """
        begin = _Trial(self._follow_with(theta, names) if names else self.follow(), tuple(names))
        first = self._larger_that_pay(begin)
        if not first and not names:
            self._check_soft_friction(begin)
            return self.base
        best = self._fit_trial(begin) if names and not first else self.base
        for trial in self._nearly_as_likely(first):
            best = self._of_higher_merit(best, self._fit_trial(trial))
            if self._must_end:
                break
        if not self._is_explained(best) and not names and not self._must_end:
            self._check_soft_friction(first[0])
            best = self._of_higher_merit(best, self._fit_all_servos())
        # Two effects may explain together what neither explains alone.
        if first and not self._is_explained(best) and not self._must_end:
            best = self._of_higher_merit(best, self._fit_trial(self._grow(first[0])))
        if not np.isfinite(best.fit.cost) or not best.names:
            return self.base
        if not self._is_explained(best) and is_likelier_soft(self, best, SWITCH):
            raise SoftFrictionError
        return self._without_idle_effects(best)

    def _fit_single_effects(self) -> Model:
        """Fit each of the proposed effects alone by simulation, side by side.

        Return the base model where none explains the runs. A filter is linear about the measured
        motion, which a joint that sticks and a servo at its limit are not.

        Raises:
            SoftFrictionError: dry friction is likelier in MuJoCo's soft form.
        """
        states = self._first_states(self.follow())
        starts = self._propose_effects(_Trial(self.follow(), ()), len(JOINT_MODEL + SERVO_MODEL))
        self.refit([replace(start, states=states) for start in starts], race=False)
        found = [self.models[frozenset(start.effects)] for start in starts]
        best = max(found, key=lambda model: model.merit, default=self.base)
        if not self._is_explained(best):
            best = self._of_higher_merit(best, self._refine_singles(found))
        if self._is_explained(best):
            return self._without_idle_effects(best)
        self._check_soft_friction(_Trial(self._followed_by(best), best.names))
        if is_likelier_soft(self, best, SWITCH):
            raise SoftFrictionError
        return self.base

    def _refine_singles(self, models: Sequence[Model]) -> Model:
        """Fit some effects alone until nothing is left to gain, those of lowest cost first.

        Where joints stick and at force limits the cost is not smooth, so that fits are caught; and
        likelihoods with coloured noise mean little where much is left over.
        """
        starts: list[Start] = []
        alone = [m for m in models if len(self.world.places(m.names[0])) <= MAX_IMPROVED_SIZE]
        for model in alone:
            starts += [model.fit.start(), *self._starts_nearby(model, model.names[0])]
        if not starts:
            return self.base
        costs = costs_of_starts(self.world, self.noise, starts, share=1.0, lost=np.inf)
        lowest: dict[tuple[str, ...], Start] = {}
        for i in np.argsort(costs, kind="stable").tolist():
            lowest.setdefault(starts[i].effects, starts[i])
        best = self.base
        for start in list(lowest.values())[:MAX_REFINED_SINGLES]:
            fitted = self._fit(start)
            if not self._is_at_noise(fitted) and self._is_nearly_explained(fitted):
                fitted = self._fit_nearby(fitted, fitted.names[0])
            best = self._of_higher_merit(best, fitted)
            if self._is_explained(best) or self._must_end:
                break
        return best

    def _nearly_as_likely(self, tried: Sequence[_Trial]) -> Sequence[_Trial]:
        """The trials that simulation has to decide between, the likeliest first: a filter's model
        is linear, which a joint that sticks and a servo at its limit are not.
        """
        if not tried:
            return ()
        gain = 2.0 * (tried[0].followed.log_likelihood - self._likelihood(self._reference))
        limit = self._criterion(tried[0]) + RIVAL_MARGIN + LINEARISATION_ERROR * gain
        near = [trial for trial in tried if self._criterion(trial) <= limit]
        return [*near, *tried[len(near) : MAX_FIRST_EFFECTS]]

    def _fit_all_servos(self) -> Model:
        """Fit stiffness and damping of all servos together, where forces are missing at several
        joints. Another effect may gain more than the stiffness or the damping alone.
        """
        names = tuple(f"{effect}@*" for effect in SERVO_MODEL)
        several = self.follow().missing_forces.sum() > 1
        if not several or any(name not in self.world.library for name in names):
            return self.base
        followed = self._follow_with(self._reference, names, ALL_SERVOS_STEPS)
        return self._fit_trial(_Trial(followed, names))

    def _fit_trial(self, trial: _Trial) -> Model:
        """Fit the effects of a trial by simulation."""
        states = self._first_states(trial.followed)
        return self._fit(Start(trial.names, trial.followed.theta, states))

    def _grow(self, trial: _Trial) -> _Trial:
        """Add effects to a trial while each pays."""
        for _ in range(MAX_STEPS - 1):
            larger = self._larger_that_pay(trial) if self._lacks_force(trial.followed) else []
            if not larger:
                break
            trial = larger[0]
        return trial

    def _larger_that_pay(self, trial: _Trial) -> list[_Trial]:
        """Trials with one more effect whose likelihood pays for it, the likeliest first."""
        base = self._likelihood(self._reference)
        own = trial.followed.log_likelihood if trial.names else base
        share = LEAST_SHARE * 2.0 * (own - base)
        return [
            one
            for one in self._try_one_more(trial)
            if 2.0 * (one.followed.log_likelihood - own) >= max(self._penalty(one.names[-1]), share)
        ]

    def _try_one_more(self, trial: _Trial) -> list[_Trial]:
        """Follow the runs with each effect that gains most in addition to a trial.

        Return the likeliest, the likeliest first; none where no effect gains.
        """
        watch, tried = self.world.watch, list[_Trial]()
        watch.stage("testing effects in the model one by one", MAX_TRIALS)
        for start in self._propose_effects(trial):
            tried.append(_Trial(self._follow_with(start.theta, start.effects, 0), start.effects))
            watch.advance()
            watch.check()
        # The coefficients of the best are improved before they are compared.
        found = list[_Trial]()
        for one in sorted(tried, key=self._criterion)[:MAX_IMPROVED_TRIALS]:
            if found and self._is_settled(found[0], one):
                found.append(one)
                continue
            found.append(_Trial(self._follow_with(one.followed.theta, one.names), one.names))
            found.sort(key=self._criterion)
        return found

    def _is_settled(self, best: _Trial, other: _Trial) -> bool:
        """Whether a trial explains the runs, and another one is far behind."""
        gain = 2.0 * (best.followed.log_likelihood - self._likelihood(self._reference))
        behind = self._criterion(other) - self._criterion(best)
        far = behind > RIVAL_MARGIN + SETTLED_SHARE * gain
        return far and not self._lacks_force(best.followed)

    def _criterion(self, trial: _Trial) -> float:
        """Penalised log likelihood of a trial's last effect, as an information criterion."""
        return self._penalty(trial.names[-1]) - 2.0 * trial.followed.log_likelihood

    def _without_idle_effects(self, model: Model) -> Model:
        """Remove effects that do not pay, and replace a family by a member that does as well."""
        model = self._merge_into_families(self.drop(model))
        families = any(name.endswith("@*") for name in model.names)
        return self.plainer(model) if families else model

    def _merge_into_families(self, model: Model) -> Model:
        """Replace all members of a family by the family, which needs fewer decisions."""
        for family in (n for n in self.world.library if n.endswith("@*")):
            members = [member.name for member in members_of(self.world.effects[family])]
            if len(members) < 2 or not set(members) <= set(model.names):
                continue
            theta = model.fit.theta.copy()
            own = np.concatenate([theta[self.world.slots[name]] for name in members])
            slot = self.world.slots[family]
            if own.size != slot.stop - slot.start:
                continue
            for name in members:
                theta[self.world.slots[name]] = 0.0
            theta[slot] = own
            names = (*(n for n in model.names if n not in members), family)
            self.refit([Start(names, theta, model.fit.states)], race=False)
            fitted = self.models[frozenset(names)]
            model = fitted if fitted.merit > model.merit - SWITCH else model
        return model

    def p_value_of_missing_effect(self, model: Model) -> float:
        """Return the p-value of the most significant effect that a fitted model lacks. Where it is
        significant by the linear innovations, it is fitted by simulation.
        """
        scores = self.scan(model)
        if scores.p_value > ALPHA or not np.isfinite(model.fit.cost):
            return scores.p_value
        name = scores.effects[0]
        (group, coefficients), *_ = scores.peaks[0]
        numbers = self._numbers(group, coefficients)
        start = with_effect(self.world, model.fit.start(), name, numbers)
        slot = self.world.slots[name]
        size, count = slot.stop - slot.start, len(self.world.library)
        # A filter with the effect in the model is faster than a fit, and not linear in it.
        own = self._followed_by(model).log_likelihood
        gains = []
        for share in TRIED_SHARES:
            theta = start.theta.copy()
            theta[slot] *= share
            gains.append(2.0 * (self._likelihood(theta) - own))
        by_filter = p_value_of_gain(max(gains), size, count)
        if by_filter > ALPHA:
            return by_filter
        self.refit([start], race=False)
        larger = self.models[frozenset(start.effects)]
        return p_value_of_gain(larger.likelihood.value - model.likelihood.value, size, count)

    def _penalty(self, name: str) -> float:
        """Return what an effect must gain in twice the log likelihood."""
        slot = self.world.slots[name]
        return float((slot.stop - slot.start) * self.price + 2.0 * np.log(len(self.world.library)))

    def _propose_effects(self, trial: _Trial, most: int = MAX_JOINT_TRIALS) -> list[Start]:
        """Return models with one more effect: those that gain most by regression, and at most so
        many of the standard joint model.
        """
        world, (followed, names) = self.world, trial
        columns = self._library_columns()
        probes = [p for n in names for p in self._tangents(n, followed.theta[world.slots[n]])]
        joined = columns.joined(followed.columns(probes)) if probes else columns
        always = range(len(columns.probes), len(joined.probes))
        regression = regress(followed, joined, always=always)
        prices = np.array([regression.price(group) for group in regression.groups])
        gains = regression.gains([]) - prices
        found: dict[str, Array] = {}
        for i in np.argsort(-gains, kind="stable").tolist():
            group = regression.groups[i]
            if group.effect in (*names, *found):
                continue
            if len(found) == MAX_TRIALS or gains[i] < max(MIN_GAIN_SHARE * gains.max(), 0.0):
                break
            found[group.effect] = self._numbers(group, regression.solve([group])[1][0])
        proposed = [*found.items(), *self._joint_model(followed, {*names, *found}, most)]
        own = Start(names, followed.theta, world.guess)
        return [with_effect(world, own, name, c) for name, c in proposed]

    def _joint_model(
        self, followed: FollowedRuns, known: Collection[str], most: int
    ) -> list[tuple[str, Array]]:
        """Return effects of the standard joint model at the joint where most is missing, each with
        its first coefficient (1,): dry and viscous friction, armature, stiffness and damping of the
        servo, and an offset of the encoder.

        A regression may miss them: they are not linear where a joint sticks, where a servo is stiff
        for a light joint, and where an offset changes the pose.
        """
        world = self.world
        assert isinstance(world.simulator, RobotSimulator)
        joint = followed.joints_by_loss[0]
        place = self._joint_name(joint)
        speed = max(float(np.abs(one.trajectory.v[:, joint]).max()) for one in followed.linear)
        typical = {
            f"drag.linear@{place}": FIRST_SHARE * float(followed.typical[joint]) / max(speed, 1e-9),
            f"inertia.armature@{place}": float(scales(world.simulator.robot).inertia[joint]),
        }
        servo = str(getattr(world.simulator.system, "servos", {}).get(joint, "")).removeprefix("u.")
        effects = [f"{effect}@{place}" for effect in JOINT_MODEL]
        effects += [f"{effect}@{servo}" for effect in SERVO_MODEL]
        steps = []
        for name in effects:
            if name in world.library and name not in known:
                bounds = coefficient_bounds(world, name)
                step, gain = gauss_newton_step(followed, world.places(name), bounds)
                steps.append((gain, name, float(step[world.places(name)[0]])))
        steps.sort(key=lambda one: -one[0])
        first = {f"sensor.bias@q.{place}": self._offset_from_command(joint)}
        friction = f"friction.coulomb@{place}"
        if friction in world.library:
            # A derivative by more friction does not tell what less friction than stated does.
            first[friction] = FIRST_SHARE * min(coefficient_bounds(world, friction)[0][0], 0.0)
        found = [(n, c) for n, c in first.items() if c and n in world.library and n not in known]
        for gain, name, change in steps[:most]:
            # Where much process noise hides an effect, its typical size is tried.
            pays = gain > 0.5 * self._penalty(name)
            first_size = typical.get(name, float(np.copysign(FIRST_SHARE, change)))
            found.append((name, change if pays else first_size))
        return [(name, np.array([c])) for name, c in found if c]

    def _joint_name(self, joint: int) -> str:
        coordinate: str = self.world.simulator.system.coordinates[joint]
        return coordinate.removeprefix("q.")

    def _follow_with(
        self, theta: Array, names: Sequence[str], steps: int = GAUSS_NEWTON_STEPS
    ) -> FollowedRuns:
        """Follow the runs with effects in the model, whose coefficients Gauss-Newton steps improve.

        Args:
            theta: (P,) initial parameters.
            names: the effects.
            steps: maximum number of Gauss-Newton steps.
        """
        known = self._trial_filters.get(theta.tobytes())
        begin = known or self._follow_near(theta, self.follow())
        bounds = [b for name in names for b in coefficient_bounds(self.world, name)]
        places = [place for name in names for place in self.world.places(name)]
        best = maximise_likelihood(begin, places, bounds, steps, self._follow_near)
        self._trial_filters = {
            best.theta.tobytes(): best,
            **dict(list(self._trial_filters.items())[:MAX_CACHED_FILTERS]),
        }
        return best

    def _follow_near(self, theta: Array, known: FollowedRuns) -> FollowedRuns:
        """Follow the runs with other parameters, about a motion that is known."""
        followed = known.with_parameters(theta)
        # With an encoder offset the true motion differs from the readings.
        return followed.with_parameters(theta) if self._has_moved_far(followed) else followed

    def _offset_from_command(self, joint: int) -> float:
        """Return the mean difference of a joint's readings from the command of its position servo;
        zero without a servo, or where the difference is small.
        """
        world, system = self.world, self.world.simulator.system
        channel = system.coordinates[joint]
        servo = getattr(system, "servos", {}).get(joint)
        if servo is None or channel not in world.channels:
            return 0.0
        column = world.channels.index(channel)
        apart = []
        for track in world.tracks:
            inputs = track.scenario.inputs
            if servo in inputs:
                apart.append(track.observed[:, column] - system.gear(joint) * inputs[servo])
        distance = float(np.nanmean(np.concatenate(apart))) if apart else 0.0
        return distance if abs(distance) > OFFSET_THRESHOLD * self.noise.sigma[column] else 0.0

    def _has_moved_far(self, followed: FollowedRuns) -> bool:
        """Whether the smoothed motion is far from that about which the model is linear."""
        size = followed.linear[0].positions
        moved = np.abs(followed.smoothed.states[:, :, :size])
        return bool(moved.max() > RELINEARISATION_THRESHOLD * float(np.nanmax(self.noise.sigma)))

    def _derivatives(
        self, theta: Array, names: Sequence[str], respond: Callable[[Sequence[Probe]], Array]
    ) -> tuple[list[int], Array]:
        """Derivatives by the coefficients of effects, as differences of responses.

        Args:
            theta: (P,) parameters.
            names: the effects.
            respond: what probes change about all runs, (R, T, C, K).

        Returns:
            The places of the q coefficients in theta, and derivatives (R, T, C, q).
        """
        tangents = [self._tangents(name, theta[self.world.slots[name]]) for name in names]
        changes = respond([probe for own in tangents for probe in own])
        places, columns, first = [], [], 0
        for name, (whole, *moved) in zip(names, tangents, strict=True):
            for k, (place, probe) in enumerate(zip(self.world.places(name), moved, strict=True)):
                # A coefficient without a range has no derivative.
                step = float(probe.c[k] - whole.c[k]) or np.inf
                columns.append((changes[..., first + 1 + k] - changes[..., first]) / step)
                places.append(place)
            first += 1 + len(moved)
        return places, np.stack(columns, axis=-1)

    @property
    def _must_end(self) -> bool:
        """Whether the budget is spent or the user has interrupted."""
        return bool(self.world.watch.left())

    def _form_of_friction(self, selected: Selected) -> tuple[bool, bool]:
        """Whether dry friction without a state follows the data as well as what was selected, and
        whether it does better in MuJoCo's soft form.

        The force of friction is not linear in its limit where a joint sticks or creeps, so whole
        models are followed.
        """
        start = self._start(selected.groups, selected.coefficients)
        plain = self._plain_theta(start)
        has_state = not np.array_equal(plain, start.theta)
        likelihood = self._likelihood(plain)
        softer = -np.inf if self._is_soft else self._likelihood(plain, self._soft_simulator)
        own = self._likelihood(start.theta) if has_state else -np.inf
        best = max(likelihood, softer)
        stands = best > own - 0.5 * SWITCH
        return stands, softer > max(likelihood, own) + 0.5 * SWITCH

    @property
    def _is_soft(self) -> bool:
        """Whether effects add dry friction in MuJoCo's soft form."""
        robot: Any = self.world.kind
        return bool(robot.robot.friction_form == "soft")

    @cached_property
    def _soft_simulator(self) -> RobotSimulator:
        """The simulator with dry friction in MuJoCo's soft form."""
        simulator = self.world.simulator_of(soft_kind(self.world.kind))
        assert isinstance(simulator, RobotSimulator)
        return simulator

    def _likelihood(self, theta: Array, simulator: RobotSimulator | None = None) -> float:
        """Return the log likelihood of the innovations with these parameters of a simulator; None
        stands for that of the world.
        """
        key = theta.tobytes(), simulator is None
        if key not in self._likelihoods:
            self._likelihoods[key] = self.follow().with_parameters(theta, simulator).log_likelihood
        return self._likelihoods[key]

    def _plain_theta(self, start: Start) -> Array:
        """The parameters of a start with dry friction in place of laws with a state."""
        world, theta = self.world, start.theta.copy()
        for name in start.effects:
            plain = plain_friction(world, name)
            if plain != name:
                # The first coefficient of both is the limit of the friction.
                theta[world.places(plain)[0]] += theta[world.places(name)[0]]
                theta[world.places(name)] = 0.0
        return theta

    # -- the linear models

    @cached_property
    def _reference(self) -> Array:
        """(P,) parameters without any effect: those of the base model, with free numbers as they
        are identified beside effects. A base model without these may need absurd numbers.
        """
        theta: Array = self.base.fit.theta.copy()
        identified = self.world.identified
        if identified is not None:
            kept = [i not in self.frozen for i in self.world.base.tolist()]
            theta[self.world.base[kept]] = identified[kept]
        return theta

    def take_over(self, other: PredictionErrorSearch) -> None:
        """Use the filter and the responses of a search of the same runs with the other form of dry
        friction, whose base model has none.
        """
        self.world.followed = replace(other.follow(), world=self.world)
        self._columns, self._hats = other._columns, other._hats

    def follow(self) -> FollowedRuns:
        """Return the runs as the filter follows them with the base model."""
        return FollowedRuns.of_model(self.world, self._reference, self.noise)

    def _library_columns(self) -> Columns:
        if self._columns is None:
            names = [name for name in self.world.library if not self._has_many_shapes(name)]
            self.world.watch.stage(f"testing {len(names)} effects", 1)
            self._columns = self.follow().columns(self._probes(names))
        return self._columns

    def _probes(self, names: Sequence[str]) -> list[Probe]:
        found = []
        for name in names:
            lows = [low for low, _ in coefficient_bounds(self.world, name)]
            for probe in first_probes(self.world, self.base.fit, name):
                # What the model file states may be too much.
                signed = probe.signed or (lows[probe.place] < 0 and not probe.fixed)
                found.append(replace(probe, signed=signed))
        return found

    @staticmethod
    def _has_many_shapes(name: str) -> bool:
        return name.partition("@")[0] in MANY_SHAPES

    def _acts_at(self, name: str, joints: Collection[int | None]) -> bool:
        """Whether an effect acts at one of some joints."""
        effect, coordinates = self.world.effects[name], self.world.simulator.system.coordinates
        for member in members_of(effect):
            if member.coordinate in joints:
                return True
            signal = member.signal.partition(".")[2]
            if any(j is not None and signal == coordinates[j][2:] for j in joints):
                return True
        return False

    # -- fits by simulation

    def _fit_selection(self, selected: Selected) -> Model:
        """Fit the selected set by simulation, and leave out effects that do not pay there."""
        if not selected.groups:
            return self.base
        start = self._start(selected.groups, selected.coefficients)
        found = self._fit(replace(start, states=self._first_states(selected.followed)))
        if not np.isfinite(found.fit.cost):
            return self.base
        found = self._without_idle_effects(found)
        if selected.shows_steps:
            found = self._corrected(found)
        return self._of_higher_merit(found, self.base)

    def _fit(self, start: Start) -> Model:
        """Fit a set by simulation; where that leaves much, again with derivatives by the first
        states about the simulated motion, since those about the measured one may not hold.
        """
        self.refit([start], race=False)
        found = self.models[frozenset(start.effects)]
        if self._is_explained(found) or not np.isfinite(found.fit.cost):
            return found
        before = self.world.derivatives
        begun(self.world, found.fit.theta, found.fit.states, anew=True)
        self.refit([found.fit.start()], race=False)
        found = self.models[frozenset(start.effects)]
        if not self._is_explained(found):
            # Derivatives about a wrong motion hold for no other model.
            self.world.derivatives = before
        for name in found.names:
            if has_dry_friction(self.world, [name]) and not self._is_explained(found):
                found = self._fit_nearby(found, name)
        return found

    def _fit_nearby(self, model: Model, name: str) -> Model:
        """Fit a model again from the best of some coefficients of an effect nearby."""
        starts = self._starts_nearby(model, name)
        costs = costs_of_starts(self.world, self.noise, starts, share=1.0, lost=np.inf)
        best = int(np.argmin(costs))
        if not costs[best] < model.fit.cost:
            return model
        self.refit([starts[best]], race=False)
        return self.models[frozenset(model.names)]

    def _starts_nearby(self, model: Model, name: str) -> list[Start]:
        """Starts with coefficients of an effect nearby. The runs begin where the fit has them
        begin, or where they are measured to begin.
        """
        starts = []
        for place in self.world.places(name):
            for factor in NEARBY:
                theta = model.fit.theta.copy()
                theta[place] *= factor
                for states in (model.fit.states, self._first_states(self.follow())):
                    starts.append(Start(model.names, theta, states))
        return starts

    def _is_explained(self, model: Model) -> bool:
        """Whether a fitted model leaves no more than noise, or next to nothing of a large gap."""
        if self._is_at_noise(model):
            return True
        # Friction of the other form leaves a small residual.
        friction = has_dry_friction(self.world, model.names) and not self._is_soft
        share = NEGLIGIBLE_SHARE * self.excess(self.base)
        return not friction and self.excess(model) < min(NEGLIGIBLE, share)

    def _is_at_noise(self, model: Model) -> bool:
        """Whether a fitted model leaves no more than noise."""
        return self.quiet(model) and self.excess(model) < EXPLAINED_EXCESS

    def fit_rivals(self, best: Model) -> Model:
        """Fit the sets that do nearly as well by the regression, and return the best of all."""
        if not best.names or not np.isfinite(best.fit.cost) or self._has_series(best):
            return best
        starts = []
        own = self._followed_by(best).log_likelihood
        for name in best.names:
            for group, coefficients, behind in self._find_rivals(best, name):
                names = (*(n for n in best.names if n != name), group.effect)
                if frozenset(names) in self.models:
                    continue
                theta = best.fit.theta.copy()
                theta[self.world.slots[name]] = 0.0
                theta[self.world.slots[group.effect]] = self._numbers(group, coefficients)
                if behind > RIVAL_MARGIN:
                    # Regression is linear; a filter with the rival in the model is not.
                    slot = self.world.slots[group.effect]
                    few = slot.stop - slot.start <= MAX_IMPROVED_SIZE
                    followed = self._follow_with(theta, names, GAUSS_NEWTON_STEPS if few else 0)
                    if 2.0 * (own - followed.log_likelihood) > RIVAL_MARGIN:
                        continue
                    theta = followed.theta
                starts.append(Start(names, theta, best.fit.states))
        if starts:
            self.refit(starts, race=False)
        size = len(best.names)
        if size == 1 and self.follow().runs.jumps.any():
            # Fits at force limits are caught.
            known = [m for m in self.models.values() if len(m.names) == 1 and m is not best]
            laws = JOINT_MODEL + SERVO_MODEL
            self._refine_singles([m for m in known if m.names[0].partition("@")[0] in laws])
        elsewhere = [
            start
            for model in self._near_the_best(size)
            for name in model.names
            for start in self._at_coupled_joints(model, name)
        ]
        if elsewhere:
            self.refit(list({frozenset(s.effects): s for s in elsewhere}.values()), race=False)
        self._refine_near(size)
        likeliest = self.best(size)
        return best if likeliest is None else likeliest

    def _refine_near(self, size: int) -> None:
        """Fit the models of a size whose merit is near the best until nothing is left to gain, so
        that incomplete fits do not decide between them.
        """
        near = self._near_the_best(size)
        if self._must_end or len(near) < 2:
            return
        fitter = Fitter(self.world, self.noise, self.frozen, exact=True)
        for model, fit in zip(near, fitter.fit([m.fit.start() for m in near], STEPS), strict=True):
            if fit.cost < model.fit.cost:
                self.enter(fit)

    def _find_rivals(self, model: Model, name: str) -> list[tuple[Group, Array, float]]:
        """The effects that do nearly as well in the place of one: the best group of columns of
        each, its coefficients, and how far it is behind in twice the log likelihood.
        """
        regression = self._regression(model)
        own = self._model_columns[self._key(model)][name]
        rest = regression.instead_of(own)
        # What has more coefficients gains more by chance.
        gains = rest.gains([]) - np.array([rest.price(group) for group in rest.groups])
        mine = rest.gain_of(own) - self._penalty(name)
        found: dict[str, tuple[Group, Array, float]] = {}
        same_joint = self._joint_models_where_acts(name)
        near_count = 0
        for i in np.argsort(-gains, kind="stable").tolist():
            group = rest.groups[i]
            behind = mine - float(gains[i])
            is_near = (
                behind <= RIVAL_MARGIN + LINEARISATION_ERROR * mine and near_count < MAX_RIVALS
            )
            # Regression is inaccurate for a large effect, so effects at the same joint are tried.
            is_alike = group.effect in same_joint and gains[i] > ALIKE_SHARE * mine
            if group.effect not in self.world.library or group.effect in (*model.names, *found):
                continue
            # A law that contains this one never replaces it.
            if (is_near or is_alike) and name not in self.world.effects[group.effect].contains:
                near_count += is_near
                found[group.effect] = group, rest.solve([group])[1][0], behind
        return list(found.values())

    def _near_the_best(self, size: int) -> list[Model]:
        """The models with a number of effects whose merit is near that of the best of them."""
        likeliest = self.best(size)
        return [
            model
            for model in self.models.values()
            if likeliest is not None
            and len(model.names) == size
            and model.merit > likeliest.merit - RIVAL_MARGIN
        ]

    def _at_coupled_joints(self, model: Model, name: str) -> list[Start]:
        """Starts with an effect of a model at the other joints of its loop, where it may do the
        same: a filter tells little of joints that are not measured.
        """
        law, _, joint = name.partition("@")
        coordinates = [one.removeprefix("q.") for one in self.world.simulator.system.coordinates]
        if joint not in coordinates:
            return []
        number, slots = coordinates.index(joint), self.world.slots
        others = {k for group in self._loops if number in group for k in group} - {number}
        starts = []
        for other in (f"{law}@{coordinates[k]}" for k in sorted(others)):
            names = (*(one for one in model.names if one != name), other)
            if other not in slots or other in model.names or frozenset(names) in self.models:
                continue
            theta = model.fit.theta.copy()
            theta[slots[other]], theta[slots[name]] = theta[slots[name]], 0.0
            starts.append(Start(names, theta, model.fit.states))
        return starts

    @cached_property
    def _loops(self) -> list[set[int]]:
        """Numbers of the joints that constraints couple."""
        assert isinstance(self.world.simulator, RobotSimulator)
        model = self.world.simulator.wide().model
        return coupled_joints(model, self.world.simulator.addresses.velocities.tolist())

    def _joint_models_where_acts(self, name: str) -> set[str]:
        """The effects of the joint and servo models at the joint where an effect acts."""
        count = len(self.world.simulator.system.coordinates)
        joints = {j for j in range(count) if self._acts_at(name, {j})}
        plain = (*JOINT_MODEL, *SERVO_MODEL)
        return {
            other
            for other in self.world.library
            if other.partition("@")[0] in plain
            and not other.endswith("@*")
            and self._acts_at(other, joints)
        }

    def _start(self, groups: Sequence[Group], coefficients: Sequence[Array]) -> Start:
        """Where the fit of a set by simulation begins."""
        theta = self._reference.copy()
        for group, own in zip(groups, coefficients, strict=True):
            theta[self.world.slots[group.effect]] = self._numbers(group, own)
        return Start(tuple(group.effect for group in groups), theta, self.base.fit.states)

    def _numbers(self, group: Group, coefficients: Array) -> Array:
        """The coefficients of an effect that a group of columns with these coefficients means."""
        assert self._columns is not None
        probes = self._columns.probes
        c = probes[group.columns[0]].c.copy()
        for column, value in zip(group.columns, coefficients, strict=True):
            # A fixed change is that of this very size.
            if not probes[column].fixed:
                c[probes[column].place] = value
        return self._within_bounds(group.effect, c)

    def _within_bounds(self, name: str, c: Array) -> Array:
        """The coefficients (k,) of an effect, limited to their bounds."""
        low, high = np.array(coefficient_bounds(self.world, name)).T
        limited: Array = np.clip(c, low, high)
        return limited

    # -- scores

    def _key(self, model: Model) -> bytes:
        return model.fit.theta.tobytes()

    def _regression(self, model: Model) -> Regression:
        """The regression of innovations with a fitted model's effects in the model; candidates are
        the library and hats.
        """
        key = self._key(model)
        if key not in self._regressions:
            followed, now = self.follow(), self._followed_by(model)
            columns = self._library_columns().joined(self._hat_columns())
            own: dict[str, list[int]] = {}
            probes: list[Probe] = []
            for name in model.names:
                tangents = self._tangents(name, model.fit.theta[self.world.slots[name]])
                first = len(columns.probes) + len(probes)
                own[name] = list(range(first, first + len(tangents)))
                probes += tangents
            joined = columns.joined(followed.columns(probes)) if probes else columns
            always = range(len(columns.probes), len(joined.probes))
            self._regressions[key] = regress(now, joined, always=always)
            self._model_columns[key] = own
        return self._regressions[key]

    def _hat_columns(self) -> Columns:
        """Forces of any shape as candidates, by the labels of their families."""
        if self._hats is None:
            probes, _ = hat_probes(self.world)
            named = [replace(probe, effect=JointHat.name) for probe in probes]
            self._hats = replace(self.follow().columns(named), probes=tuple(probes))
        return self._hats

    def _followed_by(self, model: Model) -> FollowedRuns:
        """Return the runs as a filter follows them with a fitted model."""
        followed = self.follow()
        if not model.names:
            return followed
        key = self._key(model)
        if key not in self._followed:
            names = frozenset(model.names)
            known = self._followed_sets.get(names)
            found = (known or followed).with_parameters(model.fit.theta)
            if known is None:
                found = found.with_parameters(model.fit.theta, is_alike=True)
            self._followed_sets[names] = found
            share = self._selected.numerics if self._selected is not None else 0.0
            if share:
                defects = found.runs.defects - share * found.runs.step_errors
                found = found.refitted(replace(found.runs, defects=defects))
            self._followed[key] = found
        return self._followed[key]

    def _tangents(self, name: str, c: Array) -> list[Probe]:
        """The change that an effect makes with these coefficients, and those with each of them
        moved a little.
        """
        bounds = coefficient_bounds(self.world, name)
        probes = [Probe(name, 0, 0, c, signed=True, fixed=True)]
        for place, (low, high) in enumerate(bounds):
            moved = c.copy()
            step = RELATIVE_DIFFERENCE * max(
                abs(float(c[place])), RELATIVE_DIFFERENCE * (high - low)
            )
            moved[place] += step if moved[place] + step <= high else -step
            probes.append(Probe(name, 1 + place, place, moved, signed=True, fixed=True))
        return probes

    def scan(self, model: Model, against: Array | None = None) -> Scores:  # noqa: ARG002
        """Score every effect that the model lacks by the innovations."""
        key = frozenset(model.names)
        if key not in self.scored and self._has_series(model):
            # The candidates are linear about the robot without further joints.
            self.scored[key] = replace(self.scan(self.base), p_value=1.0)
            self.tests[key] = 1.0
        if key not in self.scored:
            self._look(model)
            regression = self._regression(model)
            lacking = set(self._lacking(model))
            scores = null_scores(regression, lacking, self.drawing("library", model.names))
            self.scored[key] = scores
            self.tests[key] = scores.p_value
            if not key and not self.chances:
                self.chances = dict(zip(scores.effects, scores.chance.tolist(), strict=True))
        return self.scored[key]

    def with_sensitivities(self, start: Start) -> Start:
        """Return a start with derivatives by its coefficients about the measured motion."""
        if start.known is not None or not start.effects:
            return start
        base = [i for i in self.world.base.tolist() if i not in self.frozen]
        if base:
            return start
        if any(is_series(self.world.effects[name]) for name in start.effects):
            return start
        followed = self.follow()
        places, derivatives = self._derivatives(
            start.theta,
            start.effects,
            lambda probes: followed.sensitivities(followed.columns(probes)),
        )
        return replace(start, known=Known(np.array(places, dtype=np.intp), derivatives))

    def directions_known(self) -> tuple[Fit, Directions] | None:
        """Return what every candidate changes about the base model's runs, to first order about the
        measured motion.
        """
        columns = self._library_columns()
        values = self.follow().sensitivities(columns)
        return self.base.fit, Directions(columns.probes, values)

    def force_of_any_shape(self, model: Model) -> tuple[float, str] | None:
        """Return the p-value of the best force of any shape, and what it follows."""
        if self._has_series(model):
            return None
        regression = self._regression(model)
        labels = {probe.effect for probe in self._hat_columns().probes}
        scores = null_scores(regression, labels, self.drawing("structure", model.names))
        return scores.p_value, scores.effects[0] if scores.effects else ""


def _is_force(effect: Effect) -> bool:
    """Whether an effect is a force that is computed in every step, or has states of its own."""
    return effect.hook in ("force", "hidden") and effect.of not in OVER_TIME
