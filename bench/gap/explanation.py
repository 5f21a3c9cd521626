"""The result of `explain`: to look at in a notebook, to ask for its parts, to write to a folder."""

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
"""Characters of a line when the result is shown as text; what is longer is cut."""


@dataclass(frozen=True, repr=False)
class Explanation:
    """The result of `explain`.

    Attributes:
        answer: the verdict with its numbers; ``answer.document()`` is what verdict.json says.
        story: everything a person is told.
        extended: the extended simulator.
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
        """What the simulation lacks, strongest first; empty where nothing was found."""
        return self.answer.causes

    @property
    def figures(self) -> tuple[str, ...]:
        """Names of the figures that there are: ``overview``, ``where``, ``candidates`` at most, and
        ``robot`` where it is one.
        """
        return pictures.names(self.story)

    def figure(self, name: str) -> Figure:
        """One of the report's figures, made anew.

        Raises:
            InputError: there is none of that name.
        """
        return pictures.figure(self.story, name)

    @check_arguments
    def write(self, folder: str | Path, *, pdf: bool = False, ranges: bool = False) -> list[Path]:
        """Write verdict.json, extended.toml, the figures and report.html: all of them or none. Of
        several runs also apart.csv, and for a robot extended.xml, and extended.urdf for one from a
        URDF, after extended.toml.

        The folder is made where it is missing; files of these names in it are replaced.

        Args:
            folder: to write to.
            pdf: write each figure as PDF too, in addition to PNG.
            ranges: also write the ranges for domain randomisation (`ranges`), if there are any:
                ranges.toml, ranges.csv, ranges_isaac_lab.py and ranges_mujoco_playground.py.

        Returns:
            The files in the order above, each figure as PNG before PDF.

        Raises:
            InputError: the folder cannot be made or written to.
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
            # Loaded for those who ask alone.
            from bench.gap.randomization.files import range_files

            found = range_files(self.ranges, self.extended, folder)
            contents |= {folder / name: text for name, text in found.items()}
        for name, figure in figures.items():
            contents[folder / f"{name}.png"] = figure.png
            if figure.pdf is not None:
                contents[folder / f"{name}.pdf"] = figure.pdf
        contents[folder / "report.html"] = page(self._told, figures, folder)
        # All is drawn before the first file is made: what fails until here leaves no trace.
        try:
            folder.mkdir(parents=True, exist_ok=True)
            write_all(contents)
        except OSError as error:
            raise InputError(f"{folder}: cannot be written ({error.strerror})") from None
        return list(contents)

    @cached_property
    def ranges(self) -> RandomizationRanges:
        """The ranges for domain randomisation: of each fitted number of a robot's named causes, and
        of each free number, the 95 % interval of what the model file then has.
        """
        return randomization_ranges(self.answer, self.extended)

    @property
    def unsaid(self) -> tuple[str, ...]:
        """Of a robot: what its own file cannot say, and what is to be known of what it says."""
        return self._robot_files.said

    @cached_property
    def _robot_files(self) -> RobotFiles:
        return robot_files(self.extended)

    @cached_property
    def _told(self) -> Story:
        """The story, with what is to change in a robot's model file."""
        files = self._robot_files
        if not files.contents:
            return replace(self.story, unwritten=files.said)
        return replace(self.story, changes=changes(files.before, files.after), unwritten=files.said)

    def _json(self) -> str:
        return json.dumps(self.answer.document(), indent=1, allow_nan=False) + "\n"

    def __repr__(self) -> str:
        lines = [f"{self.verdict}: {self.story.title}", self._causes_in_words(), self._gain()]
        lines.append(cut(self.story))
        # Titles and names are from files: a long one must not fill the cell.
        return "\n".join(clean(line, WIDEST) for line in lines if line)

    def _causes_in_words(self) -> str:
        return "; ".join(_in_words(cause) for cause in self.causes)

    def _gain(self) -> str:
        """The share of the gap that is closed; empty where nothing was found or measured."""
        held_out = self.story.verdict.heldout
        if not self.causes or held_out is None or not closes(held_out):
            return ""
        share = percent(held_out.gap_closed)
        return f"{share} of the gap closed{interval(held_out)} on {self.story.validation_runs}"

    def _repr_html_(self) -> str:
        """The report for a notebook's cell, in a frame of its own so that its styles stay there."""
        # Nothing lies beside a cell: no file is named.
        return framed(page(self._told, pictures.printed(self.story)))


def _in_words(cause: Cause) -> str:
    """``drag.linear or friction.coulomb: coefficient 2.2×10⁻⁴ (2.0×10⁻⁴ to 2.4×10⁻⁴) N·s/m``."""
    effects = joined([cause.effect, *cause.alternatives], "or")
    numbers = [f"{name} {estimated(number)}" for name, number in cause.coefficients.items()]
    return f"{effects}: {joined(numbers)}"
