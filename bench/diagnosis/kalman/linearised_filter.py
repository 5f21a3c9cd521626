"""Kalman filter of a robot's runs with its model, linearised about the motion that was recorded.

The model of each run is linear about the measured motion, and then about the smoothed one
(`dynamics.linearisation_about_recording`, eqs. (3) and (4)). Standard deviations of the missing
forces (process noise) and the correlation of the sensor noise are fitted to the innovations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.initial_state_guesses import estimate_resting_position
from bench.diagnosis.evaluation.noise_model import Mask, NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.kalman.kalman_recursions import (
    MAX_MAGNITUDE,
    SMALLEST_FORCE,
    Filtered,
    LinearRuns,
    Smoothed,
    add_noise_states,
    filter_runs,
    fit_process_noise,
)
from bench.diagnosis.kalman.kinematic_smoother import estimate_measured_states
from bench.diagnosis.kalman.settled_first_states import (
    FirstState,
    FirstStateFitter,
    compute_measured_state_prior,
    settle_first_state,
)
from sims.core.effect import members_of
from sims.core.simulator import Array
from sims.robot.dynamics.active_effects import TIME_DEPENDENT_EFFECTS
from sims.robot.dynamics.joint_scales import compute_floating_forces, compute_joint_scales
from sims.robot.dynamics.linearisation_about_recording import (
    MeasuredLinear,
    SingleArray,
    Trajectory,
)
from sims.robot.dynamics.linearisation_points import LINEARISATION_INTERVAL_SECONDS
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
SMOOTHED_SHARES = (1.0, 0.5, 0.0)
"""Shares of the smoothed change of a first state that are tried for a robot on the ground."""
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


@dataclass
class FollowedRuns:
    """Runs of a robot followed by a Kalman filter with the model.

    Attributes:
        evaluator: the runs.
        theta: (P,) parameters of the model.
        noise: sensor noise.
        linear: linearised model of each run.
        runs: the linear models, stacked, without states for coloured noise.
        force: (E,) standard deviations of the missing forces (process noise), one at each joint,
            then one for each degree of freedom of floating bodies.
        filtered: results of the filter.
        smoothed: results of the smoother.
        typical: (E,) typical forces, in N or N·m.
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
        min_jacobian_seconds: float = LINEARISATION_INTERVAL_SECONDS,
    ) -> FollowedRuns:
        """Linearise a model about the measured motion and filter the runs.

        The filter's smoothed motion is closer to the true one, so the model is linearised and
        filtered again about it, while the log-likelihood increases. For a robot on the ground (one
        that stands or drives), each motion is simulated from the smoothed first state instead,
        because measured contacts are too deep. Missing forces are random forces that the filter
        allows for (process noise), because the model may be incomplete.

        Args:
            evaluator: the runs.
            theta: (P,) parameters of the model.
            noise: sensor noise.
            trajectories: motion of each run, about which the model is linearised once; None to
                estimate it.
            force: (E,) initial standard deviations of the missing forces for the fit of the process
                noise; None for a share of typical forces.
            max_linearisations: maximum number of linearisations if the motion is not given.
            min_jacobian_seconds: minimum time in seconds for which a Jacobian is held.

        Returns:
            The filter with the highest log-likelihood. The first one, about the motion of the
            readings, counts only if it is the only one, or for a robot on the ground, whose motions
            are simulated.
        """
        assert isinstance(evaluator.simulator, RobotSimulator)
        robot = evaluator.simulator.robot
        typical = np.concatenate(
            [compute_joint_scales(robot).force, compute_floating_forces(robot)]
        )
        best: FollowedRuns | None = None
        # None: to be estimated from the readings.
        unknown = [None] * len(evaluator.prepared_runs)
        motions: Sequence[Trajectory | None] = trajectories or unknown
        first_states: Sequence[FirstState | None] = unknown
        # Near the data, Jacobians change little from one motion to another, so they are reused.
        neighbours: Sequence[MeasuredLinear | None] = unknown
        for iteration in range(max_linearisations if trajectories is None else 1):
            linear = [
                linearise_run(
                    evaluator,
                    theta,
                    noise,
                    run,
                    trajectory=motion,
                    neighbour=neighbour,
                    first_state=first_state,
                    min_jacobian_seconds=min_jacobian_seconds,
                )
                for run, (motion, neighbour, first_state) in enumerate(
                    zip(motions, neighbours, first_states, strict=True)
                )
            ]
            neighbours = linear
            initial_force = FIRST_FORCE * typical if force is None else force
            followed = cls._filter_linear(evaluator, theta, noise, linear, initial_force, typical)
            # The next fit of the noise starts from this one.
            force, noise = followed.force, followed.noise
            gain = np.inf if best is None else followed.log_likelihood - best.log_likelihood
            # The first motion is that of the readings alone, which the robot may not be able to
            # make. So the second filter replaces the first one in any case, unless the motion is
            # simulated, as for a robot on the ground.
            is_second_about_possible_motion = iteration == 1 and not robot.is_on_ground
            best = followed if gain > 0.0 or is_second_about_possible_motion else best
            # Motions or, for a robot on the ground, first states about which the next iteration is
            # linear.
            motions, first_states = followed._get_smoothed_motions()
            if not gain > LINEARISED_GAIN:
                break
        # There was at least one iteration.
        assert best is not None
        return best

    def recompute_jacobians(self) -> FollowedRuns:
        """Return the filter with Jacobians about its own smoothed motion, if that is likelier.

        `follow` takes the Jacobians (derivatives of the simulator's steps) from the motion of the
        readings, which saves most of its time. There, the noise reverses the friction of joints
        that rest or creep, so that the filter of an arm with dry friction may need large missing
        forces (process noise). So this is tried only while a missing force is not negligible.

        Returns:
            The likeliest filter; this one if none is clearly likelier.
        """
        best, negligible_force = self, FIRST_FORCE * self.typical
        # For a robot on the ground, `follow` computes all Jacobians about simulated motions.
        if self.is_on_ground:
            return self
        for _ in range(MAX_LINEARISATIONS):
            if not (best.force > negligible_force).any():
                break
            linear = [
                linearise_run(
                    self.evaluator, self.theta, self.noise, run, trajectory=motion, neighbour=None
                )
                for run, motion in enumerate(best.trajectories)
            ]
            followed = self._filter_linear(
                self.evaluator, self.theta, best.noise, linear, best.force, self.typical
            )
            if not followed.log_likelihood > best.log_likelihood + LINEARISED_GAIN:
                break
            best = followed
        return best

    def with_parameters(
        self,
        theta: Array,
        simulator: RobotSimulator | None = None,
        similar: FollowedRuns | None = None,
    ) -> FollowedRuns:
        """Return the filter of a model with other parameters.

        The model is linearised once about the smoothed motion of this filter (for a robot on the
        ground, about a motion simulated from its smoothed first state), and its process noise
        starts from the present one. Derivatives (Jacobians) take most of the time, so they are
        reused where they hardly differ.

        Args:
            theta: (P,) the parameters.
            simulator: simulator to use instead of that of the evaluator, such as one with another
                form of dry friction.
            similar: filter of a similar model, whose Jacobians are reused; None to compute them,
                unless those of this filter are certain to be equal (`_has_jacobians_of`).
        """
        # Another simulator may have other derivatives at equal parameters.
        reuses_jacobians = similar is not None or (
            simulator is None and self._has_jacobians_of(theta)
        )
        motions, first_states = self._get_smoothed_motions()
        linear = [
            linearise_run(
                self.evaluator,
                theta,
                self.noise,
                run,
                trajectory=motion,
                neighbour=neighbour,
                simulator=simulator,
                reuses_jacobians=reuses_jacobians,
                first_state=first_state,
            )
            for run, (motion, neighbour, first_state) in enumerate(
                zip(motions, (similar or self).linear, first_states, strict=True)
            )
        ]
        return self._filter_linear(
            self.evaluator, theta, self.noise, linear, self.force, self.typical
        )

    def _get_smoothed_motions(
        self,
    ) -> tuple[Sequence[Trajectory | None], Sequence[FirstState | None]]:
        """Return the motions about which the runs are linearised next, and their first states.

        For a robot on the ground, only first states are given, from which motions are simulated;
        they are weighted by inverse covariances. For all others, the smoothed motions are given.

        Returns:
            Motion of each run and first state of each run; one of the two lists contains only None.
        """
        unknown = [None] * len(self.linear)
        if self.is_on_ground:
            return unknown, self.first_state_fitter.add_weights(self.get_first_states())
        return self.trajectories, unknown

    @property
    def is_on_ground(self) -> bool:
        """True if the pose of a robot that stands or drives is recorded."""
        simulator = self.evaluator.simulator
        assert isinstance(simulator, RobotSimulator)
        return simulator.robot.is_on_ground

    def _has_jacobians_of(self, theta: Array) -> bool:
        """Return whether a model with other parameters has the Jacobians of this one.

        Jacobians are derivatives of steps by the state. They are equal if only the coefficients of
        sensor effects, and of forces that depend on time alone, differ.

        Args:
            theta: (P,) parameters of the model.
        """
        evaluator = self.evaluator
        # Indices of the parameters that differ and may change the Jacobians.
        changed = set(np.flatnonzero(theta != self.theta).tolist())
        for name in evaluator.coefficient_slices:
            # An effect at all places is a family, with one member at each place. `of` is the name
            # of a member without its place.
            members = members_of(evaluator.available_effects[name])
            if all(m.hook == "sensor" or m.of in TIME_DEPENDENT_EFFECTS for m in members):
                changed -= set(evaluator.get_coefficient_indices(name))
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

        Process noise is a random force at each coordinate, which stands for forces that the model
        lacks. The correlation of the sensor noise is fitted with it.

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
            # The state has internal states of effects after positions and velocities.
            prior = _compute_prior_deviations(evaluator, linear, size=maps[0].states.shape[1])
            runs = LinearRuns.stacked(maps, evaluator.observed, prior)
            fitted = _fit_noise(runs, noise, force, typical)
        # `fitted` has the noise, the missing forces, and the results of filter and smoother.
        return cls(evaluator, theta, linear=linear, runs=runs, typical=typical, **fitted._asdict())

    @classmethod
    def get_or_follow(
        cls, evaluator: RunEvaluator, theta: Array, noise: NoiseModel
    ) -> FollowedRuns:
        """Return the filter stored in the evaluator if it has these parameters, else a new one.

        A filter takes long, and several steps of a diagnosis need that of the base model. The new
        filter replaces the stored one. It is linearised once about the motion of the stored one if
        the time steps agree and the robot is not on the ground; else the motion is estimated.

        Args:
            evaluator: the runs.
            theta: (P,) parameters of the model.
            noise: sensor noise.
        """
        # The filter stored last.
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

        Args:
            runs: the changed linear models of all runs, without states for coloured noise.
        """
        return replace(
            self, runs=runs, **_fit_noise(runs, self.noise, self.force, self.typical)._asdict()
        )

    @property
    def log_likelihood(self) -> float:
        """Log likelihood of the innovations of all runs."""
        return float(self.filtered.log_likelihood.sum())

    @cached_property
    def losses_without_force(self) -> Array:
        """Loss in twice the log-likelihood (E,) if the process noise of one force is removed.

        Process noise stands for unknown forces. A large loss shows that the model lacks a force at
        this coordinate (a joint, or a degree of freedom of a floating body). Noise is not removed
        wholly, but reduced to a negligible force, so that the filter stays well conditioned.
        """
        coloured, white = add_noise_states(self.runs, self.noise)
        losses = np.zeros(self.force.size)
        # The likelihood of the other parts of the model does not change.
        for part in coloured.independent_parts:
            # Indices from `force.size` on are those of coloured noise.
            coordinates = part.forces[part.forces < self.force.size]
            # First all forces, then one of them reduced to a tiny share of its typical size.
            forces = np.tile(self.force[coordinates], (coordinates.size + 1, 1))
            np.fill_diagonal(forces[1:], SMALLEST_FORCE * self.typical[coordinates])
            log_likelihoods = [
                filter_runs(part.runs, force, white[part.channels]).log_likelihood.sum()
                for force in forces
            ]
            losses[coordinates] = 2.0 * (log_likelihoods[0] - np.array(log_likelihoods[1:]))
        return losses

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
            # Without the padding after the run, and without the states of coloured noise.
            count = linear.knots.size
            states = self.smoothed.states[run, :count, :size]
            forces = self.smoothed.forces[run, : count - 1, : self.force.size]
            # The motion about which the model is linear, plus the deviations at all steps.
            trajectories.append(linear.moved(linear.propagate_deviations(states, forces)))
        return trajectories

    @property
    def step_errors(self) -> Array:
        """Errors (R, T - 1, Z) of the integrator's steps, composed over each interval."""
        result = np.zeros_like(self.runs.defects)
        for run, linear in enumerate(self.linear):
            result[run, : len(linear.step_errors)] = linear.step_errors
        # A step in which the model diverges gives no information on the next one.
        result[~(np.abs(result) < MAX_MAGNITUDE)] = 0.0
        return result

    def compute_state_sensitivities(self) -> Array:
        """Return the derivatives (R, T, C, s) of the readings by the s fitted first states.

        The first 2 D of them are positions and velocities of D joints; the derivatives by further
        states are left at zero. The derivatives are those of simulated runs, which no reading
        corrects, so the gain of the filter is left out.
        """
        joints = len(self.linear[0].trajectory.x[0])
        # Indices of the positions and the velocities of the robot's joints in the state of the
        # linear model. It may have joints in series after them, so that velocities begin only at
        # `positions`, the number of all positions.
        joint_states = np.concatenate(
            [np.arange(joints), self.linear[0].positions + np.arange(joints)]
        )
        # Unit change of one first state in each column.
        initial_changes = np.zeros((len(self.linear), self.runs.prior.size, joint_states.size))
        initial_changes[:, joint_states, np.arange(joint_states.size)] = 1.0
        result = np.zeros((*self.runs.residuals.shape, len(self.evaluator.state_names)))
        result[..., : joint_states.size] = self.propagate_without_gain(initial_changes)
        return result

    def compute_amplification(self, seconds: float = np.inf) -> float:
        """Return the factor by which simulated runs amplify an error of their first positions.

        It is the largest change of a reading in any segment, in units of its noise, if the segment
        begins with an error of one position by the noise of its readings. A stable motion has a
        factor of about 1; that of a chaotic or unstable one grows exponentially with the duration
        (Lyapunov exponent).

        Args:
            seconds: duration of the segments; whole runs by default.
        """
        samples = self.runs.residuals.shape[1]
        # Number of samples of a segment, at least two.
        length = int(min(max(seconds / self.evaluator.sample_interval, 1.0) + 1, samples))
        segments = self if length == samples else replace(self, runs=self.runs.segments(length))
        channels = list(self.evaluator.channels)
        coordinates = self.evaluator.simulator.system.coordinates
        # Joints of a closed loop may have no readings.
        recorded = [i for i, name in enumerate(coordinates) if name in channels]
        sigma = self.noise.sigma[[channels.index(coordinates[i]) for i in recorded]]
        # One column for the error of each recorded position.
        errors = np.zeros((len(segments.runs.residuals), self.runs.prior.size, len(recorded)))
        errors[:, recorded, np.arange(len(recorded))] = sigma
        # Changes of the readings (R, T, C, K) in units of the noise of their channel.
        changes = segments.propagate_without_gain(errors) / self.noise.sigma[:, None]
        return float(np.abs(changes).max(initial=0.0))

    def propagate_without_gain(
        self, s: Array, inputs: SingleArray | None = None, readings: SingleArray | None = None
    ) -> Array:
        """Propagate K changes of the first states, and optional inputs, through the linear model.

        So would simulated runs change, which no reading corrects. The recursion is s[i+1] = A s[i]
        + B f[i] with readings H s[i] + ψ[i]: that of the filter with gain zero. A is the transition
        matrix, B the response to the inputs, and H the observation matrix of the linear model.
        Changes of readings that diverge are set to zero.

        Args:
            s: (R, Z, K) changes of the Z components of the first states of R runs.
            inputs: f (R, T - 1, E + nu, K) changes of E forces and nu controls between T samples;
                None if there are none.
            readings: ψ (R, T, C, K) direct changes of the readings of C channels, if `inputs` is
                given.

        Returns:
            Changes of the readings (R, T, C, K).
        """
        runs = self.runs
        samples = runs.residuals.shape[1]
        responses = np.zeros((*runs.residuals.shape, s.shape[2]))
        with np.errstate(all="ignore"):
            for i in range(samples):
                responses[:, i] = runs.readings[:, i] @ s
                if readings is not None:
                    responses[:, i] += readings[:, i]
                if i + 1 < samples:
                    s = runs.states[:, i] @ s
                    if inputs is not None:
                        s += runs.inputs[:, i] @ inputs[:, i]
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
        the valid range of the linear model. Velocities have a wider prior than in the filter: the
        largest velocity of the joint, and not the share `VELOCITY_PRIOR` of it.
        """
        joints = len(self.linear[0].trajectory.x[0])
        # Further states are fitted, whose prior is not known.
        if len(self.evaluator.state_names) != 2 * joints:
            return None
        if self.is_on_ground:
            return compute_measured_state_prior(self.evaluator, self.noise)
        prior = self.runs.prior
        # Velocities follow all positions, which may include those of joints in series.
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

        - Robot on the ground: smoothed states, changed so that contacts are in equilibrium.
        - Recorded joint: estimated from the readings alone, because a stiff servo hides the first
          velocity from a linear model. A joint that rests may stick: its position is the mean of
          the readings at rest, its velocity zero.
        - Other joint: smoothed states.

        States are SI units: all positions first, then all velocities.
        """
        if self.is_on_ground:
            return self._settled_first_states
        first_states = []
        coordinates = self.evaluator.simulator.system.coordinates
        for run, trajectory in enumerate(self.trajectories):
            # Step at the first sample.
            first_step = int(self.linear[run].knots[0])
            x, v = trajectory.x[first_step].copy(), trajectory.v[first_step].copy()
            for joint, states in estimate_measured_states(
                self.evaluator, self.noise.sigma, run
            ).items():
                # Position, velocity and acceleration at the first sample.
                x[joint], v[joint], _ = states[0]
                channel = self.evaluator.channels.index(coordinates[joint])
                resting = estimate_resting_position(
                    self.evaluator.prepared_runs[run].observed[:, channel],
                    float(self.noise.sigma[channel]),
                )
                if resting is not None:
                    x[joint], v[joint] = resting, 0.0
            first_states.append(np.concatenate([x, v]))
        return np.array(first_states)

    @cached_property
    def first_state_fitter(self) -> FirstStateFitter:
        """Settles and fits first states of a robot on the ground about this linearisation."""
        sensitivities = self.compute_state_sensitivities()
        return FirstStateFitter(self.evaluator, self.noise, self.runs.recorded, sensitivities)

    @cached_property
    def _settled_first_states(self) -> Array:
        """Smoothed first positions and velocities (R, 2 D), with contacts in equilibrium.

        The smoother changes the first state of the simulated motion about which the model is
        linear. A contact that begins or ends makes the motion nonlinear, so several shares of this
        change are simulated, and each run gets the one that is closest to its readings.
        """
        fitter, changes = self.first_state_fitter, []
        # Changes (2 D,) of positions and velocities in each run.
        for linear, change in zip(self.linear, self.smoothed.states[:, 0], strict=True):
            joints = linear.trajectory.x.shape[1]
            velocities = slice(linear.positions, linear.positions + joints)
            changes.append(np.concatenate([change[:joints], change[velocities]]))
        # First states (R, 2 D) of the motions about which the models are linear.
        simulated_starts = np.array(
            [
                np.concatenate([linear.trajectory.x[0], linear.trajectory.v[0]])
                for linear in self.linear
            ]
        )
        first_states = np.array(
            [
                fitter.settle(self.theta, simulated_starts + share * np.array(changes))
                for share in SMOOTHED_SHARES
            ]
        )
        # For each share (rows) and each run (columns).
        squares = np.array([fitter.compute_squares(self.theta, states) for states in first_states])
        best: Array = first_states[np.argmin(squares, axis=0), np.arange(len(self.linear))]
        return best

    def estimate_settled_states(self, theta: Array) -> Array:
        """Return first states (R, 2 D) in contact equilibrium for a model with other parameters.

        The depth of contacts and the motion depend on the parameters, so a new filter with these
        parameters estimates the states. If it diverges, those of this filter are returned.

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
        return self.first_state_fitter.improve_first_states(self.theta, self.get_first_states())


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

    The process noise, which stands for missing forces, is fitted with the given correlation first.
    Larger correlations φ of AR(1) noise follow, in ascending order and equal in all channels, each
    with the process noise fitted again, as long as the log-likelihood increases.

    Args:
        runs: the linear models.
        noise: sensor noise of each channel.
        force: (E,) initial standard deviations of the missing forces.
        typical: (E,) typical forces in N or N·m, scales of the missing ones.

    Returns:
        The likeliest noise, with the results of filter and smoother.
    """
    best: _NoiseFit | None = None
    given_phi = float(noise.phi.max(initial=0.0))
    # First the given noise, whose channels may have different correlations.
    tried_noises = [noise] + [
        NoiseModel(noise.sigma, np.full_like(noise.phi, phi))
        for phi in CORRELATIONS
        if phi > given_phi
    ]
    for tried_noise in tried_noises:
        # Models with states for the correlated noise, and the variances of the white noise.
        coloured, white = add_noise_states(runs, tried_noise)
        # Filter with the process noise so far, and fit it only if the correlation is likelier.
        if best is not None:
            filtered = filter_runs(coloured, best.force, white)
            before, after = best.filtered.log_likelihood.sum(), filtered.log_likelihood.sum()
            # Both are minus infinity if the model diverges; `not >` then ends the loop.
            if not after > before + MIN_CORRELATION_GAIN:
                break
            force = best.force
        best = _NoiseFit(tried_noise, *fit_process_noise(coloured, force, white, typical))
    assert best is not None
    return best


def linearise_run(
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
    min_jacobian_seconds: float = LINEARISATION_INTERVAL_SECONDS,
) -> MeasuredLinear:
    """Linearise the model of one run about a motion.

    - If a motion is given, that one is used.
    - For a robot on the ground, the motion is simulated from a first state in contact equilibrium:
      contacts are less deep than the noise of encoders, so that a measured motion has wrong contact
      forces. Jacobians are then not reused, because contacts may differ.
    - Otherwise, the motion is estimated from the readings alone.

    Args:
        evaluator: the runs.
        theta: (P,) parameters about which the model is linear.
        noise: sensor noise of each channel.
        run: index of the run.
        trajectory: the motion; None to estimate or simulate it.
        neighbour: model of the same run at other parameters or about another motion, whose
            matrices are reused; None to compute all matrices.
        simulator: robot with other contact or friction settings; None for that of the evaluator.
        reuses_jacobians: whether derivatives of steps are taken from the neighbour.
        reuses_loads: whether the forces that transmissions carry are taken from the neighbour, too.
        first_state: first state from which a robot on the ground is simulated; None for that of
            the readings.
        min_jacobian_seconds: minimum time in seconds for which a Jacobian is held.
    """
    # Half of the states are positions, the others velocities.
    half = len(evaluator.state_names) // 2
    scenario = evaluator.prepared_runs[run].scenario
    guess = evaluator.initial_state_guesses[run]
    # Positions and velocities from which joints without readings are simulated.
    start = guess[:half], guess[half:]
    robot = simulator or evaluator.simulator
    assert isinstance(robot, RobotSimulator)
    measured: Mapping[int, Array] | None = None
    is_simulated = robot.robot.is_on_ground and trajectory is None
    if is_simulated:
        start = settle_first_state(evaluator, robot, theta, noise, run, first_state)
    elif trajectory is None:
        measured = estimate_measured_states(evaluator, noise.sigma, run)
    return MeasuredLinear(
        robot,
        theta,
        scenario,
        start,
        trajectory,
        measured,
        neighbour,
        reuses_jacobians=reuses_jacobians and not is_simulated,
        reuses_loads=reuses_loads,
        min_jacobian_seconds=min_jacobian_seconds,
    )


def _compute_prior_deviations(
    evaluator: RunEvaluator, linear: Sequence[MeasuredLinear], size: int
) -> Array:
    """Return prior standard deviations (Z,) of the first states, from which the filter begins.

    They are deviations from the measured motion. A recorded position may have the offset of its
    encoder. A velocity that the readings do not determine, as with a stiff servo, where it decays
    within a sample, needs a bound: a share of the joint's highest speed in any run.

    Args:
        evaluator: the runs.
        linear: linearised model of each run.
        size: number Z of state components, with the hidden states that effects may have.

    Returns:
        Standard deviations in SI units: of positions first, then of velocities; almost zero for
        hidden states.
    """
    coordinates = evaluator.simulator.system.coordinates
    # All other states, such as hidden states of effects, start at known values.
    prior = np.full(size, 1e-9)
    # Positions may include those of joints in series, which are no coordinates of the robot.
    position_count = linear[0].positions
    max_speeds = np.max(
        [np.abs(run_model.trajectory.v).max(axis=0) for run_model in linear], axis=0
    )
    for joint, name in enumerate(coordinates):
        if name in evaluator.channels:
            prior[joint] = POSITION_PRIOR
            velocity_deviation = VELOCITY_PRIOR * float(max_speeds[joint]) + MIN_VELOCITY_PRIOR
            prior[position_count + joint] = min(velocity_deviation, MAX_VELOCITY_PRIOR)
        else:
            prior[joint], prior[position_count + joint] = UNMEASURED_PRIOR, UNMEASURED_SPEED
    return prior
