import pytest

from bench.core.plugin_registries import make_robot_simulator
from tests.bench.logs.test_log_quality import ARM


@pytest.fixture(scope="session")
def kind(tmp_path_factory):
    """Return the simulator class of a robot with two servos."""
    path = tmp_path_factory.mktemp("robot") / "two.xml"
    path.write_text(ARM)
    return make_robot_simulator(path)
