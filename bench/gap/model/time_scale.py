"""Plausible ranges of times and frequencies, from the time scale of a recording.

With T the duration of the longest run and h the shortest sample interval,

* a delay or a lag is plausible up to a twentieth of T, and a fit may move it up to T: what takes
  longer than a run is a constant in it;
* a time constant of something that dies away is at most `LASTING` T;
* a frequency is at most 1 / (2 h), the Nyquist frequency.
"""

from __future__ import annotations

from dataclasses import replace

from sims.base import Parameter

SHARE = 0.05
"""A delay or a lag is plausible up to this share of the longest run."""
LASTING = 3.0
"""Longest time constant that is tried of what dies away, in durations of the longest run."""
DECADES = 100.0
"""Ratio of the highest to the lowest plausible frequency where the sampling sets the highest."""


def on_time_scale(parameter: Parameter, longest: float, spacing: float) -> Parameter:
    """The coefficient with a plausible range that suits the time scale of a recording.

    Args:
        parameter: a coefficient, with the range that its effect states.
        longest: duration of the longest run, s.
        spacing: shortest sample interval, s; 0 where it is not known.
    """
    low, high = parameter.bounds
    if is_instant(parameter):
        return parameter
    if parameter.unit == "s":
        if low > 0:
            high = max(high, LASTING * longest)
        else:
            # a delay may have either sign: both ends grow alike
            times = max(1.0, SHARE * longest / high)
            low, high = times * low, times * high
    elif parameter.unit == "Hz" and spacing > 0 and 0.5 / spacing < high:
        high = 0.5 / spacing
        low = min(low, high / DECADES)
    if (low, high) == parameter.bounds:
        return parameter
    nominal = min(max(parameter.nominal, low), high)
    return replace(parameter, nominal=nominal, bounds=(low, high), training=None)


def is_instant(coefficient: Parameter) -> bool:
    """Whether it is an instant on the clock of a recording's stamps."""
    return coefficient.name.endswith(".instant")
