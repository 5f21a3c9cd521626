"""Result of `explain`: displayed in a notebook, queried for its parts, or written to a folder."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from bench.diagnosis.extended_robot_files import ExtendedRobotFiles, build_robot_files
from bench.diagnosis.randomization_ranges import RandomizationRanges, list_randomization_ranges
from bench.diagnosis.report import explanation_figures
from bench.diagnosis.report.cause_and_value_text import (
    format_cause_with_values,
    format_percent,
    sanitise,
)
from bench.diagnosis.report.consistency_section import AGREEMENT_COLUMNS, build_consistency_rows
from bench.diagnosis.report.explanation_page import render_report
from bench.diagnosis.report.model_file_changes import find_model_file_changes
from bench.diagnosis.report.report_data import DiagnosisReportData
from bench.diagnosis.report.summary_text import format_early_stop, format_interval, has_gap_closed
from bench.diagnosis.search.verdict_rules import VerdictName
from bench.diagnosis.verdict import Cause, Verdict
from bench.figures.figure_settings import pdf_figures
from bench.pages.html_page import make_iframe
from bench.pages.text_format import format_csv
from sims import extended_simulator as extending
from sims.core.argument_checks import check_arguments
from sims.core.files import Content, write_all_atomically
from sims.core.simulator import InputError
from sims.extended_simulator import ExtendedSimulator

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_TEXT_WIDTH = 160
"""Maximum number of characters per line when the result is shown as text; the rest is cut off."""


@dataclass(frozen=True, repr=False)
class Explanation:
    """Result of `explain`.

    Attributes:
        answer: Verdict with its numbers; ``answer.to_document()`` is the content of verdict.json.
        story: Data from which text, figures and page of the report are rendered.
        extended: Extended simulator.
    """

    answer: Verdict
    story: DiagnosisReportData
    extended: ExtendedSimulator

    @property
    def verdict(self) -> VerdictName:
        """``adequate``, ``named``, ``ambiguous``, ``partial``, ``unknown``, ``unidentifiable``."""
        return self.answer.verdict

    @property
    def causes(self) -> tuple[Cause, ...]:
        """Effects that the simulation lacks, strongest first; empty if nothing was found."""
        return self.answer.causes

    @property
    def figures(self) -> tuple[str, ...]:
        """Names of the available figures.

        They are at most ``overview``, ``where``, ``candidates``, and ``robot`` for a robot.
        """
        return explanation_figures.list_figure_names(self.story)

    def figure(self, name: str) -> Figure:
        """Draw one of the report's figures.

        Args:
            name: One of `figures`.

        Raises:
            InputError: There is no figure of that name.
        """
        return explanation_figures.draw_figure(self.story, name)

    @check_arguments
    def write(self, folder: str | Path, *, pdf: bool = False, ranges: bool = False) -> list[Path]:
        """Write verdict.json, extended.toml, the figures and report.html: all of them or none.

        For several runs apart.csv is written too (whether they agree on each parameter), and for a
        robot extended.xml, and extended.urdf if the robot comes from a URDF; they follow
        extended.toml.

        A missing folder is created; existing files with these names are replaced.

        Args:
            folder: Folder to write to.
            pdf: Also write each figure as PDF, in addition to PNG.
            ranges: Also write the ranges for domain randomisation (`ranges`), if there are any:
                ranges.toml, ranges.csv, ranges_isaac_lab.py and ranges_mujoco_playground.py.

        Returns:
            The files in the order above, each figure as PNG before PDF.

        Raises:
            InputError: The folder cannot be created or written to.
        """
        folder = Path(folder)
        with pdf_figures(pdf):
            figures = explanation_figures.render_figures(self.story)
        contents: dict[Path, Content] = {
            folder / "verdict.json": self._format_json(),
            folder / "extended.toml": extending.format_extended(self.extended, folder),
        }
        if consistency_rows := build_consistency_rows(self.story):
            contents[folder / "apart.csv"] = format_csv(AGREEMENT_COLUMNS, consistency_rows)
        contents |= {folder / name: text for name, text in self._robot_files.contents.items()}
        if ranges:
            # This import is needed only if ranges are requested.
            from bench.diagnosis.randomization_files import build_range_files

            range_contents = build_range_files(self.ranges, self.extended, folder)
            contents |= {folder / name: text for name, text in range_contents.items()}
        for name, figure in figures.items():
            contents[folder / f"{name}.png"] = figure.png
            if figure.pdf is not None:
                contents[folder / f"{name}.pdf"] = figure.pdf
        contents[folder / "report.html"] = render_report(self._report_data, figures, folder)
        # Everything is rendered before the first file is written: an earlier failure leaves no
        # files.
        try:
            folder.mkdir(parents=True, exist_ok=True)
            write_all_atomically(contents)
        except OSError as error:
            raise InputError(f"{folder}: cannot be written ({error.strerror})") from None
        return list(contents)

    @cached_property
    def ranges(self) -> RandomizationRanges:
        """Ranges for domain randomisation.

        They contain, for each fitted number of a robot's diagnosed causes and for each free number,
        the 95 % interval of the resulting value in the model file.
        """
        return list_randomization_ranges(self.answer, self.extended)

    @property
    def unsaid(self) -> tuple[str, ...]:
        """For a robot: what its model file cannot express, and notes on what was written to it."""
        return self._robot_files.notes

    @cached_property
    def _robot_files(self) -> ExtendedRobotFiles:
        return build_robot_files(self.extended)

    @cached_property
    def _report_data(self) -> DiagnosisReportData:
        """Report data, with the changes that the diagnosis makes to a robot's model file."""
        files = self._robot_files
        # No file was written, so there are no changes to show.
        if not files.contents:
            return replace(self.story, unwritable_causes=files.notes)
        return replace(
            self.story,
            changes=find_model_file_changes(files.before, files.after),
            unwritable_causes=files.notes,
        )

    def _format_json(self) -> str:
        return json.dumps(self.answer.to_document(), indent=1, allow_nan=False) + "\n"

    def __repr__(self) -> str:
        """Summarise the verdict, the causes and the share of the gap that is closed."""
        lines = [
            f"{self.verdict}: {self.story.title}",
            self._format_causes(),
            self._format_gain(),
        ]
        lines.append(format_early_stop(self.story))
        # Titles and names come from files; a long one must not fill the cell.
        return "\n".join(sanitise(line, MAX_TEXT_WIDTH) for line in lines if line)

    def _format_causes(self) -> str:
        return "; ".join(format_cause_with_values(cause) for cause in self.causes)

    def _format_gain(self) -> str:
        """Return the share of the gap that is closed; empty if nothing was found or measured."""
        held_out = self.story.verdict.heldout
        if not self.causes or held_out is None or not has_gap_closed(held_out):
            return ""
        share = format_percent(held_out.gap_closed)
        return (
            f"{share} of the gap closed{format_interval(held_out)} on {self.story.validation_runs}"
        )

    def _repr_html_(self) -> str:
        """Return the report in a frame for a notebook cell, so that its styles stay inside."""
        # A cell has no folder with files, so none is linked.
        return make_iframe(
            render_report(self._report_data, explanation_figures.render_figures(self.story))
        )
