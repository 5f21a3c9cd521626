import os
from pathlib import Path

import pytest

PLUGINS = Path(__file__).parent / "plugins"


@pytest.fixture(scope="session")
def spring():
    """The test simulator, registered."""
    from bench.registry import load_plugins, simulators

    load_plugins([PLUGINS / "spring.py"])
    return simulators.get("spring")


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory, monkeypatch):
    """Trained weights of tests never meet the user's."""
    monkeypatch.setenv("SIMGAP_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))


@pytest.fixture(scope="session")
def recordings():
    """The folder of real recordings; tests that need it skip visibly where it is missing."""
    folder = Path(os.environ.get("SIMGAP_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no recordings: {folder} is missing (set SIMGAP_DATA)")
    return folder
