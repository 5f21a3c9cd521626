"""Plausible ranges of coefficients, adapted to the time scale of a recording.

With T the duration of the longest run and h the shortest sample interval:

* a delay or a lag is plausible up to T / 20, and a fit may move it up to T: longer ones look
  constant within a run;
* a decay time constant is at most `MAX_DECAY_FACTOR` T;
* a frequency is at most 1 / (2 h), the Nyquist frequency.
"""

from __future__ import annotations

from dataclasses import replace

from sims.core.simulator import Parameter

MAX_DELAY_SHARE = 0.05
"""Maximum plausible delay or lag, as a share of the duration of the longest run."""
MAX_DECAY_FACTOR = 3.0
"""Maximum decay time constant, as a multiple of the duration of the longest run."""
FREQUENCY_RANGE_RATIO = 100.0
"""Ratio of the highest to the lowest plausible frequency if the sampling limits the highest one."""


def adapt_to_time_scale(parameter: Parameter, longest: float, spacing: float) -> Parameter:
    """Return a coefficient with a plausible range that fits the time scale of a recording.

    The range that an effect states is for typical recordings of seconds.

    * Decay times (in s, always positive) and delays (in s, of either sign or zero) may be longer if
      the runs are longer.
    * Frequencies are at most half the sampling rate.
    * Event times, and coefficients of other units, are returned as they are.

    Args:
        parameter: coefficient, with the range that its effect states.
        longest: duration of the longest run, s.
        spacing: shortest sample interval, s; 0 if unknown.
    """
    low, high = parameter.bounds
    if is_instant(parameter):
        return parameter
    if parameter.unit == "s":
        if low > 0:
            high = max(high, MAX_DECAY_FACTOR * longest)
        else:
            # A delay may have either sign, so both ends are scaled by the same factor, which makes
            # the upper end at least `MAX_DELAY_SHARE` of the longest run.
            factor = max(1.0, MAX_DELAY_SHARE * longest / high)
            low, high = factor * low, factor * high
    elif parameter.unit == "Hz" and spacing > 0 and 0.5 / spacing < high:
        # The Nyquist frequency.
        high = 0.5 / spacing
        low = min(low, high / FREQUENCY_RANGE_RATIO)
    if (low, high) == parameter.bounds:
        return parameter
    # The nominal value must lie in the new range, and a range for training is dropped.
    nominal = min(max(parameter.nominal, low), high)
    return replace(parameter, nominal=nominal, bounds=(low, high), training=None)


def is_instant(coefficient: Parameter) -> bool:
    """Return whether a coefficient is a time on the clock of the recording."""
    return coefficient.name.endswith(".instant")


def is_period(parameter: Parameter, travel: float) -> bool:
    """Return whether a coefficient is a period over position (in m or rad), and the position moves.

    Args:
        parameter: the coefficient.
        travel: largest range of the position within one run, in m or rad.
    """
    return parameter.name.endswith(".period") and travel > 0
