"""Style of all figures: palette, markers, canvas, panels, legend, caption.

The style is made for print: every tuner has its own marker and line style in addition to its
colour, and colours differ in lightness. No figure is made by pyplot, so that a notebook's backend,
settings and open figures are unchanged.
"""

from __future__ import annotations

import textwrap
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

from bench.benchmark.storage.table_schemas import ERROR_FLOOR

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    from bench.benchmark.problem.experiment import Experiment
    from bench.benchmark.storage.reference_results import ReferenceResult


# Palette of eight colours safe for colour-blind readers: M. Okabe, K. Ito, Color Universal Design,
# 2002.
BLACK = "#000000"
ORANGE = "#E69F00"
BLUE = "#0072B2"
SKY_BLUE = "#56B4E9"
VERMILION = "#D55E00"
GREEN = "#009E73"
PURPLE = "#CC79A7"

# Further colours if eight are not enough; they differ from the others in lightness.
GREY = "#7F7F7F"
VIOLET = "#5B3A8E"
BROWN = "#A6761D"
RUST = "#A03C00"
PALE_BLUE = "#DCEBF5"
"""Background where a drive moves forwards."""
PALE_RUST = "#FBE6DA"
"""Background where a drive moves backwards."""

# Greys by their use, from dark to light.
NEUTRAL_MARK = "#333333"
"""Colour of marks that belong to no tuner."""
CAPTION_GREY = "#444444"
"""Colour of captions, and of lines at a threshold."""
ZERO_LINE_GREY = "#555555"
"""Colour of the zero line of a residual."""
RUN_SEPARATOR_GREY = "#888888"
"""Colour of lines between runs."""
CONNECTOR_GREY = "#999999"
"""Colour of lines that join related marks."""
NULL_LEVEL_GREY = "#A8A8A8"
"""Colour of bars over the range expected under the null hypothesis."""
INCLINE_GREY = "#BBBBBB"
"""Colour of the incline of a bounce shot."""
NOISE_BAND_GREY = "#CFCFCF"
"""Colour of bands of noise, and of parts that are not needed."""
REFERENCE_GREYS = ("#9C9C9C", "#C2C2C2")
"""Colours of the first and the second reference result behind the user's own."""
HELD_OUT_GREY = "#E4E4E4"
"""Background of held-out runs."""
RECORDED_PART_GREY = "#EEEEEE"
"""Background of the recorded part of a film, and of errors that count as equal."""

# Dark and light colours alternate, so that neighbours differ in greyscale, too.
BASE_MODEL_LINE: Mapping[str, Any] = {
    "color": VERMILION,
    "linestyle": (0, (5, 2)),
    "linewidth": 1.3,
}
"""Line style of the fitted base model: dashed, so that it is recognised without colour."""
EXTENDED_MODEL_LINE: Mapping[str, Any] = {"color": BLUE, "linestyle": "-", "linewidth": 1.5}
"""Line style of the extended model."""
BASE_MODEL_MARKER: Mapping[str, Any] = {
    "marker": "s",
    "markersize": 6,
    "markerfacecolor": "white",
    "color": VERMILION,
}
"""Marker style of the fitted base model: open squares, recognised without colour."""
EXTENDED_MODEL_MARKER: Mapping[str, Any] = {"marker": "o", "markersize": 5.5, "color": BLUE}
"""Marker style of the extended model."""
_COLOURS = (BLACK, ORANGE, BLUE, SKY_BLUE, VERMILION, GREEN, PURPLE, GREY, VIOLET, BROWN)

_DARK = {
    BLACK: "#FFFFFF",
    ORANGE: "#F2B632",
    BLUE: "#4D94FF",
    SKY_BLUE: "#7CC8F5",
    VERMILION: "#FF7A3D",
    GREEN: "#2CC79A",
    PURPLE: "#E39CC6",
    GREY: "#9C9C9C",
    VIOLET: "#B08CF0",
    BROWN: "#C4934A",
}
"""Colours for a dark page by colour for a light page, each with a contrast of at least 3 to 1."""

_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "<", ">")

# Eight line styles against ten colours: the pairs repeat only after forty tuners.
_LINES = (
    "-",
    "--",
    "-.",
    (0, (1, 1)),
    (0, (5, 1)),
    (0, (3, 1, 1, 1)),
    (0, (6, 1, 1, 1, 1, 1)),
    (0, (8, 2)),
)

_DASHES: dict[Any, tuple[float, ...]] = {"-": (), "--": (3.7, 1.6), "-.": (6.4, 1.6, 1.0, 1.6)}
"""Dashes of Matplotlib's named line styles, in line widths."""


def get_colour(place: int) -> str:
    """Return the colour of the tuner or diagnoser at this index."""
    return _COLOURS[place % len(_COLOURS)]


def get_marker(place: int) -> str:
    """Return the marker of the tuner or diagnoser at this index.

    Each round of the colours has other markers.
    """
    rounds = place // len(_COLOURS)
    return _MARKERS[(place + 3 * rounds) % len(_MARKERS)]


MEDIAN_LINE_CAPTION = (
    "Line: median over targets of the recommendation's error (mean over seeds). "
    "Band or bar: 95 % bootstrap interval of the median. "
    f"Errors below {ERROR_FLOOR:g} are drawn at {ERROR_FLOOR:g}."
)

PANEL_TITLES = {
    "in": "Targets in the training range",
    "wide": "Targets anywhere in the bounds",
    "real": "Recording",
    "obs_error": "Runs tuned on",
    "heldout_error": "Held-out runs, open loop",
}
"""Panel titles: ranges of targets, or kinds of runs of a recording."""


class MarkStyle(NamedTuple):
    """Style of a name's marks on a page.

    Attributes:
        colour: Colour on a light background.
        dark: Colour on a dark background.
        dashes: Lengths of dashes and gaps in turn, in line widths; empty for a solid line.
        marker: Matplotlib's letter of the marker; empty for none.
    """

    colour: str
    dark: str
    dashes: tuple[float, ...] = ()
    marker: str = ""


def get_mark_style(place: int) -> MarkStyle:
    """Return the style at an index of a list; neighbours differ in greyscale, too."""
    colour, line = _COLOURS[place % len(_COLOURS)], _LINES[place % len(_LINES)]
    dashes = _DASHES[line] if isinstance(line, str) else tuple(map(float, line[1]))
    return MarkStyle(colour, _DARK[colour], dashes, get_marker(place))


def make_mark_style(colour: str, dashes: tuple[float, ...] = (), marker: str = "") -> MarkStyle:
    """Return the style for a colour of the palette.

    Args:
        colour: A colour of the palette that has a dark variant.
        dashes: As in `MarkStyle`.
        marker: As in `MarkStyle`.
    """
    return MarkStyle(colour, _DARK[colour], dashes, marker)


class TunerStyles:
    """Colour, marker and line of each tuner, fixed by its index in the experiment.

    Args:
        experiment: The experiment.
        order: Tuners that have runs, in the order of the legend: best first.
        references: Reference results drawn behind the curves; at most as many as `REFERENCE_GREYS`
            has colours.
        notes: Text of the legend below a tuner's name.
    """

    def __init__(
        self,
        experiment: Experiment,
        order: Sequence[str],
        references: Sequence[ReferenceResult] = (),
        notes: Mapping[str, str] | None = None,
    ) -> None:
        """Map each tuner with runs to its index in the experiment, which sets colour and marker.

        Args:
            experiment: Experiment with all its tuners.
            order: Labels of the tuners in the order of a legend.
            references: Reference results that are drawn in grey.
            notes: Notes by tuner, which are added to its label.
        """
        self.experiment, self.references, self.notes = experiment, references, notes or {}
        # Tuners without runs count, too, so that a colour means the same tuner in every figure.
        self._places = {
            tuner.label: index
            for index, tuner in enumerate(experiment.tuners)
            if tuner.label in order
        }
        self.order = [label for label in order if label in self._places]

    def get_mark_style(self, tuner: str) -> MarkStyle:
        """Return the style of `tuner` on a page."""
        return get_mark_style(self._places[tuner])

    def get_reference_style(self, reference: ReferenceResult, tuner: str) -> dict[str, Any]:
        """Return keyword arguments for plotting `tuner` of a reference.

        The line is grey and thin, with the marker and line style of the user's own tuner of that
        name.

        Args:
            reference: The reference result.
            tuner: Label of the tuner.
        """
        places = dict(self._places)
        # Tuners that the user does not have get the following indices.
        first_free = 1 + max(places.values(), default=-1)
        further_tuners = [label for label in reference.tuners if label not in places]
        places |= {label: first_free + i for i, label in enumerate(further_tuners)}
        place = places[tuner]
        return {
            "color": REFERENCE_GREYS[self.references.index(reference)],
            "marker": get_marker(place),
            "markerfacecolor": "white",
            "markersize": 3.5,
            "linestyle": _LINES[place % len(_LINES)],
            "linewidth": 1.0,
            "zorder": 1.5,
        }


def compute_category_offset(place: int, count: int) -> float:
    """Compute a small shift along a category axis that places points side by side.

    The points of one category are spread over 0.6 of its width.

    Args:
        place: place of the point among those of the category.
        count: number of these points.
    """
    return (place - (count - 1) / 2) * 0.6 / count


def make_panel_grid(
    rows: int,
    columns: int,
    size: tuple[float, float],
    layout: Any = "constrained",
    **options: Any,
) -> tuple[Figure, Any]:
    """Make a figure and its (rows, columns) panels without pyplot.

    Args:
        rows: Number of rows of panels.
        columns: Number of columns of panels.
        size: Width and height in inches.
        layout: Matplotlib's layout engine; None if the margins are set by hand.
        **options: Options of `matplotlib.figure.Figure.subplots`.
    """
    # Matplotlib takes most of a second to load, and most commands draw nothing.
    from bench.figures.notebook_figure import NotebookFigure

    figure = NotebookFigure(figsize=size, layout=layout)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


@contextmanager
def apply_settings(settings: Mapping[Any, Any]) -> Iterator[None]:
    """Apply settings of Matplotlib while figures are drawn or written; hide missing glyphs."""
    from matplotlib import rc_context

    with rc_context(dict(settings)), warnings.catch_warnings():
        # A title may be in any script; characters that the font lacks are drawn as boxes.
        warnings.filterwarnings("ignore", message="Glyph")
        yield


def set_title(axis: Axes, title: str) -> None:
    """Set a title above a panel that has no ticks there."""
    # Without a fixed position, every drawing measures all ticks for the title.
    axis.set_title(title, fontsize=10, y=1.0)


def style_axis(axis: Axes) -> None:
    """Draw a faint grid, and remove the frame at the top and right."""
    axis.grid(visible=True, which="major", linewidth=0.4, alpha=0.5)
    axis.spines[["top", "right"]].set_visible(False)


def finish_figure(
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
    for axis in axes[1:]:
        if axis.get_ylabel() == axes[0].get_ylabel():
            axis.set_ylabel("")
    figure.suptitle(experiment.title or experiment.name, fontsize=11)
    add_caption(figure, caption, letters=17)


_MAX_LEGEND_ROWS = 18
"""Maximum number of legend entries in letters of the normal size."""


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


def add_caption(figure: Figure, caption: str, letters: int) -> None:
    """Add a caption below a figure, with `letters` characters per inch of its width."""
    lines = textwrap.fill(caption, int(letters * figure.get_figwidth()))
    figure.supxlabel(lines, fontsize=7.5, color=CAPTION_GREY)


TRUSTED_TUNERS_NOTE = (
    "trusted: the tuners ran without isolation and could have read the true parameters"
)
"""Warning for results whose tuners were not isolated."""


def add_trust_note(figure: Figure, trusted: bool) -> Figure:
    """Mark a figure in its title and caption if its tuners were not isolated, and return it.

    Args:
        figure: figure of Matplotlib.
        trusted: whether the tuners ran without isolation.
    """
    if trusted:
        figure.suptitle(f"{figure.get_suptitle()} (trusted)", fontsize=11)
        add_caption(
            figure, f"{TRUSTED_TUNERS_NOTE.capitalize()}. {figure.get_supxlabel()}", letters=17
        )
    return figure
