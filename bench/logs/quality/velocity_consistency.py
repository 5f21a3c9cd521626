"""Check velocities that contradict the derivative of their position.

Over an interval of several samples, the change of a position q equals the integral of its velocity
v,

    dq = q_b - q_a,    s = integral of v from a to b (trapezoids),    g = <dq s> / <s^2>      (1)

g is 1 if both are right, -1 if one sign is wrong, 57.3 if one is in degrees. A velocity that is
filtered, or stamped late, lags the derivative by

    T = -<(s - dq) dv> / <dv^2>,    dv = v_b - v_a                                             (2)

since s lags dq by T dv to first order.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from bench.logs.quality.noise_estimation import estimate_noise
from bench.logs.quality.quality_finding import QualityFinding
from sims.core.simulator import Array, Simulator
from sims.recording.recording import Recording, Run
from sims.system_simulator import SystemSimulator

SLOPE_ERROR_THRESHOLD = 0.05
"""Smallest reported deviation of the slope g in equation (1) from 1, if it is also significant."""
MIN_CORRELATION = 0.8
"""Correlation below which a velocity is unrelated to its position."""
DELAY_THRESHOLD_INTERVALS = 0.5
"""Smallest reported lag T of equation (2), in sampling intervals."""
SIGNIFICANCE_SIGMAS = 4.0
"""Detection threshold in standard deviations."""
MIN_SEGMENT_SAMPLES = 5
"""Minimum number of samples in an interval of integration."""
MIN_POSITION_CHANGE_SIGMAS = 10.0
"""Wanted change of a position over an interval of integration, in standard deviations of noise."""
_UNITS = {180.0 / np.pi: "degrees", 1e3: "thousandths"}
"""Ratios of velocity to position derivative that a wrong unit causes, and the unit."""


def check_velocities(recording: Recording, kind: type[Simulator]) -> Iterator[QualityFinding]:
    """Find velocities that differ from their position's derivative in sign, unit, size or time.

    Args:
        recording: Recording to check.
        kind: Simulator class of its system.

    Returns:
        One finding for each contradicting pair of position and velocity.
    """
    if not issubclass(kind, SystemSimulator):
        return
    system = kind.system
    # Not strict: an own system may have further states after the rates of the coordinates.
    for position, rate in zip(system.coordinates, system.rates, strict=False):
        runs = [run for run in recording.runs if {position, rate} <= run.channels.keys()]
        if runs:
            yield from _pair(runs, position, rate)


class _Stretches(NamedTuple):
    """Values dq, s, dv of equations (1) and (2) per interval, and the sampling interval in s."""

    gone: Array
    added: Array
    faster: Array
    interval: float


def _pair(runs: list[Run], position: str, rate: str) -> Iterator[QualityFinding]:
    found = _stretches(runs, position, rate)
    if found is None:
        return
    gone, added, *_ = found
    power, along = float(added @ added), float(gone @ added)
    like = along / np.sqrt(power * float(gone @ gone))
    if abs(like) < MIN_CORRELATION:
        yield QualityFinding(
            "contradiction",
            f"{rate} has little to do with the derivative of {position} (correlation {like:.2f})",
            "is it of another joint? correct the columns, or leave it out",
        )
        return
    # Noise of the velocity makes (1) too small, noise of the position makes its inverse too small:
    # the true slope lies between.
    slope, other = along / power, float(gone @ gone) / along
    rest = gone - slope * added
    doubt = float(np.sqrt(rest @ rest / max(gone.size - 1, 1) / power))
    size = f"{position} goes {slope:.3g} times as far as {rate} adds up to"
    off = max(SLOPE_ERROR_THRESHOLD, SIGNIFICANCE_SIGMAS * doubt)
    if slope < 0:
        yield QualityFinding("contradiction", size, f"a sign is wrong: turn that of {rate}")
    elif slope > 1.0 + off or other < 1.0 - off:
        yield QualityFinding("contradiction", size, _remedy(abs(np.log(slope)), rate))
    elif (behind := _late(found, slope)) is not None:
        yield QualityFinding(
            "contradiction",
            f"{rate} is {1e3 * abs(behind.seconds):.2g} ms (±{2e3 * behind.error:.1g}, "
            f"{behind.samples:.2g} samples) {behind.direction_word} the derivative of {position}",
            "it is filtered, or stamped at another time: trust the position, or leave it out",
        )


def _remedy(ratio: float, rate: str) -> str:
    """Recommend a correction for a velocity that is wrong by a ratio, given as its logarithm."""
    for factor, word in _UNITS.items():
        if abs(ratio - np.log(factor)) < 0.1:
            return f"one of the two is in {word}: correct its unit"
    return f"correct the unit or the gain of {rate}, or leave it out"


class VelocityDelay(NamedTuple):
    """Lag of a velocity behind the derivative of its position.

    Attributes:
        seconds: Lag in seconds; negative if the velocity leads.
        error: Standard error of the lag (1 sigma), s.
        samples: Absolute lag in sampling intervals.
    """

    seconds: float
    error: float
    samples: float

    @property
    def direction_word(self) -> str:
        """Wording for the sign of the lag: behind or ahead of."""
        return "behind" if self.seconds > 0 else "ahead of"


def estimate_velocity_delay(runs: list[Run], position: str, rate: str) -> VelocityDelay | None:
    """Estimate the lag of a velocity whose sign and unit are right.

    Args:
        runs: Runs with both channels.
        position: Name of the position channel.
        rate: Name of the velocity channel.

    Returns:
        The lag, or None if it is not significant or cannot be estimated.
    """
    found = _stretches(runs, position, rate)
    if found is None:
        return None
    return _late(found, float(found.gone @ found.added) / float(found.added @ found.added))


def _late(found: _Stretches, slope: float) -> VelocityDelay | None:
    """Estimate the lag by equation (2); None if it is not significant."""
    gone, added, faster, interval = found
    behind = slope * added - gone
    power = float(faster @ faster)
    if not power > 0:
        return None
    seconds = -float(behind @ faster) / power
    rest = behind + seconds * faster
    error = float(np.sqrt(rest @ rest / max(rest.size - 1, 1) / power))
    if abs(seconds) < max(DELAY_THRESHOLD_INTERVALS * interval, SIGNIFICANCE_SIGMAS * error):
        return None
    return VelocityDelay(seconds, error, abs(seconds) / interval)


def _stretches(runs: list[Run], position: str, rate: str) -> _Stretches | None:
    """Compute the integrals over intervals in which the position changes well beyond its noise.

    Returns None if there are too few intervals.
    """
    noise = estimate_noise((run.times, run.channels[position]) for run in runs)
    sigma = max(float(np.nan_to_num(noise.sigma)), noise.step)
    speeds = np.concatenate([np.abs(run.channels[rate]) for run in runs])
    intervals = np.concatenate([np.diff(run.times) for run in runs])
    if not intervals.size or not np.nanmax(speeds, initial=0.0) > 0:
        return None
    interval = float(np.median(intervals))
    moves = np.concatenate([np.abs(np.diff(run.channels[position])) for run in runs])
    usual = float(np.sqrt(np.nanmean(moves**2))) if np.isfinite(moves).any() else 0.0
    if not usual > 0:
        return None
    # Long enough to exceed the noise, but no longer: over a whole oscillation both integrals
    # vanish.
    length = int(
        np.clip(np.ceil(MIN_POSITION_CHANGE_SIGMAS * sigma / usual), MIN_SEGMENT_SAMPLES, 50)
    )
    parts = [_of(run, position, rate, length) for run in runs]
    gone, added, faster = (np.concatenate(rows) for rows in zip(*parts, strict=True))
    seen = np.isfinite(gone) & np.isfinite(added) & np.isfinite(faster)
    if seen.sum() < 20 or not (added[seen] @ added[seen] > 0 and gone[seen] @ gone[seen] > 0):
        return None
    return _Stretches(gone[seen], added[seen], faster[seen], interval)


def _of(run: Run, position: str, rate: str, length: int) -> tuple[Array, Array, Array]:
    q, v, t = run.channels[position], run.channels[rate], run.times
    areas = 0.5 * (v[1:] + v[:-1]) * np.diff(t)
    ends = np.arange(0, q.size, length)
    if ends.size < 2:
        return np.empty(0), np.empty(0), np.empty(0)
    # A missing sample invalidates only the interval that contains it.
    added = np.add.reduceat(areas, ends[:-1])
    added[-1] = areas[ends[-2] : ends[-1]].sum()
    return np.diff(q[ends]), added, np.diff(v[ends])
