"""Initial states of a robot with contacts, and proposals of effects at its contacts.

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

The score of an effect at a contact is misleading: without it, the simulation slides where the robot
sticks, and a small change of a coefficient does not show what a large one does. Each such effect is
therefore fitted from several values. The initial states are then estimated again with the best
model, because the first estimate belongs to the model without the effect.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.coefficient_bounds import compute_coefficient_bounds
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.evaluation.search_control import SearchStoppedError
from bench.diagnosis.fitting.fit_state import FitStart
from bench.diagnosis.kalman.measured_states import estimate_measured_states
from bench.diagnosis.search.effect_search import EffectSearch
from sims.core.simulator import Array
from sims.robot.dynamics.batch_work import RobotRunBatch
from sims.robot.dynamics.effect_forces import (
    is_evaluated_per_step,
    select_model_field_effects,
    slice_active_effects,
)
from sims.robot.dynamics.inverse_dynamics import compute_joint_scales
from sims.robot.floating_joints import FloatingState
from sims.robot.mujoco_messages import capture_mujoco_warnings
from sims.robot.robot_simulator import LINEARISATION_BATCH_SIZE, RobotSimulator

FORCE_SHARES = (0.001, 0.01, 0.1, 1.0)
"""Standard deviations of the missing force that are tried, as shares of a typical force."""
POSITION_PRIOR = 1e-2
"""Standard deviation of the first positions about their guess, rad or m."""
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


def estimate_first_states(
    evaluator: RunEvaluator, theta: Array, sigma: Array
) -> FirstStates | None:
    """Estimate the first states of all runs of a robot with contacts.

    Args:
        evaluator: the runs.
        theta: (P,) parameters of the model.
        sigma: (C,) standard deviation of the noise of each channel.

    Returns:
        First states with the likeliest missing force of each run; None if the robot has states in
        addition to joints with one coordinate, or if the filter diverges.
    """
    simulator = evaluator.simulator
    assert isinstance(simulator, RobotSimulator)
    robot, acting = simulator.robot, simulator.get_active_effects(theta[None])
    joints = len(simulator.addresses.positions)
    is_stepwise = any(is_evaluated_per_step(effect) for effect, _ in acting)
    if robot.compiled.na or len(robot.joints) != joints or is_stepwise or robot.series:
        return None
    typical = compute_joint_scales(robot).force
    states, variances = [], []
    for number in range(len(evaluator.prepared_runs)):
        run = _CubatureFilter(evaluator, simulator, theta, sigma, number)
        smoothed_runs = [run.smooth(share * typical) for share in FORCE_SHARES]
        best = max(smoothed_runs, key=lambda smoothed: smoothed.log_likelihood)
        states.append(best.mean)
        variances.append(np.diag(best.covariance))
    first_states = FirstStates(np.array(states), np.sqrt(np.mean(variances, axis=0)))
    return first_states if all(np.isfinite(part).all() for part in first_states) else None


class _Smoothed(NamedTuple):
    """Result of one run: log-likelihood, and mean and covariance of the first state."""

    log_likelihood: float
    mean: Array
    covariance: Array


class _CubatureFilter:
    """One run of a robot, for the cubature filter."""

    def __init__(
        self,
        evaluator: RunEvaluator,
        simulator: RobotSimulator,
        theta: Array,
        sigma: Array,
        run: int,
    ) -> None:
        """Compute the inputs over all steps, and find the recorded components of the state."""
        track = evaluator.prepared_runs[run]
        self._start = evaluator.initial_state_guesses[run]
        acting = simulator.get_active_effects(theta[None])
        joints = len(simulator.addresses.positions)
        work = RobotRunBatch(
            track.scenario,
            simulator.run_inputs(track.scenario),
            acting,
            self._start[None, :joints],
            self._start[None, joints:],
        )
        speeds = list(estimate_measured_states(evaluator, sigma, run).values())
        fastest = max((float(np.abs(s[:, 1]).max()) for s in speeds), default=1.0)
        self._prior = np.repeat([POSITION_PRIOR, fastest], joints)
        times = work.times
        steps = simulator.count_steps(times) + 1
        self._given = simulator.compute_controls(work, steps)
        self._knots = np.rint(times / simulator.time_step).astype(np.intp)
        self._mujoco_batch = simulator.make_linearisation_batch(acting)
        written = slice_active_effects(select_model_field_effects(acting), np.zeros(1, np.intp))
        self._acting = tuple(
            (effect, np.repeat(c, self._mujoco_batch.count, axis=1)) for effect, c in written
        )
        states = [*simulator.system.coordinates, *simulator.system.rates]
        self._columns = [i for i, name in enumerate(evaluator.channels) if name in states]
        self._rows = [states.index(evaluator.channels[i]) for i in self._columns]
        self._observed = track.observed[:, self._columns]
        self._variances = np.square(sigma[self._columns])

    def smooth(self, force: Array) -> _Smoothed:
        """Filter and smooth the run.

        Args:
            force: (D,) standard deviations of the missing forces.
        """
        size, joints = self._start.size, force.size
        mean, covariance = self._start.copy(), np.diag(np.square(self._prior))
        count = size + joints
        points = np.sqrt(count) * np.concatenate([np.eye(count), -np.eye(count)])
        log_likelihood = 0.0
        intervals: list[tuple[Array, ...]] = []
        with np.errstate(all="ignore"), capture_mujoco_warnings():
            self._mujoco_batch.write_effects(self._acting)
            for i, (begin, end) in enumerate(zip(self._knots, self._knots[1:], strict=False)):
                log_likelihood_gain, mean, covariance = self._update(i, mean, covariance)
                log_likelihood += log_likelihood_gain
                root = np.linalg.cholesky(covariance + ADDED_VARIANCE * np.eye(size))
                displacements = points[:, :size] @ root.T  # (1)
                ends = self._propagate(
                    mean + displacements, points[:, size:] * force, int(begin), int(end)
                )
                if not np.isfinite(ends).all():
                    return _Smoothed(-np.inf, self._start, covariance)
                predicted = ends.mean(axis=0)
                predicted_covariance = (ends - predicted).T @ (ends - predicted) / len(ends)
                predicted_covariance += ADDED_VARIANCE * np.eye(size)
                cross_covariance = displacements.T @ (ends - predicted) / len(ends)
                intervals.append(
                    (mean, covariance, predicted, predicted_covariance, cross_covariance)
                )
                mean, covariance = predicted, predicted_covariance
            log_likelihood_gain, mean, covariance = self._update(
                self._knots.size - 1, mean, covariance
            )
        for (
            filtered_mean,
            filtered_covariance,
            predicted,
            predicted_covariance,
            cross_covariance,
        ) in reversed(intervals):
            gain = np.linalg.solve(predicted_covariance, cross_covariance.T).T  # (2)
            mean = filtered_mean + gain @ (mean - predicted)
            covariance = filtered_covariance + gain @ (covariance - predicted_covariance) @ gain.T
        return _Smoothed(log_likelihood + log_likelihood_gain, mean, covariance)

    def _update(self, i: int, mean: Array, covariance: Array) -> tuple[float, Array, Array]:
        """Update mean and covariance of the state by the readings of sample i (Kalman filter).

        Returns:
            Log-likelihood of the readings, mean, and covariance.
        """
        is_recorded = np.isfinite(self._observed[i])
        rows = np.array(self._rows)[is_recorded]
        if not rows.size:
            return 0.0, mean, covariance
        residual = self._observed[i][is_recorded] - mean[rows]
        innovation_covariance = covariance[np.ix_(rows, rows)] + np.diag(
            self._variances[is_recorded]
        )
        gain = np.linalg.solve(innovation_covariance, covariance[rows]).T
        _, log_determinant = np.linalg.slogdet(innovation_covariance)
        log_likelihood = -0.5 * float(
            residual @ np.linalg.solve(innovation_covariance, residual) + log_determinant
        )
        new_covariance = covariance - gain @ covariance[rows]
        return log_likelihood, mean + gain @ residual, 0.5 * (new_covariance + new_covariance.T)

    def _propagate(self, states: Array, forces: Array, begin: int, end: int) -> Array:
        """Step states (n, 2 D) with additional forces (n, D) through the engine.

        Returns:
            (n, 2 D) states at the end.
        """
        joints, mujoco_batch = forces.shape[1], self._mujoco_batch
        result = states.copy()
        if end == begin:
            return result
        position_columns, velocity_columns = (
            mujoco_batch.file_joints.positions,
            mujoco_batch.file_joints.velocities,
        )
        for first in range(0, len(states), LINEARISATION_BATCH_SIZE):
            part = slice(first, first + LINEARISATION_BATCH_SIZE)
            part_states = states[part]
            count = len(part_states)
            afloat = FloatingState(np.zeros((count, 0)), np.zeros((count, 0)))
            mujoco_batch.set_initial_state(part_states[:, :joints], part_states[:, joints:], afloat)
            applied_forces = np.repeat(self._given.forces[:, begin:end], count, axis=0)
            applied_forces[:, :, velocity_columns] += forces[part, None]
            controls = np.repeat(self._given.controls[:, begin:end], count, axis=0)
            motion = mujoco_batch.step(controls, applied_forces, ["qpos", "qvel"])
            result[part, :joints] = motion["qpos"][:, -1, position_columns]
            result[part, joints:] = motion["qvel"][:, -1, velocity_columns]
            result[part][mujoco_batch.failed] = np.nan
        return result


START_SHARES = (0.5, 0.25)
"""Values at which fits begin, as shares of the lowest and the highest plausible coefficient."""
FIRST_STATE_MARGIN = 3.0
"""Prior standard deviation of a first state in contact, in standard deviations of its estimate.

The margin is needed since the estimate depends on a model that may lack causes.
"""


def set_first_states_in_contact(
    evaluators: Sequence[RunEvaluator], theta: Array, sigma: Array
) -> None:
    """Estimate the initial states of a robot whose geoms touch.

    Args:
        evaluators: runs for fitting, and held-out runs.
        theta: (P,) parameters of the model.
        sigma: (C,) standard deviation of the noise of each channel.
    """
    for evaluator in evaluators:
        found = estimate_first_states(evaluator, theta, sigma)
        if found is not None:
            evaluator.begin_at(found.states, FIRST_STATE_MARGIN * found.deviations)


def propose_contact_effects(search: EffectSearch, evaluators: Sequence[RunEvaluator]) -> None:
    """Fit each effect at a contact, and estimate the initial states again with the best model.

    Args:
        search: search with the fitted base model; it gets models with one effect each.
        evaluators: its runs, followed by held-out runs, whose initial states are estimated again.

    Raises:
        SearchStoppedError: the search had to end; it has the models that were fitted so far.
    """
    evaluator, base = search.evaluator, search.base_model.fit
    names = [
        name for name in evaluator.library if evaluator.available_effects[name].at == "contact"
    ]
    starts = []
    for name in names:
        low, high = compute_coefficient_bounds(evaluator, name)[0]
        for c in (START_SHARES[0] * low, START_SHARES[1] * high):
            theta = base.theta.copy()
            theta[evaluator.coefficient_slices[name]] = c
            starts.append(FitStart((name,), theta, base.initial_states))
    search.refit_models(starts, is_racing=False)
    fits = [search.models[frozenset((name,))] for name in names]
    best = max([search.base_model, *fits], key=lambda model: model.penalised_log_likelihood)
    if not best.effects:
        return
    set_first_states_in_contact(evaluators, best.fit.theta, search.noise.sigma)
    # Sums of squares about other initial states are not comparable.
    known = dict(search.models)
    search.models.clear()
    starts = [
        FitStart(model.effects, model.fit.theta, evaluator.initial_state_guesses)
        for model in known.values()
    ]
    try:
        search.refit_models(starts, is_racing=False)
    except SearchStoppedError:
        search.models.update(known)
        raise
    search.fit_to_convergence(search.models[frozenset(best.effects)])
