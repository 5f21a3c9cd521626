"""Choice of the segments of the runs: their duration, and which of them are left out.

Runs are cut into shorter segments, each with its own initial state, where no simulation follows a
whole run. Of a robot on the ground, segments whose motion no simulation predicts are left out.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.diagnosis.explain_options import ExplainOptions
from bench.diagnosis.pipeline.base_model import BaseModel
from bench.diagnosis.pipeline.simulated_runs import ContactConditions, SimulatedRuns
from sims.core.simulator import Array, Simulator
from sims.recording.recorded_poses import ANGLES

CONTACT_SEGMENT_SECONDS = 0.5
"""Duration in seconds of the segments of a robot on the ground."""
SEGMENT_DURATIONS = (1.0, 0.5, 0.25)
"""Durations in seconds of the segments that are tried if no simulation of whole runs succeeds."""
MAX_RUN_AMPLIFICATION = 1000.0
"""Maximum factor by which whole runs may amplify an error of their first positions."""
MAX_SEGMENT_AMPLIFICATION = 100.0
"""Maximum factor by which segments may amplify an error of their first positions."""
MIN_UNFOLLOWED_RESIDUAL = 3.0
"""Minimum RMS residual, in units of the noise, of whole runs that are cut into segments."""
MAX_ROTATION_ERROR = 0.5
"""Maximum error in rad of the simulated orientation of a floating body.

Beyond it, the effects of small changes are not linear.
"""
MAX_RESIDUAL_RATIO = 1.25
"""Maximum residual (RMS) of a segment without a jump, relative to the median of all segments."""
MAX_LEFT_OUT_SHARE = 0.25
"""Maximum share of the segments that are left out because of jumps."""


def choose_segment_duration(kind: type[Simulator], options: ExplainOptions) -> float | None:
    """Return the duration in seconds of the segments of each run; None for the usual ones.

    Runs of a robot on the ground are cut unless the user requests otherwise: a linear model about a
    simulated motion is not valid for long where contacts begin and end.

    Args:
        kind: Class of the simulator.
        options: Options of the diagnosis.
    """
    is_on_ground = ContactConditions(kind).is_on_ground
    if options.pieces is not None or options.whole or not is_on_ground:
        return options.pieces
    return CONTACT_SEGMENT_SECONDS


def is_divisible(runs: SimulatedRuns) -> bool:
    """Return whether runs may be cut into segments: those of a robot with a recorded pose.

    Those of a robot on the ground are short already.

    Args:
        runs: Prepared runs.
    """
    kind: Any = runs.kind
    has_unknown_states = kind.has_model and bool(kind.system.required_state_units)
    return kind.has_model and not has_unknown_states and not runs.contacts.is_on_ground


def find_segment_duration(model: BaseModel) -> float | None:
    """Return the duration in seconds of segments that a simulation can follow.

    An unstable or chaotic motion amplifies the error of an estimated first state, until no
    simulation follows it. Shorter segments begin at new first states.

    Args:
        model: Base model, fitted to whole runs.

    The amplification is the largest change of a reading in a segment, in units of its noise, that
    follows from an error of one first position by the noise of its readings.

    Returns:
        The longest of `SEGMENT_DURATIONS` with a small amplification, or the shortest if none
        has one. None if whole runs can be used: the base model simulates them well, they
        amplify errors little, or no filter can tell.
    """
    followed = model.runs.fitting.filtered_runs
    if followed is None or not model.is_usable:
        return None
    _, residual_rms = model.rate()
    is_simulated = residual_rms < MIN_UNFOLLOWED_RESIDUAL
    # Negated, so that NaN counts as a small amplification.
    if is_simulated or not followed.compute_amplification() > MAX_RUN_AMPLIFICATION:
        return None
    for seconds in SEGMENT_DURATIONS:
        if followed.compute_amplification(seconds) <= MAX_SEGMENT_AMPLIFICATION:
            return seconds
    return SEGMENT_DURATIONS[-1]


def loses_orientation(model: BaseModel) -> bool:
    """Return whether a simulated floating body is far from its recorded orientation.

    Beyond a certain error a fit does not find back; the runs are then divided into shorter
    segments.

    Args:
        model: Fitted base model of a robot.
    """
    # Channels of the orientation, such as `q.base.yaw`.
    names = [
        f"q.{base_name}.{angle}"
        for base_name in model.runs.kind.system.base_orientations
        for angle in ANGLES
    ]
    evaluator = model.runs.fitting
    angle_channels = [c for c, name in enumerate(evaluator.channels) if name in names]
    errors = (model.fit.fit.simulated - evaluator.observed)[..., angle_channels]
    return bool(np.nanmax(np.abs(errors), initial=0.0) > MAX_ROTATION_ERROR)


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
