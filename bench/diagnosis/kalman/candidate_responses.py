"""Responses of the innovations to every candidate effect, carried through the filter's recursion.

With gain K and whitener W of the filter (`bench.diagnosis.kalman.kalman_recursions`), a unit of
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

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from bench.diagnosis.fitting.trajectory_derivatives import CandidateDirection
from bench.diagnosis.kalman.kalman_recursions import (
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
class SparseSignals:
    """Signals of M columns, stored only where they are not zero.

    An effect at one joint of seven acts on one force of seven, and few effects change a reading, so
    a library would take about twenty times the memory otherwise.

    Attributes:
        values: (R, T, n) the n signals that are not zero.
        rows: (n,) index of the force, control or reading that each signal changes.
        columns: (n,) index of the column of each signal, in ascending order.
        shape: number of rows, and number M of columns.
    """

    values: SingleArray
    rows: IndexArray
    columns: IndexArray
    shape: tuple[int, int]

    @classmethod
    def from_dense(cls, dense: SingleArray) -> SparseSignals:
        """Take the signals of all rows and columns (R, T, E, M), most of which are zero."""
        columns, rows = np.nonzero(dense.any(axis=(0, 1)).T)
        return cls(dense[:, :, rows, columns], rows, columns, (dense.shape[2], dense.shape[3]))

    @classmethod
    def join(cls, parts: Sequence[SparseSignals]) -> SparseSignals:
        """Return the columns of all parts, one part after another."""
        # Index of the first column of each part, and the number of all columns.
        *first_columns, count = np.cumsum([0, *(part.shape[1] for part in parts)]).tolist()
        columns = [part.columns + first for part, first in zip(parts, first_columns, strict=True)]
        return cls(
            np.concatenate([part.values for part in parts], axis=2),
            np.concatenate([part.rows for part in parts]),
            np.concatenate(columns),
            (parts[0].shape[0], count),
        )

    def expand(self, begin: int, end: int) -> SingleArray:
        """Return the signals (R, T, E, end - begin) of consecutive columns, zeros included."""
        # The signals of these columns are consecutive, because columns are in ascending order.
        first, last = np.searchsorted(self.columns, [begin, end])
        dense = np.zeros((*self.values.shape[:2], self.shape[0], end - begin), dtype=np.float32)
        stored = slice(first, last)
        dense[:, :, self.rows[stored], self.columns[stored] - begin] = self.values[..., stored]
        return dense

    def total(self, columns: IndexArray, weights: Array) -> Array:
        """Return the weighted sum (R, T, E) of n columns, with R runs, T samples and E rows.

        Args:
            columns: (n,) indices of columns, which may occur several times.
            weights: (n,) their weights.
        """
        weight_by_column = np.zeros(self.shape[1])
        np.add.at(weight_by_column, columns, weights)
        stored = np.flatnonzero(weight_by_column[self.columns])
        # Signal of one row each, as a matrix that adds the signals of the same row.
        to_rows = np.zeros((stored.size, self.shape[0]))
        to_rows[np.arange(stored.size), self.rows[stored]] = weight_by_column[self.columns[stored]]
        result: Array = self.values[..., stored] @ to_rows
        return result


@dataclass(frozen=True)
class Columns:
    """Inputs that candidates add to the states and readings of R runs.

    Attributes:
        probes: the K candidates.
        column_indices: (K,) index of the column of each candidate, which those with the same effect
            share.
        sizes: (K,) scaling coefficient of each probe.
        inputs: mean forces and controls (R, T - 1, E + nu) of M columns between samples.
        readings: ψ (R, T, C) of M columns.
    """

    probes: tuple[CandidateDirection, ...]
    column_indices: IndexArray
    sizes: Array
    inputs: SparseSignals
    readings: SparseSignals

    def joined(self, others: Columns) -> Columns:
        """Return the columns of these candidates, followed by those of others."""
        # The columns of the others follow the present ones.
        _, column_count = self.inputs.shape
        return Columns(
            self.probes + others.probes,
            np.concatenate([self.column_indices, others.column_indices + column_count]),
            np.concatenate([self.sizes, others.sizes]),
            SparseSignals.join([self.inputs, others.inputs]),
            SparseSignals.join([self.readings, others.readings]),
        )

    def iterate_batches(self) -> Iterator[ColumnBatch]:
        """Iterate over the columns of the candidates, in batches that fit in the CPU cache.

        Several candidates may share a column. Each batch has consecutive columns, and the
        candidates that have one of them. Batches without candidates are left out.
        """
        _, count = self.inputs.shape
        for begin in range(0, count, COLUMNS_PER_BATCH):
            end = min(begin + COLUMNS_PER_BATCH, count)
            candidates = np.flatnonzero(
                (self.column_indices >= begin) & (self.column_indices < end)
            )
            if candidates.size:
                yield ColumnBatch(
                    candidates,
                    self.column_indices[candidates] - begin,
                    self.inputs.expand(begin, end),
                    self.readings.expand(begin, end),
                )

    def subset(self, chosen: Sequence[int]) -> Columns:
        """Return some of the candidates; the columns of all are kept, so that indices stay valid.

        Args:
            chosen: indices of these candidates.
        """
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
            coefficients: (n,) scaling coefficient of each chosen candidate.

        Returns:
            Missing forces and changes of the controls (R, T - 1, E + nu), and changes ψ of the
            readings (R, T, C), of R runs with T samples, E forces, nu controls and C channels.
        """
        columns = self.column_indices[list(chosen)]
        weights = coefficients / self.sizes[list(chosen)]
        return self.inputs.total(columns, weights), self.readings.total(columns, weights)


class ColumnBatch(NamedTuple):
    """Consecutive columns.

    Attributes:
        candidates: indices of the candidates that have one of these columns.
        columns: index, among these columns, of the column of each of the candidates.
        inputs: (R, T - 1, E + nu, m) mean forces and controls of m columns.
        readings: ψ (R, T, C, m).
    """

    candidates: IndexArray
    columns: IndexArray
    inputs: SingleArray
    readings: SingleArray


def compute_columns(followed: FollowedRuns, probes: Sequence[CandidateDirection]) -> Columns:
    """Compute the inputs that candidates add to states and readings, once for equal candidates.

    A column has the forces, controls and changes of readings that an effect with its trial
    coefficients adds to the runs. Candidates with the same effect and coefficients share a column.
    So do an effect at all places (family) of which a single member acts, and this member alone.
    Columns with an infinite number are set to zero, so that they explain nothing.

    Args:
        followed: the runs, followed by the filter about whose motion the inputs are computed.
        probes: the candidates: effects with trial coefficients.

    Returns:
        The columns, and for each candidate the index of its column and the trial value of its
        scaling coefficient, by which its response is divided later.
    """
    # The effect of each column, with its coefficients.
    effects: list[tuple[Effect, Array]] = []
    column_by_key: dict[tuple[str, bytes], int] = {}
    column_indices = []
    for probe in probes:
        effect = followed.evaluator.available_effects[probe.effect]
        coefficients = probe.coefficients
        # Members of a family, each with its part of the coefficients (K, L, 1) of one batch element
        # (L = 1); other effects are their own only part.
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
    # Dense inputs of all columns together would need too much memory.
    batches = [
        _compute_inputs(followed, effects[begin : begin + COLUMNS_PER_BATCH])
        # An empty batch if there are no effects.
        for begin in range(0, max(len(effects), 1), COLUMNS_PER_BATCH)
    ]
    inputs, readings = (SparseSignals.join(parts) for parts in zip(*batches, strict=True))
    # The response to a candidate that is valid at one size only, such as an end stop, is not
    # proportional to its coefficient, so it is not divided by it.
    sizes = np.array(
        [1.0 if p.is_single_size else p.coefficients[p.coefficient_index] for p in probes]
    )
    return Columns(tuple(probes), np.array(column_indices, dtype=np.intp), sizes, inputs, readings)


def _compute_inputs(
    followed: FollowedRuns, effects: Sequence[tuple[Effect, Array]]
) -> tuple[SparseSignals, SparseSignals]:
    """Compute the inputs that effects add to the states and to the readings.

    Inputs are the forces and controls that an effect adds to the motion that the filter predicts.
    Those of an effect with a value that is not finite are all zero.

    Args:
        followed: the runs, followed by the filter about whose motion the inputs are computed.
        effects: m effects with their coefficients; each has one column.

    Returns:
        Mean forces and controls (R, T - 1, E + nu, m) between samples, and direct changes
        (R, T, C, m) of the readings: R runs, T samples, E forces, nu controls, C channels.
    """
    run_count, samples, channels = followed.runs.residuals.shape
    input_count = followed.runs.inputs.shape[3]
    inputs = np.zeros((run_count, samples - 1, input_count, len(effects)), dtype=np.float32)
    readings = np.zeros((run_count, samples, channels, len(effects)), dtype=np.float32)
    control_changes = compute_control_changes(followed.linear, effects)
    for run, (linear, changes) in enumerate(zip(followed.linear, control_changes, strict=True)):
        # Predicted deviations from the motion, without padding after the end of the run, and
        # without states of coloured noise.
        predicted = followed.filtered.predicted[
            run, : linear.knots.size, : followed.runs.prior.size
        ]
        run_inputs, run_readings = linear.added(effects, np.nan_to_num(predicted), changes)
        inputs[run, : run_inputs.shape[0]] = run_inputs
        readings[run, : run_readings.shape[0]] = run_readings
    readings[~followed.runs.recorded] = 0.0
    # Mask (m,) of the effects.
    is_finite = np.isfinite(inputs).all(axis=(0, 1, 2)) & np.isfinite(readings).all(axis=(0, 1, 2))
    inputs[..., ~is_finite], readings[..., ~is_finite] = 0.0, 0.0
    return SparseSignals.from_dense(inputs), SparseSignals.from_dense(readings)


def compute_responses(followed: FollowedRuns, columns: Columns, responses: SingleArray) -> None:
    """Compute how a unit of each candidate changes the whitened innovations of the filter.

    A whitened innovation is the difference between a reading and its prediction by the filter, in
    units of its standard deviation and uncorrelated with the others. The response is what a unit of
    the candidate, if it acts on the robot, adds to the innovations of this filter, whose model
    lacks it. The forces, controls and readings that the candidate adds are propagated through the
    recursion of the filter, eq. (1) of the module docstring, with its gains.

    Args:
        followed: the R runs, followed by the filter.
        columns: inputs of the K candidates.
        responses: array for the whitened responses (R, T, C, K) at T samples of C channels, in
            units of the candidates' coefficients; it is overwritten.
    """
    recursion = _FilterRecursion.of(followed)
    # Responses of the states to unit forces and controls.
    input_matrices = followed.runs.inputs.astype(np.float32)
    for batch in columns.iterate_batches():
        # Slices of consecutive candidates are written several times faster than single ones. So the
        # candidates of the batch are split where their indices are not consecutive.
        breaks = np.flatnonzero(np.diff(batch.candidates) != 1) + 1
        parts = np.split(np.arange(batch.candidates.size), breaks)
        with np.errstate(all="ignore"):
            whitened = recursion.propagate(input_matrices @ batch.inputs, batch.readings)
            # One run at a time, because the arrays of all runs together exceed the CPU cache.
            for run, values in enumerate(whitened):
                # Candidates that share a column have the same response, up to their trial size. All
                # indices are valid, so that none is clipped.
                scaled = np.take(values, batch.columns, axis=2, mode="clip")
                scaled /= columns.sizes[batch.candidates].astype(np.float32)
                # A candidate with a divergent motion gets a response of zero, also for NaN.
                scaled[~(np.abs(scaled) < MAX_MAGNITUDE)] = 0.0
                for part in parts:
                    first, last = batch.candidates[part[[0, -1]]]
                    responses[run, ..., first : last + 1] = scaled[..., part[0] : part[-1] + 1]


def compute_parameter_responses(
    followed: FollowedRuns, indices: Sequence[int], sizes: Array
) -> SingleArray:
    """Return how a change of each parameter changes the whitened innovations of the filter.

    The model is linearised about the same motion, so that a change of a parameter changes the
    defects (the difference between the motion and the model's own steps) and the predicted
    readings. These changes pass through the filter as those of a candidate do, eq. (1) of the
    module docstring. Jacobians, gains and process noise stay the same.

    Args:
        followed: the R runs, followed by the filter.
        indices: indices of n parameters in theta.
        sizes: (n,) finite changes of the parameters.

    Returns:
        Minus the derivatives of the whitened innovations (R, T, C, n) by the parameters, at T
        samples of C channels.
    """
    run_count, samples, channels = followed.runs.residuals.shape
    changes = np.zeros(
        (run_count, samples - 1, followed.runs.prior.size, len(indices)), dtype=np.float32
    )
    readings = np.zeros((run_count, samples, channels, len(indices)), dtype=np.float32)
    for column, (index, size) in enumerate(zip(indices, sizes.tolist(), strict=True)):
        followed.evaluator.search_control.check_not_stopped()
        theta = followed.theta.copy()
        theta[index] += size
        for run, linear in enumerate(followed.linear):
            displaced = linearise_run(
                followed.evaluator,
                theta,
                followed.noise,
                run,
                trajectory=linear.trajectory,
                neighbour=linear,
                reuses_loads=True,
            )
            defect_changes, reading_changes = displaced.compute_changes(linear)
            with np.errstate(all="ignore"):
                # Defects are subtracted from the predicted states, hence the sign.
                changes[run, : len(defect_changes), :, column] = -defect_changes / size
                readings[run, : len(reading_changes), :, column] = reading_changes / size
    readings[~followed.runs.recorded] = 0.0
    # A step in which the model diverges gives no information on the next one.
    for values in (changes, readings):
        values[~(np.abs(values) < MAX_MAGNITUDE)] = 0.0
    return _FilterRecursion.of(followed).propagate(changes, readings)


def compute_step_error_response(followed: FollowedRuns) -> Array:
    """Return the whitened response (R, T, C) to the errors of the integrator's steps."""
    step_errors = followed.step_errors[..., None].astype(np.float32)
    no_readings = np.zeros((*followed.runs.residuals.shape, 1), dtype=np.float32)
    recursion = _FilterRecursion.of(followed)
    response: Array = recursion.propagate(step_errors, no_readings)[..., 0].astype(np.float64)
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
        columns: inputs of the K candidates; several candidates may share a column.
        dtype: type of the result.
    """
    run_count, samples, channels = followed.runs.residuals.shape
    result = np.zeros((run_count, samples, channels, len(columns.probes)), dtype)
    for batch in columns.iterate_batches():
        # The first states do not change.
        no_changes = np.zeros((run_count, followed.runs.prior.size, batch.inputs.shape[3]))
        changes = followed.propagate_without_gain(no_changes, batch.inputs, batch.readings)
        with np.errstate(all="ignore"):
            result[..., batch.candidates] = (
                changes[..., batch.columns] / columns.sizes[batch.candidates]
            )
    return result


class _FilterRecursion(NamedTuple):
    """Matrices of the recursion of a filter, in single precision.

    Attributes:
        states, readings, gains, whiteners: A, H, K and W of each run and sample.
        size: number of states of the robot, before those of coloured noise.
    """

    states: SingleArray
    readings: SingleArray
    gains: SingleArray
    whiteners: SingleArray
    size: int

    @classmethod
    def of(cls, followed: FollowedRuns) -> _FilterRecursion:
        """Return the recursion of the filter of the R runs, with states for coloured noise."""
        coloured, _ = add_noise_states(followed.runs, followed.noise)
        return cls(
            coloured.states.astype(np.float32),
            coloured.readings.astype(np.float32),
            followed.filtered.gains.astype(np.float32),
            followed.filtered.whiteners.astype(np.float32),
            followed.runs.prior.size,
        )

    def propagate(self, changes: SingleArray, readings: SingleArray) -> SingleArray:
        """Propagate columns through the filter, and return the whitened responses (R, T, C, m).

        The recursion is s[i+1] = A (s[i] - K u[i]) + b[i] with u = H s + ψ, where s is the change
        of the predicted state, A the transition and H the observation matrix, and K the gain of the
        filter: part of a change of the state is corrected by the next reading. The whitened
        response is W u. It is eq. (1) of the module docstring, for all m columns in single
        precision. Responses that diverge become zero.

        Shapes: R runs, T samples, C channels, Z states of the robot.

        Args:
            changes: b (R, T - 1, Z, m), which each column adds to the states of the robot.
            readings: ψ (R, T, C, m), which each column adds to the readings.
        """
        samples = readings.shape[1]
        responses = np.zeros_like(readings)
        # With further states for coloured noise.
        s = np.zeros((len(readings), self.states.shape[2], readings.shape[3]), dtype=np.float32)
        with np.errstate(all="ignore"):
            for i in range(samples):
                u = self.readings[:, i] @ s
                u += readings[:, i]
                np.matmul(self.whiteners[:, i], u, out=responses[:, i])
                if i + 1 < samples:
                    s -= self.gains[:, i] @ u
                    s = self.states[:, i] @ s
                    # Candidates act on the states of the robot, not on those of coloured noise.
                    s[:, : self.size] += changes[:, i]
        responses[~np.isfinite(responses)] = 0.0
        return responses
