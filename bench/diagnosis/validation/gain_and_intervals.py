"""Gain of an extended model on held-out runs, and confidence intervals of fitted parameters.

The share of the gap closed is, for the RMS errors b before and a after and the noise floor n,

    closed = (b - max(a, n)) / (b - n)                                                         (1)

The covariance of the fitted parameters is the inverse of the curvature of the sum of squares after
the initial states of every run r are eliminated (W. H. Greene, Econometric Analysis, chapter 9;
generalised least squares). With the whitened Jacobian J_r = [A_r B_r] by parameters and initial
states, and the prior standard deviation sigma_0 of the initial states,

    covariance = (sum_r A_r' A_r - A_r' B_r (B_r' B_r + diag sigma_0^-2)^-1 B_r' A_r)^-1       (2)

Simulated contacts jump, so that the sum of squares of a run has several minima, and the estimates
of single runs scatter more than noise explains. With the gradient g_r of run r and the covariance C
of (2), the scatter of R runs gives the variances

    diag(C sum_r g_r g_r' C) R / (R - 1)                                                       (3)
    g_r = A_r' e_r - A_r' B_r (B_r' B_r + diag sigma_0^-2)^-1 B_r' e_r

for whitened residuals e_r, which replace smaller ones of C (H. White, Econometrica 50, 1, 1982,
doi:10.2307/1912526; for groups of samples: K.-Y. Liang, S. Zeger, Biometrika 73, 13, 1986,
doi:10.1093/biomet/73.1.13).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from bench.benchmark.statistics.bootstrap import INTERVAL_QUANTILES
from bench.diagnosis.evaluation.noise_model import NoiseModel, whiten
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.fitted_models import FittedModel, ModelSet
from bench.diagnosis.fitting.levenberg_marquardt_state import TrajectoryFit
from bench.diagnosis.fitting.levenberg_marquardt_step import (
    compute_difference_steps,
    compute_schur_complement,
    hold_known_states,
)
from bench.diagnosis.fitting.trajectory_fit import compute_state_prior
from sims.core.simulator import Array

Z95 = 1.959964
"""Half the width of the 95 % interval of a normal distribution, in standard deviations."""
BOOTSTRAP_RESAMPLES = 2000
"""Number of bootstrap samples."""
SINGLE_RUN_SEGMENTS = 10
"""Number of segments into which a run is divided for resampling if there are too few runs."""
MAX_INTERVAL_WIDTH = 4.0
"""Maximum width of an interval, as a multiple of the parameter's range or value; a wider interval
means that the data do not bound the parameter.
"""
MIN_CURVATURE = 1e-200
"""Minimum curvature of a parameter, for parameters to which the data are insensitive. It is small,
but division by it does not overflow.
"""
STATE_REGULARISATION = 1e-12
"""Ridge added to the curvature of each initial state, as a fraction of it, so that collinear
initial states remain solvable.
"""
MIN_REPORTED_GAIN = -9.0
"""Lower limit of the reported share of the gap closed; for a failed model the exact value has no
meaning.
"""
MIN_EIGENVALUE = 1e-12
"""Minimum eigenvalue of the scaled curvature; a direction with a smaller one is unidentified."""


def compute_central_jacobian(
    evaluator: RunEvaluator, fit: TrajectoryFit, noise: NoiseModel
) -> TrajectoryFit:
    """Compute the Jacobian of a fit by central differences.

    One-sided differences suffice for the steps of a fit, but their curvature makes parameters look
    distinguishable that are not.

    Args:
        evaluator: Run evaluator of the runs.
        fit: Fit with a one-sided Jacobian.
        noise: Noise that weights the channels.

    Returns:
        The fit with the new Jacobian.
    """
    parameter_count = fit.free_indices.size
    bounds = _widen_bounds(evaluator, fit)
    ranges = bounds[:, 1] - bounds[:, 0]
    steps = compute_difference_steps(fit.jacobian, noise, ranges)
    # Derivatives by initial states from a linearisation are not one-sided differences.
    if evaluator.has_linearisation:
        steps = steps[:parameter_count]
    theta, states = _displace_both_sides(fit, steps, bounds)

    # One call simulates both sides and all runs, because the engine steps a batch at once.
    simulated = evaluator.simulate_all_runs(
        theta.reshape(-1, fit.theta.size), states.reshape(-1, *fit.initial_states.shape)
    )
    lower_side, upper_side = simulated.reshape(2, steps.size, *fit.simulated.shape)

    # Row j has changed parameter j, so the widths are on the diagonal.
    lower, upper = theta[:, :parameter_count, fit.free_indices]
    parameter_widths = np.diagonal(upper - lower)
    widths = np.concatenate([parameter_widths, 2.0 * steps[parameter_count:]])
    jacobian = np.moveaxis(upper_side - lower_side, 0, -1) / widths
    # A simulation that failed on one side gives no slope.
    jacobian = np.nan_to_num(jacobian, nan=0.0, posinf=0.0, neginf=0.0)
    state_jacobian = (
        fit.jacobian[..., parameter_count:]
        if evaluator.has_linearisation
        else jacobian[..., parameter_count:]
    )
    return replace(
        fit, jacobian=np.concatenate([jacobian[..., :parameter_count], state_jacobian], axis=3)
    )


def get_central_jacobian(models: ModelSet, fit: TrajectoryFit) -> TrajectoryFit:
    """Return the result of `compute_central_jacobian` for a fit; it is computed once and cached.

    Args:
        models: Models with the run evaluator, the noise and the cache.
        fit: Fit with a one-sided Jacobian.
    """
    cached_entry = models.refined_jacobians.get(id(fit))
    # An id can be reused after an object is deleted, so the object itself is compared.
    if cached_entry is None or cached_entry[0] is not fit:
        cached_entry = models.refined_jacobians[id(fit)] = (
            fit,
            compute_central_jacobian(models.evaluator, fit, models.noise),
        )
    return cached_entry[1]


def _displace_both_sides(fit: TrajectoryFit, steps: Array, bounds: Array) -> tuple[Array, Array]:
    """Build the parameters (2, n, P) and initial states (2, n, R, s) of the central differences.

    The first axis is the lower and the upper side. Row j has number j of the n parameters and
    initial states moved by its step, and all others unchanged. A row is simulated to get one column
    of the Jacobian.

    Shapes: R runs, P parameters.

    Args:
        fit: the fit, with q free parameters.
        steps: (n,) steps of the q parameters, then of the s initial states.
        bounds: (q, 2) bounds of the parameters.
    """
    parameter_count = fit.free_indices.size
    theta = np.tile(fit.theta, (2, len(steps), 1))
    initial_states = np.tile(fit.initial_states, (2, len(steps), 1, 1))
    for side, sign in enumerate((-1.0, 1.0)):
        shifts = sign * steps
        for j, index in enumerate(fit.free_indices):
            displaced_value = fit.theta[index] + shifts[j]
            # At a bound the step is one-sided, so the actual difference is used as the divisor.
            theta[side, j, index] = np.clip(displaced_value, *bounds[j])
        for j, shift in enumerate(shifts[parameter_count:]):
            initial_states[side, parameter_count + j, :, j] += shift
    return theta, initial_states


def _widen_bounds(evaluator: RunEvaluator, fit: TrajectoryFit) -> Array:
    """Return the bounds (q, 2) of the fitted parameters, widened to contain the fit.

    Coefficients may be outside their plausible range.

    Args:
        evaluator: the runs, with the bounds of all parameters.
        fit: the fit, with q free parameters.
    """
    values = fit.theta[fit.free_indices]
    bounds = [evaluator.parameters[i].bounds for i in fit.free_indices]
    # The shape is set explicitly because there may be no parameters.
    table = np.array(bounds).reshape(-1, 2)
    low, high = table.T
    lowest = np.minimum(low, values)
    highest = np.maximum(high, values)
    return np.stack([lowest, highest], 1)


def compute_covariance(models: ModelSet, model: FittedModel) -> Array:
    """Compute the covariance (q, q) of the fitted parameters with AR(1) noise.

    It is the inverse of the curvature of the whitened sum of squares, from which the initial states
    of each run are eliminated: eq. (2) of the module docstring.

    It is (sum_r A_r'A_r - A_r'B_r (B_r'B_r + diag sigma_0^-2)^-1 B_r'A_r)^-1 (2), with the whitened
    derivatives A_r of run r by parameters and B_r by its initial state, whose prior has the
    standard deviation sigma_0.

    If simulated contacts jump, larger variances by the scatter of the runs (3) replace those of
    (2). They are scaled so that the quantile of a normal distribution gives the interval by
    Student's t.

    Shapes: q fitted parameters.

    Args:
        models: the models, with the runs to which they are fitted.
        model: fitted model: its effects, parameters, initial states and likelihood.
    """
    fisher_blocks = compute_fisher_blocks(models, model)
    parameter_curvature = fisher_blocks.parameters.sum(axis=0)
    # The Schur complement that solves a step of the fit also eliminates the initial states here.
    schur_complement, _ = compute_schur_complement(
        parameter_curvature, fisher_blocks.cross, fisher_blocks.states
    )
    covariance = invert_scaled(parameter_curvature, schur_complement)
    if not models.has_contact_jumps or len(fisher_blocks.parameters) == 1:
        return covariance
    # Only robots on the ground need this import, which takes long.
    from scipy.special import stdtrit

    scores = _compute_run_scores(models, model, fisher_blocks)
    count = len(scores)
    scattered = np.square(scores @ covariance).sum(axis=0) * count / (count - 1)  # (3)
    # Few runs estimate their scatter poorly.
    scattered *= np.square(stdtrit(count - 1, 0.975) / Z95)
    variances = np.maximum(np.diagonal(covariance), np.finfo(float).tiny)
    factors = np.sqrt(np.maximum(scattered / variances, 1.0))
    widened: Array = covariance * np.outer(factors, factors)
    return widened


def _compute_run_scores(models: ModelSet, model: FittedModel, blocks: FisherBlocks) -> Array:
    """Compute the gradients g_r of (3) by the q parameters, (R, q), one row for each run.

    Args:
        models: the models, with the runs to which they are fitted.
        model: fitted model.
        blocks: its curvature blocks.
    """
    residual = models.compute_residual(model.fit)[..., None]
    whitened = whiten(residual, models.observed_mask, blocks.noise).reshape(len(residual), -1, 1)
    products = np.matmul(blocks.jacobian.transpose(0, 2, 1), whitened)
    q = blocks.parameters.shape[1]
    by_states = np.linalg.solve(blocks.states, products[:, q:])
    scores: Array = (products[:, :q] - blocks.cross @ by_states)[..., 0]
    return scores


def invert_scaled(parameter_curvature: Array, schur_complement: Array) -> Array:
    """Invert the curvature after elimination of the initial states, which gives the covariance.

    Directions that the data do not identify get a huge variance. Parameters are scaled by their own
    curvature before, so that the threshold for this does not depend on units.

    Shapes: q fitted parameters.

    Args:
        parameter_curvature: (q, q) curvature by the parameters alone, the first sum of eq. (2); it
            scales the inversion.
        schur_complement: (q, q) curvature after elimination of the initial states.
    """
    # Parameters of any unit are scaled alike, so that the cut-off below means the same for each.
    diagonal = np.diagonal(parameter_curvature)
    scale = np.sqrt(np.maximum(diagonal, MIN_CURVATURE))
    unit_products = np.outer(scale, scale)
    scaled = schur_complement / unit_products
    values, vectors = np.linalg.eigh(scaled)
    # An unidentified direction would look certain if its inverse were zero.
    inverse = (vectors / np.maximum(values, MIN_EIGENVALUE)) @ vectors.T
    result: Array = inverse / unit_products  # (2)
    return result


class FisherBlocks(NamedTuple):
    """Blocks of the covariance, eq. (2) of the module docstring, for each run.

    Attributes:
        noise: Noise used for whitening: the residual of the model.
        jacobian: (R, n, q + s) whitened derivatives by parameters and by initial states.
        parameters: (R, q, q) A' A.
        cross: (R, q, s) A' B, zero where an initial state is known.
        states: (R, s, s) B' B with the prior.
    """

    noise: NoiseModel
    jacobian: Array
    parameters: Array
    cross: Array
    states: Array


def compute_fisher_blocks(models: ModelSet, model: FittedModel) -> FisherBlocks:
    """Compute the curvature blocks of a fitted model, run by run.

    Args:
        models: Models with the run evaluator.
        model: Fitted model; its residual gives the noise.
    """
    fit = get_central_jacobian(models, model.fit)
    # The residual of the model is taken as the noise, whatever the recording specifies.
    sigma = np.maximum(model.likelihood.sigma, 1e-300)
    noise = NoiseModel(sigma, model.likelihood.phi)
    return compute_fisher_blocks_from_jacobian(
        models.evaluator, fit.jacobian, model.fit.free_indices.size, noise
    )


def compute_fisher_blocks_from_jacobian(
    evaluator: RunEvaluator, jacobian: Array, q: int, noise: NoiseModel
) -> FisherBlocks:
    """Compute the curvature blocks of eq. (2) of the module docstring from a Jacobian.

    The derivatives are whitened, so that their products are information in units of the noise. The
    prior of the initial states is added to their block.

    Shapes: R runs, T samples, C channels, q fitted parameters, s states of a run.

    Args:
        evaluator: Run evaluator of the runs.
        jacobian: (R, T, C, q + s) derivatives, those by initial states last.
        q: Number of parameters in the Jacobian.
        noise: Noise for whitening.
    """
    observed_mask = np.isfinite(evaluator.observed)
    jacobian = whiten(np.where(observed_mask[..., None], jacobian, 0.0), observed_mask, noise)
    runs, *_, size = jacobian.shape
    flat_jacobian = jacobian.reshape(runs, -1, size)
    normal = np.matmul(flat_jacobian.transpose(0, 2, 1), flat_jacobian)
    precision = 1.0 / compute_state_prior(evaluator) ** 2
    # In an unstable motion the derivatives by all initial states may be collinear.
    powers = np.einsum("rii->ri", normal[:, q:, q:])
    ridge = STATE_REGULARISATION * powers[:, :, None] * np.eye(powers.shape[1])
    # A known initial state is not fitted, so it is not eliminated.
    state_block, cross = hold_known_states(
        normal[:, q:, q:] + np.diag(precision) + ridge,
        normal[:, :q, q:],
        evaluator.known_state_mask,
    )
    return FisherBlocks(noise, flat_jacobian, normal[:, :q, :q], cross, state_block)


def compute_intervals(
    models: ModelSet, model: FittedModel
) -> dict[int, tuple[float, float, float]]:
    """Compute the 95 % interval of each fitted parameter from the covariance of the fit.

    An interval that is wider than a share of the plausible range says nothing, and is replaced by
    NaN.

    Args:
        models: Models with the run evaluator.
        model: Fitted model.

    Returns:
        Value, low and high by index in the parameter vector; low and high are NaN if the data do
        not bound the parameter.
    """
    variances = np.diagonal(compute_covariance(models, model))
    # Rounding may make a variance negative.
    standard_errors = np.sqrt(np.maximum(variances, 0.0))
    indices = model.fit.free_indices.tolist()
    intervals = {}
    for index, standard_error in zip(indices, standard_errors.tolist(), strict=True):
        value = float(model.fit.theta[index])
        low, high = models.evaluator.parameters[index].bounds
        # A value may be far outside its plausible range, and is then the scale itself.
        size = max(high - low, abs(value))
        is_bounded = (
            np.isfinite(standard_error) and 2.0 * Z95 * standard_error < MAX_INTERVAL_WIDTH * size
        )
        half_width = Z95 * standard_error if is_bounded else np.nan
        intervals[index] = (
            value,
            value - half_width,
            value + half_width,
        )
    return intervals


@dataclass(frozen=True)
class HeldOutGain:
    """Held-out errors and the share of the gap closed.

    Attributes:
        base: RMS error of the base model, in the unit of the channels.
        extended: RMS error of the extended model.
        floor: RMS of the noise.
        gap_closed: Share of the gap closed, eq. (1) of the module docstring.
        low: Lower end of its 95 % interval; NaN if there is none.
        high: Upper end of its 95 % interval; NaN if there is none.
    """

    base: float
    extended: float
    floor: float
    gap_closed: float
    low: float
    high: float


def compute_held_out_gain(
    evaluator: RunEvaluator,
    before: Array,
    after: Array,
    channels: Sequence[int],
    floor: float,
    rng: np.random.Generator,
    resamples_segments: bool = False,
) -> HeldOutGain:
    """Compute the share of the gap closed, eq. (1), with a bootstrap interval over runs.

    With a single run, or on request, segments of the runs are resampled (D. N. Politis, J. P.
    Romano 1992).

    For RMS errors b before and a after and the noise floor n, it is (b - max(a, n)) / (b - n) (1).

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: Run evaluator of the held-out runs.
        before: (R, T, C) simulated by the base model.
        after: (R, T, C) simulated by the extended model.
        channels: Indices of the channels that count; they share a unit.
        floor: RMS of the noise over these channels.
        rng: Random generator of the resampling.
        resamples_segments: Whether the bootstrap draws segments of the runs instead of whole runs;
            two or three runs are too few to draw from.
    """
    sums = _sum_squared_errors(evaluator, before, after, channels, resamples_segments)
    rms_before, rms_after = _compute_rms_errors(sums.sum(axis=0))
    # Whole runs are drawn, because samples of one run depend on each other.
    part_count = len(sums)
    drawn_parts = rng.integers(part_count, size=(BOOTSTRAP_RESAMPLES, part_count))
    resampled = sums[drawn_parts].sum(axis=1)
    shares = compute_closed_share(*_compute_rms_errors(resampled), floor)
    low = high = np.nan
    # All resamples of a single part are equal, and would look certain.
    if part_count > 1:
        low, high = np.quantile(shares, INTERVAL_QUANTILES).tolist()
    gap_closed = float(compute_closed_share(rms_before, rms_after, floor))
    return HeldOutGain(float(rms_before), float(rms_after), floor, gap_closed, low, high)


def _sum_squared_errors(
    evaluator: RunEvaluator,
    before: Array,
    after: Array,
    channels: Sequence[int],
    resamples_segments: bool,
) -> Array:
    """Sum up the squared errors of two models over each run or segment, for the bootstrap.

    The bootstrap draws rows and adds them, so that no error is computed again. Each row (n, 3) has
    the sum of squares of the base model, that of the extended model, and the number of samples.

    Shapes: R runs, T samples, C channels.

    Args:
        evaluator: the predicted runs.
        before: (R, T, C) prediction of the base model.
        after: (R, T, C) prediction of the extended model.
        channels: indices of the channels that count.
        resamples_segments: whether the rows are segments of runs, because there are too few runs to
            resample.
    """
    part_sums = []
    for run, part in _list_resampled_parts(evaluator, resamples_segments):
        observed = evaluator.observed[run, part][:, channels]
        observed_mask = np.isfinite(observed)
        # A part without samples would be a row of zeros with an undefined error.
        if not observed_mask.any():
            continue
        sums = []
        for simulated in (before, after):
            simulated_part = simulated[run, part][:, channels]
            error = (observed - simulated_part)[observed_mask]
            sums.append(float(error @ error))
        sums.append(float(observed_mask.sum()))
        part_sums.append(sums)
    return np.array(part_sums)


def _list_resampled_parts(
    evaluator: RunEvaluator, resamples_segments: bool
) -> list[tuple[int, slice]]:
    """List the parts that the bootstrap resamples: whole runs, or segments of too few runs.

    Whole runs are better, because neighbouring segments depend on each other.

    Args:
        evaluator: the predicted runs.
        resamples_segments: whether the parts are segments even if there are several runs.

    Returns:
        Index of the run and slice of its samples, for each part.
    """
    count = len(evaluator.prepared_runs)
    if count > 1 and not resamples_segments:
        return [(run, slice(None)) for run in range(count)]
    parts = []
    for run, length in enumerate(evaluator.lengths.tolist()):
        samples = np.linspace(0, length, SINGLE_RUN_SEGMENTS + 1).astype(int).tolist()
        # A run of few samples has empty segments.
        parts += [(run, slice(begin, end)) for begin, end in pairwise(samples) if end > begin]
    return parts


def _compute_rms_errors(sums: Array) -> tuple[Array, Array]:
    """Compute RMS errors before and after from sums (..., 3) of squares, and numbers of samples."""
    before, after, counts = np.moveaxis(sums, -1, 0)
    return np.sqrt(before / counts), np.sqrt(after / counts)


def compute_closed_share(base: Array | float, extended: Array | float, floor: float) -> Array:
    """Compute the share of the gap closed, eq. (1), of any number of models; 0 without a gap.

    For RMS errors b before and a after and the noise floor n, it is (b - max(a, n)) / (b - n) (1).

    Args:
        base: RMS errors before.
        extended: RMS errors after.
        floor: RMS of the noise.
    """
    gap = base - floor
    # A model cannot reduce the error below the noise floor.
    reached_error = np.maximum(extended, floor)
    with np.errstate(all="ignore"):
        share = (base - reached_error) / np.asarray(gap)  # (1)
    # A gap below rounding errors would give an arbitrary share, and a resample may have no gap.
    shares = np.where(gap > 1e-3 * floor, share, 0.0)
    return np.clip(shares, MIN_REPORTED_GAIN, 1.0)
