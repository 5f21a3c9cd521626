"""Input signals described by text, for simulated recordings.

``sine:2:0.5`` is 2 sin(2 pi 0.5 t), and ``0.3 + sine:2:0.5`` adds a constant of 0.3.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sims.core.number_limits import MAX_NUMBER
from sims.core.simulator import Array, InputError, make_unknown_name_error
from sims.core.user_messages import truncate_text

_TAU = 2 * np.pi
"""Radians of one period."""

_MAX_CHANGES = 1e8
"""Maximum number of periods or levels of a signal; a larger number is a typing error."""

_MULTISINE_COUNT = 6
"""Number of sines of a multisine; their frequencies are evenly spaced on a logarithmic scale."""
_RAMP_UP_SHARE = 0.5
"""Rise time of a multisine's amplitude, in periods of its lowest frequency."""
_EDGE_TOLERANCE_SHARE = 1e-9
"""Tolerance for rounded sample times at a step, as a share of the step's duration.

A sample that is earlier than the step by less than this share belongs to the new level.
"""


# All functions take the generator, so that they can be called in the same way.


def _compute_constant(t: Array, rng: np.random.Generator, value: float) -> Array:  # noqa: ARG001
    return np.full(t.size, value)


def _compute_sine(
    t: Array,
    rng: np.random.Generator,  # noqa: ARG001
    amplitude: float,
    frequency: float,
) -> Array:
    """Compute amplitude sin(2 pi frequency t).

    Args:
        t: (T,) times in s.
        rng: unused; other forms draw from it.
        amplitude: amplitude in the unit of the input.
        frequency: frequency in Hz.
    """
    signal: Array = amplitude * np.sin(_TAU * frequency * t)
    return signal


def _compute_square_wave(
    t: Array,
    rng: np.random.Generator,  # noqa: ARG001
    amplitude: float,
    frequency: float,
) -> Array:
    """Compute a square wave: +amplitude in each first half period, -amplitude in each second one.

    Args:
        t: (T,) times in s.
        rng: unused; other forms draw from it.
        amplitude: amplitude in the unit of the input.
        frequency: frequency in Hz.
    """
    half_periods = np.floor(2 * frequency * t)
    return np.where(half_periods % 2 == 0, amplitude, -amplitude)


def _compute_random_steps(
    t: Array, rng: np.random.Generator, amplitude: float, seconds: float
) -> Array:
    """Compute random levels, uniform within +-amplitude, each held for the given number of seconds.

    Args:
        t: (T,) times in s.
        rng: draws the levels.
        amplitude: largest absolute level, in the unit of the input.
        seconds: duration of each level.
    """
    level_index = np.floor(t / seconds + _EDGE_TOLERANCE_SHARE).astype(int)
    levels: Array = rng.uniform(-amplitude, amplitude, size=level_index[-1] + 1)
    held_levels: Array = levels[level_index]
    return held_levels


def _compute_chirp(
    t: Array,
    rng: np.random.Generator,  # noqa: ARG001
    amplitude: float,
    low: float,
    high: float,
) -> Array:
    """Compute a linear chirp: a sine whose frequency changes linearly until the end.

    Args:
        t: (T,) times in s from 0; the last one is the end of the sweep.
        rng: unused; other forms draw from it.
        amplitude: amplitude in the unit of the input.
        low: frequency at the beginning, Hz.
        high: frequency at the end, Hz.
    """
    # The phase is the integral of a frequency that increases linearly with time.
    periods = low * t + (high - low) * t * t / (2 * t[-1])
    signal: Array = amplitude * np.sin(_TAU * periods)
    return signal


def _compute_multisine(
    t: Array, rng: np.random.Generator, amplitude: float, low: float, high: float
) -> Array:
    """Compute a sum of `_MULTISINE_COUNT` sines with random phases.

    The amplitude rises from zero at first.

    Args:
        t: (T,) times in s.
        rng: draws the phases.
        amplitude: largest absolute value of the result, in the unit of the input.
        low: lowest frequency, Hz.
        high: highest frequency, Hz.
    """
    frequencies = np.geomspace(low, high, _MULTISINE_COUNT)
    phases = rng.uniform(0.0, _TAU, _MULTISINE_COUNT)
    total = np.sin(_TAU * frequencies * t[:, None] + phases).sum(axis=1)
    # It starts at zero, because a sudden start would make the largest error of a servo at t = 0.
    rise = np.minimum(t * low / _RAMP_UP_SHARE, 1.0)
    largest = float(np.abs(rise * total).max())
    signal: Array = amplitude * rise * total / max(largest, 1e-12)
    return signal


_FORMS: dict[str, tuple[Callable[..., Array], str]] = {
    "constant": (_compute_constant, "VALUE"),
    "sine": (_compute_sine, "AMPLITUDE:HERTZ"),
    "square": (_compute_square_wave, "AMPLITUDE:HERTZ"),
    "steps": (_compute_random_steps, "AMPLITUDE:SECONDS"),
    "chirp": (_compute_chirp, "AMPLITUDE:HERTZ:HERTZ"),
    "multisine": (_compute_multisine, "AMPLITUDE:HERTZ:HERTZ"),
}
"""Function and argument names of each form of signal, by name."""


def evaluate_signal(text: str, times: Array, rng: np.random.Generator) -> Array:
    """Compute the values of the signal that a text describes.

    A plain number is constant, and signals separated by `` + `` are added. `steps` holds random
    levels, uniform within the amplitude. `chirp` sweeps from one frequency to the other.
    `multisine` is a sum of sines between two frequencies with random phases; it starts at zero and
    reaches the amplitude.

    Args:
        text: description of the signal.
        times: (T,) sample times in seconds.
        rng: random generator of levels and phases.

    Returns:
        (T,) values.

    Raises:
        InputError: there is no such form, or its numbers are not valid.
    """
    first_term, *further_terms = text.split(" + ")
    result = _compute_signal(first_term.strip(), times, rng)
    for term in further_terms:
        result = result + _compute_signal(term.strip(), times, rng)
    return result


def _compute_signal(text: str, times: Array, rng: np.random.Generator) -> Array:
    """Compute the values (T,) of one signal, such as ``sine:2:0.5``, without sums.

    The limits on the numbers prevent values that overflow, and signals that change too often.

    Args:
        text: form and numbers of the signal.
        times: (T,) times, s.
        rng: random numbers of forms with random phases.

    Raises:
        InputError: the text is not a known form with valid numbers.
    """
    name, *arguments = text.split(":")
    if not arguments:  # a number alone
        name, arguments = "constant", [text]
    if name not in _FORMS:
        raise make_unknown_name_error("signal", name, list(_FORMS))
    compute_form, form = _FORMS[name]
    try:
        signal_arguments = [float(number) for number in arguments]
    except ValueError:
        signal_arguments = []
    is_complete = (
        len(signal_arguments) == len(form.split(":")) and np.isfinite(signal_arguments).all()
    )
    # All numbers except the first are frequencies or durations.
    frequencies_or_durations = signal_arguments[1:]
    if not is_complete or min([1.0, *frequencies_or_durations]) <= 0:
        expected = f"{name}:{form} with numbers, all but the first > 0"
        raise InputError(f"signal '{truncate_text(text)}': expected {expected}")
    span = float(times[-1])
    # Number of levels, of one duration each, or of periods at a frequency.
    changes = [
        span / number if compute_form is _compute_random_steps else span * number
        for number in frequencies_or_durations
    ]
    if max(map(abs, signal_arguments)) > MAX_NUMBER or max([0.0, *changes]) > _MAX_CHANGES:
        expected = f"numbers within {MAX_NUMBER:g}, and at most {_MAX_CHANGES:g} periods or levels"
        raise InputError(f"signal '{truncate_text(text)}': expected {expected} in its {span:g} s")
    return compute_form(times, rng, *signal_arguments)
