"""File formats of figures: PNG always (ISO/IEC 15948:2004), PDF on request.

Rendering a PDF takes about as long as rendering the PNG, and most PDF files are never opened. The
commands take ``--pdf``, the functions of `simgap` take ``pdf=True``. Both set it here, so that the
functions between them and the file need not pass it on.

Pillow tests five filters on each row, which is useful for photographs. Drawings mostly consist of
rows of equal pixels: without a filter they take half the time and give smaller files.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import numpy as np

_WANTED: ContextVar[bool] = ContextVar("pdf_wanted", default=False)


@contextmanager
def pdf_figures(wanted: bool = True) -> Iterator[None]:
    """Context in which every figure is also written as PDF.

    Args:
        wanted: Whether to write PDF files; False does not override an outer context with True.
    """
    token = _WANTED.set(wanted or _WANTED.get())
    try:
        yield
    finally:
        _WANTED.reset(token)


def is_pdf_wanted() -> bool:
    """Return whether PDF files are requested."""
    return _WANTED.get()


_command = False


def mark_as_command() -> None:
    """Record that this process runs a command and is not an interactive session."""
    global _command
    _command = True


def is_command() -> bool:
    """Return whether this process runs a command, which shows no docstrings of libraries."""
    return _command


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
    rows = np.zeros((height, 1 + 3 * width), dtype=np.uint8)
    colours = rows[:, 1:].reshape(height, width, 3)
    # NumPy copies three long strided rows in a third of the time of many short ones.
    for channel in range(3):
        colours[:, :, channel] = pixels[:, :, channel]
    density = round(dpi * _INCHES_PER_METRE)
    return b"".join(
        (
            _SIGNATURE,
            _make_chunk(b"IHDR", struct.pack(">II5B", width, height, *_EIGHT_BITS_RGB)),
            _make_chunk(b"pHYs", struct.pack(">IIB", density, density, 1)),
            _make_chunk(b"IDAT", zlib.compress(rows.data, _COMPRESSION_LEVEL)),
            _make_chunk(b"IEND", b""),
        )
    )


def _make_chunk(kind: bytes, data: bytes) -> bytes:
    """Return a chunk of a PNG file with its length and checksum."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
