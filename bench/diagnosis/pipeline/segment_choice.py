"""Leave out segments of a robot on the ground whose motion no simulation predicts."""

from __future__ import annotations

import numpy as np

from bench.diagnosis.pipeline.simulated_runs import SimulatedRuns
from sims.core.simulator import Array

MAX_RESIDUAL_RATIO = 1.25
"""Maximum residual (RMS) of a segment without a jump, relative to the median of all segments."""
MAX_LEFT_OUT_SHARE = 0.25
"""Maximum share of the segments that are left out because of jumps."""


def leave_out_unpredictable_segments(runs: SimulatedRuns) -> SimulatedRuns:
    """Leave out segments that no simulation predicts: those that not even a Kalman filter follows.

    Runs for fitting and held-out runs are treated separately. If the filter follows less than half
    of them, the model may be wrong instead, and all of them are kept.

    Args:
        runs: segments of a robot on the ground.

    Returns:
        The remaining segments; `runs` itself if none is left out.
    """
    # This import is needed for robots only.
    from bench.diagnosis.kalman.linearised_filter import FollowedRuns

    left_out: list[str] = []
    # The run evaluators are those of the runs for fitting and of the held-out runs.
    for evaluator in runs.evaluators:
        theta = evaluator.get_nominal_theta()
        # The filter of the runs for fitting is computed only once for all steps of the diagnosis.
        followed = (
            runs.nominal_filter
            if evaluator is runs.fitting
            else FollowedRuns.follow(evaluator, theta, runs.noise, max_linearisations=1)
        )
        is_followed = followed.are_runs_followed  # (R,)
        if 2 * is_followed.sum() >= is_followed.size:
            left_out += [evaluator.runs[i].name for i in np.flatnonzero(~is_followed)]
    return runs.without(left_out) if left_out else runs


def leave_out_jumps(runs: SimulatedRuns, simulated: Array) -> SimulatedRuns:
    """Leave out the few segments that a model alone does not explain.

    Where a wheel lifts off or a foot slips, the motion may depend on its initial state by a jump,
    which neither a fit nor a linear model follows. Few segments with a larger residual than the
    others show it.

    Shapes: R runs, T samples, C channels.

    Args:
        runs: the segments of a robot on the ground.
        simulated: (R, T, C) simulation of a model that explains most segments for fitting.

    Returns:
        The remaining segments; `runs` itself if none is left out.
    """
    residual = (simulated - runs.fitting.observed) / runs.noise.sigma
    residual_rms = np.sqrt(np.nanmean(np.square(residual), axis=(1, 2)))  # (R,)
    median = float(np.median(residual_rms))
    has_jump = residual_rms > MAX_RESIDUAL_RATIO * median
    is_rare = 0 < has_jump.sum() <= MAX_LEFT_OUT_SHARE * has_jump.size
    # If most segments are above the noise, the model lacks something else.
    if not median < MAX_RESIDUAL_RATIO or not is_rare:
        return runs
    return runs.without([runs.fitting.runs[i].name for i in np.flatnonzero(has_jump)])
