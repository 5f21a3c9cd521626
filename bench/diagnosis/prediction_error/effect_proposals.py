"""Propose effects that a model may lack, by regression and from the standard joint model.

Effects of the joint model are proposed at the joint with the largest missing force. A regression
may miss them: they are not linear where a joint sticks, where a servo is stiff for a light joint,
and where an encoder offset changes the pose.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.parameter_bounds import (
    compute_coefficient_bounds,
    get_bounds_by_index,
)
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.fitted_models import FittedModel
from bench.diagnosis.fitting.levenberg_marquardt import FitStart
from bench.diagnosis.kalman.likelihood_fit import compute_likelihood_step
from bench.diagnosis.kalman.linearised_filter import FollowedRuns
from bench.diagnosis.prediction_error.effects_at_joints import (
    JOINT_MODEL,
    LINK_MODEL,
    SERVO_MODEL,
    SET_POINT_MODEL,
    get_joint_name,
    get_servo_input,
    list_moved_bodies,
)
from bench.diagnosis.prediction_error.filters_with_effects import (
    OFFSET_THRESHOLD,
    FilteredSet,
    ModelFilters,
)
from bench.diagnosis.prediction_error.physically_equivalent_effects import (
    get_servo_damping,
    list_similar_shifts,
)
from bench.diagnosis.prediction_error.regression_columns import (
    LibraryColumns,
    build_regression_about,
)
from bench.diagnosis.prediction_error.regression_selection import Regression
from bench.diagnosis.search.effect_search import EffectSearch
from bench.diagnosis.search.fit_starts import add_effect_to_start
from sims.core.simulator import Array
from sims.robot.dynamics.joint_scales import compute_joint_scales
from sims.robot.robot_simulator import RobotSimulator

MAX_REGRESSION_PROPOSALS = 4
"""Maximum number of effects that are proposed by regression and then fitted or filtered."""
MAX_SIMULATED_PROPOSALS = 8
"""Maximum number of effects that are proposed by regression and only simulated, without a fit."""
MAX_FAMILY_PROPOSALS = 2
"""Maximum number among them of effects at all places.

If much process noise hides the differences, those with many coefficients gain most.
"""
MAX_JOINT_PROPOSALS = 3
"""Maximum number of effects of the joint and servo models that are added to a set."""
MAX_MASS_PROPOSALS = 4
"""Maximum number of masses among the proposals of a robot whose joints may stick."""
MIN_GAIN_SHARE = 0.3
"""Minimum gain by regression of a proposed effect, as a share of the largest gain."""
COMMAND_MODEL = ("input.lag@*",)
"""Effects of all commands that are proposed where no actuator acts at the joint alone.

Actuators at sites and tendons, such as rotors, move several joints.
"""
FIRST_LAG_INTERVALS = 2.0
"""Initial lag of commands, in sampling intervals."""
FIRST_SHARE = 0.1
"""Initial coefficient, as a share of the specified friction or of the typical force."""

Proposals = dict[str, Array]
"""Names of effects, each with its initial coefficients (k,)."""


class ProposedEffects(NamedTuple):
    """Effects worth trying next, by the reason why they are proposed.

    Attributes:
        by_regression: the effects with the largest gains by regression.
        only_simulated: those with the next largest gains, the delays and lags that may replace one
            of `by_regression`, and masses of a robot whose joints may stick. They are simulated,
            but neither fitted nor filtered.
        offset_and_friction: an encoder offset, and less dry friction.
        joint_model: effects of the standard joint and servo models, the most useful first.
    """

    by_regression: Proposals
    only_simulated: Proposals
    offset_and_friction: Proposals
    joint_model: Proposals


@dataclass
class EffectProposals:
    """The proposals of a search; those for the base model are cached.

    Attributes:
        filters: the filters of the search.
        columns: the columns of the search.
    """

    filters: ModelFilters
    columns: LibraryColumns
    _proposals_for_base: dict[int, ProposedEffects] = field(default_factory=dict)
    _base_steps: dict[str, tuple[Array, float]] = field(default_factory=dict)

    def of(
        self,
        current: FilteredSet,
        max_joint_proposals: int = MAX_JOINT_PROPOSALS,
        is_fitted: bool = True,
    ) -> list[FitStart]:
        """Return models with one more effect than a set: the effects worth trying next.

        The models are not fitted yet. Proposals by regression come first, then those of the
        standard joint and servo models. Proposals for the base model are cached; they are made anew
        when candidates are added to the library.

        Args:
            current: the set of effects in the model, with its filter; no effects mean the base
                model.
            max_joint_proposals: maximum number of effects of the joint and servo models.
            is_fitted: false to return more models, which are only simulated.

        Returns:
            Starts of fits, each with the effects of the set and one more, with a first coefficient.
        """
        # The number of candidates shows whether some were added to the library.
        evaluator, candidate_count = self.filters.evaluator, len(self.columns.library.probes)
        is_base = not current.names
        proposed = self._proposals_for_base.get(candidate_count) if is_base else None
        if proposed is None:
            proposed = self._propose_effects(current)
        if is_base:
            self._proposals_for_base[candidate_count] = proposed
        coefficients = proposed.by_regression | proposed.offset_and_friction
        if not is_fitted:
            coefficients = proposed.only_simulated | coefficients
        further_names = [name for name in proposed.joint_model if name not in coefficients]
        for name in further_names[:max_joint_proposals]:
            coefficients[name] = proposed.joint_model[name]
        present_model = FitStart(
            current.names, current.followed.theta, evaluator.initial_state_guesses
        )
        return [
            add_effect_to_start(evaluator, present_model, name, first_coefficients)
            for name, first_coefficients in coefficients.items()
        ]

    def list_alone(
        self, max_joint_proposals: int = MAX_JOINT_PROPOSALS, is_fitted: bool = True
    ) -> list[FitStart]:
        """Return models with one effect that may explain the runs alone.

        Effects at one joint are left out if a force is missing at another joint.

        Args:
            max_joint_proposals: maximum number of effects of the joint and servo models.
            is_fitted: false to return more models, which are only simulated.
        """
        return [
            start
            for start in self.of(self.filters.empty_set, max_joint_proposals, is_fitted)
            if self.filters.act_where_forces_are_missing(start.effects)
        ]

    def _propose_effects(self, current: FilteredSet) -> ProposedEffects:
        """Return all effects that are proposed in addition to a set, by the reason.

        Args:
            current: the set, with its filter. Effects of the joint and servo models are proposed at
                the joint where this filter misses most.
        """
        regression = self._regress(current)
        # Names and coefficients, the largest gain first.
        ranked = list(self._propose_by_regression(regression, current.names).items())
        by_regression = dict(ranked[:MAX_REGRESSION_PROPOSALS])
        # Delays and lags that may replace one of these. A filter does not follow late readings, so
        # that the regression misjudges them.
        similar_shifts = {
            similar: coefficients
            for name, coefficients in by_regression.items()
            for similar in list_similar_shifts(self.filters.evaluator, name)
        }
        only_simulated = dict(ranked[MAX_REGRESSION_PROPOSALS:]) | similar_shifts
        only_simulated |= self._propose_masses(regression)
        excluded = {*current.names, *by_regression}
        # The joint where the filter most needs process noise, which stands for a missing force.
        joint = current.followed.joints_by_loss[0]
        return ProposedEffects(
            by_regression,
            {name: only_simulated[name] for name in only_simulated if name not in excluded},
            self._propose_offset_and_friction(joint, excluded),
            self._propose_joint_model(current.followed, joint, excluded),
        )

    def _regress(self, current: FilteredSet) -> Regression:
        """Return the regression of the innovations of a set on the responses to each effect.

        Innovations are the one-step prediction errors of the filter with the set.

        Args:
            current: the set, with its filter; no effects mean the base model.
        """
        if not current.names:
            return self.columns.base_regression
        regression, _ = build_regression_about(current, [self.columns.library], current.followed)
        return regression

    def _propose_by_regression(
        self, regression: Regression, present_names: Collection[str]
    ) -> Proposals:
        """Propose the effects with the largest net gain by regression, with their coefficients.

        The net gain is the gain in twice the log-likelihood minus the penalty of the effect.
        Effects whose gain is a small share of the largest, and all but a few families (effects at
        every place, ``@*``), are left out.

        Args:
            regression: regression of innovations on the responses to each effect.
            present_names: names of effects that the model has already.
        """
        ranked = regression.rank_effects()
        proposals: Proposals = {}
        for group, gain in ranked:
            families = [name for name in proposals if name.endswith("@*")]
            is_surplus = group.effect.endswith("@*") and len(families) == MAX_FAMILY_PROPOSALS
            if is_surplus or group.effect in present_names:
                continue
            # Gains are in descending order, so all further ones are too small, too.
            is_small = gain < max(MIN_GAIN_SHARE * ranked[0][1], 0.0)
            if len(proposals) == MAX_SIMULATED_PROPOSALS or is_small:
                break
            proposals[group.effect] = self.columns.solve_alone(regression, group)
        return proposals

    def _propose_masses(self, regression: Regression) -> Proposals:
        """Propose the masses of single bodies with the largest gains, if joints may stick.

        Dry friction bears a part of the load of a joint that rests or creeps. Beyond the limit of
        the friction, the joint moves far more than the linear response to a small mass shows, so
        that the regression underestimates the gain of a large one.

        Args:
            regression: regression of innovations on the responses to each effect.

        Returns:
            Names and coefficients; none for a robot without dry friction.
        """
        simulator = self.filters.evaluator.simulator
        assert isinstance(simulator, RobotSimulator)
        if not simulator.robot.compiled.dof_frictionloss.any():
            return {}
        masses = [
            group
            for group, gain in regression.rank_effects()
            if group.effect.startswith("mass.scale@")
            and not group.effect.endswith("@*")
            and gain > 0.0
        ]
        return {
            group.effect: self.columns.solve_alone(regression, group)
            for group in masses[:MAX_MASS_PROPOSALS]
        }

    def _propose_offset_and_friction(self, joint: int, excluded: Collection[str]) -> Proposals:
        """Propose an encoder offset at a joint, and less dry friction than in the model file.

        A regression misses both: an offset of the encoder changes the pose, and the derivative by
        more friction does not show the effect of less friction. The offset is that of the readings
        from the servo's command. The decrease of friction is a share of that in the file. A
        coefficient of zero, because there is no offset or no friction to remove, is not proposed.

        Args:
            joint: index of the joint.
            excluded: names of effects that are not proposed.
        """
        evaluator, place = self.filters.evaluator, get_joint_name(self.filters.evaluator, joint)
        coefficients = {
            f"sensor.bias@q.{place}": compute_offset_from_command(
                evaluator, self.filters.noise, joint
            )
        }
        friction = f"friction.coulomb@{place}"
        if friction in evaluator.library:
            # The lower bound is minus the friction of the file.
            ((low, _),) = compute_coefficient_bounds(evaluator, friction)
            coefficients[friction] = FIRST_SHARE * min(low, 0.0)
        return {
            name: np.array([c])
            for name, c in coefficients.items()
            if c and name in evaluator.library and name not in excluded
        }

    def _propose_joint_model(
        self, followed: FollowedRuns, joint: int, excluded: Collection[str]
    ) -> Proposals:
        """Propose friction, damping and armature of a joint, and gains of its servo.

        A lag of all commands is added if no actuator acts at the joint alone. The coefficient of an
        effect is that of its first Gauss-Newton step on the innovations, or a typical size if that
        step hardly gains.

        Args:
            followed: the runs, followed by the filter of the set that is extended.
            joint: index of the joint.
            excluded: names of effects that are not proposed.

        Returns:
            Names and coefficients of the effects, in descending order of the gain in log-likelihood
            that the step predicts.
        """
        evaluator, place = self.filters.evaluator, get_joint_name(self.filters.evaluator, joint)
        assert isinstance(evaluator.simulator, RobotSimulator)
        # Largest speed of the joint in all runs.
        speed = max(
            float(np.abs(linear_run.trajectory.v[:, joint]).max()) for linear_run in followed.linear
        )
        interval = float(np.median(np.diff(evaluator.runs[0].times)))
        # Sizes to try if the data give none, in the unit of each coefficient. Effects that are not
        # listed get `FIRST_SHARE`, with the sign of the step. The drag is a share of the typical
        # force at full speed.
        typical = {
            **dict.fromkeys(COMMAND_MODEL, FIRST_LAG_INTERVALS * interval),
            f"drag.linear@{place}": FIRST_SHARE * float(followed.typical[joint]) / max(speed, 1e-9),
            f"inertia.armature@{place}": float(
                compute_joint_scales(evaluator.simulator.robot).inertia[joint]
            ),
        }
        changes, gains = dict[str, Array](), dict[str, float]()
        for name in self._list_effects_at(joint):
            if name not in excluded:
                change, gain = self._compute_first_change(followed, name)
                if name == f"drag.linear@{place}":
                    change, gain = self._compare_with_servo_damping(followed, joint, change, gain)
                # If much process noise hides an effect, its typical size is tried. The penalty is
                # in twice the log-likelihood.
                if not gain > 0.5 * self.filters.penalty(name):
                    change = typical.get(name, float(np.copysign(FIRST_SHARE, change)))
                changes[name], gains[name] = np.array([change]), gain
        return {name: changes[name] for name in sorted(gains, key=lambda name: -gains[name])}

    def _compute_first_change(self, followed: FollowedRuns, name: str) -> tuple[float, float]:
        """Return the first Gauss-Newton change of an effect alone, and its gain in log-likelihood.

        The change is that of the effect's first coefficient, in its unit.

        Args:
            followed: the runs, followed by the filter of the set that is extended.
            name: name of the effect.
        """
        step, gain = self._compute_likelihood_step(followed, name)
        return float(step[self.filters.evaluator.get_coefficient_indices(name)[0]]), gain

    def _compare_with_servo_damping(
        self, followed: FollowedRuns, joint: int, change: float, gain: float
    ) -> tuple[float, float]:
        """Return the first change of a joint's viscous damping, and its gain in log-likelihood.

        The damping of a servo and that of its joint are the same force unless the servo is at its
        force limit. If the servo's damping gains much more, the linear response to the joint's is
        not valid, because the joint chatters at the limit. The change and gain of the servo's
        damping are then returned in place of the joint's, the change in units of the joint.

        Args:
            followed: the runs, followed by the filter of the set that is extended.
            joint: index of the joint.
            change: first change of the joint's damping, in N·m·s/rad or N·s/m.
            gain: gain in log-likelihood that this change predicts.
        """
        servo_damping = get_servo_damping(self.filters.evaluator, joint)
        if servo_damping is None:
            return change, gain
        # Damping of the joint per unit of the servo's coefficient.
        name, damping = servo_damping
        servo_change, servo_gain = self._compute_first_change(followed, name)
        if servo_gain < gain + self.filters.penalty(name):
            return change, gain
        return damping * servo_change, servo_gain

    def compute_largest_gain_of_others(self, friction: str) -> float:
        """Return the largest gain in log-likelihood by another effect where dry friction acts.

        The other effects are those of the joint and servo models at the same joint, each added
        alone to the base model; the gains are those that a Gauss-Newton step predicts.

        Args:
            friction: name of the dry friction, such as ``friction.coulomb@elbow``.
        """
        evaluator, base = self.filters.evaluator, self.filters.base
        place = friction.partition("@")[2]
        joints = len(evaluator.simulator.system.coordinates)
        # Friction at one joint always has a place of this name.
        joint = next(j for j in range(joints) if get_joint_name(evaluator, j) == place)
        others = [name for name in self._list_effects_at(joint) if name != friction]
        return max((self._compute_likelihood_step(base, name)[1] for name in others), default=0.0)

    def _list_effects_at(self, joint: int) -> list[str]:
        """Return names of the effects of the models of a joint, its link and its servo.

        Effects of all commands are added if no drive acts at the joint alone. Effects that the
        library does not have are left out.

        Args:
            joint: index of the joint.
        """
        evaluator = self.filters.evaluator
        place = get_joint_name(evaluator, joint)
        servo = get_servo_input(evaluator, joint).removeprefix("u.")
        names = [f"{effect}@{place}" for effect in JOINT_MODEL]
        names += [f"{effect}@{list_moved_bodies(evaluator)[joint]}" for effect in LINK_MODEL]
        names += [f"{effect}@{servo}" for effect in SERVO_MODEL + SET_POINT_MODEL]
        # `drives` has the inputs of the actuators of each joint.
        if not getattr(evaluator.simulator.system, "drives", {}).get(joint):
            names += COMMAND_MODEL
        return [name for name in names if name in evaluator.library]

    def _compute_likelihood_step(self, followed: FollowedRuns, name: str) -> tuple[Array, float]:
        """Return the Gauss-Newton step of an effect alone, cached for the base model.

        Args:
            followed: the runs, followed by the filter of the present set.
            name: name of the effect.

        Returns:
            Change of all parameters (P,), and the predicted gain in log-likelihood.
        """
        if followed is self.filters.base and name in self._base_steps:
            return self._base_steps[name]
        step = compute_likelihood_step(
            followed, get_bounds_by_index(self.filters.evaluator, [name])
        )
        if followed is self.filters.base:
            self._base_steps[name] = step
        return step


def compute_offset_from_command(evaluator: RunEvaluator, noise: NoiseModel, joint: int) -> float:
    """Return the mean difference in rad or m of a joint's readings from its servo's command.

    It is a first guess of an encoder offset. The command acts on the actuator, so it is multiplied
    by the gear to get a joint position.

    Args:
        evaluator: the runs.
        noise: sensor noise.
        joint: index of the joint.

    Returns:
        The difference; zero without a servo, or if it is within `OFFSET_THRESHOLD` standard
        deviations of the noise, so that noise alone does not start an effect.
    """
    system, servo = evaluator.simulator.system, get_servo_input(evaluator, joint)
    channel = system.coordinates[joint]
    if not servo or channel not in evaluator.channels:
        return 0.0
    column = evaluator.channels.index(channel)
    differences = [
        run.observed[:, column] - system.gear(joint) * run.scenario.inputs[servo]
        for run in evaluator.prepared_runs
        if servo in run.scenario.inputs
    ]
    offset = float(np.nanmean(np.concatenate(differences))) if differences else 0.0
    return offset if abs(offset) > OFFSET_THRESHOLD * noise.sigma[column] else 0.0


@dataclass(frozen=True)
class SearchContext:
    """Shared state of a search.

    Attributes:
        search: the search, with all models fitted by simulation.
        filters: filters with effects in the model.
        columns: columns of regressions.
        proposals: effects that a set may lack.
        extended_sets: sets that were extended by one effect, each with the larger sets, by their
            effects and the size of the library.
        filtered_fits: models fitted from the coefficients of a filter, by their effects and these
            coefficients.
    """

    search: EffectSearch
    filters: ModelFilters
    columns: LibraryColumns
    proposals: EffectProposals
    extended_sets: dict[tuple[frozenset[str], int], tuple[FilteredSet, list[FilteredSet]]] = field(
        default_factory=dict
    )
    filtered_fits: dict[tuple[tuple[str, ...], bytes], FittedModel] = field(default_factory=dict)

    @classmethod
    def of(cls, search: EffectSearch) -> SearchContext:
        """Create the context of a new search."""
        filters = ModelFilters(search)
        columns = LibraryColumns(filters)
        return cls(search, filters, columns, EffectProposals(filters, columns))

    @property
    def evaluator(self) -> RunEvaluator:
        """The runs for fitting."""
        return self.search.evaluator
