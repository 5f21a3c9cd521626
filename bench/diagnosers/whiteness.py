"""Whiteness test of the residual, and correlation with the directions of the effects.

The base model is fitted and its residual is tested for whiteness (G. M. Ljung, G. E. P. Box,
Biometrika 65(2), 297, 1978, doi:10.1093/biomet/65.2.297). The effects that correlate with it are
named. This is the residual analysis of textbooks (L. Ljung, System Identification, 2nd ed., section
16.6), and of published agents for system identification, with thresholds of 0.3 to 0.5. The
correlation is computed with the direction of each effect, after parameters and initial states are
projected out.
"""

from __future__ import annotations

import numpy as np

from bench.diagnoser import Answer, Case, Diagnoser, Named
from bench.diagnosers.evidence import Evidence, strongest

LEVEL = 0.01
"""False-alarm probability over all runs and channels."""
LAGS = 20
"""Number of autocorrelations in the Ljung-Box statistic."""
CORRELATION = 0.5
"""Minimum correlation with an effect's direction for which the effect is named."""
CLOSE = 0.02
"""Difference from the highest correlation up to which effects are indistinguishable."""


class Whiteness(Diagnoser):
    """Whiteness of the residual (Ljung-Box), and the effects that it correlates with."""

    name = "ljung-box"

    def diagnose(self, case: Case) -> Answer:
        """Name the effects with the highest correlation if the residual is not white."""
        evidence = Evidence(case)
        try:
            chance = _whiteness(evidence)
            if chance >= LEVEL:
                return Answer("adequate", p_value=chance)
            rows = evidence.trajectories()
            left, effects = rows.projected()
            best = strongest(left, effects, evidence.columns)
        finally:
            evidence.close()
        total = float(left @ left)
        correlated = {name: (gain / total) ** 0.5 for name, (gain, _) in best.items()}
        order = sorted(correlated, key=lambda name: -correlated[name])
        if not order or correlated[order[0]] < CORRELATION:
            return Answer("unknown", p_value=chance)
        first, *others = order
        alike = [name for name in others if correlated[first] - correlated[name] <= CLOSE]
        cause = Named(first, tuple(alike), p_value=chance)
        return Answer("ambiguous" if alike else "named", (cause,), p_value=chance)


def _whiteness(evidence: Evidence) -> float:
    """Compute the smallest Ljung-Box p-value of all runs and channels, Bonferroni-corrected."""
    from statsmodels.stats.diagnostic import acorr_ljungbox

    chances = []
    runs, _, channels = evidence.residual.shape
    for r in range(runs):
        for c in range(channels):
            values = evidence.residual[r][evidence.seen[r, :, c], c]
            if values.size > 2 * LAGS and np.ptp(values) > 0:
                table = acorr_ljungbox(values, lags=[LAGS])
                chances.append(float(table["lb_pvalue"].iloc[0]))
    return min(1.0, len(chances) * min(chances)) if chances else 1.0
