"""Tests of the filmed ball: its image in the camera, and the tracked film."""

import importlib.util

import numpy as np
import pytest

from sims.core.simulator import InputError, Scenario
from sims.vision.filmed_ball import FilmedBall

TIMES = np.arange(60) / 60.0
CONSTANTS = {"radius": 0.5, "gravity": 9.8}
vision = pytest.mark.skipif(
    not all(map(importlib.util.find_spec, ("av", "cv2"))),
    reason="PyAV and OpenCV are not installed: .[vision]",
)


def test_row_of_a_resting_ball_is_that_of_the_pinhole():
    """A level camera at distance d sees the centre of a resting ball h - r below its axis, at focal
    (h - r) / d.
    """
    far = FilmedBall(
        {"radius": 0.001, "camera_distance": 20.0, "camera_height": 2.0, "pixels": 400.0}
    )
    seen = far.simulate(np.array([[0.5]]), Scenario(TIMES[:1], {"z": 1.0}))[0, 0]
    focal = 200.0 / np.tan(np.radians(20.0))
    assert seen[0] == pytest.approx(1.0)
    assert seen[1] == pytest.approx(199.5 + focal * 1.0 / 20.0, abs=1e-3)


def test_a_ball_on_the_optical_axis_is_in_the_middle_wherever_the_camera_stands():
    for azimuth, distance, height in ((0.0, 5.0, 5.0), (2.0, 8.0, 7.0)):
        place = {"camera_azimuth": azimuth, "camera_distance": distance, "camera_height": height}
        seen = FilmedBall(CONSTANTS).simulate(
            np.array([[0.5]]), Scenario(TIMES[:1], {"z": 2.0}, {}, place)
        )
        assert seen[0, 0, 1] == pytest.approx(49.5, abs=1e-9)


@vision
def test_tracked_rows_are_those_of_the_projection_within_a_pixel_and_heights_are_hidden():
    place = {"camera_azimuth": 1.0, "camera_distance": 9.0, "camera_height": 6.0}
    fall = Scenario(TIMES, {"z": 4.0}, {}, place)
    theta = np.array([[0.6]])
    true = FilmedBall(CONSTANTS).simulate(theta, fall)[0]
    world = FilmedBall(CONSTANTS, film="tracked")
    seen = world.simulate(theta, fall)[0]
    assert np.isnan(seen[:, 0]).all()
    there = np.isfinite(seen[:, 1])
    assert there.mean() > 0.8
    assert np.sqrt(np.mean((seen[there, 1] - true[there, 1]) ** 2)) < 1.0
    assert np.array_equal(
        seen, FilmedBall(CONSTANTS, film="tracked").simulate(theta, fall)[0], equal_nan=True
    )


@vision
def test_where_the_ball_is_out_of_the_picture_nothing_is_invented():
    place = {"camera_distance": 5.0, "camera_height": 5.0}
    fall = Scenario(TIMES, {"z": 5.0}, {}, place)
    true = FilmedBall(CONSTANTS).simulate(np.array([[0.6]]), fall)[0, :, 1]
    seen = FilmedBall(CONSTANTS, film="tracked").simulate(np.array([[0.6]]), fall)[0, :, 1]
    outside = true < -15.0  # its radius is 10 px: no part of it is visible
    assert outside.sum() >= 3
    assert np.isnan(seen[outside]).all()
    away = FilmedBall(CONSTANTS, film="tracked").simulate(
        np.array([[0.6]]), Scenario(TIMES[:20], {"z": 9.0}, {}, place)
    )
    assert np.isnan(away).all(), "a film without a ball has no rows"


def test_an_unknown_film_and_missing_packages_are_one_line(monkeypatch):
    with pytest.raises(InputError, match="projected, tracked, found 'seen'"):
        FilmedBall(film="seen")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r'pip install -e "\.\[vision\]"'):
        FilmedBall(film="tracked")


def test_free_effects_act_on_the_ball_before_the_camera():
    fall = Scenario(TIMES, {"z": 4.0}, {}, {"camera_distance": 7.0})
    free = FilmedBall(CONSTANTS, effects=["drag.quadratic"])
    assert [parameter.name for parameter in free.parameters] == ["restitution", "drag.quadratic"]
    seen = free.simulate(np.array([[0.6, 0.0], [0.6, 0.1]]), fall)
    fixed = FilmedBall(CONSTANTS, fixed={"drag.quadratic": [0.1]})
    assert np.array_equal(seen[1], fixed.simulate(np.array([[0.6]]), fall)[0])
    assert np.array_equal(seen[0], FilmedBall(CONSTANTS).simulate(np.array([[0.6]]), fall)[0])
    assert np.abs(seen[1] - seen[0])[:, 0].max() > 0.1
