"""Compare a recorded velocity with the derivative of its position.

Over an interval of several samples, the change of a position q equals the integral of its velocity
v,

    dq = q_b - q_a,    s = integral of v from a to b (trapezoids),    g = <dq s> / <s^2>      (1)

g is 1 if both are right, -1 if one sign is wrong, 57.3 if one is in degrees. A velocity that is
filtered, or stamped late, lags the derivative by

    T = -<(s - dq) dv> / <dv^2>,    dv = v_b - v_a                                             (2)

since s lags dq by T dv to first order.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from bench.logs.quality.quality_finding import SIGNIFICANCE_SIGMAS, QualityFinding
from sims.core.noise_estimation import estimate_noise
from sims.core.root_mean_square import compute_rms
from sims.core.simulator import Array, Simulator
from sims.recording.recording import Recording, Run
from sims.system_simulator import SystemSimulator

SLOPE_ERROR_THRESHOLD = 0.05
"""Smallest reported deviation of the slope g in equation (1) from 1, if it is also significant."""
MIN_CORRELATION = 0.8
"""Correlation below which a velocity is unrelated to its position."""
DELAY_THRESHOLD_INTERVALS = 0.5
"""Smallest reported lag T of equation (2), in sampling intervals."""
MIN_SEGMENT_SAMPLES = 5
"""Minimum number of samples in an interval of integration."""
MAX_SEGMENT_SAMPLES = 50
"""Maximum number of samples in an interval of integration."""
MIN_SEGMENTS = 10
"""Minimum number of intervals of integration."""
MIN_RMS_CHANGE_SIGMAS = 3.0
"""Minimum change (RMS) of a position over an interval, in standard deviations of its noise; the
noise of a joint that stands still makes changes of 1.4.
"""
MIN_POSITION_CHANGE_SIGMAS = 10.0
"""Wanted change of a position over an interval of integration, in standard deviations of noise."""
MAX_INTERVAL_RATIO = 3.0
"""Largest time between two samples, in usual sampling intervals, over which a velocity is
integrated; over a longer gap it is not known.
"""
_UNIT_BY_RATIO = {180.0 / np.pi: "degrees", 1e3: "thousandths"}
"""Ratios of velocity to position derivative that a wrong unit causes, and the unit."""
MAX_UNIT_LOG_ERROR = 0.1
"""Largest difference of the logarithms of a ratio and of the factor between two units."""


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
            yield from _check_pair(runs, position, rate)


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


class VelocityComparison(NamedTuple):
    """Values of equations (1) and (2) for N intervals of a motion, each of several samples.

    Attributes:
        position_changes: (N,) changes dq of the position.
        velocity_integrals: (N,) integrals s of the velocity, which should be equal to dq.
        velocity_changes: (N,) changes dv of the velocity.
        interval: Sampling interval, s.
    """

    position_changes: Array
    velocity_integrals: Array
    velocity_changes: Array
    interval: float

    @staticmethod
    def measure(runs: Sequence[Run], position: str, rate: str) -> VelocityComparison | None:
        """Compare the integral of a velocity with the change of its position, over all runs.

        The runs are divided into intervals so long that the position changes well beyond its noise.
        Samples at which one of both is missing, and intervals with a gap in time, are left out.

        Args:
            runs: Runs with both channels.
            position: Name of the position channel.
            rate: Name of the velocity channel.

        Returns:
            The comparison, or None if the motion is too short or too small.
        """
        series = [_Series.read(run, position, rate) for run in runs]
        noise = estimate_noise((part.times, part.position) for part in series)
        sigma = max(float(np.nan_to_num(noise.sigma)), noise.step)
        steps = np.concatenate([np.diff(part.times) for part in series]) if series else np.empty(0)
        if not steps.size or not max(np.abs(part.velocity).max(initial=0.0) for part in series) > 0:
            return None
        interval = float(np.median(steps))
        sample_changes = np.concatenate([np.diff(part.position) for part in series])
        rms_sample_change = compute_rms(sample_changes)
        if not rms_sample_change > 0:
            return None
        # Samples of an interval: enough to exceed the noise, but not more, since over a whole
        # oscillation both the change and the integral vanish.
        required_length = np.ceil(MIN_POSITION_CHANGE_SIGMAS * sigma / rms_sample_change)
        length = int(np.clip(required_length, MIN_SEGMENT_SAMPLES, MAX_SEGMENT_SAMPLES))
        integrated = [part.integrate(length, MAX_INTERVAL_RATIO * interval) for part in series]
        # Changes of the position, integrals of the velocity, and changes of the velocity.
        dq, s, dv = (np.concatenate(arrays) for arrays in zip(*integrated, strict=True))
        is_known = np.isfinite(s)  # no gap in time
        dq, s, dv = dq[is_known], s[is_known], dv[is_known]
        if is_known.sum() < MIN_SEGMENTS or not (s @ s > 0 and dq @ dq > 0):
            return None
        if compute_rms(dq) < MIN_RMS_CHANGE_SIGMAS * sigma:
            return None
        return VelocityComparison(dq, s, dv, interval)

    @staticmethod
    def pool(comparisons: Sequence[VelocityComparison]) -> VelocityComparison:
        """Join the comparisons of several joints to one, from which a common delay is estimated.

        Each velocity is first multiplied by its slope, the factor from the integrated velocity to
        the change of the position, so that a wrong unit has no influence.

        Args:
            comparisons: comparison of each joint.
        """
        return VelocityComparison(
            np.concatenate([c.position_changes for c in comparisons]),
            np.concatenate([c.slope * c.velocity_integrals for c in comparisons]),
            np.concatenate([c.slope * c.velocity_changes for c in comparisons]),
            float(np.median([c.interval for c in comparisons])),
        )

    @property
    def slope(self) -> float:
        """Slope g of equation (1).

        It is g = <dq s> / <s^2> (1), with changes dq of position and integrals s of velocity over
        intervals: 1 if both agree, -1 if a sign is wrong, 57.3 if one is in degrees.
        """
        s = self.velocity_integrals
        return float(self.position_changes @ s) / float(s @ s)

    @property
    def correlation(self) -> float:
        """Correlation of dq and s."""
        dq, s = self.position_changes, self.velocity_integrals
        return float(dq @ s) / float(np.sqrt((s @ s) * (dq @ dq)))

    def delay(self) -> VelocityDelay | None:
        """Return the lag of the velocity behind the derivative of the position.

        It is T = -<(s - dq) dv> / <dv^2> (2), with changes dq of position, integrals s of velocity
        and changes dv of velocity over intervals. The velocity is multiplied by its slope, so that
        a wrong unit has no influence. The result is None if the lag is not significant, which means
        several standard errors and a fraction of a sampling interval.
        """
        slope, dv = self.slope, self.velocity_changes
        difference = slope * self.velocity_integrals - self.position_changes
        # The difference is proportional to slope * T * dv, so this is the denominator of T.
        power = slope * float(dv @ dv)
        if power == 0:
            return None
        # T by least squares: the difference is about -slope T dv.
        seconds = -float(difference @ dv) / power
        residual = difference + slope * seconds * dv
        # Standard error of T: that of the regressor slope * dv, whose square sum is slope * power.
        error = float(np.sqrt(residual @ residual / max(residual.size - 1, 1) / abs(slope * power)))
        if abs(seconds) < max(
            DELAY_THRESHOLD_INTERVALS * self.interval, SIGNIFICANCE_SIGMAS * error
        ):
            return None
        return VelocityDelay(seconds, error, abs(seconds) / self.interval)


class _Series(NamedTuple):
    """Times, positions and velocities (T,) of a run, where both are known."""

    times: Array
    position: Array
    velocity: Array

    @staticmethod
    def read(run: Run, position: str, rate: str) -> _Series:
        """Return the samples of a run at which both the position and its rate are recorded."""
        q, v = run.channels[position], run.channels[rate]
        # If two publishers alternate, each row has the joints of one of them.
        is_recorded = np.isfinite(q) & np.isfinite(v)
        return _Series(run.times[is_recorded], q[is_recorded], v[is_recorded])

    def integrate(self, length: int, max_gap: float) -> tuple[Array, Array, Array]:
        """Return dq, s and dv (see `VelocityComparison`) of intervals of `length` samples.

        The velocity is integrated by the trapezoidal rule. The samples after the last whole
        interval are not used.

        Args:
            length: number of samples of an interval.
            max_gap: longest time between two samples, s; across a longer one, s is NaN.

        Returns:
            Changes of position (N,), integrals of velocity (N,) and changes of velocity (N,) over
            N intervals.
        """
        steps = np.diff(self.times)
        areas = 0.5 * (self.velocity[1:] + self.velocity[:-1]) * steps
        areas[steps > max_gap] = np.nan
        edges = np.arange(0, self.times.size, length)
        if edges.size < 2:
            return np.empty(0), np.empty(0), np.empty(0)
        integrals = np.add.reduceat(areas, edges[:-1])
        # reduceat sums the last interval to the end of the run, beyond its edge.
        integrals[-1] = areas[edges[-2] : edges[-1]].sum()
        return np.diff(self.position[edges]), integrals, np.diff(self.velocity[edges])


def _check_pair(runs: Sequence[Run], position: str, rate: str) -> Iterator[QualityFinding]:
    """Yield a finding if a recorded velocity contradicts the change of its position.

    The changes of the position are compared with the integral of the velocity over the same
    intervals. The first of these findings is reported: no correlation, a wrong sign, a wrong factor
    (such as a unit), or a delay.

    Args:
        runs: Runs that contain both channels.
        position: Name of the position channel.
        rate: Name of the velocity channel.
    """
    comparison = VelocityComparison.measure(runs, position, rate)
    if comparison is None:
        return
    dq, s = comparison.position_changes, comparison.velocity_integrals
    correlation, slope = comparison.correlation, comparison.slope
    if abs(correlation) < MIN_CORRELATION:
        yield QualityFinding(
            "contradiction",
            f"{rate} does not match the derivative of {position} (correlation {correlation:.2f})",
            "is it of another joint? correct the columns, or leave it out",
        )
        return
    # The slope of dq against s is too small due to noise of s, and the inverse of the slope of s
    # against dq is too large due to noise of dq. The true slope lies between them.
    inverse_slope = float(dq @ dq) / float(dq @ s)
    residual = dq - slope * s
    error = float(np.sqrt(residual @ residual / max(dq.size - 1, 1) / (s @ s)))
    size = f"{position} moves {slope:.3g} times as far as the integral of {rate}"
    threshold = max(SLOPE_ERROR_THRESHOLD, SIGNIFICANCE_SIGMAS * error)
    if slope < 0:
        yield QualityFinding("contradiction", size, f"a sign is wrong: reverse the sign of {rate}")
    elif slope > 1.0 + threshold or inverse_slope < 1.0 - threshold:
        yield QualityFinding("contradiction", size, _recommend_correction(abs(np.log(slope)), rate))
    elif (delay := comparison.delay()) is not None:
        yield QualityFinding(
            "contradiction",
            f"{rate} is {1e3 * abs(delay.seconds):.2g} ms (±{2e3 * delay.error:.1g}, "
            f"{delay.samples:.2g} samples) {delay.direction_word} the derivative of {position}",
            "it is filtered, or stamped at a different time: use the position, or leave it out",
        )


def _recommend_correction(log_ratio: float, rate: str) -> str:
    """Recommend a correction for a velocity that is wrong by a factor.

    If the factor is that between two usual units, the unit is wrong.

    Args:
        log_ratio: absolute natural logarithm of the factor.
        rate: name of the velocity.
    """
    for factor, unit in _UNIT_BY_RATIO.items():
        if abs(log_ratio - np.log(factor)) < MAX_UNIT_LOG_ERROR:
            return f"one of the two is in {unit}: correct its unit"
    return f"correct the unit or the gain of {rate}, or leave it out"
