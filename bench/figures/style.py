"""Style of all figures: palette, greys, markers and line styles.

The style is made for print: every tuner has its own marker and line style in addition to its
colour, and colours differ in lightness.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from bench.benchmark.problem.experiment_config import Experiment
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
# Dark and light colours alternate, so that neighbours differ in greyscale, too.
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
