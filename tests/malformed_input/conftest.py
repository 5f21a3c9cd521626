import pytest

from tests.malformed_input.shortened_work import environment
from tests.malformed_input.valid_input import bases


@pytest.fixture(scope="session")
def ready(tmp_path_factory):
    """Return a working folder and the prepared folders by name."""
    folder = tmp_path_factory.mktemp("malformed")
    with environment(folder / "place"):
        return folder, bases(folder)
