"""Result of `explain`: displayed in a notebook, queried for its parts, or written to a folder."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from bench.figures.formats import pdf_figures
from bench.gap.causes.rules import VerdictName
from bench.gap.randomization.ranges import RandomizationRanges, randomization_ranges
from bench.gap.report import pictures
from bench.gap.report.account import closes, cut, interval
from bench.gap.report.agreement import HEAD, rows
from bench.gap.report.changes import changes
from bench.gap.report.page import page
from bench.gap.report.story import Story
from bench.gap.report.words import clean, estimated, joined, percent
from bench.gap.robot_files import RobotFiles, robot_files
from bench.gap.verdict import Cause, Verdict
from bench.pages.csv_text import csv_text
from bench.pages.elements import framed
from sims import extended as extending
from sims.arguments import check_arguments
from sims.base import InputError
from sims.extended import Extended
from sims.files import Content, write_all

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDEST = 160
"""Maximum number of characters per line when the result is shown as text; the rest is cut off."""


@dataclass(frozen=True, repr=False)
class Explanation:
    """Result of `explain`.

    Attributes:
        answer: Verdict with its numbers; ``answer.document()`` is the content of verdict.json.
        story: Data from which text, figures and page of the report are rendered.
        extended: Extended simulator.
    """

    answer: Verdict
    story: Story
    extended: Extended

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
        return pictures.names(self.story)

    def figure(self, name: str) -> Figure:
        """Draw one of the report's figures.

        Args:
            name: One of `figures`.

        Raises:
            InputError: There is no figure of that name.
        """
        return pictures.figure(self.story, name)

    @check_arguments
    def write(self, folder: str | Path, *, pdf: bool = False, ranges: bool = False) -> list[Path]:
        """Write verdict.json, extended.toml, the figures and report.html: all of them or none.

        For several runs apart.csv is written too, and for a robot extended.xml, and extended.urdf
        if the robot comes from a URDF; they follow extended.toml.

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
            figures = pictures.printed(self.story)
        contents: dict[Path, Content] = {
            folder / "verdict.json": self._json(),
            folder / "extended.toml": extending.written(self.extended, folder),
        }
        if apart := rows(self.story):
            contents[folder / "apart.csv"] = csv_text(HEAD, apart)
        contents |= {folder / name: text for name, text in self._robot_files.contents.items()}
        if ranges:
            # This import is needed only if ranges are requested.
            from bench.gap.randomization.files import range_files

            found = range_files(self.ranges, self.extended, folder)
            contents |= {folder / name: text for name, text in found.items()}
        for name, figure in figures.items():
            contents[folder / f"{name}.png"] = figure.png
            if figure.pdf is not None:
                contents[folder / f"{name}.pdf"] = figure.pdf
        contents[folder / "report.html"] = page(self._told, figures, folder)
        # Everything is rendered before the first file is written: an earlier failure leaves no
        # files.
        try:
            folder.mkdir(parents=True, exist_ok=True)
            write_all(contents)
        except OSError as error:
            raise InputError(f"{folder}: cannot be written ({error.strerror})") from None
        return list(contents)

    @cached_property
    def ranges(self) -> RandomizationRanges:
        """Ranges for domain randomisation.

        They contain, for each fitted number of a robot's diagnosed causes and for each free number,
        the 95 % interval of the resulting value in the model file.
        """
        return randomization_ranges(self.answer, self.extended)

    @property
    def unsaid(self) -> tuple[str, ...]:
        """For a robot: what its model file cannot express, and notes on what was written to it."""
        return self._robot_files.said

    @cached_property
    def _robot_files(self) -> RobotFiles:
        return robot_files(self.extended)

    @cached_property
    def _told(self) -> Story:
        """Report data with the changes of a robot's model file."""
        files = self._robot_files
        if not files.contents:
            return replace(self.story, unwritten=files.said)
        return replace(self.story, changes=changes(files.before, files.after), unwritten=files.said)

    def _json(self) -> str:
        return json.dumps(self.answer.document(), indent=1, allow_nan=False) + "\n"

    def __repr__(self) -> str:
        lines = [f"{self.verdict}: {self.story.title}", self._causes_in_words(), self._gain()]
        lines.append(cut(self.story))
        # Titles and names come from files; a long one must not fill the cell.
        return "\n".join(clean(line, WIDEST) for line in lines if line)

    def _causes_in_words(self) -> str:
        return "; ".join(_in_words(cause) for cause in self.causes)

    def _gain(self) -> str:
        """Return the share of the gap that is closed; empty if nothing was found or measured."""
        held_out = self.story.verdict.heldout
        if not self.causes or held_out is None or not closes(held_out):
            return ""
        share = percent(held_out.gap_closed)
        return f"{share} of the gap closed{interval(held_out)} on {self.story.validation_runs}"

    def _repr_html_(self) -> str:
        """Return the report in a frame for a notebook cell, so that its styles stay inside."""
        # A cell has no folder with files, so none is linked.
        return framed(page(self._told, pictures.printed(self.story)))


def _in_words(cause: Cause) -> str:
    """Format a cause, its alternatives and its numbers.

    For example ``drag.linear or friction.coulomb: coefficient 2.2×10⁻⁴ (2.0×10⁻⁴ to 2.4×10⁻⁴)
    N·s/m``.
    """
    effects = joined([cause.effect, *cause.alternatives], "or")
    numbers = [f"{name} {estimated(number)}" for name, number in cause.coefficients.items()]
    return f"{effects}: {joined(numbers)}"
