"""Printed figures of one comparison by name, drawn from the charts of its page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bench.benchmark.figures.comparison_charts import CHARTS, list_directional_metrics
from bench.benchmark.figures.comparison_view import AxisLabels, ComparisonView
from bench.benchmark.figures.spectra_figure import draw_spectra_figure
from bench.benchmark.statistics.comparison_statistics import ComparisonStatistics
from bench.benchmark.statistics.error_floor import ERROR_FLOOR
from bench.benchmark.statistics.training_amortisation import TARGETS_PER_TRAINING
from bench.benchmark.storage.result_folder import StoredComparison
from bench.figures.style import (
    MEDIAN_LINE_CAPTION,
    REFERENCE_GREYS,
    TunerStyles,
    add_trust_note,
    finish_figure,
    make_reference_id,
)
from bench.pages.chart import Panel
from bench.pages.chart_figure import draw_chart, select_first_panels
from sims.core.simulator import Array, InputError, make_unknown_name_error

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from bench.benchmark.storage.reference_results import ReferenceResult

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
    """List the names of the figures that a comparison's data allow; empty without a run."""
    experiment, runs = stored.experiment, stored.runs
    if runs.empty:
        return []
    has_wide_range = "wide" in experiment.ranges
    has_data = {
        "error": True,
        # Without a true system other than the simulator, the misfit is only the sensor noise.
        "misfit": bool(experiment.world),
        "distance": has_wide_range
        and bool(runs.loc[runs["range"] == "wide", "outside"].gt(0).any()),
        "runtime": True,
        "cost": True,
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
    if name == "spectra":
        assert stored.spectra is not None
        figure = draw_spectra_figure(stored.experiment, stored.spectra)
    else:
        view = ComparisonView(stored, labels, statistics or ComparisonStatistics(stored))
        figure = _draw_chart_figure(view, name, references)
    return add_trust_note(figure, stored.experiment.trusted)


def check_references_allowed(
    stored: StoredComparison, name: str, references: Sequence[ReferenceResult]
) -> None:
    """Reject references that cannot be drawn in a figure.

    Args:
        stored: The comparison.
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
        reference.find_mismatches(stored.experiment)


def _draw_chart_figure(
    view: ComparisonView, name: str, references: Sequence[ReferenceResult]
) -> Figure:
    """Draw the figure called `name`, one of `CHARTS`, with the same panels as on the report page.

    `references` are the results of other comparisons; they are drawn in grey behind those of
    `view`.
    """
    chart, layout = CHARTS[name](view), _LAYOUTS[name]
    panels = select_first_panels(chart.panels, (chart.side_by_side, layout.rows))
    columns = len({panel.facets[chart.side_by_side] for panel in panels}) if layout.rows else 0
    figure, axes = draw_chart(panels, chart.tables, columns, layout.size, layout.horizontal)
    notes = {name: note.replace("; ", "\n") for name, note in chart.notes.items()}
    style = TunerStyles(view.experiment, view.statistics.order, references, notes)
    for axis, panel in zip(axes, panels, strict=True):
        for reference in references:
            _draw_reference_lines(axis, panel, reference, style)
    caption = layout.caption.format(
        level=view.statistics.reference_level,
        thresholds=format_threshold_caption(view.statistics.runtime_thresholds),
    )
    finish_figure(figure, axes, style, view.experiment, caption, layout.legend)
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
    """Draw each tuner's median of a reference, at the simulation counts of its table."""
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
