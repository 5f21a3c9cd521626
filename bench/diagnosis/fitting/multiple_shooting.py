"""Multiple shooting: fit short segments of the runs first, to start long fits near the minimum.

Over a long run, a small change of a period, a limit or a delay moves the trajectory far from the
data, so the sum of squares has many local minima. It has few over short segments, because every
segment starts at the data (multiple shooting; H. G. Bock 1983, doi:10.1007/978-1-4684-7324-7_7).
With the observation y, the simulated observation h at time t, and the state z_k of segment k at its
start time τ_k, the segments are fitted by

    min over θ, z_1 ... z_K of  Σ_k Σ_{τ_k ≤ t < τ_{k+1}} |y(t) - h(t; z_k, θ)|² / σ²            (1)

Bock also requires that segment k ends where segment k + 1 begins. This constraint is omitted here:
the segment fit only gives a start for the fit of whole runs, which enforces continuity, and decides
nothing itself.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from bench.diagnosis.evaluation.noise_model import Mask, NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.levenberg_marquardt import FitStart, TrajectoryFit
from sims.core.simulator import Array
from sims.recording.recording import Run

SEGMENTS_PER_RUN = 4
"""Maximum number of segments per run; a run gets fewer if the segments would be too short."""
MIN_MEAN_SEGMENT_SAMPLES = 20
"""Minimum number of samples per segment, on average over the segments of a run."""
MAX_MISSING_FACTOR = 2
"""Factor by which a segment may fall below `MIN_MEAN_SEGMENT_SAMPLES` due to missing samples."""
RUN_END_SHARE = 0.1
"""Share of a run, at its end, in which the influence of the initial state is measured."""
MAX_STATE_INFLUENCE = 0.1
"""Maximum influence of the initial state on the end of a run if the run forgets its initial state.

The influence is a share of the largest influence within the run.
"""


def make_segment_evaluator(evaluator: RunEvaluator) -> RunEvaluator | None:
    """Return a `RunEvaluator` of the segments with the same parameters.

    A floating base is excluded, because its pose at the start of a segment is not known. A system
    that bounces is excluded, too: for a segment that starts near an impact, the side of the impact
    is ambiguous, and for a ball that comes to rest the fit searches among hundreds of small bounces
    (this takes minutes in the updraft cases of the exam).

    Args:
        evaluator: the whole runs.

    Returns:
        The segments as runs, or None if every run is too short for two segments, or if the system
        has a floating base or bounces.
    """
    if evaluator.simulator.system.bounces or evaluator.simulator.system.required_state_units:
        return None
    runs = [segment for run in evaluator.runs for segment in _split_run(run)]
    if len(runs) == len(evaluator.runs):
        return None
    return evaluator.with_runs(runs)


def _split_run(run: Run) -> list[Run]:
    """Split a run into segments of equal length, or return it whole if one is too sparse.

    The number of segments is the largest for which they have `MIN_MEAN_SEGMENT_SAMPLES` samples on
    average, up to `SEGMENTS_PER_RUN`. One that has less than half of these samples is too sparse.

    Args:
        run: recorded run.

    Returns:
        At most `SEGMENTS_PER_RUN` segments, each with its own initial state in a fit.
    """
    # A time counts as sampled if any channel has a sample.
    values = np.stack(list(run.channels.values()))
    is_sampled: Mask = np.any(np.isfinite(values), axis=0)
    count = int(np.clip(is_sampled.sum() // MIN_MEAN_SEGMENT_SAMPLES, 1, SEGMENTS_PER_RUN))
    edges = np.linspace(0, run.times.size, count + 1).astype(int)
    parts = [slice(begin, end) for begin, end in pairwise(edges)]
    # Segments have equal length, but one of them may have too many missing samples.
    if any(
        is_sampled[part].sum() < MIN_MEAN_SEGMENT_SAMPLES // MAX_MISSING_FACTOR for part in parts
    ):
        return [run]
    return [run.part(part, f"{run.name}.{number}") for number, part in enumerate(parts)]


def join_segment_fits(evaluator: RunEvaluator, segment_fit: TrajectoryFit) -> FitStart:
    """Return the start of a fit of the whole runs from a fit of their segments.

    Args:
        evaluator: the whole runs.
        segment_fit: fit of the segments of `evaluator`.

    Returns:
        The fitted parameters, with the initial states of the first segment of each run.
    """
    counts = [len(_split_run(run)) for run in evaluator.runs]
    # The initial state of a run is that of its first segment.
    first = np.cumsum([0, *counts])[:-1]
    return FitStart(segment_fit.effects, segment_fit.theta, segment_fit.initial_states[first])


def forgets_initial_state(evaluator: RunEvaluator, noise: NoiseModel, derivatives: Array) -> bool:
    """Return whether initial states hardly influence the last samples of each run.

    Then a fit of whole runs has no more local minima than a fit of their segments, and multiple
    shooting is not needed.

    Shapes: R runs, T samples, C channels, s states of a run.

    Args:
        evaluator: evaluator with the recorded runs.
        noise: noise of each channel.
        derivatives: (R, T, C, s) derivatives of the simulated runs by their initial states; zero
            for known states.
    """
    observed_mask = np.isfinite(evaluator.observed)[..., None]
    # Influence of each state (R, T, s) on the channel that shows it most, in units of the noise.
    state_influence = np.abs(np.where(observed_mask, derivatives / noise.sigma[:, None], 0.0)).max(
        axis=2
    )
    for influence, length in zip(state_influence, evaluator.lengths, strict=True):
        # If all initial states of a run are known, the decay of their influence cannot be measured.
        if not influence.any():
            return False
        last_samples = influence[int((1.0 - RUN_END_SHARE) * length) : int(length)]
        if (last_samples.max(axis=0) > MAX_STATE_INFLUENCE * influence.max(axis=0)).any():
            return False
    return True
