"""Gaussian-process discrepancy model: detects that something is missing, names no cause.

The discrepancy is a function of time, state and input with a Gaussian process as its prior (M. C.
Kennedy, A. O'Hagan, J. R. Stat. Soc. B 63, 425, 2001, doi:10.1111/1467-9868.00294), here of
accelerations, as in residual models of robots. It is fitted on the runs for fitting. If it predicts
the residual of the held-out runs better than zero does, something is missing.
"""

from __future__ import annotations

import warnings
from itertools import pairwise

import numpy as np

from bench.diagnoser import Answer, Case, Diagnoser
from bench.diagnosers.evidence import Evidence, Rows

LEVEL = 0.01
"""False-alarm probability."""
FITTED = 160
"""Maximum number of samples on which the process is conditioned."""
BLOCKS = 12
"""Number of blocks of the held-out runs whose improvements are compared."""


class Discrepancy(Diagnoser):
    """Gaussian process of the acceleration residuals: detects a discrepancy, names no cause."""

    name = "gp"

    def diagnose(self, case: Case) -> Answer:
        """Return "unknown" if the process predicts held-out runs better than zero does."""
        evidence = Evidence(case)
        try:
            rows = evidence.accelerations()
        finally:
            evidence.close()
        chance = _chance(rows.of(evidence.fitted), rows.of(evidence.held_out), case.rng)
        return Answer("adequate" if chance >= LEVEL else "unknown", p_value=chance)


def _chance(fitted: Rows, held_out: Rows, rng: np.random.Generator) -> float:
    """Compute the p-value of the improvement on held-out runs: one-sided t-test over blocks."""
    from scipy.stats import t as students
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    if min(len(fitted.left), len(held_out.left)) < 2 * BLOCKS:
        return 1.0
    centre, scale = fitted.state.mean(axis=0), fitted.state.std(axis=0)
    moving = scale > 0
    seen = (fitted.state - centre)[:, moving] / scale[moving]
    unseen = (held_out.state - centre)[:, moving] / scale[moving]
    chosen = np.sort(rng.choice(len(seen), min(FITTED, len(seen)), replace=False))
    kernel = ConstantKernel(1.0, (1e-3, 1e3)) * RBF(
        np.ones(seen.shape[1]), (0.05, 100.0)
    ) + WhiteKernel(1.0, (1e-2, 1e2))
    process = GaussianProcessRegressor(kernel, normalize_y=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        process.fit(seen[chosen], fitted.left[chosen])
    predicted = process.predict(unseen)
    gains = np.square(held_out.left) - np.square(held_out.left - predicted)
    ends = np.linspace(0, len(gains), BLOCKS + 1).astype(int)
    means = np.array([gains[a:b].mean() for a, b in pairwise(ends.tolist())])
    spread = float(means.std(ddof=1) / np.sqrt(BLOCKS))
    if spread == 0:
        return 1.0
    return float(students.sf(means.mean() / spread, BLOCKS - 1))
