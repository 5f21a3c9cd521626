"""What an explanation tells: plain data that account, figures and report are made from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from bench.gap.apart import Apart
from bench.gap.identify import Number
from bench.gap.model.bounds import Bound
from bench.gap.verdict import Verdict
from sims.base import Array

if TYPE_CHECKING:
    from sims.robot.model import Robot


@dataclass(frozen=True)
class Shown:
    """One recorded channel: name, unit, noise (1 sigma), whether that is stated, its quantisation
    (0: none).
    """

    name: str
    unit: str
    sigma: float
    stated: bool
    step: float


@dataclass(frozen=True)
class Side:
    """Runs with what was measured and simulated.

    Attributes:
        names: of the runs.
        times: (T_r,) seconds of each run.
        observed: (R, T, C), NaN where missing and behind the end of shorter runs.
        before: (R, T, C) the tuned base model.
        after: (R, T, C) the extended model; the base model again where nothing was found.
    """

    names: tuple[str, ...]
    times: tuple[Array, ...]
    observed: Array
    before: Array
    after: Array


@dataclass(frozen=True)
class Place:
    """Where the gap is: RMS of the residual in units of the noise, before and after, in one part of
    the data.

    Attributes:
        kind: ``run``, ``channel`` or ``phase``.
        label: which one.
        samples: how many.
        before: RMS, 1 is the noise floor.
        after: RMS.
    """

    kind: str
    label: str
    samples: int
    before: float
    after: float


@dataclass(frozen=True)
class Profile:
    """The residual of one channel against a variable, averaged in bins.

    Attributes:
        channel: whose residual.
        variable: ``time``, ``position``, ``speed`` or an input's name.
        unit: of the variable.
        centres: (B,) of the bins.
        before: (B,) mean residual, units of the channel; NaN in empty bins.
        after: (B,).
        error: (B,) standard error of a mean, from the noise.
    """

    channel: str
    variable: str
    unit: str
    centres: Array
    before: Array
    after: Array
    error: Array


@dataclass(frozen=True)
class Tuned:
    """A parameter before and after the extension, each with its 95 % interval (NaN where the data
    give none), and which end of its range it lies at, before and after; of a robot also what
    becomes of the number of its model file.
    """

    name: str
    unit: str
    before: tuple[float, float, float]
    after: tuple[float, float, float]
    touched: bool
    bounds: tuple[Bound | None, Bound | None] = (None, None)
    in_file: str = ""


@dataclass(frozen=True)
class Change:
    """A line of a robot's model file that the extended one has otherwise.

    Attributes:
        element: whose line, as ``joint elbow``.
        before: the line as it is; empty where there is none.
        after: the line as it should be; empty where it goes.
        comment: which cause, interval and recording ask for it.
    """

    element: str
    before: str
    after: str
    comment: str = ""


@dataclass(frozen=True)
class Story:
    """Everything that is told.

    Attributes:
        title: of the recording.
        path: of the recording.
        verdict: the answer with its numbers; its ``says`` and names are texts from files or
            plugins: escape them.
        channels: the recorded ones.
        fitting: runs for fitting.
        held_out: runs for measuring; None where there are none.
        places: where the gap is, held-out runs included.
        profiles: the residual against time, position, speed and inputs.
        parameters: before and after.
        remains: what the extended model leaves unexplained and what to bear in mind, a sentence
            each; may be empty.
        why: sentences that say why the verdict is what it is, the most important first.
        vague: names of base parameters that the data do not fix.
        robot: whose recording it is, to be drawn; None for systems that are no robots.
        changes: of its model file.
        unwritten: what its model file cannot hold, and what is to be known of it, a sentence each.
        fixable: what the recording can say of each number and cause; empty where nobody knows.
        apart: what runs, logs and loads say of the numbers by themselves.
        track: the picture of a film's track (PNG), of a recording that was tracked; empty for none.
        logs: recordings that are explained together.
        thorough: whether all has been searched that can be.
        cross_validated: whether `held_out` has all runs, each predicted by fits to the others,
            since they were too few to hold one out.
        share_intervals: 95 % interval of the share of the held-out gap that each effect closes
            alone, by its name, where that was simulated.
    """

    title: str
    path: Path
    verdict: Verdict
    channels: tuple[Shown, ...]
    fitting: Side
    held_out: Side | None
    places: tuple[Place, ...]
    profiles: tuple[Profile, ...]
    parameters: tuple[Tuned, ...]
    remains: tuple[str, ...]
    why: tuple[str, ...]
    vague: tuple[str, ...] = ()
    robot: Robot | None = None
    changes: tuple[Change, ...] = ()
    unwritten: tuple[str, ...] = ()
    fixable: tuple[Number, ...] = ()
    apart: Apart = field(default_factory=Apart)
    track: bytes = b""
    logs: int = 1
    thorough: bool = False
    cross_validated: bool = False
    share_intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def validation_runs(self) -> str:
        """Name the runs of `held_out` in a sentence."""
        return "runs left out in turn" if self.cross_validated else "held-out runs"

    @property
    def validation_run(self) -> str:
        """Return the word that goes before the name of a run of `held_out`."""
        return "left-out" if self.cross_validated else "held-out"
