"""Initial states and likelihoods of runs of a robot with contacts, by a cubature Kalman filter.

A contact force depends on the depth of the contact, which is smaller than the noise of most
encoders. A model that is linearised about measured positions therefore has wrong forces. Here the
model itself decides about depth and sliding: a cubature Kalman filter (I. Arasaratnam, S. Haykin,
IEEE Trans. Autom. Control 54(6), 1254, 2009, doi:10.1109/TAC.2009.2019800) propagates 2 n points

    x_j = m +- sqrt(n) S e_j,    P = S S'                                                      (1)

of the augmented state of n components (positions, velocities and a force at each joint that is
constant between two samples) through the engine, and takes mean and covariance of the results.
Readings are linear in the state, so that the update is that of Kalman. The smoother of Rauch, Tung
and Striebel uses the cross-covariance C of the points before and after an interval,

    m_s[i] = m[i] + D (m_s[i+1] - m-[i+1]),    D = C inv(P-[i+1])                              (2)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.noise_model import Mask
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.kalman.kinematic_smoother import estimate_measured_states
from sims.core.simulator import Array
from sims.robot.dynamics.active_effects import (
    is_evaluated_per_step,
    pad_coefficients,
    slice_active_effects,
)
from sims.robot.dynamics.added_elements import group_by_added_elements
from sims.robot.dynamics.joint_scales import compute_joint_scales
from sims.robot.dynamics.run_batches import RobotRunBatch
from sims.robot.floating_joints import FloatingState
from sims.robot.model_field_effects import select_model_field_effects
from sims.robot.mujoco_messages import capture_mujoco_warnings
from sims.robot.robot_simulator import LINEARISATION_BATCH_SIZE, RobotSimulator

FORCE_SHARES = (0.001, 0.01, 0.1, 1.0)
"""Standard deviations of the missing force that are tried, as shares of a typical force."""
POSITION_PRIOR = 1e-2
"""Standard deviation of the first positions about their guess, rad or m."""
SPEED_PRIOR = 3.0
"""Standard deviation of the first velocities, in units of their noise.

Without a velocity channel, it is the noise of positions per sample interval.
"""
SEARCH_ROUNDS = 4
"""Maximum number of rounds of the random search of a first state by simulation."""
SEARCHED_STATES = 40
"""Number of first states that are simulated in a round."""
SEARCH_SHRINKAGE = 0.5
"""Ratio of the standard deviations of the search in two successive rounds."""
MAX_SEARCHED_SQUARES = 100.0
"""Mean square of the residual, in units of the noise, above which the model is wrong."""
MAX_EXPLAINED_SQUARES = 1.1
"""Mean square of the residual, in units of the noise, at which a first state is not searched."""
FIRST_STATE_MARGIN = 3.0
"""Prior standard deviation of a first state in contact, in standard deviations of its estimate.

The margin is needed since the estimate depends on a model that may lack causes.
"""
ADDED_VARIANCE = 1e-18
"""Variance added to each component of the state, so that its covariance has a square root."""


class FirstStates(NamedTuple):
    """Positions and velocities of D joints at the first samples of R runs.

    Attributes:
        states: (R, 2 D) smoothed states.
        deviations: (2 D,) their standard deviations, RMS over the runs.
    """

    states: Array
    deviations: Array


class FilterHypothesis(NamedTuple):
    """Assumption with which one run is filtered.

    Attributes:
        run: index of the run.
        theta: (P,) parameters of the model.
        share: standard deviation of the missing forces, as a share of the typical forces.
    """

    run: int
    theta: Array
    share: float


class SmoothedStart(NamedTuple):
    """Result of filter and smoother for one run: log-likelihood, and law of the first state.

    Attributes:
        log_likelihood: log-likelihood of the readings; -inf if the filter diverges.
        mean: (2 D,) mean of the positions and velocities of D joints at the first sample.
        covariance: (2 D, 2 D) their covariance.
    """

    log_likelihood: float
    mean: Array
    covariance: Array


def estimate_first_states(
    evaluator: RunEvaluator, theta: Array, sigma: Array
) -> FirstStates | None:
    """Estimate the first states of all runs of a robot with contacts.

    A filter and smoother estimate them, and simulations improve those that do not explain their
    run.

    Args:
        evaluator: the runs.
        theta: (P,) parameters of the model.
        sigma: (C,) standard deviation of the noise of each channel.

    Returns:
        First states with the likeliest missing force of each run; None if `can_filter` is false, or
        if the filter diverges.
    """
    best = smooth_first_states(evaluator, theta, sigma)
    if best is None:
        return None
    states = [
        _refine_first_state(evaluator, theta, sigma, run, smoothed)
        for run, smoothed in enumerate(best)
    ]
    return FirstStates(np.array(states), compute_first_deviations(best))


def smooth_first_states(
    evaluator: RunEvaluator, theta: Array, sigma: Array
) -> list[SmoothedStart] | None:
    """Filter and smooth all runs with the likeliest missing force of each.

    The missing force, a random force at each joint that is constant between two samples (process
    noise), allows for an incomplete model. Several sizes of it are tried for each run, and the
    result with the highest log-likelihood is returned.

    Args:
        evaluator: the runs.
        theta: (P,) parameters of the model.
        sigma: (C,) standard deviation of the noise of each channel.

    Returns:
        First states by run; None if `can_filter` is false, or if the filter diverges.
    """
    if not can_filter(evaluator, theta):
        return None
    runs, share_count = range(len(evaluator.prepared_runs)), len(FORCE_SHARES)
    # The hypotheses of a run, one for each size of the missing force, follow one another.
    results = filter_hypotheses(
        evaluator,
        sigma,
        [FilterHypothesis(run, theta, share) for run in runs for share in FORCE_SHARES],
    )
    best = [
        max(
            results[share_count * run : share_count * (run + 1)],
            key=lambda smoothed: smoothed.log_likelihood,
        )
        for run in runs
    ]
    is_finite = all(
        np.isfinite(smoothed.mean).all() and np.isfinite(smoothed.covariance).all()
        for smoothed in best
    )
    return best if is_finite else None


def compute_first_deviations(smoothed: Sequence[SmoothedStart]) -> Array:
    """Return the standard deviations (2 D,) of first states, RMS over the runs."""
    variances = [np.diag(run_start.covariance) for run_start in smoothed]
    deviations: Array = np.sqrt(np.mean(variances, axis=0))
    return deviations


def _refine_first_state(
    evaluator: RunEvaluator, theta: Array, sigma: Array, run: int, smoothed: SmoothedStart
) -> Array:
    """Return the first state (2 D,) of one run that explains it best by simulation.

    Where a contact begins to slide or to lift, the simulated run has kinks at which Gauss-Newton
    steps from the smoothed state end. The state is therefore searched at random within its
    uncertainty, in rounds with a decreasing width about the best state so far. The cost is the sum
    of the squared residual, in units of the noise, and the squared change of the smoothed state, in
    units of its uncertainty. The search ends if the best state explains the run, or at once if the
    residual is so large that the model cannot explain it.

    Args:
        evaluator: the runs.
        theta: (P,) parameters of the model.
        sigma: (C,) standard deviation of the noise of each channel.
        run: index of the run.
        smoothed: result of the smoother for this run: mean and covariance of its first state.

    Returns:
        Positions, then velocities of D joints; the smoothed mean if no better state is found.
    """
    is_recorded = np.isfinite(evaluator.observed[run])
    # A fixed seed, so that the result depends only on the arguments.
    rng = np.random.default_rng(0)
    root = compute_root(smoothed.covariance[None])[0]
    # Deviates are in units of the uncertainty: a state is mean + root @ deviates.
    best, deviates = smoothed.mean, np.zeros(smoothed.mean.size)
    width, lowest = 1.0, np.inf
    for _ in range(SEARCH_ROUNDS):
        tried = deviates + width * rng.standard_normal((SEARCHED_STATES, deviates.size))
        # The first one is the best so far, whose residual decides below whether the search goes on.
        tried[0] = deviates
        states = smoothed.mean + tried @ root.T
        simulated = evaluator.simulate(
            np.repeat(theta[None], len(states), axis=0), np.full(len(states), run), states
        )
        residual = np.where(is_recorded, simulated - evaluator.observed[run], 0.0) / sigma
        squares = np.square(residual).sum(axis=(1, 2))
        mean_square = squares[0] / max(is_recorded.sum(), 1)
        if not MAX_EXPLAINED_SQUARES < mean_square < MAX_SEARCHED_SQUARES:
            break
        costs = squares + np.square(tried).sum(axis=1)
        index = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
        if costs[index] < lowest:
            lowest, best, deviates = costs[index], states[index], tried[index]
        width *= SEARCH_SHRINKAGE
    return best


def can_filter(evaluator: RunEvaluator, theta: Array) -> bool:
    """Return whether the cubature filter can follow the runs of a robot.

    The state must consist of positions and velocities of joints with one coordinate: no activations
    of actuators, no floating or ball joints, and no joints in series with others. Effects that are
    evaluated in every step of the engine are excluded, too.

    Args:
        evaluator: the runs.
        theta: (P,) parameters of the model.
    """
    simulator = evaluator.simulator
    assert isinstance(simulator, RobotSimulator)
    robot, joints = simulator.robot, len(simulator.addresses.positions)
    acting = simulator.get_active_effects(theta[None])
    is_stepwise = any(is_evaluated_per_step(effect) for effect, _ in acting)
    # `na` is MuJoCo's number of activations. Only joints with one coordinate have a position each.
    has_more_states = robot.compiled.na or len(robot.joints) != joints or robot.series
    return not (has_more_states or is_stepwise)


def filter_hypotheses(
    evaluator: RunEvaluator, sigma: Array, hypotheses: Sequence[FilterHypothesis]
) -> list[SmoothedStart]:
    """Filter and smooth runs under several hypotheses, with as many as possible in one batch.

    A batch steps many states of one model at once, so its runs must have the same sample times, and
    their effects must add the same elements (such as springs) to the model.

    Args:
        evaluator: the runs; `can_filter` must be true.
        sigma: (C,) standard deviation of the noise of each channel.
        hypotheses: runs with the parameters and missing forces to assume.

    Returns:
        The result of each hypothesis; the log-likelihood of a filter that diverges is -inf.
    """
    simulator = evaluator.simulator
    assert isinstance(simulator, RobotSimulator)
    points = count_cubature_points(len(simulator.addresses.positions))
    # Number of hypotheses whose points fit in one batch of the engine.
    batch_size = max(LINEARISATION_BATCH_SIZE // points, 1)
    thetas = np.array([hypothesis.theta for hypothesis in hypotheses])
    active_effects = simulator.get_active_effects(thetas)
    # Indices of the hypotheses that may share a batch, by added elements and sample times.
    groups: dict[tuple[int, bytes], list[int]] = {}
    for added_elements, indices in enumerate(
        group_by_added_elements(active_effects, len(hypotheses)).values()
    ):
        for index in indices:
            times = evaluator.prepared_runs[hypotheses[index].run].scenario.times
            groups.setdefault((added_elements, times.tobytes()), []).append(index)
    # Results by index of the hypothesis.
    results: dict[int, SmoothedStart] = {}
    for group in groups.values():
        for first in range(0, len(group), batch_size):
            part = group[first : first + batch_size]
            batch_results = _CubatureFilters(
                evaluator, sigma, [hypotheses[i] for i in part]
            ).smooth()
            results.update(zip(part, batch_results, strict=True))
    return [results[index] for index in range(len(hypotheses))]


class _CubatureFilters:
    """Cubature filters of F hypotheses about runs with the same sample times."""

    def __init__(
        self, evaluator: RunEvaluator, sigma: Array, hypotheses: Sequence[FilterHypothesis]
    ) -> None:
        """Compute the inputs over all steps, and find the recorded components of the state.

        Each hypothesis gets its controls, forces, first state with prior, and readings. The batch
        of the engine gets the effects of each hypothesis once per cubature point.

        For F hypotheses and D joints, `_first_means` and `_first_deviations` (F, 2 D) are the
        guessed first states and their prior standard deviations, `_controls` and `_forces` the
        inputs of each step, and `_force_deviations` (F, D) the standard deviations of the missing
        forces. `_sample_steps` (T,) are the numbers of the steps at which the samples lie,
        `_readings` (F, T, m) the readings of the m recorded components of the state,
        `_observed_components` the indices of these components, and `_noise_variances` (m,) the
        variances of their noise.

        Args:
            evaluator: the runs.
            sigma: (C,) standard deviation of the noise of each channel.
            hypotheses: runs with parameters and missing forces; sample times and added elements are
                equal.
        """
        simulator = evaluator.simulator
        assert isinstance(simulator, RobotSimulator)
        joints = len(simulator.addresses.positions)
        # The state consists of positions and velocities.
        self._joint_count, self._state_size = joints, 2 * joints
        self._point_count = count_cubature_points(joints)
        acting = simulator.get_active_effects(np.array([h.theta for h in hypotheses]))
        typical = compute_joint_scales(simulator.robot).force
        self._force_deviations = np.array([h.share * typical for h in hypotheses])
        starts, priors, controls, forces = [], [], [], []
        for index, hypothesis in enumerate(hypotheses):
            run_data = evaluator.prepared_runs[hypothesis.run]
            start, prior = _guess_first_state(evaluator, sigma, hypothesis.run)
            own_effects = slice_active_effects(acting, np.array([index]))
            run_batch = RobotRunBatch(
                run_data.scenario,
                simulator.run_inputs(run_data.scenario),
                own_effects,
                start[None, :joints],
                start[None, joints:],
            )
            # A batch of one run, hence the index 0.
            step_count = simulator.count_steps(run_batch.times) + 1
            inputs = simulator.compute_controls(run_batch, step_count)
            controls.append(inputs.controls[0])
            forces.append(inputs.forces[0])
            starts.append(start)
            priors.append(prior)
        self._controls, self._forces = np.array(controls), np.array(forces)
        self._first_means, self._first_deviations = np.array(starts), np.array(priors)
        # Sample times and added elements of all hypotheses are equal, so those of the last one
        # serve.
        self._sample_steps = np.rint(run_batch.times / simulator.time_step).astype(np.intp)
        self._mujoco_batch = simulator.make_linearisation_batch(own_effects)
        # Index of the hypothesis of each element of the engine's batch: one element for each
        # cubature point. If the points of a single hypothesis exceed the batch, they are stepped in
        # several parts, so the index is cut to the size of the batch.
        elements = np.repeat(np.arange(len(hypotheses)), self._point_count)[
            : self._mujoco_batch.count
        ]
        # Effects that change numbers of the model, such as a friction, for each element. Elements
        # of the batch that are not in use have coefficients of zero.
        field_effects = slice_active_effects(select_model_field_effects(acting), elements)
        self._field_effects = pad_coefficients(
            field_effects, elements.size, self._mujoco_batch.count
        )
        names = [*simulator.system.coordinates, *simulator.system.rates]
        # Recorded components of the state: their channels, and their rows in the state.
        columns = [i for i, name in enumerate(evaluator.channels) if name in names]
        self._observed_components = [names.index(evaluator.channels[i]) for i in columns]
        data_of_runs = [evaluator.prepared_runs[h.run] for h in hypotheses]
        self._readings = np.array([run_data.observed[:, columns] for run_data in data_of_runs])
        self._noise_variances = np.square(sigma[columns])

    def smooth(self) -> list[SmoothedStart]:
        """Filter the runs forward, smooth them backward, and return the first states.

        1. Forward: update the states by the readings of each sample, and predict those of the next
           sample by cubature points. The moments of each interval are kept.
        2. Backward: correct the states by what later readings say (smoother of Rauch, Tung and
           Striebel).

        Returns:
            The result of each hypothesis; the log-likelihood of a filter that diverges is -inf.
        """
        mean = self._first_means.copy()
        covariance = np.square(self._first_deviations)[:, :, None] * np.eye(self._state_size)
        log_likelihood = np.zeros(len(mean))
        has_failed = np.zeros(len(mean), dtype=bool)
        intervals: list[_IntervalMoments] = []
        last_sample = self._sample_steps.size - 1
        with np.errstate(all="ignore"), capture_mujoco_warnings():
            self._mujoco_batch.write_effects(self._field_effects)
            # 1. Forward.
            for i in range(self._sample_steps.size):
                log_likelihood_gain, mean, covariance = self._update(i, mean, covariance)
                log_likelihood += log_likelihood_gain
                if i < last_sample:
                    interval = self._predict(i, mean, covariance, has_failed)
                    intervals.append(interval)
                    mean, covariance = interval.predicted, interval.predicted_covariance
            # 2. Backward.
            for interval in reversed(intervals):
                mean, covariance = _smooth_interval(interval, mean, covariance)
        log_likelihood[has_failed | ~np.isfinite(log_likelihood)] = -np.inf
        return [
            SmoothedStart(*smoothed)
            for smoothed in zip(log_likelihood.tolist(), mean, covariance, strict=True)
        ]

    def _predict(
        self, i: int, mean: Array, covariance: Array, has_failed: Mask
    ) -> _IntervalMoments:
        """Predict the states of F hypotheses at the next sample, by cubature points.

        The state is augmented by a random missing force at each joint, which is constant until the
        next sample. The 2 n points of the n components, m +- sqrt(n) S e_j of eq. (1) with the mean
        m and a root S of the covariance, are stepped through the engine.

        Args:
            i: index of the sample from which the states are propagated.
            mean: (F, Z) filtered states at this sample.
            covariance: (F, Z, Z) their covariances.
            has_failed: (F,) mask of the filters that have diverged so far; it is updated in place.

        Returns:
            Means and covariances of the states at both samples.
        """
        size, component_count = self._state_size, self._point_count // 2
        added_covariance = ADDED_VARIANCE * np.eye(size)
        # Points (2 n, n) in units of the standard deviations, of which the last D are forces.
        points = np.sqrt(component_count) * np.concatenate(
            [np.eye(component_count), -np.eye(component_count)]
        )
        root = compute_root(covariance + added_covariance)
        displacements = points[:, :size] @ root.swapaxes(1, 2)  # (1)
        missing_forces = points[:, size:] * self._force_deviations[:, None]
        begin, end = self._sample_steps[i : i + 2].tolist()
        ends = self._propagate(mean[:, None] + displacements, missing_forces, begin, end)
        has_failed |= ~np.isfinite(ends).all(axis=(1, 2))
        # A diverged filter must not spread numbers that are not finite; its result is discarded.
        ends[has_failed] = 0.0
        # Mean and covariances of the propagated points, all of which have the same weight.
        predicted = ends.mean(axis=1)
        deviations = ends - predicted[:, None]
        predicted_covariance = deviations.swapaxes(1, 2) @ deviations / ends.shape[1]
        predicted_covariance += added_covariance
        cross_covariance = displacements.swapaxes(1, 2) @ deviations / ends.shape[1]
        return _IntervalMoments(mean, covariance, predicted, predicted_covariance, cross_covariance)

    def _update(self, i: int, mean: Array, covariance: Array) -> tuple[Array, Array, Array]:
        """Update means and covariances of F hypotheses by the readings of sample i (Kalman filter).

        Readings are components of the state, so the observation matrix selects rows.

        Args:
            i: index of the sample.
            mean: (F, Z) predicted states.
            covariance: (F, Z, Z) their covariances.

        Returns:
            Log-likelihoods of the readings (F,), means, and covariances.
        """
        readings, rows = self._readings[:, i], self._observed_components
        is_recorded = np.isfinite(readings)
        # A missing reading has a zero row in the observation matrix, the residual 0 and the
        # variance 1, so that it changes neither state nor likelihood.
        residual = np.where(is_recorded, readings - mean[:, rows], 0.0)
        # Covariance H P of the readings with the state, with the observation matrix H.
        observed_covariance = is_recorded[:, :, None] * covariance[:, rows]
        variances = np.where(is_recorded, self._noise_variances, 1.0)
        # H P H' + R
        innovation_covariance = observed_covariance[:, :, rows] * is_recorded[
            :, None, :
        ] + variances[:, :, None] * np.eye(len(rows))
        # Kalman gain: covariance with the readings times the inverse of the readings' covariance.
        gain = _solve(innovation_covariance, observed_covariance).swapaxes(1, 2)
        _, log_determinant = np.linalg.slogdet(innovation_covariance)
        weighted = _solve(innovation_covariance, residual[..., None])[..., 0]
        log_likelihood = -0.5 * ((residual * weighted).sum(axis=1) + log_determinant)
        new_covariance = covariance - gain @ observed_covariance
        new_mean = mean + (gain @ residual[..., None])[..., 0]
        # Rounding makes the two halves of a covariance differ.
        return log_likelihood, new_mean, 0.5 * (new_covariance + new_covariance.swapaxes(1, 2))

    def _propagate(self, states: Array, forces: Array, begin: int, end: int) -> Array:
        """Step states (F, n, 2 D) with additional forces (F, n, D) through the engine.

        There are F hypotheses with n cubature points each and D joints. All F n states are stepped
        in batches of the size that the engine has.

        Args:
            states: positions, then velocities.
            forces: missing force of each joint, constant over the steps.
            begin: first step.
            end: step after the last one; if it equals `begin`, nothing is stepped.

        Returns:
            (F, n, 2 D) states at the end; NaN where the simulation fails.
        """
        # Two samples may lie in the same step.
        if end == begin:
            return states.copy()
        joints, mujoco_batch = self._joint_count, self._mujoco_batch
        position_columns = mujoco_batch.file_joints.positions
        velocity_columns = mujoco_batch.file_joints.velocities
        # The index of the hypothesis of each state selects its controls and recorded forces.
        flat_states, flat_forces = states.reshape(-1, 2 * joints), forces.reshape(-1, joints)
        hypotheses = np.repeat(np.arange(len(states)), states.shape[1])
        result = np.empty_like(flat_states)
        for first in range(0, len(flat_states), mujoco_batch.count):
            part = slice(first, first + mujoco_batch.count)
            part_states = flat_states[part]
            count = len(part_states)
            # The robot has no floating joints, see `can_filter`.
            no_pose = FloatingState(np.zeros((count, 0)), np.zeros((count, 0)))
            mujoco_batch.set_initial_state(
                part_states[:, :joints], part_states[:, joints:], no_pose
            )
            # An index array makes a copy, so that the recorded forces stay as they are.
            applied_forces = self._forces[hypotheses[part], begin:end]
            applied_forces[:, :, velocity_columns] += flat_forces[part, None]
            motion = mujoco_batch.step(
                self._controls[hypotheses[part], begin:end], applied_forces, ["qpos", "qvel"]
            )
            # The states after the last step.
            result[part, :joints] = motion["qpos"][:, -1, position_columns]
            result[part, joints:] = motion["qvel"][:, -1, velocity_columns]
            # `result[part]` is a view, because `part` is a slice.
            result[part][mujoco_batch.failed[:count]] = np.nan
        return result.reshape(states.shape)


class _IntervalMoments(NamedTuple):
    """Moments of the states of F hypotheses at both ends of an interval between two samples.

    Attributes:
        mean: (F, Z) filtered states at its beginning, given the readings up to there.
        covariance: (F, Z, Z) their covariances.
        predicted: (F, Z) predicted states at its end.
        predicted_covariance: (F, Z, Z) their covariances.
        cross_covariance: (F, Z, Z) covariances of the states at the beginning (rows) with those at
            the end.
    """

    mean: Array
    covariance: Array
    predicted: Array
    predicted_covariance: Array
    cross_covariance: Array


def _smooth_interval(
    interval: _IntervalMoments, mean: Array, covariance: Array
) -> tuple[Array, Array]:
    """Smooth the states at the beginning of an interval, given those at its end.

    The smoothed mean is m + D (m_end - m-) with the gain D = C inv(P-), the filtered mean m, the
    prediction m- with the covariance P-, and the cross-covariance C of both ends (Rauch, Tung and
    Striebel, eq. (2) of the module docstring).

    Args:
        interval: moments of the filter in the interval.
        mean: (F, Z) smoothed states at its end, m_end.
        covariance: (F, Z, Z) their covariances.

    Returns:
        Smoothed states (F, Z) at the beginning, and their covariances.
    """
    # D' solves P- D' = C'.
    transposed_gain = _solve(
        interval.predicted_covariance, interval.cross_covariance.swapaxes(1, 2)
    )  # (2)
    gain = transposed_gain.swapaxes(1, 2)
    new_mean = interval.mean + (gain @ (mean - interval.predicted)[..., None])[..., 0]
    new_covariance = interval.covariance + gain @ (
        covariance - interval.predicted_covariance
    ) @ gain.swapaxes(1, 2)
    return new_mean, new_covariance


def count_cubature_points(joints: int) -> int:
    """Return the number of points: two each for the position, velocity and force of a joint."""
    return 2 * 3 * joints


def _guess_first_state(evaluator: RunEvaluator, sigma: Array, run: int) -> tuple[Array, Array]:
    """Return a guess of the first state of a run, and its prior standard deviations.

    Positions are those of the evaluator; velocities are estimated from the readings where a joint
    is recorded.

    Args:
        evaluator: the runs.
        sigma: (C,) standard deviation of the noise of each channel.
        run: index of the run.

    Returns:
        Positions and velocities (2 D,) of D joints, and their standard deviations (2 D,).
    """
    start = evaluator.initial_state_guesses[run].copy()
    joints = start.size // 2
    prior = np.concatenate([np.full(joints, POSITION_PRIOR), np.ones(joints)])
    for joint, states in estimate_measured_states(evaluator, sigma, run).items():
        # Velocity (index 1) at the first sample.
        start[joints + joint] = states[0, 1]
        prior[joints + joint] = _compute_speed_deviation(evaluator, sigma, joint)
    return start, prior


def _compute_speed_deviation(evaluator: RunEvaluator, sigma: Array, joint: int) -> float:
    """Return the prior standard deviation of the first velocity of a joint, in its unit per second.

    It is a few times the noise of the velocity channel or, without one, that of positions per
    sample interval. It is needed since a velocity that a contact stops within a sample interval
    leaves no trace in the readings.

    Args:
        evaluator: the runs, in which the position or the velocity of the joint is recorded.
        sigma: (C,) standard deviation of the noise of each channel.
        joint: index of the joint.
    """
    system, channels = evaluator.simulator.system, list(evaluator.channels)
    coordinate, rate = system.coordinates[joint], system.rates[joint]
    if rate in channels:
        return SPEED_PRIOR * float(sigma[channels.index(rate)])
    return SPEED_PRIOR * float(sigma[channels.index(coordinate)]) / evaluator.sample_interval


def _solve(matrices: Array, sides: Array) -> Array:
    """Solve systems of equations (F, Z, Z) with right-hand sides (F, Z, N)."""
    return np.asarray(np.linalg.solve(matrices, sides), dtype=np.float64)


def compute_root(matrices: Array) -> Array:
    """Return square roots S of symmetric matrices P = S S', (F, Z, Z).

    They are Cholesky factors or, if one of the matrices has none, those of the eigenvectors.
    """
    try:
        root = np.asarray(np.linalg.cholesky(matrices), dtype=np.float64)
    except np.linalg.LinAlgError:
        # Rounding may make an eigenvalue negative, which is set to zero. A filter that diverges has
        # matrices that are not finite, and must not stop the others of the batch.
        values, vectors = np.linalg.eigh(np.nan_to_num(matrices))
        root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    return root


def set_first_states_in_contact(
    evaluators: Sequence[RunEvaluator], theta: Array, sigma: Array
) -> None:
    """Estimate the initial states of a robot whose geoms touch, and set them in the evaluators.

    An evaluator keeps its initial states if the filter cannot follow its runs.

    Args:
        evaluators: runs for fitting, and held-out runs.
        theta: (P,) parameters of the model.
        sigma: (C,) standard deviation of the noise of each channel.
    """
    for evaluator in evaluators:
        first = estimate_first_states(evaluator, theta, sigma)
        if first is not None:
            evaluator.begin_at(first.states, FIRST_STATE_MARGIN * first.deviations)
