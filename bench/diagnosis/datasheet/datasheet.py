"""Build and write the data sheet of a joint or actuator, as page and files (`simgap datasheet`)."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

from bench.diagnosis.datasheet import datasheet_content
from bench.diagnosis.datasheet.datasheet_content import SheetContent, build_sheet_rows
from bench.diagnosis.datasheet.datasheet_figure import render_diagram, render_pdf
from bench.diagnosis.datasheet.datasheet_joint import make_subject
from bench.diagnosis.datasheet.datasheet_mjcf import CLASS_FILE, MjcfFiles, build_mjcf
from bench.diagnosis.datasheet.detection_limits import compute_detection_limits, list_absent_effects
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.report import cause_and_value_text
from bench.diagnosis.verdict import Verdict
from bench.figures.figure_output import FigureFiles
from bench.logs.filter_settling import leave_out_settling
from bench.logs.segmentation import segment_recording
from bench.pages.html_page import HtmlPage
from bench.pages.page_table import Table
from sims import effects as library
from sims.core.argument_checks import check_arguments
from sims.core.effect import Effect
from sims.core.files import Content, write_all_atomically
from sims.core.simulator import InputError, make_unknown_name_error
from sims.core.user_messages import format_run_names
from sims.extended_simulator import ExtendedSimulator
from sims.recording.recording import Recording

_TEMPLATE = Path(__file__).with_name("sheet.html")
DIAGRAM_NAME = "diagram"
"""Name of the figure, and of the table with its numbers."""
_NAMED_RUNS = 8
"""Maximum number of runs that the footer names."""


def render_page(sheet: SheetContent, diagram: FigureFiles | None, mjcf: MjcfFiles) -> str:
    """Render the HTML datasheet of an explained simulator.

    The page has the numbers with their evidence, detection limits of absent effects, the drive
    diagram and the MJCF class.

    Args:
        sheet: Content of the data sheet.
        diagram: Diagram as SVG, and as PDF if requested; None without a drive.
        mjcf: MJCF files with their notes.
    """
    page = HtmlPage({DIAGRAM_NAME: diagram} if diagram else None)
    if sheet.diagram is not None:
        columns = {
            "load": sheet.diagram.load.tolist(),
            "moves_forward": sheet.diagram.forward.tolist(),
            "moves_back": sheet.diagram.back.tolist(),
        }
        page.add_table(DIAGRAM_NAME, Table(columns))
    return page.render(
        _TEMPLATE,
        sheet=sheet,
        has_diagram=diagram is not None,
        runs=format_run_names([run.name for run in sheet.recording.training()], _NAMED_RUNS),
        elsewhere=list(sheet.elsewhere()),
        class_file=CLASS_FILE,
        class_text=mjcf.contents.get(CLASS_FILE, ""),
        notes=mjcf.notes,
        content=datasheet_content,
        wording=cause_and_value_text,
    )


TRANSMISSION = frozenset({"joint.backlash", "joint.coupling", "joint.flexibility"})
"""Effects between a drive and its joint."""


class DataSheet(SheetContent):
    """Data sheet of a joint or actuator that can be written to a folder."""

    @check_arguments
    def write(self, folder: str | Path) -> list[Path]:
        """Write sheet.toml, .html and .pdf, class.xml and models that use it: all or none.

        A missing folder is created.

        Args:
            folder: Folder to write to.

        Returns:
            The files that were written.

        Raises:
            InputError: The folder cannot be created or written to.
        """
        import tomli_w

        folder = Path(folder)
        mjcf = build_mjcf(self, folder)
        diagram = render_diagram(self.diagram) if self.diagram is not None else None
        contents: dict[Path, Content] = {
            folder / "sheet.toml": tomli_w.dumps(self.document()),
            folder / "sheet.html": render_page(self, diagram, mjcf),
            folder / "sheet.pdf": render_pdf(self),
            **{folder / name: text for name, text in mjcf.contents.items()},
        }
        try:
            folder.mkdir(parents=True, exist_ok=True)
            write_all_atomically(contents)
        except OSError as error:
            raise InputError(f"{folder}: cannot be written ({error.strerror})") from None
        return list(contents)


def build_datasheet(
    recording: Recording,
    extended: ExtendedSimulator,
    verdict: Verdict,
    joint: str | None = None,
    name: str | None = None,
) -> DataSheet:
    """Build the data sheet of a joint or actuator: identified numbers and detection limits.

    The recording is prepared as for a diagnosis. Detection limits are computed for all absent
    effects that the recorded channels could show; effects that need a drive are only listed for
    driven joints. Stops are not listed, since they show by their position and not by a size.

    Args:
        recording: Logs that were explained.
        extended: Extended simulator that was identified from them; its class is known.
        verdict: Verdict of the same diagnosis, with the evidence.
        joint: Joint of a robot; None for the only one.
        name: Name on the sheet; None for the name of the joint or the system.

    Raises:
        InputError: The joint does not exist, or the logs are not of this system.
    """
    # 1. Joint or system, whose channels must be recorded.
    kind = extended.kind
    assert kind is not None
    subject = make_subject(kind, joint)
    recorded_channels = list(recording.runs[0].channels)
    for channel in extended.observe:
        if channel not in recorded_channels:
            raise make_unknown_name_error(
                f"channel of {recording.path}", channel, recorded_channels
            )
    # 2. Recording, prepared as for a diagnosis; its own constants take precedence.
    recording = replace(recording, constants={**extended.constants, **recording.constants})
    recording, _ = leave_out_settling(recording, kind)
    recording, _ = segment_recording(recording, kind)
    # 3. Absent effects.
    is_driven = subject.is_driven(recording)
    absent_effects = []
    for absent_name in list_absent_effects(subject, extended):
        effect = library.find_effect(absent_name, kind.system)
        if (is_driven or not _needs_drive(absent_name, effect)) and not _is_stop(effect):
            absent_effects.append(absent_name)
    # 4. Detection limits and rows.
    candidates = [*extended.effects, *absent_effects]
    # A simulator with its own integrator has no engine to choose.
    engine = None if kind.own_engine else extended.engine
    evaluator = RunEvaluator(kind, recording, recording.training(), engine, candidates=candidates)
    with closing(evaluator):
        # An effect on a channel that is not recorded has no visible influence.
        visible_effects = [
            absent_name
            for absent_name in absent_effects
            if not evaluator.available_effects[absent_name].signal
            or _is_recorded(evaluator, absent_name)
        ]
        limits = compute_detection_limits(evaluator, extended, visible_effects)
        rows = build_sheet_rows(subject, extended, verdict, limits)
    return DataSheet(
        name or subject.joint or kind.name, subject, recording, verdict, extended, rows
    )


def _needs_drive(name: str, effect: Effect | type[Effect]) -> bool:
    """Return whether an effect belongs to a drive or its transmission.

    Args:
        name: name of the effect, with its place if it has one.
        effect: the effect.
    """
    return effect.at == "actuator" or name.partition("@")[0] in TRANSMISSION


def _is_stop(effect: Effect | type[Effect]) -> bool:
    """Return whether an effect is a stop, which shows by its position, not by its stiffness."""
    return effect.coefficients[0].of == "stop"


def _is_recorded(evaluator: RunEvaluator, effect: str) -> bool:
    """Return whether the signal that an effect acts on was recorded.

    Args:
        evaluator: evaluator that simulates the recorded runs for any parameters and effects.
        effect: name of the effect, with its place on a robot: ``drag.linear@elbow``.
    """
    run = evaluator.runs[0]
    return evaluator.available_effects[effect].signal in {*run.channels, *run.inputs}
