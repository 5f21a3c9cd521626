"""Gaussian-process discrepancy model: detects that something is missing, names no cause.

The discrepancy is a function of time, state and input with a Gaussian process as its prior (M. C.
Kennedy, A. O'Hagan, J. R. Stat. Soc. B 63, 425, 2001, doi:10.1111/1467-9868.00294), here of
accelerations, as in residual models of robots. It is fitted on the runs for fitting. If it predicts
the residual of the held-out runs better than zero does, something is missing.
"""

from __future__ import annotations

import warnings
from contextlib import closing

import numpy as np

from bench.core.diagnoser import Answer, Diagnoser, DiagnosisCase
from bench.diagnosis_benchmark.diagnosers.regression_evidence import (
    RegressionData,
    RegressionEvidence,
    compute_block_means,
    compute_standard_error,
)

FALSE_ALARM_RATE = 0.01
"""False-alarm probability."""
TRAINING_SAMPLE_COUNT = 160
"""Maximum number of samples on which the process is conditioned."""
HELD_OUT_BLOCK_COUNT = 12
"""Number of blocks of the held-out runs whose improvements are compared."""
VARIANCE_BOUNDS = (1e-3, 1e3)
"""Bounds of the kernel's variance, in units of the standardised residual squared."""
LENGTH_BOUNDS = (0.05, 100.0)
"""Bounds of the kernel's length scales, in standard deviations of each input."""
NOISE_BOUNDS = (1e-2, 1e2)
"""Bounds of the noise variance, in units of the standardised residual squared."""


class GaussianProcessDiscrepancy(Diagnoser):
    """Gaussian process of the acceleration residuals: detects a discrepancy, names no cause."""

    name = "gp"

    def diagnose(self, case: DiagnosisCase) -> Answer:
        """Return "unknown" if the process predicts held-out runs better than zero does.

        Otherwise the verdict is "adequate": a residual that cannot be predicted is noise.
        """
        with closing(RegressionEvidence.collect(case)) as evidence:
            rows = evidence.build_acceleration_regression()
        # `fitted` and `held_out` are the indices of the runs for fitting and of the others.
        p_value = _compute_gain_p_value(
            rows.select_runs(evidence.fitted), rows.select_runs(evidence.held_out), case.rng
        )
        return Answer("adequate" if p_value >= FALSE_ALARM_RATE else "unknown", p_value=p_value)


def _compute_gain_p_value(
    fitted: RegressionData, held_out: RegressionData, rng: np.random.Generator
) -> float:
    """Compute the p-value of the improvement on held-out runs: one-sided t-test over blocks.

    The gain of a sample is the decrease of its squared residual by the prediction of the Gaussian
    process. Blocks of consecutive samples are compared because neighbouring samples are correlated.

    Args:
        fitted: acceleration residuals of the runs for fitting.
        held_out: acceleration residuals of the held-out runs.
        rng: random generator, which selects the samples on which the process is conditioned.

    Returns:
        The p-value; 1 if there are too few samples.
    """
    from scipy.stats import t as students
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    if min(len(fitted.residual), len(held_out.residual)) < 2 * HELD_OUT_BLOCK_COUNT:
        return 1.0
    centre, scale = fitted.state.mean(axis=0), fitted.state.std(axis=0)
    is_varying = scale > 0  # a constant input cannot be standardised
    fitted_inputs = (fitted.state - centre)[:, is_varying] / scale[is_varying]
    held_out_inputs = (held_out.state - centre)[:, is_varying] / scale[is_varying]
    # A Gaussian process costs the cube of its number of samples.
    training_indices = np.sort(
        rng.choice(
            len(fitted_inputs), min(TRAINING_SAMPLE_COUNT, len(fitted_inputs)), replace=False
        )
    )
    # A smooth function (RBF) plus noise; fitting finds its size, its length scales and the noise.
    kernel = ConstantKernel(1.0, VARIANCE_BOUNDS) * RBF(
        np.ones(fitted_inputs.shape[1]), LENGTH_BOUNDS
    ) + WhiteKernel(1.0, NOISE_BOUNDS)
    process = GaussianProcessRegressor(kernel, normalize_y=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns if a hyperparameter reaches its bound
        process.fit(fitted_inputs[training_indices], fitted.residual[training_indices])
    predicted = process.predict(held_out_inputs)
    gains = np.square(held_out.residual) - np.square(held_out.residual - predicted)
    block_means = compute_block_means(gains, HELD_OUT_BLOCK_COUNT)
    standard_error = compute_standard_error(block_means)
    if standard_error == 0:
        return 1.0
    return float(students.sf(block_means.mean() / standard_error, HELD_OUT_BLOCK_COUNT - 1))
