"""Report data of an explanation, from which summary, figures and page are made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from bench.diagnosis.evaluation.parameter_bounds import Bound
from bench.diagnosis.identifiability import ParameterIdentifiability
from bench.diagnosis.validation.run_consistency import ConsistencySummary
from bench.diagnosis.verdict import Verdict
from sims.core.simulator import Array

if TYPE_CHECKING:
    from sims.robot.robot_model import RobotModel


@dataclass(frozen=True)
class ChannelInfo:
    """Recorded channel.

    Attributes:
        name: Name of the channel.
        unit: Unit of its values.
        sigma: Standard deviation of the noise.
        stated: Whether the noise is specified in the recording.
        step: Quantisation step; 0 for none.
    """

    name: str
    unit: str
    sigma: float
    stated: bool
    step: float


@dataclass(frozen=True)
class DataSplit:
    """Runs with measured and simulated data.

    Attributes:
        names: Names of the runs.
        times: (T_r,) sample times of each run in seconds.
        observed: (R, T, C) measurements; NaN where missing and after the end of shorter runs.
        before: (R, T, C) simulated by the fitted base model.
        after: (R, T, C) simulated by the extended model; the base model if nothing was found.
    """

    names: tuple[str, ...]
    times: tuple[Array, ...]
    observed: Array
    before: Array
    after: Array


@dataclass(frozen=True)
class GapLocation:
    """Gap location: RMS residual in units of the noise in one part of the data.

    Attributes:
        kind: ``run``, ``channel`` or ``phase``.
        label: Name of the part.
        samples: Number of samples.
        before: RMS residual of the base model; 1 is the noise floor.
        after: RMS residual of the extended model.
    """

    kind: str
    label: str
    samples: int
    before: float
    after: float


@dataclass(frozen=True)
class ResidualProfile:
    """Residual of one channel against a variable, averaged in bins.

    Attributes:
        channel: Name of the channel.
        variable: ``time``, ``position``, ``speed`` or an input's name.
        unit: Unit of the variable.
        centres: (B,) centres of the bins.
        before: (B,) mean residual of the base model, in the channel's unit; NaN in empty bins.
        after: (B,) mean residual of the extended model.
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
class ParameterChange:
    """Change of a parameter by the extension.

    Attributes:
        name: Name of the parameter.
        unit: Unit of its value.
        before: Value in the base model, with the ends of its 95 % interval; NaN without an
            interval.
        after: Value in the extended model, with the ends of its 95 % interval.
        is_sensitive: Whether the data are sensitive to it.
        bounds: End of its range that it is at, before and after; None if it is inside.
        in_file: For a robot, text on the change of its number in the model file.
    """

    name: str
    unit: str
    before: tuple[float, float, float]
    after: tuple[float, float, float]
    is_sensitive: bool
    bounds: tuple[Bound | None, Bound | None] = (None, None)
    in_file: str = ""


@dataclass(frozen=True)
class ModelFileChange:
    """Changed line of a robot's model file.

    Attributes:
        element: Element of the line, such as ``joint elbow``.
        before: Line in the file; empty if there is none.
        after: Line in the extended file; empty if it is removed.
        comment: Cause, interval and recording that are the reason.
    """

    element: str
    before: str
    after: str
    comment: str = ""


@dataclass(frozen=True)
class DiagnosisReportData:
    """Report data of an explanation.

    Attributes:
        title: Title of the recording.
        path: Path of the recording.
        verdict: Verdict with its numbers. Its ``says`` and names come from files or plugins and
            must be escaped.
        channels: Recorded channels.
        fitting: Runs for fitting.
        held_out: Runs for validation; None if there are none.
        gap_locations: Gap locations, including held-out runs.
        profiles: Residual against time, position, speed and inputs.
        parameters: Parameters before and after.
        lack_of_fit: Sentences on what the extended model leaves unexplained, and notes; may be
            empty.
        why: Reasons for the verdict, one sentence each, the most important first.
        unidentified_parameters: Names of base parameters that the data do not identify.
        robot: Recorded robot, to be drawn; None for other systems.
        changes: Changes of the robot's model file.
        unwritable_causes: Notes on the model file and on what it cannot express, one sentence each.
        identifiability: Identifiability of each parameter and cause; empty if unknown.
        consistency: Consistency of the parameters between runs, logs and loads.
        track: Figure of a ball track (PNG) for a recording from a film; empty for none.
        logs: Number of recordings that are explained together.
        thorough: Whether the search was thorough.
        cross_validated: Whether `held_out` contains all runs, each predicted by fits to the others,
            because there were too few to hold one out.
        share_intervals: 95 % interval of the share of the held-out gap that each effect closes
            alone, by effect, if it was simulated there.
    """

    title: str
    path: Path
    verdict: Verdict
    channels: tuple[ChannelInfo, ...]
    fitting: DataSplit
    held_out: DataSplit | None
    gap_locations: tuple[GapLocation, ...]
    profiles: tuple[ResidualProfile, ...]
    parameters: tuple[ParameterChange, ...]
    lack_of_fit: tuple[str, ...]
    why: tuple[str, ...]
    unidentified_parameters: tuple[str, ...] = ()
    robot: RobotModel | None = None
    changes: tuple[ModelFileChange, ...] = ()
    unwritable_causes: tuple[str, ...] = ()
    identifiability: tuple[ParameterIdentifiability, ...] = ()
    consistency: ConsistencySummary = field(default_factory=ConsistencySummary)
    track: bytes = b""
    logs: int = 1
    thorough: bool = False
    cross_validated: bool = False
    share_intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def validation_runs(self) -> str:
        """Name of the runs of `held_out` in a sentence."""
        return "runs left out in turn" if self.cross_validated else "held-out runs"

    @property
    def validation_run(self) -> str:
        """Word before the name of a run of `held_out`."""
        return "left-out" if self.cross_validated else "held-out"

    @property
    def has_extended_model(self) -> bool:
        """Return whether there is an extended model to show next to the base model."""
        return bool(self.verdict.causes)

    @property
    def data_splits(self) -> list[DataSplit]:
        """The fitted runs and the held-out runs, as far as they exist."""
        splits = (self.fitting, self.held_out)
        return [split for split in splits if split is not None and split.names]
