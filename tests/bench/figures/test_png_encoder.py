"""Tests of the PNG encoder: Pillow reads the same pixels, and the image has the requested size."""

from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from bench.figures.figure_layout import make_panel_grid
from bench.figures.figure_output import encode_png, render_png


def test_pixels_and_dots_an_inch_are_kept():
    rgba = np.random.default_rng(0).integers(0, 256, (7, 5, 4), dtype=np.uint8)
    with Image.open(BytesIO(encode_png(rgba.tobytes(), 7, 5, 160.0))) as image:
        assert (image.format, image.mode, image.size) == ("PNG", "RGB", (5, 7))
        assert image.info["dpi"] == pytest.approx((160.0, 160.0), abs=0.1)
        np.testing.assert_array_equal(np.asarray(image), rgba[:, :, :3])


@pytest.mark.parametrize("size", [(10.6875, 4.9700000000000006), (3.14159, 2.71828), (1.07, 1.01)])
def test_a_figure_is_what_matplotlib_writes(size):
    figure, axes = make_panel_grid(1, 1, size, layout=None)
    axes[0, 0].plot([0, 1], [0, 1])
    expected = BytesIO()
    figure.savefig(expected, format="png", dpi=150)
    with Image.open(expected) as a, Image.open(BytesIO(render_png(figure, 150))) as b:
        np.testing.assert_array_equal(np.asarray(a)[:, :, :3], np.asarray(b))
