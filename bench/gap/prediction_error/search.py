"""Search of effects that a robot's model lacks: by prediction errors, confirmed by simulation.

`identification` selects effects by the innovations of a filter. Here the selected set, its parts
and its rivals are fitted to whole simulated runs (output errors), which decide. The order:

    1. Select effects that have few shapes.
    2. Fit the set by simulation. If it leaves no more than noise, the search ends.
    3. Offer effects with many shapes at the joints where a force is still missing; select again,
       and fit.
    4. Fit the sets that do nearly as well by the regression: they may be equivalent.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.special import chdtrc

from bench.gap.causes.candidates import Directions, Probe, _first
from bench.gap.causes.gains import Group
from bench.gap.causes.joint_hats import JointHat
from bench.gap.causes.rules import ALPHA, SWITCH
from bench.gap.causes.score_test import Scores
from bench.gap.causes.search import Search
from bench.gap.causes.structure import hat_probes
from bench.gap.friction_form import (
    choose_friction_form,
    has_dry_friction,
    plain_friction,
    soft_kind,
)
from bench.gap.model.bounds import coefficient_bounds
from bench.gap.model.models import Model
from bench.gap.model.problem import Fit, Known, Start
from bench.gap.model.tangents import begun
from bench.gap.model.world import World
from bench.gap.prediction_error.candidate_responses import Columns, FollowedRuns
from bench.gap.prediction_error.identification import Selected, identify, regress
from bench.gap.prediction_error.null_distribution import null_scores
from bench.gap.prediction_error.selection import Regression
from sims.base import Array
from sims.robot.forces import OVER_TIME
from sims.robot.native import FIELDS
from sims.robot.scales import scales
from sims.robot.series import is_series
from sims.robot.simulator import RobotSimulator
from sims.simulated import Simulated
from sims.system import Effect

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
NEEDED = 20.0
"""Twice the log likelihood that the process noise of a joint must gain to be needed there."""
RIVAL = 20.0
"""Rivals this near in twice the log likelihood of the regression are fitted by simulation."""
LINEAR = 0.03
"""Share of a gain by which it may be wrong, since responses are linear."""
MAX_RIVALS = 3
"""Maximum number of rivals of each effect that are fitted by simulation."""
MAX_STEPS = 4
"""Maximum number of effects that are added one after another."""
SOME = 0.1
"""Share of the stated dry friction that is taken away where less of it is tried."""
OFF = 10.0
"""A smoothed first position takes the place of the recorded one from so many times the noise."""
ELSEWHERE = 100.0
"""The model is linearised again where the smoothed motion has moved by so many times the noise."""
FEW = 2
"""Sets of at most so many effects are fitted by simulation even where that is slow."""
KEPT = 6
"""Number of filters that are kept for effects that were tried."""
TRIED = 4
"""Maximum number of effects that are tried in the model at each step."""
PROMISING = 0.3
"""Share of the largest gain by regression that an effect must have to be tried in the model."""
REFINED = 1
"""Number of Gauss-Newton steps for an effect that is tried in the model."""
MOVED = 0.02
"""Share of a coefficient by which it is moved for its derivative."""
SILENT = 0.03
"""Excess over the noise below which a fitted set leaves nothing to explain."""


class SoftFrictionError(Exception):
    """Dry friction of these data has MuJoCo's soft form: search with a simulator of that form."""


@dataclass
class PredictionErrorSearch(Search):
    """A search whose candidates come from prediction errors.

    Attributes:
        selections: what was selected so far.
    """

    selections: list[Selected] = field(default_factory=list)
    _columns: Columns | None = None
    _hats: Columns | None = None
    _followed: dict[bytes, FollowedRuns] = field(default_factory=dict)
    _regressions: dict[bytes, Regression] = field(default_factory=dict)
    _tried: dict[bytes, FollowedRuns] = field(default_factory=dict)
    _own: dict[bytes, dict[str, list[int]]] = field(default_factory=dict)

    def run(self) -> Model:
        """Return the model of all effects that the data show."""
        watch = self.world.watch
        self.supported = self.base
        followed = self.follow()
        columns = self._plain_columns()
        watch.stage("selecting effects", 1)
        selected = identify(followed, columns)
        self.selections.append(selected)
        best = self._of_friction(selected)
        if not self._is_explained(best):
            best = self._better(best, self._fitted(selected))
        if not self._is_explained(best) and not self._is_cut and self._needs_noise(selected):
            best = self._better(best, self._step_by_step(selected, ()))
        if not self._is_explained(best):
            selected = self._with_many_shapes(selected)
            best = self._better(best, self._fitted(selected))
        if not self._is_explained(best) and not self._is_cut:
            best = self._better(best, self._in_series(selected))
        if not best.names:
            best = self._confirmed(selected)
        best = self._with_fewer(best)
        self.supported = best
        return best

    def _in_series(self, selected: Selected) -> Model:
        """The best model with what gives between a drive and its links, at the joint where most is
        missing. It has states of its own and no small size, so that it is simulated at each shape.
        """
        joint = int(np.argmax(selected.followed.needs_process_noise()))
        effects = self.world.effects
        names = [n for n in self.world.library if is_series(effects[n])]
        probes = self._probes([n for n in names if self._acts_at(n, {joint})])
        runs = len(self.world.tracks)
        if not probes:
            return self.base
        self.world.watch.stage("testing what gives between drive and links", len(probes))
        thetas = []
        for probe in probes:
            theta = self.base.fit.theta.copy()
            theta[self.world.slots[probe.effect]] = probe.c
            thetas.append(theta)
        simulated = self.world.simulate(
            np.repeat(thetas, runs, axis=0),
            np.tile(np.arange(runs), len(probes)),
            np.tile(self.world.guess, (len(probes), 1)),
        ).reshape(len(probes), *self.world.observed.shape)
        left = np.where(self.seen, (self.world.observed - simulated) / self.noise.sigma, 0.0)
        with np.errstate(all="ignore"):
            costs = np.nan_to_num(np.square(left).sum(axis=(1, 2, 3)), nan=np.inf)
        best: dict[str, int] = {}
        for i in np.argsort(costs, kind="stable").tolist():
            best.setdefault(probes[i].effect, i)
        starts = [Start((name,), thetas[i], self.world.guess) for name, i in best.items()]
        self.refit(starts, race=False)
        fitted = [self.models[frozenset((name,))] for name in best]
        return max(fitted, key=lambda model: model.merit)

    def _has_series(self, model: Model) -> bool:
        """Whether a model has joints in series with others, and so states of its own."""
        return any(is_series(self.world.effects[name]) for name in model.names)

    def _with_fewer(self, best: Model) -> Model:
        """One effect in place of several, where a filter with it in the model does as well: two
        laws that are linear may stand for one that is not.
        """
        if (
            len(best.names) < 2
            or self._has_series(best)
            or not self._is_explained(best)
            or self._is_cut
        ):
            return best
        theta = self.base.fit.theta
        tried = [
            (*self._refined(start, [name], turns=0), name)
            for name, start in self._promising(self.follow(), theta, [])
        ]
        if not tried:
            return best
        first = max(tried, key=lambda one: 2.0 * one[2] - self._price(one[3]))
        name = first[3]
        theta, followed, likelihood = self._refined(first[0], [name])
        own = float(self._followed_by(best).filtered.log_likelihood.sum())
        price = sum(self._price(one) for one in best.names) - self._price(name)
        if 2.0 * (own - likelihood) > price + RIVAL:
            return best
        single = self._fit(Start((name,), theta, self._first_states(followed)))
        return self._better(single, best)

    @staticmethod
    def _better(one: Model, other: Model) -> Model:
        return max(one, other, key=lambda model: model.merit)

    def _of_friction(self, selected: Selected) -> Model:
        """The fitted model that begins with the dry friction of a selection; the base model where
        nothing is missing beside what was selected, or where friction was not.

        Raises:
            SoftFrictionError: the friction has MuJoCo's soft form.
        """
        if not self._needs_noise(selected):
            return self.base
        plain = self._plain_friction(selected)
        if not plain:
            return self.base
        start = self._start(selected.groups, selected.coefficients)
        only, own = self.base.fit.theta.copy(), self._plain_theta(start)
        for name in plain:
            only[self.world.slots[name]] = own[self.world.slots[name]]
        best = self._fit(Start(plain, only, self._first_states(self.follow())))
        if self._is_explained(best):
            return self._lean(best)
        stands, softer = self._form_of_friction(selected)
        if not stands:
            return best
        if softer and self._is_softer(best):
            raise SoftFrictionError
        return self._better(best, self._step_by_step(selected, plain))

    def _plain_friction(self, selected: Selected) -> tuple[str, ...]:
        """The dry friction of a selection, without a state; a family in place of its members."""
        world = self.world
        plain = dict.fromkeys(plain_friction(world, name) for name in selected.effects)
        native = [name for name in plain if name.partition("@")[0] in FIELDS]
        names = [name for name in native if has_dry_friction(world, [name])]
        return tuple(n for n in names if not any(n in world.effects[m].contains for m in names))

    def _needs_noise(self, selected: Selected) -> bool:
        """Whether forces are still missing beside what was selected."""
        return bool((selected.followed.needs_process_noise() > NEEDED).any())

    def _fitted(self, selected: Selected) -> Model:
        """The selected set fitted by simulation, where that is quick or promises to end the search;
        else the base model.
        """
        large = len(selected.groups) > FEW
        if large and self._is_slow(selected) and self._needs_noise(selected):
            return self.base
        return self._confirmed(selected)

    def _with_many_shapes(self, selected: Selected) -> Selected:
        """Select again with effects of many shapes, at the joints where a force is missing."""
        joints = {int(j) for j in np.flatnonzero(selected.followed.needs_process_noise() > NEEDED)}
        rich = [n for n in self.world.library if self._is_rich(n) and self._acts_at(n, joints)]
        if not rich:
            return selected
        self.world.watch.stage(f"testing {len(rich)} effects with many shapes", 1)
        followed = self.follow()
        self._columns = self._plain_columns().joined(followed.columns(self._probes(rich)))
        found = identify(followed, self._columns)
        self.selections.append(found)
        return found

    def _is_slow(self, selected: Selected) -> bool:
        """Whether a set is slow to simulate, as forces that are asked for in every step are."""
        effects = [self.world.effects[name] for name in selected.effects]
        return any(m.of not in FIELDS for e in effects for m in _members(e) if _is_force(m))

    # -- selection with the model linearised again after each effect

    def _first_states(self, followed: FollowedRuns) -> Array:
        """(R, s) states at the first samples: those of the base fit are bent by what is missing.

        Positions are smoothed with the effects in the model, since an encoder may be off.
        """
        states, positions = self.world.guess.copy(), followed.first_positions()
        own = states[:, : positions.shape[1]]
        noise = float(np.nanmax(self.noise.sigma))
        moved = np.abs(positions - own) > OFF * noise
        fine = np.isfinite(positions) & moved & ~self.world.known[:, : positions.shape[1]]
        states[:, : positions.shape[1]] = np.where(fine, positions, own)
        return states

    def _step_by_step(self, selected: Selected, begin: Sequence[str]) -> Model:
        """Add effects one after another, each chosen by whole filters with the effect in the model.

        Where much is missing, the noise of the measured motion is in the innovations and in the
        responses of effects that follow the same readings, and regression prefers these. A filter
        with the right effect in the model needs no process noise any more.

        Args:
            selected: what regression has selected.
            begin: dry friction that is in the model from the beginning.
        """
        theta, names = self.base.fit.theta.copy(), list(begin)
        followed = self.follow()
        likelihood = float(followed.filtered.log_likelihood.sum())
        if names:
            own = self._plain_theta(self._start(selected.groups, selected.coefficients))
            for name in names:
                theta[self.world.slots[name]] = own[self.world.slots[name]]
            theta, followed, likelihood = self._refined(theta, names)
        watch = self.world.watch
        for _ in range(MAX_STEPS):
            watch.stage("testing effects in the model one by one", TRIED)
            tried = []
            for name, start in self._promising(followed, theta, names):
                tried.append((*self._refined(start, [*names, name], turns=0), name))
                watch.advance()
                watch.check()
            if not tried:
                break
            # The coefficients of the best two are improved before they are compared.
            tried.sort(key=lambda one: self._price(one[3]) - 2.0 * one[2])
            tried = [(*self._refined(one[0], [*names, one[3]]), one[3]) for one in tried[:2]]
            best = max(tried, key=lambda one: 2.0 * one[2] - self._price(one[3]))
            name = best[3]
            if 2.0 * (best[2] - likelihood) < self._price(name):
                break
            theta, followed, likelihood, _ = best
            contained = self.world.effects[name].contains
            names = [n for n in names if n not in contained] + [name]
            if not (followed.needs_process_noise() > NEEDED).any():
                break
        if not names:
            return self.base
        fitted = self._fit(Start(tuple(names), theta, self._first_states(followed)))
        return self._lean(fitted) if np.isfinite(fitted.fit.cost) else self.base

    def _lean(self, model: Model) -> Model:
        """The model without effects that do not pay, and with one member in place of a family where
        it does as well.
        """
        model = self._as_families(self.drop(model))
        families = any(name.endswith("@*") for name in model.names)
        return self.plainer(model) if families else model

    def _as_families(self, model: Model) -> Model:
        """The model with a family in place of all its members, which cost more one by one."""
        for family in (n for n in self.world.library if n.endswith("@*")):
            members = [member.name for member in _members(self.world.effects[family])]
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

    def lacks(self, model: Model) -> float:
        """Return the p-value of the effect that a fitted model seems to lack most; where the
        innovations show one it is fitted by simulation, since they are linear in it.
        """
        scores = self.scan(model)
        if scores.p_value > ALPHA or not np.isfinite(model.fit.cost):
            return scores.p_value
        name = scores.effects[0]
        (group, coefficients), *_ = scores.peaks[0]
        theta = model.fit.theta.copy()
        contained = self.world.effects[name].contains
        for other in contained:
            # What is free is no effect.
            if other in self.world.slots:
                theta[self.world.slots[other]] = 0.0
        theta[self.world.slots[name]] = self._numbers(group, coefficients)
        names = (*(n for n in model.names if n not in contained), name)
        self.refit([Start(names, theta, model.fit.states)], race=False)
        larger = self.models[frozenset(names)]
        gain = max(larger.likelihood.value - model.likelihood.value, 0.0)
        slot = self.world.slots[name]
        return float(min(len(self.world.library) * chdtrc(slot.stop - slot.start, gain), 1.0))

    def _price(self, name: str) -> float:
        """What an effect must gain in twice the log likelihood."""
        slot = self.world.slots[name]
        return float((slot.stop - slot.start) * self.price + 2.0 * np.log(len(self.world.library)))

    def _promising(
        self, followed: FollowedRuns, theta: Array, names: Sequence[str]
    ) -> list[tuple[str, Array]]:
        """The effects that gain most beside those in the model, with parameters to begin with."""
        columns = self._plain_columns()
        probes = [p for n in names for p in self._tangents(n, theta[self.world.slots[n]])]
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
            if len(found) == TRIED or gains[i] < max(PROMISING * gains.max(), 0.0):
                break
            start = theta.copy()
            for contained in self.world.effects[group.effect].contains:
                if contained in self.world.slots:
                    start[self.world.slots[contained]] = 0.0
            start[self.world.slots[group.effect]] = self._numbers(
                group, regression.solve([group])[1][0]
            )
            found[group.effect] = start
        return [
            *found.items(),
            *self._of_joint_model(followed, theta, [*names, *found]),
        ]

    def _of_joint_model(
        self,
        followed: FollowedRuns,
        theta: Array,
        names: Sequence[str],
    ) -> list[tuple[str, Array]]:
        """The standard joint model at the joint where most is missing: dry friction, less than the
        model file states, armature, as large as the joint's own inertia, and an encoder's offset.

        None is linear: where a joint sticks, where a servo is too stiff for a light joint, and
        where the pose is another one.
        """
        world = self.world
        assert isinstance(world.simulator, RobotSimulator)
        coordinates = world.simulator.system.coordinates
        joint = int(np.argmax(followed.needs_process_noise()[: len(coordinates)]))
        place = coordinates[joint].removeprefix("q.")
        inertia = float(scales(world.simulator.robot).inertia[joint])
        found = []
        offset, apart = f"sensor.bias@q.{place}", self._from_command(joint)
        if offset in world.library and offset not in names and apart:
            start = theta.copy()
            start[world.slots[offset]] = apart
            found.append((offset, start))
        speed = max(float(np.abs(one.trajectory.v[:, joint]).max()) for one in followed.linear)
        damping = SOME * float(followed.typical[joint]) / max(speed, 1e-9)
        for effect in ("friction.coulomb", "inertia.armature", "drag.linear"):
            name = f"{effect}@{place}"
            if name not in world.library or name in names:
                continue
            low, high = coefficient_bounds(world, name)[0]
            value = {"inertia.armature": inertia, "drag.linear": damping}.get(effect, SOME * low)
            if value:
                start = theta.copy()
                start[world.slots[name]] = np.clip(value, low, high)
                found.append((name, start))
        return found

    def _refined(
        self, theta: Array, names: Sequence[str], turns: int = REFINED
    ) -> tuple[Array, FollowedRuns, float]:
        """Follow the runs with effects in the model, and again after Gauss-Newton steps of their
        coefficients on the innovations.
        """
        key = theta.tobytes()
        known = self._tried.get(key)
        world, motion = self.world, self.follow().trajectories()
        noise = self.follow().noise
        best: tuple[Array, FollowedRuns, float] | None = None
        for turn in range(turns + 1):
            force = self.follow().force if best is None else best[1].force
            followed = known if turn == 0 and known is not None else None
            if followed is None:
                followed = FollowedRuns.follow(world, theta, noise, motion, force=force)
                if self._is_elsewhere(followed):
                    # With an encoder that is off the motion is another one.
                    own = followed.trajectories()
                    followed = FollowedRuns.follow(world, theta, noise, own, force=force)
            likelihood = float(followed.filtered.log_likelihood.sum())
            if best is not None and likelihood < best[2]:
                break
            best = theta, followed, likelihood
            if turn < turns:
                theta = self._improved(followed, theta, names)
        assert best is not None
        self._tried = {best[0].tobytes(): best[1], **dict(list(self._tried.items())[:KEPT])}
        return best

    def _from_command(self, joint: int) -> float:
        """Mean distance of a joint's readings from the command of its position servo; zero where it
        has none, or is near it.
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
        return distance if abs(distance) > OFF * self.noise.sigma[column] else 0.0

    def _is_elsewhere(self, followed: FollowedRuns) -> bool:
        """Whether the smoothed motion is far from that about which the model is linear."""
        size = followed.linear[0].positions
        moved = np.abs(followed.smoothed.states[:, :, :size])
        return bool(moved.max() > ELSEWHERE * float(np.nanmax(self.noise.sigma)))

    def _improved(self, followed: FollowedRuns, theta: Array, names: Sequence[str]) -> Array:
        """The coefficients of effects after a Gauss-Newton step on the innovations."""
        slots = self.world.slots
        tangents = [self._tangents(name, theta[slots[name]]) for name in names]
        responses = followed.responses(followed.columns([p for own in tangents for p in own]))
        columns, steps, places, first = [], [], [], 0
        for name, own in zip(names, tangents, strict=True):
            c, place = theta[slots[name]], self.world.places(name)[0]
            for k in range(c.size):
                columns.append(responses[..., first + 1 + k] - responses[..., first])
                steps.append(own[1 + k].c[k] - c[k])
                places.append(place + k)
            first += len(own)
        rows = np.stack(columns, axis=-1).reshape(-1, len(columns)).astype(np.float64)
        target = followed.filtered.whitened.reshape(-1)
        solved = np.linalg.lstsq(rows, target, rcond=1e-8)[0]
        result = theta.copy()
        result[places] += solved * np.array(steps)
        for name in names:
            low, high = np.array(coefficient_bounds(self.world, name)).T
            result[slots[name]] = np.clip(result[slots[name]], low, high)
        return result

    @property
    def _is_cut(self) -> bool:
        """Whether the search has to end."""
        return bool(self.world.watch.left())

    def _is_softer(self, model: Model) -> bool:
        """Whether a fitted model with dry friction is likelier in MuJoCo's soft form."""
        world = self.world
        if not has_dry_friction(world, model.names):
            return False
        kind = soft_kind(world.kind)
        runs, free = world.runs, [p.name for p in world.freed]
        other = World(kind, world.recording, runs, world.engine, world.extra, free, world.library)
        other.watch, other.crew = world.watch, world.crew
        other.guess, other.derivatives = world.guess, world.derivatives
        self.world.crew.join(other)
        soft = choose_friction_form(self, model, other, SWITCH)
        other.close()
        return soft is not None

    def _form_of_friction(self, selected: Selected) -> tuple[bool, bool]:
        """Whether dry friction without a state follows the data as well as what was selected, and
        whether it does better in MuJoCo's soft form.

        The force of friction is not linear in its limit where a joint sticks or creeps, so whole
        models are followed.
        """
        world = self.world
        robot: Any = world.kind
        start = self._start(selected.groups, selected.coefficients)
        plain = self._plain_theta(start)
        has_state = not np.array_equal(plain, start.theta)
        is_soft = robot.robot.friction_form == "soft"
        likelihood = self._likelihood(plain, world.kind)
        softer = -np.inf if is_soft else self._likelihood(plain, soft_kind(world.kind))
        own = self._likelihood(start.theta, world.kind) if has_state else -np.inf
        best = max(likelihood, softer)
        stands = best > own - 0.5 * SWITCH
        return stands, softer > max(likelihood, own) + 0.5 * SWITCH

    def _likelihood(self, theta: Array, kind: type[Simulated]) -> float:
        """The log likelihood of the innovations with a simulator and its parameters."""
        world, followed = self.world, self.follow()
        effects: list[str | type[Effect]] = [*world.library, *world.extra]
        simulator = kind(world.recording.constants, world.channels, effects=effects)
        assert isinstance(simulator, RobotSimulator)
        motion = followed.trajectories()
        force = followed.force
        own = FollowedRuns.follow(world, theta, followed.noise, motion, simulator, force)
        return float(own.filtered.log_likelihood.sum())

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

    def follow(self) -> FollowedRuns:
        """Return the runs as the filter follows them with the base model."""
        known: FollowedRuns | None = self.world.followed
        theta, simulator = self.base.fit.theta, self.world.simulator
        assert isinstance(simulator, RobotSimulator)
        same = known is not None and known.world is self.world
        if known is None or not same or not np.array_equal(known.theta, theta):
            self.world.watch.stage("following the runs with the model", 1)
            # Of other steps the motion is not known at the ends of these.
            alike = known is not None and known.step == simulator.step
            nearby = known.trajectories() if known is not None and alike else None
            known = FollowedRuns.follow(self.world, theta, self.noise, nearby)
            self.world.followed = known
        return known

    def _plain_columns(self) -> Columns:
        if self._columns is None:
            names = [name for name in self.world.library if not self._is_rich(name)]
            self.world.watch.stage(f"testing {len(names)} effects", 1)
            self._columns = self.follow().columns(self._probes(names))
        return self._columns

    def _probes(self, names: Sequence[str]) -> list[Probe]:
        found = []
        for name in names:
            lows = [low for low, _ in coefficient_bounds(self.world, name)]
            for probe in _first(self.world, self.base.fit, name):
                # What the model file states may be too much.
                signed = probe.signed or (lows[probe.place] < 0 and not probe.fixed)
                found.append(replace(probe, signed=signed))
        return found

    @staticmethod
    def _is_rich(name: str) -> bool:
        return name.partition("@")[0] in MANY_SHAPES

    def _acts_at(self, name: str, joints: Collection[int | None]) -> bool:
        """Whether an effect acts at one of some joints."""
        effect, coordinates = self.world.effects[name], self.world.simulator.system.coordinates
        for member in _members(effect):
            if member.coordinate in joints:
                return True
            signal = member.signal.partition(".")[2]
            if any(j is not None and signal == coordinates[j][2:] for j in joints):
                return True
        return False

    # -- fits by simulation

    def _confirmed(self, selected: Selected) -> Model:
        """Fit the selected set by simulation, and leave out effects that do not pay there."""
        if not selected.groups:
            return self.base
        start = self._start(selected.groups, selected.coefficients)
        found = self._fit(replace(start, states=self._first_states(selected.followed)))
        if not np.isfinite(found.fit.cost):
            return self.base
        found = self._lean(found)
        if selected.shows_steps:
            found = self._corrected(found)
        return self._better(found, self.base)

    def _fit(self, start: Start) -> Model:
        """Fit a set by simulation; where that leaves much, again with derivatives by the first
        states about the simulated motion, since those about the measured one may not hold.
        """
        self.refit([start], race=False)
        found = self.models[frozenset(start.effects)]
        if self._is_explained(found) or not np.isfinite(found.fit.cost):
            return found
        begun(self.world, found.fit.theta, found.fit.states, anew=True)
        self.refit([found.fit.start()], race=False)
        return self.models[frozenset(start.effects)]

    def _is_explained(self, model: Model) -> bool:
        """Whether a fitted model leaves no more than noise."""
        return self.quiet(model) and self.excess(model) < SILENT

    def with_rivals(self, best: Model) -> Model:
        """Fit the sets that do nearly as well by the regression, and return the best of all."""
        if not best.names or not np.isfinite(best.fit.cost) or self._has_series(best):
            return best
        starts = []
        own = float(self._followed_by(best).filtered.log_likelihood.sum())
        for name in best.names:
            for group, coefficients, behind in self._rivals(best, name):
                names = (*(n for n in best.names if n != name), group.effect)
                if frozenset(names) in self.models:
                    continue
                theta = best.fit.theta.copy()
                theta[self.world.slots[name]] = 0.0
                theta[self.world.slots[group.effect]] = self._numbers(group, coefficients)
                if behind > RIVAL:
                    # Regression is linear; a filter with the rival in the model is not.
                    theta, _, likelihood = self._refined(theta, names)
                    if 2.0 * (own - likelihood) > RIVAL:
                        continue
                starts.append(Start(names, theta, best.fit.states))
        if starts:
            self.refit(starts, race=False)
        size = len(best.names)
        fitted = [m for m in self.models.values() if len(m.names) == size]
        return max(fitted, key=lambda model: model.merit)

    def _rivals(self, model: Model, name: str) -> list[tuple[Group, Array, float]]:
        """The effects that do nearly as well in the place of one: the best group of columns of
        each, its coefficients, and how far it is behind in twice the log likelihood.
        """
        regression = self._regression(model)
        own = self._own[self._key(model)][name]
        rest = regression.instead_of(own)
        # What has more coefficients gains more by chance.
        gains = rest.gains([]) - np.array([rest.price(group) for group in rest.groups])
        mine = rest.gain_of(own) - self._price(name)
        found: dict[str, tuple[Group, Array, float]] = {}
        for i in np.argsort(-gains, kind="stable").tolist():
            group = rest.groups[i]
            behind = mine - float(gains[i])
            if behind > RIVAL + LINEAR * mine or len(found) == MAX_RIVALS:
                break
            if group.effect not in self.world.library or group.effect in (*model.names, *found):
                continue
            # A richer law never stands for a plainer one that does as well.
            if name not in self.world.effects[group.effect].contains:
                found[group.effect] = group, rest.solve([group])[1][0], behind
        return list(found.values())

    def _names(self, groups: Sequence[Group]) -> tuple[str, ...]:
        return tuple(group.effect for group in groups)

    def _start(
        self, groups: Sequence[Group], coefficients: Sequence[Array], fit: Fit | None = None
    ) -> Start:
        """Where the fit of a set by simulation begins."""
        states = self.base.fit.states if fit is None else fit.states
        theta = self.base.fit.theta.copy()
        for group, own in zip(groups, coefficients, strict=True):
            theta[self.world.slots[group.effect]] = self._numbers(group, own)
        return Start(self._names(groups), theta, states)

    def _numbers(self, group: Group, coefficients: Array) -> Array:
        """The coefficients of an effect that a group of columns with these coefficients means."""
        assert self._columns is not None
        probes = self._columns.probes
        c = probes[group.columns[0]].c.copy()
        for column, value in zip(group.columns, coefficients, strict=True):
            # A fixed change is that of this very size.
            if not probes[column].fixed:
                c[probes[column].place] = value
        low, high = np.array(coefficient_bounds(self.world, group.effect)).T
        found: Array = np.clip(c, low, high)
        return found

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
            columns = self._plain_columns().joined(self._hat_columns())
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
            self._own[key] = own
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
            motion, force = followed.trajectories(), followed.force
            found = FollowedRuns.follow(
                self.world, model.fit.theta, followed.noise, motion, force=force
            )
            numerics = self.selections[-1].numerics if self.selections else 0.0
            defects = found.runs.defects - numerics * found.runs.step_errors
            self._followed[key] = found.refitted(replace(found.runs, defects=defects))
        return self._followed[key]

    def _tangents(self, name: str, c: Array) -> list[Probe]:
        """The change that an effect makes with these coefficients, and those with each of them
        moved a little.
        """
        bounds = coefficient_bounds(self.world, name)
        probes = [Probe(name, 0, 0, c, signed=True, fixed=True)]
        for place, (low, high) in enumerate(bounds):
            moved = c.copy()
            step = MOVED * max(abs(float(c[place])), MOVED * (high - low))
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
        probes, free = [], []
        for name in start.effects:
            c = start.theta[self.world.slots[name]]
            whole, *moved = self._tangents(name, c)
            probes.append(whole)
            probes += moved
            free += list(self.world.places(name))
        if any(is_series(self.world.effects[name]) for name in start.effects):
            return start
        changes = self.follow().output_sensitivities(probes)
        columns, place = [], 0
        for name in start.effects:
            c = start.theta[self.world.slots[name]]
            for k in range(c.size):
                # A coefficient without a range has no derivative.
                step = float(probes[place + 1 + k].c[k] - c[k]) or np.inf
                columns.append((changes[..., place + 1 + k] - changes[..., place]) / step)
            place += 1 + c.size
        known = Known(np.array(free, dtype=np.intp), np.stack(columns, axis=3))
        return replace(start, known=known)

    def directions_known(self) -> tuple[Fit, Directions] | None:
        """Return what every candidate changes about the base model's runs, to first order about the
        measured motion.
        """
        columns = self._plain_columns()
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

    def missing(self, model: Model, larger: Model) -> float:
        """Return the probability of the larger model's gain if nothing were missing."""
        gain = larger.likelihood.value - model.likelihood.value
        return self.gained(self.scan(model), larger, gain)


def _members(effect: Effect) -> Sequence[Effect]:
    """The members of a family; any other effect alone."""
    members: Sequence[Effect] = getattr(effect, "members", ()) or (effect,)
    return members


def _is_force(effect: Effect) -> bool:
    """Whether an effect is a force that is asked for in every step, or has states of its own."""
    return effect.hook in ("force", "hidden") and effect.of not in OVER_TIME
