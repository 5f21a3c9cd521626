"""Covariance and confidence intervals of fitted parameters.

The covariance of the fitted parameters is the inverse of the curvature of the sum of squares after
the initial states of every run r are eliminated (W. H. Greene, Econometric Analysis, chapter 9;
generalised least squares). With the whitened Jacobian J_r = [A_r B_r] by parameters and initial
states, and the prior standard deviation sigma_0 of the initial states,

    covariance = (sum_r A_r' A_r - A_r' B_r (B_r' B_r + diag sigma_0^-2)^-1 B_r' A_r)^-1       (1)

Simulated contacts jump, so that the sum of squares of a run has several minima, and the estimates
of single runs scatter more than noise explains. With the gradient g_r of run r and the covariance C
of (1), the scatter of R runs gives the variances

    diag(C sum_r g_r g_r' C) R / (R - 1)                                                       (2)
    g_r = A_r' e_r - A_r' B_r (B_r' B_r + diag sigma_0^-2)^-1 B_r' e_r

for whitened residuals e_r, which replace smaller ones of C (H. White, Econometrica 50, 1, 1982,
doi:10.2307/1912526; for groups of samples: K.-Y. Liang, S. Zeger, Biometrika 73, 13, 1986,
doi:10.1093/biomet/73.1.13).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.noise_model import NoiseModel, whiten
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.fitted_models import FittedModel, ModelSet
from bench.diagnosis.fitting.levenberg_marquardt import (
    TrajectoryFit,
    compute_schur_complement,
    hold_known_states,
)
from bench.diagnosis.fitting.trajectory_derivatives import compute_central_jacobian
from bench.diagnosis.fitting.trajectory_fit import compute_state_prior
from sims.core.simulator import Array

Z95 = 1.959964
"""Half the width of the 95 % interval of a normal distribution, in standard deviations."""
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
MIN_EIGENVALUE = 1e-12
"""Minimum eigenvalue of the scaled curvature; a direction with a smaller one is unidentified."""


def get_central_jacobian(models: ModelSet, fit: TrajectoryFit) -> TrajectoryFit:
    """Return the result of `compute_central_jacobian` for a fit; it is computed once and cached.

    Args:
        models: Models with the run evaluator, the noise and the cache.
        fit: Fit with a one-sided Jacobian.
    """
    cached_fit, refined_fit = models.refined_jacobians.get(id(fit), (None, fit))
    # An id can be reused after an object is deleted, so the object itself is compared.
    if cached_fit is not fit:
        refined_fit = compute_central_jacobian(models.evaluator, fit, models.noise)
        models.refined_jacobians[id(fit)] = fit, refined_fit
    return refined_fit


def compute_covariance(models: ModelSet, model: FittedModel) -> Array:
    """Compute the covariance (q, q) of the fitted parameters with AR(1) noise.

    It is the inverse of the curvature of the whitened sum of squares, from which the initial states
    of each run are eliminated:

        (sum_r A_r'A_r - A_r'B_r (B_r'B_r + diag sigma_0^-2)^-1 B_r'A_r)^-1                     (1)

    with the whitened derivatives A_r of run r by parameters and B_r by its initial state, whose
    prior has the standard deviation sigma_0. If simulated contacts jump, a variance of (1) that is
    smaller than that by the scatter of the runs, eq. (2) of the module docstring, is replaced by
    it. Correlations are kept. The latter is scaled so that the quantile of a normal distribution
    gives the interval by Student's t.

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
    # A single run has no scatter.
    if not models.has_contact_jumps or len(fisher_blocks.parameters) == 1:
        return covariance
    # Only models with contact jumps need this import, which takes long.
    from scipy.special import stdtrit

    gradients = _compute_run_scores(models, model, fisher_blocks)
    count = len(gradients)
    # A row is the change of the parameters by which one run contributes to the fit.
    changes_by_run = gradients @ covariance
    scatter_variances = np.square(changes_by_run).sum(axis=0) * count / (count - 1)  # (2)
    # Few runs estimate their scatter poorly: quantile of Student's t instead of the normal one.
    scatter_variances *= np.square(stdtrit(count - 1, 0.975) / Z95)
    variances = np.maximum(np.diagonal(covariance), np.finfo(float).tiny)
    # Factors of the standard errors, at least 1, so that variances never become smaller.
    factors = np.sqrt(np.maximum(scatter_variances / variances, 1.0))
    widened: Array = covariance * np.outer(factors, factors)
    return widened


def _compute_run_scores(models: ModelSet, model: FittedModel, blocks: FisherBlocks) -> Array:
    """Compute the gradient of the likelihood of each run by the q parameters, (R, q).

    Its initial states are eliminated, with the whitened residual e_r of run r, its derivatives A_r
    by parameters and B_r by initial states, and their prior: g_r of eq. (2), which is

        A_r'e_r - A_r'B_r (B_r'B_r + diag sigma_0^-2)^-1 B_r'e_r

    Shapes: R runs.

    Args:
        models: the models, with the runs to which they are fitted.
        model: fitted model.
        blocks: its curvature blocks.
    """
    residual = models.compute_residual(model.fit)[..., None]
    whitened = whiten(residual, models.observed_mask, blocks.noise).reshape(len(residual), -1, 1)
    gradients = np.matmul(blocks.jacobian.transpose(0, 2, 1), whitened)
    q = blocks.parameters.shape[1]
    # A'e and B'e of each run.
    parameter_gradients, state_gradients = gradients[:, :q], gradients[:, q:]
    # (B'B + diag sigma_0^-2)^-1 B'e, the step of the initial states alone.
    state_steps = np.linalg.solve(blocks.states, state_gradients)
    scores: Array = (parameter_gradients - blocks.cross @ state_steps)[..., 0]
    return scores


def invert_scaled(parameter_curvature: Array, schur_complement: Array) -> Array:
    """Invert the curvature after elimination of the initial states, which gives the covariance.

    Directions that the data do not identify get a huge variance instead of a division by zero: the
    eigenvalues of the scaled curvature have the lower limit `MIN_EIGENVALUE`. Parameters are scaled
    by their own curvature before, so that this limit does not depend on units.

    Shapes: q fitted parameters.

    Args:
        parameter_curvature: (q, q) curvature by the parameters alone, which scales the inversion.
        schur_complement: (q, q) curvature after elimination of the initial states.

    Returns:
        The covariance (q, q), in the units of the parameters.
    """
    diagonal = np.diagonal(parameter_curvature)
    scale = np.sqrt(np.maximum(diagonal, MIN_CURVATURE))
    scale_products = np.outer(scale, scale)
    scaled = schur_complement / scale_products
    values, vectors = np.linalg.eigh(scaled)
    # A pseudo-inverse would give an unidentified direction no variance at all.
    inverse = (vectors / np.maximum(values, MIN_EIGENVALUE)) @ vectors.T
    result: Array = inverse / scale_products  # (1)
    return result


class FisherBlocks(NamedTuple):
    """Blocks of the covariance, eq. (1) of the module docstring, for each run.

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
    """Compute the curvature blocks of a fitted model, run by run, with central differences.

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
    """Compute the curvature blocks of each run from a Jacobian, for the covariance of parameters.

    With the whitened derivatives A by parameters and B by initial states, they are A'A, A'B, and
    B'B with the prior of the initial states. Whitening makes them information in units of the
    noise.

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
    parameter_block, cross, state_block = normal[:, :q, :q], normal[:, :q, q:], normal[:, q:, q:]
    precision = 1.0 / compute_state_prior(evaluator) ** 2
    # In an unstable motion the derivatives by all initial states may be collinear.
    powers = np.einsum("rii->ri", state_block)  # (R, s) diagonals
    ridge = STATE_REGULARISATION * powers[:, :, None] * np.eye(powers.shape[1])
    # A known initial state is not fitted, so it is not eliminated.
    state_block, cross = hold_known_states(
        state_block + np.diag(precision) + ridge, cross, evaluator.known_state_mask
    )
    return FisherBlocks(noise, flat_jacobian, parameter_block, cross, state_block)


def compute_intervals(
    models: ModelSet, model: FittedModel
) -> dict[int, tuple[float, float, float]]:
    """Compute the 95 % interval of each fitted parameter from the covariance of the fit.

    An interval that is wider than a multiple of the plausible range says nothing, and its ends are
    replaced by NaN.

    Args:
        models: Models of the runs, with the run evaluator to which they are fitted.
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
        intervals[index] = value, value - half_width, value + half_width
    return intervals
