"""Decision thresholds, and the rules that select one of six verdicts.

`search.diagnose` asks the questions in order; each answer is decided by one function here.
Errors are in units of the noise unless stated otherwise: RMS 1 is noise alone. An *excess* is this
RMS minus one, so it is 0 for a model whose residual is only noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sims.core.simulator import Array

VerdictName = Literal["adequate", "named", "ambiguous", "partial", "unknown", "unidentifiable"]

VERDICT_MEANINGS: Mapping[VerdictName, str] = {
    "adequate": "these data show no missing effect",
    "named": "one cause, or several jointly, explains the gap",
    "ambiguous": "several causes explain the gap equally well",
    "partial": "the causes are significant, but the residual still has structure",
    "unknown": "there is a gap that no effect of the library explains",
    "unidentifiable": "the data do not identify the parameters of the model without causes",
}
"""Meaning of each verdict, in one sentence."""

MIN_MOTION_SIGMAS = 6.0
"""Maximum range of a channel without motion, in sigmas of its noise."""
MAX_RESIDUAL_SIGMAS_AT_REST = 3.0
"""Maximum residual of the base model for a recording without motion, in sigmas of the noise."""
MAX_RELATIVE_STANDARD_ERROR = 0.5
"""Maximum standard error of an identifiable base parameter, as a share of its bounds."""
NOISE_TOLERANCE = 0.05
"""Maximum relative excess of the residual over specified noise; no sensor is known better."""
EXCESS_STANDARD_ERRORS = 4.0
"""Maximum further excess of the residual, in standard errors of its finite-sample RMS."""
MAX_AUTOCORRELATED_NOISE_RATIO = 7.0
"""Maximum ratio of the residual to an estimated noise floor that AR(1) noise may explain.

A larger ratio would require a correlation over 30 samples, which no sensor noise has.
"""
STRUCTURE_P_VALUE_THRESHOLD = 1e-3
"""P-value threshold of the lack-of-fit test if the recording specifies its noise."""
STRUCTURE_P_VALUE_THRESHOLD_ESTIMATED_NOISE = 1e-4
"""P-value threshold of the lack-of-fit test if noise is estimated, as it may be autocorrelated."""
EFFECT_P_VALUE_THRESHOLD = 0.003
"""P-value threshold for accepting an effect."""
HELD_OUT_EXCESS_THRESHOLD = 0.5
"""Excess on held-out runs above which an effect must reduce it clearly."""
MIN_HELD_OUT_IMPROVEMENT = 0.1
"""Minimum relative reduction of the held-out excess that is a clear reduction."""
INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO = 7.0
"""Minimum difference in twice the log-likelihood of distinguishable models: odds of 33 to 1."""
INDISTINGUISHABLE_EXCESS_RATIO = 1.2
"""Maximum ratio of excesses of indistinguishable causes, if the residual has structure."""
NEGLIGIBLE_EXCESS = 0.1
"""Minimum excess in ratios of excesses; smaller values are replaced by it."""
MIN_GAP_CLOSED = 0.7
"""Minimum share of the discrepancy that effects must remove to be its explanation."""
UNSEEN_EFFECT_EXCESS = 0.5
"""Minimum excess on held-out runs that shows something the fitted runs do not."""
EARLY_STOP_MEANINGS: Mapping[VerdictName, str] = {
    "partial": "the causes are significant; the search stopped before testing for further causes",
    "unknown": "the search stopped before it identified a cause",
}
"""Meaning of each verdict of a search that ended early; such a search has no other verdicts."""
OPEN: str = "a cause is found, but one of its coefficients is at a bound or has no finite interval"
"""Meaning of `partial` if a coefficient of a cause is at a bound or has no finite interval."""
BORDERING: str = (
    "a cause is found, but a base parameter is at a bound of its range, "
    "and the cause may compensate for a value beyond it"
)
"""Meaning of `partial` if a base parameter is at a bound of its range."""
FAULTY: str = "the recording states a wrong unit or sign; correct it and run again"
"""Meaning of `unknown` for a recording with a wrong unit or sign."""
OPTIONAL_QUESTIONS: frozenset[str] = frozenset({"structure", "alternatives"})
"""Questions of a search that may stay open if a cause is accepted after an early stop."""


def is_motionless(
    ranges: Array, residual_sigma: Array, sigma: Array, is_model_sensitive: bool
) -> bool:
    """Return whether a recording shows no motion and the model expects none.

    Both are required, because a body that rests where it should fall is a discrepancy. A recording
    whose channels are all constant shows no motion in any case.

    Args:
        ranges: (C,) maximum minus minimum of each channel.
        residual_sigma: (C,) standard deviation of the residual of the base model, in the unit of
            the channel.
        sigma: (C,) noise floor in the unit of the channel.
        is_model_sensitive: whether any base parameter changes the simulated runs.
    """
    is_at_rest = bool(
        (ranges < MIN_MOTION_SIGMAS * sigma).all()
        and (residual_sigma < MAX_RESIDUAL_SIGMAS_AT_REST * sigma).all()
    )
    # All ranges are exactly zero.
    is_constant = not ranges.any()
    # A constant recording contains no information, whatever the model expects.
    return is_constant or (is_at_rest and not is_model_sensitive)


def is_identified(sd: float, low: float, high: float) -> bool:
    """Return whether the data determine a base parameter.

    Bounds are what is physically possible, so a standard error of half their width means almost no
    information.

    Args:
        sd: standard error of the parameter.
        low: lower bound.
        high: upper bound.
    """
    return sd < MAX_RELATIVE_STANDARD_ERROR * (high - low)


def exceeds_noise(excess: float, error: float, is_noise_stated: bool) -> bool:
    """Return whether the residual of a channel exceeds its noise significantly.

    Args:
        excess: RMS residual of the channel divided by its noise floor; 1 is noise alone.
        error: relative standard error of this RMS.
        is_noise_stated: whether the recording specifies the noise; an estimated floor assumes white
            noise and may be several times too small.
    """
    if is_noise_stated:
        return excess > 1.0 + NOISE_TOLERANCE + EXCESS_STANDARD_ERRORS * error
    # Autocorrelated noise may exceed an estimated floor by this factor.
    return excess > MAX_AUTOCORRELATED_NOISE_RATIO


def get_structure_threshold(is_noise_stated: bool) -> float:
    """Return the p-value threshold of the lack-of-fit test.

    It is lower if noise is estimated, because such noise may be autocorrelated.

    Args:
        is_noise_stated: whether the noise of all channels is specified.
    """
    if is_noise_stated:
        return STRUCTURE_P_VALUE_THRESHOLD
    return STRUCTURE_P_VALUE_THRESHOLD_ESTIMATED_NOISE


def has_structure(p_value: float, level: float, channels_above_noise: Sequence[str]) -> bool:
    """Return whether the residual has structure, by the lack-of-fit test or by its size.

    Each test misses something: a cause that is not a force may not resemble one, and a small force
    does not exceed the noise.

    Args:
        p_value: p-value of the best force of any shape.
        level: threshold of this p-value.
        channels_above_noise: names of channels whose residual exceeds their noise.
    """
    return p_value < level or len(channels_above_noise) > 0


def is_unexplained(structure: bool, p_value: float) -> bool:
    """Return whether a model lacks something: a structure in the residual, or a library effect.

    Args:
        structure: whether the residual has structure.
        p_value: p-value of the best score of the library.
    """
    return structure or p_value < EFFECT_P_VALUE_THRESHOLD


def improves_held_out(likelihoods: tuple[float, float], excesses: tuple[float, float]) -> bool:
    """Return whether an effect improves the prediction of held-out runs.

    The likelihood must increase. Far from the noise, the excess residual must also decrease
    clearly, because a small gain in likelihood may only mimic another missing effect.

    Args:
        likelihoods: penalised log-likelihood of the held-out runs without the effect, and with it.
        excesses: excess residual (RMS in units of the noise, minus one) without the effect, and
            with it.
    """
    likelihood_without, likelihood_with = likelihoods
    excess_without, excess_with = excesses
    # Near the noise only the likelihood decides: 10 % of a very small excess is meaningless.
    return likelihood_with > likelihood_without and (
        excess_without < HELD_OUT_EXCESS_THRESHOLD
        or excess_with < (1.0 - MIN_HELD_OUT_IMPROVEMENT) * excess_without
    )


def is_indistinguishable(distance: float) -> bool:
    """Return whether a model is indistinguishable from a better one.

    Args:
        distance: difference in twice the log-likelihood.
    """
    return distance < INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO


def convert_excess_ratio(ratios: Sequence[float]) -> float:
    """Convert ratios of excess residuals to a difference in twice the log-likelihood.

    Both tell how far another model is behind a model, and `is_indistinguishable` has a threshold D
    for the difference. A ratio R (`INDISTINGUISHABLE_EXCESS_RATIO`) is equivalent to it:

        difference = D mean(log ratios) / log R                                                (1)

    Args:
        ratios: for each part of the data (fitted runs, held-out runs), the excess residual of the
            other model divided by that of the model; below 1 if the other one is better.
    """
    return (
        INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO
        * float(np.mean(np.log(ratios)))
        / float(np.log(INDISTINGUISHABLE_EXCESS_RATIO))
    )  # (1)


def compute_excess_ratio(excess: float, reference_excess: float) -> float:
    """Return the ratio of two excesses, each raised to at least `NEGLIGIBLE_EXCESS`.

    Args:
        excess: RMS residual in units of the noise, minus one.
        reference_excess: the excess of another model, the divisor.
    """
    # For two models at the noise floor, the ratio is random and may be arbitrarily large.
    return max(excess, NEGLIGIBLE_EXCESS) / max(reference_excess, NEGLIGIBLE_EXCESS)


def explains_gap(gap_closed: float) -> bool:
    """Return whether effects that remove this share of the discrepancy explain it.

    Below the threshold they may be real, but the main cause is not in the library.
    """
    return not gap_closed < MIN_GAP_CLOSED


def misses_held_out_gap(before: float, after: float) -> bool:
    """Return whether held-out runs show a discrepancy that the model does not remove.

    In this case something acts there that the fitted runs do not show: the excess is too large, or
    too little of the excess of the base model is removed. The excess is the RMS residual in units
    of the noise, minus one, so that it is 0 for a model that leaves only noise.

    Args:
        before: excess of the base model on held-out runs.
        after: excess of the extended model on held-out runs.
    """
    decrease = before - max(after, 0.0)
    # The comparison is negated, so that the NaN of a failed simulation counts as missed.
    return not after < UNSEEN_EFFECT_EXCESS or (
        before > UNSEEN_EFFECT_EXCESS and decrease < MIN_GAP_CLOSED * before
    )


@dataclass(frozen=True)
class DiagnosisState:
    """Answers to all questions, from which the verdict follows.

    Attributes:
        is_base_determined: whether the data determine the sensitive base parameters.
        cause_count: number of causes found.
        has_alternatives: whether at least one cause has an indistinguishable alternative.
        gap_closed: share of the discrepancy on the fitted runs that the causes remove.
        is_unexplained: whether the model with the causes still lacks something on the fitted runs.
        misses_held_out_gap: whether held-out runs show a discrepancy that the model does not
            remove.
    """

    is_base_determined: bool = True
    cause_count: int = 0
    has_alternatives: bool = False
    gap_closed: float = 0.0
    is_unexplained: bool = False
    misses_held_out_gap: bool = False


def decide_verdict(state: DiagnosisState) -> VerdictName:
    """Return the verdict that follows from the answers; the first rule that applies decides.

    Args:
        state: answers to the questions of the diagnosis: is the base model determined, does
            anything remain unexplained, how much of the gap is closed, how many causes were found,
            and have they alternatives.

    Returns:
        "unidentifiable", "unknown", "adequate", "partial", "ambiguous" or "named".
    """
    # If the base model is not determined, every cause could be a wrong parameter value.
    if not state.is_base_determined:
        return "unidentifiable"
    incomplete = state.is_unexplained or state.misses_held_out_gap
    if not state.cause_count:
        return "unknown" if incomplete else "adequate"
    # Causes that leave most of the discrepancy mimic what is missing: the report lists them, but
    # does not accept them.
    if not explains_gap(state.gap_closed):
        return "unknown"
    # Incompleteness comes before alternatives, because a set of causes is only valid for a complete
    # answer.
    if incomplete:
        return "partial"
    return "ambiguous" if state.has_alternatives else "named"


def verdict_of_numbers(verdict: VerdictName, are_results: bool) -> VerdictName:
    """Replace the verdict "named" by "partial" if the coefficients of the causes are no results.

    A coefficient at a bound of its range or without a finite interval is not a result.

    Args:
        verdict: verdict by all other rules.
        are_results: whether every coefficient of the causes without alternatives is a result.
    """
    return "partial" if verdict == "named" and not are_results else verdict


def decide_early_stop_verdict(
    causes: int, gap_closed: float, skipped_questions: Sequence[str]
) -> VerdictName:
    """Return the verdict of a search that ended early, which claims only what was tested.

    Causes are accepted ("partial") if they were compared with their competing models and on
    held-out runs, so that only `OPTIONAL_QUESTIONS` are open, and if they explain the discrepancy.
    Otherwise the verdict is "unknown". A better verdict would claim that nothing else is missing.

    Args:
        causes: number of causes found.
        gap_closed: share of the discrepancy on the fitted runs that they remove, if the residual is
            counted as structure.
        skipped_questions: the open questions.
    """
    has_required_answers = OPTIONAL_QUESTIONS.issuperset(skipped_questions)
    return "partial" if causes and has_required_answers and explains_gap(gap_closed) else "unknown"
