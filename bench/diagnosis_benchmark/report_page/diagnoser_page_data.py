"""Data from which the HTML report of a comparison of diagnosers is rendered."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import pandas as pd

from bench.benchmark.problem.experiment import Experiment
from bench.diagnosis_benchmark.result_tables import PRIMARY_METRIC
from bench.figures.figure_output import FigureFiles
from bench.figures.style import MarkStyle, get_mark_style
from bench.pages.chart import PrintedFigure, Series


@dataclass(frozen=True)
class DiagnoserReportData:
    """Data of a comparison of diagnosers that its HTML report displays.

    Attributes:
        experiment: the experiment that was run.
        folder: result folder.
        order: names of the diagnosers, in the order of their colours.
        rows: one row per answer, only for cases that every diagnoser has answered.
        tables: tables by name, see `bench.diagnosis_benchmark.result_tables.build_all_tables`.
        training: training costs, one row per diagnoser and system.
        pictures: printed figures by name.
        skipped: diagnosers that could not be run, with the reason.
        planned: number of cases in the case set.
        left_out: rows of cases that a diagnoser does not support; they count in no table.
    """

    experiment: Experiment
    folder: str
    order: Sequence[str]
    rows: pd.DataFrame
    tables: Mapping[str, pd.DataFrame]
    training: Sequence[Mapping[str, str]]
    pictures: Mapping[str, FigureFiles]
    skipped: Mapping[str, str]
    planned: int
    left_out: pd.DataFrame

    @property
    def title(self) -> str:
        """Title of the experiment."""
        return self.experiment.title or self.experiment.name

    @property
    def counts(self) -> dict[str, int | str]:
        """Numbers of recordings behind the charts, for their captions."""
        table, power, calibration = (
            self.tables[name] for name in ("table", "power", "calibration")
        )
        sizes = power[power["metric"] == "named"].drop_duplicates("size")
        return {
            "clean_count": int(table.loc[table["metric"] == "false alarms", "of"].max()),
            "single_count": int(table.loc[table["metric"] == PRIMARY_METRIC, "of"].max()),
            "power_counts": ", ".join(
                f"{int(count)} of {size:g} noises"
                for size, count in sizes[["size", "of"]].to_numpy()
            ),
            "calibration_count": int(calibration["of"].max()) if len(calibration) else 0,
        }

    @property
    def case_count(self) -> int:
        """Number of cases that every diagnoser has answered."""
        return int(self.rows["question"].nunique())

    def get_line_styles(self) -> Iterator[tuple[str, MarkStyle]]:
        """Yield each diagnoser with its mark style (colour, dash and marker)."""
        return ((name, get_mark_style(place)) for place, name in enumerate(self.order))

    def make_interval_series(
        self, y: str, *, is_shifted: bool = False, **where: str
    ) -> tuple[Series, ...]:
        """Make one series of points with error bars for each diagnoser.

        Args:
            y: column with the value.
            is_shifted: whether the points of the diagnosers are shifted sideways, so that they do
                not overlap on a category axis.
            **where: values of further columns that select the rows of the series.
        """
        count = len(self.order)
        return tuple(
            Series(
                name,
                y,
                line_style,
                {"diagnoser": name, **where},
                "low",
                "high",
                "points",
                (place - (count - 1) / 2) * 0.7 / count if is_shifted else 0.0,
            )
            for place, (name, line_style) in enumerate(self.get_line_styles())
        )

    def make_line_series(self, y: str, frame: pd.DataFrame, **where: str) -> tuple[Series, ...]:
        """Make one line with error bars for each diagnoser that occurs in a table.

        Args:
            y: column with the value.
            frame: the table.
            **where: values of further columns that select the rows of the line.
        """
        names_in_table = set(frame["diagnoser"])
        return tuple(
            Series(name, y, line_style, {"diagnoser": name, **where}, "low", "high")
            for name, line_style in self.get_line_styles()
            if name in names_in_table
        )

    def make_static_figure(self, name: str, description: str) -> PrintedFigure | None:
        """Return the printed version of a figure, or None if the figure was not drawn.

        Args:
            name: name of the figure.
            description: text alternative for readers who cannot see the figure.
        """
        return PrintedFigure.from_files(self.pictures, name, description)
