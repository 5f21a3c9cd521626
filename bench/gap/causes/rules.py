"""Which of six verdicts a state of affairs is, and every threshold that decides it.

`bench.gap.causes.name` asks the questions, in order; the answers are rules here, one function each.
Errors are in units of the noise unless said otherwise: RMS 1 is noise alone, and an *excess* is
that RMS less one, so that 0 is a model that leaves nothing but noise.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sims.base import Array

VerdictName = Literal["adequate", "named", "ambiguous", "partial", "unknown", "unidentifiable"]

MEANING: Mapping[VerdictName, str] = {
    "adequate": "nothing is missing that these data can show",
    "named": "one cause, or several jointly, explains the gap",
    "ambiguous": "causes that these data cannot tell apart explain the gap",
    "partial": "the causes are real, and something besides them is missing",
    "unknown": "something is missing that no effect of the library explains",
    "unidentifiable": "the data do not fix the parameters of the model without any cause",
}
"""What each verdict says, in one sentence."""

STILL = 6.0
"""A channel whose range is below so many sigmas of its noise shows no motion."""
AT_REST = 3.0
"""What the base model leaves of a recording without motion is below so many sigmas of the noise."""
VAGUE = 0.5
"""A base parameter is not fixed if its 1 sigma is more than this share of its bounds."""
EXCESS = 0.05
"""What is left may exceed the stated noise by this share: no sensor is known better."""
SIGMAS = 4.0
"""It may exceed that by so many standard errors besides, since it is a finite sample's RMS."""
SLOWEST = 7.0
"""Estimated noise that is exceeded by more than this factor would have to remember for 30 samples:
that is no sensor's.
"""
CHANCE = 1e-3
"""Chance at which structure would be seen where there is none."""
UNSURE = 1e-4
"""The same where the recording states no noise, and a noise that remembers may be all there is."""
ALPHA = 0.003
"""Chance at which an effect would be taken for real although nothing is missing."""
NOTICED = 0.5
"""Excess of held-out runs above which an effect must make a clear difference to them."""
HELPS = 0.1
"""Share of that excess which counts as a clear difference."""
SWITCH = 7.0
"""Twice the log likelihood by which two models must differ to be told apart: odds of 33 to 1."""
SIMILAR = 1.2
"""Where structure is left, causes are alike that leave less than so many times the same excess."""
AT_THE_NOISE = 0.1
"""An excess below this is as good as none, and ratios of excesses are not taken of less."""
EXPLAINED = 0.7
"""Share of the gap that the effects must close to be taken for its explanation."""
STRANGE = 0.5
"""Excess of held-out runs above which they show something that the fitted runs do not."""
CUT: Mapping[VerdictName, str] = {
    "partial": "the causes are real, and what else is missing was not asked to the end",
    "unknown": "the search was ended before it could say what is missing",
}
"""The same as `MEANING` of a search that was ended early, which has no other verdicts."""
OPEN: str = "a cause is found, but a number of it lies at a bound or has no finite interval"
"""What `partial` says where a number of a cause is not a result."""
BORDERING: str = (
    "a cause is found, but a base parameter ends at a bound of its range, "
    "and the cause may stand for a value beyond it"
)
"""What `partial` says where a base parameter is not a result."""
FAULTY: str = "the recording states a unit or a sign wrongly; correct it before causes are searched"
"""What `unknown` says of a recording with a wrong unit or sign."""
LAST: Collection[str] = frozenset({"structure", "alternatives"})
"""Questions without which a cause may be real already."""


def shows_nothing(ranges: Array, left: Array, sigma: Array, touched: bool) -> bool:
    """Whether a recording shows no motion, and its model expects none: nothing can be learnt.

    Both are asked, since a body that rests where it ought to fall is a finding.

    Args:
        ranges: (C,) largest less smallest value of each channel.
        left: (C,) what the base model leaves, 1 sigma, in the channel's unit.
        sigma: (C,) the noise floor in the channel's unit.
        touched: whether any base parameter changes the simulated runs.
    """
    still = bool((ranges < STILL * sigma).all() and (left < AT_REST * sigma).all())
    # A recording that is one constant has nothing to say whatever its model expects.
    return (still and not touched) or not ranges.any()


def is_fixed(sd: float, low: float, high: float) -> bool:
    """Whether the data fix a base parameter with this standard error and these bounds.

    Bounds are what is physically possible, so half of their width is next to no knowledge.
    """
    return sd < VAGUE * (high - low)


def is_loud(excess: float, error: float, stated: bool) -> bool:
    """Whether what is left of a channel exceeds its noise by more than the noise is in doubt.

    Args:
        excess: RMS left in units of the noise floor.
        error: standard error of that RMS, as a share of it.
        stated: whether the recording states the noise; an estimated floor takes noise for white and
            may be several times too small.
    """
    return excess > (1.0 + EXCESS + SIGMAS * error if stated else SLOWEST)


def level_of(stated: bool) -> float:
    """Chance below which a force of any shape is structure, by whether all noise is stated."""
    return CHANCE if stated else UNSURE


def has_structure(p_value: float, level: float, loud: Sequence[str]) -> bool:
    """Whether structure is left: a force of any shape would help, or a channel is too loud.

    Either test is blind to something: what is no force need not look like one, and a small force is
    not loud.
    """
    return p_value < level or len(loud) > 0


def is_unexplained(structure: bool, chance: float) -> bool:
    """Whether a model lacks something: a structure of any shape, or an effect of the library."""
    return structure or chance < ALPHA


def helps(merits: tuple[float, float], excesses: tuple[float, float]) -> bool:
    """Whether an effect makes held-out runs better, and clearly so while they are far from noise.

    Far from the noise a small gain in merit may be mimicry of what is missing still.

    Args:
        merits: without the effect, and with it.
        excesses: the same.
    """
    # Near the noise the merit alone decides: a tenth of next to nothing says nothing.
    before, after = excesses
    return merits[1] > merits[0] and (before < NOTICED or after < (1.0 - HELPS) * before)


def is_alike(behind: float) -> bool:
    """Whether a model explains the data as well as another, this far behind in twice the log
    likelihood.
    """
    return behind < SWITCH


def behind_in_excess(ratios: Sequence[float]) -> float:
    """How far a model is behind on the scale of `is_alike`, from what it leaves over the noise.

    A ratio of excesses of `SIMILAR` counts as `SWITCH` does:

        behind = SWITCH mean(log ratios) / log SIMILAR                                         (1)

    Args:
        ratios: its excess by the other's, on each part of the data.
    """
    return SWITCH * float(np.mean(np.log(ratios))) / float(np.log(SIMILAR))  # (1)


def ratio_of(excess: float, other: float) -> float:
    """One excess by another, neither of them taken for less than `AT_THE_NOISE`."""
    # Of two models at the noise either may be nearer by chance, by any factor.
    return max(excess, AT_THE_NOISE) / max(other, AT_THE_NOISE)


def explains(closed: float) -> bool:
    """Whether effects that close this share of the gap are its explanation.

    Below it they may be real and are not what matters most, which the library then does not know.
    """
    return not closed < EXPLAINED


def is_missed(before: float, after: float) -> bool:
    """Whether held-out runs show a gap that the model does not close.

    Something acts there that the fitted runs did not teach: too much is left, or too little of what
    the base model left is gone.

    Args:
        before: excess of the base model on held-out runs.
        after: excess of the extended one.
    """
    closed = before - max(after, 0.0)
    # Asked this way round, since a simulation that failed leaves NaN and has missed.
    return not after < STRANGE or (before > STRANGE and closed < EXPLAINED * before)


@dataclass(frozen=True)
class State:
    """A state of affairs: what the questions have brought to light.

    Attributes:
        fixed: the data fix the base parameters that shape them.
        causes: how many were found.
        alternatives: at least one of them has another that does as well.
        closed: share of the gap on the fitted runs that the causes close.
        unexplained: the model with them still lacks something on the fitted runs.
        missed: held-out runs show a gap that it does not close.
    """

    fixed: bool = True
    causes: int = 0
    alternatives: bool = False
    closed: float = 0.0
    unexplained: bool = False
    missed: bool = False


def verdict_of(state: State) -> VerdictName:
    """The verdict that a state of affairs is; the first question that is answered decides."""
    # Where the base model is not fixed, every cause could be a wrong value of a parameter.
    if not state.fixed:
        return "unidentifiable"
    incomplete = state.unexplained or state.missed
    if not state.causes:
        return "unknown" if incomplete else "adequate"
    # Causes that leave most of the gap mimic what is missing; they are listed and not believed.
    if not explains(state.closed):
        return "unknown"
    # What else is missing comes before what else would do: a set is only fair about a whole answer.
    if incomplete:
        return "partial"
    return "ambiguous" if state.alternatives else "named"


def verdict_of_numbers(verdict: VerdictName, results: bool) -> VerdictName:
    """The verdict when the fitted numbers of the causes are known.

    A number at a bound of its range, or without a finite interval, is not a result: its cause is
    not named.

    Args:
        verdict: by all other rules.
        results: whether every number of the causes that stand alone is a result.
    """
    return "partial" if verdict == "named" and not results else verdict


def verdict_of_cut(causes: int, closed: float, not_asked: Sequence[str]) -> VerdictName:
    """The verdict of a search that was ended early: never more than what was asked supports.

    Without an answer to every question nothing is adequate and nothing is named. Causes are real
    where they stood against their rivals and held-out runs; else they are listed, and not believed.

    Args:
        causes: how many were found.
        closed: share of the gap on the fitted runs that they close, what is left taken for
            structure.
        not_asked: the questions that are open.
    """
    stood = all(name in LAST for name in not_asked)
    return "partial" if causes and stood and explains(closed) else "unknown"
