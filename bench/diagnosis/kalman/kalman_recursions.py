"""Kalman filter and smoother about a measured motion, with process noise by maximum likelihood.

All runs are filtered side by side. With δ the deviation of the state from the motion about which
the model is linear (`dynamics.linearisation_about_recording`, eqs. (3) and (4)), and r[i] = y[i] -
h(x̄[i]),

    δ-[i+1] = A_i δ[i] - d_i,        P-[i+1] = A_i P[i] A_iᵀ + G_i Q G_iᵀ + J_i                (1)
    e[i] = r[i] - H_i δ-[i],         S_i = H_i P- H_iᵀ + R,     K_i = P- H_iᵀ S_i⁻¹            (2)
    δ[i] = δ- + K_i e[i],            P[i] = P- - K_i S_i K_iᵀ                                  (3)
    log L = - Σ_i (log det S_i + e_iᵀ S_i⁻¹ e_i) / 2                                           (4)

with Q the variances of missing forces and J_i those of jumps (`dynamics.servo_force_limits`; R. E.
Kalman 1960, doi:10.1115/1.3662552; F. C. Schweppe 1965, doi:10.1109/TIT.1965.1053737). The smoother
is that of Bryson and Frazier in its modified form (G. J. Bierman, Automatica 9, 503, 1973,
doi:10.1016/0005-1098(73)90076-9): backward, with C_i = I - K_i H_i,

    λ_i = C_iᵀ A_iᵀ λ_{i+1} - H_iᵀ S_i⁻¹ e_i
    Λ_i = C_iᵀ A_iᵀ Λ_{i+1} A_i C_i + H_iᵀ S_i⁻¹ H_i                                            (5)
    δ[i|T] = δ-[i] - P-[i] λ_i,                 f[i|T] = - Q G_iᵀ λ_{i+1}                        (6)

The likelihood is stationary in the variance q_j of the force that is missing at coordinate j where
Σ_i (G_iᵀ λ_{i+1})_j² = Σ_i (G_iᵀ Λ_{i+1} G_i)_jj (S. J. Koopman, N. Shephard, J. R. Stat. Soc. B
54(1), 135, 1992), which the iteration

    q_j ← q_j Σ_i (G_iᵀ λ_{i+1})_j² / Σ_i (G_iᵀ Λ_{i+1} G_i)_jj                                  (7)

solves. Sensor noise is white, or AR(1): then it is a state of its own (A. C. Harvey, Forecasting,
Structural Time Series Models and the Kalman Filter, 1989, section 3.4).

Matrices of a few joints are too small for one library call each: a step in Python takes fifty
microseconds whatever their size. So the recursions over the samples (`run_filter`, `run_smoother`)
are compiled once (`compiled_functions`), and allocate no memory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.diagnosis.evaluation.noise_model import Mask, NoiseModel
from sims.core.simulator import Array
from sims.engines.compiled.compiled_functions import CompiledFunctions
from sims.robot.dynamics.linearisation_about_recording import IntervalMaps

IndexArray = NDArray[np.intp]

AR_FLOOR = 1e-3
"""White part of AR(1) noise, as a share of its variance, so that no reading is exact."""
NEGLIGIBLE_SHARE = 1e-9
"""Share of the largest entry of a row or column of a matrix below which an entry is rounding error.

MuJoCo's solver couples joints of different limbs by its tolerance, which their derivatives contain.
"""
MAX_MAGNITUDE = 1e12
"""Maximum magnitude of derivatives and defects; larger ones come from divergence.

They are replaced by zero.
"""
LARGEST_COVARIANCE = 1e8
"""Maximum variance of predicted states, in SI units squared."""
LARGEST_LOSS = 1e30
"""Maximum negative log-likelihood of a model that does not diverge."""
STACKED = ("states", "defects", "forces", "inputs", "readings", "jumps")
"""Arrays of the linear models of single runs that are stacked as they are."""

SEGMENT_SAMPLES = 80
"""Number of samples of a segment on which the process noise is fitted."""
MAX_ITERATIONS = 12
"""Maximum number of iterations of (7)."""
CONVERGENCE_TOLERANCE = 0.15
"""Maximum relative change of the standard deviations at which (7) has converged."""
MIN_ITERATION_GAIN = 0.3
"""Minimum change of the log-likelihood by an iteration of (7) for which another one follows.

The variance of a force that is not missing tends to zero ever more slowly, which gains nothing.
"""
LARGEST_CHANGE = 10.0
"""Largest factor by which an iteration of (7) changes a standard deviation."""
SMALLEST_FORCE = 1e-6
"""Minimum standard deviation of a missing force, as a share of the typical force."""


class IndependentPart(NamedTuple):
    """States, channels and forces that do not depend on those of other parts, such as a limb.

    Attributes:
        states: indices of its states.
        channels: indices of the channels that measure them.
        forces: indices of the missing forces that act on them.
        runs: linear models of all runs with these alone.
    """

    states: IndexArray
    channels: IndexArray
    forces: IndexArray
    runs: LinearRuns


@dataclass(frozen=True)
class LinearRuns:
    """Linear models of R runs, padded to T samples.

    Attributes:
        states: A (R, T - 1, Z, Z).
        defects: d (R, T - 1, Z).
        forces: G (R, T - 1, Z, E).
        inputs: (R, T - 1, Z, E + nu) response of the states to forces and controls.
        readings: H (R, T, C, Z).
        residuals: r (R, T, C), zero where nothing was recorded.
        recorded: (R, T, C) mask of recorded samples.
        prior: (Z,) standard deviations of the first states.
        jumps: (R, T - 1, Z) standard deviations of further process noise of each state.
    """

    states: Array
    defects: Array
    forces: Array
    inputs: Array
    readings: Array
    residuals: Array
    recorded: Mask
    prior: Array
    jumps: Array

    def subset(self, chosen: IndexArray) -> LinearRuns:
        """Return some of the runs."""
        return self._map_arrays(lambda values: values[chosen])

    @cached_property
    def independent_parts(self) -> list[IndependentPart]:
        """Parts of the model that are filtered by themselves; one part if all depends on all.

        The cost of a filter grows with the cube of the number of states, and the limbs of a robot
        with a fixed base do not influence each other.
        """
        state_count, (channel_count, _) = self.prior.size, self.readings.shape[2:]
        force_count = self.forces.shape[3]
        # Which states depend on which: edges of a graph whose nodes are states, channels, forces.
        first_force = state_count + channel_count
        edges = np.zeros((first_force + force_count,) * 2, dtype=bool)
        edges[:state_count, :state_count] = self.states.any(axis=(0, 1))
        edges[state_count:first_force, :state_count] = self.readings.any(axis=(0, 1))
        edges[:state_count, first_force:] = self.forces.any(axis=(0, 1))
        labels = _label_components(edges | edges.T)
        # Channels and forces without a state are given to the first part that has one.
        with_states = np.unique(labels[:state_count])
        if with_states.size == 1:
            channels, forces = np.arange(channel_count), np.arange(force_count)
            return [IndependentPart(np.arange(state_count), channels, forces, self)]
        labels[~np.isin(labels, with_states)] = with_states[0]
        return [
            self._select_part(
                *(
                    np.flatnonzero(kind == label)
                    for kind in np.split(labels, [state_count, first_force])
                )
            )
            for label in with_states
        ]

    def _select_part(
        self, states: IndexArray, channels: IndexArray, forces: IndexArray
    ) -> IndependentPart:
        """Return the part of the model with some states, channels and forces.

        Responses to inputs are left out, since no filter needs them.
        """
        arrays = {
            "states": self.states[:, :, states[:, None], states],
            "defects": self.defects[:, :, states],
            "forces": self.forces[:, :, states[:, None], forces],
            "inputs": self.inputs[:, :, :0],
            "readings": self.readings[:, :, channels[:, None], states],
            "residuals": self.residuals[:, :, channels],
            "recorded": self.recorded[:, :, channels],
            "prior": self.prior[states],
            "jumps": self.jumps[:, :, states],
        }
        # Indexing changes the memory layout, which the compiled recursions expect.
        runs = LinearRuns(**{name: np.ascontiguousarray(array) for name, array in arrays.items()})
        return IndependentPart(states, channels, forces, runs)

    def segments(self, length: int) -> LinearRuns:
        """Split the runs into segments of `length` samples, each with the prior of a run.

        The process noise is fitted on such segments: they are filtered in parallel, so this needs
        fewer steps. The last segment of a run is padded with zeros, which count as missing readings
        and do not change the likelihood.
        """
        run_count, samples, _ = self.residuals.shape
        # Number of segments of a run, rounded up.
        count = -(-samples // length)

        def cut(values: Any) -> Any:
            """Cut an array (R, T or T - 1, ...) into segments; pad the last one with zeros."""
            padded = np.zeros((run_count, count * length, *values.shape[2:]), dtype=values.dtype)
            padded[:, : values.shape[1]] = values
            segment_values = padded.reshape(run_count * count, length, *values.shape[2:])
            # A segment has one interval fewer than samples.
            return segment_values if values.shape[1] == samples else segment_values[:, :-1]

        return self._map_arrays(cut)

    def _map_arrays(self, change: Callable[[Any], Any]) -> LinearRuns:
        """Return the runs with a function applied to the arrays of all runs."""
        # The prior is that of each run, and has no axis for the runs.
        names = [one.name for one in fields(self) if one.name != "prior"]
        changed: dict[str, Any] = {name: change(getattr(self, name)) for name in names}
        return replace(self, **changed)

    @classmethod
    def stacked(cls, maps: Sequence[IntervalMaps], observed: Array, prior: Array) -> LinearRuns:
        """Stack the linear models of R runs into arrays, padded to the length T of the longest run.

        After its end, the state of a run stays, and nothing is recorded, so that the likelihood
        does not change. Numbers of a model that diverges are set to zero, too.

        Args:
            maps: linear model of each run, whose arrays have the names `STACKED`.
            observed: (R, T, C) readings, NaN where nothing was recorded.
            prior: (Z,) standard deviations of the first states.

        Returns:
            The models, with the residuals (recorded minus predicted readings) and the mask of what
            was recorded.
        """
        runs, samples, _ = observed.shape
        stacked: dict[str, Array] = {}
        for name in STACKED:
            parts = [getattr(run_maps, name) for run_maps in maps]
            # Readings belong to samples, all other arrays to the intervals between samples.
            length = samples if name == "readings" else samples - 1
            values = np.zeros((runs, length, *parts[0].shape[1:]))
            # After the end of a run, the state stays as it is.
            if name == "states":
                values[:] = np.eye(prior.size)
            for run, part in enumerate(parts):
                values[run, : len(part)] = part
            # A step in which the model diverges gives no information on the next one.
            values[~(np.abs(values) < MAX_MAGNITUDE)] = 0.0
            stacked[name] = values
        _remove_rounding_errors(stacked["states"], axis=3)
        _remove_rounding_errors(stacked["forces"], axis=2)
        # Recorded minus predicted readings at the motion about which the models are linear.
        residuals = np.zeros(observed.shape)
        for run, run_maps in enumerate(maps):
            count = len(run_maps.predicted)
            residuals[run, :count] = observed[run, :count] - run_maps.predicted
        recorded = np.isfinite(residuals) & np.isfinite(observed)
        residuals[~recorded] = 0.0
        stacked["readings"][~recorded] = 0.0
        return cls(residuals=residuals, recorded=recorded, prior=prior, **stacked)


@dataclass(frozen=True)
class Filtered:
    """Results of the filter for B runs.

    Attributes:
        predicted: δ- (B, T, Z).
        covariances: P- (B, T, Z, Z); empty (B, 0, 0, 0) after `without_covariances`.
        innovations: e (B, T, C), zero where nothing was recorded.
        gains: K (B, T, Z, C).
        whiteners: W (B, T, C, C) with Wᵀ W = S⁻¹.
        log_likelihood: log L (B,).
    """

    predicted: Array
    covariances: Array
    innovations: Array
    gains: Array
    whiteners: Array
    log_likelihood: Array

    def subset(self, chosen: IndexArray) -> Filtered:
        """Return some of the runs."""
        return Filtered(*(getattr(self, one.name)[chosen] for one in fields(self)))

    def without_covariances(self) -> Filtered:
        """Return the results without the covariances.

        They are a third of the memory, and only the smoother needs them.
        """
        return replace(self, covariances=np.zeros((len(self.covariances), 0, 0, 0)))

    @property
    def whitened(self) -> Array:
        """Whitened innovations W e (B, T, C): white with unit variance if the model is right."""
        whitened: Array = np.einsum("btcd,btd->btc", self.whiteners, self.innovations)
        return whitened


@dataclass(frozen=True)
class Smoothed:
    """Results of the smoother.

    Attributes:
        states: δ (B, T, Z).
        forces: f (B, T - 1, E).
        score: (E,) factor of (7) by which variances change.
    """

    states: Array
    forces: Array
    score: Array


def add_noise_states(runs: LinearRuns, noise: NoiseModel) -> tuple[LinearRuns, Array]:
    """Add states for autocorrelated AR(1) noise, because a Kalman filter expects white noise.

    The noise n of a channel with φ > 0 becomes a state: n[i+1] = φ n[i] + σ sqrt(1 - φ²) w[i] with
    white noise w of variance one. It is added to the reading of the channel. A small share of white
    noise remains, so that the filter stays well conditioned.

    Shapes: R runs, T samples, Z states, E missing forces, C channels, N channels with φ > 0.

    Args:
        runs: the linear models, with the arrays A, d, G and H of `LinearRuns`.
        noise: standard deviation σ and correlation φ of each channel.

    Returns:
        The models with N more states, and the variances (C,) of the remaining white noise.
    """
    coloured_channels = np.flatnonzero(noise.phi > 0)
    white_variances = np.square(noise.sigma)
    if not coloured_channels.size:
        return runs, white_variances
    white_variances = white_variances.copy()
    white_variances[coloured_channels] *= AR_FLOOR
    (run_count, samples, channels), size = runs.residuals.shape, runs.prior.size
    force_count, noise_count = runs.forces.shape[3], coloured_channels.size
    # The noise states follow the Z states, and their innovations the E forces.
    transitions = np.zeros((run_count, samples - 1, size + noise_count, size + noise_count))
    transitions[:, :, :size, :size] = runs.states
    noise_states = size + np.arange(noise_count)
    transitions[:, :, noise_states, noise_states] = noise.phi[coloured_channels]
    zeros = np.zeros((run_count, samples - 1, noise_count))
    defects = np.concatenate([runs.defects, zeros], axis=2)
    jumps = np.concatenate([runs.jumps, zeros], axis=2)
    # The innovations of the noise act like forces of known variance.
    forces = np.zeros((run_count, samples - 1, size + noise_count, force_count + noise_count))
    forces[:, :, :size, :force_count] = runs.forces
    innovation_sigmas = noise.sigma[coloured_channels] * np.sqrt(
        1.0 - np.square(noise.phi[coloured_channels])
    )
    forces[:, :, noise_states, force_count + np.arange(noise_count)] = innovation_sigmas
    # A reading contains the noise state of its channel.
    readings = np.concatenate(
        [runs.readings, np.zeros((run_count, samples, channels, noise_count))], axis=3
    )
    readings[:, :, coloured_channels, noise_states] = 1.0
    readings[~runs.recorded] = 0.0
    prior = np.concatenate([runs.prior, noise.sigma[coloured_channels]])
    runs_with_noise = replace(
        runs,
        states=transitions,
        defects=defects,
        forces=forces,
        readings=readings,
        prior=prior,
        jumps=jumps,
    )
    return runs_with_noise, white_variances


def filter_runs(runs: LinearRuns, force: Array, white: Array) -> Filtered:
    """Follow all runs with a Kalman filter, eqs. (1) to (4) of the module docstring.

    The filter estimates the deviation of the state from the motion about which the model is linear.
    A recording has no reading of some channels at some samples. Such a reading is replaced by zero
    with variance one and no dependence on the state, so that it changes neither state nor
    likelihood.

    Args:
        runs: the linear models of B runs.
        force: (E,) standard deviations of the missing forces (process noise), or (B, E) of each
            run. Further columns of the matrix G, which are those of coloured noise, have 1.
        white: (C,) variances of the white noise of C channels.

    Returns:
        Results of the filter; the log-likelihood of a run in which the model diverges is -inf.

    Raises:
        ValueError: the models do not have one interval fewer than samples.
    """
    if runs.states.shape[1] != runs.residuals.shape[1] - 1:
        raise ValueError(f"expected a step between two samples, got {runs.states.shape[1]} steps")
    deviations = _complete_deviations(force, runs)
    if len(runs.independent_parts) == 1:
        return _filter_part(runs, deviations, white)
    run_count, samples, channels = runs.residuals.shape
    size = runs.prior.size
    joined = Filtered(
        predicted=np.zeros((run_count, samples, size)),
        covariances=np.zeros((run_count, samples, size, size)),
        innovations=np.zeros(runs.residuals.shape),
        gains=np.zeros((run_count, samples, size, channels)),
        whiteners=np.zeros((run_count, samples, channels, channels)),
        log_likelihood=np.zeros(run_count),
    )
    for part in runs.independent_parts:
        filtered = _filter_part(part.runs, deviations[:, part.forces], white[part.channels])
        for name, index in _index_filtered(part).items():
            getattr(joined, name)[index] = getattr(filtered, name)
        joined.log_likelihood[:] += filtered.log_likelihood
    return joined


def _index_filtered(part: IndependentPart) -> dict[str, Any]:
    """Return the index of a part's entries in each array of the results of the filter."""
    states, channels = part.states, part.channels
    return {
        "predicted": np.s_[:, :, states],
        "covariances": np.s_[:, :, states[:, None], states],
        "innovations": np.s_[:, :, channels],
        "gains": np.s_[:, :, states[:, None], channels],
        "whiteners": np.s_[:, :, channels[:, None], channels],
    }


def _filter_part(runs: LinearRuns, deviations: Array, white: Array) -> Filtered:
    """Follow one independent part of all runs, see `filter_runs`.

    Args:
        runs: the linear models of B runs.
        deviations: (B, E) standard deviations of all columns of G.
        white: (C,) variances of the white noise of C channels.
    """
    # The residuals and rows of H of missing readings are zero already.
    variances = np.where(runs.recorded, white, 1.0)
    # The arguments of the compiled function are in the order of its signature. Its last results are
    # buffers.
    predicted, covariances, innovations, gains, whiteners, likelihood, *_ = COMPILED.call(
        run_filter,
        *_make_contiguous(runs.states, runs.defects, runs.forces, runs.readings, runs.residuals),
        *_make_contiguous(np.square(runs.jumps), variances, runs.prior, deviations),
        np.array([LARGEST_COVARIANCE]),
    )
    # The likelihood of a model that diverges is zero; `>` is also false for NaN.
    likelihood = np.where(likelihood > -LARGEST_LOSS, likelihood, -np.inf)
    return Filtered(predicted, covariances, innovations, gains, whiteners, likelihood)


def smooth_runs(runs: LinearRuns, filtered: Filtered, force: Array) -> Smoothed:
    """Smooth all runs backward, eqs. (5) and (6) of the module docstring (Bryson and Frazier).

    The smoothed states and forces are the most likely ones, given all samples of a run and not only
    those before. The score of a force, eq. (7), is the ratio of its measured to its expected mean
    square: above one if its assumed variance is too small. It is one where the model diverges.

    Args:
        runs: the linear models.
        filtered: results of the filter for these runs, with covariances.
        force: standard deviations of the missing forces, as for `filter_runs`.
    """
    deviations = _complete_deviations(force, runs)
    if len(runs.independent_parts) == 1:
        return _smooth_part(runs, filtered, deviations)
    joined = Smoothed(
        states=np.zeros_like(filtered.predicted),
        forces=np.zeros((*runs.defects.shape[:2], runs.forces.shape[3])),
        score=np.zeros(runs.forces.shape[3]),
    )
    for part in runs.independent_parts:
        part_of_filtered = Filtered(
            **{
                name: np.ascontiguousarray(getattr(filtered, name)[index])
                for name, index in _index_filtered(part).items()
            },
            log_likelihood=filtered.log_likelihood,
        )
        smoothed = _smooth_part(part.runs, part_of_filtered, deviations[:, part.forces])
        joined.states[:, :, part.states] = smoothed.states
        joined.forces[:, :, part.forces] = smoothed.forces
        joined.score[part.forces] = smoothed.score
    return joined


def _smooth_part(runs: LinearRuns, filtered: Filtered, deviations: Array) -> Smoothed:
    """Smooth one independent part of all runs, see `smooth_runs`.

    Args:
        runs: the linear models of B runs.
        filtered: results of the filter for this part.
        deviations: (B, E) standard deviations of all columns of G.
    """
    states, forces, measured, expected, *_ = COMPILED.call(
        run_smoother,
        *_make_contiguous(runs.states, runs.forces, runs.readings, deviations),
        *(filtered.predicted, filtered.covariances, filtered.innovations),
        *(filtered.gains, filtered.whiteners),
    )
    states, forces = np.nan_to_num(states), np.nan_to_num(forces)
    with np.errstate(all="ignore"):
        score = np.nan_to_num(measured / np.maximum(expected, 1e-300), nan=1.0)
    return Smoothed(states, forces, score)


def fit_process_noise(
    runs: LinearRuns, force: Array, white: Array, typical: Array
) -> tuple[Array, Filtered, Smoothed]:
    """Fit the standard deviations of the missing forces (process noise) by maximum likelihood.

    Each iteration filters and smooths the runs, and multiplies each variance by the ratio of its
    smoothed to its expected square, eq. (7) of the module docstring. It ends when neither the
    variances nor the likelihood change much. The results are those of the returned deviations.

    Args:
        runs: the linear models.
        force: (E,) initial standard deviations.
        white: (C,) variances of the white noise of C channels.
        typical: (E,) typical forces in N or N·m; a small share of them is the minimum.

    Returns:
        The standard deviations (E,), and the results of filter and smoother of the whole runs,
        without the covariances of the states.
    """
    count = force.size
    # All runs are filtered in parallel, sample by sample, so short segments need fewer steps than
    # long runs. They show the same process noise.
    is_long = runs.residuals.shape[1] > 2 * SEGMENT_SAMPLES
    fitted_runs = runs.segments(SEGMENT_SAMPLES) if is_long else runs
    log_likelihood = -np.inf
    for iteration in range(MAX_ITERATIONS):
        filtered = filter_runs(fitted_runs, force, white)
        smoothed = smooth_runs(fitted_runs, filtered, force)
        last, log_likelihood = log_likelihood, float(filtered.log_likelihood.sum())
        if abs(log_likelihood - last) < MIN_ITERATION_GAIN:
            break
        # Scores after the first `count` are those of coloured noise, whose variance is known. A
        # score is a ratio of variances, and its root that of standard deviations.
        ratio = np.clip(np.sqrt(smoothed.score[:count]), 1.0 / LARGEST_CHANGE, LARGEST_CHANGE)
        new_force = np.maximum(force * ratio, SMALLEST_FORCE * typical)
        has_converged = bool((np.abs(new_force / force - 1.0) < CONVERGENCE_TOLERANCE).all())
        # Short runs are not filtered again, so the last filter belongs to the present variances.
        is_last_filter = not is_long and iteration == MAX_ITERATIONS - 1
        if has_converged or is_last_filter:
            break
        force = new_force
    if is_long:
        filtered = filter_runs(runs, force, white)
        smoothed = smooth_runs(runs, filtered, force)
    return force, filtered.without_covariances(), smoothed


def _label_components(edges: Mask) -> IndexArray:
    """Return the smallest node (n,) of the connected component to which each node belongs.

    SciPy's function would load a package for which `simgap explain` has no other use.

    Args:
        edges: (n, n) symmetric mask of the edges of a graph.
    """
    nodes = np.arange(len(edges))
    is_neighbour = edges | np.eye(nodes.size, dtype=bool)
    labels = nodes
    while True:
        # Each node takes the smallest label of its neighbours.
        smallest: IndexArray = np.where(is_neighbour, labels, nodes.size).min(axis=1)
        if np.array_equal(smallest, labels):
            return labels
        labels = smallest


def _remove_rounding_errors(matrices: Array, axis: int) -> None:
    """Set entries to zero that are negligible in their row (axis 3) or column (axis 2) of all runs.

    Args:
        matrices: (R, T - 1, rows, columns), which are changed.
        axis: axis along which the largest entry is taken.
    """
    largest = np.abs(matrices).max(axis=(0, 1), initial=0.0)
    is_negligible = largest <= NEGLIGIBLE_SHARE * largest.max(axis=axis - 2, keepdims=True)
    matrices[:, :, is_negligible] = 0.0


def _make_contiguous(*arrays: Array) -> tuple[Array, ...]:
    """Return the arrays in the memory layout for which the recursions are compiled."""
    return tuple(np.ascontiguousarray(array) for array in arrays)


def _complete_deviations(force: Array, runs: LinearRuns) -> Array:
    """Return standard deviations (R, B) for all columns of G, including those of coloured noise.

    Args:
        force: (E,) or (R, E) standard deviations of the missing forces.
        runs: linear models of R runs, whose G has B >= E columns; the further ones drive coloured
            noise and have deviation one.
    """
    run_count, columns = len(runs.residuals), runs.forces.shape[3]
    result = np.ones((run_count, columns))
    result[:, : force.shape[-1]] = force
    return result


def run_filter(
    states: Array,
    defects: Array,
    forces: Array,
    readings: Array,
    residuals: Array,
    jumps: Array,
    variances: Array,
    prior: Array,
    deviations: Array,
    limits: Array,
    predicted: Array,
    covariances: Array,
    innovations: Array,
    gains: Array,
    whiteners: Array,
    likelihood: Array,
    x: Array,
    moved: Array,
    p: Array,
    work: Array,
    spread: Array,
    root: Array,
    inverse: Array,
    crossed: Array,
    half: Array,
    w: Array,
) -> None:
    """Filter B runs of T samples with Z states, C channels and E forces (Kalman filter).

    The deviation δ of the state is that from the motion about which the model is linear, δ- its
    prediction, and P- the covariance of δ-. Each sample has an innovation e with the covariance S
    and its Cholesky factor L, a whitener W, a gain K, and a part of the log-likelihood ℓ, whose
    constant is left out (eqs. (1) to (4) of the module docstring):

        e = r - H δ-,    S = H P- Hᵀ + R = L Lᵀ,    W = L⁻¹,    K = P- Hᵀ Wᵀ W
        ℓ ← ℓ - log det L - |W e|² / 2

    After each sample but the last, the state is updated by the reading, and that of the next sample
    is predicted:

        δ = δ- + K e,    P = P- - K S Kᵀ,    δ- = A δ - d,    P- = A P Aᵀ + G Q Gᵀ + J

    If a predicted covariance exceeds the limit, the state of an unstable motion is unknown, and its
    covariance is reset to a prior that is wider than that of the first state. Results are written
    to `predicted` and the five arguments after it, which are zero at first; the last ten are
    buffers, so that no memory is allocated.

    Args:
        states: A (B, T - 1, Z, Z).
        defects: d (B, T - 1, Z).
        forces: G (B, T - 1, Z, E).
        readings: H (B, T, C, Z).
        residuals: r (B, T, C).
        jumps: J (B, T - 1, Z), variances.
        variances: diagonal of R (B, T, C), variances of white noise.
        prior: (Z,) standard deviations of the first states.
        deviations: (B, E) standard deviations of the missing forces, whose squares are Q.
        limits: (1,) maximum covariance.
        predicted: δ- (B, T, Z).
        covariances: P- (B, T, Z, Z).
        innovations: e (B, T, C).
        gains: K (B, T, Z, C).
        whiteners: W (B, T, C, C).
        likelihood: log-likelihood ℓ (B,) of each run.
        x: (Z,) deviation of the state.
        moved: (Z,) deviation of the next state.
        p: (Z, Z) covariance of the state.
        work: (Z, Z) product.
        spread: (Z, Z) propagated covariance.
        root: (C, C) Cholesky factor L of S.
        inverse: (C, C) inverse of L.
        crossed: (C, Z) H P.
        half: (C, Z) W H P.
        w: (C,) whitened innovation.
    """
    # Indices: z and y of states, c and d of channels, e of forces, i of samples, k of a sum.
    runs, samples, channels, size = readings.shape
    count = forces.shape[3]
    for run in range(runs):
        for z in range(size):
            x[z] = 0.0
            for y in range(size):
                p[z, y] = prior[z] * prior[z] if z == y else 0.0
        total = 0.0
        for i in range(samples):
            h = readings[run, i]
            for z in range(size):
                predicted[run, i, z] = x[z]
                for y in range(size):
                    covariances[run, i, z, y] = p[z, y]
            # crossed = H P
            multiply_sparse(h, p, crossed)
            # S = H P Hᵀ + R (lower triangle, in `root`), and in place, row by row, its Cholesky
            # factor L
            for c in range(channels):
                for d in range(c + 1):
                    root[c, d] = variances[run, i, c] if c == d else 0.0
                for y in range(size):
                    factor = h[c, y]
                    if factor != 0.0:
                        for d in range(c + 1):
                            root[c, d] += factor * crossed[d, y]
                for d in range(c + 1):
                    value = root[c, d]
                    for k in range(d):
                        value -= root[c, k] * root[d, k]
                    root[c, d] = np.sqrt(value) if c == d else value / root[d, d]
            # W = L⁻¹ by forward substitution, and half = W H P
            for c in range(channels):
                for d in range(c + 1):
                    value = 1.0 if c == d else 0.0
                    for k in range(d, c):
                        value -= root[c, k] * inverse[k, d]
                    inverse[c, d] = value / root[c, c]
            multiply_sparse(inverse, crossed, half)
            # Innovation, whitened innovation w = W e, and what they add to the log-likelihood.
            for c in range(channels):
                value = residuals[run, i, c]
                for z in range(size):
                    value -= h[c, z] * x[z]
                innovations[run, i, c] = value
            for c in range(channels):
                value = 0.0
                for d in range(c + 1):
                    value += inverse[c, d] * innovations[run, i, d]
                    whiteners[run, i, c, d] = inverse[c, d]
                w[c] = value
                total -= np.log(root[c, c]) + 0.5 * value * value
            # K = halfᵀ W; gains are zero at first.
            for z in range(size):
                for c in range(channels):
                    factor = half[c, z]
                    for d in range(c + 1):
                        gains[run, i, z, d] += factor * inverse[c, d]
            if i + 1 == samples:
                break
            # Update by the reading: K e = halfᵀ w, and K S Kᵀ = halfᵀ half
            for c in range(channels):
                for z in range(size):
                    x[z] += half[c, z] * w[c]
            for z in range(size):
                for c in range(channels):
                    factor = half[c, z]
                    for y in range(size):
                        p[z, y] -= factor * half[c, y]
            # Predict the next state and its covariance.
            a = states[run, i]
            for z in range(size):
                value = -defects[run, i, z]
                for y in range(size):
                    value += a[z, y] * x[y]
                moved[z] = value
            for z in range(size):
                x[z] = moved[z]
            propagate_covariance(a, p, work, spread)
            # Add J and G Q Gᵀ to the lower triangle, and copy it to both halves of P-.
            is_lost = False
            for z in range(size):
                spread[z, z] += jumps[run, i, z]
                for e in range(count):
                    g = forces[run, i, z, e] * deviations[run, e] * deviations[run, e]
                    if g != 0.0:
                        for y in range(z + 1):
                            spread[z, y] += g * forces[run, i, y, e]
                for y in range(z + 1):
                    value = spread[z, y]
                    p[z, y] = value
                    p[y, z] = value
                    # `not` also finds NaN.
                    if not abs(value) < limits[0]:
                        is_lost = True
            # Nothing is known about a lost state: its standard deviation is at least 1 in SI units.
            if is_lost:
                for z in range(size):
                    for y in range(size):
                        p[z, y] = prior[z] * prior[z] + 1.0 if z == y else 0.0
        likelihood[run] = total


def run_smoother(
    states: Array,
    forces: Array,
    readings: Array,
    deviations: Array,
    predicted: Array,
    covariances: Array,
    innovations: Array,
    gains: Array,
    whiteners: Array,
    smoothed: Array,
    missing: Array,
    measured: Array,
    expected: Array,
    adjoint: Array,
    moved: Array,
    white: Array,
    information: Array,
    spread: Array,
    work: Array,
    back: Array,
    closed: Array,
    weighed: Array,
) -> None:
    """Smooth B runs of T samples with Z states, C channels and E forces (Bryson and Frazier).

    Backward from the last sample, the adjoint λ_i and its information Λ_i collect what the readings
    from sample i on say about the state at this sample; both are zero after the last sample. With C
    = I - K H and the whitener W of the filter (eqs. (5) and (6) of the module docstring), the
    smoothed state δ and the missing force f are

        λ_i = Cᵀ Aᵀ λ_{i+1} - Hᵀ Wᵀ W e,    Λ_i = Cᵀ Aᵀ Λ_{i+1} A C + Hᵀ Wᵀ W H
        δ_i = δ- - P- λ_i,    f_{i-1} = - Q Gᵀ λ_i

    Sums of (Gᵀ λ)² and of the diagonal of Gᵀ Λ G over all runs are the numerator and denominator of
    (7), the factor by which the variances Q of the missing forces must change. Results are written
    to `smoothed` and the three arguments after it; the last ten are buffers, so that no memory is
    allocated.

    Args:
        states: A (B, T - 1, Z, Z).
        forces: G (B, T - 1, Z, E).
        readings: H (B, T, C, Z).
        deviations: (B, E) standard deviations of the missing forces, whose squares are Q.
        predicted: δ- (B, T, Z), as written by the filter.
        covariances: P- (B, T, Z, Z), as written by the filter.
        innovations: e (B, T, C), as written by the filter.
        gains: K (B, T, Z, C), as written by the filter.
        whiteners: W (B, T, C, C), as written by the filter.
        smoothed: δ (B, T, Z).
        missing: f (B, T - 1, E).
        measured: (E,) numerator of (7), to which the runs are added.
        expected: (E,) denominator of (7), to which the runs are added.
        adjoint: (Z,) λ.
        moved: (Z,) λ of the previous sample.
        white: (C,) whitened innovation.
        information: (Z, Z) Λ.
        spread: (Z, Z) propagated Λ.
        work: (Z, Z) product.
        back: (Z, Z) A C.
        closed: (Z, Z) C.
        weighed: (C, Z) W H.
    """
    # Indices: z and y of states, c and d of channels, e of forces, i of samples.
    runs, samples, channels, size = readings.shape
    count = forces.shape[3]
    for run in range(runs):
        for z in range(size):
            adjoint[z] = 0.0
            for y in range(size):
                information[z, y] = 0.0
        for i in range(samples - 1, -1, -1):
            h, whitener = readings[run, i], whiteners[run, i]
            multiply_sparse(whitener, h, weighed)
            if i + 1 < samples:
                # Carry λ and Λ from the next sample to this one: λ becomes backᵀ λ, and Λ becomes
                # backᵀ Λ back, with back = A closed and closed = I - K H.
                for z in range(size):
                    for y in range(size):
                        closed[z, y] = 1.0 if z == y else 0.0
                for c in range(channels):
                    for y in range(size):
                        factor = h[c, y]
                        if factor != 0.0:
                            for z in range(size):
                                closed[z, y] -= gains[run, i, z, c] * factor
                multiply_sparse(states[run, i], closed, back)
                for z in range(size):
                    moved[z] = 0.0
                for y in range(size):
                    for z in range(size):
                        moved[z] += back[y, z] * adjoint[y]
                for z in range(size):
                    adjoint[z] = moved[z]
                multiply_sparse(information, back, work)
                multiply_transposed(back, work, spread)
                for z in range(size):
                    for y in range(z, size):
                        information[z, y] = spread[z, y]
                        information[y, z] = spread[z, y]
            # Add what the reading of this sample says.
            for c in range(channels):
                value = 0.0
                for d in range(channels):
                    value += whitener[c, d] * innovations[run, i, d]
                white[c] = value
            for c in range(channels):
                for z in range(size):
                    factor = weighed[c, z]
                    if factor != 0.0:
                        adjoint[z] -= factor * white[c]
                        for y in range(size):
                            information[z, y] += factor * weighed[c, y]
            for z in range(size):
                smoothed[run, i, z] = predicted[run, i, z]
            for y in range(size):
                for z in range(size):
                    smoothed[run, i, z] -= covariances[run, i, y, z] * adjoint[y]  # (6)
            if i == 0:
                break
            # Missing force between the previous sample and this one, and what it adds to (7):
            # `force_adjoint` is the element e of Gᵀ λ, `force_information` that of the diagonal of
            # Gᵀ Λ G.
            g = forces[run, i - 1]
            for e in range(count):
                force_adjoint, force_information = 0.0, 0.0
                for z in range(size):
                    if g[z, e] != 0.0:
                        force_adjoint += g[z, e] * adjoint[z]
                        for y in range(size):
                            if g[y, e] != 0.0:
                                force_information += g[z, e] * information[z, y] * g[y, e]
                deviation = deviations[run, e]
                missing[run, i - 1, e] = -deviation * deviation * force_adjoint
                measured[e] += force_adjoint * force_adjoint
                expected[e] += force_information


def multiply_sparse(a: Array, b: Array, out: Array) -> None:
    """Write a b to `out`; zeros of a are skipped, because most entries of a are zero."""
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            out[i, j] = 0.0
        for k in range(a.shape[1]):
            factor = a[i, k]
            if factor != 0.0:
                for j in range(b.shape[1]):
                    out[i, j] += factor * b[k, j]


def multiply_transposed(a: Array, b: Array, out: Array) -> None:
    """Write aᵀ b to `out`; zeros of a are skipped, because most entries of a are zero."""
    for i in range(a.shape[1]):
        for j in range(b.shape[1]):
            out[i, j] = 0.0
    for k in range(a.shape[0]):
        for i in range(a.shape[1]):
            factor = a[k, i]
            if factor != 0.0:
                for j in range(b.shape[1]):
                    out[i, j] += factor * b[k, j]


def propagate_covariance(a: Array, p: Array, product: Array, out: Array) -> None:
    """Write a p aᵀ for a symmetric matrix p to `out`, as a covariance is propagated.

    `product` receives (a p)ᵀ = p aᵀ, for which `out` is used as a buffer. The lower triangle is
    copied from the upper one, so that the result is exactly symmetric.
    """
    # product = (a p)ᵀ
    multiply_sparse(a, p, out)
    size = a.shape[0]
    for i in range(size):
        for j in range(size):
            product[j, i] = out[i, j]
    # out = a (p aᵀ)
    multiply_sparse(a, product, out)
    for i in range(size):
        for j in range(i):
            out[i, j] = out[j, i]


COMPILED = CompiledFunctions(
    __name__,
    "the Kalman filter",
    {
        run_filter: (
            *("bizz", "biz", "bize", "btcz", "btc", "biz", "btc", "z", "be", "1"),
            *("btz", "btzz", "btc", "btzc", "btcc", "b"),
            *("z", "z", "zz", "zz", "zz", "cc", "cc", "cz", "cz", "c"),
        ),
        run_smoother: (
            *("bizz", "bize", "btcz", "be", "btz", "btzz", "btc", "btzc", "btcc"),
            *("btz", "bie", "e", "e"),
            *("z", "z", "c", "zz", "zz", "zz", "zz", "zz", "cz"),
        ),
    },
)
"""Compiled recursions.

Letters of the shapes: b runs, t samples, i = t - 1 intervals, c channels, z states, e forces.
"""
