import pytest


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a text to a file and returns its path."""

    def written(text, name="robot.xml"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return path

    return written
