"""Python API: `simgap.design`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.api.explain import with_all_cores
from bench.api.recordings import Sources, list_sources
from bench.core.option_dataclasses import with_options
from bench.diagnosis import explain as explaining
from bench.diagnosis.experiment_design.information_gain import DISCRIMINATION_THRESHOLD
from bench.diagnosis.experiment_design.next_run import NextRunDesign
from bench.diagnosis.explain_options import ExplainOptions
from bench.diagnosis.explanation import Explanation
from sims.core.argument_checks import Seconds, check_arguments
from sims.core.files import check_absent, write_files
from sims.core.simulator import InputError

MAX_RUN_SECONDS = 600.0
"""Maximum duration of a designed run, in seconds."""


MAX_LENGTH_FACTOR = 5.0
"""Maximum ratio of a run's duration to the requested one, if that settles a question."""
MAX_REPEATS = 8
"""Maximum number of repetitions of a run that is recommended."""
MAX_LOG_GAIN = 50.0
"""Largest logarithm of a gain that is printed as a factor."""


@dataclass(frozen=True)
class NextRecording:
    """Recommendation for the next recording.

    Attributes:
        explanation: Explanation of the existing recordings.
        design: The run to record; None if no run within the limits can be simulated.
    """

    explanation: Explanation
    design: NextRunDesign | None

    def lines(self) -> list[str]:
        """Format the recommended run and its expected benefit as text."""
        design = self.design
        if design is None:
            return ["no run could be simulated that stays within the limits of joints and commands"]
        initial_text = ", ".join(f"{name} = {value:.4g}" for name, value in design.initial.items())
        lines = [f"record next, {design.times[-1]:.3g} s: {design.says}; begin near {initial_text}"]
        if design.is_for_discrimination:
            return [*lines, *_format_discrimination(design)]
        # The gain is a logarithm; its limit keeps the factor printable.
        factor = math.exp(min(design.gain, MAX_LOG_GAIN))
        benefit = (
            f"it shrinks the joint confidence region of all parameters by a factor of {factor:.3g}"
        )
        return [*lines, f"no causes need to be distinguished: {benefit}"]

    @check_arguments
    def write(self, path: str | Path) -> None:
        """Write the commands as CSV.

        The columns are ``t`` in s and one for each input in the SI units of `simgap list systems`;
        values are held from row to row.

        Args:
            path: Path of a new file.

        Raises:
            InputError: There is no run, or the file exists already.
        """
        if self.design is None:
            raise InputError("there is no run to write")
        path = Path(path)
        check_absent([path])
        columns = [self.design.times, *self.design.inputs.values()]
        rows = ["t," + ",".join(self.design.inputs) if self.design.inputs else "t"]
        rows += [",".join(f"{value:.9g}" for value in row) for row in np.column_stack(columns)]
        write_files({path: "\n".join(rows) + "\n"})


def _format_discrimination(design: NextRunDesign) -> list[str]:
    """Format which causes a run distinguishes from the present one, and which it does not.

    The discrimination of two causes is the squared distance between their predictions, in noise
    standard deviations. It is proportional to the number of recordings, which gives the number of
    repeats that would be needed.

    Args:
        design: the designed run with its discrimination.
    """
    lines, discrimination = [], design.discrimination
    if design.distinguished_effects:
        distances = [
            f"{name} ({math.sqrt(discrimination[name]):.3g})"
            for name in design.distinguished_effects
        ]
        lines.append(
            f"it distinguishes {design.effect} from {', '.join(distances)}; in brackets: "
            "distance between the predictions in noise standard deviations, with all parameters "
            "refitted"
        )
    remaining = [name for name in discrimination if name not in design.distinguished_effects]
    if remaining:
        lines.append(f"no run of this kind distinguishes it from {', '.join(remaining)}")
    # The cause that needs the fewest repetitions.
    best = max((discrimination[name] for name in remaining), default=0.0)
    if best > 0 and (repeats := math.ceil(DISCRIMINATION_THRESHOLD / best)) <= MAX_REPEATS:
        lines.append(f"{repeats} recordings of it would distinguish one more of these")
    if design.settles_all:
        lines.append("all equivalent causes are then distinguished")
    other_groups = [
        group for group in design.groups if len(group) > 1 and design.effect not in group
    ]
    lines += [
        f"if the cause is one of {', '.join(group)}, this run does not distinguish them"
        for group in other_groups
    ]
    return lines


@dataclass(frozen=True, kw_only=True)
class DesignOptions(ExplainOptions):
    """Options of the design of the next recording, in addition to those of `explain`.

    Attributes:
        seconds: Duration of the next run in seconds.
        longest: Maximum duration in seconds, if a run of `seconds` does not distinguish all causes
            (default: five times `seconds`).
    """

    seconds: Seconds = 4.0
    longest: Seconds | None = None


@with_options(DesignOptions)
def design(recording: Sources, options: DesignOptions) -> NextRecording:
    """Design the next recording by simulation, within the limits of joints and commands.

    The commands distinguish causes that the existing runs do not distinguish, or reduce the
    uncertainty of the estimated numbers.

    Args:
        recording: The existing recordings, as for `explain`.
        options: Keyword arguments, the attributes of `DesignOptions` and those of `explain`.

    Raises:
        InputError: As for `explain`, or a duration is out of range.
    """
    seconds, longest = options.seconds, options.longest
    if not 0 < seconds <= MAX_RUN_SECONDS:
        raise InputError(f"seconds: expected 0 to {MAX_RUN_SECONDS:g}, found {seconds!r}")
    longest_seconds = (
        min(MAX_LENGTH_FACTOR * seconds, MAX_RUN_SECONDS) if longest is None else longest
    )
    if not seconds <= longest_seconds <= MAX_RUN_SECONDS:
        raise InputError(
            f"longest: expected {seconds:g} to {MAX_RUN_SECONDS:g}, found {longest_seconds!r}"
        )
    sources = list_sources(recording, options)
    explanation, next_run = explaining.explain_and_design(
        sources, seconds, longest_seconds, with_all_cores(options)
    )
    return NextRecording(explanation, next_run)
