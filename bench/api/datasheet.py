"""Python API: `simgap.datasheet`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, TypeAlias

from bench.api.explain import with_all_cores
from bench.api.recordings import Sources, list_sources
from bench.core.option_dataclasses import with_options
from bench.core.plugin_registries import simulators
from bench.diagnosis import explain as explaining
from bench.diagnosis.datasheet.datasheet import DataSheet, build_datasheet
from bench.diagnosis.datasheet.datasheet_joint import make_subject
from bench.diagnosis.explain_options import ExplainOptions
from bench.diagnosis.explanation import Explanation
from bench.diagnosis.verdict import Verdict, read_verdict
from bench.logs.recording_joining import load_joined
from sims.core.argument_checks import Expected, Name
from sims.core.simulator import InputError
from sims.extended_simulator import ExtendedSimulator, open_extended
from sims.recording.recording import Recording
from sims.system_simulator import SystemSimulator

Explained: TypeAlias = Annotated[
    str | Path | Explanation,
    Expected("an Explanation (of explain), or the folder that it was written to"),
]
"""A result of `explain`."""


@dataclass(frozen=True, kw_only=True)
class DatasheetOptions(ExplainOptions):
    """Options of a data sheet, in addition to those of `explain`.

    Attributes:
        joint: Name of the joint, if the robot has several.
        name: Name on the sheet (default: the name of the joint or system).
        explained: Result of `explain` for these logs, or the folder to which it was written
            (default: they are explained now).
    """

    joint: Name | None = None
    name: Name | None = None
    explained: Explained | None = None


@with_options(DatasheetOptions)
def datasheet(recording: Sources, options: DatasheetOptions) -> DataSheet:
    """Make the data sheet of a joint or actuator.

    Args:
        recording: The logs, as for `explain`.
        options: Keyword arguments, the attributes of `DatasheetOptions` and those of `explain`.

    Raises:
        InputError: As for `explain`; or there is no such joint, or the folder was not written by
            explain, or belongs to other logs.
    """
    sources, explained = list_sources(recording, options), options.explained
    if explained is None:
        check_joint_exists(sources, options)
        explained = explaining.explain(sources, with_all_cores(options))
    if isinstance(explained, Explanation):
        extended, verdict = explained.extended, explained.answer
    else:
        extended, verdict = _read_explanation_folder(Path(explained))
    # The numbers of a robot's model file that were tuned; other systems have no such file.
    free = extended.robot.free if extended.robot is not None else ()
    loaded, kind = load_joined(
        sources, options.system, options.model, free, fix_base=options.fix_base
    )
    # Both are simulator classes: that of the explained system, and that of the logs.
    if extended.kind is None or kind.name != extended.kind.name:
        raise InputError(
            f"{loaded.path}: expected a recording of {extended.system}, as for the explanation; "
            f"found one of {kind.name}"
        )
    options.say("computing detection limits")
    return build_datasheet(loaded, extended, verdict, options.joint, options.name)


def check_joint_exists(
    sources: Sequence[str | Path | Recording], options: DatasheetOptions
) -> None:
    """Reject a joint that the recording's robot does not have, before anything is explained.

    Args:
        sources: The logs.
        options: Options of the data sheet, with the name of the joint.

    Raises:
        InputError: There is no joint with this name, or there are several and none is named.
    """
    loaded, kind = load_joined(
        sources, options.system, options.model, options.free, fix_base=options.fix_base
    )
    if not issubclass(kind, SystemSimulator):
        raise InputError(f"{loaded.path}: simulator {loaded.system} takes no effects")
    make_subject(kind, options.joint)


def _read_explanation_folder(folder: Path) -> tuple[ExtendedSimulator, Verdict]:
    """Read the results that explain has written to a folder.

    Returns:
        The extended simulator with its simulator class, and the verdict.
    """
    verdict = read_verdict(folder)
    extended, kind, _ = open_extended(folder / "extended.toml", simulators.get)
    return replace(extended, kind=kind), verdict
