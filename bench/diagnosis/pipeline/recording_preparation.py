"""Prepare a recording for a diagnosis: read it, check it, and select and cut its runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

from bench.core.resource_estimates import check_recording_size
from bench.diagnosis.evaluation.noise_floor import INTEGRATION_ERROR_SHARE, add_minimal_noise
from bench.diagnosis.pipeline.segment_choice import (
    choose_segment_duration,
    leave_out_unpredictable_segments,
)
from bench.diagnosis.pipeline.simulated_runs import (
    DiagnosisContext,
    SimulatedRuns,
    choose_engine,
)
from bench.logs.filter_settling import leave_out_settling
from bench.logs.lost_samples import fill_lost_commands
from bench.logs.quality.log_quality import check_recording_plausible
from bench.logs.recording_joining import load_joined
from bench.logs.sample_thinning import thin_recording
from bench.logs.segmentation import segment_recording
from bench.pages.text_format import joined
from sims.core.simulator import InputError, Simulator
from sims.extended_simulator import check_not_extended
from sims.recording.recording import Recording
from sims.system_simulator import SystemSimulator

MIN_SAMPLES_PER_UNKNOWN = 2.0
"""Minimum number of samples for fitting per unknown."""
MIN_EXTRA_SAMPLES = 4
"""Minimum number of samples for fitting in addition to `MIN_SAMPLES_PER_UNKNOWN` per unknown."""
MAX_CHANNEL_SIZE_FACTOR = 1e9
"""Recorded values of at least this multiple of a channel's typical size are refused."""
RecordingSource: TypeAlias = str | Path | Recording

MIN_HELD_LOG_LIKELIHOOD = 1.0
"""Minimum gain in log-likelihood for each lost row if its command counts as held.

A model with a wrong number may prefer either kind of command by less.
"""


def prepare_runs(sources: Sequence[RecordingSource], context: DiagnosisContext) -> SimulatedRuns:
    """Load and check recordings, and build their run evaluators, before any fit.

    The runs are thinned, cut and given noise where needed; lost commands are filled; segments that
    no simulation predicts are left out. What is changed is noted for the user.

    Args:
        sources: paths of tables, or recordings in memory, which are joined.
        context: options of the diagnosis; it receives the notes on what is changed.

    Raises:
        InputError: The recording or the simulator cannot be used for a diagnosis.
    """
    options = context.options
    # `_without_inactive_drives` is applied to each recording before its runs are divided.
    recording, kind = load_joined(
        sources,
        options.system,
        options.model,
        options.free,
        _without_inactive_drives,
        options.fix_base,
    )
    if not issubclass(kind, SystemSimulator):
        raise InputError(
            f"{recording.path}: simulator {recording.system} takes no effects, "
            "so nothing can be missing from it"
        )
    # Effects that are part of the simulator already could not be chosen again.
    check_not_extended(kind)
    kind = _add_contact_effects(recording, kind)
    # This check precedes the run evaluators, which plan every step of every run.
    for anomaly in check_recording_plausible(recording, kind, options.force):
        options.say(f"{recording.path}: {anomaly}")
    recording = _prepare_recording(recording, kind, context)
    check_recording_size(recording, kind(engine=choose_engine(kind, options)), options.force)
    runs = _fill_lost_commands(SimulatedRuns.build(context, kind, recording))
    if runs.contacts.is_on_ground:
        runs = leave_out_unpredictable_segments(runs)
    context.add_notes(
        f"{effect} is not tested: {reason}" for effect, reason in kind.system.left_out.items()
    )
    _check_sample_count(runs)
    _check_sizes(runs)
    return runs


def _without_inactive_drives(recording: Recording, kind: type[Simulator]) -> Recording:
    """Switch off or leave out the samples of a robot in which its drives have no effect.

    Args:
        recording: the recording.
        kind: class of the simulator.
    """
    if not kind.has_model:
        return recording
    # This import is needed for robots only.
    from bench.diagnosis.prediction_error.inactive_drives import remove_inactive_drives

    return remove_inactive_drives(recording, kind)


def _add_contact_effects(
    recording: Recording, kind: type[SystemSimulator]
) -> type[SystemSimulator]:
    """Return the simulator of a robot with effects at the contacts of the recording.

    Only pairs of geoms that touch in the recorded motion get effects such as contact friction.
    Without any, and for a system, the simulator is returned as it is.

    Args:
        recording: the recording, whose motion shows the contacts.
        kind: class of the simulator.
    """
    if not kind.has_model:
        return kind
    # These imports are needed for robots only.
    from sims.robot.contact_pairs import find_recorded_contacts
    from sims.robot.robot_simulator import RobotSimulator

    assert issubclass(kind, RobotSimulator)
    contacts = find_recorded_contacts(recording, kind)
    return kind.with_contacts(contacts) if contacts else kind


def _prepare_recording(
    recording: Recording, kind: type[SystemSimulator], context: DiagnosisContext
) -> Recording:
    """Thin and split the runs, leave out their settling, and add noise where there is none.

    Args:
        recording: the recording.
        kind: class of the simulator.
        context: options of the diagnosis; each change is noted in it.
    """
    options = context.options
    recording, thinning_note = thin_recording(recording, kind)
    recording, settling_note = leave_out_settling(recording, kind)
    seconds = choose_segment_duration(kind, options)
    recording, segment_note = segment_recording(recording, kind, seconds, options.whole)
    recorded = recording.runs[0].channels
    names = [channel.name for channel in kind.channels if channel.name in recorded]
    recording, noise_free_channels = add_minimal_noise(recording, names)
    noise_note = _format_added_noise(noise_free_channels)
    notes = thinning_note, settling_note, segment_note, noise_note
    context.add_notes(note for note in notes if note)
    return recording


def _fill_lost_commands(runs: SimulatedRuns) -> SimulatedRuns:
    """Interpolate the commands of lost rows of a robot unless they were clearly held.

    A logger may have lost a row whose command was sent, or the controller may have sent none, so
    that the previous command was held. A filter is run with both; the more likely one shows which.
    Held commands must be clearly likelier, by a log-likelihood for each filled row.

    Args:
        runs: the runs as recorded, in which the command before a lost row is held.

    Returns:
        The given runs if no row is lost or the commands were held; otherwise the filled runs.
    """
    if not runs.kind.has_model:
        return runs
    # The note for the user is empty if no row is lost.
    filled, note = fill_lost_commands(runs.recording)
    if not note:
        return runs
    filled_row_count = sum(
        filled_run.times.size - run.times.size
        for filled_run, run in zip(filled.runs, runs.recording.runs, strict=True)
    )
    filled_runs = SimulatedRuns.build(runs.context, runs.kind, filled)
    held = runs.nominal_filter.log_likelihood
    interpolated = filled_runs.nominal_filter.log_likelihood
    if held > interpolated + MIN_HELD_LOG_LIKELIHOOD * filled_row_count:
        return runs
    runs.context.add_notes([note])
    return filled_runs


def _format_added_noise(channels: Sequence[str]) -> str:
    """Return the message about channels to which noise was added; empty if there are none."""
    if not channels:
        return ""
    return (
        f"no noise is found in {joined(channels)}: white noise of {INTEGRATION_ERROR_SHARE:g} of "
        "the range is added, the accuracy of a simulation; smaller differences are not explained"
    )


def _check_sample_count(runs: SimulatedRuns) -> None:
    """Refuse a recording with too few samples for its parameters and initial states.

    With fewer samples than unknowns every model fits exactly, and no gap would be visible.

    Args:
        runs: the prepared runs.

    Raises:
        InputError: There are too few samples.
    """
    evaluator = runs.fitting
    samples = int(np.isfinite(evaluator.observed).sum())
    # Base parameters, and the initial states of all runs that are not known.
    unknowns = evaluator.base_indices.size + int((~evaluator.known_state_mask).sum())
    if samples < MIN_SAMPLES_PER_UNKNOWN * unknowns + MIN_EXTRA_SAMPLES:
        min_samples = int(MIN_SAMPLES_PER_UNKNOWN * unknowns) + MIN_EXTRA_SAMPLES
        raise InputError(
            f"{runs.recording.path}: too short: {samples} samples for fitting, "
            f"expected at least {min_samples} for {unknowns} parameters and initial states"
        )


def _check_sizes(runs: SimulatedRuns) -> None:
    """Refuse values that are too large by orders of magnitude, which no fit could follow.

    Their unit must be wrong. They are compared with the typical size of the channel,
    `channel.scale`.

    Args:
        runs: the prepared runs, for fitting and held out.

    Raises:
        InputError: A value is too large.
    """
    for c, channel in enumerate(runs.fitting.simulator.channels):
        largest = max(
            float(np.nanmax(np.abs(evaluator.observed[..., c]), initial=0.0))
            for evaluator in runs.evaluators
        )
        if largest >= MAX_CHANNEL_SIZE_FACTOR * channel.scale:
            raise InputError(
                f"{runs.recording.path}: column {channel.name}: expected values of about "
                f"{channel.scale:g} {channel.unit}, found {largest:.3g}; is the unit right?"
            )
