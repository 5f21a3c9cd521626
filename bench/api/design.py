"""Python API: `simgap.design`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.api.explain import Sources, Units, sources_of
from bench.gap import explain as explaining
from bench.gap.design import Design
from bench.gap.explanation import Explanation
from bench.gap.model.crew import cores
from bench.gap.model.progress import ProgressListener
from bench.gap.model.watch import Watch
from bench.gap.rig.worth import SPLITS
from bench.recordings.frames import FrameDescription
from sims.arguments import Count, Name, Names, check_arguments
from sims.base import InputError
from sims.recording.write import publish, refuse_existing

LONGEST = 600.0
"""Maximum duration of a designed run, in seconds."""


LONGER = 5.0
"""Maximum ratio of a run's duration to the requested one, if that settles a question."""
REPEATS = 8
"""Maximum number of repetitions of a run that is recommended."""


@dataclass(frozen=True)
class NextRecording:
    """Recommendation for the next recording.

    Attributes:
        explanation: Explanation of the existing recordings.
        design: The run to record; None if no run within the limits can be simulated.
    """

    explanation: Explanation
    design: Design | None

    def lines(self) -> list[str]:
        """Format the recommended run and its expected benefit as text."""
        found = self.design
        if found is None:
            return ["no run could be simulated that stays within the limits of what moves"]
        begin = ", ".join(f"{name} = {value:.4g}" for name, value in found.initial.items())
        lasting = f"{found.times[-1]:.3g} s"
        lines = [f"record next, {lasting}: {found.says}; begin near {begin}"]
        if found.by == "T":
            return [*lines, *_told(found)]
        factor = math.exp(min(found.gain, 50.0))
        what = f"it narrows what is known of all numbers together {factor:.3g} times"
        return [*lines, f"nothing is open: {what}"]

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
        refuse_existing([path])
        columns = [self.design.times, *self.design.inputs.values()]
        rows = ["t," + ",".join(self.design.inputs) if self.design.inputs else "t"]
        rows += [",".join(f"{value:.9g}" for value in row) for row in np.column_stack(columns)]
        publish({path: "\n".join(rows) + "\n"})


def _told(found: Design) -> list[str]:
    """Format which causes a run distinguishes, and which it does not."""
    lines = []
    if found.split:
        sizes = [f"{name} ({math.sqrt(found.told[name]):.3g})" for name in found.split]
        lines.append(
            f"it tells {found.effect} from {', '.join(sizes)}: by so many noises, once every "
            "number is fitted again, whichever is true"
        )
    stays = [name for name in found.told if name not in found.split]
    if stays:
        lines.append(f"no run of this kind tells it from {', '.join(stays)}")
    best = max((found.told[name] for name in stays), default=0.0)
    if best > 0 and (times := math.ceil(SPLITS / best)) <= REPEATS:
        lines.append(f"recorded {times} times it would tell it from one more of these")
    if found.settles:
        lines.append("that settles it")
    others = [group for group in found.groups if len(group) > 1 and found.effect not in group]
    lines += [f"should it be one of {', '.join(group)}: these stay open" for group in others]
    return lines


@check_arguments
def design(
    recording: Sources,
    *,
    seconds: float = 4.0,
    longest: float | None = None,
    system: Name | None = None,
    model: str | Path | None = None,
    units: Units | None = None,
    constants: Mapping[str, float] | None = None,
    description: Mapping[str, Any] | None = None,
    free: Names = (),
    jobs: Count | None = None,
    say: Callable[[str], None] = lambda _: None,
    stop: Callable[[], bool] = lambda: False,
    progress: Callable[[float, str], None] | None = None,
    listener: ProgressListener | None = None,
) -> NextRecording:
    """Design the next recording by simulation, within the limits of joints and commands.

    The commands distinguish causes that the existing runs cannot tell apart, or reduce the
    uncertainty of the estimated numbers.

    Args:
        recording: The existing recordings, as for `explain`.
        seconds: Duration of the next run in seconds.
        longest: Maximum duration in seconds, if `seconds` does not settle the open questions; None
            for five times `seconds`.
        system: As for `explain`.
        model: As for `explain`.
        units: As for `explain`.
        constants: As for `explain`.
        description: As for `explain`.
        free: As for `explain`.
        jobs: As for `explain`.
        say: As for `explain`.
        stop: As for `explain`.
        progress: As for `explain`.
        listener: As for `explain`.

    Raises:
        InputError: As for `explain`, or a duration is out of range.
    """
    if not 0 < seconds <= LONGEST:
        raise InputError(f"seconds: expected 0 to {LONGEST:g}, found {seconds!r}")
    most = min(LONGER * seconds, LONGEST) if longest is None else longest
    if not seconds <= most <= LONGEST:
        raise InputError(f"longest: expected {seconds:g} to {LONGEST:g}, found {most!r}")
    watch = Watch(None, stop, progress, listener)
    about = FrameDescription(system, model, units or {}, constants or {}, description or {})
    sources = sources_of(recording, about)
    given = sources, seconds, most, system, model, free, say, watch, jobs or cores()
    return NextRecording(*explaining.explain_and_design(*given))
