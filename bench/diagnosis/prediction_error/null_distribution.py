"""Scores of candidates and their null distribution.

Under the null hypothesis, twice the gain in log-likelihood by k further coefficients has a
chi-squared distribution with k degrees of freedom (S. S. Wilks 1938, doi:10.1214/aoms/1177732360).
The score of an effect with n shapes is the best of them, and the score of the library is the best
of its effects. Shapes are assumed independent, which overestimates the gain under the null
hypothesis.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from scipy.special import chdtrc, chdtri

from bench.diagnosis.prediction_error.regression_selection import Regression
from bench.diagnosis.search.explained_variance import DirectionGroup
from bench.diagnosis.search.score_test import NULL_QUANTILE, CandidateScores

DRAWS = 200
"""Number of draws from the null distribution."""


def p_value_of_gain(gain: float, coefficients: int, candidates: int) -> float:
    """Return the p-value of the largest gain among several candidates.

    Args:
        gain: gain in twice the log-likelihood.
        coefficients: number of coefficients of each candidate.
        candidates: number of candidates.
    """
    return min(candidates * float(chdtrc(coefficients, max(gain, 0.0))), 1.0)


def null_scores(
    regression: Regression, lacking: Collection[str], rng: np.random.Generator
) -> CandidateScores:
    """Score effects by a regression.

    Args:
        regression: regression about the model that lacks the effects.
        lacking: names of the effects to score.
        rng: random numbers for draws from the null distribution.
    """
    gains = regression.gains([])
    by_effect: dict[str, list[int]] = {}
    for i, group in enumerate(regression.groups):
        if group.effect in lacking:
            by_effect.setdefault(group.effect, []).append(i)
    names = list(by_effect)
    score = np.array([max(gains[i] for i in by_effect[name]) for name in names])
    chance, drawn, p_values, peaks = [], [], [], []
    for name, best in zip(names, score.tolist(), strict=True):
        own = by_effect[name]
        freedom = max(len(regression.groups[i].column_indices) for i in own)
        shapes = len(own)
        chance.append(float(chdtri(freedom, 1.0 - NULL_QUANTILE ** (1.0 / shapes))))
        uniform = rng.random(DRAWS) ** (1.0 / shapes)
        drawn.append(chdtri(freedom, 1.0 - uniform))
        p_values.append(p_value_of_gain(best, freedom, shapes))
        peak: DirectionGroup = regression.groups[max(own, key=lambda i: gains[i])]
        peaks.append(((peak, regression.solve([peak])[1][0]),))
    order = np.argsort(-score, kind="stable")
    luck = np.array(chance)
    by_chance = np.array(drawn).reshape(len(names), DRAWS) - luck[:, None]
    p_value = min(len(names) * min(p_values, default=1.0), 1.0)
    return CandidateScores(
        effects=tuple(names[i] for i in order),
        score=score[order],
        null_quantiles=luck[order],
        peaks=tuple(peaks[i] for i in order),
        p_value=p_value,
        phi=0.0,
        null_scores=by_chance[order],
        white_noise_scores=score[order],
    )
