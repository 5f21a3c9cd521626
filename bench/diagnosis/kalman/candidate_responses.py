"""Responses of the innovations to every candidate effect, carried through the filter's recursion.

With gain K and whitener W of the filter (`bench.diagnosis.kalman.filter_and_smoother`), a unit of
candidate k, which adds b to states and ψ to readings (`dynamics.linearisation_about_recording`,
eqs. (3) and (4)), changes the predicted state by s and the whitened innovations by -w:

    u_i = ψ_i + H_i s_i,    w_i = W_i u_i,    s_{i+1} = A_i (s_i - K_i u_i) + b_i               (1)

so that the innovations are e = Σ_k c_k w_k + white noise, linear in the coefficients however large
they are, since the motion about which the model is linear is the measured one (L. Ljung, System
Identification, 2nd ed., 1999, chapter 3; K. J. Åström, Automatica 16, 551, 1980,
doi:10.1016/0005-1098(80)90078-3).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.candidate_direction import CandidateDirection
from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.kalman.filter_and_smoother import (
    MAX_MAGNITUDE,
    SMALLEST_FORCE,
    Filtered,
    IndexArray,
    LinearRuns,
    Mask,
    Smoothed,
    add_noise_states,
    filter_runs,
    fit_process_noise,
)
from bench.diagnosis.kalman.measured_states import (
    estimate_measured_states,
    estimate_resting_position,
)
from sims.core.effect import Effect, members_of
from sims.core.simulator import Array
from sims.robot.dynamics.active_effects import TIME_DEPENDENT_EFFECTS
from sims.robot.dynamics.contact_states import ContactModel, KnownJacobians, settle_contacts
from sims.robot.dynamics.joint_scales import compute_floating_forces, compute_joint_scales
from sims.robot.dynamics.linearisation_about_recording import (
    MeasuredLinear,
    SingleArray,
    Trajectory,
)
from sims.robot.dynamics.linearisation_about_simulation import compute_control_changes
from sims.robot.robot_simulator import RobotSimulator

POSITION_PRIOR, VELOCITY_PRIOR = 1.0, 0.3
"""Standard deviations of the first states about the measured motion.

That of positions is in rad or m, because an encoder may have an offset; that of velocities is a
share of the largest velocity.
"""
MIN_VELOCITY_PRIOR = 1e-4
"""Minimum prior standard deviation of a velocity, rad/s or m/s."""
MAX_VELOCITY_PRIOR = 1e3
"""Maximum prior standard deviation of a velocity, rad/s or m/s."""
UNMEASURED_PRIOR, UNMEASURED_SPEED = 0.3, 3.0
"""Prior standard deviations of unrecorded joints: position in rad or m, velocity per second."""
MEASURED_PRIOR = 10.0
"""Prior standard deviation of a first state of a robot on the ground, in units of its noise.

The noise of a velocity is that of positions per sample interval.
"""
SMOOTHED_SHARES = (1.0, 0.5, 0.0)
"""Shares of the smoothed change of a first state that are tried for a robot on the ground."""
MAX_FIRST_STATE_STEPS = 5
"""Maximum number of Gauss-Newton steps of the first states of a robot on the ground."""
STEP_SHARES = (1.0, 0.5, 0.1)
"""Shares of such a step that are tried."""
MIN_STEP_DECREASE = 0.02
"""Minimum relative decrease of the sum of squares for another such step."""
FIRST_FORCE = 0.1
"""Initial missing force of the process noise fit, as a share of a typical force."""
MAX_LINEARISATIONS = 4
"""Maximum number of times the model is linearised about a motion that is smoothed with it."""
LINEARISED_GAIN = 10.0
"""Minimum gain in log-likelihood by a linearisation for which another one is made."""

CORRELATIONS = (0.4, 0.6, 0.75, 0.85, 0.92, 0.96)
"""Correlations of AR(1) sensor noise, tried in this order while the likelihood increases."""
MIN_CORRELATION_GAIN = 5.0
"""Minimum gain in log-likelihood by a larger correlation."""
MAX_MEAN_SQUARE_INNOVATION = 100.0
"""Mean square of the whitened innovations above which a linear model does not follow the runs."""
MIN_LOSS_WITHOUT_FORCE = 20.0
"""Minimum loss in twice the log-likelihood without process noise that shows a missing force."""
COLUMNS_PER_BATCH = 256
"""Number of columns that pass through the filter together, so that they fit in the CPU cache."""


@dataclass(frozen=True)
class Columns:
    """Inputs that candidates add to the states and readings of R runs.

    Attributes:
        probes: the K candidates.
        places: (K,) index of the column of each candidate; candidates with the same effect share a
            column.
        sizes: (K,) scaling coefficient of each probe.
        pushed: (R, T - 1, E + nu, M) mean forces and controls of M columns between samples.
        readings: ψ (R, T, C, M).
    """

    probes: tuple[CandidateDirection, ...]
    places: IndexArray
    sizes: Array
    pushed: SingleArray
    readings: SingleArray

    def joined(self, others: Columns) -> Columns:
        """Return the columns of these candidates, followed by those of others."""
        return Columns(
            self.probes + others.probes,
            np.concatenate([self.places, others.places + self.pushed.shape[3]]),
            np.concatenate([self.sizes, others.sizes]),
            np.concatenate([self.pushed, others.pushed], axis=3),
            np.concatenate([self.readings, others.readings], axis=3),
        )

    def subset(self, chosen: Sequence[int]) -> Columns:
        """Return some of the candidates, with the columns of all."""
        indices = list(chosen)
        probes = tuple(self.probes[i] for i in indices)
        return replace(self, probes=probes, places=self.places[indices], sizes=self.sizes[indices])

    def total(self, chosen: Sequence[int], coefficients: Array) -> tuple[Array, Array]:
        """Return the sum of the inputs of the chosen candidates, each times its coefficient.

        Columns are stored for a trial coefficient, so they are divided by its size.

        Args:
            chosen: indices of probes.
            coefficients: coefficient of each chosen probe.

        Returns:
            Missing forces and changes of the controls (R, T - 1, E + nu), and changes ψ of the
            readings (R, T, C).
        """
        columns = self.places[list(chosen)]
        weights = coefficients / self.sizes[list(chosen)]
        return self.pushed[..., columns] @ weights, self.readings[..., columns] @ weights


@dataclass
class FollowedRuns:
    """Runs of a robot followed by a Kalman filter with the model.

    Attributes:
        evaluator: the runs.
        theta: (P,) parameters of the model.
        noise: sensor noise.
        linear: linearised model of each run.
        runs: the linear models, stacked, without states for coloured noise.
        force: (E,) standard deviations of the missing forces.
        filtered: results of the filter.
        smoothed: results of the smoother.
        typical: (E,) typical forces.
    """

    evaluator: RunEvaluator
    theta: Array
    noise: NoiseModel
    linear: list[MeasuredLinear]
    runs: LinearRuns
    force: Array
    filtered: Filtered
    smoothed: Smoothed
    typical: Array

    @classmethod
    def follow(
        cls,
        evaluator: RunEvaluator,
        theta: Array,
        noise: NoiseModel,
        trajectories: Sequence[Trajectory] | None = None,
        force: Array | None = None,
        max_linearisations: int = MAX_LINEARISATIONS,
    ) -> FollowedRuns:
        """Linearise a model about the measured motion and filter the runs.

        The filter's smoothed motion is closer to the true one, so the model is linearised and
        filtered again about it, while the log-likelihood increases. For a robot on the ground, each
        motion is simulated from the smoothed first state instead.

        Args:
            evaluator: the runs.
            theta: (P,) parameters of the model.
            noise: sensor noise.
            trajectories: motion of each run, about which the model is linearised once; None to
                estimate it.
            force: (E,) initial standard deviations of the missing forces for the fit of the process
                noise; None for a share of typical forces.
            max_linearisations: maximum number of linearisations if the motion is not given.

        Returns:
            The filter with the highest log-likelihood.
        """
        assert isinstance(evaluator.simulator, RobotSimulator)
        robot = evaluator.simulator.robot
        typical = np.concatenate(
            [compute_joint_scales(robot).force, compute_floating_forces(robot)]
        )
        best: FollowedRuns | None = None
        first_states: Sequence[FirstState | None] = [None] * len(evaluator.prepared_runs)
        linear: list[MeasuredLinear] = []
        for iteration in range(max_linearisations if trajectories is None else 1):
            # Near the data, Jacobians change little from one motion to another.
            neighbours: Sequence[MeasuredLinear | None] = linear or [None] * len(
                evaluator.prepared_runs
            )
            motion: Sequence[Trajectory | None] = trajectories or [None] * len(
                evaluator.prepared_runs
            )
            linear = [
                _linearise_run(
                    evaluator,
                    theta,
                    noise,
                    run,
                    motion[run],
                    neighbour,
                    first_state=first_states[run],
                )
                for run, neighbour in enumerate(neighbours)
            ]
            initial_force = FIRST_FORCE * typical if force is None else force
            followed = cls._filter_linear(evaluator, theta, noise, linear, initial_force, typical)
            force, noise = followed.force, followed.noise
            gain = np.inf if best is None else followed.log_likelihood - best.log_likelihood
            # The first linearisation is about the readings alone, which are not a possible motion.
            is_first = iteration < (1 if robot.is_on_ground else 2)
            best = followed if is_first or gain > 0.0 else best
            if robot.is_on_ground:
                first_states = followed._weight_first_states(followed.get_first_states())
            else:
                trajectories = followed.trajectories
            if not gain > LINEARISED_GAIN:
                break
        assert best is not None
        return best

    def with_parameters(
        self,
        theta: Array,
        simulator: RobotSimulator | None = None,
        similar: FollowedRuns | None = None,
    ) -> FollowedRuns:
        """Return the filter of a model with other parameters.

        The model is linearised once about the smoothed motion of this filter, and its process noise
        starts from the present one. Derivatives (Jacobians) take most of the time, so they are
        reused where they hardly differ.

        Args:
            theta: (P,) the parameters.
            simulator: simulator to use instead of that of the evaluator, such as one with another
                form of dry friction.
            similar: filter of a similar model, whose Jacobians are reused; None to compute them,
                unless they are certain to be equal.
        """
        reuses_jacobians = similar is not None or (
            simulator is None and self._has_jacobians_of(theta)
        )
        neighbours = (similar or self).linear
        motions: Sequence[Trajectory | None] = [None] * len(neighbours)
        starts: Sequence[FirstState | None] = [None] * len(neighbours)
        if self.is_on_ground:
            starts = self._weight_first_states(self.get_first_states())
        else:
            motions = self.trajectories
        linear = [
            _linearise_run(
                *(self.evaluator, theta, self.noise, run, motion, neighbour, simulator),
                reuses_jacobians=reuses_jacobians,
                first_state=first_state,
            )
            for run, (motion, neighbour, first_state) in enumerate(
                zip(motions, neighbours, starts, strict=True)
            )
        ]
        filter_arguments = self.noise, linear, self.force, self.typical
        return self._filter_linear(self.evaluator, theta, *filter_arguments)

    @property
    def is_on_ground(self) -> bool:
        """True if the pose of a robot that stands or drives is recorded."""
        simulator = self.evaluator.simulator
        assert isinstance(simulator, RobotSimulator)
        return simulator.robot.is_on_ground

    def _has_jacobians_of(self, theta: Array) -> bool:
        """Return whether a model has the Jacobians of this one.

        This is the case if only effects at sensors, and forces that depend on time alone, differ.

        Args:
            theta: (P,) parameters of the model.
        """
        evaluator = self.evaluator
        changed = set(np.flatnonzero(theta != self.theta).tolist())
        for name, slot in evaluator.coefficient_slices.items():
            members = members_of(evaluator.available_effects[name])
            if all(m.hook == "sensor" or m.of in TIME_DEPENDENT_EFFECTS for m in members):
                changed -= set(range(slot.start, slot.stop))
        return not changed

    @classmethod
    def _filter_linear(
        cls,
        evaluator: RunEvaluator,
        theta: Array,
        noise: NoiseModel,
        linear: list[MeasuredLinear],
        force: Array,
        typical: Array,
    ) -> FollowedRuns:
        """Fit the process noise of the linearised models of all runs, and return their filter.

        Args:
            evaluator: the R runs to follow.
            theta: (P,) parameters about which the models are linear.
            noise: sensor noise of each channel.
            linear: model of each run, linearised at its samples.
            force: (E,) standard deviations of the missing forces, from which the noise fit starts.
            typical: (E,) typical force of each joint, in N or N·m, a scale for the missing forces.
        """
        # A model that diverges between two samples overflows; `has_expected_innovations` is then
        # false.
        with np.errstate(all="ignore"):
            maps = [run_model.interval_maps() for run_model in linear]
            # An effect may have its own states.
            prior = _compute_prior_deviations(evaluator, linear, maps[0].states.shape[1])
            runs = LinearRuns.stacked(maps, evaluator.observed, prior)
            fitted = _fit_noise(runs, noise, force, typical)
        return cls(evaluator, theta, linear=linear, runs=runs, typical=typical, **fitted._asdict())

    @classmethod
    def get_or_follow(
        cls, evaluator: RunEvaluator, theta: Array, noise: NoiseModel
    ) -> FollowedRuns:
        """Return the filter stored in the evaluator if it has these parameters, else a new one.

        A filter takes long, and several steps of a diagnosis need that of the base model. The new
        filter is stored in the evaluator; it begins with the motion of the stored one if the time
        steps agree.

        Args:
            evaluator: the runs.
            theta: (P,) parameters of the model.
            noise: sensor noise.
        """
        known: FollowedRuns | None = evaluator.filtered_runs
        if (
            known is not None
            and known.evaluator is evaluator
            and np.array_equal(known.theta, theta)
        ):
            return known
        evaluator.search_control.begin_stage("computing prediction errors", 1)
        assert isinstance(evaluator.simulator, RobotSimulator)
        # With another step size, the motion at the ends of the steps is not known.
        has_same_step = known is not None and known.step == evaluator.simulator.time_step
        motion = None
        if known is not None and has_same_step and not known.is_on_ground:
            motion = known.trajectories
        followed = evaluator.filtered_runs = cls.follow(evaluator, theta, noise, motion)
        return followed

    def refit_noise(self, runs: LinearRuns) -> FollowedRuns:
        """Return the filter of changed linear models with refitted noise.

        Process noise and the correlation of the sensor noise are fitted again.
        """
        return replace(
            self, runs=runs, **_fit_noise(runs, self.noise, self.force, self.typical)._asdict()
        )

    def compute_parameter_responses(self, places: Sequence[int], sizes: Array) -> SingleArray:
        """Return how a change of each parameter changes the whitened innovations of the filter.

        The model is linearised about the same motion, so that a change of a parameter changes the
        defects of the motion (by how much a step misses the next state) and the predicted readings.
        They pass through the filter as those of a candidate do, eq. (1) of the module docstring.
        Jacobians, gains and process noise stay the same.

        Args:
            places: indices of n parameters in theta.
            sizes: (n,) finite changes of the parameters.

        Returns:
            Minus the derivatives of the whitened innovations (R, T, C, n) by the parameters: R
            runs, T samples, C channels.
        """
        run_count, samples, channels = self.runs.residuals.shape
        pushed = np.zeros(
            (run_count, samples - 1, self.runs.prior.size, len(places)), dtype=np.float32
        )
        readings = np.zeros((run_count, samples, channels, len(places)), dtype=np.float32)
        for column, (place, size) in enumerate(zip(places, sizes.tolist(), strict=True)):
            self.evaluator.search_control.check_not_stopped()
            theta = self.theta.copy()
            theta[place] += size
            for run, linear in enumerate(self.linear):
                displaced = _linearise_run(
                    *(self.evaluator, theta, self.noise, run, linear.trajectory, linear),
                    reuses_loads=True,
                )
                defects, predicted = displaced.compute_changes(linear)
                with np.errstate(all="ignore"):
                    pushed[run, : len(defects), :, column] = -defects / size
                    readings[run, : len(predicted), :, column] = predicted / size
        readings[~self.runs.recorded] = 0.0
        # A step in which the model diverges gives no information on the next one.
        for values in (pushed, readings):
            values[~(np.abs(values) < MAX_MAGNITUDE)] = 0.0
        return self._propagate_through_filter(pushed, readings)

    @property
    def log_likelihood(self) -> float:
        """Log likelihood of the innovations of all runs."""
        return float(self.filtered.log_likelihood.sum())

    @cached_property
    def losses_without_force(self) -> Array:
        """Loss in twice the log-likelihood (E,) if the process noise of one force is removed.

        Process noise stands for unknown forces. A large loss shows that the model lacks a force at
        this coordinate. Noise is not removed wholly, but reduced to a negligible force.
        """
        coloured, white = add_noise_states(self.runs, self.noise)
        log_likelihood = self.log_likelihood
        losses = []
        for j in range(self.force.size):
            force = self.force.copy()
            force[j] = SMALLEST_FORCE * self.typical[j]
            filtered = filter_runs(coloured, force, white)
            losses.append(2.0 * (log_likelihood - float(filtered.log_likelihood.sum())))
        return np.array(losses)

    @property
    def missing_forces(self) -> Mask:
        """True if the model lacks a force (E,), so that the filter needs process noise there."""
        is_missing: Mask = self.losses_without_force > MIN_LOSS_WITHOUT_FORCE
        return is_missing

    @property
    def has_missing_force(self) -> bool:
        """True if the model lacks a force at any coordinate."""
        return bool(self.missing_forces.any())

    @property
    def joints_by_loss(self) -> list[int]:
        """Indices of the joints, in descending order of the loss without process noise."""
        joints = len(self.evaluator.simulator.system.coordinates)
        order: list[int] = np.argsort(-self.losses_without_force[:joints], kind="stable").tolist()
        return order

    @property
    def step(self) -> float:
        """Time step of the simulator in seconds."""
        return float(self.linear[0].step)

    @cached_property
    def trajectories(self) -> list[Trajectory]:
        """Smoothed motion of each run: the most likely states, given all samples of the run."""
        size = self.runs.prior.size
        trajectories = []
        for run, linear in enumerate(self.linear):
            count = linear.knots.size
            states = self.smoothed.states[run, :count, :size]
            forces = self.smoothed.forces[run, : count - 1, : self.force.size]
            trajectories.append(linear.moved(linear.propagate_deviations(states, forces)))
        return trajectories

    def columns(self, probes: Sequence[CandidateDirection]) -> Columns:
        """Compute the inputs that candidates add to states and readings, once for equal candidates.

        Candidates with the same effect and coefficients, such as a family with a single acting
        member and that member alone, share a column. Columns with an infinite number are set to
        zero, so that they explain nothing.

        Args:
            probes: the candidates: effects with trial coefficients.
        """
        effects: list[tuple[Effect, Array]] = []
        column_by_key: dict[tuple[str, bytes], int] = {}
        column_indices = []
        for probe in probes:
            effect, c = self.evaluator.available_effects[probe.effect], probe.coefficients
            # Members of a family, each with its part of the coefficients.
            parts = [(part, k) for part, k in effect.parts(c[:, None, None]) if k.any()]
            # A member of a family has the same response as the single effect.
            if len(parts) == 1:
                effect, c = parts[0][0], parts[0][1][:, 0, 0]
            key = effect.name, c.tobytes()
            if key not in column_by_key:
                column_by_key[key] = len(effects)
                effects.append((effect, c))
            column_indices.append(column_by_key[key])
        # Inputs to the states and to the readings, by run.
        run_count, samples, channels = self.runs.residuals.shape
        inputs = self.runs.inputs.shape[3]
        pushed = np.zeros((run_count, samples - 1, inputs, len(effects)), dtype=np.float32)
        readings = np.zeros((run_count, samples, channels, len(effects)), dtype=np.float32)
        changes = compute_control_changes(self.linear, effects)
        for run, (linear, driven) in enumerate(zip(self.linear, changes, strict=True)):
            predicted = self.filtered.predicted[run, : linear.knots.size, : self.runs.prior.size]
            run_pushed, run_readings = linear.added(effects, np.nan_to_num(predicted), driven)
            pushed[run, : run_pushed.shape[0]] = run_pushed
            readings[run, : run_readings.shape[0]] = run_readings
        readings[~self.runs.recorded] = 0.0
        is_finite = np.isfinite(pushed).all(axis=(0, 1, 2)) & np.isfinite(readings).all(
            axis=(0, 1, 2)
        )
        pushed[..., ~is_finite], readings[..., ~is_finite] = 0.0, 0.0
        sizes = np.array(
            [1.0 if p.is_single_size else p.coefficients[p.coefficient_index] for p in probes]
        )
        return Columns(
            tuple(probes), np.array(column_indices, dtype=np.intp), sizes, pushed, readings
        )

    @property
    def step_errors(self) -> Array:
        """Errors (R, T - 1, Z) of the integrator's steps, composed over each interval."""
        result = np.zeros_like(self.runs.defects)
        for run, linear in enumerate(self.linear):
            result[run, : len(linear.step_errors)] = linear.step_errors
        # A step in which the model diverges gives no information on the next one.
        result[~(np.abs(result) < MAX_MAGNITUDE)] = 0.0
        return result

    def step_error_response(self) -> Array:
        """Return the whitened response (R, T, C) to the errors of the integrator's steps."""
        step_errors = self.step_errors[..., None].astype(np.float32)
        no_readings = np.zeros((*self.runs.residuals.shape, 1), dtype=np.float32)
        response: Array = self._propagate_through_filter(step_errors, no_readings)[..., 0].astype(
            np.float64
        )
        return response

    def responses(self, columns: Columns) -> SingleArray:
        """Return how a unit of each candidate changes the whitened innovations of the filter.

        The forces, controls and readings that a candidate adds are propagated through the recursion
        of the filter, eq. (1) of the module docstring, with its gains.

        Args:
            columns: inputs of the candidates.

        Returns:
            Whitened responses (R, T, C, K), in units of the probes' coefficients.
        """
        inputs = self.runs.inputs.astype(np.float32)
        whitened = self._propagate_through_filter(columns.pushed, columns.readings, inputs)
        sizes: SingleArray = columns.sizes.astype(np.float32)
        result = np.empty((*whitened.shape[:3], sizes.size), dtype=np.float32)
        # The arrays of all runs together exceed the CPU cache.
        for run, values in enumerate(result):
            np.take(whitened[run], columns.places, axis=2, out=values, mode="clip")
            with np.errstate(all="ignore"):
                values /= sizes
                # A candidate with a divergent motion gets a response of zero.
                values[~(np.abs(values) < MAX_MAGNITUDE)] = 0.0
        return result

    def compute_state_sensitivities(self) -> Array:
        """Return the derivatives (R, T, C, 2 D) of the readings by the first states of D joints.

        The first states are positions and velocities. The derivatives are those of simulated runs,
        which no reading corrects, so the gain of the filter is left out.
        """
        joints = len(self.linear[0].trajectory.x[0])
        joint_states = np.concatenate(
            [np.arange(joints), self.linear[0].positions + np.arange(joints)]
        )
        initial_changes = np.zeros((len(self.linear), self.runs.prior.size, joint_states.size))
        initial_changes[:, joint_states, np.arange(joint_states.size)] = 1.0
        result = np.zeros((*self.runs.residuals.shape, len(self.evaluator.state_names)))
        result[..., : joint_states.size] = self._propagate_without_gain(initial_changes)
        return result

    def compute_amplification(self, seconds: float = np.inf) -> float:
        """Return the factor by which simulated runs amplify an error of their first positions.

        It is the largest change of a reading in any segment, in units of its noise, if the segment
        begins with an error of one position by the noise of its readings. A stable motion has about
        1; a chaotic or unstable one grows exponentially with the duration (Lyapunov exponent).

        Args:
            seconds: duration of the segments; whole runs by default.
        """
        samples = self.runs.residuals.shape[1]
        length = int(min(max(seconds / self.evaluator.sample_interval, 1.0) + 1, samples))
        segments = self if length == samples else replace(self, runs=self.runs.segments(length))
        channels = list(self.evaluator.channels)
        coordinates = self.evaluator.simulator.system.coordinates
        # Joints of a closed loop may have no readings.
        recorded = [i for i, name in enumerate(coordinates) if name in channels]
        sigma = self.noise.sigma[[channels.index(coordinates[i]) for i in recorded]]
        errors = np.zeros((len(segments.runs.residuals), self.runs.prior.size, len(recorded)))
        errors[:, recorded, np.arange(len(recorded))] = sigma
        changes = segments._propagate_without_gain(errors) / self.noise.sigma[:, None]
        return float(np.abs(changes).max(initial=0.0))

    def sensitivities(self, columns: Columns, dtype: type[np.floating] = np.float64) -> Array:
        """Return the derivatives (R, T, C, K) of simulated readings by K candidate effects.

        A column is the response to an effect with a finite coefficient; divided by that coefficient
        (`columns.sizes`), it is the response to a unit. Simulated runs are not corrected by
        readings, so the gain of the filter is zero. Shapes: R runs, T samples, C channels.

        Args:
            columns: inputs of the candidates.
            dtype: type of the result.
        """
        number, _, _, count = columns.readings.shape
        result = np.zeros((*columns.readings.shape[:3], len(columns.probes)), dtype)
        for begin in range(0, count, COLUMNS_PER_BATCH):
            batch = slice(begin, min(begin + COLUMNS_PER_BATCH, count))
            changes = self._propagate_without_gain(
                np.zeros((number, self.runs.prior.size, batch.stop - begin)),
                replace(
                    columns,
                    pushed=columns.pushed[..., batch],
                    readings=columns.readings[..., batch],
                ),
            )
            chosen = np.flatnonzero((columns.places >= begin) & (columns.places < batch.stop))
            with np.errstate(all="ignore"):
                result[..., chosen] = (
                    changes[..., columns.places[chosen] - begin] / columns.sizes[chosen]
                )
        return result

    def _propagate_without_gain(self, s: Array, columns: Columns | None = None) -> Array:
        """Propagate changes of the first states, and optional columns, through the linear model.

        So would simulated runs change, which no reading corrects. The recursion is s[i+1] = A s[i]
        + b[i] with readings H s + ψ, eq. (1) of the module docstring with gain zero. Changes that
        diverge are set to zero.

        Args:
            s: (R, Z, K) changes of the Z first states of R runs, by K candidates.
            columns: inputs of candidates; None if there are none.

        Returns:
            Changes of the readings (R, T, C, K).
        """
        runs = self.runs
        samples = runs.residuals.shape[1]
        responses = np.zeros((*runs.residuals.shape, s.shape[2]))
        with np.errstate(all="ignore"):
            for i in range(samples):
                responses[:, i] = runs.readings[:, i] @ s
                if columns is not None:
                    responses[:, i] += columns.readings[:, i]
                if i + 1 < samples:
                    s = runs.states[:, i] @ s
                    if columns is not None:
                        s += runs.inputs[:, i] @ columns.pushed[:, i]
        responses[~(np.abs(responses) < MAX_MAGNITUDE)] = 0.0
        return responses

    @property
    def has_expected_innovations(self) -> bool:
        """True if the filter follows the runs: its innovations have the expected size."""
        with np.errstate(all="ignore"):
            size = float(np.square(self.filtered.whitened).sum()) / max(self.runs.recorded.sum(), 1)
        return bool(size < MAX_MEAN_SQUARE_INNOVATION)

    @property
    def are_runs_followed(self) -> Mask:
        """Which runs (R,) the filter follows: their innovations have the expected size."""
        with np.errstate(all="ignore"):
            squares = np.square(self.filtered.whitened).sum(axis=(1, 2))
            sizes = squares / np.maximum(self.runs.recorded.sum(axis=(1, 2)), 1)
        is_followed: Mask = sizes < MAX_MEAN_SQUARE_INNOVATION
        return is_followed

    def get_state_prior(self) -> Array | None:
        """Return the prior standard deviations (2 D,) of the first positions and velocities.

        The result is None if further states are fitted. With a stiff servo, the first velocity
        decays within a sample. Without a prior, a fit would make it so large that the motion leaves
        the valid range of the linear model.
        """
        joints = len(self.linear[0].trajectory.x[0])
        if len(self.evaluator.state_names) != 2 * joints:
            return None
        if self.is_on_ground:
            return self._get_prior_of_measured_states()
        prior = self.runs.prior
        velocities = prior[self.linear[0].positions + np.arange(joints)] / VELOCITY_PRIOR
        return np.concatenate([prior[:joints], velocities])

    def get_first_positions(self) -> Array:
        """Return the smoothed positions of the joints at the first samples (R, D)."""
        positions = []
        for run, linear in enumerate(self.linear):
            x = linear.trajectory.x[int(linear.knots[0])]
            positions.append(x + self.smoothed.states[run, 0, : x.size])
        return np.array(positions)

    def get_first_states(self) -> Array:
        """Return positions and velocities of the joints at the first samples (R, 2 D).

        For recorded joints they are estimated from the readings alone, because a stiff servo hides
        the first velocity from a linear model; a joint that rests may stick, so that its position
        is a mean. For other joints they are smoothed states, and for robots on the ground these
        with settled contacts.
        """
        if self.is_on_ground:
            return self._settled_first_states
        first_states = []
        coordinates = self.evaluator.simulator.system.coordinates
        for run, trajectory in enumerate(self.trajectories):
            first_step = int(self.linear[run].knots[0])
            x, v = trajectory.x[first_step].copy(), trajectory.v[first_step].copy()
            for joint, states in estimate_measured_states(
                self.evaluator, self.noise.sigma, run
            ).items():
                x[joint], v[joint] = states[0, :2]
                channel = self.evaluator.channels.index(coordinates[joint])
                resting = estimate_resting_position(
                    self.evaluator.prepared_runs[run].observed[:, channel],
                    float(self.noise.sigma[channel]),
                )
                if resting is not None:
                    x[joint], v[joint] = resting, 0.0
            first_states.append(np.concatenate([x, v]))
        return np.array(first_states)

    def _weight_first_states(self, states: Array) -> list[FirstState]:
        """Return first states (R, 2 D) of a robot on the ground with their weights."""
        return [FirstState(*pair) for pair in zip(states, self.first_state_factors.r, strict=True)]

    @cached_property
    def first_state_factors(self) -> FirstStateFactors:
        """Information of the readings about the first states of a robot on the ground."""
        derivatives = self.scale_by_noise(self.compute_state_sensitivities())
        prior = np.diag(1.0 / self._get_prior_of_measured_states())
        factors = [
            np.linalg.qr(np.concatenate([rows.reshape(-1, len(prior)), prior]))
            for rows in derivatives
        ]
        return FirstStateFactors(np.array([f.Q for f in factors]), np.array([f.R for f in factors]))

    def scale_by_noise(self, values: Array) -> Array:
        """Return values of the readings (R, T, C, ...) in units of the noise; 0 if not recorded."""
        sigma = self.noise.sigma.reshape(-1, *[1] * (values.ndim - 3))
        with np.errstate(all="ignore"):
            scaled: Array = values / sigma
        scaled[~self.runs.recorded] = 0.0
        return scaled

    def _get_prior_of_measured_states(self) -> Array:
        """Return prior standard deviations (2 D,) in multiples of the noise of the positions.

        A first state far from the readings would be in another state of the contacts.
        """
        return MEASURED_PRIOR * np.concatenate(_get_noise_of_states(self.evaluator, self.noise))

    @cached_property
    def _settled_first_states(self) -> Array:
        """Smoothed positions and velocities at the first samples (R, 2 D), with settled contacts.

        A contact that begins or ends makes the motion nonlinear. So each run begins at the share of
        the smoothed change whose simulation is closest to the readings.
        """
        changes = []
        for linear, change in zip(self.linear, self.smoothed.states[:, 0], strict=True):
            joints = linear.trajectory.x.shape[1]
            velocities = slice(linear.positions, linear.positions + joints)
            changes.append(np.concatenate([change[:joints], change[velocities]]))
        simulated_starts = np.array(
            [
                np.concatenate([linear.trajectory.x[0], linear.trajectory.v[0]])
                for linear in self.linear
            ]
        )
        first_states = np.array(
            [
                self.settle(self.theta, simulated_starts + share * np.array(changes))
                for share in SMOOTHED_SHARES
            ]
        )
        squares = np.array([self.compute_squares(self.theta, states) for states in first_states])
        best: Array = first_states[np.argmin(squares, axis=0), np.arange(len(self.linear))]
        return best

    def estimate_settled_states(self, theta: Array) -> Array:
        """Return first states (R, 2 D) with settled contacts for a model with other parameters.

        The depth of contacts and the motion depend on the parameters, so a filter with them
        estimates the states. If it diverges, those of this filter are returned.

        Args:
            theta: (P,) parameters of the model of a robot on the ground.
        """
        followed = self.follow(self.evaluator, theta, self.noise, max_linearisations=1)
        if not followed.has_expected_innovations:
            return self.get_first_states()
        return followed.improved_first_states

    @cached_property
    def improved_first_states(self) -> Array:
        """First states (R, 2 D) of a robot on the ground, improved for the parameters `theta`."""
        return self.improve_first_states(self.theta, self.get_first_states())

    def improve_first_states(self, theta: Array, states: Array) -> Array:
        """Return first states (R, 2 D) with settled contacts whose simulations are closer.

        The smoother explains a part of the readings by forces that a simulation does not have.
        Gauss-Newton steps minimise the residual of the simulated runs instead, with the prior of
        first states. Contacts are settled after each step, since a simulation from a state between
        settled ones begins with a jump, which ends other fits in a local minimum.

        Args:
            theta: (P,) parameters of the model, near those of this linearisation.
            states: (R, 2 D) settled positions and velocities of D coordinates in R runs.
        """
        runs = np.arange(len(states))
        squares = self.compute_squares(theta, states)
        for _ in range(MAX_FIRST_STATE_STEPS):
            residuals = self.simulate_residuals(theta, states).reshape(len(states), -1)
            steps = np.array(
                [
                    np.linalg.solve(r, q[: residual.size].T @ residual)
                    for q, r, residual in zip(*self.first_state_factors, residuals, strict=True)
                ]
            )
            tried, all_squares = [states], [squares]
            for share in STEP_SHARES:
                tried.append(self.settle(theta, states + share * steps))
                all_squares.append(self.compute_squares(theta, tried[-1]))
            best = np.argmin(all_squares, axis=0)
            states, new_squares = np.array(tried)[best, runs], np.array(all_squares)[best, runs]
            is_converged = new_squares.sum() > (1.0 - MIN_STEP_DECREASE) * squares.sum()
            squares = new_squares
            if is_converged:
                break
        return states

    def fit_settled_states(self, theta: Array, states: Array) -> Array:
        """Return first states (R, 2 D) fitted for other parameters, with settled contacts.

        Args:
            theta: (P,) parameters of the model, perhaps of another geometry.
            states: (R, 2 D) first states for parameters nearby.
        """
        settled = self.settle(theta, states, is_other_geometry=True)
        return self.improve_first_states(theta, settled)

    def simulate(self, theta: Array, states: Array) -> Array:
        """Simulate all runs (R, T, C) of a robot on the ground from given first states.

        Args:
            theta: (P,) parameters of the model.
            states: (R, 2 D) positions and velocities of D coordinates in R runs.
        """
        number = len(states)
        return self.evaluator.simulate(np.tile(theta, (number, 1)), np.arange(number), states)

    def simulate_residuals(self, theta: Array, states: Array) -> Array:
        """Return the residuals (R, T, C) of simulations from first states, in units of the noise.

        Args:
            theta: (P,) parameters of the model.
            states: (R, 2 D) positions and velocities of D coordinates in R runs.
        """
        return self.scale_by_noise(self.evaluator.observed - self.simulate(theta, states))

    def compute_squares(self, theta: Array, states: Array) -> Array:
        """Return the sum of squared residuals of each run (R,); infinite if it diverges.

        Args:
            theta: (P,) parameters of the model.
            states: (R, 2 D) positions and velocities of D coordinates in R runs.
        """
        with np.errstate(all="ignore"):
            squares = np.square(self.simulate_residuals(theta, states)).sum(axis=(1, 2))
        result: Array = np.where(np.isfinite(squares), squares, np.inf)
        return result

    def settle(
        self,
        theta: Array,
        states: Array,
        is_other_geometry: bool = False,
        known_jacobians: Sequence[KnownJacobians] | None = None,
    ) -> Array:
        """Return first states (R, 2 D) near given ones at which the contacts are in equilibrium.

        Otherwise a simulated robot would jump at the first step, because noise of its pose makes
        contacts too deep.

        Args:
            theta: (P,) parameters of the model.
            states: (R, 2 D) positions and velocities of D coordinates in R runs.
            is_other_geometry: whether the states may be those of another geometry, so that contacts
                farther away may be closed.
            known_jacobians: derivatives of contacts for each run, see `settle_contacts`.
        """
        simulator = self.evaluator.simulator
        assert isinstance(simulator, RobotSimulator)
        # They bound how far from closed a contact is that may be closed. Another geometry moves
        # the points of contact by more than the noise.
        factor = MEASURED_PRIOR if is_other_geometry else 1.0
        noise = _get_noise_of_states(self.evaluator, self.noise)
        deviations = factor * noise[0], factor * noise[1]
        model, settled = ContactModel(simulator, theta), []
        for run, state in enumerate(states):
            scenario = self.evaluator.prepared_runs[run].scenario
            x, v = np.split(state, 2)
            weights = self.first_state_factors.r[run]
            known = known_jacobians[run] if known_jacobians is not None else None
            start = settle_contacts(model, scenario, (x, v), deviations, weights, known)
            settled.append(np.concatenate(start))
        return np.array(settled)

    def _propagate_through_filter(
        self, pushed: SingleArray, readings: SingleArray, inputs: SingleArray | None = None
    ) -> SingleArray:
        """Propagate columns through the filter, and return the whitened responses (R, T, C, M).

        The recursion is s[i+1] = A (s[i] - K u[i]) + b[i] with u = H s + ψ, where K is the gain of
        the filter: part of a change of the state is corrected by the next reading. The whitened
        response is W u. It is eq. (1) of the module docstring, for all M columns in single
        precision, in batches that fit in the CPU cache.

        Args:
            pushed: (R, T - 1, E + nu, M) forces and controls, or states if `inputs` is None.
            readings: ψ (R, T, C, M).
            inputs: (R, T - 1, Z, E + nu) matrices that map `pushed` to b.
        """
        coloured, _ = add_noise_states(self.runs, self.noise)
        run_count, samples, channels, count = readings.shape
        size = self.runs.prior.size
        responses = np.zeros((run_count, samples, channels, count), dtype=np.float32)
        h, a = coloured.readings.astype(np.float32), coloured.states.astype(np.float32)
        gains = self.filtered.gains.astype(np.float32)
        whiteners = self.filtered.whiteners.astype(np.float32)
        with np.errstate(all="ignore"):
            for first_column in range(0, count, COLUMNS_PER_BATCH):
                batch_columns = slice(first_column, min(first_column + COLUMNS_PER_BATCH, count))
                s = np.zeros(
                    (run_count, a.shape[2], batch_columns.stop - batch_columns.start),
                    dtype=np.float32,
                )
                for i in range(samples):
                    u = h[:, i] @ s
                    u += readings[:, i, :, batch_columns]
                    np.matmul(whiteners[:, i], u, out=responses[:, i, :, batch_columns])
                    if i + 1 < samples:
                        s -= gains[:, i] @ u
                        s = a[:, i] @ s
                        added = pushed[:, i, :, batch_columns]
                        s[:, :size] += added if inputs is None else inputs[:, i] @ added
        responses[~np.isfinite(responses)] = 0.0
        return responses


class FirstState(NamedTuple):
    """First state of a run of a robot on the ground.

    Attributes:
        state: (2 D,) positions and velocities.
        weights: (2 D, 2 D) square root W of the inverse W^T W of its covariance.
    """

    state: Array
    weights: Array


class FirstStateFactors(NamedTuple):
    """Factors of the derivatives H of the readings by the first states, with their prior.

    H is in units of the noise, and p are the prior standard deviations of the first states:

        Q R = [H; diag(1 / p)]

    R^T R is the inverse covariance of the first states, if no force is missing. Columns of Q span
    what first states explain.

    Attributes:
        q: (R, n, 2 D) Q of each run; its n rows are readings, then first states.
        r: (R, 2 D, 2 D) R of each run.
    """

    q: Array
    r: Array


class _NoiseFit(NamedTuple):
    """Fitted noise, with the results of filter and smoother.

    Attributes:
        noise: sensor noise.
        force: (E,) standard deviations of the missing forces.
        filtered: results of the filter.
        smoothed: results of the smoother.
    """

    noise: NoiseModel
    force: Array
    filtered: Filtered
    smoothed: Smoothed


def _fit_noise(runs: LinearRuns, noise: NoiseModel, force: Array, typical: Array) -> _NoiseFit:
    """Fit the process noise and the correlation of the sensor noise by maximum likelihood.

    The process noise is fitted with the given correlation first. Larger correlations φ of AR(1)
    noise follow, in ascending order, each with the process noise fitted again, as long as the
    log-likelihood increases.

    Args:
        runs: the linear models.
        noise: sensor noise of each channel.
        force: (E,) initial standard deviations of the missing forces.
        typical: (E,) typical forces.
    """
    best: _NoiseFit | None = None
    present_phi = float(noise.phi.max(initial=0.0))
    # None is the given noise itself, whose channels may have different correlations.
    for phi in (None, *(phi for phi in CORRELATIONS if phi > present_phi)):
        tried_noise = (
            noise if phi is None else NoiseModel(noise.sigma, np.full_like(noise.phi, phi))
        )
        coloured, white = add_noise_states(runs, tried_noise)
        if best is not None:
            filtered = filter_runs(coloured, best.force, white)
            before, after = best.filtered.log_likelihood.sum(), filtered.log_likelihood.sum()
            # Both are minus infinity if the model diverges.
            if not after > before + MIN_CORRELATION_GAIN:
                break
            force = best.force
        best = _NoiseFit(tried_noise, *fit_process_noise(coloured, force, white, typical))
    assert best is not None
    return best


def _linearise_run(
    evaluator: RunEvaluator,
    theta: Array,
    noise: NoiseModel,
    run: int,
    trajectory: Trajectory | None,
    neighbour: MeasuredLinear | None,
    simulator: RobotSimulator | None = None,
    reuses_jacobians: bool = True,
    reuses_loads: bool = False,
    first_state: FirstState | None = None,
) -> MeasuredLinear:
    """Linearise the model of one run about a motion.

    The motion is given, or estimated from the readings. For a robot on the ground it is simulated
    from a first state with settled contacts: contacts are less deep than the noise of encoders, so
    that a measured motion has wrong contact forces. Jacobians of a simulated motion are never
    reused, because contacts may differ.

    Args:
        evaluator: the runs.
        theta: (P,) parameters about which the model is linear.
        noise: sensor noise of each channel.
        run: index of the run.
        trajectory: the motion; None to estimate it from the readings alone, or to simulate it.
        neighbour: model of the same run at other parameters, whose matrices are reused; None if
            there is none.
        simulator: robot with other contact or friction settings; None for that of the evaluator.
        reuses_jacobians: whether derivatives are taken from the neighbour.
        reuses_loads: whether loads at the joints are taken from the neighbour.
        first_state: first state of a robot on the ground; None for that of the readings.
    """
    half = len(evaluator.state_names) // 2
    scenario = evaluator.prepared_runs[run].scenario
    guess = evaluator.initial_state_guesses[run].copy()
    start = guess[:half], guess[half:]
    robot = simulator or evaluator.simulator
    assert isinstance(robot, RobotSimulator)
    measured: Mapping[int, Array] | None = None
    is_simulated = robot.robot.is_on_ground and trajectory is None
    weights: Array | None = None
    if is_simulated and first_state is not None:
        start, weights = (first_state.state[:half], first_state.state[half:]), first_state.weights
    elif trajectory is None:
        measured = estimate_measured_states(evaluator, noise.sigma, run)
    if is_simulated:
        for joint, states in (measured or {}).items():
            start[0][joint], start[1][joint] = states[0, :2]
        measured = None
        deviations = _get_noise_of_states(evaluator, noise)
        model = ContactModel(robot, theta)
        start = settle_contacts(model, scenario, start, deviations, weights)
    return MeasuredLinear(
        *(robot, theta, scenario, start, trajectory, measured, neighbour),
        *(reuses_jacobians and not is_simulated, reuses_loads),
    )


def _get_noise_of_states(evaluator: RunEvaluator, noise: NoiseModel) -> tuple[Array, Array]:
    """Return the noise (D,) of positions, and that of velocities if they are differences of these.

    Args:
        evaluator: the runs of a robot on the ground, whose joints are recorded.
        noise: sensor noise of each channel.
    """
    channels = list(evaluator.channels)
    names = evaluator.simulator.system.coordinates
    positions = np.array([noise.sigma[channels.index(name)] for name in names])
    return positions, positions / evaluator.sample_interval


def _compute_prior_deviations(
    evaluator: RunEvaluator, linear: Sequence[MeasuredLinear], size: int
) -> Array:
    """Return prior standard deviations (Z,) of the first states, from which the filter begins.

    They are relative to the measured motion, so positions are nearly known. A velocity that is not
    determined by the readings, as with a stiff servo, where it decays within a sample, needs a
    bound: a share of the joint's highest speed in any run.

    Args:
        evaluator: the runs.
        linear: linearised model of each run.
        size: number Z of states, with the hidden states that effects may have.

    Returns:
        Standard deviations in SI units: of positions first, then of velocities; almost zero for
        hidden states.
    """
    coordinates = evaluator.simulator.system.coordinates
    prior = np.full(size, 1e-9)
    joint_count, position_count = len(coordinates), linear[0].positions
    max_speeds = np.max(
        [np.abs(run_model.trajectory.v).max(axis=0) for run_model in linear], axis=0
    )
    for joint, name in enumerate(coordinates[:joint_count]):
        if name in evaluator.channels:
            prior[joint] = POSITION_PRIOR
            velocity_deviation = VELOCITY_PRIOR * float(max_speeds[joint]) + MIN_VELOCITY_PRIOR
            prior[position_count + joint] = min(velocity_deviation, MAX_VELOCITY_PRIOR)
        else:
            prior[joint], prior[position_count + joint] = UNMEASURED_PRIOR, UNMEASURED_SPEED
    return prior
