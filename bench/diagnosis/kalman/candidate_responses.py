"""Responses of the innovations to every candidate effect, carried through the filter's recursion.

With gain K and whitener W of the filter (`bench.diagnosis.kalman.filter_and_smoother`), a unit of
candidate k, which adds b to states and ψ to readings (`dynamics.linearisation_about_recording`,
eqs. (3) and (4)), changes the predicted state by s and the whitened innovations by -w:

    u_i = ψ_i + H_i s_i,    w_i = W_i u_i,    s_{i+1} = A_i (s_i - K_i u_i) + b_i               (1)

so that the innovations are e = Σ_k c_k w_k + white noise, linear in the coefficients however large
they are, since the motion about which the model is linear is the measured one (L. Ljung, System
Identification, 2nd ed., 1999, chapter 3; K. J. Åström, Automatica 16, 551, 1980,
doi:10.1016/0005-1098(80)90078-3). Without the gain K, (1) gives the responses of simulated runs.

Shapes: R runs of T samples, C channels, K candidates, M columns, Z state components, E missing
forces and nu controls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.diagnosis.evaluation.candidate_direction import CandidateDirection
from bench.diagnosis.kalman.filter_and_smoother import (
    MAX_MAGNITUDE,
    IndexArray,
    add_noise_states,
)
from bench.diagnosis.kalman.linearised_filter import FollowedRuns, linearise_run
from sims.core.effect import Effect
from sims.core.simulator import Array
from sims.robot.dynamics.linearisation_about_recording import SingleArray
from sims.robot.dynamics.linearisation_about_simulation import compute_control_changes

COLUMNS_PER_BATCH = 256
"""Number of columns that pass through the filter together, so that they fit in the CPU cache."""


@dataclass(frozen=True)
class Columns:
    """Inputs that candidates add to the states and readings of R runs.

    Attributes:
        probes: the K candidates.
        column_indices: (K,) index of the column of each candidate, which those with the same effect
            share.
        sizes: (K,) scaling coefficient of each probe.
        pushed: (R, T - 1, E + nu, M) mean forces and controls of M columns between samples.
        readings: ψ (R, T, C, M).
    """

    probes: tuple[CandidateDirection, ...]
    column_indices: IndexArray
    sizes: Array
    pushed: SingleArray
    readings: SingleArray

    def joined(self, others: Columns) -> Columns:
        """Return the columns of these candidates, followed by those of others."""
        return Columns(
            self.probes + others.probes,
            np.concatenate([self.column_indices, others.column_indices + self.pushed.shape[3]]),
            np.concatenate([self.sizes, others.sizes]),
            np.concatenate([self.pushed, others.pushed], axis=3),
            np.concatenate([self.readings, others.readings], axis=3),
        )

    def subset(self, chosen: Sequence[int]) -> Columns:
        """Return some of the candidates, with the columns of all."""
        indices = list(chosen)
        probes = tuple(self.probes[i] for i in indices)
        return replace(
            self,
            probes=probes,
            column_indices=self.column_indices[indices],
            sizes=self.sizes[indices],
        )

    def total(self, chosen: Sequence[int], coefficients: Array) -> tuple[Array, Array]:
        """Return the sum of the inputs of the chosen candidates, each times its coefficient.

        Inputs are stored for a trial coefficient of each candidate (`sizes`), so they are divided
        by it.

        Args:
            chosen: (n,) indices of candidates.
            coefficients: (n,) coefficient of each chosen candidate.

        Returns:
            Missing forces and changes of the controls (R, T - 1, E + nu), and changes ψ of the
            readings (R, T, C), of R runs with T samples, E forces, nu controls and C channels.
        """
        columns = self.column_indices[list(chosen)]
        weights = coefficients / self.sizes[list(chosen)]
        return self.pushed[..., columns] @ weights, self.readings[..., columns] @ weights


def compute_columns(followed: FollowedRuns, probes: Sequence[CandidateDirection]) -> Columns:
    """Compute the inputs that candidates add to states and readings, once for equal candidates.

    Candidates with the same effect and coefficients share a column. So do an effect at all places
    (family) of which a single member acts, and this member alone. Columns with an infinite number
    are set to zero, so that they explain nothing.

    Args:
        followed: the runs, followed by the filter about whose motion the inputs are computed.
        probes: the candidates: effects with trial coefficients.
    """
    effects: list[tuple[Effect, Array]] = []
    column_by_key: dict[tuple[str, bytes], int] = {}
    column_indices = []
    for probe in probes:
        effect = followed.evaluator.available_effects[probe.effect]
        coefficients = probe.coefficients
        # Members of a family, each with its part of the coefficients.
        acting_members = [
            (member, part)
            for member, part in effect.parts(coefficients[:, None, None])
            if part.any()
        ]
        # The single acting member of a family has the same response as that effect alone.
        if len(acting_members) == 1:
            effect, part = acting_members[0]
            coefficients = part[:, 0, 0]
        key = effect.name, coefficients.tobytes()
        if key not in column_by_key:
            column_by_key[key] = len(effects)
            effects.append((effect, coefficients))
        column_indices.append(column_by_key[key])
    # Inputs to the states and to the readings, by run.
    run_count, samples, channels = followed.runs.residuals.shape
    inputs = followed.runs.inputs.shape[3]
    pushed = np.zeros((run_count, samples - 1, inputs, len(effects)), dtype=np.float32)
    readings = np.zeros((run_count, samples, channels, len(effects)), dtype=np.float32)
    changes = compute_control_changes(followed.linear, effects)
    for run, (linear, driven) in enumerate(zip(followed.linear, changes, strict=True)):
        predicted = followed.filtered.predicted[
            run, : linear.knots.size, : followed.runs.prior.size
        ]
        run_pushed, run_readings = linear.added(effects, np.nan_to_num(predicted), driven)
        pushed[run, : run_pushed.shape[0]] = run_pushed
        readings[run, : run_readings.shape[0]] = run_readings
    readings[~followed.runs.recorded] = 0.0
    is_finite = np.isfinite(pushed).all(axis=(0, 1, 2)) & np.isfinite(readings).all(axis=(0, 1, 2))
    pushed[..., ~is_finite], readings[..., ~is_finite] = 0.0, 0.0
    sizes = np.array(
        [1.0 if p.is_single_size else p.coefficients[p.coefficient_index] for p in probes]
    )
    return Columns(tuple(probes), np.array(column_indices, dtype=np.intp), sizes, pushed, readings)


def compute_responses(followed: FollowedRuns, columns: Columns) -> SingleArray:
    """Return how a unit of each candidate changes the whitened innovations of the filter.

    The forces, controls and readings that a candidate adds are propagated through the recursion of
    the filter, eq. (1) of the module docstring, with its gains.

    Args:
        followed: the R runs, followed by the filter.
        columns: inputs of the K candidates.

    Returns:
        Whitened responses (R, T, C, K) at T samples of C channels, in units of the candidates'
        coefficients.
    """
    inputs = followed.runs.inputs.astype(np.float32)
    whitened = _propagate_through_filter(followed, columns.pushed, columns.readings, inputs)
    sizes: SingleArray = columns.sizes.astype(np.float32)
    result = np.empty((*whitened.shape[:3], sizes.size), dtype=np.float32)
    # One run at a time, because the arrays of all runs together exceed the CPU cache.
    for run, values in enumerate(result):
        np.take(whitened[run], columns.column_indices, axis=2, out=values, mode="clip")
        with np.errstate(all="ignore"):
            values /= sizes
            # A candidate with a divergent motion gets a response of zero.
            values[~(np.abs(values) < MAX_MAGNITUDE)] = 0.0
    return result


def compute_parameter_responses(
    followed: FollowedRuns, indices: Sequence[int], sizes: Array
) -> SingleArray:
    """Return how a change of each parameter changes the whitened innovations of the filter.

    The model is linearised about the same motion, so that a change of a parameter changes the
    defects of the motion (by how much a step misses the next state) and the predicted readings.
    They pass through the filter as those of a candidate do, eq. (1) of the module docstring.
    Jacobians, gains and process noise stay the same.

    Args:
        followed: the R runs, followed by the filter.
        indices: indices of n parameters in theta.
        sizes: (n,) finite changes of the parameters.

    Returns:
        Minus the derivatives of the whitened innovations (R, T, C, n) by the parameters, at T
        samples of C channels.
    """
    run_count, samples, channels = followed.runs.residuals.shape
    pushed = np.zeros(
        (run_count, samples - 1, followed.runs.prior.size, len(indices)), dtype=np.float32
    )
    readings = np.zeros((run_count, samples, channels, len(indices)), dtype=np.float32)
    for column, (index, size) in enumerate(zip(indices, sizes.tolist(), strict=True)):
        followed.evaluator.search_control.check_not_stopped()
        theta = followed.theta.copy()
        theta[index] += size
        for run, linear in enumerate(followed.linear):
            displaced = linearise_run(
                *(followed.evaluator, theta, followed.noise, run, linear.trajectory, linear),
                reuses_loads=True,
            )
            defects, predicted = displaced.compute_changes(linear)
            with np.errstate(all="ignore"):
                pushed[run, : len(defects), :, column] = -defects / size
                readings[run, : len(predicted), :, column] = predicted / size
    readings[~followed.runs.recorded] = 0.0
    # A step in which the model diverges gives no information on the next one.
    for values in (pushed, readings):
        values[~(np.abs(values) < MAX_MAGNITUDE)] = 0.0
    return _propagate_through_filter(followed, pushed, readings)


def compute_step_error_response(followed: FollowedRuns) -> Array:
    """Return the whitened response (R, T, C) to the errors of the integrator's steps."""
    step_errors = followed.step_errors[..., None].astype(np.float32)
    no_readings = np.zeros((*followed.runs.residuals.shape, 1), dtype=np.float32)
    response: Array = _propagate_through_filter(followed, step_errors, no_readings)[..., 0].astype(
        np.float64
    )
    return response


def compute_sensitivities(
    followed: FollowedRuns, columns: Columns, dtype: type[np.floating] = np.float64
) -> Array:
    """Return the derivatives (R, T, C, K) of simulated readings by K candidate effects.

    A column is the response to an effect with a finite coefficient; divided by that coefficient
    (`columns.sizes`), it is the response to a unit. Simulated runs are not corrected by readings,
    so the gain of the filter is zero. Shapes: R runs, T samples, C channels.

    Args:
        followed: the runs, with their linearised models.
        columns: inputs of the candidates.
        dtype: type of the result.
    """
    run_count, _, _, count = columns.readings.shape
    result = np.zeros((*columns.readings.shape[:3], len(columns.probes)), dtype)
    for begin in range(0, count, COLUMNS_PER_BATCH):
        batch = slice(begin, min(begin + COLUMNS_PER_BATCH, count))
        changes = followed.propagate_without_gain(
            np.zeros((run_count, followed.runs.prior.size, batch.stop - begin)),
            columns.pushed[..., batch],
            columns.readings[..., batch],
        )
        # Candidates whose columns are in this batch.
        chosen = np.flatnonzero(
            (columns.column_indices >= begin) & (columns.column_indices < batch.stop)
        )
        with np.errstate(all="ignore"):
            result[..., chosen] = (
                changes[..., columns.column_indices[chosen] - begin] / columns.sizes[chosen]
            )
    return result


def _propagate_through_filter(
    followed: FollowedRuns,
    pushed: SingleArray,
    readings: SingleArray,
    inputs: SingleArray | None = None,
) -> SingleArray:
    """Propagate columns through the filter, and return the whitened responses (R, T, C, M).

    The recursion is s[i+1] = A (s[i] - K u[i]) + b[i] with u = H s + ψ, where s is the change of
    the predicted state and K the gain of the filter: part of a change of the state is corrected by
    the next reading. The whitened response is W u. It is eq. (1) of the module docstring, for all M
    columns in single precision, in batches that fit in the CPU cache.

    Args:
        followed: the R runs, followed by the filter, with matrices A, H, K and W.
        pushed: (R, T - 1, E + nu, M) forces and controls, or states if `inputs` is None.
        readings: ψ (R, T, C, M).
        inputs: (R, T - 1, Z, E + nu) matrices that map `pushed` to b.
    """
    coloured, _ = add_noise_states(followed.runs, followed.noise)
    run_count, samples, channels, count = readings.shape
    # Candidates act on the states of the robot, and not on those of coloured noise after them.
    size = followed.runs.prior.size
    responses = np.zeros((run_count, samples, channels, count), dtype=np.float32)
    h, a = coloured.readings.astype(np.float32), coloured.states.astype(np.float32)
    gains = followed.filtered.gains.astype(np.float32)
    whiteners = followed.filtered.whiteners.astype(np.float32)
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
