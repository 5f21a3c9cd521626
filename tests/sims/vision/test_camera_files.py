import pytest

from sims.core.simulator import InputError
from sims.vision.pinhole_camera import (
    FilmDescription,
    PinholeCamera,
    format_camera_file,
    read_camera_file,
)

FILMED = FilmDescription(PinholeCamera(0.1, 6.0, 5.0), 0.03, 0.2, 0.0)


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "drop.camera.toml"
    path.write_text(format_camera_file(FILMED))
    return path


def test_what_is_written_is_read(path):
    assert read_camera_file(path) == FILMED


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("azimuth = 0.1", "", "camera.azimuth: expected a number, found None"),
        ("azimuth = 0.1", "azimuth = nan", "camera.azimuth: expected a number, found nan"),
        ("azimuth", "azimut", "unknown entry in .camera. of .*'azimut'; there are: azimuth"),
        ("[ball]", "[bal]", "ball: expected a table, found None"),
        ("radius = 0.03", "radius = 0", "ball.radius: expected more than 0 m, found 0"),
        ("distance = 6.0", "distance = -1", "camera: distance: expected more than 0 m, found -1"),
        ("100,\n    100,\n", "100,\n    nan,\n", "camera.size: expected a number, found nan"),
        ("100,\n    100,\n", "100,\n", r"camera.size: expected 2 numbers, found \[100\]"),
    ],
)
def test_a_fault_is_one_line_that_names_the_file(path, old, new, message):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=message) as caught:
        read_camera_file(path)
    assert "drop.camera.toml" in str(caught.value)
