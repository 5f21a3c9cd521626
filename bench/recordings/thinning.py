"""Thin recordings of robots that are sampled much faster than they move.

Neighbouring samples of a slow motion have the same rounding errors of an encoder and the same
vibrations, which no model of the robot has: at 500 Hz and more they, and not the motion, decide a
likelihood. Each k-th sample is kept, with k as large as these hold everything that moves: the
others follow from a cubic spline through them (C. de Boor, A Practical Guide to Splines, 1978,
chapter 4) as well as from one through every second sample.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sims.base import Array, Simulator
from sims.recording.recording import Recording, Run

FASTEST = 400.0
"""Sample rate in Hz up to which a recording is kept as it is."""
SLOWEST = 100.0
"""Lowest sample rate in Hz after thinning."""
LARGER = 1.25
"""Factor by which the error of interpolation may grow over that of every second sample."""
PRECISION = 1e-4
"""Error of interpolation that does not matter, as a share of a channel's range: the accuracy of a
simulation.
"""
COMPLETE = 0.9
"""Smallest share of its samples that each channel must have."""
FEWEST = 40
"""Smallest number of samples that each run must keep."""


def thin(recording: Recording, kind: type[Simulator]) -> tuple[Recording, str]:
    """Keep each k-th sample of a robot's recording, where these samples contain all motion.

    Inputs that are held take their mean between the samples that are kept.

    Returns:
        The recording, and a message for the user, which is empty where it is unchanged.
    """
    rate = min((_rate(run) for run in recording.runs), default=0.0)
    if not kind.has_model or rate <= FASTEST:
        return recording, ""
    every = next((k for k in range(round(rate / SLOWEST), 1, -1) if _holds(recording, k)), 1)
    if every == 1:
        return recording, ""
    runs = tuple(_thinned(run, every) for run in recording.runs)
    note = (
        f"sampled at {rate:.4g} Hz, faster than it moves: each sample of {every} is used, "
        "and the mean of the inputs between them"
    )
    return replace(recording, runs=runs), note


def _rate(run: Run) -> float:
    """Samples per second."""
    return float(1.0 / np.median(np.diff(run.times))) if run.times.size > 1 else 0.0


def _holds(recording: Recording, every: int) -> bool:
    """Whether every k-th sample holds all motion of all channels."""
    for run in recording.runs:
        if run.times.size < FEWEST * every:
            return False
        for values in run.channels.values():
            if np.isfinite(values).mean() < COMPLETE:
                return False
            least = PRECISION * float(np.ptp(values[np.isfinite(values)]))
            allowed = max(LARGER * _interpolation_error(run.times, values, 2), least)
            if _interpolation_error(run.times, values, every) > allowed:
                return False
    return True


def _interpolation_error(times: Array, values: Array, every: int) -> float:
    """RMS error of a cubic spline through every k-th sample at the others."""
    # Loaded where a robot's recording is that fast.
    from scipy.interpolate import CubicSpline

    there = np.isfinite(values)
    kept = there & (np.arange(times.size) % every == 0)
    first, last = np.flatnonzero(kept)[[0, -1]]
    others = there & ~kept
    others[:first] = others[last:] = False
    if not others.any():
        return 0.0
    missed = CubicSpline(times[kept], values[kept])(times[others]) - values[others]
    return float(np.sqrt(np.mean(np.square(missed))))


def _thinned(run: Run, every: int) -> Run:
    """Every k-th sample of a run, with the mean of its inputs from each one to the next."""
    part = run.part(slice(None, None, every))
    first = np.arange(0, run.times.size, every)
    spans = np.diff(run.times, append=run.times[-1] + np.median(np.diff(run.times)))
    inputs = dict(part.inputs)
    for name in part.inputs:
        if name not in run.linear:
            weighed = np.add.reduceat(run.inputs[name] * spans, first)
            inputs[name] = weighed / np.add.reduceat(spans, first)
    return replace(part, inputs=inputs)
