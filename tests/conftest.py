import os
import re
import signal
from collections import Counter
from pathlib import Path

import pytest

PLUGINS = Path(__file__).parent / "plugins"

_SHARED = Path(__file__).parents[2] / "shared"
_BESIDE = _SHARED / "data"
"""Folder of the real recordings on machines that have them."""

_READS_DATA = re.compile(
    "SIMGAP_(DATA|ROBOTS)|[\"']shared[\"']|pendulum-real|robot-so101|simgap list"
)
"""What a test file contains whose tests may differ with these recordings."""

# For child processes too. Values that the user has set stand.
for _name, _folder in (("SIMGAP_DATA", _BESIDE), ("SIMGAP_ROBOTS", _SHARED / "robots")):
    if _folder.is_dir():
        os.environ.setdefault(_name, str(_folder))

# One test's threads of linear algebra wait for another's, and spend its time waiting.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in the background; children inherit it
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_configure(config):
    """Machine code is made before there are workers that would each wait for it."""
    if not hasattr(config, "workerinput"):
        from sims.engines.compiled import kernel

        kernel.get_kernel()


@pytest.fixture(scope="session")
def spring():
    """The test simulator, registered."""
    from bench.core.plugin_registries import load_plugins, simulators

    load_plugins([PLUGINS / "spring.py"])
    return simulators.get("spring")


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory, monkeypatch):
    """Keep the trained weights and data sets of tests apart from the user's."""
    monkeypatch.setenv("SIMGAP_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path_factory.getbasetemp() / "data"))


@pytest.fixture(scope="session")
def recordings():
    """The folder of real recordings; tests that need it skip visibly where it is missing."""
    folder = Path(os.environ.get("SIMGAP_DATA", _BESIDE))
    if not folder.is_dir():
        pytest.skip(f"no recordings: {folder} is missing (set SIMGAP_DATA)")
    return folder


@pytest.fixture(scope="module", autouse=True)
def registries_as_before():
    """What a module's tests register is gone after it, but for the test simulator."""
    from bench.core.plugin_registries import REGISTRIES, simulators

    before = [registry.snapshot() for registry in REGISTRIES]
    yield
    # Other modules hold the class that the session's fixture registered.
    shared = {name: part for name, part in simulators.snapshot().items() if name == "spring"}
    for registry, snapshot in zip(REGISTRIES, before, strict=True):
        registry.restore(snapshot)
    simulators.restore({**simulators.snapshot(), **shared})


@pytest.fixture
def fresh_registries():
    """What a test registers is gone after it."""
    from bench.core.plugin_registries import REGISTRIES

    before = [registry.snapshot() for registry in REGISTRIES]
    yield
    for registry, snapshot in zip(REGISTRIES, before, strict=True):
        registry.restore(snapshot)


@pytest.fixture
def undrawn():
    """Comparisons of this process write their tables alone."""
    from tests import without_drawing

    with without_drawing.undrawn():
        yield


_SECONDS = {True: 15.0, False: 0.2}
"""What a test takes, about, by whether it is marked as slow."""


@pytest.hookimpl(tryfirst=True)  # before `-m` chooses by markers
def pytest_collection_modifyitems(items):
    """Mark the tests that depend on the folder of recordings beside the clone, and put files that
    take long first: one that began last would keep the other workers waiting.
    """
    seconds = Counter()
    reads = {path: bool(_READS_DATA.search(path.read_text())) for path in {i.path for i in items}}
    for item in items:
        if reads[item.path] or "recordings" in item.fixturenames:
            item.add_marker(pytest.mark.data)
        seconds[item.path] += _SECONDS[item.get_closest_marker("slow") is not None]
    items.sort(key=lambda item: -seconds[item.path])


@pytest.fixture(scope="session")
def browser():
    """One headless browser for all tests of pages; they skip visibly where there is none."""
    from tests.browser import launched

    with launched() as started:
        yield started
