import math

import numpy as np
import pytest

from sims.core.simulator import InputError
from sims.vision.pinhole_camera import PinholeCamera


def level(**changes):
    """Return a camera 5 m along x from the target's vertical and at the target's height, so that
    all distances are simple.
    """
    return PinholeCamera(
        **{"azimuth": 0.0, "distance": 5.0, "height": 2.0, "size": (201, 101), **changes}
    )


def test_projection_by_hand():
    camera = level()
    focal = 50.5 / math.tan(math.radians(20))
    assert camera.focal == pytest.approx(focal, rel=1e-14)
    points = [[0, 0, 2], [0, 1, 2], [0, 0, 3], [3, -1, 1]]
    pixels = [
        [100, 50],
        [100 + focal / 5, 50],
        [100, 50 - focal / 5],
        [100 - focal / 2, 50 + focal / 2],
    ]
    np.testing.assert_allclose(camera.project(points), pixels, rtol=0, atol=1e-12)
    np.testing.assert_allclose(camera.to_camera_frame(points)[:, 2], [5, 5, 5, 2], atol=1e-14)
    assert np.isnan(camera.project([6, 0, 2])).all()


def test_a_turned_camera_sees_the_turned_world():
    plain, turned = PinholeCamera(0.0, 7.0, 6.0), PinholeCamera(1.2, 7.0, 6.0)
    points = np.random.default_rng(0).normal(0, 1, (20, 3)) + np.array([0, 0, 2])
    c, s = math.cos(1.2), math.sin(1.2)
    rotated = points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    np.testing.assert_allclose(turned.project(rotated), plain.project(points), atol=1e-10)
    np.testing.assert_allclose(
        np.linalg.norm(turned.position - (0, 0, 2)), math.hypot(7, 4), rtol=1e-14
    )


def test_the_middle_of_the_picture_is_the_target_and_its_edge_the_field_of_view():
    camera = PinholeCamera(0.7, 6.0, 7.0, size=(640, 480))
    np.testing.assert_allclose(camera.project(camera.target), [319.5, 239.5], atol=1e-10)
    edge = np.array(camera.target) - camera.axes[1] * np.linalg.norm(
        camera.position - camera.target
    ) * math.tan(math.radians(20))
    np.testing.assert_allclose(camera.project(edge), [319.5, -0.5], atol=1e-9)


def test_outline_of_a_sphere_by_hand_and_by_its_surface():
    camera = level()
    centre, axes = camera.project_sphere([0.0, 0.0, 2.0], 0.5)
    radius = (
        camera.focal * 0.5 / math.sqrt(25 - 0.25)
    )  # on the optical axis: a circle, tangents from the camera
    np.testing.assert_allclose(centre, [100, 50], atol=1e-12)
    np.testing.assert_allclose(axes, [radius, radius], rtol=1e-12)
    camera = PinholeCamera(0.3, 5.5, 7.5, size=(400, 400))
    ball = np.array([0.6, 0.4, 4.6])
    rng = np.random.default_rng(1)
    surface = ball + 0.5 * (points := rng.normal(size=(400_000, 3))) / np.linalg.norm(
        points, axis=1, keepdims=True
    )
    pixels = camera.project(surface)
    (u, v), (longer, shorter) = camera.project_sphere(ball, 0.5)
    direction = np.array([u, v]) - camera.principal_point
    direction /= np.linalg.norm(direction)
    along, across = (pixels - (u, v)) @ direction, (pixels - (u, v)) @ [-direction[1], direction[0]]
    np.testing.assert_allclose([along.max(), -along.min()], longer, rtol=2e-4)
    np.testing.assert_allclose([across.max(), -across.min()], shorter, rtol=2e-4)
    assert longer / shorter > 1.01


def test_heights_come_back_from_outlines():
    for seed in range(20):
        camera = PinholeCamera.draw_published(np.random.default_rng(seed))
        z = np.linspace(0.5, 5.0, 50)
        points = np.stack([np.full(50, 0.2), np.full(50, -0.1), z], axis=1)
        np.testing.assert_allclose(
            camera.estimate_heights(camera.project_sphere(points, 0.5)[0], 0.2, -0.1, 0.5),
            z,
            atol=1e-6,
        )


def test_published_cameras_lie_in_the_published_ranges():
    cameras = [PinholeCamera.draw_published(np.random.default_rng(seed)) for seed in range(300)]
    for name, low, high in (("azimuth", 0, 2 * math.pi), ("distance", 5, 10), ("height", 5, 8)):
        values = np.array([getattr(c, name) for c in cameras])
        assert low <= values.min() < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < values.max() <= high
    assert {(c.field_of_view, c.target, c.size) for c in cameras} == {
        (40.0, (0.0, 0.0, 2.0), (100, 100))
    }


@pytest.mark.parametrize(
    "change", [{"distance": 0.0}, {"field_of_view": 180.0}, {"height": np.nan}, {"size": (1, 9)}]
)
def test_impossible_cameras_are_refused(change):
    with pytest.raises(InputError, match="camera"):
        level(**change)
