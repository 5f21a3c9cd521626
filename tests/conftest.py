import os
import signal
from pathlib import Path

import pytest

PLUGINS = Path(__file__).parent / "plugins"

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in the background; children inherit it
    signal.signal(signal.SIGINT, signal.default_int_handler)


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


@pytest.fixture(scope="module", autouse=True)
def registries_as_before():
    """What a module's tests register is gone after it, but for the test simulator."""
    from bench import registry
    from sims import effects

    parts = (registry.tuners._from_files, registry.simulators._from_files, effects._from_files)
    before, loaded = [dict(p) for p in parts], set(registry._loaded)
    yield
    for part, kept in zip(parts, before, strict=True):
        for name in [n for n in part if n not in kept and n != "spring"]:
            del part[name]
    registry._loaded.intersection_update(loaded | {PLUGINS / "spring.py"})
