"""Charts and printed figures of a comparison of diagnosers, and the data that its report shows.

The charts are drawn by the page and, with a caption, printed; outcomes and confusion matrices are
printed only. Printed figures are readable in greyscale.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from bench.benchmark.problem.experiment_config import Experiment
from bench.diagnosis_benchmark.result_tables import (
    P_VALUE_LEVELS,
    PRIMARY_METRIC,
    SET_SIZE_BINS,
    TARGET_FALSE_ALARM_RATE,
    is_correct,
    select_graded_answers,
    select_single_effects,
)
from bench.figures import figure_layout, style
from bench.figures.figure_layout import add_trust_note, finish_chart
from bench.figures.figure_output import FigureFiles, render_all_formats
from bench.figures.style import GREY, MarkStyle, get_mark_style, make_mark_style
from bench.pages.chart import Axis, Panel, ReferenceLine, Series, draw_chart, make_method_series

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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
        """Numbers of recordings behind the charts, for their captions.

        Returns:
            * ``clean_count``: recordings without a hidden cause,
            * ``single_count``: recordings with one effect that is large enough to be graded,
            * ``power_counts``: a text, as "40 of 1 noises, 40 of 3 noises": number of recordings
              with a hidden effect of each size,
            * ``calibration_count``: clean recordings with a p-value, of the diagnoser with most.
        """
        table, power, calibration = (
            self.tables[name] for name in ("table", "power", "calibration")
        )
        # The column "of" has the number of recordings of a share; all diagnosers have the same.
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

    @property
    def styles(self) -> dict[str, MarkStyle]:
        """Style (colour, dash and marker) of each diagnoser, in their order."""
        return {name: get_mark_style(place) for place, name in enumerate(self.order)}

    def make_interval_series(self, is_shifted: bool = False) -> tuple[Series, ...]:
        """Make a series of points with error bars for each diagnoser.

        A point is a share, read from the column ``share`` of the chart's table; its error bar is
        the 95 % interval from column ``low`` to column ``high``.

        Args:
            is_shifted: whether the points lie side by side on a category axis.
        """
        options: dict[str, Any] = {"low": "low", "high": "high", "draw": "points"}
        styles = self.styles
        return make_method_series(styles, "diagnoser", "share", is_shifted=is_shifted, **options)

    def make_line_series(self, frame: pd.DataFrame, **where: str) -> tuple[Series, ...]:
        """Make one line with error bars for each diagnoser that occurs in a table.

        A line has the column ``share``; its error bars go from ``low`` to ``high``.

        Args:
            frame: the table.
            **where: values of further columns that select the rows of the line.
        """
        names = set(frame["diagnoser"])
        styles = {name: look for name, look in self.styles.items() if name in names}
        return make_method_series(styles, "diagnoser", "share", where=where, low="low", high="high")


_SHARE_METRICS = {
    "false alarms": "alarms",
    "named, alone": "alone",
    PRIMARY_METRIC: "set of 2",
    "something seen": "detected",
    "pairs: both named": "pairs",
    "foreign causes: unknown or partial": "outside",
    "95 % intervals that hold": "intervals",
}
"""Metrics of the chart of shares, each with its label on the axis."""
_SHARE_LIMITS = (-0.03, 1.03)
_SHARE_AXIS = Axis("share", scales=("linear",), ends=_SHARE_LIMITS)


def build_chart_tables(data: DiagnoserReportData) -> dict[str, pd.DataFrame]:
    """Build the tables of the charts that are not tables of the comparison.

    A chart of the page reads a table with one column per coordinate. Category axes need a column
    ``place`` with the number of the category.

    Args:
        data: graded answers and result tables of all diagnosers.

    Returns:
        Tables by name; those without data are empty.

        * ``board``: share of named single causes with the false alarms, both in per cent.
        * ``shares``: shares of all metrics, with the category of each metric.
        * ``calibration``: share of clean recordings by the level of the p-value; the rows of
          diagnoser "" are the ideal line, on which the share equals the level.
        * ``sets``: answers by the size of their largest set, with the category of each size.
        * ``cost``: share of named single causes with the costs of an answer.
    """
    table = data.tables["table"]
    alarms = table[table["metric"] == "false alarms"].set_index("diagnoser")["share"]
    named_rows = table[(table["metric"] == PRIMARY_METRIC) & (table["of"] > 0)]
    leaderboard = named_rows.assign(alarms=100 * named_rows["diagnoser"].map(alarms))
    leaderboard[["share", "low", "high"]] *= 100
    metric_position = {metric: position for position, metric in enumerate(_list_shares(data))}
    shares = table[table["metric"].isin(metric_position)]
    levels = pd.DataFrame({"diagnoser": "", "level": P_VALUE_LEVELS, "share": P_VALUE_LEVELS})
    calibration, sets = data.tables["calibration"], data.tables["sets"]
    sizes = {label: position for position, label in enumerate(SET_SIZE_BINS)}
    return {
        "board": leaderboard.dropna(subset="alarms"),
        "shares": shares.assign(place=shares["metric"].map(metric_position)),
        "calibration": pd.concat([calibration, levels], ignore_index=True)
        if len(calibration)
        else calibration,
        "sets": sets.assign(place=sets["largest_set"].map(sizes)),
        "cost": named_rows.merge(data.tables["costs"], on="diagnoser"),
    }


def _list_shares(data: DiagnoserReportData) -> list[str]:
    """List the metrics of the chart of shares that have answers."""
    table = data.tables["table"]
    return [name for name in _SHARE_METRICS if table.loc[table["metric"] == name, "of"].any()]


def make_charts(data: DiagnoserReportData) -> dict[str, list[Panel]]:
    """Make the panels of every chart by name; a chart without data has none.

    The chart ``board`` is the leaderboard: named causes against false alarms.

    Args:
        data: graded answers and result tables of all diagnosers.
    """
    tables = build_chart_tables(data)
    return {
        "board": _make_board(data) if len(tables["board"]) else [],
        "shares": _make_shares(data, tables["shares"]) if len(tables["shares"]) else [],
        "power": _make_power(data) if len(data.tables["power"]) else [],
        "calibration": _make_calibration(data) if len(tables["calibration"]) else [],
        "sets": _make_sets(data) if tables["sets"]["of"].any() else [],
        "cost": _make_cost(data) if len(tables["cost"]) else [],
    }


def _make_board(data: DiagnoserReportData) -> list[Panel]:
    """Make the leaderboard chart: share of named single causes against share of false alarms.

    A line marks the largest acceptable share of false alarms.

    Args:
        data: graded answers and result tables of all diagnosers.
    """
    x_axis = Axis(
        "false alarms if nothing is hidden [%]",
        "symlog",
        ("symlog", "linear"),
        (0.0, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0),
        ends=(-0.15, 110.0),
    )
    # A margin of 3 %, so that marks at 0 and 100 % are visible.
    y_axis = Axis("single causes named [%]", scales=("linear",), ends=(-3.0, 103.0))
    series, percent = data.make_interval_series(), 100 * TARGET_FALSE_ALARM_RATE
    rules = (ReferenceLine(percent, f"{percent:g} %", "x"),)
    return [Panel("", "board", "alarms", series, x_axis, y_axis, rules=rules)]


def _make_shares(data: DiagnoserReportData, table: pd.DataFrame) -> list[Panel]:
    """Make the chart of the fractions in table.csv that have answers, one category per metric.

    Args:
        data: graded answers and result tables of all diagnosers.
        table: rows of table.csv of these metrics.
    """
    counts = table.groupby("metric")["of"].max()
    names = tuple(f"{_SHARE_METRICS[name]}\nn={int(counts[name])}" for name in _list_shares(data))
    x_axis = Axis("what is counted; at most n answers or intervals", names=names)
    series = data.make_interval_series(is_shifted=True)
    return [Panel("", "shares", "place", series, x_axis, _SHARE_AXIS)]


def _make_power(data: DiagnoserReportData) -> list[Panel]:
    """Make the chart of the shares named and detected against the size of the hidden effect.

    Args:
        data: Results of all diagnosers; sizes are in units of the noise.
    """
    table = data.tables["power"]
    sizes = tuple(sorted(float(size) for size in table["size"].unique()))
    x_axis = Axis("size of the hidden effect [noises]", "log", ticks=sizes)
    panels = []
    for metric, title in (("named", "Named, in a set of at most two"), ("seen", "Detected")):
        lines = data.make_line_series(table, metric=metric)
        panels.append(Panel(title, "power", "size", lines, x_axis, _SHARE_AXIS, {"what": title}))
    return panels


def _make_calibration(data: DiagnoserReportData) -> list[Panel]:
    """Make the chart of the fraction of clean recordings with a p-value of at most each level.

    For a calibrated p-value the fraction equals the level; a grey line shows this ideal.

    Args:
        data: graded answers and result tables of all diagnosers.
    """
    ideal_series = Series(
        "calibrated p-value", "share", make_mark_style(GREY, (4.0, 3.0)), {"diagnoser": ""}
    )
    lines = data.make_line_series(data.tables["calibration"])
    x_axis = Axis("level", "log", ticks=P_VALUE_LEVELS)
    y_axis = Axis(
        "share of clean recordings with p below the level", scales=("linear",), ends=_SHARE_LIMITS
    )
    return [Panel("", "calibration", "level", (*lines, ideal_series), x_axis, y_axis)]


def _make_sets(data: DiagnoserReportData) -> list[Panel]:
    """Make the chart of answers, and of correct ones, by the size of their largest set.

    A set contains the effects that an answer cannot distinguish.

    Args:
        data: graded answers and result tables of all diagnosers.
    """
    x_axis = Axis("effects in the largest set of an answer", names=tuple(SET_SIZE_BINS))
    correct = data.make_interval_series(is_shifted=True)
    counts = tuple(replace(series, y="of", low="", high="") for series in correct)
    share_axis = Axis("share of sets with the true cause", scales=("linear",), ends=_SHARE_LIMITS)
    count_axis = Axis("answers of this size", scales=("linear",), holds=(0.0,))
    return [
        Panel("Correct", "sets", "place", correct, x_axis, share_axis, {"what": "correct"}),
        Panel("Number", "sets", "place", counts, x_axis, count_axis, {"what": "number"}),
    ]


def _make_cost(data: DiagnoserReportData) -> list[Panel]:
    """Make the chart of named single causes against the cost of an answer: one panel per cost.

    Args:
        data: graded answers and result tables of all diagnosers.
    """
    y_axis = Axis("share of single causes named", scales=("linear",), ends=_SHARE_LIMITS)
    labels = {
        "simulations_median": "simulations for an answer, median",
        "processor_seconds_median": "processor time for an answer [s], median",
    }
    series = data.make_interval_series()
    return [
        Panel("", "cost", column, series, Axis(label, "log"), y_axis, {"cost": label})
        for column, label in labels.items()
    ]


OUTCOME_STYLES = (
    ("right", style.BLACK, "named, alone"),
    ("set", style.BLUE, "in a set"),
    ("class", style.SKY_BLUE, "an equivalent one"),
    ("extra", style.ORANGE, "named, with another one"),
    ("wrong", style.VERMILION, "something else named"),
    ("unnamed", style.NOISE_BAND_GREY, "detected, not named"),
    ("missed", style.RECORDED_PART_GREY, "not detected"),
    ("undecided", style.RECORDED_PART_GREY, "unidentifiable"),
    ("failed", style.PURPLE, "no answer"),
)
"""Outcomes of single effects, the best first, with colour and legend text."""
_CHART_CAPTIONS = {
    "board": (
        "{clean_count} recordings with nothing hidden, {single_count} with one effect of at least "
        "one noise. Named: alone or in a set of at most two, equivalent effects being one. Bars: "
        "95 % intervals (Wilson). Dashes: 1 % of false alarms."
    ),
    "cost": "Marks: medians; bars: 95 % intervals (Wilson).",
    "power": (
        "Recordings with one hidden effect: {power_counts}. Bands: 95 % intervals (Wilson). "
        "Compare with the false alarms: a diagnoser that always alarms detects everything."
    ),
    "calibration": (
        "Up to {calibration_count} recordings with nothing hidden. Dashes: calibrated p-values. "
        "Below: conservative; above: too many alarms. Bands: 95 % intervals (Clopper-Pearson)."
    ),
}
"""Captions of the charts of the page that are also printed, by name."""
_SINGLE_PANEL_SIZE = (6.0, 4.0)
"""Width and height of the panel of a figure with one panel, in inches."""


def draw_chart_figures(data: DiagnoserReportData) -> dict[str, Figure]:
    """Draw the charts of the page that have data and a caption, by name.

    Args:
        data: the data of the report; its printed figures are not used.
    """
    tables = {**data.tables, **build_chart_tables(data)}
    charts, figures = make_charts(data), {}
    for name, caption in _CHART_CAPTIONS.items():
        if charts[name]:
            size = _SINGLE_PANEL_SIZE if len(charts[name]) == 1 else None
            figure, axes = draw_chart(charts[name], tables, size=size)
            text = caption.format(**data.counts)
            figures[name] = finish_chart(figure, axes[0], data.title, text, "outside right upper")
    return figures


def draw_outcomes(rows: pd.DataFrame, order: Sequence[str], title: str) -> Figure:
    """Draw the outcomes of all recordings with one hidden effect, as stacked bars.

    Each diagnoser has a bar whose parts are the outcomes, such as right, ambiguous, wrong or
    missed, in per cent of the recordings.

    Args:
        rows: one row per answer on a single effect.
        order: names of the diagnosers.
        title: title of the figure.
    """
    # Width and height in inches, with the space for each diagnoser.
    figure, axes = figure_layout.make_panel_grid(1, 1, (8.6, 0.5 * len(order) + 2.2))
    axis: Axes = axes[0][0]
    styles = {outcome: (colour, label) for outcome, colour, label in OUTCOME_STYLES}
    counts = pd.crosstab(rows["diagnoser"], rows["outcome"]).reindex(
        index=list(order), columns=list(styles), fill_value=0
    )
    # Each diagnoser has answered all recordings, so the sums are equal; at least 1 for a division.
    total = max(int(counts.sum(axis=1).max()), 1)
    bar_starts = np.zeros(len(order))
    for outcome in counts.columns[counts.any()]:
        colour, label = styles[outcome]
        widths = 100.0 * counts[outcome].to_numpy() / total
        bars = axis.barh(
            list(order),
            widths,
            left=bar_starts,
            color=colour,
            edgecolor=style.NEUTRAL_MARK,
            linewidth=0.5,
            label=label,
        )
        is_dark = colour in (style.BLACK, style.BLUE, style.VERMILION)
        axis.bar_label(
            bars,
            # A narrower part has no room for its number.
            [str(n) if width > 4 else "" for n, width in zip(counts[outcome], widths, strict=True)],
            label_type="center",
            fontsize=8,
            color="white" if is_dark else style.NEUTRAL_MARK,
        )
        bar_starts += widths
    axis.invert_yaxis()
    axis.set_xlim(0, 100)
    axis.set_xlabel("recordings with one hidden effect of at least one noise [%]")
    figure_layout.style_axis(axis)
    axis.grid(visible=False)
    axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=8.5)
    figure.suptitle(title, fontsize=11)
    figure_layout.add_caption(
        figure, f"{total} recordings; numbers in bars count them.", letters=16
    )
    return figure


_FAMILY_LABELS = ("several", "unknown", "nothing", "no answer")
"""Answers that are not the name of a family; `nothing` means that the simulation is adequate."""
_PANELS_PER_ROW = 4
"""Maximum number of panels in a row."""
_MIN_LABELLED_PERCENT = 10.0
"""Minimum percentage of its row for which a cell shows its number."""


def draw_confusion_matrices(rows: pd.DataFrame, order: Sequence[str], title: str) -> Figure:
    """Draw one confusion matrix of cause families for each diagnoser.

    A family is the part of an effect's name before the dot, as ``friction``. Rows are the families
    of the hidden causes, columns those of the answers, in per cent of a row. Cases with two hidden
    causes are left out.

    Args:
        rows: one row per answer.
        order: names of the diagnosers.
        title: title of the figure.
    """
    graded_rows = select_graded_answers(rows[rows["kind"] != "double"])
    graded_rows = graded_rows.assign(
        family=_list_hidden_families(graded_rows), answer=_list_answer_families(graded_rows)
    )
    # Clean and foreign cases are the last rows. The columns begin in the order of the rows, so
    # that correct answers are on the diagonal.
    hidden = sorted(set(graded_rows["family"]), key=lambda name: (name in _LAST_ROW_LABELS, name))
    answer_labels = [name for name in hidden if name not in _LAST_ROW_LABELS]
    answer_labels += sorted(set(graded_rows["answer"]) - {*answer_labels, *_FAMILY_LABELS})
    answer_labels += [name for name in _FAMILY_LABELS if (graded_rows["answer"] == name).any()]
    column_count = min(_PANELS_PER_ROW, len(order))
    row_count = -(-len(order) // column_count)  # rounded up
    size = (
        # Width and height in inches, with the space for each label.
        1.6 + column_count * max(2.2, 0.16 * len(answer_labels)),
        1.4 + row_count * max(1.4, 0.17 * len(hidden)),
    )
    figure, axes = figure_layout.make_panel_grid(
        row_count, column_count, size, sharex=True, sharey=True
    )
    for panel_index, axis in enumerate(axes.flat):
        if panel_index >= len(order):  # the last row of panels is not full
            axis.set_axis_off()
            continue
        diagnoser_rows = graded_rows[graded_rows["diagnoser"] == order[panel_index]]
        counts = pd.crosstab(diagnoser_rows["family"], diagnoser_rows["answer"]).reindex(
            index=hidden, columns=answer_labels, fill_value=0
        )
        _draw_confusion_matrix(axis, counts, order[panel_index])
    figure.suptitle(title, fontsize=11)
    figure.supylabel("hidden", fontsize=9)
    cases = graded_rows.drop_duplicates("question")
    figure_layout.add_caption(
        figure,
        f"{len(cases)} recordings with nothing hidden, one effect of at least one noise or a "
        "foreign cause. Per cent of a row. Black frames: right. A cause that is found alone or in "
        "a set of at most two counts as its family, otherwise the first named cause counts.",
        letters=16,
    )
    return figure


_LAST_ROW_LABELS = ("(foreign)", "(clean)")
"""Row labels that follow below those of the effect families."""
_CORRECT_ANSWERS = {"(clean)": ("nothing",), "(foreign)": ("unknown",)}
"""Correct answers for the rows of clean recordings and unmodelled causes."""


def _list_hidden_families(rows: pd.DataFrame) -> pd.Series[str]:
    """Return the row of the confusion matrix of each answer: the family of the hidden effect.

    The family is the part of the name before the dot. Clean recordings and unmodelled causes have
    the rows ``(clean)`` and ``(foreign)``.
    """
    family = rows["hidden"].astype(str).str.partition(".")[0]
    return family.where(rows["kind"] == "single", "(" + rows["kind"] + ")")


def _list_answer_families(rows: pd.DataFrame) -> list[str]:
    """Return the column of the confusion matrix of each answer.

    It is the family that the answer names, or one of `_FAMILY_LABELS`.

    Args:
        rows: one row per answer.
    """
    correct = is_correct(rows)
    return [
        _get_answer_family(row, is_right)
        for row, is_right in zip(rows.to_dict("records"), correct, strict=True)
    ]


def _get_answer_family(row: dict[Any, Any], is_right: bool) -> str:
    """Return the family that an answer names, or the label of an answer without a family.

    The family is the part of an effect's name before the dot, as ``friction``. An answer that is
    correct because its small set contains the cause counts as the hidden family, otherwise the
    leading name counts.

    Args:
        row: row of the answer; its ``named`` has the causes separated by " + ", and the
            alternatives of a cause separated by bars.
        is_right: whether the answer is correct.
    """
    if row["status"] != "done":
        return "no answer"
    if row["verdict"] == "adequate":
        return "nothing"
    if is_right and row["kind"] == "single":
        return str(row["hidden"]).partition(".")[0]
    if row["verdict"] in ("unknown", "unidentifiable") or (is_right and row["kind"] == "foreign"):
        return "unknown"
    named_effects = str(row["named"] or "")
    if not named_effects:
        return "unknown"
    if " + " in named_effects:
        return "several"
    leading_name = named_effects.partition("|")[0]
    return leading_name.partition(".")[0]


def _draw_confusion_matrix(axis: Axes, counts: pd.DataFrame, name: str) -> None:
    """Draw the confusion matrix of one diagnoser in per cent; frames mark correct answers.

    Args:
        axis: axes to draw on.
        counts: number of answers, hidden families in rows and named families in columns.
        name: name of the diagnoser.
    """
    from matplotlib.patches import Rectangle

    totals = counts.sum(axis=1).to_numpy()
    shares = 100.0 * counts.to_numpy() / np.maximum(totals, 1)[:, None]
    axis.imshow(shares, cmap="Greys", vmin=0, vmax=100, aspect="auto")
    answer_labels = list(counts.columns)
    for row, family in enumerate(counts.index):
        for right_answer in _CORRECT_ANSWERS.get(family, (family,)):
            if right_answer in answer_labels:
                corner = answer_labels.index(right_answer) - 0.5, row - 0.5
                axis.add_patch(
                    Rectangle(corner, 1, 1, fill=False, edgecolor=style.NEUTRAL_MARK, linewidth=1.0)
                )
        for column, share in enumerate(shares[row]):
            if share >= _MIN_LABELLED_PERCENT:
                # White text on dark cells.
                ink = "white" if share > 55 else style.NEUTRAL_MARK
                axis.text(
                    column, row, f"{share:.0f}", ha="center", va="center", fontsize=5.5, color=ink
                )
    axis.set_title(name, fontsize=9)
    axis.set_xticks(range(len(answer_labels)), answer_labels, rotation=90, fontsize=6.5)
    labels = [f"{family} {n}" for family, n in zip(counts.index, totals, strict=True)]
    axis.set_yticks(range(len(labels)), labels, fontsize=6.5)
    axis.spines[:].set_visible(False)
    axis.tick_params(length=0)


def draw_figures(data: DiagnoserReportData) -> dict[str, FigureFiles]:
    """Draw every figure for which there is data.

    Outcomes and confusion need clean cases and cases with one effect.

    Args:
        data: the data of the report; its printed figures are not used.

    Returns:
        Figures by name.
    """
    figures = draw_chart_figures(data)
    if data.counts["clean_count"] and data.counts["single_count"]:
        singles = select_single_effects(data.rows)
        figures["outcomes"] = draw_outcomes(singles, data.order, data.title)
        figures["confusion"] = draw_confusion_matrices(data.rows, data.order, data.title)
    return {
        name: render_all_formats(add_trust_note(figure, data.experiment.trusted))
        for name, figure in figures.items()
    }
