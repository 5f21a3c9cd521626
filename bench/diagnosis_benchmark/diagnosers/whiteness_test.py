"""Whiteness test of the residual, and correlation with the directions of the effects.

The base model is fitted and its residual is tested for whiteness (G. M. Ljung, G. E. P. Box,
Biometrika 65(2), 297, 1978, doi:10.1093/biomet/65.2.297). The effects that correlate with it are
named. This is the residual analysis of textbooks (L. Ljung, System Identification, 2nd ed., section
16.6), and of published agents for system identification, with thresholds of 0.3 to 0.5. The
correlation is computed with the direction of each effect, after parameters and initial states are
projected out.
"""

from __future__ import annotations

from contextlib import closing

import numpy as np

from bench.core.diagnoser import Answer, Diagnoser, DiagnosisCase, NamedCause
from bench.diagnosis_benchmark.diagnosers.regression_evidence import (
    RegressionEvidence,
    find_strongest_columns,
)

FALSE_ALARM_RATE = 0.01
"""False-alarm probability over all runs and channels."""
LAG_COUNT = 20
"""Number of autocorrelations in the Ljung-Box statistic."""
MIN_CORRELATION = 0.5
"""Minimum correlation with an effect's direction for which the effect is named."""
CORRELATION_TIE_TOLERANCE = 0.02
"""Difference from the highest correlation up to which effects are indistinguishable."""


class WhitenessTest(Diagnoser):
    """Whiteness of the residual (Ljung-Box), and the effects that it correlates with."""

    name = "ljung-box"

    def diagnose(self, case: DiagnosisCase) -> Answer:
        """Name the effects with the highest correlation if the residual is not white.

        A white residual gives "adequate". If no effect correlates by at least `MIN_CORRELATION`,
        the answer is "unknown"; effects that correlate almost as well as the best are its
        alternatives.

        Args:
            case: recording, simulator and effects, without the hidden causes.
        """
        with closing(RegressionEvidence.collect(case)) as evidence:
            p_value = _compute_whiteness_p_value(evidence)
            if p_value >= FALSE_ALARM_RATE:
                return Answer("adequate", p_value=p_value)
            rows = evidence.build_trajectory_regression()
            # Without the part that parameters and initial states explain.
            residual, effects = rows.project_out_base()
            # By effect, the decrease of the sum of squares by its best column.
            best = find_strongest_columns(residual, effects, evidence.effect_columns)
        # The correlation is the root of the fraction of the sum of squares that a column explains.
        total = float(residual @ residual)
        correlated = {name: (gain / total) ** 0.5 for name, (gain, _) in best.items()}
        if max(correlated.values(), default=0.0) < MIN_CORRELATION:
            return Answer("unknown", p_value=p_value)
        most_correlated, *other_effects = sorted(correlated, key=lambda name: -correlated[name])
        alternatives = [
            name
            for name in other_effects
            if correlated[most_correlated] - correlated[name] <= CORRELATION_TIE_TOLERANCE
        ]
        cause = NamedCause(most_correlated, tuple(alternatives), p_value=p_value)
        return Answer("ambiguous" if alternatives else "named", (cause,), p_value=p_value)


def _compute_whiteness_p_value(evidence: RegressionEvidence) -> float:
    """Compute the p-value of the hypothesis that all residuals are white noise.

    The Ljung-Box test asks for each run and channel whether samples correlate with earlier ones.
    The smallest p-value counts, multiplied by the number of tests (Bonferroni's correction). Series
    that are constant or not longer than twice the number of autocorrelations are left out; if none
    remains, the p-value is 1.

    Args:
        evidence: fitted base model with its residual.
    """
    from statsmodels.stats.diagnostic import acorr_ljungbox

    p_values = []
    runs, _, channels = evidence.residual.shape  # (R, T, C)
    for run_index in range(runs):
        for channel_index in range(channels):
            values = evidence.residual[run_index][
                evidence.observed_mask[run_index, :, channel_index], channel_index
            ]
            if values.size > 2 * LAG_COUNT and np.ptp(values) > 0:
                table = acorr_ljungbox(values, lags=[LAG_COUNT])
                p_values.append(float(table["lb_pvalue"].iloc[0]))
    return min(1.0, len(p_values) * min(p_values)) if p_values else 1.0
