"""Check whether the clock of the sensors drifts against that of the commands.

The response of a position y to a command u is modelled as linear with finite memory,

    p(t) = c + d t + sum_k h_k <u>_k(t),  <u>_k the mean of u over the k-th interval before t  (1)

so that slow and fast commands each have the lag that the drive gives them. A position whose delay
grows by a share e of the time is

    y(t) = p(t - T - e t) = p - (T + e t) p' + ...                                             (2)

Least squares for T and e finds the shift at which the two are most similar (the maximum of the
cross-correlation, to first order; C. Knapp, G. Carter, IEEE Trans. ASSP 24(4), 320, 1976). The
standard error of e is computed from sums over blocks longer than the memory, since the residual of
(1) is not white (W. Newey, K. West, Econometrica 55, 703, 1987).
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from bench.logs.quality.quality_finding import QualityFinding
from sims.core.simulator import Array, Simulator
from sims.recording.recording import Recording, Run
from sims.system_simulator import SystemSimulator

MAX_COMPARED_INSTANTS = 8000
"""Maximum number of times of a run at which command and position are compared."""
LAG_BIN_EDGES = (-2, -1, 0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)
"""Bounds of the intervals of equation (1), in grid steps before the time considered."""
BLOCK_COUNT = 4
"""Minimum number of blocks of a run for estimating the standard error of its drift."""
STUDENT_T_FACTORS = (
    9.0,
    9.0,
    9.0,
    2.7,
    1.9,
    1.6,
    1.43,
    1.35,
    1.3,
    1.25,
    1.2,
    1.18,
    1.16,
    1.14,
    1.12,
    1.1,
    1.05,
)
"""Correction factors of the standard error, indexed by the number of blocks.

They are the factors by which an error from few blocks is too small (Student's t at 95 %, one block
lost).
"""
MODEL_ERROR_SHARE = 0.01
"""Relative error of the drift from truncating equation (2)."""
MIN_EXPLAINED_VARIANCE = 0.9
"""Minimum share of a position's variance that equation (1) must explain."""
MIN_REPORTED_DRIFT = 2e-5
"""Smallest reported drift (dimensionless); ordinary quartz clocks differ by less."""
SIGNIFICANCE_SIGMAS = 4.0
"""Detection threshold in standard deviations."""


class _Estimate(NamedTuple):
    """Relative clock drift and its standard error, both dimensionless."""

    drift: float
    error: float


def check_clock_drift(recording: Recording, kind: type[Simulator]) -> Iterator[QualityFinding]:
    """Find the clock drift, pooled over all runs and driven coordinates, if it is significant.

    Args:
        recording: Recording to check.
        kind: Simulator class of its system.

    Returns:
        At most one finding.
    """
    estimates = [
        estimate
        for command, position in _list_driven_positions(kind)
        for run in recording.runs
        if command in run.inputs and position in run.channels
        for estimate in _estimate_run_drifts(run, command, position)
    ]
    if not estimates:
        return
    drift, error = _pool_estimates(estimates)
    if abs(drift) < max(MIN_REPORTED_DRIFT, SIGNIFICANCE_SIGMAS * error):
        return
    word = "fast" if drift > 0 else "slow"
    yield QualityFinding(
        "drift",
        f"the sensors' clock runs {1e6 * abs(drift):.3g} ppm (±{2e6 * error:.2g}) {word} against "
        "the commands'",
        "stamp both with one clock; the effect clock.skew of simgap explain estimates and "
        "removes it",
    )


def _list_driven_positions(kind: type[Simulator]) -> list[tuple[str, str]]:
    """Return pairs of an input and a position that it drives, by channel name."""
    if not issubclass(kind, SystemSimulator):
        return []
    if kind.has_model:
        robot: Any = kind
        return [(f"u.{a.name}", f"q.{a.joint}") for a in robot.robot.actuators if a.joint]
    return [(u.name, name) for u in kind.inputs for name in kind.system.coordinates]


def _estimate_run_drifts(run: Run, command: str, position: str) -> Iterator[_Estimate]:
    """Estimate the drift of the sensors' clock against the commands' clock in one run, by eq. (2).

    The position is predicted by means of past commands, eq. (1). A drift makes the delay grow with
    time t, so that the error of the prediction has a part proportional to t times the velocity.
    Nothing is yielded if the commands explain too little of the motion.
    """
    t, u, y = run.times, run.inputs[command], run.channels[position]
    is_recorded = np.isfinite(y)
    if is_recorded.sum() < 2 * len(LAG_BIN_EDGES) or not (np.nanstd(y) > 0 and np.std(u) > 0):
        return
    step = max(float(np.median(np.diff(t))), float(t[-1] - t[0]) / MAX_COMPARED_INSTANTS)
    grid = np.arange(t[0], t[-1], step)
    positions = np.interp(grid, t[is_recorded], y[is_recorded])
    past_command_means = _average_over_intervals(np.interp(grid, t, u))
    fitted_part = slice(LAG_BIN_EDGES[-1], len(grid) + LAG_BIN_EDGES[0])
    time = (grid - grid.mean())[fitted_part]
    positions, past_command_means = positions[fitted_part], past_command_means[fitted_part]
    if time.size < BLOCK_COUNT * LAG_BIN_EDGES[-1] or not np.std(positions) > 0:
        return
    regressors = np.column_stack([np.ones_like(time), time, past_command_means])
    coefficients, *_ = np.linalg.lstsq(regressors, positions, rcond=1e-10)
    predicted = regressors @ coefficients  # Equation (1).
    if np.var(positions - predicted) > (1.0 - MIN_EXPLAINED_VARIANCE) * np.var(positions):
        return
    rate = np.gradient(predicted, step)
    basis, _ = np.linalg.qr(np.column_stack([regressors, rate]))
    delay_response = -time * rate
    delay_response = delay_response - basis @ (basis.T @ delay_response)
    response_power = float(delay_response @ delay_response)
    if not response_power > 0:
        return
    drift = float(delay_response @ positions) / response_power
    residual = positions - basis @ (basis.T @ positions) - drift * delay_response
    block_sums = np.add.reduceat(
        delay_response * residual, np.arange(0, time.size, LAG_BIN_EDGES[-1])
    )
    error = (
        STUDENT_T_FACTORS[min(len(block_sums), len(STUDENT_T_FACTORS) - 1)]
        * float(np.sqrt(block_sums @ block_sums))
        / response_power
    )
    yield _Estimate(drift, float(np.hypot(error, MODEL_ERROR_SHARE * drift)))


def _average_over_intervals(u: Array) -> Array:
    """Return the (N, K) means of a command over the intervals of equation (1)."""
    total = np.concatenate([[0.0], np.cumsum(u)])
    samples = np.arange(u.size)
    columns = []
    for begin, end in pairwise(LAG_BIN_EDGES):
        first, last = (np.clip(samples - bound + 1, 0, u.size) for bound in (end, begin))
        columns.append((total[last] - total[first]) / (end - begin))
    return np.column_stack(columns)


def _pool_estimates(estimates: list[_Estimate]) -> _Estimate:
    """Return the weighted mean; scale its error up if estimates scatter more than their errors."""
    drifts, errors = np.array(estimates).T
    weights = np.maximum(errors, 1e-12) ** -2.0
    drift = float(weights @ drifts / weights.sum())
    error = float(weights.sum() ** -0.5)
    if len(estimates) > 1:
        scatter = float(weights @ (drifts - drift) ** 2) / (len(estimates) - 1)
        error *= max(scatter, 1.0) ** 0.5
    return _Estimate(drift, error)
