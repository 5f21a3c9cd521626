"""Tests of filling gaps with a map from a simulation to a sensor: exact for a camera, and NaN where
data are insufficient.
"""

import numpy as np
import pytest

from methods.learning.gap_filling import fill_gaps
from sims.vision.pinhole_camera import PinholeCamera

TIMES = np.arange(120) / 60
FALL = 4.5 - 0.5 * 9.8 * (TIMES % 0.9) ** 2


def rows(camera):
    points = np.stack([0 * FALL, 0 * FALL, FALL], axis=1)
    return camera.project(points)[:, 1]


@pytest.mark.parametrize("gap", [slice(0, 30), slice(20, 60), slice(90, 120)])
def test_a_gap_is_bridged_to_what_a_pinhole_camera_would_have_shown(gap):
    """This includes the beginning, where the ball is above the image and no sample is near."""
    true = rows(PinholeCamera.draw_published(np.random.default_rng(4)))
    seen = true.copy()
    seen[gap] = np.nan
    whole = fill_gaps(seen, FALL)
    assert whole[gap] == pytest.approx(true[gap], abs=1e-6)
    keep = np.isfinite(seen)
    assert (whole[keep] == true[keep]).all()
    held = np.interp(np.arange(120), np.flatnonzero(keep), seen[keep])
    assert (
        np.abs(held[gap] - true[gap]).max() > 5
    )  # error of a constant or linear interpolation across the gap


def test_a_model_that_agrees_only_at_first_bridges_the_beginning():
    true = rows(PinholeCamera.draw_published(np.random.default_rng(5)))
    seen = true.copy()
    seen[:15] = np.nan
    wrong = FALL.copy()
    wrong[100:] += 0.5
    assert fill_gaps(seen, wrong)[:15] == pytest.approx(true[:15], abs=1.0)


def test_too_little_is_not_bridged():
    seen = np.full(120, np.nan)
    seen[:5] = 3.0
    assert np.isnan(fill_gaps(seen, FALL)[5:]).all()
    constant = np.where(TIMES < 1, 7.0, np.nan)
    assert np.isnan(fill_gaps(constant, np.ones(120))[-1])
    whole = rows(PinholeCamera.draw_published(np.random.default_rng(6)))
    assert fill_gaps(whole, FALL) is whole
