"""Result of a comparison for users of Python: tables, figures and files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from bench.benchmark import comparison_charts, comparison_printed_figures
from bench.benchmark.problem.experiment_config import Experiment
from bench.benchmark.statistics.comparison_statistics import build_tables
from bench.benchmark.storage.csv_reader import CsvTable
from bench.benchmark.storage.reference_results import find_reference
from bench.benchmark.storage.result_folder import StoredComparison, read_comparison
from bench.benchmark.storage.table_schemas import (
    MISSPECIFICATION_RANK_COLUMNS,
    MISSPECIFICATION_TABLE_COLUMNS,
    RANK_AGREEMENT_COLUMNS,
    SHOT_COLUMNS,
    SHOT_STATUS_COLUMNS,
    SHOT_TABLE_COLUMNS,
)
from bench.diagnosis_benchmark import result_tables as diagnosis
from bench.misspecification.calibration_recording import MODEL_LABELS
from bench.studies import study_kinds
from sims.core.argument_checks import check_arguments
from sims.core.simulator import InputError

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

_SHOT_TABLE_COLUMNS = {
    "status": SHOT_STATUS_COLUMNS,
    "shots": SHOT_COLUMNS,
    "table": SHOT_TABLE_COLUMNS,
}
"""Columns of the tables of a bounce shot."""

_MISSPECIFICATION_TABLE_COLUMNS = {
    "table": MISSPECIFICATION_TABLE_COLUMNS,
    "ranks": MISSPECIFICATION_RANK_COLUMNS,
    "ranking": RANK_AGREEMENT_COLUMNS,
}
"""Columns of the tables of a study of a missing effect."""

_MAX_NOTEBOOK_ROWS = 200
"""Maximum number of table rows that a notebook shows."""


class ComparisonResult:
    """A comparison that has been run, read from its folder.

    Args:
        folder: Folder of a comparison of tuners or of diagnosers, a bounce shot or a study of a
            missing effect, finished or not.

    Attributes:
        folder: Folder with all results.
        experiment: The experiment that was run.

    Raises:
        InputError: The folder is not that of a comparison.
    """

    @check_arguments
    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.experiment: Experiment = study_kinds.open_study(self.folder).configuration.experiment

    @cached_property
    def _stored_comparison(self) -> StoredComparison:
        return read_comparison(self.folder)

    @cached_property
    def _axis_labels(self) -> comparison_charts.AxisLabels:
        """Labels of axes in figures: names and units of the parameters and channels."""
        return comparison_charts.make_axis_labels(self.experiment)

    def _read_csv_table(self, name: str) -> pd.DataFrame:
        """Read a table file of a bounce shot or of a study of two comparisons.

        Args:
            name: Name of the table without its suffix, such as "hits".
        """
        remedy = f"write it again with simgap plot {self.folder}"
        path = self.folder / f"{name}.csv"
        columns_by_table = (
            _SHOT_TABLE_COLUMNS if self.experiment.shot else _MISSPECIFICATION_TABLE_COLUMNS
        )
        table: pd.DataFrame = CsvTable(path, columns_by_table[name], remedy).table.to_pandas()
        return table

    @property
    def _in_files(self) -> bool:
        """True if tables and figures are only available as files in the folder."""
        experiment = self.experiment
        return bool(experiment.shot or experiment.calibration or experiment.diagnosis)

    @property
    def _study_kind(self) -> str:
        """Kind of the study in words, for messages."""
        if self.experiment.diagnosis:
            return "a comparison of diagnosers"
        return "a bounce shot" if self.experiment.shot else "a study of two comparisons"

    def _concatenate_comparisons(
        self, rows: Callable[[StoredComparison], pd.DataFrame]
    ) -> pd.DataFrame:
        """Concatenate the tables of a study of a missing effect, which consists of two comparisons.

        They use the simulator before and after its extension; the new first column ``model`` says
        which.

        Args:
            rows: Function that returns the table of one comparison.
        """
        import pandas as pd

        parts = []
        for model in MODEL_LABELS:
            part = rows(read_comparison(self.folder / model)).copy()
            part.insert(0, "model", model)
            parts.append(part)
        return pd.concat(parts, ignore_index=True)

    @cached_property
    def tables(self) -> dict[str, pd.DataFrame]:
        """Tables by name.

        A comparison of tuners has table, ert, ranking, pairs, break_even and who_wins; a bounce
        shot table and shots (docs/results-films.md); a study of a missing effect table, ranks and
        ranking (docs/misspecified.md); a comparison of diagnosers table, failures, items and others
        (docs/diagnosers.md).
        """
        if self.experiment.diagnosis:
            return {
                name: diagnosis.read_table(self.folder, name) for name in diagnosis.TABLE_COLUMNS
            }
        if self.experiment.shot:
            return {name: self._read_csv_table(name) for name in ("table", "shots")}
        if self.experiment.calibration:
            return {name: self._read_csv_table(name) for name in _MISSPECIFICATION_TABLE_COLUMNS}
        return build_tables(self._stored_comparison)

    @property
    def table(self) -> pd.DataFrame:
        """Error after N simulations by tuner, range and metric, in long form, as in table.csv.

        For diagnosers, each share with its interval.
        """
        return self.tables["table"]

    @property
    def runs(self) -> pd.DataFrame:
        """A row for each simulation, as in runs.parquet.

        A bounce shot has a row for each shot, a comparison of diagnosers one for each answer.
        """
        if self.experiment.diagnosis:
            return self.tables["items"]
        if self.experiment.calibration:
            return self._concatenate_comparisons(lambda stored: stored.runs)
        return self.tables["shots"] if self.experiment.shot else self._stored_comparison.runs

    @property
    def statuses(self) -> pd.DataFrame:
        """A row for each run or answer with its status and reason, as in status.csv."""
        if self.experiment.diagnosis:
            return self.tables["items"][list(diagnosis.STATUS_COLUMNS)]
        if self.experiment.calibration:
            return self._concatenate_comparisons(lambda stored: stored.statuses)
        return (
            self._read_csv_table("status")
            if self.experiment.shot
            else self._stored_comparison.statuses
        )

    @property
    def figures(self) -> list[str]:
        """Names of the available figures.

        The figures of a bounce shot, of a study of a missing effect and of diagnosers are files in
        the folder instead.
        """
        return (
            []
            if self._in_files
            else comparison_printed_figures.list_figure_names(self._stored_comparison)
        )

    def figure(self, name: str = "error", behind: str | Sequence[str] = ()) -> Figure:
        """Draw one of the figures; a notebook shows it inline.

        Args:
            name: Name of the figure.
            behind: Reference results, such as ``ball-drop``, or folders of comparisons, which are
                drawn in grey; at most two.

        Raises:
            InputError: There is no such figure, or a reference cannot be drawn in it.
        """
        if self._in_files:
            raise InputError(f"figures of {self._study_kind} are files: {self.folder / 'figures'}")
        names = [behind] if isinstance(behind, str) else behind
        references = [find_reference(reference) for reference in names]
        return comparison_printed_figures.draw_figure(
            self._stored_comparison, self._axis_labels, name, references=references
        )

    def summary(self) -> pd.DataFrame:
        """Return each tuner's last error of the first metric, with its verdict and failed runs.

        The tuners are in the order of their ranking. For diagnosers, the measures of each diagnoser
        are returned.
        """
        table = self.table
        if self.experiment.diagnosis:
            return diagnosis.build_leaderboard(table)
        if self._in_files:
            return table
        import pandas as pd

        # Rows after the whole budget, and among them those of the metric that the table has first.
        last_rows = table[table["simulations"] == table["simulations"].max()]
        rows = last_rows[last_rows["metric"] == last_rows["metric"].iloc[0]]
        # The verdict of the ranking after all simulations, in the order of these rows.
        ranking = self.tables["ranking"]
        last_ranking = ranking[ranking["simulations"] == ranking["simulations"].max()]
        verdicts = last_ranking.set_index(["range", "tuner"])["verdict"]
        ranges_and_tuners = pd.MultiIndex.from_frame(rows[["range", "tuner"]])
        rows = rows.assign(verdict=verdicts.reindex(ranges_and_tuners).to_numpy())
        columns = ["tuner", "range", "verdict", "metric", "median", "mean", "low", "high"]
        best: pd.DataFrame = rows[[*columns, "runs", "failures"]]
        return best.reset_index(drop=True)

    def __repr__(self) -> str:
        """Return one line: the experiment, the number of runs, how many failed, and the folder."""
        failed = int((~self.statuses["status"].isin(("done", "converged"))).sum())
        unit = "answers" if self.experiment.diagnosis else "runs"
        runs = f"{len(self.statuses)} {unit}, {failed} of them failed or skipped"
        return f"<comparison {self.experiment.name}: {runs}; {self.folder}>"

    def _repr_html_(self) -> str:
        """Return the summary as an HTML table, which a notebook shows for this object."""
        html: str = (
            self.summary()
            .head(_MAX_NOTEBOOK_ROWS)
            .to_html(index=False, float_format=lambda value: f"{value:.3g}")
        )
        return html
