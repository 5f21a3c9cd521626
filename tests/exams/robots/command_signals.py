"""Command signals of the robots: multisine, ramps, steps and chirp; each begins at zero."""

from __future__ import annotations

import numpy as np

FORMS = ("multisine", "ramps", "steps", "chirp")


def wave(form, times, rng):
    """Return a signal (T,) whose largest amplitude is 1."""
    signal = SIGNALS[form](times, rng)
    eased = np.clip(times / 0.4, 0.0, 1.0)
    return signal / max(np.abs(signal).max(), 1e-12) * eased**2 * (3 - 2 * eased)


def _multisine(times, rng):
    tones = np.exp(rng.uniform(np.log(0.25), np.log(2.5), 5))
    phases, heights = rng.uniform(0, 2 * np.pi, 5), rng.uniform(0.3, 1.0, 5) / tones**0.5
    return np.sin(2 * np.pi * tones * times[:, None] + phases) @ heights


def _levels(times, rng):
    """Draw random levels: (start times, levels)."""
    count = int(rng.integers(4, 8))
    begins = np.sort(rng.uniform(0.1, times[-1] - 0.3, count))
    return begins, rng.uniform(-1.0, 1.0, count)


def _ramps(times, rng):
    """Return ramps of constant rate between random levels, with a hold after each."""
    begins, levels = _levels(times, rng)
    ends = np.minimum(begins + rng.uniform(0.2, 0.8, begins.size), [*begins[1:], times[-1]])
    knots = np.column_stack([begins, ends]).ravel()
    heights = np.column_stack([[0.0, *levels[:-1]], levels]).ravel()
    return np.interp(times, knots, heights)


def _steps(times, rng):
    begins, levels = _levels(times, rng)
    return np.array([0.0, *levels])[np.searchsorted(begins, times, side="right")]


def _chirp(times, rng):
    low, high = rng.uniform(0.15, 0.4), rng.uniform(1.5, 3.0)
    phase = 2 * np.pi * (low * times + (high - low) * times**2 / (2 * times[-1]))
    return np.sin(phase + rng.uniform(0, 2 * np.pi))


SIGNALS = {"multisine": _multisine, "ramps": _ramps, "steps": _steps, "chirp": _chirp}
