"""Input signals by name, for recordings made by simulation: ``sine:2:0.5`` is 2 sin(2 pi 0.5 t),
and ``0.3 + sine:2:0.5`` about 0.3.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sims.base import Array, InputError, unknown
from sims.limits import LARGEST, cut

_TAU = 2 * np.pi
"""Radians of one period."""

_MOST_CHANGES = 1e8
"""Periods or levels of a signal beyond which its frequency is a slip of the pen."""

_SINES = 6
"""Of a multisine; their frequencies are even on a logarithmic axis."""
_RISE = 0.5
"""Of its longest period, until it has its full size."""
_EDGE = 1e-9
"""Share of a step by which a sample may come early and still belong to the new level: times are
rounded."""


# Every form takes the generator, whether it draws from it or not: one call serves all.


def _constant(t: Array, rng: np.random.Generator, value: float) -> Array:  # noqa: ARG001
    return np.full(t.size, value)


def _sine(
    t: Array,
    rng: np.random.Generator,  # noqa: ARG001
    amplitude: float,
    frequency: float,
) -> Array:
    signal: Array = amplitude * np.sin(_TAU * frequency * t)
    return signal


def _square(
    t: Array,
    rng: np.random.Generator,  # noqa: ARG001
    amplitude: float,
    frequency: float,
) -> Array:
    half_periods = np.floor(2 * frequency * t)
    return np.where(half_periods % 2 == 0, amplitude, -amplitude)


def _steps(t: Array, rng: np.random.Generator, amplitude: float, seconds: float) -> Array:
    place = np.floor(t / seconds + _EDGE).astype(int)
    levels: Array = rng.uniform(-amplitude, amplitude, size=place[-1] + 1)
    held: Array = levels[place]
    return held


def _chirp(
    t: Array,
    rng: np.random.Generator,  # noqa: ARG001
    amplitude: float,
    low: float,
    high: float,
) -> Array:
    # The phase is the integral of a frequency that grows in proportion to time.
    periods = low * t + (high - low) * t * t / (2 * t[-1])
    signal: Array = amplitude * np.sin(_TAU * periods)
    return signal


def _multisine(
    t: Array, rng: np.random.Generator, amplitude: float, low: float, high: float
) -> Array:
    frequencies = np.geomspace(low, high, _SINES)
    phases = rng.uniform(0.0, _TAU, _SINES)
    total = np.sin(_TAU * frequencies * t[:, None] + phases).sum(axis=1)
    # From rest: a servo that is to leap has its largest error before anything has been told.
    rise = np.minimum(t * low / _RISE, 1.0)
    largest = float(np.abs(rise * total).max())
    faded: Array = amplitude * rise * total / max(largest, 1e-12)
    return faded


_FORMS: dict[str, tuple[Callable[..., Array], str]] = {
    "constant": (_constant, "VALUE"),
    "sine": (_sine, "AMPLITUDE:HERTZ"),
    "square": (_square, "AMPLITUDE:HERTZ"),
    "steps": (_steps, "AMPLITUDE:SECONDS"),
    "chirp": (_chirp, "AMPLITUDE:HERTZ:HERTZ"),
    "multisine": (_multisine, "AMPLITUDE:HERTZ:HERTZ"),
}
"""Each form by name: what computes it, and the numbers that it takes."""

HELP = ", ".join(f"{name}:{form}" for name, (_, form) in _FORMS.items())
"""The forms there are, for a help text."""


def signal(text: str, times: Array, rng: np.random.Generator) -> Array:
    """The values (T,) at `times` (T,) of the signal that `text` describes; a plain number is
    constant, and signals with `` + `` between are added.

    `steps` holds levels drawn by `rng` evenly within the amplitude, `chirp` sweeps from one
    frequency to the other, `multisine` is a sum of sines from one to the other with phases drawn by
    `rng`, that begins at zero and reaches the amplitude.

    Raises:
        InputError: no such form, or not its numbers.
    """
    first, *others = text.split(" + ")
    result = _one(first.strip(), times, rng)
    for other in others:
        result = result + _one(other.strip(), times, rng)
    return result


def _one(text: str, times: Array, rng: np.random.Generator) -> Array:
    """The values of a signal that is no sum."""
    name, *given = text.split(":")
    if not given:
        name, given = "constant", [text]
    if name not in _FORMS:
        raise unknown("signal", name, list(_FORMS))
    make, form = _FORMS[name]
    try:
        numbers = [float(number) for number in given]
    except ValueError:
        numbers = []
    complete = len(numbers) == len(form.split(":")) and np.isfinite(numbers).all()
    # All behind the first are frequencies or durations.
    if not complete or min([1.0, *numbers[1:]]) <= 0:
        wanted = f"{name}:{form} with numbers, all but the first > 0"
        raise InputError(f"signal '{cut(text)}': expected {wanted}")
    span = float(times[-1])
    changes = [span / n if make is _steps else span * n for n in numbers[1:]]
    if max(map(abs, numbers)) > LARGEST or max([0.0, *changes]) > _MOST_CHANGES:
        wanted = f"numbers within {LARGEST:g}, and at most {_MOST_CHANGES:g} periods or levels"
        raise InputError(f"signal '{cut(text)}': expected {wanted} in its {span:g} s")
    return make(times, rng, *numbers)
