"""Changes of recorded signals: source, factor, offset, whole turns, and the times of inputs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from sims.core.angles_and_quaternions import unwrap_angle
from sims.core.simulator import Array
from sims.recording.recording import Recording, Run


@dataclass(frozen=True)
class SignalChange:
    """Signal of the model as a function of a recorded signal, in SI units.

    Attributes:
        source: Name of the recorded signal.
        scale: Factor.
        offset: Offset that is added after the factor.
        unwrap: Whether whole turns are restored first.
        command: Name of the command that determines the turn of a position; empty without one.
    """

    source: str
    scale: float = 1.0
    offset: float = 0.0
    unwrap: bool = False
    command: str = ""

    def applied(self, signals: Mapping[str, Array]) -> Array:
        """Return the signal (T,) in the convention of the model.

        Args:
            signals: Recorded signals by name, each (T,).
        """
        values = signals[self.source]
        if self.unwrap:
            values = unwrap_angle(values, signals.get(self.command))
        return self.scale * values + self.offset


def change_signals(recording: Recording, changes: Mapping[str, SignalChange]) -> Recording:
    """Return a recording with changed signals; stated noise is scaled with its signal.

    All changes refer to the signals of the given recording, so that two signals can be exchanged.

    Args:
        recording: the recording, with its stated noise (standard deviation) by signal.
        changes: changes by the name of the signal.
    """
    noise = dict(recording.noise)
    for name, change in changes.items():
        if change.source in recording.noise:
            noise[name] = abs(change.scale) * recording.noise[change.source]
    runs = tuple(_change_run(run, changes) for run in recording.runs)
    return replace(recording, noise=noise, runs=runs)


def _change_run(run: Run, changes: Mapping[str, SignalChange]) -> Run:
    """Return one run with changed signals.

    `run.before` has, by name of an input, the stacked pair of time stamps and values recorded
    before the run, if it is a part of a run; the values are changed like those of the run.

    Args:
        run: the run.
        changes: changes by the name of the signal; other signals stay as they are.
    """
    signals = {**run.inputs, **run.channels}
    earlier_times = {name: times for name, (times, _) in run.before.items()}
    earlier_values = {name: values for name, (_, values) in run.before.items()}

    def convert(values: Mapping[str, Array], source: Mapping[str, Array]) -> dict[str, Array]:
        """Return signals by name, with the changed ones converted.

        A change may need another signal, for example if two joints are exchanged.

        Args:
            values: signals to convert, (T,) by name.
            source: all signals at the same times, from which a changed one may be computed.
        """
        return {
            name: changes[name].applied(source) if name in changes else unchanged
            for name, unchanged in values.items()
        }

    before = {
        name: np.stack([earlier_times[name], values])
        for name, values in convert(earlier_values, earlier_values).items()
    }
    return replace(
        run,
        channels=convert(run.channels, signals),
        inputs=convert(run.inputs, signals),
        before=before,
    )


def advance_inputs(run: Run, delay: float) -> Run:
    """Return a run with its inputs moved to earlier times by a delay in s.

    The end of the run is cut off, because its new inputs were not recorded. Samples are moved
    instead of the offset of the time stamps, because a part of a run contains no inputs after its
    end. Inputs that are linear between samples are interpolated; others hold their last value.

    Args:
        run: recorded run; `run.linear` names the inputs that are linear between samples.
        delay: delay of the command time stamps in s, positive.
    """
    shifted_times = run.times + delay
    # Samples whose new input was recorded, with half a delay of tolerance; a run has at least two.
    count = int(np.searchsorted(shifted_times, run.times[-1] + 0.5 * delay, side="right"))
    count = min(max(count, 2), run.times.size)
    inputs = {}
    for name, values in run.inputs.items():
        if name in run.linear:
            advanced = np.interp(shifted_times, run.times, values)
        else:
            # Index of the last sample up to the shifted time; the tolerance is for stamps that
            # differ by rounding.
            last_indices = (
                np.searchsorted(run.times, shifted_times + 1e-6 * delay, side="right") - 1
            )
            advanced = values[last_indices]
        inputs[name] = advanced
    return replace(run, inputs=inputs).part(slice(0, count))
