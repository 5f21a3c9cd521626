"""Python API: `simgap.design`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bench.api.explain import with_all_cores
from bench.api.recordings import Sources, list_sources
from bench.core.option_dataclasses import with_options
from bench.diagnosis import explain as explaining
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
        if self.design is None:
            return ["no run could be simulated that stays within the limits of joints and commands"]
        return self.design.format_lines()

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
        write_files({path: self.design.format_csv()})


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
