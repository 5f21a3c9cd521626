"""A Gaussian process over what the base model leaves: it says that something is missing, and never
what.

The discrepancy is a function of time, state and input with a Gaussian process as its prior (M. C.
Kennedy, A. O'Hagan, J. R. Stat. Soc. B 63, 425, 2001, doi:10.1111/1467-9868.00294), here of
accelerations, as residual models of robots have it. It is fitted on some runs; where it predicts
the others better than nothing does, something is missing.
"""

from __future__ import annotations

import warnings
from itertools import pairwise

import numpy as np

from bench.diagnoser import Answer, Case, Diagnoser
from bench.diagnosers.evidence import Evidence, Rows

LEVEL = 0.01
"""Chance of a false alarm that is wanted."""
FITTED = 160
"""Samples that the process is conditioned on."""
BLOCKS = 12
"""Parts of the held-out runs whose gains are compared."""


class Discrepancy(Diagnoser):
    """A Gaussian process over the accelerations that are left: the alarm alone, no name."""

    name = "gp"

    def diagnose(self, case: Case) -> Answer:
        """Unknown where runs that are held out are predicted better with it."""
        evidence = Evidence(case)
        try:
            rows = evidence.accelerations()
        finally:
            evidence.close()
        chance = _chance(rows.of(evidence.fitted), rows.of(evidence.held_out), case.rng)
        return Answer("adequate" if chance >= LEVEL else "unknown", p_value=chance)


def _chance(fitted: Rows, held_out: Rows, rng: np.random.Generator) -> float:
    """Probability of the gain on held-out runs if the process had nothing to say."""
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
