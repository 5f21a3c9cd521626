"""Render figures as PNG (ISO/IEC 15948:2004), SVG and PDF, and write their files.

Pillow tests five filters on each row, which is useful for photographs. Drawings mostly consist of
rows of equal pixels: without a filter they take half the time and give smaller files.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from bench.figures.figure_settings import is_pdf_wanted
from sims.core.files import write_all_atomically
from sims.core.simulator import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_LONG_NUMBER_PATTERN = re.compile(rb"\b[1-9]\d*\.\d{3,}\b")
"""Pattern of a number in an SVG file with needless digits; numbers below 1 are scales."""
DPI = 160
"""Resolution of the PNG files in dots per inch."""
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_EIGHT_BITS_RGB = (8, 2, 0, 0, 0)
"""Bit depth, colour type, compression, filter method and interlacing of the header."""
_COMPRESSION_LEVEL = 3
"""Compression level: the default 6 takes twice the time for files of the same size."""
_INCHES_PER_METRE = 39.3701
"""Number of inches in a metre."""


def encode_png(rgba: bytes | memoryview, height: int, width: int, dpi: float) -> bytes:
    """Encode an opaque image as the bytes of a PNG file.

    Args:
        rgba: Red, green, blue and opacity of each pixel, row by row; the opacity is ignored.
        height: Number of rows.
        width: Number of pixels per row.
        dpi: Dots per inch, for programs that print the file.

    Raises:
        ValueError: The number of pixels is not height times width.
    """
    pixels = np.frombuffer(rgba, dtype=np.uint8).reshape(height, width, 4)
    # Each row begins with the number of its filter: 0 for none.
    pixel_rows = np.zeros((height, 1 + 3 * width), dtype=np.uint8)
    colours = pixel_rows[:, 1:].reshape(height, width, 3)
    # NumPy copies three long strided rows in a third of the time of many short ones.
    for channel in range(3):
        colours[:, :, channel] = pixels[:, :, channel]
    density = round(dpi * _INCHES_PER_METRE)
    return b"".join(
        (
            _SIGNATURE,
            _make_chunk(b"IHDR", struct.pack(">II5B", width, height, *_EIGHT_BITS_RGB)),
            _make_chunk(b"pHYs", struct.pack(">IIB", density, density, 1)),
            _make_chunk(b"IDAT", zlib.compress(pixel_rows.data, _COMPRESSION_LEVEL)),
            _make_chunk(b"IEND", b""),
        )
    )


def _make_chunk(kind: bytes, data: bytes) -> bytes:
    """Return a chunk of a PNG file with its length and checksum.

    Args:
        kind: four letters of the chunk's type, such as ``IDAT``.
        data: content.
    """
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def render_png(figure: Figure, dpi: int = DPI) -> bytes:
    """Render a figure as the bytes of a PNG file.

    Args:
        figure: figure of Matplotlib.
        dpi: resolution in pixels per inch.
    """
    file = _Pixels()
    figure.savefig(file, format="rgba", dpi=dpi)
    return encode_png(file.getbuffer(), *file.shape, dpi=dpi)


class _Pixels(BytesIO):
    """The pixels of a figure as Matplotlib's renderer writes them.

    Attributes:
        shape: Height and width as rounded by the renderer.
    """

    shape: tuple[int, int] = (0, 0)

    def write(self, pixels: Any) -> int:
        """Store the pixels (H, W, 4), which are written in one call."""
        height, width, _ = memoryview(pixels).shape or (0, 0, 0)
        self.shape = height, width
        return super().write(pixels)


def render_pdf(figure: Figure) -> bytes:
    """Render a figure as the bytes of a PDF file."""
    file = BytesIO()
    # Without a date the file is identical whenever it is made.
    figure.savefig(file, format="pdf", metadata={"CreationDate": None})
    return file.getvalue()


def render_svg(figure: Figure) -> bytes:
    """Render a figure as the bytes of an SVG file, the same whenever it is made.

    Args:
        figure: Figure of Matplotlib.
    """
    from matplotlib import rc_context

    file = BytesIO()
    # Without a date and random names the file is identical whenever it is made.
    with rc_context({"svg.hashsalt": "simgap"}):
        figure.savefig(file, format="svg", metadata={"Date": None})

    def shorten(number: re.Match[bytes]) -> bytes:
        """Round to a hundredth of a point, which is finer than any printer's resolution."""
        return f"{float(number[0]):.2f}".encode()

    # Longer numbers would double the size of the file.
    return _LONG_NUMBER_PATTERN.sub(shorten, file.getvalue())


def render_png_and_pdf(figure: Figure, dpi: int = DPI) -> tuple[bytes, bytes | None]:
    """Render a figure as PNG, and as PDF if requested (`bench.figures.figure_settings`).

    Args:
        figure: figure of Matplotlib.
        dpi: resolution of the PNG in pixels per inch.

    Returns:
        The bytes of the PNG file, and those of the PDF file or None.
    """
    with _lay_out_once(figure, dpi):
        return render_png(figure, dpi), _render_pdf_if_wanted(figure)


def render_all_formats(figure: Figure, dpi: int = DPI) -> FigureFiles:
    """Render a figure as PNG, as SVG for a page, and as PDF if requested.

    Args:
        figure: figure of Matplotlib.
        dpi: resolution of the PNG in pixels per inch.
    """
    with _lay_out_once(figure, dpi):
        return FigureFiles(
            render_png(figure, dpi), render_svg(figure), _render_pdf_if_wanted(figure)
        )


class FigureFiles(NamedTuple):
    """One figure as the bytes of its files.

    Attributes:
        png: PNG file; empty if only a page shows the figure.
        svg: SVG file; None if the page shows the PNG.
        pdf: PDF file; None if none was requested.
        joint_positions: For a drawing of a robot, joints with their positions as fractions of width
            and height from the top left.
    """

    png: bytes
    svg: bytes | None = None
    pdf: bytes | None = None
    joint_positions: tuple[tuple[str, float, float], ...] = ()


def _render_pdf_if_wanted(figure: Figure) -> bytes | None:
    return render_pdf(figure) if is_pdf_wanted() else None


@contextmanager
def _lay_out_once(figure: Figure, dpi: int) -> Iterator[None]:
    """Compute the layout of a figure once for all files that are written in the `with` block.

    Args:
        figure: figure of Matplotlib.
        dpi: resolution for which text is measured, in pixels per inch.
    """
    engine, screen_dpi = figure.get_layout_engine(), figure.dpi
    try:
        # Without an engine, the margins are set by hand.
        if engine is not None:
            figure.set_dpi(dpi)
            engine.execute(figure)
            figure.set_dpi(screen_dpi)
            # With the engine, savefig would draw the figure once more for the layout of each file.
            figure.set_layout_engine(None)
        yield
    finally:
        figure.set_dpi(screen_dpi)
        figure.set_layout_engine(engine)


def write_figure(figure: Figure, path: Path, dpi: int = DPI) -> list[Path]:
    """Write a figure as PNG, and as PDF if requested: all files or none.

    Missing folders are made.

    Args:
        figure: Figure to write.
        path: Path of the files without file extension.
        dpi: Resolution of the PNG in dots per inch.

    Returns:
        Paths of the files, the PNG first.

    Raises:
        InputError: The folder cannot be made or written to.
    """
    return write_figure_files(path, *render_png_and_pdf(figure, dpi))


def write_figures(folder: Path, figures: Mapping[str, FigureFiles]) -> list[Path]:
    """Write figures to the folder ``figures`` of a result folder.

    Args:
        folder: Result folder.
        figures: Figures by the name of their files.

    Returns:
        Paths of the files, for each figure the PNG before the PDF.

    Raises:
        InputError: The folder cannot be made or written to.
    """
    return [
        path
        for name, figure in figures.items()
        for path in write_figure_files(folder / "figures" / name, figure.png, figure.pdf)
    ]


def write_figure_files(path: Path, as_png: bytes, as_pdf: bytes | None) -> list[Path]:
    """Write a figure's files, all or none.

    Args:
        path: Path of the files without file extension.
        as_png: Content of the PNG file.
        as_pdf: Content of the PDF file; None for no such file.

    Returns:
        Paths of the files, the PNG first.

    Raises:
        InputError: The folder cannot be made or written to.
    """
    contents = {path.with_name(f"{path.name}.png"): as_png}
    if as_pdf is not None:
        contents[path.with_name(f"{path.name}.pdf")] = as_pdf
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_all_atomically(contents)
    except OSError as error:
        raise InputError(f"{path.parent}: cannot be written ({error.strerror})") from None
    return list(contents)
