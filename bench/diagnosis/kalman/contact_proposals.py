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
sticks, and a small change of a coefficient does not show what a large one does. The coefficient is
therefore estimated by maximum likelihood of the filter, which follows the data with a missing
force, or by scans of simulated runs. The initial states are estimated again with the fitted effect,
because the first estimate belongs to the model without it. Where a contact begins to slide, the sum
of squares has kinks at which Gauss-Newton steps end, so each fit begins with a scan.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.coefficient_bounds import compute_coefficient_bounds
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.evaluation.search_control import SearchStoppedError
from bench.diagnosis.fitting.fitted_models import FittedModel
from bench.diagnosis.fitting.levenberg_marquardt_state import FitStart
from bench.diagnosis.kalman.measured_states import estimate_measured_states
from bench.diagnosis.search.contact_search import exclude_laws_with_many_shapes
from bench.diagnosis.search.effect_search import EffectSearch
from bench.diagnosis.search.model_moves import MAX_REFITTED_CANDIDATES
from sims.core.simulator import Array
from sims.robot.dynamics.batch_work import RobotRunBatch
from sims.robot.dynamics.effect_forces import (
    is_evaluated_per_step,
    pad_coefficients,
    select_model_field_effects,
    slice_active_effects,
)
from sims.robot.dynamics.inverse_dynamics import compute_joint_scales
from sims.robot.dynamics.series_joints import group_by_added_elements
from sims.robot.floating_joints import FloatingState
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


class Hypothesis(NamedTuple):
    """Assumption about one run.

    Attributes:
        run: number of the run.
        theta: (P,) parameters of the model.
        share: standard deviation of the missing forces, as a share of the typical forces.
    """

    run: int
    theta: Array
    share: float


class SmoothedStart(NamedTuple):
    """Result of a filter: log-likelihood, and mean and covariance of the first state."""

    log_likelihood: float
    mean: Array
    covariance: Array


def estimate_first_states(
    evaluator: RunEvaluator, theta: Array, sigma: Array
) -> FirstStates | None:
    """Estimate the first states of all runs of a robot with contacts.

    Args:
        evaluator: the runs.
        theta: (P,) parameters of the model.
        sigma: (C,) standard deviation of the noise of each channel.

    Returns:
        First states with the likeliest missing force of each run; None if `can_filter` is false, or
        if the filter diverges.
    """
    if not can_filter(evaluator, theta):
        return None
    runs, tried = range(len(evaluator.prepared_runs)), len(FORCE_SHARES)
    results = filter_hypotheses(
        evaluator, sigma, [Hypothesis(run, theta, share) for run in runs for share in FORCE_SHARES]
    )
    best = [
        max(results[tried * run : tried * (run + 1)], key=lambda smoothed: smoothed.log_likelihood)
        for run in runs
    ]
    variances = [np.diag(smoothed.covariance) for smoothed in best]
    deviations = np.sqrt(np.mean(variances, axis=0))
    if not np.isfinite(deviations).all() or not all(np.isfinite(one.mean).all() for one in best):
        return None
    states = [_refine_first_state(evaluator, theta, sigma, run, best[run]) for run in runs]
    return FirstStates(np.array(states), deviations)


def _refine_first_state(
    evaluator: RunEvaluator, theta: Array, sigma: Array, run: int, smoothed: SmoothedStart
) -> Array:
    """Return the first state (2 D,) of one run that explains it best by simulation.

    Where a contact begins to slide or to lift, the simulated run has kinks at which Gauss-Newton
    steps from the smoothed state end. The state is therefore searched at random within its
    uncertainty, by the squares of the residual and of the change of the smoothed state. A run that
    the smoothed state explains is not searched, and neither is one that the model cannot explain.
    """
    is_recorded = np.isfinite(evaluator.observed[run])
    rng = np.random.default_rng(0)
    root = _compute_root(smoothed.covariance[None])[0]
    best, deviates = smoothed.mean, np.zeros(smoothed.mean.size)
    width, lowest = 1.0, np.inf
    for _ in range(SEARCH_ROUNDS):
        tried = deviates + width * rng.standard_normal((SEARCHED_STATES, deviates.size))
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
    """Return whether positions and velocities of joints with one coordinate are the whole state.

    Effects that are evaluated in every step are excluded, too.

    Args:
        evaluator: the runs.
        theta: (P,) parameters of the model.
    """
    simulator = evaluator.simulator
    assert isinstance(simulator, RobotSimulator)
    robot, joints = simulator.robot, len(simulator.addresses.positions)
    acting = simulator.get_active_effects(theta[None])
    is_stepwise = any(is_evaluated_per_step(effect) for effect, _ in acting)
    has_more_states = robot.compiled.na or len(robot.joints) != joints or robot.series
    return not (has_more_states or is_stepwise)


def filter_hypotheses(
    evaluator: RunEvaluator, sigma: Array, hypotheses: Sequence[Hypothesis]
) -> list[SmoothedStart]:
    """Filter and smooth runs under several hypotheses, with as many as possible in one batch.

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
    width = max(LINEARISATION_BATCH_SIZE // points, 1)
    acting = simulator.get_active_effects(np.array([one.theta for one in hypotheses]))
    groups: dict[tuple[int, bytes], list[int]] = {}
    # Batch elements with different elements of the model cannot share a batch.
    for kind, elements in enumerate(group_by_added_elements(acting, len(hypotheses)).values()):
        for number in elements:
            times = evaluator.prepared_runs[hypotheses[number].run].scenario.times
            groups.setdefault((kind, times.tobytes()), []).append(number)
    results: dict[int, SmoothedStart] = {}
    for numbers in groups.values():
        for first in range(0, len(numbers), width):
            part = numbers[first : first + width]
            found = _CubatureFilters(evaluator, sigma, [hypotheses[i] for i in part]).smooth()
            results.update(zip(part, found, strict=True))
    return [results[number] for number in range(len(hypotheses))]


class _CubatureFilters:
    """Cubature filters of F hypotheses about runs with the same sample times."""

    def __init__(
        self, evaluator: RunEvaluator, sigma: Array, hypotheses: Sequence[Hypothesis]
    ) -> None:
        """Compute the inputs over all steps, and find the recorded components of the state."""
        simulator = evaluator.simulator
        assert isinstance(simulator, RobotSimulator)
        joints = len(simulator.addresses.positions)
        self._joints, self._size = joints, 2 * joints
        self._point_count = count_cubature_points(joints)
        acting = simulator.get_active_effects(np.array([h.theta for h in hypotheses]))
        typical = compute_joint_scales(simulator.robot).force
        self._force_deviations = np.array([h.share * typical for h in hypotheses])
        starts, speed_priors, controls, forces = [], [], [], []
        for index, hypothesis in enumerate(hypotheses):
            track = evaluator.prepared_runs[hypothesis.run]
            start = evaluator.initial_state_guesses[hypothesis.run].copy()
            speed_prior = np.ones(joints)
            measured = estimate_measured_states(evaluator, sigma, hypothesis.run)
            for joint, states in measured.items():
                start[joints + joint] = states[0, 1]
                speed_prior[joint] = _compute_speed_deviation(evaluator, sigma, joint)
            own_effects = slice_active_effects(acting, np.array([index]))
            work = RobotRunBatch(
                track.scenario,
                simulator.run_inputs(track.scenario),
                own_effects,
                start[None, :joints],
                start[None, joints:],
            )
            inputs = simulator.compute_controls(work, simulator.count_steps(work.times) + 1)
            controls.append(inputs.controls[0])
            forces.append(inputs.forces[0])
            starts.append(start)
            speed_priors.append(speed_prior)
        self._controls, self._forces = np.array(controls), np.array(forces)
        self._start = np.array(starts)
        self._prior = np.hstack([np.full((len(starts), joints), POSITION_PRIOR), speed_priors])
        self._knots = np.rint(work.times / simulator.time_step).astype(np.intp)
        self._mujoco_batch = simulator.make_linearisation_batch(own_effects)
        # One hypothesis may need several batches, whose elements all have its effects.
        elements = np.repeat(np.arange(len(hypotheses)), self._point_count)[
            : self._mujoco_batch.count
        ]
        written = slice_active_effects(select_model_field_effects(acting), elements)
        self._acting = pad_coefficients(written, elements.size, self._mujoco_batch.count)
        names = [*simulator.system.coordinates, *simulator.system.rates]
        columns = [i for i, name in enumerate(evaluator.channels) if name in names]
        self._rows = [names.index(evaluator.channels[i]) for i in columns]
        tracks = [evaluator.prepared_runs[h.run] for h in hypotheses]
        self._observed = np.array([track.observed[:, columns] for track in tracks])
        self._variances = np.square(sigma[columns])

    def smooth(self) -> list[SmoothedStart]:
        """Filter and smooth the runs."""
        size, count = self._size, self._point_count // 2
        mean = self._start.copy()
        covariance = np.square(self._prior)[:, :, None] * np.eye(size)
        points = np.sqrt(count) * np.concatenate([np.eye(count), -np.eye(count)])
        log_likelihood = np.zeros(len(mean))
        has_failed = np.zeros(len(mean), dtype=bool)
        intervals: list[tuple[Array, ...]] = []
        added_covariance = ADDED_VARIANCE * np.eye(size)
        with np.errstate(all="ignore"), capture_mujoco_warnings():
            self._mujoco_batch.write_effects(self._acting)
            for i, (begin, end) in enumerate(zip(self._knots, self._knots[1:], strict=False)):
                log_likelihood_gain, mean, covariance = self._update(i, mean, covariance)
                log_likelihood += log_likelihood_gain
                root = _compute_root(covariance + added_covariance)
                displacements = points[:, :size] @ root.swapaxes(1, 2)  # (1)
                missing_forces = points[:, size:] * self._force_deviations[:, None]
                ends = self._propagate(
                    mean[:, None] + displacements, missing_forces, int(begin), int(end)
                )
                has_failed |= ~np.isfinite(ends).all(axis=(1, 2))
                ends[has_failed] = 0.0
                predicted = ends.mean(axis=1)
                deviations = ends - predicted[:, None]
                predicted_covariance = deviations.swapaxes(1, 2) @ deviations / ends.shape[1]
                predicted_covariance += added_covariance
                cross_covariance = displacements.swapaxes(1, 2) @ deviations / ends.shape[1]
                intervals.append(
                    (mean, covariance, predicted, predicted_covariance, cross_covariance)
                )
                mean, covariance = predicted, predicted_covariance
            log_likelihood_gain, mean, covariance = self._update(
                self._knots.size - 1, mean, covariance
            )
            log_likelihood += log_likelihood_gain
            for (
                filtered_mean,
                filtered_covariance,
                predicted,
                predicted_covariance,
                cross_covariance,
            ) in reversed(intervals):
                gain = _solve(predicted_covariance, cross_covariance.swapaxes(1, 2))  # (2)
                gain = gain.swapaxes(1, 2)
                mean = filtered_mean + (gain @ (mean - predicted)[..., None])[..., 0]
                covariance = filtered_covariance + gain @ (
                    covariance - predicted_covariance
                ) @ gain.swapaxes(1, 2)
        log_likelihood[has_failed | ~np.isfinite(log_likelihood)] = -np.inf
        return [
            SmoothedStart(float(value), *rest)
            for value, *rest in zip(log_likelihood, mean, covariance, strict=True)
        ]

    def _update(self, i: int, mean: Array, covariance: Array) -> tuple[Array, Array, Array]:
        """Update means and covariances by the readings of sample i (Kalman filter).

        Returns:
            Log-likelihoods of the readings (F,), means, and covariances.
        """
        readings, rows = self._observed[:, i], self._rows
        is_recorded = np.isfinite(readings)
        # A missing reading has the observation matrix 0, the residual 0 and the variance 1.
        residual = np.where(is_recorded, readings - mean[:, rows], 0.0)
        observed_covariance = is_recorded[:, :, None] * covariance[:, rows]
        variances = np.where(is_recorded, self._variances, 1.0)
        innovation_covariance = observed_covariance[:, :, rows] * is_recorded[
            :, None, :
        ] + variances[:, :, None] * np.eye(len(rows))
        gain = _solve(innovation_covariance, observed_covariance).swapaxes(1, 2)
        _, log_determinant = np.linalg.slogdet(innovation_covariance)
        weighted = _solve(innovation_covariance, residual[..., None])[..., 0]
        log_likelihood = -0.5 * ((residual * weighted).sum(axis=1) + log_determinant)
        new_covariance = covariance - gain @ observed_covariance
        new_mean = mean + (gain @ residual[..., None])[..., 0]
        return log_likelihood, new_mean, 0.5 * (new_covariance + new_covariance.swapaxes(1, 2))

    def _propagate(self, states: Array, forces: Array, begin: int, end: int) -> Array:
        """Step states (F, n, 2 D) with additional forces (F, n, D) through the engine.

        Returns:
            (F, n, 2 D) states at the end.
        """
        if end == begin:
            return states.copy()
        joints, mujoco_batch = self._joints, self._mujoco_batch
        position_columns, velocity_columns = (
            mujoco_batch.file_joints.positions,
            mujoco_batch.file_joints.velocities,
        )
        flat_states, flat_forces = states.reshape(-1, 2 * joints), forces.reshape(-1, joints)
        runs = np.repeat(np.arange(len(states)), states.shape[1])
        result = np.empty_like(flat_states)
        for first in range(0, len(flat_states), mujoco_batch.count):
            part = slice(first, first + mujoco_batch.count)
            part_states = flat_states[part]
            count = len(part_states)
            no_pose = FloatingState(np.zeros((count, 0)), np.zeros((count, 0)))
            mujoco_batch.set_initial_state(
                part_states[:, :joints], part_states[:, joints:], no_pose
            )
            applied_forces = self._forces[runs[part], begin:end]
            applied_forces[:, :, velocity_columns] += flat_forces[part, None]
            motion = mujoco_batch.step(
                self._controls[runs[part], begin:end], applied_forces, ["qpos", "qvel"]
            )
            result[part, :joints] = motion["qpos"][:, -1, position_columns]
            result[part, joints:] = motion["qvel"][:, -1, velocity_columns]
            result[part][mujoco_batch.failed[:count]] = np.nan
        return result.reshape(states.shape)


def count_cubature_points(joints: int) -> int:
    """Return the number of points for positions, velocities and forces of some joints."""
    return 2 * 3 * joints


def _compute_speed_deviation(evaluator: RunEvaluator, sigma: Array, joint: int) -> float:
    """Return the prior standard deviation of a first velocity, that of a few readings.

    A velocity that a contact stops within a sample interval leaves no trace in the readings.
    """
    system, channels = evaluator.simulator.system, list(evaluator.channels)
    position, rate = system.coordinates[joint], system.rates[joint]
    if rate in channels:
        return SPEED_PRIOR * float(sigma[channels.index(rate)])
    return SPEED_PRIOR * float(sigma[channels.index(position)]) / evaluator.sample_interval


def _solve(matrices: Array, sides: Array) -> Array:
    """Solve systems of equations (F, Z, Z) with right-hand sides (F, Z, N)."""
    return np.asarray(np.linalg.solve(matrices, sides), dtype=np.float64)


def _compute_root(matrices: Array) -> Array:
    """Return square roots S of symmetric matrices (F, Z, Z), P = S S'."""
    try:
        root = np.asarray(np.linalg.cholesky(matrices), dtype=np.float64)
    except np.linalg.LinAlgError:
        # Rounding may make an eigenvalue negative; a filter that diverges has no finite matrix.
        values, vectors = np.linalg.eigh(np.nan_to_num(matrices))
        root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    return root


DECREASES = (0.75, 0.5, 0.25)
"""Values that are tried, as shares of the largest possible decrease."""
INCREASES = (0.3, 0.7, 1.5)
"""Values that are tried, relative to the number of the model file."""
COMPARED_FORCE_SHARE = 0.1
"""Standard deviation of the missing force when values are compared, as a share of a typical force.

It is large enough for a model that lacks something to follow the data.
"""
REFINEMENT_WIDTHS = (0.25, 0.08)
"""Half of the intervals of the filter's refinements, relative to the number of the model file."""
GRID = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Values that are compared in a refinement, in half widths from the likeliest value."""
SCAN_WIDTHS = (1.5, 0.15, 0.03, 0.006, 0.001)
"""Half of the intervals of scans over a whole range, relative to the number of the model file."""
NEAR_SCAN_WIDTHS = (0.05, 0.01, 0.002, 0.0005)
"""Half of the intervals of scans near an estimate, relative to the number of the model file."""
SCANNED_VALUES = 21
"""Number of values of a scan."""
MAX_SCANNED_FITS = 4
"""Maximum number of fits that follow a scan."""
MAX_TRIED_EFFECTS = 3
"""Maximum number of effects at contacts that are fitted by simulation."""
MAX_MOVED_MODELS = 4
"""Maximum number of models of one effect that are fitted again from other initial states."""
MAX_SCAN_RATIO = 0.9
"""Maximum sum of squares in a scan of an effect that is fitted, relative to that without it."""
MAX_COST_RATIO = 0.5
"""Maximum sum of squares of an effect that is pursued, relative to that of the base model."""
MAX_EXPLAINED_EXCESS = 0.05
"""Maximum excess of a model whose initial states are not estimated again."""
MIN_COST_RATIO = 0.95
"""Ratio of the sums of squares of two fits above which no further fit is made."""
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
    """Fit single effects from initial states that belong to them, those at contacts first.

    Nothing is fitted if the base model leaves only noise, and no further effect if one explains the
    recording.

    Args:
        search: search with the fitted base model; it gets models with one effect.
        evaluators: its runs, followed by held-out runs, whose initial states are estimated again.

    Raises:
        SearchStoppedError: the search had to end; it has the models that were fitted so far.
    """
    if search.is_noise_like(search.base_model):
        return
    first_states = [(e.initial_state_guesses, e.state_prior) for e in evaluators]
    base = search.base_model
    likeliest = _find_likeliest_effect(search)
    if likeliest is not None:
        value = _refine_coefficient(search, likeliest)
        fits = [_fit_about_first_states_in_turn(search, evaluators, value)]
        if not _is_explained(search, fits[0][0]):
            others = [v for v in _rank_effects_at_contacts(search, base) if v.name != value.name]
            fits += [
                _fit_about_its_first_states(search, evaluators, v, SCAN_WIDTHS) for v in others
            ]
        model, value = min(fits, key=lambda pair: pair[0].fit.cost)
        if model.fit.cost < MAX_COST_RATIO * base.fit.cost:
            if not _is_explained(search, model):
                model, _ = _fit_about_first_states_in_turn(search, evaluators, value)
            search.fit_to_convergence(model)
            return
    for evaluator, (states, deviations) in zip(evaluators, first_states, strict=True):
        assert deviations is not None
        evaluator.begin_at(states, deviations)
    search.models.clear()
    search.add_fit(base.fit)
    _propose_single_effects(search, evaluators)


def _fit_about_its_first_states(
    search: EffectSearch,
    evaluators: Sequence[RunEvaluator],
    value: _ScannedValue,
    widths: Sequence[float] = NEAR_SCAN_WIDTHS,
) -> tuple[FittedModel, _ScannedValue]:
    """Estimate the initial states with an effect, and scan and fit its coefficient about them."""
    _move_to_first_states_of(search, evaluators, _add_effect(search, value))
    states = search.evaluator.initial_state_guesses
    for width in widths:
        value = _scan(search, value, width, states)
    model = search.fit_one(FitStart((value.name,), _add_effect(search, value), states))
    index = search.evaluator.coefficient_slices[value.name].start
    return model, value._replace(coefficient=float(model.fit.theta[index]))


def _fit_about_first_states_in_turn(
    search: EffectSearch, evaluators: Sequence[RunEvaluator], value: _ScannedValue
) -> tuple[FittedModel, _ScannedValue]:
    """Fit an effect and estimate the initial states in turn, while the sum of squares decreases."""
    limit = MAX_COST_RATIO * search.base_model.fit.cost
    for _ in range(MAX_SCANNED_FITS):
        model, value = _fit_about_its_first_states(search, evaluators, value)
        if _is_explained(search, model) or not model.fit.cost < limit:
            break
        limit = MIN_COST_RATIO * model.fit.cost
    return model, value


def _is_explained(search: EffectSearch, model: FittedModel) -> bool:
    """Return whether no better initial states are needed for a model."""
    return search.compute_excess_residual(model) < MAX_EXPLAINED_EXCESS


def _propose_single_effects(search: EffectSearch, evaluators: Sequence[RunEvaluator]) -> None:
    """Fit the effects with the best scores, and estimate the initial states with the best of them.

    The first estimate belongs to the model without the effect. The best effects are fitted again
    until one of them explains the recording.
    """
    exclude_laws_with_many_shapes(search)
    base = search.base_model
    search.refit_extensions([base], MAX_REFITTED_CANDIDATES)
    for _ in range(MAX_SCANNED_FITS):
        fitted = sorted(
            (model for model in search.models.values() if model.effects),
            key=lambda model: model.fit.cost,
        )
        if not fitted or _is_explained(search, fitted[0]):
            return
        if not fitted[0].fit.cost < MAX_COST_RATIO * base.fit.cost:
            return
        cost = fitted[0].fit.cost
        _move_to_first_states_of(search, evaluators, fitted[0].fit.theta)
        states = search.evaluator.initial_state_guesses
        search.refit_models(
            [FitStart(m.effects, m.fit.theta, states) for m in fitted[:MAX_MOVED_MODELS]],
            is_racing=False,
        )
        if not min(m.fit.cost for m in search.models.values()) < MIN_COST_RATIO * cost:
            return


def _move_to_first_states_of(
    search: EffectSearch, evaluators: Sequence[RunEvaluator], theta: Array
) -> None:
    """Estimate the initial states with parameters (P,), and fit the base model again about them.

    Raises:
        SearchStoppedError: the search had to end; it keeps the models about the former states.
    """
    base, known = search.base_model, dict(search.models)
    set_first_states_in_contact(evaluators, theta, search.noise.sigma)
    # Sums of squares about other initial states are not comparable.
    search.models.clear()
    try:
        search.refit_models([FitStart((), base.fit.theta, search.evaluator.initial_state_guesses)])
    except SearchStoppedError:
        search.models.update(known)
        raise


class _ScannedValue(NamedTuple):
    """Coefficient of an effect at a contact.

    Attributes:
        name: the effect.
        coefficient: its coefficient.
        unit: the number of the model file, in the unit of the coefficient.
        squares: sum of squares of the scan, in units of the noise.
    """

    name: str
    coefficient: float
    unit: float
    squares: float


def _list_effects_at_contacts(search: EffectSearch) -> list[_ScannedValue]:
    """Return the effects at contacts, each with the coefficient zero."""
    evaluator = search.evaluator
    return [
        # A coefficient is limited below, where the number of the file becomes zero.
        _ScannedValue(name, 0.0, -compute_coefficient_bounds(evaluator, name)[0][0], np.inf)
        for name in evaluator.library
        if evaluator.available_effects[name].at == "contact"
    ]


def _find_likeliest_effect(search: EffectSearch) -> _ScannedValue | None:
    """Return the likeliest of some values of all effects at contacts; None if there are none."""
    values = []
    for start in _list_effects_at_contacts(search):
        values += [start._replace(coefficient=-share * start.unit) for share in DECREASES]
        values += [start._replace(coefficient=share * start.unit) for share in INCREASES]
    if not values:
        return None
    likelihoods = _compute_log_likelihoods(search, values)
    best = int(np.argmax(likelihoods))
    return values[best] if np.isfinite(likelihoods[best]) else None


def _refine_coefficient(search: EffectSearch, value: _ScannedValue) -> _ScannedValue:
    """Return the likeliest coefficient of an effect near a value."""
    for width in REFINEMENT_WIDTHS:
        values = _list_nearby_values(search, value, width * np.array(GRID))
        value = values[int(np.argmax(_compute_log_likelihoods(search, values)))]
    return value


def _rank_effects_at_contacts(search: EffectSearch, base: FittedModel) -> list[_ScannedValue]:
    """Scan each effect at a contact over its range, from the initial states of the base model.

    Returns:
        The best value of each effect that explains a part of the discrepancy, the best effect
        first.
    """
    found = []
    for value in _list_effects_at_contacts(search):
        for width in SCAN_WIDTHS:
            value = _scan(search, value, width, base.fit.initial_states)
        found.append(value)
    if not found:
        return []
    unchanged = _scan(search, found[0]._replace(coefficient=0.0), 0.0, base.fit.initial_states)
    useful = [value for value in found if value.squares < MAX_SCAN_RATIO * unchanged.squares]
    return sorted(useful, key=lambda value: value.squares)[:MAX_TRIED_EFFECTS]


def find_lowest_scan(search: EffectSearch) -> float:
    """Return the lowest sum of squares of scans of all effects at contacts; infinite without any.

    The initial states are those that were estimated with the present model.
    """
    states, lowest = search.evaluator.initial_state_guesses, np.inf
    for value in _list_effects_at_contacts(search):
        for width in SCAN_WIDTHS:
            value = _scan(search, value, width, states)
        lowest = min(lowest, value.squares)
    return lowest


def _list_nearby_values(
    search: EffectSearch, value: _ScannedValue, distances: Array
) -> list[_ScannedValue]:
    """Return possible values at distances relative to the number of the model file."""
    ((low, high),) = compute_coefficient_bounds(search.evaluator, value.name)
    coefficients = np.clip(value.coefficient + value.unit * distances, low, high)
    return [value._replace(coefficient=float(c)) for c in coefficients]


def _scan(search: EffectSearch, value: _ScannedValue, width: float, states: Array) -> _ScannedValue:
    """Return the value that has the lowest sum of squares.

    Args:
        search: search with the base model.
        value: centre of the scan.
        width: half of the interval, relative to the number of the model file.
        states: (R, s) initial states.
    """
    evaluator, runs = search.evaluator, len(states)
    evaluator.search_control.check_not_stopped()
    distances = width * np.linspace(-1.0, 1.0, SCANNED_VALUES)
    values = _list_nearby_values(search, value, distances)
    theta = np.array([_add_effect(search, value) for value in values])
    simulated = evaluator.simulate(
        np.repeat(theta, runs, axis=0),
        np.tile(np.arange(runs), len(theta)),
        np.tile(states, (len(theta), 1)),
    )
    residual = simulated.reshape(len(theta), *evaluator.observed.shape) - evaluator.observed
    scaled = np.where(search.observed_mask, residual, 0.0) / search.noise.sigma
    squares = np.square(scaled).sum(axis=(1, 2, 3))
    squares = np.where(np.isfinite(squares), squares, np.inf)
    best = int(np.argmin(squares))
    return values[best]._replace(squares=float(squares[best]))


def _compute_log_likelihoods(search: EffectSearch, values: Sequence[_ScannedValue]) -> Array:
    """Return the log-likelihood (N,) of each value, summed over the runs."""
    evaluator = search.evaluator
    evaluator.search_control.check_not_stopped()
    runs = range(len(evaluator.prepared_runs))
    hypotheses = [
        Hypothesis(run, theta, COMPARED_FORCE_SHARE)
        for theta in (_add_effect(search, value) for value in values)
        for run in runs
    ]
    results = filter_hypotheses(evaluator, search.noise.sigma, hypotheses)
    found = np.array([result.log_likelihood for result in results])
    total: Array = found.reshape(len(values), len(runs)).sum(axis=1)
    return total


def _add_effect(search: EffectSearch, value: _ScannedValue) -> Array:
    """Return the parameters (P,) of the base model with an effect."""
    theta = search.base_model.fit.theta.copy()
    theta[search.evaluator.coefficient_slices[value.name]] = value.coefficient
    return theta
