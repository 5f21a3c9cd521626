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

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bench.gap.causes.candidates import Probe, _first
from bench.gap.causes.gains import Group
from bench.gap.causes.score_test import Scores
from bench.gap.causes.joint_hats import JointHat
from bench.gap.causes.search import Search
from bench.gap.causes.structure import hat_probes
from bench.gap.model.bounds import coefficient_bounds
from bench.gap.model.models import Model
from bench.gap.model.problem import Fit, Start
from bench.gap.prediction_error.candidate_responses import Columns, FollowedRuns
from bench.gap.prediction_error.identification import Selected, identify, regress
from bench.gap.prediction_error.null_distribution import null_scores
from bench.gap.prediction_error.selection import Regression
from sims.base import Array
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
RIVAL = 30.0
"""Rivals this near in twice the log likelihood of the regression are fitted by simulation."""
MAX_RIVALS = 4
"""Maximum number of rivals of each effect that are fitted by simulation."""
MOVED = 0.02
"""Share of a coefficient by which it is moved for its derivative."""
SILENT = 0.03
"""Excess over the noise below which a fitted set leaves nothing to explain."""


@dataclass
class PredictionErrorSearch(Search):
    """A search whose candidates come from prediction errors.

    Attributes:
        selections: what was selected so far.
    """

    selections: list[Selected] = field(default_factory=list)
    _columns: Columns | None = None
    _hats: Columns | None = None
    _followed: dict[frozenset[str], FollowedRuns] = field(default_factory=dict)
    _regressions: dict[frozenset[str], Regression] = field(default_factory=dict)

    def run(self) -> Model:
        """Return the model of all effects that the data show."""
        watch = self.world.watch
        self.supported = self.base
        followed = self.follow()
        columns = self._plain_columns()
        watch.stage("selecting effects", 1)
        selected = identify(followed, columns)
        self.selections.append(selected)
        best = self._confirmed(selected, self.base)
        if not self._is_explained(best):
            needed = selected.followed.needs_process_noise() > NEEDED
            joints = {int(j) for j in np.flatnonzero(needed)}
            rich = [n for n in self.world.library if self._is_rich(n) and self._acts_at(n, joints)]
            if rich:
                watch.stage(f"testing {len(rich)} effects with many shapes", 1)
                columns = columns.joined(followed.columns(self._probes(rich)))
                self._columns = columns
                selected = identify(followed, columns)
                self.selections.append(selected)
                best = max(best, self._confirmed(selected, best), key=lambda model: model.merit)
        best = self._with_rivals(best, selected)
        # All rivals have been fitted: none is asked for by simulation again.
        self.settled = frozenset(best.names)
        self.supported = best
        return best

    # -- the linear models

    def follow(self) -> FollowedRuns:
        """Return the runs as the filter follows them with the base model."""
        theta, known = self.base.fit.theta, self.world.followed
        if known is None or not np.array_equal(known.theta, theta):
            self.world.watch.stage("following the runs with the model", 1)
            nearby = None if known is None else known.trajectories()
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
        return [p for name in names for p in _first(self.world, self.base.fit, name)]

    @staticmethod
    def _is_rich(name: str) -> bool:
        return name.partition("@")[0] in MANY_SHAPES

    def _acts_at(self, name: str, joints: Iterable[int]) -> bool:
        """Whether an effect acts at one of some joints."""
        effect, coordinates = self.world.effects[name], self.world.simulator.system.coordinates
        members: Sequence[Effect] = getattr(effect, "members", ()) or (effect,)
        for member in members:
            if member.coordinate in joints:
                return True
            if any(member.signal.partition(".")[2] == coordinates[j][2:] for j in joints):
                return True
        return False

    # -- fits by simulation

    def _confirmed(self, selected: Selected, best: Model) -> Model:
        """Fit the selected set by simulation, and leave out effects that do not pay there."""
        if not selected.groups:
            return best
        self.refit([self._start(selected.groups, selected.coefficients)], race=False)
        names = frozenset(self._names(selected.groups))
        found = self.models[names]
        if not np.isfinite(found.fit.cost):
            return best
        found = self.plainer(self.drop(found))
        if selected.shows_steps:
            found = self._corrected(found)
        return found if found.merit > best.merit else best

    def _is_explained(self, model: Model) -> bool:
        """Whether a fitted model leaves no more than noise."""
        return self.quiet(model) and self.excess(model) < SILENT

    def _with_rivals(self, best: Model, selected: Selected) -> Model:
        """Fit the sets that do nearly as well by the regression, and return the best of all."""
        if not best.names:
            return best
        regression = selected.regression
        starts = []
        chosen = self._groups_of(best, regression)
        for place, group in enumerate(chosen):
            rest = [other for other in chosen if other is not group]
            gains = regression.gains(rest)
            own = gains[list(regression.groups).index(group)]
            order = np.argsort(-gains, kind="stable")
            near: dict[str, Group] = {}
            for i in order.tolist():
                if gains[i] < own - RIVAL or len(near) == MAX_RIVALS:
                    break
                other = regression.groups[i]
                if other.effect not in (*best.names, *near):
                    near[other.effect] = other
            for other in near.values():
                groups = [*rest, other]
                coefficients = regression.solve(groups)[1]
                start = self._start(groups, coefficients, best.fit)
                if frozenset(start.effects) not in self.models:
                    starts.append(start)
        if starts:
            self.refit(starts, race=False)
        size = len(best.names)
        fitted = [m for m in self.models.values() if len(m.names) == size]
        return max(fitted, key=lambda model: model.merit)

    def _groups_of(self, model: Model, regression: Regression) -> list[Group]:
        """The groups of columns nearest to the shapes that a fitted model has."""
        columns = self._columns
        assert columns is not None
        found = []
        for name in model.names:
            own = [g for g in regression.groups if g.effect == name]
            if not own:
                continue
            gains = regression.gains(found)
            places = [list(regression.groups).index(g) for g in own]
            found.append(own[int(np.argmax(gains[places]))])
        return found

    def _names(self, groups: Sequence[Group]) -> tuple[str, ...]:
        return tuple(group.effect for group in groups)

    def _start(
        self, groups: Sequence[Group], coefficients: Sequence[Array], fit: Fit | None = None
    ) -> Start:
        """Where the fit of a set by simulation begins."""
        fit = fit or self.base.fit
        theta = self.base.fit.theta.copy()
        columns = self._columns
        assert columns is not None
        for group, own in zip(groups, coefficients, strict=True):
            slot = self.world.slots[group.effect]
            c = columns.probes[group.columns[0]].c.copy()
            for column, value in zip(group.columns, own, strict=True):
                probe = columns.probes[column]
                if probe.fixed:
                    # The change is that of this very size.
                    c = probe.c.copy()
                else:
                    c[probe.place] = value
            low, high = np.array(coefficient_bounds(self.world, group.effect)).T
            theta[slot] = np.clip(c, low, high)
        return Start(self._names(groups), theta, fit.states)

    # -- scores

    def _regression(self, model: Model, columns: Columns | None = None) -> Regression:
        """The regression of innovations with a fitted model's effects in the linear model.

        Args:
            model: a fitted model.
            columns: of the candidates; the library where None.
        """
        followed = self.follow()
        kind = "library" if columns is None else "hats"
        columns = self._plain_columns() if columns is None else columns
        key = frozenset((kind, *model.names))
        if key not in self._regressions:
            # What the model has acts in its own steps, as what sticks does not in a linear model.
            now = self._followed_by(model)
            probes = [p for name in model.names for p in self._tangents(model, name)]
            joined = columns.joined(followed.columns(probes)) if probes else columns
            always = range(len(columns.probes), len(joined.probes))
            self._regressions[key] = regress(now, joined, always=always)
        return self._regressions[key]

    def _followed_by(self, model: Model) -> FollowedRuns:
        """Return the runs as a filter follows them with a fitted model."""
        followed = self.follow()
        if not model.names:
            return followed
        key = frozenset(model.names)
        if key not in self._followed:
            found = FollowedRuns.follow(
                self.world, model.fit.theta, followed.noise, followed.trajectories()
            )
            numerics = self.selections[-1].numerics if self.selections else 0.0
            defects = found.runs.defects - numerics * found.runs.step_errors
            self._followed[key] = found.refitted(replace(found.runs, defects=defects))
        return self._followed[key]

    def _tangents(self, model: Model, name: str) -> list[Probe]:
        """The change that an effect of a fitted model makes, and those with each of its
        coefficients moved a little.
        """
        c = model.fit.theta[self.world.slots[name]]
        bounds = coefficient_bounds(self.world, name)
        probes = [Probe(name, 0, 0, c, signed=True, fixed=True)]
        for place, (low, high) in enumerate(bounds):
            moved = c.copy()
            step = MOVED * max(abs(float(c[place])), MOVED * (high - low))
            moved[place] += step if moved[place] + step <= high else -step
            probes.append(Probe(name, 1 + place, place, moved, signed=True, fixed=True))
        return probes

    def scan(self, model: Model, against: Array | None = None) -> Scores:
        """Score every effect that the model lacks by the innovations."""
        key = frozenset(model.names)
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

    def force_of_any_shape(self, model: Model) -> tuple[float, str] | None:
        """Return the p-value of the best force of any shape, and what it follows."""
        if self._hats is None:
            probes, _ = hat_probes(self.world)
            named = [replace(probe, effect=JointHat.name) for probe in probes]
            columns = self.follow().columns(named)
            self._hats = replace(columns, probes=tuple(probes))
        regression = self._regression(model, self._hats)
        scores = null_scores(regression, regression.effects, self.drawing("structure", model.names))
        return scores.p_value, scores.effects[0] if scores.effects else ""

    def missing(self, model: Model, larger: Model) -> float:
        """Return the probability of the larger model's gain if nothing were missing."""
        gain = larger.likelihood.value - model.likelihood.value
        return self.gained(self.scan(model), larger, gain)
