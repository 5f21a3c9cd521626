import pytest

from methods.tuners.tunenet import TuneNet
from tests.methods.test_tunenet import Toy, trained


@pytest.fixture(scope="session")
def two() -> TuneNet:
    """Return a network for two parameters and three runs; tests do not change it."""
    return trained(Toy(2, runs=3), scenarios=80)
