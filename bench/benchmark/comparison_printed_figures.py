"""Printed figures of a comparison: charts of the page, spectra of targets, references in grey."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from bench.benchmark.comparison_charts import (
    CHARTS,
    AxisLabels,
    ComparisonView,
    list_directional_metrics,
    make_axis_labels,
)
from bench.benchmark.problem.experiment_config import Experiment
from bench.benchmark.problem.fisher_information import (
    SPECTRUM_COLUMNS,
    STIFF_SIGMA_THRESHOLD,
)
from bench.benchmark.statistics.comparison_statistics import (
    REQUIRED_RUN_COLUMNS,
    ComparisonStatistics,
)
from bench.benchmark.statistics.training_amortisation import TARGETS_PER_TRAINING
from bench.benchmark.storage.reference_results import ReferenceResult
from bench.benchmark.storage.result_folder import StoredComparison, read_comparison
from bench.benchmark.storage.table_schemas import ERROR_FLOOR
from bench.figures.figure_layout import add_caption, add_trust_note, make_panel_grid, style_axis
from bench.figures.figure_output import write_figure
from bench.figures.style import (
    BLUE,
    CAPTION_GREY,
    REFERENCE_GREYS,
    VERMILION,
    TunerStyles,
)
from bench.pages.chart import Panel, draw_chart, select_first_panels
from sims.core.simulator import Array, InputError, make_unknown_name_error

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D


FIGURE_FILES: Mapping[str, str] = {
    "error": "error-vs-simulations",
    "misfit": "misfit-vs-simulations",
    "distance": "error-vs-distance",
    "runtime": "runtime-distribution",
    "cost": "who-wins-at-which-cost",
    "amortisation": "amortisation",
    "spectra": "identifiability",
    "directions": "stiff-sloppy-prediction",
}
"""File name of every figure by its name, in the order in which they are written."""
OVERLAYABLE_FIGURES = ("error", "misfit", "directions")
"""Figures of errors against simulations, which can show references in grey."""
MEDIAN_LINE_CAPTION = (
    "Line: median over targets of the recommendation's error (mean over seeds). "
    "Band or bar: 95 % bootstrap interval of the median. "
    f"Errors below {ERROR_FLOOR:g} are drawn at {ERROR_FLOOR:g}."
)
_MAX_LEGEND_ROWS = 18
"""Maximum number of legend entries in letters of the normal size."""
_MIN_DRAWN_SIGMA = 1e-6
"""Standard deviation in training widths below which values are drawn at the edge."""
_MAX_DRAWN_SIGMA = 1e4
"""Standard deviation in training widths above which values are drawn at the edge."""
_MIN_LABELLED_SHARE = 0.05
"""Minimum share of a parameter in a direction that is written."""
_WHITE_TEXT_SHARE = 0.55
"""Share from which a cell is so dark that its number is white."""
_RANGE_LABELS = {
    "in": "true parameters in training range",
    "wide": "true parameters in bounds",
    "real": "recording, at nominal values",
}
_RANGE_MARKERS = (("o", BLUE), ("^", VERMILION))
"""Markers and colours of the ranges, in their order."""


class _Layout(NamedTuple):
    """Layout and texts of a printed figure.

    Attributes:
        caption: Caption, in which ``{level}`` and ``{thresholds}`` are replaced.
        size: Width and height of a panel in inches; None for the usual size.
        legend: Title of the legend.
        rows: Facet whose values are rows of panels; empty for one row.
        horizontal: Whether categories are from top to bottom.
    """

    caption: str = MEDIAN_LINE_CAPTION
    size: tuple[float, float] | None = None
    legend: str = "best over all targets first"
    rows: str = ""
    horizontal: bool = False


_LAYOUTS = {
    "error": _Layout(),
    "misfit": _Layout(),
    "distance": _Layout(f"{MEDIAN_LINE_CAPTION} n: number of targets."),
    "runtime": _Layout("{thresholds}"),
    "cost": _Layout(
        "To reach an error of {level:.2g} and stay below it: ERT × seconds of a simulation + "
        "seconds of "
        f"the tuner as measured; training shared by {TARGETS_PER_TRAINING} targets. "
        "The strip names the tuner that needs the least time."
    ),
    "amortisation": _Layout(
        "To reach an error of {level:.2g} and stay below it. A mark: from this number of targets "
        "on, the "
        "training and the expected simulations (ERT) of the trained tuner are fewer than those of "
        "the tuner that searches. At once: the search never reaches the error. Never: not within "
        "10 000 targets. Bar: 95 % bootstrap interval over targets.",
        (4.3, 3.0),
        "trained tuner",
        horizontal=True,
    ),
    "directions": _Layout(
        f"{MEDIAN_LINE_CAPTION} A sloppy direction is one that the target's data do not identify.",
        (4.0, 2.4),
        rows="error",
    ),
}


def list_figure_names(stored: StoredComparison) -> list[str]:
    """List the names of the figures for which a comparison has data; empty without a run.

    Returns:
        Keys of `FIGURE_FILES`, in its order.
    """
    experiment, runs = stored.experiment, stored.runs
    if runs.empty:
        return []
    has_wide_range = "wide" in experiment.ranges
    has_data = {
        "error": True,
        # Without a true system other than the simulator, the misfit is only the sensor noise.
        "misfit": bool(experiment.world),
        # `outside` is the distance of the true parameters from the training range.
        "distance": has_wide_range
        and bool(runs.loc[runs["range"] == "wide", "outside"].gt(0).any()),
        "runtime": True,
        "cost": True,
        # Some tuner was trained.
        "amortisation": any(simulations for simulations, _ in stored.costs.values()),
        "spectra": stored.spectra is not None,
        "directions": bool(list_directional_metrics(stored)),
    }
    return [name for name in FIGURE_FILES if has_data[name]]


def draw_figure(
    stored: StoredComparison,
    labels: AxisLabels,
    name: str,
    statistics: ComparisonStatistics | None = None,
    references: Sequence[ReferenceResult] = (),
) -> Figure:
    """Draw one figure of a comparison.

    Args:
        stored: The comparison, as read by `bench.benchmark.storage.result_folder.read_comparison`.
        labels: Axis labels, see `make_axis_labels`.
        name: One of `list_figure_names(stored)`.
        statistics: Result of `ComparisonStatistics(stored)`, to share it between several figures.
        references: Reference results that are drawn in grey, if the figure is one of
            `OVERLAYABLE_FIGURES`.

    Raises:
        InputError: The comparison has no figure of that name, or a reference cannot be drawn.
    """
    if name not in (figure_names := list_figure_names(stored)):
        raise make_unknown_name_error("figure", name, figure_names)
    if references:
        check_references_allowed(stored, name, references)
    # The figure of identifiability is the only one that is not a chart of the page.
    if name == "spectra":
        assert stored.spectra is not None
        figure = _draw_spectra_figure(stored.experiment, stored.spectra)
    else:
        view = ComparisonView(stored, labels, statistics or ComparisonStatistics(stored))
        figure = _draw_chart_figure(view, name, references)
    return add_trust_note(figure, stored.experiment.trusted)


def draw_with_references(
    folder: Path,
    references: Sequence[ReferenceResult],
    out: Path,
    print_line: Callable[[str], None],
    before: str = "",
) -> list[dict[str, Any]]:
    """Draw a comparison's figures again with references behind them, as separate files.

    A reference is a stored comparison of the same problem, whose medians are drawn in grey. Only
    the figures in `OVERLAYABLE_FIGURES` can show references.

    Args:
        folder: folder of the comparison.
        references: reference results to draw.
        out: folder in whose subfolder ``figures`` the files are written.
        print_line: callback that prints one line; it gets differences of the references, and files.
        before: prefix of the file names.

    Returns:
        JSON document of each reference, with its differences and the files.

    Raises:
        InputError: a reference belongs to another problem, or there are too many.
    """
    stored = read_comparison(folder, REQUIRED_RUN_COLUMNS)
    if stored.runs.empty:
        raise InputError(f"{folder}: contains no runs")
    check_references_allowed(stored, OVERLAYABLE_FIGURES[0], references)
    labels = make_axis_labels(stored.experiment)
    for reference in references:
        print_line(f"behind  {reference.provenance_text}")
        for line in reference.find_mismatches(stored.experiment):
            print_line(f"differs {line}")
    files = []
    for name in list_figure_names(stored):
        if name in OVERLAYABLE_FIGURES:
            figure = draw_figure(stored, labels, name, references=references)
            file_name = f"{before}{FIGURE_FILES[name]}-behind"
            paths = write_figure(figure, out / "figures" / file_name)
            files += paths
            print_line(f"figure  {paths[0]}")
    return [reference.to_document(stored.experiment, files) for reference in references]


def check_references_allowed(
    stored: StoredComparison, name: str, references: Sequence[ReferenceResult]
) -> None:
    """Reject references (stored comparisons) that cannot be drawn in grey in a figure.

    Args:
        stored: Comparison read from its result folder: configuration, runs and statuses.
        name: Name of the figure.
        references: Reference results.

    Raises:
        InputError: They are of another problem, there are too many, or the figure shows no errors
            against simulations.
    """
    if name not in OVERLAYABLE_FIGURES:
        raise InputError(
            f"figure {name}: expected one of {', '.join(OVERLAYABLE_FIGURES)} before a reference"
        )
    if len(references) > len(REFERENCE_GREYS):
        raise InputError(
            f"expected {len(REFERENCE_GREYS)} references at most, found {len(references)}"
        )
    for reference in references:
        # Differences of settings are allowed; another problem is an error, which this raises.
        reference.find_mismatches(stored.experiment)


def _draw_chart_figure(
    view: ComparisonView, name: str, references: Sequence[ReferenceResult]
) -> Figure:
    """Draw a printed figure of one of the charts of the report page.

    Args:
        view: comparison with its statistics, experiment and styles of tuners.
        name: name of the chart, a key of `CHARTS`.
        references: results of other comparisons, drawn in grey behind those of `view`.

    Returns:
        Figure with legend, title and caption.
    """
    chart, layout = CHARTS[name](view), _LAYOUTS[name]
    # A facet is a property of a panel that a reader of the page can choose, such as the range. A
    # printed figure shows all values of two facets, and the first value of any other.
    panels = select_first_panels(chart.panels, (chart.side_by_side, layout.rows))
    # With several rows, there is a column for each value of the facet that is side by side.
    columns = len({panel.facets[chart.side_by_side] for panel in panels}) if layout.rows else 0
    figure, axes = draw_chart(panels, chart.tables, columns, layout.size, layout.horizontal)
    # Each note of a tuner has its own line in the legend.
    notes = {name: note.replace("; ", "\n") for name, note in chart.notes.items()}
    style = TunerStyles(view.experiment, view.statistics.order, references, notes)
    for axis, panel in zip(axes, panels, strict=True):
        for reference in references:
            _draw_reference_lines(axis, panel, reference, style)
    caption = layout.caption.format(
        level=view.statistics.reference_level,
        thresholds=format_threshold_caption(view.statistics.runtime_thresholds),
    )
    _finish_figure(figure, axes, style, view.experiment, caption, layout.legend)
    return figure


def format_threshold_caption(thresholds: Array) -> str:
    """Return a caption that explains a runtime distribution over these thresholds."""
    span = f"from {thresholds[0]:.2g} to {thresholds[-1]:.2g} on a logarithmic scale"
    return (
        f"{len(thresholds)} thresholds {span}. "
        "Reached: the recommendation's error stays at or below it from there on. "
        "A failed run reaches none."
    )


def _draw_reference_lines(
    axis: Axes, panel: Panel, reference: ReferenceResult, style: TunerStyles
) -> None:
    """Draw each tuner's median of a reference, at the simulation counts of its table.

    Args:
        axis: axes to draw on.
        panel: panel that the axes show, with its range and metric.
        reference: results to draw.
        style: line style of each tuner.
    """
    # All series of a panel have the same range and metric.
    conditions = panel.series[0].where
    for tuner in reference.tuners:
        curve = reference.get_curve(
            tuner, conditions["range"], conditions["metric"], style.experiment.budget
        )
        if len(curve):
            medians = np.maximum(curve["median"].to_numpy(dtype=np.float64), ERROR_FLOOR)
            line_style = style.get_reference_style(reference, tuner)
            axis.plot(
                curve["simulations"], medians, gid=make_reference_id(reference, tuner), **line_style
            )


def _finish_figure(
    figure: Figure,
    axes: list[Axes],
    style: TunerStyles,
    experiment: Experiment,
    caption: str = MEDIAN_LINE_CAPTION,
    heading: str = "best over all targets first",
) -> None:
    """Add legend, title and caption to a figure; references are listed below the tuners.

    Args:
        figure: Figure of Matplotlib.
        axes: Its panels.
        style: Styles of the tuners.
        experiment: The experiment, which gives the title.
        caption: Caption below the figure.
        heading: Title of the legend.
    """
    # Matplotlib's handle of a legend entry, by the label of its tuner.
    handle_by_label: dict[str, Any] = {}
    # A panel may lack a tuner that another panel has; of several handles the first panel's is used.
    for axis in reversed(axes):
        handles, labels = axis.get_legend_handles_labels()
        handle_by_label |= dict(zip(labels, handles, strict=True))
    legend_entries = [
        (handle_by_label[label], "\n".join(filter(None, [label, style.notes.get(label)])))
        for label in style.order
        if label in handle_by_label
    ]
    for reference in style.references:
        legend_entries += _make_reference_entries(axes, style, reference)
        caption += _format_reference_caption(reference, style.experiment)
    # Size of the letters in points; a long legend has small letters.
    size = 9.0 if len(legend_entries) <= _MAX_LEGEND_ROWS else 7.0
    figure.legend(
        [handle for handle, _ in legend_entries],
        [label for _, label in legend_entries],
        loc="outside right upper",
        title=heading,
        fontsize=size,
        title_fontsize=min(size, 8),
        frameon=False,
        handlelength=3.2,
    )
    # A label that all panels share is written once, at the first panel.
    for axis in axes[1:]:
        if axis.get_ylabel() == axes[0].get_ylabel():
            axis.set_ylabel("")
    figure.suptitle(experiment.title or experiment.name, fontsize=11)
    add_caption(figure, caption, letters=17)


def _make_reference_entries(
    axes: list[Axes], style: TunerStyles, reference: ReferenceResult
) -> list[tuple[Line2D, str]]:
    """Make the legend entries of reference results: a heading, and each tuner that is drawn.

    An entry is the handle and its label. The lines of references are recognised by their ids
    (`make_reference_id`).

    Args:
        axes: all panels.
        style: line style of each tuner.
        reference: stored comparison that is drawn in grey.
    """
    from matplotlib.lines import Line2D

    line_ids = {line.get_gid() for axis in axes for line in axis.get_lines()}
    heading = f"thin, grey: {reference.name},\nsimgap {reference.simgap}"
    return [
        (Line2D([], [], linestyle="none"), heading),
        *(
            (Line2D([], [], **style.get_reference_style(reference, tuner)), tuner)
            for tuner in reference.tuners
            if make_reference_id(reference, tuner) in line_ids
        ),
    ]


def _format_reference_caption(reference: ReferenceResult, experiment: Experiment) -> str:
    mismatches = reference.find_mismatches(experiment)
    difference_text = f"; differs in {'; '.join(mismatches)}" if mismatches else ""
    return f" Grey: medians of the reference {reference.provenance_text}{difference_text}."


def make_reference_id(reference: ReferenceResult, tuner: str) -> str:
    """Return the identifier of a reference's line in a figure.

    Args:
        reference: stored comparison that is drawn in grey.
        tuner: label of the tuner.
    """
    return f"behind {reference.name} {tuner}"


def _draw_spectra_figure(experiment: Experiment, table: pd.DataFrame) -> Figure:
    """Draw the standard deviations along all directions, and the parameters in each direction.

    Left: 1 sigma of every direction, one marker per target. Right: share of each parameter in each
    direction.

    Args:
        experiment: Content of the experiment's TOML file: simulator, tuners, targets and budget.
        table: Rows of identifiability.csv.
    """
    names = [c for c in table.columns if c not in SPECTRUM_COLUMNS]
    # Width and height in inches, with the space for each parameter.
    size = (4.8 + 0.8 * len(names), 2.2 + 0.4 * len(names))
    figure, axes = make_panel_grid(1, 2, size, width_ratios=[1, 1.25])
    _draw_spectra(axes[0, 0], table, len(names))
    _draw_direction_shares(axes[0, 1], table, names)
    figure.suptitle(f"{experiment.title or experiment.name}: what the data identify", fontsize=11)
    is_real = set(table["range"]) == {"real"}
    evaluation_point = "the nominal parameters" if is_real else "each target's true parameters"
    caption = (
        f"From the Fisher information at {evaluation_point} (Cramér–Rao bound). "
        f"Stiff: 1 sigma below {STIFF_SIGMA_THRESHOLD:g} of the training width (dashed). "
        "Right: mean over targets of the squared component."
    )
    add_caption(figure, caption, letters=15)
    return figure


def _draw_spectra(axis: Axes, table: pd.DataFrame, directions: int) -> None:
    """Draw every target's smallest possible standard error (1 sigma) along each direction.

    A direction is a combination of parameters; stiff ones are determined by the data, sloppy ones
    are not. The ranges of targets are drawn side by side.

    Args:
        axis: axes to draw on.
        table: one row for each target and direction: number of the direction from 1, standard error
            in widths of the training range, and range of the target.
        directions: number of directions.
    """
    ranges = list(dict.fromkeys(table["range"]))
    for range_index, (kind, (marker, colour)) in enumerate(
        zip(ranges, _RANGE_MARKERS, strict=False)
    ):
        range_rows = table[table["range"] == kind]
        targets = range_rows["target"].nunique()
        # Position of the target among those of the range, from 0.
        target_indices = range_rows.groupby("direction").cumcount()
        target_offsets = (
            # Marks of the targets are spread over 0.3 of the distance of two directions.
            (target_indices / (targets - 1) - 0.5) * 0.3 if targets > 1 else 0.0 * target_indices
        )
        x_values = (
            # Ranges are 0.4 of the distance of two directions apart.
            range_rows["direction"] + target_offsets + (range_index - 0.5 * (len(ranges) - 1)) * 0.4
        )
        axis.plot(
            x_values,
            # A direction without effect on the data has an infinite sigma and is drawn at the edge.
            range_rows["sigma"].clip(_MIN_DRAWN_SIGMA, _MAX_DRAWN_SIGMA),
            marker,
            color=colour,
            markersize=3.5,
            alpha=0.75,
            linestyle="none",
            label=_RANGE_LABELS.get(kind, kind) + ("" if kind == "real" else f" (n = {targets})"),
        )
    axis.axhline(STIFF_SIGMA_THRESHOLD, color=CAPTION_GREY, linewidth=0.8, linestyle="--")
    for name, text_offset in (("sloppy", 3), ("stiff", -9)):
        axis.annotate(
            name,
            (0.01, STIFF_SIGMA_THRESHOLD),
            (0, text_offset),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            fontsize=8,
        )
    axis.set_yscale("log")
    # Extra space for the legend.
    axis.set_ylim(bottom=axis.get_ylim()[0] / 10)
    axis.set_xticks(range(1, directions + 1))
    axis.set_xlabel("direction, the stiffest first")
    axis.set_ylabel("smallest possible 1 sigma of an estimate\n[training widths]")
    style_axis(axis)
    axis.legend(fontsize=7.5, frameon=False, loc="lower right")


def _draw_direction_shares(axis: Axes, table: pd.DataFrame, names: list[str]) -> None:
    """Draw the shares of the parameters in each direction, as a grid of numbers.

    Directions are combinations of parameters that the data determine more or less well.

    Args:
        axis: axes to draw on.
        table: one row for each target and direction: column ``direction``, and the unit vector in
            the columns `names`.
        names: names of the parameters.
    """
    # A direction has length 1: its squared components are shares, independent of their signs.
    squares = table.set_index("direction")[names] ** 2
    # Means over the targets, one row per parameter and one column per direction.
    shares = squares.groupby(level=0).mean().to_numpy().T
    axis.imshow(shares, cmap="Greys", vmin=0.0, vmax=1.0, aspect="auto")
    for row, column in np.argwhere(shares >= _MIN_LABELLED_SHARE):
        share = float(shares[row, column])
        axis.text(
            column,
            row,
            # From 0.995 on, two digits would show 1.00.
            f"{share:.2f}".lstrip("0") if share < 0.995 else "1",
            ha="center",
            va="center",
            fontsize=8,
            color="white" if share > _WHITE_TEXT_SHARE else "black",
        )
    axis.set_xticks(range(len(names)), [str(i + 1) for i in range(len(names))])
    axis.set_yticks(range(len(names)), names, fontsize=8)
    axis.set_xlabel("direction")
    axis.set_title("share of each parameter", fontsize=9)
