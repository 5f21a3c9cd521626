import pytest

from tests.malformed.short import environment
from tests.malformed.sound import bases


@pytest.fixture(scope="session")
def ready(tmp_path_factory):
    """A folder to work in, and prepared folders by name."""
    folder = tmp_path_factory.mktemp("malformed")
    with environment(folder / "place"):
        return folder, bases(folder)
