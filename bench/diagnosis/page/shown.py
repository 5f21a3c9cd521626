"""What the page of a comparison of diagnosers shows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import pandas as pd

from bench.figures.style import Look, Pictures, look
from bench.pages.chart import Series, Static
from bench.problem.experiment import Experiment


@dataclass(frozen=True)
class Shown:
    """A comparison of diagnosers as its page shows it.

    Attributes:
        experiment: what was asked for.
        folder: where it lies.
        order: diagnosers, in the order of colours.
        rows: a row an answer, of the questions that everybody was asked.
        tables: by name, see `bench.diagnosis.tables.all_tables`.
        training: what learning cost, a row a diagnoser and system.
        pictures: figures by name, as they are printed.
        skipped: diagnosers that could not be asked, and why.
        planned: questions of the sheet.
        left_out: rows of questions that a diagnoser cannot be asked, and that count nowhere.
    """

    experiment: Experiment
    folder: str
    order: Sequence[str]
    rows: pd.DataFrame
    tables: Mapping[str, pd.DataFrame]
    training: Sequence[Mapping[str, str]]
    pictures: Mapping[str, Pictures]
    skipped: Mapping[str, str]
    planned: int
    left_out: pd.DataFrame

    @property
    def asked(self) -> int:
        """Questions that everybody was asked."""
        return int(self.rows["question"].nunique())

    def looks(self) -> Iterator[tuple[str, Look]]:
        """Each diagnoser with its look."""
        return ((name, look(place)) for place, name in enumerate(self.order))

    def points(self, y: str, *, beside: bool = False, **where: str) -> tuple[Series, ...]:
        """A row of marks with intervals for each diagnoser, side by side on a category axis."""
        count = len(self.order)
        return tuple(
            Series(
                name,
                y,
                drawn,
                {"diagnoser": name, **where},
                "low",
                "high",
                "points",
                (place - (count - 1) / 2) * 0.7 / count if beside else 0.0,
            )
            for place, (name, drawn) in enumerate(self.looks())
        )

    def lines(self, y: str, frame: pd.DataFrame, **where: str) -> tuple[Series, ...]:
        """A line with intervals for each diagnoser that a table has."""
        there = set(frame["diagnoser"])
        return tuple(
            Series(name, y, drawn, {"diagnoser": name, **where}, "low", "high")
            for name, drawn in self.looks()
            if name in there
        )

    def still(self, name: str, shows: str) -> Static | None:
        """A figure as it is printed; None where there was nothing to draw.

        Args:
            name: of the figure.
            shows: what, for those who do not see it.
        """
        picture = self.pictures.get(name)
        return None if picture is None else Static(picture.svg, picture.pdf, shows, name)
