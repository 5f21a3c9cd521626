"""Base-model residuals and directions of the effects, shared by several diagnosers.

The base model is fitted to a recording. With y the recorded runs and y₀ those of the fitted base
model, the residual r = y - y₀ is to first order a sum of changes by parameters and initial states
(J) and by missing effects (D),

    r = J δ + D c + noise                                                                      (1)

The direction D of an effect is computed with the simulator (`search.candidate_directions`), so it
exists for effects of forces, inputs, sensors and impacts alike. A regression of accelerations
applies a linear operator to (1): the second derivative of a position, or the first derivative of a
rate, minus the effect of a displacement through the stiffness A and damping B of the motion,

    L r = r'' - A r - B r'                                                                     (2)

with derivatives by local polynomials (A. Savitzky, M. J. E. Golay, Anal. Chem. 36, 1627, 1964).
Both sides pass the same filter, so the filter causes no bias. Samples near an impact are excluded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.core.diagnoser import DiagnosisCase
from bench.diagnosis.evaluation.noise_floor import compute_noise_floor
from bench.diagnosis.evaluation.noise_model import Mask, NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.base_fit import BaseFit, fit_base_model
from bench.diagnosis.fitting.levenberg_marquardt import TrajectoryFit
from bench.diagnosis.search.candidate_directions import DirectionSet, compute_directions
from sims.core.simulator import Array
from sims.core.system import StateSnapshot

POLYNOMIAL_WINDOW_SECONDS = 0.2
"""Length of the window of a local polynomial, seconds."""
MIN_WINDOW_SAMPLES = 7
"""Minimum number of samples in the window of a local polynomial."""
POLYNOMIAL_DEGREE = 3
"""Degree of the local polynomials."""
FINITE_DIFFERENCE_STEP = 1e-5
"""Finite-difference step of a coordinate and of a rate for A and B in (2), SI units."""


@dataclass(frozen=True)
class EffectColumn:
    """Column of (1): all directions of an effect at one point of its parameter grid.

    Attributes:
        effect: name of the effect.
        places: indices of its directions among all directions.
    """

    effect: str
    places: tuple[int, ...]

    def select_directions(self, effects: Array) -> Array:
        """Return the directions of the column that are not zero, with length one, (N, D).

        Args:
            effects: all K directions with N rows each, (N, K); D of them belong to the column.
        """
        part = effects[:, list(self.places)]
        scale = np.sqrt(np.square(part).sum(axis=0))
        # Columns below 1e-9 are zero up to rounding, and cannot be normalised.
        directions: Array = part[:, scale > 1e-9] / scale[scale > 1e-9]
        return directions


@dataclass(frozen=True)
class RegressionData:
    """Equation (1) as a linear regression, with each row in units of its noise.

    Attributes:
        residual: residual, (N,).
        base: columns of parameters and initial states, (N, B).
        effects: columns of all directions, (N, K).
        run: index of the run of each row, (N,).
        state: time, channels of the base model and inputs, (N, F).
    """

    residual: Array
    base: Array
    effects: Array
    run: NDArray[np.intp]
    state: Array

    def select_runs(self, runs: Sequence[int]) -> RegressionData:
        """Select the rows of some runs."""
        is_selected = np.isin(self.run, list(runs))
        return RegressionData(*(getattr(self, field.name)[is_selected] for field in fields(self)))

    def project_out_base(self) -> tuple[Array, Array]:
        """Project out parameters and initial states: what they can explain is not evidence.

        Shapes: N rows (one per sample), K directions of effects.

        Returns:
            The residual (N,) and the effect columns (N, K), without the part that parameters and
            initial states can explain.
        """
        scale = np.sqrt(np.square(self.base).sum(axis=0))
        basis = self.base[:, scale > 0] / scale[scale > 0]
        orthonormal, triangle = np.linalg.qr(basis)
        # Parameters that depend linearly on others have no direction of their own.
        base_directions = orthonormal[:, np.abs(np.diag(triangle)) > 1e-10]
        residual: Array = self.residual - base_directions @ (base_directions.T @ self.residual)
        effects: Array = self.effects - base_directions @ (base_directions.T @ self.effects)
        return residual, effects


@dataclass(eq=False)
class RegressionEvidence:
    """Base model fitted to the recording of a case, and the directions of the effects.

    The directions of the effects are computed when they are first used.

    Attributes:
        evaluator: the runs for fitting, then the held-out runs, and the simulator.
        noise: noise of each channel, stated or estimated.
        base: fitted base model.
        fitted: indices of the runs for fitting.
        held_out: indices of the held-out runs.
        names: names of the effects.
    """

    evaluator: RunEvaluator
    noise: NoiseModel
    base: BaseFit
    fitted: range
    held_out: range
    names: tuple[str, ...]

    @classmethod
    def collect(cls, case: DiagnosisCase) -> RegressionEvidence:
        """Find the noise of each channel and fit the base model.

        Systems without an engine of their own are simulated by the batch engine.

        Args:
            case: task of a diagnoser: recording, simulator and effects, without the hidden causes.
        """
        recording = case.recording
        runs = [*recording.training(), *recording.held_out()]
        # The simulator of a robot uses the step that its model file states.
        engine = None if case.kind.own_engine else "batch"
        evaluator = RunEvaluator(case.kind, recording, runs, engine, candidates=list(case.library))
        noise = NoiseModel.make_white(compute_noise_floor(evaluator, recording).sigma)
        base, count = fit_base_model(evaluator, noise), len(recording.training())
        runs_for_fitting, held_out = range(count), range(count, len(runs))
        return cls(evaluator, noise, base, runs_for_fitting, held_out, tuple(evaluator.library))

    def close(self) -> None:
        """Release the resources of the engine."""
        self.evaluator.close()

    @cached_property
    def observed_mask(self) -> Mask:
        """Mask of the samples that are not missing, (R, T, C)."""
        return np.isfinite(self.evaluator.observed)

    @cached_property
    def residual(self) -> Array:
        """Observed minus simulated, (R, T, C); zero where a sample is missing."""
        difference = self.evaluator.observed - self.base.fit.simulated
        residual: Array = np.where(self.observed_mask, difference, 0.0)
        return residual

    @cached_property
    def sensitivity_directions(self) -> DirectionSet:
        """Directions of all effects."""
        return compute_directions(self.evaluator, self.base.fit, self.names)

    @cached_property
    def effect_columns(self) -> list[EffectColumn]:
        """Columns of all effects, one for each point of their parameter grids.

        A nonlinear parameter, such as a period, has a grid of values; the directions at one value,
        one for each linear coefficient, form one column.
        """
        # Indices of directions by effect, grid point and, for a direction of a fixed size, index.
        groups: dict[tuple[str, int, int], list[int]] = {}
        for i, probe in enumerate(self.sensitivity_directions.candidates):
            # A direction such as that of an end stop is valid only at the size at which it was
            # simulated. Such directions do not add up, so each is a column of its own; -1 is common
            # to all others.
            separate_index = i if probe.is_single_size else -1
            groups.setdefault((probe.effect, probe.grid_point, separate_index), []).append(i)
        return [EffectColumn(effect, tuple(indices)) for (effect, _, _), indices in groups.items()]

    def build_trajectory_regression(self) -> RegressionData:
        """Build the regression of the residual r on its causes, with one row per sample.

        To first order r = J delta + D c + noise (1), with the derivatives J by parameters and
        initial states, their changes delta, the directions D of the effects and their sizes c.

        Returns:
            r, J and D, with each row in units of its noise.
        """
        fit = self.base.fit
        runs, length, channels, _ = fit.jacobian.shape
        return self._flatten_to_rows(
            self.residual,
            self._compute_base_columns(),
            self.sensitivity_directions.responses,
            np.broadcast_to(self.noise.sigma, (runs, length, channels)),
            self.observed_mask,
        )

    def build_acceleration_regression(
        self, seconds: float = POLYNOMIAL_WINDOW_SECONDS
    ) -> RegressionData:
        """Build the regression of accelerations: the operator L of (2) applied to equation (1).

        Accelerations show forces at the moment at which they act, while trajectories integrate
        them. The operator L r = r'' - A r - B r' (2), with the stiffness A and damping B of the
        motion, is applied to both sides of r = J delta + D c + noise (1), with the derivatives J by
        parameters and initial states and the directions D of the effects.

        Args:
            seconds: window of the local polynomials.

        Returns:
            L r, L J and L D, with each row in units of its noise.
        """
        residual, sigma, is_observed = self._apply_residual_operator(
            self.residual[..., None], seconds
        )
        base, _, _ = self._apply_residual_operator(self._compute_base_columns(), seconds)
        effects, _, _ = self._apply_residual_operator(
            self.sensitivity_directions.responses, seconds
        )
        return self._flatten_to_rows(residual[..., 0], base, effects, sigma, is_observed)

    def _compute_base_columns(self) -> Array:
        """Return the columns of parameters and initial states in equation (1), (R, T, C, B)."""
        return compute_base_jacobian(self.evaluator, self.base.fit)

    def _flatten_to_rows(
        self, residual: Array, base: Array, effects: Array, sigma: Array, is_observed: Mask
    ) -> RegressionData:
        """Flatten arrays over runs, samples and channels into the rows of a regression.

        Each row is divided by its noise. Rows that are masked, or not finite because of an impact,
        are left out.

        Shapes: R runs, T samples, C channels, B parameters and initial states, K directions.

        Args:
            residual: residual, (R, T, C).
            base: columns of parameters and initial states, (R, T, C, B).
            effects: columns of all directions of effects, (R, T, C, K).
            sigma: standard deviation of the noise, (R, T, C).
            is_observed: mask of the samples to use, (R, T, C).

        Returns:
            The regression with N rows, ordered by run, sample and channel.
        """
        runs = np.broadcast_to(np.arange(len(residual))[:, None, None], is_observed.shape)
        is_complete = is_observed & np.isfinite(base).all(axis=3) & np.isfinite(effects).all(axis=3)
        scale = 1.0 / sigma[is_complete]
        states = self._compute_states()
        states = np.broadcast_to(states[:, :, None], (*is_observed.shape, states.shape[2]))
        return RegressionData(
            residual[is_complete] * scale,
            base[is_complete] * scale[:, None],
            effects[is_complete] * scale[:, None],
            runs[is_complete],
            states[is_complete],
        )

    def _compute_states(self) -> Array:
        """Return time since the start, simulated channels, and inputs: (R, T, F = 1 + C + inputs).

        They are the arguments of a discrepancy function, such as a Gaussian process. Samples after
        the end of a run, and inputs that a run does not have, are zero.

        Shapes: R runs, T samples, C channels.
        """
        evaluator = self.evaluator
        runs, length, channels = evaluator.observed.shape
        names = [channel.name for channel in evaluator.simulator.inputs]
        states = np.zeros((runs, length, 1 + channels + len(names)))
        for run_index, run_data in enumerate(evaluator.prepared_runs):
            size = int(evaluator.lengths[run_index])
            times, inputs = run_data.scenario.times, run_data.scenario.inputs
            states[run_index, :size, 0] = times - times[0]
            for i, name in enumerate(names):
                states[run_index, :size, 1 + channels + i] = inputs.get(name, np.zeros(size))
        states[..., 1 : 1 + channels] = np.nan_to_num(self.base.fit.simulated)
        return states

    def _apply_residual_operator(self, values: Array, seconds: float) -> tuple[Array, Array, Mask]:
        """Apply the operator L of equation (2) to trajectories: L r = r'' - A r - B r'.

        A displacement r changes the forces, by the stiffness A and the damping B of the motion.
        Subtracting this from the acceleration r'' yields the force that caused it. For a channel
        that is a rate (velocity), the first derivative replaces the second, and the term with A is
        omitted. Channels that are neither coordinates nor rates are not used.

        Shapes: R runs, T samples, C channels.

        Args:
            values: K sets of trajectories, such as the residual or the directions of effects,
                (R, T, C, K).
            seconds: window of the local polynomials.

        Returns:
            The filtered trajectories, the standard deviation of their noise (R, T, C), and the mask
            of the samples to use (R, T, C).
        """
        from scipy.signal import savgol_coeffs

        evaluator, system = self.evaluator, self.evaluator.simulator.system
        runs, length, channels, _ = values.shape
        # Unused channels stay NaN, with sigma 1 and a mask of False.
        filtered_runs = np.full_like(values, np.nan)
        sigma = np.ones((runs, length, channels))
        is_used = np.zeros((runs, length, channels), dtype=bool)
        coordinate_by_rate = dict(zip(system.rates, system.coordinates, strict=False))
        for run_index, run_data in enumerate(evaluator.prepared_runs):
            size = int(evaluator.lengths[run_index])
            step = float(np.median(np.diff(run_data.scenario.times)))
            # Number of samples of the window, at most half of a short run.
            window = _round_down_to_odd(
                min(max(MIN_WINDOW_SAMPLES, round(seconds / step)), size // 2)
            )
            stiffness, damping = self._linearise(run_index)
            for channel_index, name in enumerate(evaluator.channels):
                is_rate = name in coordinate_by_rate
                if not is_rate and name not in system.coordinates:
                    continue
                coordinate = system.coordinates.index(coordinate_by_rate.get(name, name))
                filtered_runs[run_index, :size, channel_index] = _compute_residual_force(
                    values[run_index, :size, channel_index],
                    is_rate,
                    stiffness[:size, coordinate, None],
                    damping[:size, coordinate, None],
                    window,
                    step,
                )
                # White noise through a filter: its variance is multiplied by the sum of the squared
                # weights. The noise of the smaller terms with A and B is neglected.
                order = 1 if is_rate else 2
                weights = savgol_coeffs(window, POLYNOMIAL_DEGREE, deriv=order, delta=step)
                sigma[run_index, :size, channel_index] = self.noise.sigma[channel_index] * np.sqrt(
                    np.square(weights).sum()
                )
                is_used[run_index, :size, channel_index] = self._find_smooth_samples(
                    run_index, size, window
                )
        return filtered_runs, sigma, is_used & self.observed_mask

    def _find_smooth_samples(self, run: int, size: int, window: int) -> Mask:
        """Return a mask (T,) of the samples whose window has no impact and no end of the run.

        An impact is a minimum of the height in the simulated or in the observed path. A polynomial
        over an impact would be wrong, because the velocity jumps there.

        Args:
            run: index of the run.
            size: number of samples of the run.
            window: number of samples of the window of the local polynomials.
        """
        is_smooth = np.ones(size, dtype=bool)
        half_window = window // 2
        is_smooth[:half_window] = is_smooth[size - half_window :] = False
        system = self.evaluator.simulator.system
        # The last coordinate of a system that bounces is its height.
        name = system.coordinates[-1] if system.bounces else ""
        if name in self.evaluator.channels:
            channel_index = self.evaluator.channels.index(name)
            simulated = self.base.fit.simulated[run, :size, channel_index]
            for path in (simulated, self.evaluator.observed[run, :size, channel_index]):
                lowest = np.flatnonzero((path[1:-1] < path[:-2]) & (path[1:-1] <= path[2:])) + 1
                for impact in lowest[path[lowest] < _IMPACT_HEIGHT]:
                    is_smooth[max(0, impact - half_window - 1) : impact + half_window + 2] = False
        return is_smooth

    def _linearise(self, run: int) -> tuple[Array, Array]:
        """Compute A and B of L r = r'' - A r - B r' (2), each (T, D), by finite differences.

        They are the derivatives of the base model's acceleration by the coordinate and by its rate
        (stiffness and damping, per mass), along the fitted motion with T samples and D coordinates.
        They are zero for systems of several coordinates (D > 1), and if the coordinate is not
        recorded.

        Args:
            run: index of the run.
        """
        evaluator, system = self.evaluator, self.evaluator.simulator.system
        run_data = evaluator.prepared_runs[run]
        size, dimensions = int(evaluator.lengths[run]), len(system.coordinates)
        zeros = np.zeros((size, dimensions))
        if dimensions != 1:
            return zeros, zeros
        times = run_data.scenario.times
        name = system.coordinates[0]
        if name not in evaluator.channels:
            return zeros, zeros
        # Position and velocity of the fitted motion, (T, 1).
        x = self.base.fit.simulated[run, :size, evaluator.channels.index(name)][:, None]
        v = np.gradient(x[:, 0], times)[:, None]
        # Constants of the simulator are replaced by those of the recording, then of the run.
        values = {constant.name: constant.value for constant in evaluator.kind.constants}
        values |= {**evaluator.simulator.constant_values, **run_data.scenario.constants}
        constants = {key: np.full((size, 1), float(value)) for key, value in values.items()}
        theta = np.tile(self.base.fit.theta[: evaluator.system_parameter_count], (size, 1))
        inputs = {
            channel.name: np.asarray(run_data.scenario.inputs.get(channel.name, np.zeros(size)))[
                :size, None
            ]
            for channel in evaluator.simulator.inputs
        }
        elapsed = (times - times[0])[:, None]

        def compute_acceleration(x: Array, v: Array) -> Array:
            """Return the base model's acceleration (T, D) at positions x and velocities v."""
            moment = StateSnapshot(system(), theta, constants, elapsed, x, v, inputs)
            force: Array = moment.system.force(moment) / moment.inertia
            return force

        step, base_acceleration = FINITE_DIFFERENCE_STEP, compute_acceleration(x, v)
        stiffness = (compute_acceleration(x + step, v) - base_acceleration) / step
        damping = (compute_acceleration(x, v + step) - base_acceleration) / step
        return stiffness, damping


_IMPACT_HEIGHT = 1.0
"""Height in metres below which a minimum of the last coordinate counts as an impact."""


def _compute_residual_force(
    values: Array, is_rate: bool, stiffness: Array, damping: Array, window: int, step: float
) -> Array:
    """Compute L r = r'' - A r - B r' (2) for trajectories r of one channel by local polynomials.

    For a channel that is a rate, r' is recorded in place of r: its first derivative replaces r'',
    and the term with A is omitted.

    Args:
        values: K trajectories of the channel, (T, K).
        is_rate: whether the channel is a rate (velocity) and not a coordinate.
        stiffness: A, (T, 1).
        damping: B, (T, 1).
        window: number of samples of the window of the polynomials.
        step: sampling interval, s.

    Returns:
        L r, (T, K): the acceleration that no displacement explains, m/s^2 or rad/s^2.
    """
    from scipy.signal import savgol_filter

    def differentiate(order: int) -> Array:
        """Return a derivative (T, K) of the trajectories; for order 0 the smoothed values."""
        filtered: Array = savgol_filter(
            values, window, POLYNOMIAL_DEGREE, deriv=order, delta=step, axis=0
        )
        return filtered

    if is_rate:
        return differentiate(1) - damping * differentiate(0)
    return differentiate(2) - stiffness * differentiate(0) - damping * differentiate(1)


def _round_down_to_odd(samples: int) -> int:
    """Return the next lower odd number of samples, but enough for the local polynomials."""
    return max(samples - 1 + samples % 2, POLYNOMIAL_DEGREE + 2)


def compute_base_jacobian(evaluator: RunEvaluator, fit: TrajectoryFit) -> Array:
    """Compute the columns of a fit's parameters and of each run's own initial states.

    A parameter affects all runs. An unknown initial state affects its own run only, so its column
    is zero in the other runs.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        fit: a fitted model with its Jacobian.

    Returns:
        Columns, (R, T, C, q + n), for q free parameters and n unknown initial states of all runs.
    """
    from scipy.linalg import block_diag

    # The last axis of the Jacobian has the parameters, then the initial states of the run itself.
    parameters, states = np.split(fit.jacobian, [fit.free_indices.size], axis=3)
    runs, length, channels, state_count = states.shape
    # One block of rows and columns per run: a state of one run does not change another run.
    own_columns = block_diag(*states.reshape(runs, length * channels, state_count))
    unknown = ~evaluator.known_state_mask.ravel()
    state_columns = own_columns[:, unknown].reshape(runs, length, channels, int(unknown.sum()))
    return np.concatenate([parameters, state_columns], axis=3)


def compute_block_means(values: Array, count: int) -> Array:
    """Compute the means of consecutive blocks (count,), as neighbouring samples are correlated.

    Args:
        values: values of N samples, (N,).
        count: number of blocks, which differ by at most one sample in length.
    """
    edges = np.linspace(0, len(values), count + 1).astype(int)
    return np.array([values[start:end].mean() for start, end in pairwise(edges.tolist())])


def compute_standard_error(values: Array) -> float:
    """Compute the standard error of the mean of independent values."""
    return float(values.std(ddof=1) / np.sqrt(len(values)))


class StrongestColumn(NamedTuple):
    """Column of an effect that explains most of the residual.

    Attributes:
        gain: decrease of the sum of squares by a least-squares fit of its directions.
        column: the column.
    """

    gain: float
    column: EffectColumn


def find_strongest_columns(
    residual: Array, effects: Array, columns: Sequence[EffectColumn]
) -> dict[str, StrongestColumn]:
    """Find for each effect the column that explains most of the residual.

    With the directions A of a column and b = A^T r for the residual r, a least-squares fit of the
    column decreases the sum of squares by b^T (A^T A)^-1 b.

    Args:
        residual: N values after the part that parameters explain is projected out, (N,).
        effects: K directions of all effects after the same projection, (N, K).
        columns: columns of the effects; each is one or several of these directions.

    Returns:
        By effect; an effect without a direction that differs from zero is left out.
    """
    best: dict[str, StrongestColumn] = {}
    for column in columns:
        part = column.select_directions(effects)
        if not part.size:
            continue
        # The small diagonal keeps the matrix invertible if two directions are parallel.
        normal_matrix = part.T @ part + 1e-9 * np.eye(part.shape[1])
        projected_residual = part.T @ residual
        gain = float(projected_residual @ np.linalg.solve(normal_matrix, projected_residual))
        if column.effect not in best or gain > best[column.effect].gain:
            best[column.effect] = StrongestColumn(gain, column)
    return best
